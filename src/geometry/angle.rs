//! Angles: wrapping to [-π, π) and the circular mean.

use std::f64::consts::{PI, TAU};

/// Wraps an angle to [-π, π) [rad].
pub fn wrap_angle(angle_rad: f64) -> f64 {
    let wrapped = (angle_rad + PI).rem_euclid(TAU) - PI;
    // `rem_euclid` may round up to the modulus itself.
    if wrapped >= PI { -PI } else { wrapped }
}

/// Circular mean of (angle, weight), the direction of the weighted sum of unit vectors [rad]; `None`
/// if the sum vanishes.
///
/// Mardia and Jupp, *Directional Statistics* (2000), eq. 2.2.4.
pub fn circular_mean(weighted_angles: impl IntoIterator<Item = (f64, f64)>) -> Option<f64> {
    let (mut sin, mut cos) = (0.0, 0.0);
    for (angle_rad, weight) in weighted_angles {
        sin += weight * angle_rad.sin();
        cos += weight * angle_rad.cos();
    }
    (f64::hypot(sin, cos) > 1e-12).then(|| f64::atan2(sin, cos))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn wrapping_keeps_the_direction_and_the_interval() {
        for turns in -3..=3 {
            for angle in [-3.0, -0.1, 0.0, 0.1, 3.0] {
                let wrapped = wrap_angle(angle + f64::from(turns) * TAU);
                assert_relative_eq!(wrapped, angle, epsilon = 1e-12);
            }
        }
        assert_eq!(wrap_angle(PI), -PI);
        assert!(wrap_angle(-PI - 1e-17) < PI);
    }

    #[test]
    fn the_mean_of_headings_around_pi_is_pi_and_not_zero() {
        let mean = circular_mean([(PI - 0.1, 1.0), (-PI + 0.1, 1.0)]).unwrap();
        assert_relative_eq!(mean.abs(), PI, epsilon = 1e-12);
    }

    #[test]
    fn opposite_headings_have_no_mean() {
        assert_eq!(circular_mean([(0.0, 1.0), (PI, 1.0)]), None);
    }
}
