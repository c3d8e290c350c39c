//! Scans: the points of one sweep.

use std::sync::Arc;

use glam::Vec3;
use nalgebra::Vector3;

use super::model::LidarModel;
use crate::inertial::{Gyroscope, MeasuredRotation};

/// A measured direction and range.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beam {
    /// Unit direction in the lidar frame.
    pub direction: Vec3,
    /// Range of the return [m].
    pub range_m: f32,
}

impl Beam {
    /// The measured point in the lidar frame [m].
    pub fn point(&self) -> Vec3 {
        self.direction * self.range_m
    }
}

/// Points of one sweep in the lidar frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scan {
    /// Positions [m], in the order of the file.
    pub points: Vec<Vec3>,
    /// Reflectance of each point, 0 to 1 (unitless); empty if unknown.
    pub intensities: Vec<f32>,
    /// When each point was measured, after the moment of the pose [s]; empty if unknown, or if the scan
    /// is motion-compensated.
    pub times_s: Vec<f32>,
    /// Number of the beam that measured each point; empty if unknown.
    pub rings: Vec<u16>,
    /// The moment of the pose [s], from any origin; `None` if unknown.
    pub time_s: Option<f64>,
    /// The sensor that measured how the lidar turned, on the clock of `time_s`; `None` without one.
    pub gyroscope: Option<Arc<Gyroscope>>,
}

impl Scan {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// At most `count` of its points, and at least one, evenly spread.
    #[must_use]
    pub(crate) fn at_most(&self, count: usize) -> Self {
        self.every(self.len().div_ceil(count.max(1)).max(1))
    }

    /// Every n-th of its points.
    #[must_use]
    pub(crate) fn every(&self, n: usize) -> Self {
        fn pick<T: Copy>(values: &[T], n: usize) -> Vec<T> {
            values.iter().step_by(n).copied().collect()
        }
        Self {
            points: pick(&self.points, n),
            intensities: pick(&self.intensities, n),
            times_s: pick(&self.times_s, n),
            rings: pick(&self.rings, n),
            time_s: self.time_s,
            gyroscope: self.gyroscope.clone(),
        }
    }

    /// The measured rotation around its moment by the calibration of the sensor, where there is one.
    pub(crate) fn measured_rotation(&self) -> Option<MeasuredRotation> {
        Some(MeasuredRotation {
            gyroscope: self.gyroscope.clone()?,
            moment_s: self.time_s?,
            bias_change_rad_s: Vector3::zeros(),
        })
    }

    /// Adds an angle to the elevations of all points [rad]: corrects beams that are mounted higher than they say.
    pub(crate) fn raise(&mut self, angle_rad: f64) {
        if angle_rad == 0.0 {
            return;
        }
        let (sin, cos) = angle_rad.sin_cos();
        for point in &mut self.points {
            let [x, y, z] = point.to_array().map(f64::from);
            let horizontal_m = x.hypot(y);
            let raised_m = horizontal_m * cos - z * sin;
            // A point straight above or below has no azimuth.
            let factor = if horizontal_m > 0.0 {
                raised_m / horizontal_m
            } else {
                1.0
            };
            let z = horizontal_m * sin + z * cos;
            *point = [factor * x, factor * y, z].map(|m| m as f32).into();
        }
    }

    /// Removes points that are not finite or outside the range limits of the model; returns their
    /// number.
    pub(crate) fn drop_invalid(&mut self, model: &LidarModel) -> usize {
        self.retain(|point| point.is_finite() && model.accepts_range(point.length()))
    }

    /// Removes points that are not finite; returns their number.
    pub fn drop_not_finite(&mut self) -> usize {
        self.retain(|point| point.is_finite())
    }

    /// Drops the points inside a rectangle of the lidar frame, x_min, x_max, y_min, y_max [m], such as
    /// the own car. Returns how many.
    pub(crate) fn drop_inside(&mut self, rectangle_m: [f32; 4]) -> usize {
        self.retain(|point| !is_inside(*point, rectangle_m))
    }

