//! The tables of a comparison as data: means with their spread, differences and rates.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::app::report::pages;
use crate::app::report::results::Value;

/// Rows of cells under named columns.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Table {
    /// Short name, suitable as a file name and as the target of a link: letters, digits and `_` (`table_1`).
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
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Column {
    /// Name of the quantity.
    pub name: String,
    /// Unit of the numbers; empty for text and unitless numbers.
    pub unit: String,
    /// Definition of the quantity; empty where the name is sufficient.
    pub definition: String,
}

/// Content of a cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Cell {
    /// Text.
    Text(String),
    /// Text that links to a file.
    Link {
        /// Text of the link.
        text: String,
        /// Path of the file, relative to the table.
        to: String,
    },
    /// Number.
    Number(f64),
    /// Mean with its spread.
    #[serde(rename = "estimate")]
    Mean(MeanWithSpread),
    /// Difference with its confidence interval.
    Difference(PairedDifference),
    /// Success rate with its confidence interval.
    Rate(SuccessRate),
    /// Not measured, or not defined.
    Absent,
}

/// Mean with standard deviations.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct MeanWithSpread {
    /// Mean of the means of the sequences.
    pub mean: f64,
    /// Standard deviation over seeds within a sequence; absent if no sequence has two runs.
    pub over_seeds: Option<f64>,
    /// Standard deviation of the means of the sequences; absent for a single sequence.
    pub over_sequences: Option<f64>,
    /// Number of runs.
    pub runs: usize,
}

/// Mean difference between two configurations.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PairedDifference {
    /// Mean of the mean differences of the sequences.
    pub mean: f64,
    /// 95 % confidence interval; absent if no sequence has two pairs.
    pub interval: Option<(f64, f64)>,
    /// Number of pairs.
    pub pairs: usize,
}

/// Share of successful runs with its 95 % confidence interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SuccessRate {
    /// Number of successful runs.
    pub successes: usize,
    /// Number of runs.
    pub runs: usize,
    /// Share of successful runs, 0 to 1.
    pub rate: f64,
    /// Lower end of the interval.
    pub low: f64,
    /// Upper end of the interval.
    pub high: f64,
}

impl PairedDifference {
    /// Whether the interval excludes zero; `None` without an interval.
    pub fn is_significant(&self) -> Option<bool> {
        self.interval.map(|(low, high)| low > 0.0 || high < 0.0)
    }
}

impl Table {
    /// The table without columns of which nothing is known.
    #[must_use]
    pub fn without_absent_columns(mut self) -> Self {
        let is_known = |column: usize| self.rows.iter().any(|row| row[column] != Cell::Absent);
        let known: Vec<bool> = (0..self.columns.len()).map(is_known).collect();
        let mut kept = known.iter();
        self.columns.retain(|_| kept.next() == Some(&true));
        for row in &mut self.rows {
            let mut kept = known.iter();
            row.retain(|_| kept.next() == Some(&true));
        }
        self
    }

    /// Whether any cell of a column is a number.
    pub(crate) fn is_numeric(&self, column: usize) -> bool {
        self.rows.iter().any(|row| row[column].number().is_some())
    }

    /// Columns that have a definition.
    pub(crate) fn defined_columns(&self) -> impl Iterator<Item = &Column> {
        self.columns.iter().filter(|c| !c.definition.is_empty())
    }
}

impl Cell {
    /// Number to sort by; `None` for text.
    pub fn number(&self) -> Option<f64> {
        match self {
            Self::Number(number) => Some(*number),
            Self::Mean(mean) => Some(mean.mean),
            Self::Difference(difference) => Some(difference.mean),
            Self::Rate(rate) => Some(rate.rate),
            Self::Text(_) | Self::Link { .. } | Self::Absent => None,
        }
    }
}

impl Column {
    /// Column without unit and definition.
    pub fn named(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            ..Self::default()
        }
    }

    /// Name with the unit in brackets.
    pub fn title(&self) -> String {
        if self.unit.is_empty() {
            self.name.clone()
        } else {
            format!("{} [{}]", self.name, self.unit)
        }
    }
}

impl<T: Into<Cell>> From<Option<T>> for Cell {
    fn from(value: Option<T>) -> Self {
        value.map_or(Self::Absent, Into::into)
    }
}

impl From<MeanWithSpread> for Cell {
    fn from(mean: MeanWithSpread) -> Self {
        Self::Mean(mean)
    }
}

impl From<PairedDifference> for Cell {
    fn from(difference: PairedDifference) -> Self {
        Self::Difference(difference)
    }
}

impl From<SuccessRate> for Cell {
    fn from(rate: SuccessRate) -> Self {
        Self::Rate(rate)
    }
}

impl From<f64> for Cell {
    fn from(number: f64) -> Self {
        Self::Number(number)
    }
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}

