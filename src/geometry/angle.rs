//! Angles: wrapping to [-π, π) and the circular mean.

use std::f32;
use std::f64::consts::{PI, TAU};

use glam::Vec3;

/// Wraps an angle to [-π, π) [rad].
pub fn wrap_angle(angle_rad: f64) -> f64 {
    let wrapped = (angle_rad + PI).rem_euclid(TAU) - PI;
    // `rem_euclid` may round up to the modulus itself.
    if wrapped >= PI { -PI } else { wrapped }
}

/// Index of the sector of azimuth that contains a direction; `count` sectors begin at −π.
pub fn azimuth_sector(direction: Vec3, count: usize) -> usize {
    let turns = 0.5 + fast_atan2(direction.y, direction.x) / f32::consts::TAU;
    ((turns * count as f32) as usize).min(count - 1)
}

/// `atan2` to 5e-7 rad, π/2 of two zeros, with the same bits on every platform; loops over it are vectorized.
#[inline(always)]
pub fn fast_atan2(y: f32, x: f32) -> f32 {
    /// Coefficients of the odd polynomial that is nearest to the arctangent on [0, 1].
    const COEFFICIENTS: [f32; 7] = [
        0.999_996_1,
        -0.333_173_7,
        0.198_078_16,
        -0.132_333_42,
        0.079_623_67,
        -0.033_604_22,
        0.006_811_793,
    ];
    let (ax, ay) = (x.abs(), y.abs());
    // Selections instead of branches, so that loops are vectorized.
    let (small, large) = if ay < ax { (ay, ax) } else { (ax, ay) };
    let large = if large > f32::MIN_POSITIVE {
        large
    } else {
        f32::MIN_POSITIVE
    };
    let t = small / large;
    let mut sum = 0.0;
    for coefficient in COEFFICIENTS.into_iter().rev() {
        sum = sum * (t * t) + coefficient;
    }
    let octant = t * sum;
    let quadrant = if ay < ax {
        octant
    } else {
        f32::consts::FRAC_PI_2 - octant
    };
    let half = if x < 0.0 {
        f32::consts::PI - quadrant
    } else {
        quadrant
    };
    half.copysign(y)
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
    fn the_fast_arctangent_is_the_exact_one_to_its_accuracy() {
        for step in 0..100_000 {
            let angle = (f64::from(step) / 100_000.0 - 0.5) * TAU;
            let (y, x) = ((1e3 * angle.sin()) as f32, (1e3 * angle.cos()) as f32);
            let exact = f64::from(y).atan2(f64::from(x));
            assert!(
                (f64::from(fast_atan2(y, x)) - exact).abs() < 5e-7,
                "{angle}"
            );
        }
        assert_eq!(fast_atan2(0.0, -1.0), f32::consts::PI);
        assert_eq!(fast_atan2(-0.0, -1.0), -f32::consts::PI);
        assert!(fast_atan2(f32::NAN, 1.0).is_nan());
    }

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
