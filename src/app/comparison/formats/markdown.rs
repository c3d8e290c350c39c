//! Tables in Markdown, with the definitions of their columns below.

use std::fmt::Write as _;

use crate::app::comparison::table::{Cell, Table, value_and_uncertainty};
use crate::app::run::visible::visible_in_line;

/// Formats the table under a heading.
pub fn table(table: &Table) -> String {
    let mut text = format!("## {}\n\n", table.title);
    let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
    let titles = table.columns.iter().map(|c| escape(&c.title()));
    text.push_str(&line(titles.collect()));
    let rules = (0..table.columns.len()).map(|column| {
        let rule = if table.is_numeric(column) {
            "---:"
        } else {
            "---"
        };
        rule.to_owned()
    });
    text.push_str(&line(rules.collect()));
    for row in &table.rows {
        text.push_str(&line(row.iter().map(cell).collect()));
    }
    if !table.note.is_empty() {
        let _ = write!(text, "\n{}\n", table.note);
    }
    let definitions: String = table
        .defined_columns()
        .map(|column| format!("- **{}**: {}\n", column.name, column.definition))
        .collect();
    if !definitions.is_empty() {
        let _ = write!(text, "\n{definitions}");
    }
    text
}

fn cell(cell: &Cell) -> String {
    let (value, uncertainty) = value_and_uncertainty(cell);
    match cell {
        Cell::Link { text, to } => format!("[{}]({to})", escape(text)),
        _ if uncertainty.is_empty() => escape(&value),
        Cell::Mean(_) => format!("{value} {uncertainty}"),
        _ => format!("{value} ({uncertainty})"),
    }
}

/// Shows control characters, and escapes the bar, which would end the cell.
fn escape(text: &str) -> String {
    visible_in_line(text).replace('|', "\\|")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::comparison::table_tests::example;

    #[test]
    fn every_line_has_as_many_cells_and_every_column_its_definition() {
        let text = table(&example());
        let lines: Vec<&str> = text.lines().filter(|line| line.starts_with('|')).collect();
        assert_eq!(lines.len(), 4);
        for line in &lines {
            let bars = line.replace("\\|", "").matches('|').count();
            assert_eq!(bars, 4, "{line}");
        }
        assert!(
            lines[2].contains("| 0.0230 ±0.0020 | 100 (57 .. 100) |"),
            "{text}"
        );
        assert!(lines[3].contains("[B\\|C](runs/b.html)"), "{text}");
        assert_eq!(text.matches("- **").count(), 2);
    }

    #[test]
    fn control_characters_of_a_cell_are_shown() {
        let mut example = example();
        example.rows[0][0] = "a\u{1b}[2J\n| b".into();
        let text = table(&example);
        assert!(text.contains(r"| a\u001b[2J\n\| b |"), "{text}");
    }
}
