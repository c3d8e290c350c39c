//! Drift: the error of a trajectory against the distance driven.
//!
//! ```text
//! dᵢ = Σ |q_k − q_{k−1}|, k ≤ i      Fᵢ = Qᵢ⁻¹ Pᵢ
//! position |t_F|      rotation: angle of R_F      heading: atan2(R₁₀, R₀₀) of R_F
//! ```
//!
//! with the true poses Q and the estimates P, aligned as the caller chooses.

use crate::geometry::{Pose3, distances_m, yaw};

/// Error of one estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DriftPoint {
    /// Distance driven along the truth [m].
    pub distance_m: f64,
    /// Distance to the true position [m].
    pub position_m: f64,
    /// Angle between the orientations, 0 to π [rad].
    pub rotation_rad: f64,
    /// Rotation about the z axis of the true pose, counter-clockwise positive [rad].
    pub heading_rad: f64,
}

/// The errors of all estimates, in their order.
pub fn drift(estimates: &[Pose3], truth: &[Pose3]) -> Vec<DriftPoint> {
    (estimates.iter().zip(truth).zip(distances_m(truth)))
        .map(|((estimate, truth), distance_m)| {
            let error = truth.inverse() * estimate;
            DriftPoint {
                distance_m,
                position_m: error.translation.vector.norm(),
                rotation_rad: error.rotation.angle(),
                heading_rad: yaw(&error),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn a_constant_turn_per_metre_is_a_line_of_the_heading_wherever_the_path_is() {
        let world = Pose3::new(Vector3::new(5.0, 6.0, 7.0), Vector3::new(0.4, 0.2, 2.0));
        let straight = |turn_rad: f64| -> Vec<Pose3> {
            let step = Pose3::new(
                Vector3::new(2.0, 0.0, 0.0),
                Vector3::new(0.0, 0.0, turn_rad),
            );
            std::iter::successors(Some(world), |pose| Some(pose * step))
                .take(100)
                .collect()
        };
        let points = drift(&straight(-0.002), &straight(0.0));
        for (i, point) in points.iter().enumerate() {
            assert_relative_eq!(point.distance_m, 2.0 * i as f64, epsilon = 1e-9);
            assert_relative_eq!(
                point.heading_rad,
                -0.001 * point.distance_m,
                epsilon = 1e-12
            );
            assert_relative_eq!(point.rotation_rad, point.heading_rad.abs(), epsilon = 1e-9);
        }
        // A circle of a turn of 1 mrad per metre departs from its tangent by d²/2000.
        let end = points.last().unwrap();
        assert_relative_eq!(
            end.position_m,
            end.distance_m.powi(2) / 2000.0,
            max_relative = 0.02
        );
    }
}
