//! Tables in Markdown, with the definitions of their columns below.

use std::fmt::Write as _;

use super::words::parts;
use crate::app::comparison::{Cell, Table};

/// The table under a heading.
pub fn table(table: &Table) -> String {
    let mut text = format!("## {}\n\n", table.title);
    let line = |cells: Vec<String>| format!("| {} |\n", cells.join(" | "));
    let heads = table.columns.iter().map(|column| escaped(&column.head()));
    text.push_str(&line(heads.collect()));
    let rules = (0..table.columns.len()).map(|column| {
        let has_numbers = table.rows.iter().any(|row| row[column].number().is_some());
        if has_numbers { "---:" } else { "---" }.to_owned()
    });
    text.push_str(&line(rules.collect()));
    for row in &table.rows {
        text.push_str(&line(row.iter().map(cell).collect()));
    }
    if !table.note.is_empty() {
        let _ = write!(text, "\n{}\n", table.note);
    }
    let defined = table.columns.iter().filter(|c| !c.definition.is_empty());
    let definitions: String = defined
        .map(|column| format!("- **{}**: {}\n", column.name, column.definition))
        .collect();
    if !definitions.is_empty() {
        let _ = write!(text, "\n{definitions}");
    }
    text
}

fn cell(cell: &Cell) -> String {
    if let Cell::Link { text, to } = cell {
        return format!("[{}]({to})", escaped(text));
    }
    let (first, second) = parts(cell);
    match cell {
        _ if second.is_empty() => escaped(&first),
        Cell::Estimate(_) => format!("{first} {second}"),
        _ => format!("{first} ({second})"),
    }
}

/// A bar inside a cell would end it.
fn escaped(text: &str) -> String {
    text.replace('|', "\\|")
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::app::comparison::{Column, Estimate, success_rate};

    /// Two rows with everything that a cell may be.
    pub fn example() -> Table {
        let column = |name: &str, unit: &str| Column {
            name: name.to_owned(),
            unit: unit.to_owned(),
            definition: "a | b <c>".to_owned(),
        };
        let estimate = Estimate {
            mean: 0.023,
            over_seeds: Some(0.002),
            over_sequences: None,
            runs: 5,
        };
        Table {
            name: "table_1".to_owned(),
            title: "Table 1: errors".to_owned(),
            note: "What <b> means.".to_owned(),
            columns: vec![
                Column::named("configuration"),
                column("average positional error", "m"),
                column("success", "%"),
            ],
            rows: vec![
                vec![
                    Cell::from("A, \"first\""),
                    Some(estimate).into(),
                    success_rate(5, 5).into(),
                ],
                vec![
                    Cell::Link {
                        text: "B|C".to_owned(),
                        to: "runs/b.html".to_owned(),
                    },
                    Cell::Number(0.5),
                    Cell::Absent,
                ],
            ],
        }
    }

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
}
