//! Errors of a trajectory in six degrees of freedom.
//!
//! ```text
//! F = Q⁻¹ P      Q true, P estimated pose      position |t_F|, rotation: angle of R_F
//! ```
//!
//! The height error is z_P − z_Q in the frame of the truth. Absolute errors are those of the poses as they are
//! given and after a rigid [`alignment`](super::alignment); relative errors are those of
//! [segments](super::pose_error::segments) and need none.

use serde::{Deserialize, Serialize};

use super::alignment::{aligned, rigid_alignment};
use super::pose_error::{
    KITTI_FRAME_STEP, KITTI_LENGTHS_M, SHORT_LENGTHS_M, SegmentErrors, absolute_pose_error,
    segments,
};
use super::statistics::{Summary, mean};
use crate::geometry::{Pose3, distances_m};

/// Errors in space, in addition to those in the plane.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct SpatialMetrics {
    /// Distance to the true position [m].
    pub position_m: Summary,
    /// Magnitude of the height error [m].
    pub height_m: Summary,
    /// Mean of the height error [m]; positive is above the truth.
    pub height_bias_m: f64,
    /// Angle of the rotation between estimate and truth [rad].
    pub rotation_rad: Summary,
    /// Distance to the true position after rigid alignment [m]; absent on a straight line.
    #[serde(default)]
    pub aligned_position_m: Option<Summary>,
    /// Angle of the rotation after rigid alignment [rad].
    #[serde(default)]
    pub aligned_rotation_rad: Option<Summary>,
    /// Distance driven along the truth [m].
    #[serde(default)]
    pub distance_m: f64,
    /// Distance of the last position to the true one [m].
    #[serde(default)]
    pub end_position_m: f64,
    /// Angle of the rotation of the last pose [rad].
    #[serde(default)]
    pub end_rotation_rad: f64,
    /// Segments of 100 to 800 m from every tenth pose; absent for a path under 100 m.
    #[serde(default)]
    pub kitti_segments: Option<SegmentErrors>,
    /// Segments of 5, 10, 20 and 50 m from every pose; absent for a path under 5 m.
    #[serde(default)]
    pub short_segments: Option<SegmentErrors>,
    /// Segments of each length, from the shortest, as far as the path has them.
    #[serde(default)]
    pub by_length: Vec<LengthErrors>,
}

/// Mean errors of the segments of one length.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct LengthErrors {
    /// Length [m].
    pub length_m: f64,
    /// Mean errors.
    #[serde(flatten)]
    pub errors: SegmentErrors,
}

impl SpatialMetrics {
    /// Computes the metrics of the frames after the skipped ones; `None` if there are none or the
    /// trajectories differ in length.
    pub fn new(estimates: &[Pose3], ground_truth: &[Pose3], skip_frames: usize) -> Option<Self> {
        if estimates.len() != ground_truth.len() {
            return None;
        }
        let (estimates, truth) = (
            estimates.get(skip_frames..)?,
            ground_truth.get(skip_frames..)?,
        );
        let mut by_length = Vec::new();
        let mut mean_of_segments = |lengths_m: &[f64], frame_step| {
            let all = segments(estimates, truth, lengths_m, frame_step);
            by_length.extend(lengths_m.iter().filter_map(|&length_m| {
                let of_length = all.iter().filter(|it| it.length_m == length_m);
                let errors = SegmentErrors::mean_of(of_length)?;
                Some(LengthErrors { length_m, errors })
            }));
            SegmentErrors::mean_of(&all)
        };
        let short_segments = mean_of_segments(&SHORT_LENGTHS_M, 1);
        let kitti_segments = mean_of_segments(&KITTI_LENGTHS_M, KITTI_FRAME_STEP);
        let errors = absolute_pose_error(estimates, truth);
        let aligned_errors = rigid_alignment(estimates, truth)
            .map(|transform| absolute_pose_error(&aligned(&transform, estimates), truth));
        let pairs = estimates.iter().zip(truth);
        let heights_m: Vec<f64> = pairs
            .map(|(estimate, truth)| estimate.translation.z - truth.translation.z)
            .collect();
        Some(Self {
            position_m: errors.translation()?,
            height_m: Summary::new(&heights_m)?,
            height_bias_m: mean(&heights_m)?,
            rotation_rad: errors.rotation()?,
            aligned_position_m: aligned_errors.as_ref().and_then(|it| it.translation()),
            aligned_rotation_rad: aligned_errors.as_ref().and_then(|it| it.rotation()),
            distance_m: *distances_m(truth).last()?,
            end_position_m: *errors.translations_m.last()?,
            end_rotation_rad: *errors.rotations_rad.last()?,
            kitti_segments,
            short_segments,
            by_length,
        })
    }

