//! Motion compensation (deskewing) of scans.
//!
//! A sweep takes about a tenth of a second, in which a car moves up to a few meters. With constant velocity,
//! a point that was measured at a time t after the moment of the scan's pose is moved to that moment by
//!
//! ```text
//! p = exp(t / T · log(previous_from_current)) · p_measured       T: duration of the motion
//! ```
//!
//! Where the data have no times, they follow from the azimuth α of a sensor that turns once in a period P,
//! from an azimuth α₀ on, and whose pose is that of the middle of the revolution:
//!
//! ```text
//! t = −(α − α₀ − π) P / 2π  clockwise,   +(α − α₀ − π) P / 2π  counter-clockwise,   −P/2 ≤ t < P/2
//! ```
//!
//! With α₀ = π, as of KITTI, the revolution starts behind and the pose is that of facing forward.
//! Geiger et al., *Vision meets Robotics: The KITTI Dataset* (2013), section III, for the time stamp.

use std::f32::consts::TAU;
use std::f64::consts::PI;
use std::ops::Range;

use glam::Vec3;
use nalgebra::{UnitQuaternion, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::scan::Scan;
use crate::geometry::pose::{exponential, logarithm};
use crate::geometry::{Pose3, Rigid3f, fast_atan2, wrap_angle};
use crate::inertial::MeasuredRotation;

/// Duration of a revolution, and time between scans, where nothing shows it [s].
pub const PERIOD_S: f64 = 0.1;

/// Direction of rotation of a spinning sensor, seen from above.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum RotationDirection {
    /// From the left over the front to the right.
    Clockwise,
    /// From the right over the front to the left.
    CounterClockwise,
}

impl RotationDirection {
    /// Sign of the change of the azimuth: 1 counter-clockwise, -1 clockwise.
    pub(crate) fn sense(self) -> f64 {
        match self {
            Self::Clockwise => -1.0,
            Self::CounterClockwise => 1.0,
        }
    }
}

/// Rotation of a spinning sensor.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rotation {
    /// Direction.
    pub direction: RotationDirection,
    /// Duration of a revolution [s].
    pub period_s: f64,
    /// Azimuth at which a revolution starts, counter-clockwise from the x axis [rad].
    pub start_rad: f64,
}

impl Rotation {
    /// The same that starts at another azimuth, counter-clockwise from this one [rad].
    pub(crate) fn turned(self, turn_rad: f64) -> Self {
        Self {
            start_rad: wrap_angle(self.start_rad + turn_rad),
            ..self
        }
    }

    /// The same in the opposite direction.
    pub(crate) fn reversed(self) -> Self {
        let direction = match self.direction {
            RotationDirection::Clockwise => RotationDirection::CounterClockwise,
            RotationDirection::CounterClockwise => RotationDirection::Clockwise,
        };
        Self { direction, ..self }
    }

    /// Time of each point from its azimuth, zero in the middle of the revolution [s].
    pub(crate) fn point_times(&self, points: &[Vec3]) -> Vec<f32> {
        let sense = self.direction.sense() as f32;
        let (middle_rad, period_s) = (wrap_angle(self.start_rad + PI) as f32, self.period_s as f32);
        let time = |point: &Vec3| {
            let turns = sense * (fast_atan2(point.y, point.x) - middle_rad) / TAU;
            // It is between -1 and 1; a call of `floor` would take as long as the rest.
            let whole = if turns >= 0.5 {
                1.0
            } else if turns < -0.5 {
                -1.0
            } else {
                0.0
            };
            (turns - whole) * period_s
        };
        points.iter().map(time).collect()
    }
}

/// Motion at constant velocity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// `p_previous = previous_from_current * p_current`.
    pub previous_from_current: Pose3,
    /// Duration, greater than zero [s].
    pub duration_s: f64,
}

