//! A table as data, independent of its layout.

use serde::{Deserialize, Serialize};

/// Rows of cells under named columns.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
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
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Column {
    /// Name of the quantity.
    pub name: String,
    /// Unit of the numbers; empty for text and unitless numbers.
    pub unit: String,
    /// Definition of the quantity; empty where the name is sufficient.
    pub definition: String,
}

/// Content of a cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
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
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
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
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PairedDifference {
    /// Mean of the mean differences of the sequences.
    pub mean: f64,
    /// 95 % confidence interval; absent if no sequence has two pairs.
    pub interval: Option<(f64, f64)>,
    /// Number of pairs.
    pub pairs: usize,
}

/// Share of successful runs with its 95 % confidence interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
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

#[cfg(test)]
mod tests {
    use super::super::tests::example;
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
}
