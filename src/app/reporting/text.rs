//! Tables for the terminal: what is uncertain stands below its number, so that rows stay short.

use super::words::parts;
use crate::app::comparison::Table;

/// Widest line of a head before it is broken [characters].
const HEAD_WIDTH: usize = 16;
/// Between columns.
const GAP: &str = "  ";

/// The table as lines.
pub fn table(table: &Table) -> String {
    let heads: Vec<Vec<String>> = table
        .columns
        .iter()
        .map(|column| broken(&column.head(), HEAD_WIDTH))
        .collect();
    let mut bands = vec![heads];
    for row in &table.rows {
        let cell = |cell| {
            let (first, second) = parts(cell);
            if second.is_empty() {
                vec![first]
            } else {
                vec![first, second]
            }
        };
        bands.push(row.iter().map(cell).collect());
    }
    let widths: Vec<usize> = (0..table.columns.len())
        .map(|column| {
            let lines = bands.iter().flat_map(|band| &band[column]);
            lines.map(|line| line.chars().count()).max().unwrap_or(0)
        })
        .collect();
    let words: Vec<bool> = (0..table.columns.len())
        .map(|column| table.rows.iter().all(|row| row[column].number().is_none()))
        .collect();
    let mut text = format!("{}\n\n", table.title);
    for (index, band) in bands.iter().enumerate() {
        let height = band.iter().map(Vec::len).max().unwrap_or(0);
        for line in 0..height {
            let cells = band.iter().enumerate().map(|(column, lines)| {
                // Heads stand on their numbers.
                let skipped = if index == 0 { height - lines.len() } else { 0 };
                let found = line.checked_sub(skipped).and_then(|line| lines.get(line));
                let found = found.map_or("", String::as_str);
                let width = widths[column];
                if words[column] {
                    format!("{found:<width$}")
                } else {
                    format!("{found:>width$}")
                }
            });
            let joined = cells.collect::<Vec<String>>().join(GAP);
            text.push_str(joined.trim_end());
            text.push('\n');
        }
        if index == 0 {
            let rules: Vec<String> = widths.iter().map(|width| "-".repeat(*width)).collect();
            text.push_str(&rules.join(GAP));
            text.push('\n');
        }
    }
    if !table.note.is_empty() {
        text.push('\n');
        for line in broken(&table.note, 100) {
            text.push_str(&line);
            text.push('\n');
        }
    }
    text
}

/// Words in lines of at most `width`, where they allow it.
fn broken(text: &str, width: usize) -> Vec<String> {
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
    use super::super::markdown::tests::example;
    use super::*;

    #[test]
    fn numbers_stand_below_each_other_and_their_scatter_below_them() {
        let text = table(&example());
        let lines: Vec<&str> = text.lines().collect();
        let place = |line: usize, word: &str| {
            let start = lines[line].find(word);
            start.unwrap_or_else(|| panic!("{word} is not in line {line}:\n{text}")) + word.len()
        };
        assert!(lines[0].starts_with("Table 1"));
        // Three lines of head, a rule, then two lines per row with scatter.
        assert_eq!(place(4, "[m]"), place(6, "0.0230"), "{text}");
        assert!(lines[7].trim().starts_with("±0.0020"), "{text}");
        assert_eq!(place(6, "0.0230"), place(8, "0.5000"));
    }

    #[test]
    fn long_heads_are_broken_between_words() {
        let lines = broken("drift over distance [mm/m]", 16);
        assert_eq!(lines, ["drift over", "distance [mm/m]"]);
        assert_eq!(
            broken("incomprehensibilities", 5),
            ["incomprehensibilities"]
        );
    }
}