    /// Moves the moment of the scan to the middle of its sweep, and rounds times to microseconds, so that the same
    /// scan of different files has the same times.
    pub(crate) fn center_times(&mut self) {
        let finite = || self.times_s.iter().copied().filter(|time| time.is_finite());
        let first_s = finite().fold(f32::INFINITY, f32::min);
        let last_s = finite().fold(f32::NEG_INFINITY, f32::max);
        if first_s > last_s {
            return;
        }
        let middle_s = 0.5 * (f64::from(first_s) + f64::from(last_s));
        for time_s in &mut self.times_s {
            *time_s = (1e6 * (f64::from(*time_s) - middle_s)).round() as f32 * 1e-6;
        }
        self.time_s = self.time_s.map(|time_s| time_s + middle_s);
    }

    fn retain(&mut self, is_kept: impl Fn(&Vec3) -> bool) -> usize {
        let before = self.len();
        let keep: Vec<bool> = self.points.iter().map(is_kept).collect();
        retain_flagged(&mut self.points, &keep);
        retain_flagged(&mut self.intensities, &keep);
        retain_flagged(&mut self.times_s, &keep);
        retain_flagged(&mut self.rings, &keep);
        before - self.len()
    }
}

/// Time between two moments of scans, in whole microseconds, so that the same scans of different files have the
/// same intervals [s].
pub fn interval_s(earlier_s: f64, later_s: f64) -> f64 {
    1e-6 * (1e6 * (later_s - earlier_s)).round()
}

/// Whether a point is above or below the inside of a rectangle, x_min, x_max, y_min, y_max [m].
#[inline]
pub(crate) fn is_inside(point: Vec3, [x_min, x_max, y_min, y_max]: [f32; 4]) -> bool {
    point.x > x_min && point.x < x_max && point.y > y_min && point.y < y_max
}

/// Keeps the values whose flag is set.
fn retain_flagged<T>(values: &mut Vec<T>, keep: &[bool]) {
    let mut flags = keep.iter();
    values.retain(|_| flags.next() == Some(&true));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_moment_of_a_scan_is_the_middle_of_its_sweep() {
        let mut scan = Scan {
            times_s: vec![0.0, 0.025, 0.1],
            time_s: Some(5.0),
            ..Scan::default()
        };
        scan.center_times();
        for (found, expected) in scan.times_s.iter().zip([-0.05, -0.025, 0.05]) {
            assert!((found - expected).abs() < 1e-6);
        }
        assert!((scan.time_s.unwrap() - 5.05).abs() < 1e-6);
        let centered = scan.clone();
        scan.center_times();
        assert_eq!(scan, centered);
    }

    #[test]
    fn raised_points_keep_range_and_azimuth() {
        let mut scan = Scan {
            points: vec![
                Vec3::new(3.0, -4.0, 1.0),
                Vec3::new(-30.0, 2.0, -8.0),
                Vec3::new(0.0, 0.0, 2.0),
            ],
            ..Scan::default()
        };
        let before = scan.points.clone();
        scan.raise(0.01);
        let elevation = |p: &Vec3| p.z.atan2(p.x.hypot(p.y));
        for (a, b) in before.iter().zip(&scan.points).take(2) {
            assert!((elevation(b) - elevation(a) - 0.01).abs() < 1e-6);
            assert!((a.length() - b.length()).abs() < 1e-5);
            assert!((a.y.atan2(a.x) - b.y.atan2(b.x)).abs() < 1e-6);
        }
        assert!(scan.points.iter().all(|point| point.is_finite()));
    }

    #[test]
    fn invalid_points_are_removed_with_their_intensities() {
        let mut scan = Scan {
            points: vec![
                Vec3::new(5.0, 0.0, 0.0),
                Vec3::new(f32::NAN, 0.0, 0.0),
                Vec3::new(f32::INFINITY, 0.0, 0.0),
                Vec3::ZERO,
                Vec3::new(0.0, 60.0, 0.0),
                Vec3::new(0.0, 6.0, 0.0),
            ],
            intensities: vec![0.0, 0.1, 0.2, 0.3, 0.4, 0.5],
            rings: vec![0, 1, 2, 3, 4, 5],
            ..Scan::default()
        };
        assert_eq!(scan.drop_invalid(&LidarModel::default()), 4);
        assert_eq!(scan.intensities, [0.0, 0.5]);
        assert_eq!(scan.rings, [0, 5]);
        assert_eq!(scan.points[1], Vec3::new(0.0, 6.0, 0.0));
    }
}
