//! Ranges of values, checked once, when a configuration is loaded.
//!
//! A stage's own struct has its check in `blocks`, and a command calls it as
//! `nested("block", self.block.check())`.

use std::fmt::Display;
use std::ops::RangeInclusive;

use crate::lidar::LidarModel;
use crate::simulation::{SimulationConfig, SimulationError};

/// A configuration that knows which of its values cannot be used.
pub trait Check {
    /// The first value that cannot be used, if any.
    fn check(&self) -> Result<(), Problem>;
}

/// A value that cannot be used, and what to do about it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{key} is {value}: {remedy}")]
pub struct Problem {
    /// Dotted key.
    pub key: String,
    /// The value as the user may have written it.
    pub value: String,
    /// What to write instead.
    pub remedy: String,
}

/// The problem of a block, told with the full key.
pub(super) fn nested(block: &str, result: Result<(), Problem>) -> Result<(), Problem> {
    result.map_err(|problem| Problem {
        key: format!("{block}.{}", problem.key),
        ..problem
    })
}

/// A problem unless `condition` holds.
pub(super) fn require(
    condition: bool,
    key: &str,
    value: impl Display,
    remedy: impl Into<String>,
) -> Result<(), Problem> {
    if condition {
        return Ok(());
    }
    Err(Problem {
        key: key.to_owned(),
        value: value.to_string(),
        remedy: remedy.into(),
    })
}

/// Finite and greater than zero.
pub(super) fn positive<N: Into<f64> + Copy + Display>(key: &str, value: N) -> Result<(), Problem> {
    let number: f64 = value.into();
    let holds = number.is_finite() && number > 0.0;
    require(holds, key, value, "it must be greater than 0")
}

/// Finite and not below zero.
pub(super) fn not_negative<N: Into<f64> + Copy + Display>(
    key: &str,
    value: N,
) -> Result<(), Problem> {
    let number: f64 = value.into();
    let holds = number.is_finite() && number >= 0.0;
    require(holds, key, value, "it must be 0 or greater")
}

/// Within both limits.
pub(super) fn within<N: PartialOrd + Display>(
    key: &str,
    value: N,
    range: RangeInclusive<N>,
) -> Result<(), Problem> {
    let remedy = format!("it must lie between {} and {}", range.start(), range.end());
    require(range.contains(&value), key, value, remedy)
}

/// From nothing to all, 0 to 1.
pub(super) fn share<N: Into<f64> + Copy + Display>(key: &str, value: N) -> Result<(), Problem> {
    let holds = (0.0..=1.0).contains(&value.into());
    require(holds, key, value, "it must lie between 0 and 1")
}

/// At least one.
pub(super) fn at_least_one(key: &str, value: usize) -> Result<(), Problem> {
    require(value >= 1, key, value, "it must be 1 or greater")
}

/// The keys of every command that choose frames.
pub(super) fn selection(n_scans: i64, frame_step: usize) -> Result<(), Problem> {
    require(
        n_scans == -1 || n_scans >= 1,
        "n_scans",
        n_scans,
        "it must be 1 or greater, or -1 for all scans",
    )?;
    require(
        frame_step >= 1,
        "frame_step",
        frame_step,
        "1 takes every frame, 2 every other one",
    )
}

/// A path that must not be left empty.
pub(super) fn path(key: &str, value: &std::path::Path) -> Result<(), Problem> {
    let given = !value.as_os_str().is_empty();
    require(given, key, "empty", "give a path")
}

impl Check for LidarModel {
    fn check(&self) -> Result<(), Problem> {
        within("height", self.height, 1..=4096)?;
        within("width", self.width, 1..=65_536)?;
        within("fov_up", self.fov_up, -90.0..=90.0)?;
        within("fov_down", self.fov_down, -90.0..=90.0)?;
        require(
            self.fov_rad() > 0.0,
            "fov_up",
            self.fov_up,
            format!("it must lie above fov_down, which is {}", self.fov_down),
        )?;
        not_negative("min_range", self.min_range)?;
        positive("max_range", self.max_range)?;
        require(
            self.min_range < self.max_range,
            "min_range",
            self.min_range,
            format!(
                "it must be less than max_range, which is {}",
                self.max_range
            ),
        )
    }
}

impl Check for SimulationConfig {
    fn check(&self) -> Result<(), Problem> {
        Self::check(self).map_err(|error| match error {
            SimulationError::BadValue { key, value, wanted } => Problem {
                key: key.to_owned(),
                value: value.to_string(),
                remedy: format!("it must be {wanted}"),
            },
            SimulationError::PathTooShort { length_m, least_m } => Problem {
                key: "path".to_owned(),
                value: format!("{length_m:.1} m long"),
                remedy: format!("at least {least_m} m are needed; add segments"),
            },
            // Known only when the drive is planned.
            SimulationError::NowhereToBeSet { frame, .. } => Problem {
                key: "motion.kidnapped_at_frame".to_owned(),
                value: frame.to_string(),
                remedy: error.to_string(),
            },
        })
    }
}
