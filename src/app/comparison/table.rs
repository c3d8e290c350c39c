//! A table as data: what stands in it, not how it looks.

use serde::{Deserialize, Serialize};

use super::paired::PairedDifference;
use super::spread::Estimate;
use super::success::SuccessRate;

/// Rows of cells under named columns.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Table {
    /// Short name, fit for a file: `table_1`.
    pub name: String,
    /// Above it.
    pub title: String,
    /// Below it, in sentences.
    pub note: String,
    /// From the left.
    pub columns: Vec<Column>,
    /// From the top, each with a cell per column.
    pub rows: Vec<Vec<Cell>>,
}

/// Head of a column.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Column {
    /// What stands in it.
    pub name: String,
    /// Unit of its numbers; empty for words and plain numbers.
    pub unit: String,
    /// What its numbers are; empty where the name says it.
    pub definition: String,
}

/// What stands in one place.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Cell {
    /// A word.
    Text(String),
    /// A word that leads to a file beside the table.
    Link {
        /// The word.
        text: String,
        /// The file, relative to the table.
        to: String,
    },
    /// A number.
    Number(f64),
    /// A mean with its scatter.
    Estimate(Estimate),
    /// A difference with its interval.
    Difference(PairedDifference),
    /// A share of successes.
    Rate(SuccessRate),
    /// Not measured, or not defined.
    Absent,
}

impl Cell {
    /// The number to sort by and to print first; `None` of words.
    pub fn number(&self) -> Option<f64> {
        match self {
            Self::Number(number) => Some(*number),
            Self::Estimate(estimate) => Some(estimate.mean),
            Self::Difference(difference) => Some(difference.mean),
            Self::Rate(rate) => Some(rate.rate),
            Self::Text(_) | Self::Link { .. } | Self::Absent => None,
        }
    }
}

impl Column {
    /// A column of words.
    pub fn named(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            ..Self::default()
        }
    }

    /// The name with its unit in brackets.
    pub fn head(&self) -> String {
        if self.unit.is_empty() {
            self.name.clone()
        } else {
            format!("{} [{}]", self.name, self.unit)
        }
    }
}

impl From<Option<Estimate>> for Cell {
    fn from(estimate: Option<Estimate>) -> Self {
        estimate.map_or(Self::Absent, Self::Estimate)
    }
}

impl From<Option<f64>> for Cell {
    fn from(number: Option<f64>) -> Self {
        number.map_or(Self::Absent, Self::Number)
    }
}

impl From<Option<SuccessRate>> for Cell {
    fn from(rate: Option<SuccessRate>) -> Self {
        rate.map_or(Self::Absent, Self::Rate)
    }
}

impl From<Option<PairedDifference>> for Cell {
    fn from(difference: Option<PairedDifference>) -> Self {
        difference.map_or(Self::Absent, Self::Difference)
    }
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Self::Text(text.to_owned())
    }
}
