//! Tables for other programs: every number in full, what is uncertain in columns of its own
//! (RFC 4180).

use crate::app::comparison::{Cell, Column, Table};

/// The table with a line of titles.
pub fn table(table: &Table) -> String {
    let mut lines = vec![Vec::new(); 1 + table.rows.len()];
    for (index, column) in table.columns.iter().enumerate() {
        let cells: Vec<&Cell> = table.rows.iter().map(|row| &row[index]).collect();
        for (title, value) in parts_of(column, &cells) {
            lines[0].push(quoted(&title));
            for (line, cell) in lines[1..].iter_mut().zip(&cells) {
                line.push(quoted(&value(cell)));
            }
        }
    }
    lines.iter().map(|line| line.join(",") + "\n").collect()
}

type Part = (String, fn(&Cell) -> String);

/// The columns that a column of the table becomes.
fn parts_of(column: &Column, cells: &[&Cell]) -> Vec<Part> {
    let head = column.head();
    let mut parts: Vec<Part> = vec![(head.clone(), first)];
    let mut add = |what: &str, value: fn(&Cell) -> String| {
        parts.push((format!("{head}, {what}"), value));
    };
    let has = |is: fn(&Cell) -> bool| cells.iter().any(|cell| is(cell));
    if has(|cell| matches!(cell, Cell::Estimate(_))) {
        add("deviation over seeds", |cell| match cell {
            Cell::Estimate(estimate) => full(estimate.over_seeds),
            _ => String::new(),
        });
        add("deviation over sequences", |cell| match cell {
            Cell::Estimate(estimate) => full(estimate.over_sequences),
            _ => String::new(),
        });
    }
    if has(|cell| matches!(cell, Cell::Difference(_) | Cell::Rate(_))) {
        add("low", |cell| match cell {
            Cell::Difference(difference) => full(difference.interval.map(|ends| ends.0)),
            Cell::Rate(rate) => full(Some(100.0 * rate.low)),
            _ => String::new(),
        });
        add("high", |cell| match cell {
            Cell::Difference(difference) => full(difference.interval.map(|ends| ends.1)),
            Cell::Rate(rate) => full(Some(100.0 * rate.high)),
            _ => String::new(),
        });
    }
    parts
}

fn first(cell: &Cell) -> String {
    match cell {
        Cell::Text(text) | Cell::Link { text, .. } => text.clone(),
        // Its column is in percent.
        Cell::Rate(rate) => full(Some(100.0 * rate.rate)),
        cell => full(cell.number()),
    }
}

fn full(number: Option<f64>) -> String {
    number.map_or(String::new(), |number| number.to_string())
}

fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::super::markdown::tests::example;
    use super::*;

    #[test]
    fn every_number_has_a_column_and_words_with_commas_are_quoted() {
        let text = table(&example());
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines[0],
            "configuration,average positional error [m],\"average positional error [m], deviation over seeds\",\"average positional error [m], deviation over sequences\",success [%],\"success [%], low\",\"success [%], high\""
        );
        assert!(
            lines[1].starts_with("\"A, \"\"first\"\"\",0.023,0.002,,100,56.5"),
            "{text}"
        );
        assert_eq!(lines[2], "B|C,0.5,,,,,");
    }
}