impl Motion {
    /// The motion around a row of a trajectory, from the row before to the row after; at an end, extrapolated from the
    /// two steps next to it if these last about as long. `None` if there is only one row, or if its times do not ascend.
    pub fn along(map_from_lidar: &[Pose3], times_s: &[f64], row: usize) -> Option<Self> {
        let last = map_from_lidar.len() - 1;
        let between = |first: usize, second: usize| Self {
            previous_from_current: map_from_lidar[first].inverse() * map_from_lidar[second],
            duration_s: times_s[second] - times_s[first],
        };
        let motion = match row {
            0 if last >= 2 => between(0, 1).beyond(&between(1, 2)),
            row if row == last && last >= 2 => {
                between(last - 1, last).beyond(&between(last - 2, last - 1))
            }
            row => between(row.saturating_sub(1), (row + 1).min(last)),
        };
        (motion.duration_s > 0.0).then_some(motion)
    }

    /// The rows of a trajectory by which [`along`](Self::along) finds the motion around one of them: three, if there are as many.
    pub(crate) fn rows_along(rows: usize, row: usize) -> Range<usize> {
        let first = row.saturating_sub(1).min(rows.saturating_sub(3));
        first..rows.min(first + 3)
    }

    /// The motion at the outer end of this step, extrapolated at constant acceleration from this step and its neighbour.
    fn beyond(&self, other: &Self) -> Self {
        /// Largest ratio of the durations: beyond it the noise of the shorter step would decide.
        const MAX_RATIO: f64 = 3.0;
        let ratio = self.duration_s / other.duration_s;
        if !(0.0..=MAX_RATIO).contains(&ratio) {
            return *self;
        }
        let share = self.duration_s / (self.duration_s + other.duration_s);
        let [own, neighbour] = [self, other].map(|it| logarithm(&it.previous_from_current));
        let twist = own * (1.0 + share) - neighbour * (share * ratio);
        Self {
            previous_from_current: exponential(&twist),
            ..*self
        }
    }

    /// The motion in a time; backward if it is negative.
    pub(crate) fn after(&self, time_s: f64) -> Pose3 {
        interpolate_motion(&self.previous_from_current, time_s / self.duration_s)
    }

    /// Moves the points of a scan to the moment of its pose; its rotation is the measured one where there is one. Afterwards
    /// the scan has no times; a scan without times is unchanged.
    pub fn deskew(&self, scan: &mut Scan) {
        let deskewing = self.deskewing(scan);
        let points = scan.points.par_iter_mut().zip(&scan.times_s);
        points.for_each(|(point, &time_s)| *point = deskewing.moved(*point, time_s));
        scan.times_s.clear();
    }

    /// How the points of a scan are moved to the moment of its pose.
    pub(crate) fn deskewing(&self, scan: &Scan) -> Deskewing {
        let sweep = Sweep::spanning(scan.times_s.iter().copied());
        let turns = sweep.turns(scan.measured_rotation().as_ref());
        Deskewing {
            sweep,
            transforms: sweep.transforms(self, turns.as_deref()),
        }
    }
}

/// Transforms of the points of a scan to the moment of its pose, by their times.
pub struct Deskewing {
    sweep: Sweep,
    transforms: Vec<Rigid3f>,
}

impl Deskewing {
    /// A point that was measured at a time [s], at the moment of the pose.
    #[inline]
    pub fn moved(&self, point: Vec3, time_s: f32) -> Vec3 {
        self.transforms[self.sweep.interval(time_s)].apply(point)
    }
}

/// Equal intervals of the time of a sweep; the points of each share one transform.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sweep {
    first_s: f32,
    interval_s: f32,
    /// Number of intervals.
    intervals: usize,
}

impl Sweep {
    const MAX_INTERVALS: usize = 720;

    /// The intervals between the first and the last of finite times.
    pub fn spanning(times_s: impl Iterator<Item = f32>) -> Self {
        let (first_s, last_s) = (times_s.filter(|time_s| time_s.is_finite())).fold(
            (f32::INFINITY, f32::NEG_INFINITY),
            |(first, last), time_s| (first.min(time_s), last.max(time_s)),
        );
        let (first_s, last_s) = if first_s <= last_s {
            (first_s, last_s)
        } else {
            (0.0, 0.0)
        };
        // Powers of two and their multiples, so that the intervals do not depend on rounding of the first and last time.
        let least_s = ((last_s - first_s) / (Self::MAX_INTERVALS - 1) as f32).max(1e-9);
        let interval_s = least_s.log2().ceil().exp2();
        let mut sweep = Self {
            first_s: (first_s / interval_s).floor() * interval_s,
            interval_s,
            intervals: Self::MAX_INTERVALS,
        };
        sweep.intervals = sweep.interval(last_s) + 1;
        sweep
    }