impl From<Table> for pages::Table {
    fn from(table: Table) -> Self {
        let column = |column: &Column| pages::Column {
            title: column.title(),
            definition: column.definition.clone(),
        };
        Self {
            columns: table.columns.iter().map(column).collect(),
            rows: (table.rows.iter())
                .map(|row| row.iter().map(pages::Cell::from).collect())
                .collect(),
            name: table.name,
            title: table.title,
            note: table.note,
        }
    }
}

impl From<&Cell> for pages::Cell {
    fn from(cell: &Cell) -> Self {
        let (text, uncertainty) = value_and_uncertainty(cell);
        Self {
            text,
            uncertainty,
            number: cell.number(),
            link: match cell {
                Cell::Link { to, .. } => Some(to.clone()),
                _ => None,
            },
        }
    }
}

/// Formats a cell as its value and its uncertainty, which may be empty.
pub fn value_and_uncertainty(cell: &Cell) -> (String, String) {
    match cell {
        Cell::Text(text) | Cell::Link { text, .. } => (text.clone(), String::new()),
        Cell::Number(value) if value.fract() == 0.0 && value.abs() < 1e9 => {
            (format!("{value:.0}"), String::new())
        }
        Cell::Number(value) => (four_digits(*value), String::new()),
        Cell::Mean(mean) => {
            let deviations = [mean.over_seeds, mean.over_sequences].into_iter().flatten();
            let deviations: Vec<String> =
                deviations.map(|d| format!("±{}", two_digits(d))).collect();
            (four_digits(mean.mean), deviations.join(" "))
        }
        Cell::Difference(difference) => {
            let significance = match difference.is_significant() {
                Some(true) => " yes",
                Some(false) => " no",
                None => "",
            };
            let interval = difference
                .interval
                .map(|(low, high)| format!("{} .. {}", signed(low), signed(high)));
            (
                format!("{}{significance}", signed(difference.mean)),
                interval.unwrap_or_default(),
            )
        }
        Cell::Rate(rate) => (
            format!("{:.0}", 100.0 * rate.rate),
            format!("{:.0} .. {:.0}", 100.0 * rate.low, 100.0 * rate.high),
        ),
        Cell::Absent => ("-".to_owned(), String::new()),
    }
}

fn four_digits(number: f64) -> String {
    Value::Number(number).to_string()
}

fn two_digits(number: f64) -> String {
    let digits = number.abs().max(1e-9).log10().floor() as i32;
    let decimals = (1 - digits).clamp(0, 4) as usize;
    format!("{number:.decimals$}")
}

/// Four digits with a sign, except for zero.
fn signed(value: f64) -> String {
    let text = four_digits(value);
    let is_zero = text.chars().all(|c| !c.is_ascii_digit() || c == '0');
    match (is_zero, value > 0.0) {
        (true, _) => text.trim_start_matches('-').to_owned(),
        (false, true) => format!("+{text}"),
        (false, false) => text,
    }
}

#[cfg(test)]
mod tests {
    use super::super::table_tests::{all_successful, example};
    use super::*;

    #[test]
    fn a_column_without_any_value_is_left_out_and_no_other() {
        let table = example();
        assert_eq!(table.clone().without_absent_columns(), table);
        let mut unknown = table.clone();
        unknown.columns.insert(1, Column::named("claimed"));
        for row in &mut unknown.rows {
            row.insert(1, Cell::Absent);
        }
        assert_eq!(unknown.without_absent_columns(), table);
    }

    #[test]
    fn the_value_comes_first_and_its_spread_second() {
        let mean = MeanWithSpread {
            mean: 0.023_41,
            over_seeds: Some(0.001_24),
            over_sequences: None,
            runs: 5,
        };
        let formatted = |cell: Cell| {
            let (value, uncertainty) = value_and_uncertainty(&cell);
            format!("{value}|{uncertainty}")
        };
        assert_eq!(formatted(mean.into()), "0.0234|±0.0012");
        assert_eq!(formatted(all_successful().into()), "100|57 .. 100");
        assert_eq!(formatted(1000.0.into()), "1000|");
        assert_eq!(formatted(Cell::Absent), "-|");
    }

    #[test]
    fn a_difference_is_marked_as_significant_or_not_and_zero_has_no_sign() {
        let formatted = |mean, interval| {
            value_and_uncertainty(&Cell::Difference(PairedDifference {
                mean,
                interval,
                pairs: 5,
            }))
        };
        let (value, interval) = formatted(-0.01, Some((-0.02, -0.001)));
        assert_eq!(
            (value.as_str(), interval.as_str()),
            ("-0.0100 yes", "-0.0200 .. -0.0010")
        );
        let (value, interval) = formatted(0.5, Some((-0.5, 1.5)));
        assert_eq!(
            (value.as_str(), interval.as_str()),
            ("+0.5000 no", "-0.5000 .. +1.500")
        );
        assert_eq!(formatted(-0.000_01, None).0, "0.0000");
    }
}
