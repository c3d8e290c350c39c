//! Whether the states and covariances of a run can be trusted.
//!
//! A frame is *wrong* if its position is off by more than half a metre. It must not be called tracking:
//!
//! ```text
//! wrong       |e| > 0.5 m and tracking              right but unsure   |e| ≤ 0.5 m and not tracking
//! to notice   longest time wrong and tracking       to recover         longest time not tracking after the first
//! inside      share of tracking frames inside the 95 % region of their covariance: consistency
//! ```

use nalgebra::{Matrix2, Matrix3};
use serde::{Deserialize, Serialize};

use super::consistency::is_inside;
use super::planar::planar_errors;
use crate::geometry::Pose2;
use crate::statistics::median;

/// Position error from which on a frame is wrong [m].
pub const WRONG_M: f64 = 0.5;

/// A run, one row per frame.
#[derive(Clone, Copy, Debug)]
pub struct TrustedRun<'a> {
    /// The estimates.
    pub estimates: &'a [Pose2],
    /// The ground truth.
    pub ground_truth: &'a [Pose2],
    /// Covariances of (x, y, heading) [m², m·rad, rad²].
    pub covariances: &'a [Matrix3<f64>],
    /// Whether the filter called itself tracking.
    pub is_tracking: &'a [bool],
    /// Times of the frames [s].
    pub times_s: &'a [f64],
}

/// Errors of a run against its states and covariances.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct Trust {
    /// Number of frames.
    pub frames: usize,
    /// Number of frames that are tracking.
    pub tracking: usize,
    /// Number of frames that are wrong and tracking.
    pub wrong: usize,
    /// Number of frames that are right and not tracking.
    pub unsure: usize,
    /// Largest position error while tracking [m].
    pub worst_m: Option<f64>,
    /// Median position error while tracking [m].
    pub median_m: Option<f64>,
    /// Median absolute heading error while tracking [rad].
    pub median_heading_rad: Option<f64>,
    /// Time until the first frame that is tracking [s]; absent if there is none.
    pub found_after_s: Option<f64>,
    /// Longest time during which frames are wrong and tracking [s].
    pub notice_s: f64,
    /// Longest time after the first tracking frame during which none is tracking [s].
    pub recover_s: f64,
    /// Share of the tracking frames inside the 95 % region.
    pub inside: Option<f64>,
    /// Largest standard deviation of the position while tracking along an axis [m].
    pub widest_m: Option<f64>,
    /// Standard deviation across that axis in the same frame [m].
    pub narrowest_m: Option<f64>,
    /// Angle between that axis and the direction of the car, at most a right angle [rad].
    pub widest_direction_rad: Option<f64>,
    /// Median number of places where the car may be, over the frames before the first that is tracking.
    pub places: Option<f64>,
}

impl Trust {
    /// The trust of a run whose columns have the same length.
    pub fn new(run: &TrustedRun) -> Self {
        let errors = planar_errors(run.estimates, run.ground_truth);
        let tracked: Vec<usize> = (0..errors.len()).filter(|&k| run.is_tracking[k]).collect();
        let is_wrong = |k: usize| errors[k].distance_m() > WRONG_M;
        let first = tracked.first().copied();
        let is_inside = |k: usize| is_inside(&errors[k], &run.covariances[k]);
        let inside = tracked.iter().filter(|&&k| is_inside(k)).count();
        let widest = (tracked
            .iter()
            .map(|&k| Axes::new(&run.covariances[k], &run.estimates[k])))
        .max_by(|a, b| a.long_m.total_cmp(&b.long_m));
        Self {
            frames: errors.len(),
            tracking: tracked.len(),
            wrong: tracked.iter().filter(|&&k| is_wrong(k)).count(),
            unsure: (0..errors.len())
                .filter(|&k| !run.is_tracking[k] && !is_wrong(k))
                .count(),
            worst_m: (tracked.iter().map(|&k| errors[k].distance_m())).reduce(f64::max),
            median_m: median(tracked.iter().map(|&k| errors[k].distance_m())),
            median_heading_rad: median(tracked.iter().map(|&k| errors[k].turn_rad.abs())),
            found_after_s: first.map(|k| run.times_s[k] - run.times_s[0]),
            notice_s: longest_s(run.times_s, |k| run.is_tracking[k] && is_wrong(k)),
            recover_s: longest_s(run.times_s, |k| {
                first.is_some_and(|first| k > first) && !run.is_tracking[k]
            }),
            inside: (!tracked.is_empty()).then(|| inside as f64 / tracked.len() as f64),
            widest_m: widest.map(|axes| axes.long_m),
            narrowest_m: widest.map(|axes| axes.short_m),
            widest_direction_rad: widest.map(|axes| axes.long_from_forward_rad),
            places: None,
        }
    }
}

