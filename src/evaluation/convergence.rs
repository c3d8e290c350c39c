//! When a run has found the car, and whether it keeps it.
//!
//! A frame is good when its position and its heading are within limits. The run has converged at
//! the first frame that begins so many good frames in a row; it is a strict success when every
//! frame from there to the end is good.

use serde::{Deserialize, Serialize};

use super::planar::PlanarError;

/// What counts as found.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StrictSuccess {
    /// Largest position error of a good frame [m].
    pub position_m: f64,
    /// Largest heading error of a good frame [rad].
    pub heading_rad: f64,
    /// How many good frames in a row are convergence.
    pub hold_frames: usize,
}

impl Default for StrictSuccess {
    /// Half a metre and two degrees, held for ten frames: a second of a 10 Hz sensor.
    fn default() -> Self {
        Self {
            position_m: 0.5,
            heading_rad: 2.0_f64.to_radians(),
            hold_frames: 10,
        }
    }
}

/// When a run converged.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Convergence {
    /// Row of the first frame that counts as found.
    pub row: usize,
    /// Distance driven until then [m].
    pub distance_m: f64,
    /// Time passed until then [s]; absent without times.
    pub time_s: Option<f64>,
    /// Whether every frame from there to the end is good.
    pub kept: bool,
}

impl StrictSuccess {
    fn is_good(&self, error: &PlanarError) -> bool {
        error.distance_m() <= self.position_m && error.turn_rad.abs() <= self.heading_rad
    }

    /// When the run converged; `None` where it never did.
    pub fn convergence(
        &self,
        errors: &[PlanarError],
        distances_m: &[f64],
        times_s: Option<&[f64]>,
    ) -> Option<Convergence> {
        let hold = self.hold_frames.max(1);
        let row = errors
            .windows(hold)
            .position(|frames| frames.iter().all(|error| self.is_good(error)))?;
        Some(Convergence {
            row,
            distance_m: distances_m[row] - distances_m[0],
            time_s: times_s.map(|times_s| times_s[row] - times_s[0]),
            kept: errors[row..].iter().all(|error| self.is_good(error)),
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
    fn a_good_frame_alone_is_chance_and_three_are_convergence() {
        let found = converged(&[9.0, 0.1, 9.0, 0.1, 0.1, 0.1, 0.1]).unwrap();
        assert_eq!((found.row, found.time_s, found.kept), (3, Some(3.0), true));
        assert!((found.distance_m - 2.4).abs() < 1e-12);
    }

    #[test]
    fn a_run_that_loses_the_car_again_converged_but_did_not_keep_it() {
        let found = converged(&[0.1, 0.1, 0.1, 0.6, 0.1]).unwrap();
        assert_eq!((found.row, found.kept), (0, false));
    }

    #[test]
    fn a_run_that_is_never_good_long_enough_never_converges() {
        assert_eq!(converged(&[0.1, 0.1, 9.0, 0.1, 0.1]), None);
        assert_eq!(converged(&[]), None);
    }

    #[test]
    fn a_wrong_heading_is_not_good() {
        let turned = PlanarError::between(&Pose2::rotation(0.05), &Pose2::identity());
        let rules = StrictSuccess::default();
        assert_eq!(rules.convergence(&[turned; 20], &[0.0; 20], None), None);
    }
}
