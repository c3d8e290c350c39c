//! Motion compensation (deskewing) of the scans of a spinning sensor.
//!
//! A sweep takes about a tenth of a second, in which a car moves up to a few meters. The pose of a
//! scan is that of the moment when the sensor faces forward; a point at azimuth α was measured a
//! fraction f of a sweep earlier or later,
//!
//! ```text
//! f = −α / 2π  clockwise,   +α / 2π  counter-clockwise           f in [−½, ½)
//! p = exp(f · log(previous_from_current)) · p_measured
//! ```
//!
//! at constant velocity. Geiger et al., *Vision meets Robotics: The KITTI Dataset* (2013), section
//! III, for the time stamp.

use std::f32::consts::TAU;

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::geometry::{Pose3, Rigid3f};

/// Direction of rotation of a spinning sensor, seen from above.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RotationDirection {
    /// From the left over the front to the right.
    Clockwise,
    /// From the right over the front to the left.
    CounterClockwise,
}

/// Motion of the sensor during a sweep.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SweepMotion {
    /// Direction of rotation of the sensor.
    pub direction: RotationDirection,
    /// Motion over one sweep.
    pub previous_from_current: Pose3,
}

impl SweepMotion {
    /// Transforms points, each measured at its own time, to the pose of the scan.
    pub fn deskew(&self, points: &mut [Vec3]) {
        /// Equal azimuth intervals; the points of each share one transform.
        const INTERVALS: usize = 720;
        let transforms: Vec<Rigid3f> = (0..INTERVALS)
            .map(|interval| {
                let azimuth = (interval as f64 + 0.5) / INTERVALS as f64 - 0.5;
                let fraction = match self.direction {
                    RotationDirection::Clockwise => -azimuth,
                    RotationDirection::CounterClockwise => azimuth,
                };
                Rigid3f::from(&interpolate_motion(&self.previous_from_current, fraction))
            })
            .collect();
        for point in points {
            let turns = point.y.atan2(point.x) / TAU + 0.5;
            let interval = (turns * INTERVALS as f32) as usize;
            *point = transforms[interval.min(INTERVALS - 1)].apply(*point);
        }
    }
}

/// A fraction of a motion at constant velocity: identity for 0, the motion for 1, backward if
/// negative.
pub fn interpolate_motion(motion: &Pose3, fraction: f64) -> Pose3 {
    let axis_angle = motion.rotation.scaled_axis();
    let rotation = |fraction| nalgebra::UnitQuaternion::from_scaled_axis(axis_angle * fraction);
    // The chord, rotated back by half of the remaining rotation: the arc to second order.
    let translation = rotation(0.5 * (fraction - 1.0)) * motion.translation.vector * fraction;
    Pose3::from_parts(translation.into(), rotation(fraction))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

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
    fn the_scan_of_a_stationary_sensor_is_unchanged() {
        let measured = [Vec3::new(3.0, -2.0, 0.5), Vec3::new(-7.0, 1.0, 0.0)];
        let mut points = measured;
        SweepMotion {
            direction: RotationDirection::Clockwise,
            previous_from_current: Pose3::identity(),
        }
        .deskew(&mut points);
        assert_eq!(points, measured);
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
            let mut points: Vec<Vec3> = truth
                .iter()
                .map(|&point| {
                    // Fixed-point iteration: the azimuth depends on the pose of the sensor.
                    let mut seen = point;
                    for _ in 0..5 {
                        let azimuth = f64::from(seen.y.atan2(seen.x) / TAU);
                        let fraction = match direction {
                            RotationDirection::Clockwise => -azimuth,
                            RotationDirection::CounterClockwise => azimuth,
                        };
                        let sensor = interpolate_motion(&motion(), fraction);
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
            SweepMotion {
                direction,
                previous_from_current: motion(),
            }
            .deskew(&mut points);
            assert!(off(&points) < 5e-3, "{direction:?}: {}", off(&points));
        }
    }
}
