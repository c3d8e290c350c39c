//! Metrics of one trajectory against the ground truth.
//!
//! The first frames, in which the filter converges, are excluded from all metrics but
//! convergence, and so are frames whose pose is not trusted. Trajectories are not aligned.

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::convergence::{Convergence, StrictSuccess};
use super::planar::{PlanarError, planar_errors};
use super::pose_error::{SegmentErrors, kitti_segment_errors, relative_pose_error};
use super::smoothness::{jitter_m, log_dimensionless_jerk, mean_pose_change};
use super::statistics::{Summary, mean, rms, slope};
use crate::geometry::{Pose2, Pose3, distances_m, pose3_from_pose2};

/// Parameters of the metrics.
///
/// Default: ten frames to converge.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct MetricsConfig {
    /// Number of frames at the beginning that are excluded.
    #[default(10)]
    pub skip_frames: usize,
    /// Limits of the errors after convergence.
    pub success: StrictSuccess,
}

/// A trajectory with its ground truth, one entry of each per frame.
#[derive(Clone, Copy, Debug)]
pub struct EvaluatedTrajectory<'a> {
    /// The estimates.
    pub estimates: &'a [Pose2],
    /// The ground truth.
    pub ground_truth: &'a [Pose2],
    /// Times of the frames [s], ascending.
    pub times_s: Option<&'a [f64]>,
    /// Computing time per frame [s].
    pub runtimes_s: Option<&'a [f64]>,
    /// Whether each pose is trusted; `None`: all are.
    pub trusted: Option<&'a [bool]>,
}

/// Error along and across the true heading [m].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct AxisError {
    /// Root mean square [m].
    pub rmse_m: f64,
    /// Signed mean [m].
    pub bias_m: f64,
}

/// Smoothness of the estimate, and of the truth for comparison.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct Smoothness {
    /// RMS difference of consecutive planar error vectors [m].
    pub jitter_m: Option<f64>,
    /// Log dimensionless jerk of the estimate.
    pub log_jerk: Option<f64>,
    /// Log dimensionless jerk of the truth.
    pub log_jerk_of_truth: Option<f64>,
    /// Mean length of a step of the estimate [m].
    pub mean_step_m: Option<f64>,
    /// Mean turn of a step of the estimate [rad].
    pub mean_turn_rad: Option<f64>,
    /// Mean length of a step of the truth [m].
    pub mean_step_of_truth_m: Option<f64>,
}

/// Metrics of one trajectory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct TrajectoryMetrics {
    /// Number of evaluated frames.
    pub frames: usize,
    /// Number of frames at the beginning that are excluded.
    #[serde(default)]
    pub skipped_frames: usize,
    /// Number of frames after them that are excluded because their pose is not trusted.
    #[serde(default)]
    pub untrusted_frames: usize,
    /// Distance driven in the evaluated ones, along the ground truth [m].
    pub distance_m: f64,
    /// Planar distance to the true position [m]: the absolute pose error in the plane.
    pub position_m: Summary,
    /// RMSE of x in the map frame [m].
    pub x_rmse_m: f64,
    /// RMSE of y in the map frame [m].
    pub y_rmse_m: f64,
    /// Position error along the true heading.
    pub along: AxisError,
    /// Position error across the true heading.
    pub across: AxisError,
    /// Magnitude of the heading error [rad].
    pub heading_rad: Summary,
    /// Convergence; absent if the run never converged.
    pub convergence: Option<Convergence>,
    /// Smoothness of the trajectory.
    pub smoothness: Smoothness,
    /// Slope of the position error against the distance driven [m/m]; absent if the car stands.
    pub drift: Option<f64>,
    /// Slope of the position error against time [m/s]; absent without times.
    pub drift_m_per_s: Option<f64>,
    /// Relative pose error, translation [m].
    pub rpe_translation_m: Option<Summary>,
    /// Relative pose error, rotation [rad].
    pub rpe_rotation_rad: Option<Summary>,
    /// KITTI's segment errors; absent for a path under 100 m.
    pub segments: Option<SegmentErrors>,
    /// Computing time per frame, trusted or not [s]; absent if not measured.
    pub runtime_s: Option<Summary>,
    /// Computing time of the first frame of the run [s].
    pub first_runtime_s: Option<f64>,
}

