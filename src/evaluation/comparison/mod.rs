//! Many runs beside each other: which configuration is better, by how much, and whether that is
//! more than chance.
//!
//! A [`RunRecord`] is what one run leaves for the comparison. [`measures`] takes numbers out of it,
//! [`spread`] tells their mean and scatter over seeds and sequences, [`paired`] whether two
//! configurations differ, and [`tables`] puts all that into rows and columns.

pub mod measures;
pub mod paired;
pub mod record;
pub mod spread;
pub mod success;
pub mod table;
pub mod tables;

pub use measures::Measure;
pub use paired::{PairedDifference, paired_difference};
pub use record::{Outcome, RunId, RunRecord};
pub use spread::Estimate;
pub use success::{SuccessRate, success_rate};
pub use table::{Cell, Column, Table};
pub use tables::{Comparison, Contrast, Variant};