    /// Number of the interval of a time.
    #[inline]
    pub fn interval(&self, time_s: f32) -> usize {
        (((time_s - self.first_s) / self.interval_s) as usize).min(self.intervals - 1)
    }

    /// For each interval, the transform of points to the moment of the scan's pose, with measured rotations where there are
    /// some.
    pub fn transforms(
        &self,
        motion: &Motion,
        turns: Option<&[UnitQuaternion<f64>]>,
    ) -> Vec<Rigid3f> {
        let arc = CircularArc::new(&motion.previous_from_current);
        let transform = |interval: usize| {
            let time_s = f64::from(self.middle_s(interval));
            let mut moved = arc.at(time_s / motion.duration_s);
            if let Some(turns) = turns {
                moved.rotation = turns[interval];
            }
            Rigid3f::from(&moved)
        };
        (0..self.intervals).map(transform).collect()
    }

    /// For each interval, the measured rotation of points to the moment of the scan's pose; `None` where it was not measured.
    pub fn turns(&self, rotation: Option<&MeasuredRotation>) -> Option<Vec<UnitQuaternion<f64>>> {
        let middle_s = |interval: usize| self.middle_s(interval).into();
        let times_s: Vec<f64> = (0..self.intervals).map(middle_s).collect();
        rotation?.around(&times_s)
    }

    /// The middle of an interval [s].
    fn middle_s(&self, interval: usize) -> f32 {
        self.first_s + (interval as f32 + 0.5) * self.interval_s
    }
}

/// A fraction of a motion at constant velocity: identity for 0, the motion for 1, backward if
/// negative.
pub fn interpolate_motion(motion: &Pose3, fraction: f64) -> Pose3 {
    CircularArc::new(motion).at(fraction)
}

/// A motion at constant velocity.
struct CircularArc {
    /// [rad]
    axis_angle: Vector3<f64>,
    chord_m: Vector3<f64>,
}

impl CircularArc {
    fn new(motion: &Pose3) -> Self {
        Self {
            axis_angle: motion.rotation.scaled_axis(),
            chord_m: motion.translation.vector,
        }
    }