/// An error of the input.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum MetricsError {
    #[error(
        "{frames} frames are too few: the first {skip_frames} (skip_frames) are excluded and one that is trusted is needed after them"
    )]
    TooFewFrames { frames: usize, skip_frames: usize },
    #[error("there are {found} {what} for {frames} frames; they belong to different runs")]
    LengthMismatch {
        what: &'static str,
        found: usize,
        frames: usize,
    },
}

impl TrajectoryMetrics {
    /// Computes the metrics of a trajectory.
    ///
    /// # Errors
    /// The trajectories differ in length, or are empty.
    pub fn new(
        trajectory: &EvaluatedTrajectory,
        config: &MetricsConfig,
    ) -> Result<Self, MetricsError> {
        trajectory.check_lengths()?;
        Self::after_skipping(trajectory, config).ok_or(MetricsError::TooFewFrames {
            frames: trajectory.estimates.len(),
            skip_frames: config.skip_frames,
        })
    }

    /// `None` if no trusted frames are left after the skipped ones.
    fn after_skipping(whole: &EvaluatedTrajectory, config: &MetricsConfig) -> Option<Self> {
        // What has an entry per frame is dropped before the next is computed: a run may have a million.
        let convergence = {
            let errors = planar_errors(whole.estimates, whole.ground_truth);
            let driven_m = distances_m(whole.ground_truth);
            (config.success).convergence(&errors, &driven_m, whole.times_s)
        };
        let columns = whole.columns(&whole.trusted_after(config.skip_frames));
        let counted = columns.as_trajectory();
        let relative = RelativeErrors::of(&counted);
        let errors = &planar_errors(counted.estimates, counted.ground_truth);
        let driven_m = distances_m(counted.ground_truth);
        let column =
            |number: fn(&PlanarError) -> f64| -> Vec<f64> { errors.iter().map(number).collect() };
        let distance = column(PlanarError::distance_m);
        Some(Self {
            frames: errors.len(),
            skipped_frames: config.skip_frames,
            untrusted_frames: (config.skip_frames..whole.estimates.len()).len() - errors.len(),
            distance_m: *driven_m.last()?,
            position_m: Summary::new(&distance)?,
            x_rmse_m: rms(&column(|error| error.offset_in_map.x))?,
            y_rmse_m: rms(&column(|error| error.offset_in_map.y))?,
            along: AxisError::of(&column(|error| error.along_m))?,
            across: AxisError::of(&column(|error| error.across_m))?,
            heading_rad: Summary::new(&column(|error| error.turn_rad))?,
            convergence,
            smoothness: Smoothness::of(&counted, errors),
            drift: slope(&driven_m, &distance),
            drift_m_per_s: counted.times_s.and_then(|times| slope(times, &distance)),
            rpe_translation_m: relative.translation_m,
            rpe_rotation_rad: relative.rotation_rad,
            segments: relative.segments,
            runtime_s: (whole.runtimes_s)
                .and_then(|all| Summary::new(all.get(config.skip_frames..)?)),
            first_runtime_s: whole.runtimes_s.and_then(|all| all.first().copied()),
        })
    }
}

impl EvaluatedTrajectory<'_> {
    fn check_lengths(&self) -> Result<(), MetricsError> {
        let frames = self.estimates.len();
        for (what, found) in [
            ("true poses", Some(self.ground_truth.len())),
            ("times", self.times_s.map(<[f64]>::len)),
            ("runtimes", self.runtimes_s.map(<[f64]>::len)),
            ("states", self.trusted.map(<[bool]>::len)),
        ] {
            if let Some(found) = found.filter(|&found| found != frames) {
                return Err(MetricsError::LengthMismatch {
                    what,
                    found,
                    frames,
                });
            }
        }
        Ok(())
    }

    /// Rows of the trusted poses without those of the first frames.
    pub(crate) fn trusted_after(&self, frames: usize) -> Vec<usize> {
        let is_trusted = |row: &usize| self.trusted.is_none_or(|trusted| trusted[*row]);
        (frames..self.estimates.len()).filter(is_trusted).collect()
    }

    /// Some rows of the trajectory.
    fn columns(&self, rows: &[usize]) -> Columns {
        Columns {
            estimates: pick(self.estimates, rows),
            ground_truth: pick(self.ground_truth, rows),
            times_s: self.times_s.map(|times_s| pick(times_s, rows)),
        }
    }
}

