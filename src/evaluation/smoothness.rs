//! Smoothness of a trajectory.
//!
//! ```text
//! jitter = √ mean |eₖ − eₖ₋₁|²                      e: planar error vectors, map axes
//! LDLJ   = −ln( (T³ / v²_peak) ∫ |d³p/dt³|² dt )    T: duration, p: position
//! ```
//!
//! Jitter is 0 for a trajectory with a constant offset. The log dimensionless jerk needs no ground
//! truth, is invariant to speed and scale, and is larger (less negative) for a smoother path: Hogan and Sternad, *Sensitivity of smoothness measures to movement duration, amplitude,
//! and arrests*, J. Motor Behavior 2009; Balasubramanian et al., IEEE Trans. Biomed. Eng. 2012.

use nalgebra::Vector2;

use super::planar::PlanarError;
use super::statistics::{mean, rms};
use crate::geometry::{Pose2, wrap_angle};

/// RMS difference of consecutive planar error vectors [m]; `None` for fewer than two.
pub fn jitter_m(errors: &[PlanarError]) -> Option<f64> {
    let steps: Vec<f64> = errors
        .windows(2)
        .map(|pair| (pair[1].offset_in_map - pair[0].offset_in_map).norm())
        .collect();
    rms(&steps)
}

/// Log dimensionless jerk, unitless; `None` for fewer than four poses, for poses that do not move,
/// and for a motion without jerk, which is infinitely smooth.
///
/// `times_s` ascend strictly, one per pose. Derivatives are differences of neighbours, each at
/// their mean time.
pub fn log_dimensionless_jerk(poses: &[Pose2], times_s: &[f64]) -> Option<f64> {
    let positions: Vec<Vector2<f64>> = poses.iter().map(|pose| pose.translation.vector).collect();
    let (velocity_times, velocities) = derivative(times_s, &positions);
    let (middles, accelerations) = derivative(&velocity_times, &velocities);
    let (_, jerks) = derivative(&middles, &accelerations);
    let integral: f64 = middles
        .windows(2)
        .zip(&jerks)
        .map(|(pair, jerk)| jerk.norm_squared() * (pair[1] - pair[0]))
        .sum();
    let peak = velocities.iter().map(Vector2::norm).fold(0.0, f64::max);
    let duration = times_s.last()? - times_s.first()?;
    let dimensionless = duration.powi(3) / peak.powi(2) * integral;
    (dimensionless.is_finite() && dimensionless > 0.0).then(|| -dimensionless.ln())
}

fn derivative(times: &[f64], values: &[Vector2<f64>]) -> (Vec<f64>, Vec<Vector2<f64>>) {
    times
        .windows(2)
        .zip(values.windows(2))
        .map(|(t, v)| (0.5 * (t[0] + t[1]), (v[1] - v[0]) / (t[1] - t[0])))
        .unzip()
}

/// Mean length of the steps between frames [m] and mean magnitude of the turns [rad]; `None` for
/// fewer than two poses. The "average delta pose" of the report, by unit.
pub fn mean_pose_change(poses: &[Pose2]) -> Option<(f64, f64)> {
    let (steps_m, turns_rad): (Vec<f64>, Vec<f64>) = poses
        .windows(2)
        .map(|pair| {
            let step = pair[1].translation.vector - pair[0].translation.vector;
            let turn_rad = wrap_angle(pair[1].rotation.angle() - pair[0].rotation.angle());
            (step.norm(), turn_rad.abs())
        })
        .unzip();
    Some((mean(&steps_m)?, mean(&turns_rad)?))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::super::planar::planar_errors;
    use super::*;

    fn arc(count: usize, wobble_m: f64) -> Vec<Pose2> {
        (0..count)
            .map(|k| {
                let angle = 0.02 * k as f64;
                let radius_m = 20.0 + if k % 2 == 0 { wobble_m } else { -wobble_m };
                let position = Vector2::new(radius_m * angle.sin(), -radius_m * angle.cos());
                Pose2::new(position, angle)
            })
            .collect()
    }

    fn times(count: usize, step_s: f64) -> Vec<f64> {
        (0..count).map(|k| step_s * k as f64).collect()
    }

    #[test]
    fn a_constant_offset_has_no_jitter_and_a_zigzag_has_its_amplitude() {
        let truth = arc(50, 0.0);
        let shift = Pose2::translation(3.0, -2.0);
        let shifted: Vec<Pose2> = truth.iter().map(|pose| shift * pose).collect();
        let jitter = jitter_m(&planar_errors(&shifted, &truth)).unwrap();
        assert_relative_eq!(jitter, 0.0, epsilon = 1e-12);
        let zigzag = jitter_m(&planar_errors(&arc(50, 0.1), &truth)).unwrap();
        assert_relative_eq!(zigzag, 0.2, epsilon = 1e-4);
    }

    #[test]
    fn jerk_is_invariant_to_speed_and_scale_and_grows_with_the_wobble() {
        let poses = arc(60, 0.01);
        let jerk = log_dimensionless_jerk(&poses, &times(60, 0.1)).unwrap();
        let slower = log_dimensionless_jerk(&poses, &times(60, 0.7)).unwrap();
        assert_relative_eq!(jerk, slower, epsilon = 1e-9);
        let larger: Vec<Pose2> = poses
            .iter()
            .map(|pose| Pose2::new(5.0 * pose.translation.vector, pose.rotation.angle()))
            .collect();
        let larger = log_dimensionless_jerk(&larger, &times(60, 0.1)).unwrap();
        assert_relative_eq!(jerk, larger, epsilon = 1e-9);
        let calm = log_dimensionless_jerk(&arc(60, 0.0), &times(60, 0.1)).unwrap();
        assert!(calm > jerk + 2.0, "{calm} {jerk}");
    }

    #[test]
    fn the_jerk_of_a_circle_equals_the_integral() {
        // |jerk| = r ω³, v = r ω:  T³ / v² · r² ω⁶ T = (ω T)⁴
        let poses = arc(2001, 0.0);
        let jerk = log_dimensionless_jerk(&poses, &times(2001, 1.0)).unwrap();
        let expected = -(0.02_f64 * 2000.0).powi(4).ln();
        assert_relative_eq!(jerk, expected, epsilon = 2e-3);
    }

    #[test]
    fn a_standing_or_too_short_trajectory_has_no_jerk() {
        let standing = vec![Pose2::identity(); 10];
        assert_eq!(log_dimensionless_jerk(&standing, &times(10, 0.1)), None);
        assert_eq!(log_dimensionless_jerk(&arc(3, 0.0), &times(3, 0.1)), None);
    }

    #[test]
    fn the_mean_pose_change_of_an_arc_is_its_chord_and_turn() {
        let (step_m, turn_rad) = mean_pose_change(&arc(10, 0.0)).unwrap();
        assert_relative_eq!(step_m, 2.0 * 20.0 * 0.01_f64.sin(), epsilon = 1e-12);
        assert_relative_eq!(turn_rad, 0.02, epsilon = 1e-12);
    }
}
