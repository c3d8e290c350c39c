//! Errors of a trajectory in six degrees of freedom, without alignment.
//!
//! ```text
//! F = Q⁻¹ P      Q true, P estimated pose      position |t_F|, rotation: angle of R_F
//! ```
//!
//! The height error is z_P − z_Q in the map frame.

use serde::{Deserialize, Serialize};

use super::pose_error::absolute_pose_error;
use super::statistics::{Summary, mean};
use crate::geometry::Pose3;

/// Errors in space, beside those in the plane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SpatialMetrics {
    /// Distance to the true position [m].
    pub position_m: Summary,
    /// Magnitude of the height error [m].
    pub height_m: Summary,
    /// Mean of the height error [m]; positive is above the truth.
    pub height_bias_m: f64,
    /// Angle of the rotation between estimate and truth [rad].
    pub rotation_rad: Summary,
}

impl SpatialMetrics {
    /// Computes the metrics of the frames after the skipped ones; `None` if there are none or the
    /// trajectories differ in length.
    pub fn of(estimates: &[Pose3], ground_truth: &[Pose3], skip_frames: usize) -> Option<Self> {
        if estimates.len() != ground_truth.len() {
            return None;
        }
        let (estimates, truth) = (
            estimates.get(skip_frames..)?,
            ground_truth.get(skip_frames..)?,
        );
        let errors = absolute_pose_error(estimates, truth);
        let pairs = estimates.iter().zip(truth);
        let heights_m: Vec<f64> = pairs
            .map(|(estimate, truth)| estimate.translation.z - truth.translation.z)
            .collect();
        Some(Self {
            position_m: errors.translation()?,
            height_m: Summary::of(&heights_m)?,
            height_bias_m: mean(&heights_m)?,
            rotation_rad: errors.rotation()?,
        })
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
        let metrics = SpatialMetrics::of(&estimates, &truth, 1).unwrap();
        assert_relative_eq!(metrics.position_m.max, 0.5, epsilon = 1e-9);
        assert_relative_eq!(metrics.height_m.rmse, 0.4, epsilon = 1e-9);
        assert_relative_eq!(metrics.height_bias_m, -0.4, epsilon = 1e-9);
        assert_relative_eq!(metrics.rotation_rad.mean, 0.02, epsilon = 1e-9);
        assert_eq!(SpatialMetrics::of(&estimates, &truth, 20), None);
        assert_eq!(SpatialMetrics::of(&estimates[1..], &truth, 0), None);
    }
}
