//! What may be wrong with the points of all scans, and scans without it.

use std::fmt;

use super::odometry::Odometry;
use crate::geometry::{Pose3, mirrored_motion};
use crate::lidar::Scan;

/// Ratio of neighbouring factors: scans whose ranges are off by 3 % are found on a map (`docs/method.md`, Distorted scans).
const STEP: f64 = 1.03;
/// Number of factors above one, and below it: up to 23 % too long and 19 % too short.
const STEPS: i32 = 7;

/// What is wrong with the points of all scans.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Distortion {
    /// Their y has the other sign: the frame is left-handed.
    Mirrored,
    /// Their ranges are the true ones times a factor.
    Scaled {
        /// The factor, to some thousandths.
        factor: f64,
    },
}

impl fmt::Display for Distortion {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Mirrored => formatter.write_str("y of the wrong sign"),
            Self::Scaled { factor } => {
                write!(formatter, "ranges of {factor:.3} times the true ones")
            }
        }
    }
}

impl Distortion {
    /// All distortions that are suspected, the likely ones first.
    pub(super) fn all() -> impl Iterator<Item = Self> + Clone {
        let scaled = |power| Self::Scaled {
            factor: STEP.powi(power),
        };
        let powers = (1..=STEPS).flat_map(|power| [power, -power]);
        [Self::Mirrored].into_iter().chain(powers.map(scaled))
    }

    /// A scan without the distortion.
    pub(super) fn undistort(self, scan: &Scan) -> Scan {
        let mut scan = scan.clone();
        for point in &mut scan.points {
            match self {
                Self::Mirrored => point.y = -point.y,
                Self::Scaled { factor } => *point /= factor as f32,
            }
        }
        scan
    }

    /// A motion in space without the distortion, which is taken to be that of the scans; that of wheels and of commands is not distorted.
    pub(super) fn undistort_motion(self, odometry: Odometry) -> Odometry {
        odometry.map_in_space(|motion| match self {
            Self::Mirrored => mirrored_motion(motion),
            Self::Scaled { factor } => {
                let translation = motion.translation.vector / factor;
                Pose3::from_parts(translation.into(), motion.rotation)
            }
        })
    }

    /// A rectangle of the lidar frame, x_min, x_max, y_min, y_max [m], without the distortion.
    pub(super) fn undistort_rectangle(self, [x_min, x_max, y_min, y_max]: [f32; 4]) -> [f32; 4] {
        match self {
            Self::Mirrored => [x_min, x_max, -y_max, -y_min],
            Self::Scaled { factor } => [x_min, x_max, y_min, y_max].map(|m| m / factor as f32),
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use glam::Vec3;
    use nalgebra::{Point3, Vector3};

    use super::*;

    #[test]
    fn a_distortion_is_undone_in_points_motions_and_the_rectangle_of_the_own_car_alike() {
        let current = Vec3::new(3.0, -2.0, 0.5);
        let motion = Pose3::new(Vector3::new(1.0, 0.2, -0.1), Vector3::new(0.1, -0.2, 0.3));
        let of = |point: Vec3| Point3::from(point.as_dvec3().to_array());
        let scan_of = |point: Point3<f64>| Scan {
            points: vec![Vec3::new(point.x as f32, point.y as f32, point.z as f32)],
            ..Scan::default()
        };
        for distortion in Distortion::all() {
            let undone = |point: Point3<f64>| of(distortion.undistort(&scan_of(point)).points[0]);
            let odometry = distortion.undistort_motion(Odometry::Motion(motion));
            let moved = odometry.in_space().unwrap();
            let (before, after) = (undone(motion * of(current)), moved * undone(of(current)));
            assert_relative_eq!(before, after, epsilon = 1e-5);
            let corner = undone(Point3::new(-4.0, 2.0, 0.0));
            let [x_min, _, y_min, y_max] = distortion.undistort_rectangle([-4.0, 3.0, -1.0, 2.0]);
            let is_corner = |y: f32| (f64::from(y) - corner.y).abs() < 1e-5;
            assert_relative_eq!(f64::from(x_min), corner.x, epsilon = 1e-5);
            assert!((is_corner(y_min) || is_corner(y_max)) && y_min < y_max);
        }
    }

    #[test]
    fn ranges_are_searched_up_to_a_fifth_too_long_and_too_short() {
        let factors = Distortion::all().filter_map(|it| match it {
            Distortion::Scaled { factor } => Some(factor),
            Distortion::Mirrored => None,
        });
        let mut factors: Vec<f64> = factors.chain([1.0]).collect();
        factors.sort_by(f64::total_cmp);
        let (least, most) = (factors[0], factors[factors.len() - 1]);
        assert!(least < 0.82 && most > 1.22, "{least} to {most}");
        // No factor is farther from the next one than a localizer reaches.
        let is_near = |pair: &[f64]| (pair[1] / pair[0] - STEP).abs() < 1e-9;
        assert!(factors.windows(2).all(is_near));
    }
}
