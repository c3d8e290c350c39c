//! Tables for the terminal: the uncertainty is below its value, so that rows stay short.

use crate::app::comparison::table::{Table, value_and_uncertainty};

/// Maximum width of a line of a column title [characters].
const TITLE_WIDTH: usize = 16;
/// Maximum width of a line of the note [characters].
const NOTE_WIDTH: usize = 100;
/// Space between columns.
const GAP: &str = "  ";

/// Formats the table as aligned lines.
pub fn table(table: &Table) -> String {
    let titles = table
        .columns
        .iter()
        .map(|c| wrapped(&c.title(), TITLE_WIDTH));
    let mut titles: Vec<Vec<String>> = titles.collect();
    // Titles are aligned at the bottom.
    let height = titles.iter().map(Vec::len).max().unwrap_or(0);
    for title in &mut titles {
        title.splice(0..0, vec![String::new(); height - title.len()]);
    }
    let rows = table.rows.iter().map(|row| -> Vec<Vec<String>> {
        let cells = row.iter().map(value_and_uncertainty);
        cells
            .map(|(value, below)| {
                if below.is_empty() {
                    vec![value]
                } else {
                    vec![value, below]
                }
            })
            .collect()
    });
    let rows: Vec<Vec<Vec<String>>> = rows.collect();
    let widths: Vec<usize> = (0..table.columns.len())
        .map(|column| {
            let cells = rows.iter().chain([&titles]).flat_map(|row| &row[column]);
            cells.map(|line| line.chars().count()).max().unwrap_or(0)
        })
        .collect();
    let line = |cells: &[Vec<String>], line: usize| {
        let cells = cells.iter().zip(&widths).enumerate();
        let cells = cells.map(|(column, (cell, &width))| {
            let text = cell.get(line).map_or("", String::as_str);
            if table.is_numeric(column) {
                format!("{text:>width$}")
            } else {
                format!("{text:<width$}")
            }
        });
        let joined = cells.collect::<Vec<String>>().join(GAP);
        joined.trim_end().to_owned()
    };
    let mut lines = vec![table.title.clone(), String::new()];
    lines.extend((0..height).map(|number| line(&titles, number)));
    let rules: Vec<String> = widths.iter().map(|&width| "-".repeat(width)).collect();
    lines.push(rules.join(GAP));
    for row in &rows {
        let height = row.iter().map(Vec::len).max().unwrap_or(0);
        lines.extend((0..height).map(|number| line(row, number)));
    }
    if !table.note.is_empty() {
        lines.push(String::new());
        lines.extend(wrapped(&table.note, NOTE_WIDTH));
    }
    lines.join("\n") + "\n"
}

/// Wraps text between words into lines of at most `width` characters.
fn wrapped(text: &str, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 1 + word.chars().count() <= width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::comparison::table_tests::example;

    #[test]
    fn numbers_are_aligned_and_their_spread_is_below_them() {
        let text = table(&example());
        let lines: Vec<&str> = text.lines().collect();
        let place = |line: usize, word: &str| {
            let start = lines[line].find(word);
            start.unwrap_or_else(|| panic!("{word} is not in line {line}:\n{text}")) + word.len()
        };
        assert!(lines[0].starts_with("Table 1"));
        // Three lines of titles, a rule, then two lines per row with a spread.
        assert_eq!(place(4, "[m]"), place(6, "0.0230"), "{text}");
        assert!(lines[7].trim().starts_with("±0.0020"), "{text}");
        assert_eq!(place(6, "0.0230"), place(8, "0.5000"));
    }

    #[test]
    fn long_titles_are_wrapped_between_words() {
        let lines = wrapped("drift over distance [mm/m]", 16);
        assert_eq!(lines, ["drift over", "distance [mm/m]"]);
        assert_eq!(
            wrapped("incomprehensibilities", 5),
            ["incomprehensibilities"]
        );
    }
}
