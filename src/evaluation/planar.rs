//! Errors in the plane, frame by frame, in the axes of the map and in those of the car.
//!
//! ```text
//! e = t_estimate − t_truth          (along, across) = R(θ_truth)ᵀ e
//! turn = wrap(θ_estimate − θ_truth)
//! ```
//!
//! Nothing is aligned: estimate and truth are in the map frame.

use nalgebra::Vector2;

use crate::geometry::{Pose2, wrap_angle};

/// How far one estimate is from the truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanarError {
    /// In the axes of the map [m].
    pub offset_in_map: Vector2<f64>,
    /// Ahead of the true pose [m].
    pub along_m: f64,
    /// To the left of the true pose [m].
    pub across_m: f64,
    /// Counter-clockwise from the true heading, in [-π, π) [rad].
    pub turn_rad: f64,
}

impl PlanarError {
    /// Of one estimate.
    pub fn between(estimate: &Pose2, truth: &Pose2) -> Self {
        let offset_in_map = estimate.translation.vector - truth.translation.vector;
        let offset_in_car = truth.rotation.inverse() * offset_in_map;
        Self {
            offset_in_map,
            along_m: offset_in_car.x,
            across_m: offset_in_car.y,
            turn_rad: wrap_angle(estimate.rotation.angle() - truth.rotation.angle()),
        }
    }

    /// Distance from the true position [m].
    pub fn distance_m(&self) -> f64 {
        self.offset_in_map.norm()
    }
}

/// One error per pair of poses.
pub fn planar_errors(estimates: &[Pose2], ground_truth: &[Pose2]) -> Vec<PlanarError> {
    estimates
        .iter()
        .zip(ground_truth)
        .map(|(estimate, truth)| PlanarError::between(estimate, truth))
        .collect()
}

/// Distance driven up to each pose, starting at 0 [m].
pub fn distances_m(poses: &[Pose2]) -> Vec<f64> {
    let mut driven_m = 0.0;
    let mut previous: Option<&Pose2> = None;
    poses
        .iter()
        .map(|pose| {
            if let Some(previous) = previous {
                driven_m += (pose.translation.vector - previous.translation.vector).norm();
            }
            previous = Some(pose);
            driven_m
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn along_is_ahead_of_the_true_car_and_across_is_to_its_left() {
        let truth = Pose2::new(Vector2::new(5.0, 5.0), FRAC_PI_2);
        let estimate = truth * Pose2::new(Vector2::new(0.3, 0.1), 0.02);
        let error = PlanarError::between(&estimate, &truth);
        assert_relative_eq!(error.along_m, 0.3, epsilon = 1e-12);
        assert_relative_eq!(error.across_m, 0.1, epsilon = 1e-12);
        assert_relative_eq!(
            error.offset_in_map,
            Vector2::new(-0.1, 0.3),
            epsilon = 1e-12
        );
        assert_relative_eq!(error.turn_rad, 0.02, epsilon = 1e-12);
    }

    #[test]
    fn headings_on_both_sides_of_pi_are_near() {
        let left = Pose2::rotation(PI - 0.1);
        let right = Pose2::rotation(-PI + 0.1);
        assert_relative_eq!(
            PlanarError::between(&right, &left).turn_rad,
            0.2,
            epsilon = 1e-12
        );
    }

    #[test]
    fn moving_the_whole_world_changes_no_error() {
        let world = Pose2::new(Vector2::new(100.0, -40.0), 2.2);
        let truth = Pose2::new(Vector2::new(5.0, 5.0), 3.0);
        let estimate = Pose2::new(Vector2::new(5.5, 4.0), -3.0);
        let here = PlanarError::between(&estimate, &truth);
        let there = PlanarError::between(&(world * estimate), &(world * truth));
        assert_relative_eq!(here.along_m, there.along_m, epsilon = 1e-12);
        assert_relative_eq!(here.across_m, there.across_m, epsilon = 1e-12);
        assert_relative_eq!(here.turn_rad, there.turn_rad, epsilon = 1e-12);
    }
}
