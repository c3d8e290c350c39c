//! Errors in the plane per frame, along the axes of the map and of the car.
//!
//! ```text
//! e = t_estimate − t_truth          (along, across) = R(θ_truth)ᵀ e
//! turn = wrap(θ_estimate − θ_truth)
//! ```
//!
//! Trajectories are not aligned: estimate and truth are both in the map frame.

use nalgebra::Vector2;

use crate::geometry::{Pose2, wrap_angle};

/// Error of one estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlanarError {
    /// Position error in the map frame [m].
    pub offset_in_map: Vector2<f64>,
    /// Position error along the true heading, positive ahead [m].
    pub along_m: f64,
    /// Position error across the true heading, positive to the left [m].
    pub across_m: f64,
    /// Heading error, counter-clockwise positive, in [-π, π) [rad].
    pub turn_rad: f64,
}

impl PlanarError {
    /// The error of an estimate.
    pub(crate) fn between(estimate: &Pose2, truth: &Pose2) -> Self {
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
    pub(crate) fn distance_m(&self) -> f64 {
        self.offset_in_map.norm()
    }
}

/// The error of each estimate.
pub fn planar_errors(estimates: &[Pose2], ground_truth: &[Pose2]) -> Vec<PlanarError> {
    estimates
        .iter()
        .zip(ground_truth)
        .map(|(estimate, truth)| PlanarError::between(estimate, truth))
        .collect()
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn along_is_positive_ahead_and_across_is_positive_to_the_left() {
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
    fn heading_errors_are_wrapped_at_pi() {
        let left = Pose2::rotation(PI - 0.1);
        let right = Pose2::rotation(-PI + 0.1);
        assert_relative_eq!(
            PlanarError::between(&right, &left).turn_rad,
            0.2,
            epsilon = 1e-12
        );
    }

    #[test]
    fn errors_are_invariant_under_a_transform_of_the_map() {
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
