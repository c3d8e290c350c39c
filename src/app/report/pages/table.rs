//! A table of a page.

use crate::app::report::results::Value;

/// Rows of cells under titled columns.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Table {
    /// Short name, the target of links: letters, digits and `_` (`table_1`).
    pub name: String,
    /// Title, above the table.
    pub title: String,
    /// Explanation, below the table; may be empty.
    pub note: String,
    /// Columns from the left.
    pub columns: Vec<Column>,
    /// Rows from the top, each with one cell per column.
    pub rows: Vec<Vec<Cell>>,
}

/// Header of a column.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Column {
    /// Name of the quantity, with its unit in brackets.
    pub title: String,
    /// Definition of the quantity; empty where the title is sufficient.
    pub definition: String,
}

/// Content of a cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Cell {
    /// Text.
    pub text: String,
    /// Uncertainty of a number; may be empty.
    pub uncertainty: String,
    /// Number to sort by; `None` for text.
    pub number: Option<f64>,
    /// File that the text links to, relative to the page.
    pub link: Option<String>,
}

impl From<&str> for Column {
    fn from(title: &str) -> Self {
        Self {
            title: title.to_owned(),
            definition: String::new(),
        }
    }
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Self {
            text: text.to_owned(),
            ..Self::default()
        }
    }
}

impl From<f64> for Cell {
    /// Whole numbers without decimals, others with four digits.
    fn from(number: f64) -> Self {
        let text = if number.fract() == 0.0 && number.abs() < 1e9 {
            format!("{number:.0}")
        } else {
            Value::Number(number).to_string()
        };
        Self {
            text,
            number: Some(number),
            ..Self::default()
        }
    }
}
