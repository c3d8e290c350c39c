//! Tables as CSV (RFC 4180): numbers in full precision, uncertainties in columns of their own.

use std::io::{self, Write};

use csv::Writer;

use crate::app::comparison::table::{Cell, Column, Table};

/// A column of the file: its title and the value that it takes from a cell.
type CsvColumn = (String, fn(&Cell) -> String);

/// Writes a header line and one line per row.
pub fn write(table: &Table, writer: impl Write) -> io::Result<()> {
    let cells = |index: usize| table.rows.iter().map(move |row| &row[index]);
    let columns: Vec<Vec<CsvColumn>> = (table.columns.iter().enumerate())
        .map(|(index, column)| csv_columns(column, cells(index)))
        .collect();
    let mut writer = Writer::from_writer(writer);
    writer.write_record(columns.iter().flatten().map(|(title, _)| title))?;
    for row in &table.rows {
        let cells = row.iter().zip(&columns);
        let values = cells.flat_map(|(cell, columns)| columns.iter().map(|(_, value)| value(cell)));
        writer.write_record(values)?;
    }
    writer.flush()
}

/// The columns of the file for one column of the table, by the kinds of its cells.
fn csv_columns<'a>(
    column: &Column,
    mut cells: impl Iterator<Item = &'a Cell> + Clone,
) -> Vec<CsvColumn> {
    let title = column.title();
    let mut columns: Vec<CsvColumn> = vec![(title.clone(), value)];
    let mut add =
        |part: &str, value: fn(&Cell) -> String| columns.push((format!("{title}, {part}"), value));
    if cells.clone().any(|cell| matches!(cell, Cell::Mean(_))) {
        add("deviation over seeds", |cell| match cell {
            Cell::Mean(mean) => number(mean.over_seeds),
            _ => String::new(),
        });
        add("deviation over sequences", |cell| match cell {
            Cell::Mean(mean) => number(mean.over_sequences),
            _ => String::new(),
        });
    }
    if cells.any(|cell| matches!(cell, Cell::Difference(_) | Cell::Rate(_))) {
        add("low", |cell| number(interval(cell).map(|ends| ends.0)));
        add("high", |cell| number(interval(cell).map(|ends| ends.1)));
    }
    columns
}

fn value(cell: &Cell) -> String {
    match cell {
        Cell::Text(text) | Cell::Link { text, .. } => text.clone(),
        // In percent, as its interval.
        Cell::Rate(rate) => (100.0 * rate.rate).to_string(),
        cell => number(cell.number()),
    }
}

fn interval(cell: &Cell) -> Option<(f64, f64)> {
    match cell {
        Cell::Difference(difference) => difference.interval,
        Cell::Rate(rate) => Some((100.0 * rate.low, 100.0 * rate.high)),
        _ => None,
    }
}

fn number(number: Option<f64>) -> String {
    number.map_or(String::new(), |number| number.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::comparison::table_tests::example;

    #[test]
    fn every_number_has_a_column_and_text_with_commas_is_quoted() {
        let mut text = Vec::new();
        write(&example(), &mut text).unwrap();
        let text = String::from_utf8(text).unwrap();
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
