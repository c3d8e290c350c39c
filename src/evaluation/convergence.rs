//! Convergence of global localization, and strict success.
//!
//! A run converges at the first of `hold_frames` consecutive frames whose position and heading
//! errors are within the limits. It is a strict success if all later frames are, too.

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::planar::PlanarError;

/// Limits of the errors after convergence.
///
/// Defaults: half a metre and two degrees, held for ten frames: a second of a 10 Hz sensor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct StrictSuccess {
    /// Largest position error [m].
    #[default(0.5)]
    pub position_m: f64,
    /// Largest heading error [rad].
    #[default(2.0_f64.to_radians())]
    pub heading_rad: f64,
    /// Number of consecutive frames within the limits that count as convergence.
    #[default(10)]
    pub hold_frames: usize,
}

/// Convergence of a run.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct Convergence {
    /// Row of the first frame after convergence.
    pub row: usize,
    /// Distance driven before [m].
    pub distance_m: f64,
    /// Time passed before [s]; absent without times.
    pub time_s: Option<f64>,
    /// Whether all later frames are within the limits.
    pub kept: bool,
}

impl StrictSuccess {
    fn is_within_limits(&self, error: &PlanarError) -> bool {
        error.distance_m() <= self.position_m && error.turn_rad.abs() <= self.heading_rad
    }

    /// The convergence of a run; `None` if it never converged.
    pub(crate) fn convergence(
        &self,
        errors: &[PlanarError],
        distances_m: &[f64],
        times_s: Option<&[f64]>,
    ) -> Option<Convergence> {
        let hold = self.hold_frames.max(1);
        let row = errors
            .windows(hold)
            .position(|frames| frames.iter().all(|error| self.is_within_limits(error)))?;
        Some(Convergence {
            row,
            distance_m: distances_m[row] - distances_m[0],
            time_s: times_s.map(|times_s| times_s[row] - times_s[0]),
            kept: errors[row..]
                .iter()
                .all(|error| self.is_within_limits(error)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Pose2;

    fn errors(offsets_m: &[f64]) -> Vec<PlanarError> {
        offsets_m
            .iter()
            .map(|&x| PlanarError::between(&Pose2::translation(x, 0.0), &Pose2::identity()))
            .collect()
    }

    fn converged(offsets_m: &[f64]) -> Option<Convergence> {
        let rules = StrictSuccess {
            hold_frames: 3,
            ..StrictSuccess::default()
        };
        let distances_m: Vec<f64> = (0..offsets_m.len()).map(|k| 0.8 * k as f64).collect();
        let times_s: Vec<f64> = (0..offsets_m.len()).map(|k| 5.0 + k as f64).collect();
        rules.convergence(&errors(offsets_m), &distances_m, Some(&times_s))
    }

    #[test]
    fn convergence_needs_consecutive_frames_within_the_limits() {
        let found = converged(&[9.0, 0.1, 9.0, 0.1, 0.1, 0.1, 0.1]).unwrap();
        assert_eq!((found.row, found.time_s, found.kept), (3, Some(3.0), true));
        assert!((found.distance_m - 2.4).abs() < 1e-12);
    }

    #[test]
    fn a_run_with_a_later_error_converged_without_strict_success() {
        let found = converged(&[0.1, 0.1, 0.1, 0.6, 0.1]).unwrap();
        assert_eq!((found.row, found.kept), (0, false));
    }

    #[test]
    fn a_run_that_is_never_within_the_limits_long_enough_does_not_converge() {
        assert_eq!(converged(&[0.1, 0.1, 9.0, 0.1, 0.1]), None);
        assert_eq!(converged(&[]), None);
    }

    #[test]
    fn a_wrong_heading_prevents_convergence() {
        let turned = PlanarError::between(&Pose2::rotation(0.05), &Pose2::identity());
        let rules = StrictSuccess::default();
        assert_eq!(rules.convergence(&[turned; 20], &[0.0; 20], None), None);
    }
}