    /// A fraction of the motion.
    fn at(&self, fraction: f64) -> Pose3 {
        let rotation = |fraction| UnitQuaternion::from_scaled_axis(self.axis_angle * fraction);
        // The chord, rotated back by half of the remaining rotation: the arc to second order.
        let translation = rotation(0.5 * (fraction - 1.0)) * self.chord_m * fraction;
        Pose3::from_parts(translation.into(), rotation(fraction))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;
    use crate::inertial::{GRAVITY_M_S2, Gyroscope, Imu, ImuSample, ImuSamples};

    fn motion() -> Pose3 {
        // An arc: 1.5 m of road with 0.06 rad of turn.
        let (turn, radius) = (0.06_f64, 25.0);
        let chord = Vector3::new(radius * turn.sin(), radius * (1.0 - turn.cos()), 0.0);
        Pose3::new(chord, Vector3::new(0.0, 0.0, turn))
    }

    #[test]
    fn fractions_of_a_motion_compose_to_the_motion() {
        for (a, b) in [(0.5, 0.5), (0.3, 0.7), (-0.4, 1.4), (1.0, 0.0)] {
            let sum = interpolate_motion(&motion(), a) * interpolate_motion(&motion(), b);
            // Interpolation along the chord differs from the arc by θ² / 24.
            assert_relative_eq!(sum, motion(), epsilon = 1.5 * 0.06_f64.powi(2) / 6.0);
        }
        assert_eq!(interpolate_motion(&motion(), 0.0), Pose3::identity());
    }

    #[test]
    fn the_motion_of_an_accelerated_drive_is_exact_in_every_row() {
        // x = 2 t + 3 t², at uneven times.
        let times_s = [0.0, 0.1, 0.25, 0.3, 0.4];
        let poses = times_s.map(|t| Pose3::translation(2.0 * t + 3.0 * t * t, 0.0, 0.0));
        for (row, time_s) in [(0, 0.0), (4, 0.4)] {
            let motion = Motion::along(&poses, &times_s, row).unwrap();
            let speed = motion.previous_from_current.translation.x / motion.duration_s;
            assert_relative_eq!(speed, 2.0 + 6.0 * time_s, epsilon = 1e-9);
        }
        let motion = Motion::along(&poses[..2], &times_s, 0).unwrap();
        assert_relative_eq!(
            motion.previous_from_current.translation.x,
            0.23,
            epsilon = 1e-12
        );
        assert_eq!(Motion::along(&poses[..1], &times_s, 0), None);
    }

    #[test]
    fn no_other_rows_change_the_motion_around_a_row() {
        let times_s = [0.0, 0.1, 0.25, 0.3, 0.4];
        let poses = times_s.map(|t| Pose3::translation(2.0 * t + 3.0 * t * t, 0.0, 0.0));
        for rows in 1..=times_s.len() {
            for row in 0..rows {
                let around = Motion::rows_along(rows, row);
                assert!(around.contains(&row) && around.end <= rows);
                let mut elsewhere = poses;
                for (other, pose) in elsewhere.iter_mut().enumerate() {
                    if !around.contains(&other) {
                        *pose = Pose3::translation(99.0, 9.0, 0.0);
                    }
                }
                let along = |poses: &[Pose3]| Motion::along(&poses[..rows], &times_s, row);
                assert_eq!(along(&elsewhere), along(&poses), "{rows} {row}");
            }
        }
    }

    fn rotation(direction: RotationDirection) -> Rotation {
        Rotation {
            direction,
            period_s: 0.1,
            start_rad: PI,
        }
    }

    fn deskewed(points: &[Vec3], direction: RotationDirection, motion: Pose3) -> Vec<Vec3> {
        let mut scan = Scan {
            points: points.to_vec(),
            times_s: rotation(direction).point_times(points),
            ..Scan::default()
        };
        // Two revolutions.
        let motion = Motion {
            previous_from_current: motion * motion,
            duration_s: 0.2,
        };
        motion.deskew(&mut scan);
        assert!(scan.times_s.is_empty(), "it is compensated");
        scan.points
    }

    #[test]
    fn a_scan_without_motion_or_without_times_is_unchanged() {
        let points = [Vec3::new(3.0, -2.0, 0.5), Vec3::new(-7.0, 1.0, 0.0)];
        let moved = deskewed(&points, RotationDirection::Clockwise, Pose3::identity());
        assert_eq!(moved, points);
        let mut scan = Scan {
            points: points.to_vec(),
            ..Scan::default()
        };
        let motion = Motion {
            previous_from_current: motion(),
            duration_s: 0.1,
        };
        motion.deskew(&mut scan);
        assert_eq!(scan.points, points);
    }

    #[test]
    fn times_are_zero_in_front_and_grow_with_the_rotation() {
        let points = [Vec3::X, Vec3::Y, -Vec3::Y];
        let times = rotation(RotationDirection::Clockwise).point_times(&points);
        assert_eq!(times, [0.0, -0.025, 0.025]);
        let times = rotation(RotationDirection::CounterClockwise).point_times(&points);
        assert_eq!(times, [0.0, 0.025, -0.025]);
    }

    #[test]
    fn times_ascend_over_a_revolution_from_its_start_on_and_are_zero_in_its_middle() {
        for (direction, sense) in [
            (RotationDirection::Clockwise, -1.0_f32),
            (RotationDirection::CounterClockwise, 1.0),
        ] {
            for start_rad in [0.0, 0.7, -2.5, 3.1, 6.0] {
                let rotation = Rotation {
                    start_rad,
                    ..rotation(direction)
                };
                let at = |turns: f32| {
                    let azimuth = start_rad as f32 + sense * turns * TAU;
                    Vec3::new(azimuth.cos(), azimuth.sin(), 0.0)
                };
                let times = rotation.point_times(&[0.01, 0.25, 0.5, 0.75, 0.99].map(at));
                for (found, expected) in times.iter().zip([-0.049, -0.025, 0.0, 0.025, 0.049]) {
                    assert_relative_eq!(*found, expected, epsilon = 1e-6);
                }
            }
        }
    }

    #[test]
    fn a_measured_rotation_that_is_not_constant_is_compensated() {
        // About x, once up and down in the sweep: at constant velocity there is none.
        let angle = |time_s: f64| 0.2 * (PI * time_s / 0.05).sin();
        let turned = |time_s| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), angle(time_s));
        let samples = (-100..=100).map(|row| {
            let time_s = 0.001 * f64::from(row);
            ImuSample {
                time_s: 7.0 + time_s,
                rate_rad_s: Vector3::x() * 0.2 * PI / 0.05 * (PI * time_s / 0.05).cos(),
                force_m_s2: Vector3::z() * GRAVITY_M_S2,
            }
        });
        let imu = Imu {
            samples: Arc::new(ImuSamples::new(samples.collect()).unwrap()),
            lidar_from_imu: None,
        };
        let truth = Vector3::new(0.0, 20.0, 1.0);
        let times_s: Vec<f64> = (-50..=50).map(|row| 0.001 * f64::from(row)).collect();
        let seen = |time_s: &f64| Vec3::from((turned(*time_s).inverse() * truth).cast::<f32>());
        let mut scan = Scan {
            points: times_s.iter().map(seen).collect(),
            times_s: times_s.iter().map(|&time_s| time_s as f32).collect(),
            time_s: Some(7.0),
            ..Scan::default()
        };
        let still = Motion {
            previous_from_current: Pose3::identity(),
            duration_s: 0.1,
        };
        let off_m = |mut scan: Scan| {
            still.deskew(&mut scan);
            let truth = Vec3::from(truth.cast::<f32>());
            let distances = scan.points.iter().map(|point| point.distance(truth));
            distances.fold(0.0, f32::max)
        };
        assert!(off_m(scan.clone()) > 3.5);
        scan.gyroscope = Some(Arc::new(Gyroscope::exact(&imu)));
        // Half of an interval of the sweep at 12.6 rad/s.
        let found_m = off_m(scan.clone());
        assert!(found_m < 0.04, "{found_m}");
        // Where nothing was measured, velocity is constant.
        scan.time_s = Some(7.08);
        assert!(off_m(scan) > 3.5);
    }

    #[test]
    fn deskewing_recovers_the_points_of_a_moving_sensor() {
        for direction in [
            RotationDirection::Clockwise,
            RotationDirection::CounterClockwise,
        ] {
            // Without the points straight behind, which are measured first or last in the sweep.
            let truth: Vec<Vec3> = (-170..170)
                .map(|degree| {
                    let azimuth = (degree as f32 + 0.5).to_radians();
                    Vec3::new(20.0 * azimuth.cos(), 20.0 * azimuth.sin(), 1.0)
                })
                .collect();
            let points: Vec<Vec3> = truth
                .iter()
                .map(|&point| {
                    // Fixed-point iteration: the azimuth depends on the pose of the sensor.
                    let mut seen = point;
                    for _ in 0..5 {
                        let time_s = rotation(direction).point_times(&[seen])[0];
                        let sensor = interpolate_motion(&motion(), f64::from(time_s) / 0.1);
                        seen = Rigid3f::from(&sensor.inverse()).apply(point);
                    }
                    seen
                })
                .collect();
            let off = |points: &[Vec3]| {
                let distances = points.iter().zip(&truth).map(|(a, b)| a.distance(*b));
                distances.fold(0.0, f32::max)
            };
            assert!(off(&points) > 0.5, "behind it is off by half the motion");
            let found = off(&deskewed(&points, direction, motion()));
            assert!(found < 5e-3, "{direction:?}: {found}");
        }
    }
}