/// Axes of the ellipse of a covariance of the position.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Axes {
    /// Standard deviation along the long axis [m].
    pub long_m: f64,
    /// Standard deviation along the short axis [m].
    pub short_m: f64,
    /// Angle between the long axis and the direction of the car, at most a right angle [rad].
    pub long_from_forward_rad: f64,
}

impl Axes {
    /// The axes of the covariance of (x, y, heading) in the axes of the map, around a pose.
    pub fn new(covariance: &Matrix3<f64>, pose: &Pose2) -> Self {
        let position: Matrix2<f64> = covariance.fixed_view::<2, 2>(0, 0).into_owned();
        let eigen = position.symmetric_eigen();
        let long = eigen.eigenvalues.imax();
        let sigma_m = |axis: usize| eigen.eigenvalues[axis].max(0.0).sqrt();
        let along = eigen.eigenvectors.column(long);
        let forward = pose.rotation * nalgebra::Vector2::x();
        Self {
            long_m: sigma_m(long),
            short_m: sigma_m(1 - long),
            long_from_forward_rad: along.dot(&forward).abs().min(1.0).acos(),
        }
    }
}

/// Longest time during which successive frames meet a condition, up to the frame after the last of them [s].
fn longest_s(times_s: &[f64], holds: impl Fn(usize) -> bool) -> f64 {
    let (mut longest_s, mut since) = (0.0_f64, None);
    for frame in 0..times_s.len() {
        if holds(frame) {
            let since: usize = *since.get_or_insert(frame);
            let end = (frame + 1).min(times_s.len() - 1);
            longest_s = longest_s.max(times_s[end] - times_s[since]);
        } else {
            since = None;
        }
    }
    longest_s
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

    /// Ten frames, 0.1 s apart, with errors along x and standard deviations of 0.2, 0.1 m and 0.01 rad.
    fn trust(errors_m: [f64; 10], is_tracking: [bool; 10]) -> Trust {
        let truth = [Pose2::identity(); 10];
        let estimates = errors_m.map(|x| Pose2::translation(x, 0.0));
        let covariance = Matrix3::from_diagonal(&Vector3::new(0.04, 0.01, 1e-4));
        Trust::new(&TrustedRun {
            estimates: &estimates,
            ground_truth: &truth,
            covariances: &[covariance; 10],
            is_tracking: &is_tracking,
            times_s: &std::array::from_fn::<f64, 10, _>(|k| 0.1 * k as f64),
        })
    }

    #[test]
    fn wrong_frames_count_only_while_tracking_and_right_ones_only_while_not() {
        let mut errors_m = [0.1; 10];
        errors_m[..2].fill(7.0);
        errors_m[4..7].fill(0.6);
        let mut is_tracking = [true; 10];
        is_tracking[..3].fill(false);
        is_tracking[6..8].fill(false);
        let found = trust(errors_m, is_tracking);
        assert_eq!((found.wrong, found.unsure, found.tracking), (2, 2, 5));
        assert_relative_eq!(found.found_after_s.unwrap(), 0.3, epsilon = 1e-9);
        assert_relative_eq!(found.notice_s, 0.2, epsilon = 1e-9);
        assert_relative_eq!(found.recover_s, 0.2, epsilon = 1e-9);
        assert_relative_eq!(found.worst_m.unwrap(), 0.6, epsilon = 1e-9);
        // 0.6 m are three standard deviations: chi squared is 9.
        assert_relative_eq!(found.inside.unwrap(), 0.6, epsilon = 1e-9);
        assert_relative_eq!(found.widest_m.unwrap(), 0.2, epsilon = 1e-9);
        assert_relative_eq!(found.widest_direction_rad.unwrap(), 0.0, epsilon = 1e-6);
    }

    #[test]
    fn a_run_that_never_tracks_has_no_errors_to_report() {
        let found = trust([3.0; 10], [false; 10]);
        assert_eq!((found.wrong, found.unsure, found.worst_m), (0, 0, None));
        assert_eq!((found.found_after_s, found.recover_s), (None, 0.0));
    }

    #[test]
    fn the_long_axis_turns_with_the_map() {
        let turn = Pose2::rotation(0.7);
        let rotation = turn.rotation.to_rotation_matrix().to_homogeneous();
        let along = Matrix3::from_diagonal(&Vector3::new(1.0, 0.01, 1e-4));
        let axes = Axes::new(&(rotation * along * rotation.transpose()), &turn);
        assert_relative_eq!(axes.long_m, 1.0, epsilon = 1e-9);
        assert_relative_eq!(axes.short_m, 0.1, epsilon = 1e-9);
        assert_relative_eq!(axes.long_from_forward_rad, 0.0, epsilon = 1e-6);
    }
}