    /// Mean errors of the segments of one length [m]; `None` if the path has none.
    pub(crate) fn of_length(&self, length_m: f64) -> Option<SegmentErrors> {
        let found = self.by_length.iter().find(|it| it.length_m == length_m);
        found.map(|it| it.errors)
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn height_roll_and_heading_errors_are_measured_in_space_wherever_the_map_is() {
        let error = Pose3::new(Vector3::new(0.3, 0.0, -0.4), Vector3::new(0.02, 0.0, 0.0));
        let truth: Vec<Pose3> = (0..20)
            .map(|i| {
                Pose3::new(
                    Vector3::new(f64::from(i), 1e3, 5.0),
                    Vector3::z() * f64::from(i),
                )
            })
            .collect();
        let mut estimates: Vec<Pose3> = truth.iter().map(|pose| pose * error).collect();
        estimates[0].translation.z = 100.0;
        let metrics = SpatialMetrics::new(&estimates, &truth, 1).unwrap();
        assert_relative_eq!(metrics.position_m.max, 0.5, epsilon = 1e-9);
        assert_relative_eq!(metrics.height_m.rmse, 0.4, epsilon = 1e-9);
        assert_relative_eq!(metrics.height_bias_m, -0.4, epsilon = 1e-9);
        assert_relative_eq!(metrics.rotation_rad.mean, 0.02, epsilon = 1e-9);
        assert_eq!(SpatialMetrics::new(&estimates, &truth, 20), None);
        assert_eq!(SpatialMetrics::new(&estimates[1..], &truth, 0), None);
    }
    /// A path with curves of steps of 1 m and a little, so that n steps are not below n metres, `scale` times as long.
    fn curve(scale: f64) -> Vec<Pose3> {
        let step = |i: usize| {
            let turn = Vector3::new(0.0, 0.0, 0.02 * (0.05 * i as f64).sin());
            Pose3::new(Vector3::new(scale * (1.0 + 1e-9), 0.0, 0.0), turn)
        };
        (0..400)
            .scan(Pose3::identity(), |pose, i| {
                let here = *pose;
                *pose *= step(i);
                Some(here)
            })
            .collect()
    }

    #[test]
    fn a_rigid_transform_of_the_truth_has_no_error_after_alignment() {
        let truth = curve(1.0);
        let elsewhere = Pose3::new(Vector3::new(70.0, 3.0, 2.0), Vector3::new(0.2, 0.1, 2.0));
        let metrics = SpatialMetrics::new(&aligned(&elsewhere, &truth), &truth, 0).unwrap();
        assert!(metrics.position_m.rmse > 50.0);
        assert!(metrics.aligned_position_m.unwrap().max < 1e-9);
        assert!(metrics.aligned_rotation_rad.unwrap().max < 1e-7);
        for segments in [metrics.kitti_segments, metrics.short_segments] {
            assert!(segments.unwrap().translation_percent < 1e-9);
        }
    }

    #[test]
    fn a_scale_error_is_the_translation_error_of_every_length_and_of_the_end() {
        let (truth, estimates) = (curve(1.0), curve(1.03));
        let metrics = SpatialMetrics::new(&estimates, &truth, 0).unwrap();
        assert_relative_eq!(metrics.distance_m, 399.0, epsilon = 1e-5);
        let lengths_m = [5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 300.0];
        assert_eq!(metrics.by_length.len(), lengths_m.len());
        for length_m in lengths_m {
            // The chord of a curve is shorter than its arc.
            let errors = metrics.of_length(length_m).unwrap();
            assert!(
                (2.6..=3.0001).contains(&errors.translation_percent),
                "{errors:?}"
            );
            assert!(errors.rotation_deg_per_100_m() < 1e-4, "{errors:?}");
        }
        let chord_m = truth[399].translation.vector.norm();
        assert_relative_eq!(metrics.end_position_m, 0.03 * chord_m, epsilon = 1e-9);
        // Alignment divides the error between both ends.
        assert!(metrics.aligned_position_m.unwrap().rmse < metrics.position_m.rmse);
    }
}