/// The columns of some rows of a trajectory.
struct Columns {
    estimates: Vec<Pose2>,
    ground_truth: Vec<Pose2>,
    times_s: Option<Vec<f64>>,
}

impl Columns {
    fn as_trajectory(&self) -> EvaluatedTrajectory<'_> {
        EvaluatedTrajectory {
            estimates: &self.estimates,
            ground_truth: &self.ground_truth,
            times_s: self.times_s.as_deref(),
            runtimes_s: None,
            trusted: None,
        }
    }
}

/// Some rows of a column.
pub(crate) fn pick<T: Copy>(column: &[T], rows: &[usize]) -> Vec<T> {
    rows.iter().map(|&row| column[row]).collect()
}

impl AxisError {
    fn of(errors_m: &[f64]) -> Option<Self> {
        Some(Self {
            rmse_m: rms(errors_m)?,
            bias_m: mean(errors_m)?,
        })
    }
}

impl Smoothness {
    fn of(trajectory: &EvaluatedTrajectory, errors: &[PlanarError]) -> Self {
        // Dimensionless jerk does not depend on the unit of time: without times, frames are used.
        let numbers: Vec<f64> = (0..errors.len()).map(|frame| frame as f64).collect();
        let times = trajectory.times_s.unwrap_or(&numbers);
        let change = mean_pose_change(trajectory.estimates);
        Self {
            jitter_m: jitter_m(errors),
            log_jerk: log_dimensionless_jerk(trajectory.estimates, times),
            log_jerk_of_truth: log_dimensionless_jerk(trajectory.ground_truth, times),
            mean_step_m: change.map(|(step_m, _)| step_m),
            mean_turn_rad: change.map(|(_, turn_rad)| turn_rad),
            mean_step_of_truth_m: mean_pose_change(trajectory.ground_truth)
                .map(|(step_m, _)| step_m),
        }
    }
}

/// Errors of the motions between poses.
struct RelativeErrors {
    translation_m: Option<Summary>,
    rotation_rad: Option<Summary>,
    segments: Option<SegmentErrors>,
}

impl RelativeErrors {
    fn of(trajectory: &EvaluatedTrajectory) -> Self {
        let (estimates, truth) = (
            level_poses(trajectory.estimates),
            level_poses(trajectory.ground_truth),
        );
        let steps = relative_pose_error(&estimates, &truth);
        Self {
            translation_m: steps.translation(),
            rotation_rad: steps.rotation(),
            segments: kitti_segment_errors(&estimates, &truth),
        }
    }
}

/// Planar poses as level poses in space.
fn level_poses(poses: &[Pose2]) -> Vec<Pose3> {
    poses
        .iter()
        .map(|pose| pose3_from_pose2(pose, 0.0))
        .collect()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector2;

    use super::*;

    fn circle(frames: usize) -> Vec<Pose2> {
        (0..frames)
            .map(|k| Pose2::rotation(0.02 * k as f64) * Pose2::translation(50.0, 0.0))
            .map(|pose| pose * Pose2::rotation(std::f64::consts::FRAC_PI_2))
            .collect()
    }

    fn in_the_car(truth: &[Pose2], error: impl Fn(usize) -> Pose2) -> Vec<Pose2> {
        let pairs = truth.iter().enumerate();
        pairs.map(|(frame, pose)| pose * error(frame)).collect()
    }

    fn measure(estimates: &[Pose2], ground_truth: &[Pose2]) -> TrajectoryMetrics {
        let trajectory = EvaluatedTrajectory {
            estimates,
            ground_truth,
            times_s: None,
            runtimes_s: None,
            trusted: None,
        };
        TrajectoryMetrics::new(&trajectory, &MetricsConfig::default()).unwrap()
    }

    #[test]
    fn a_pose_that_is_not_trusted_has_no_error_and_is_counted() {
        let truth = circle(40);
        let trusted: Vec<bool> = (0..40).map(|frame| frame % 3 != 0).collect();
        let estimates = in_the_car(&truth, |frame| {
            Pose2::translation(if trusted[frame] { 0.1 } else { 30.0 }, 0.0)
        });
        let mut trajectory = EvaluatedTrajectory {
            estimates: &estimates,
            ground_truth: &truth,
            times_s: None,
            runtimes_s: None,
            trusted: Some(&trusted),
        };
        let config = MetricsConfig::default();
        let metrics = TrajectoryMetrics::new(&trajectory, &config).unwrap();
        assert_relative_eq!(metrics.position_m.max, 0.1, epsilon = 1e-12);
        assert_eq!(
            (
                metrics.skipped_frames,
                metrics.frames,
                metrics.untrusted_frames
            ),
            (10, 20, 10)
        );
        trajectory.trusted = Some(&[false; 40]);
        assert!(TrajectoryMetrics::new(&trajectory, &config).is_err());
    }

    #[test]
    fn the_ground_truth_has_no_error_and_converges_at_once() {
        let truth = circle(200);
        let metrics = measure(&truth, &truth);
        assert_eq!(metrics.position_m.max, 0.0);
        assert_eq!(metrics.heading_rad.max, 0.0);
        assert_eq!(metrics.smoothness.jitter_m, Some(0.0));
        assert_eq!(
            metrics.smoothness.log_jerk,
            metrics.smoothness.log_jerk_of_truth
        );
        let found = metrics.convergence.unwrap();
        assert_eq!((found.row, found.kept), (0, true));
        assert_relative_eq!(
            metrics.segments.unwrap().translation_percent,
            0.0,
            epsilon = 1e-9
        );
    }

    #[test]
    fn an_error_in_the_car_frame_is_split_into_along_and_across() {
        let truth = circle(200);
        let error = Pose2::new(Vector2::new(0.3, -0.4), 0.01);
        let metrics = measure(&in_the_car(&truth, |_| error), &truth);
        assert_relative_eq!(metrics.position_m.rmse, 0.5, epsilon = 1e-12);
        assert_relative_eq!(metrics.along.bias_m, 0.3, epsilon = 1e-12);
        assert_relative_eq!(metrics.across.bias_m, -0.4, epsilon = 1e-12);
        assert_relative_eq!(metrics.heading_rad.rmse, 0.01, epsilon = 1e-12);
        let both = f64::hypot(metrics.x_rmse_m, metrics.y_rmse_m);
        assert_relative_eq!(both, metrics.position_m.rmse, epsilon = 1e-12);
    }

    #[test]
    fn an_error_that_grows_with_the_distance_is_drift() {
        let truth = circle(200);
        let driven_m = distances_m(&truth);
        let estimates = in_the_car(&truth, |frame| {
            Pose2::translation(0.0, 0.1 + 0.002 * driven_m[frame])
        });
        assert_relative_eq!(
            measure(&estimates, &truth).drift.unwrap(),
            0.002,
            epsilon = 1e-9
        );
    }

    #[test]
    fn skipped_frames_count_for_convergence_alone() {
        let truth = circle(200);
        let estimates = in_the_car(&truth, |frame| {
            Pose2::translation(if frame < 10 { 30.0 } else { 0.1 }, 0.0)
        });
        let metrics = measure(&estimates, &truth);
        assert_relative_eq!(metrics.position_m.max, 0.1, epsilon = 1e-12);
        assert_eq!(metrics.frames, 190);
        assert_eq!(metrics.convergence.unwrap().row, 10);
    }

    #[test]
    fn too_few_frames_and_different_lengths_are_errors() {
        let truth = circle(10);
        let mut trajectory = EvaluatedTrajectory {
            estimates: &truth,
            ground_truth: &truth,
            times_s: None,
            runtimes_s: None,
            trusted: None,
        };
        let config = MetricsConfig::default();
        let message = TrajectoryMetrics::new(&trajectory, &config)
            .unwrap_err()
            .to_string();
        assert!(message.contains("10 frames are too few"), "{message}");
        let shorter = EvaluatedTrajectory {
            estimates: &truth[..5],
            ground_truth: &truth[..5],
            ..trajectory
        };
        assert!(TrajectoryMetrics::new(&shorter, &config).is_err());
        trajectory.ground_truth = &truth[1..];
        let message = TrajectoryMetrics::new(&trajectory, &config)
            .unwrap_err()
            .to_string();
        assert!(message.contains("9 true poses for 10 frames"), "{message}");
    }
}
