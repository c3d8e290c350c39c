//! What the sensor saw during a revolution, as if it had stood still.
//!
//! A spinning sensor takes a tenth of a second for a revolution, in which a car drives up to a few
//! metres. The pose of a scan is that of the moment when the sensor faces forward; a return at
//! azimuth α was measured a part of a revolution before or after it,
//!
//! ```text
//! f = −α / 2π  clockwise,   +α / 2π  counter-clockwise           f in [−½, ½)
//! p = exp(f · log(previous_from_current)) · p_measured
//! ```
//!
//! with the motion over one revolution, taken as steady. Geiger et al., *Vision meets Robotics: The
//! KITTI Dataset* (2013), section III, for the moment.

use std::f32::consts::TAU;

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::geometry::{Pose3, Rigid3f};

/// The sense of a revolution, seen from above.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Spin {
    /// From the left over the front to the right.
    Clockwise,
    /// From the right over the front to the left.
    CounterClockwise,
}

/// A revolution of a sensor that moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Revolution {
    /// Its sense.
    pub spin: Spin,
    /// Motion over the revolution, `previous_from_current`.
    pub motion: Pose3,
}

impl Revolution {
    /// Moves points to where they would have been measured had the sensor stood still at the pose of
    /// the scan.
    pub fn compensate(&self, points: &mut [Vec3]) {
        /// Points within one of so many equal parts of the revolution are moved alike.
        const PARTS: usize = 720;
        let parts: Vec<Rigid3f> = (0..PARTS)
            .map(|part| {
                let azimuth = (part as f64 + 0.5) / PARTS as f64 - 0.5;
                let share = match self.spin {
                    Spin::Clockwise => -azimuth,
                    Spin::CounterClockwise => azimuth,
                };
                Rigid3f::from(&share_of(&self.motion, share))
            })
            .collect();
        for point in points {
            let turns = point.y.atan2(point.x) / TAU + 0.5;
            let part = (turns * PARTS as f32) as usize;
            *point = parts[part.min(PARTS - 1)].apply(*point);
        }
    }
}

/// A part of a steady motion; the whole for 1, back for negative parts.
pub fn share_of(motion: &Pose3, share: f64) -> Pose3 {
    let turn = motion.rotation.scaled_axis();
    let turned = |share: f64| nalgebra::UnitQuaternion::from_scaled_axis(turn * share);
    // Along the chord, turned back by half of what is left to turn: on the arc to second order.
    let along = turned(0.5 * (share - 1.0)) * motion.translation.vector * share;
    Pose3::from_parts(along.into(), turned(share))
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
    fn parts_of_a_motion_add_up_to_it() {
        for (a, b) in [(0.5, 0.5), (0.3, 0.7), (-0.4, 1.4), (1.0, 0.0)] {
            let sum = share_of(&motion(), a) * share_of(&motion(), b);
            // A part of a chord is longer than the chord of a part, by θ² / 24.
            assert_relative_eq!(sum, motion(), epsilon = 1.5 * 0.06_f64.powi(2) / 6.0);
        }
        assert_eq!(share_of(&motion(), 0.0), Pose3::identity());
    }

    #[test]
    fn a_standing_sensor_needs_no_compensation() {
        let seen = [Vec3::new(3.0, -2.0, 0.5), Vec3::new(-7.0, 1.0, 0.0)];
        let mut points = seen;
        Revolution {
            spin: Spin::Clockwise,
            motion: Pose3::identity(),
        }
        .compensate(&mut points);
        assert_eq!(points, seen);
    }

    #[test]
    fn points_measured_from_a_moving_sensor_come_to_lie_where_they_are() {
        for spin in [Spin::Clockwise, Spin::CounterClockwise] {
            // Straight back the revolution begins and ends: what lies there may be seen at either.
            let truth: Vec<Vec3> = (-170..170)
                .map(|degree| {
                    let azimuth = (degree as f32 + 0.5).to_radians();
                    Vec3::new(20.0 * azimuth.cos(), 20.0 * azimuth.sin(), 1.0)
                })
                .collect();
            let mut points: Vec<Vec3> = truth
                .iter()
                .map(|&point| {
                    // Where the sensor is when it looks there; the azimuth changes a little with it.
                    let mut seen = point;
                    for _ in 0..5 {
                        let azimuth = f64::from(seen.y.atan2(seen.x) / TAU);
                        let share = match spin {
                            Spin::Clockwise => -azimuth,
                            Spin::CounterClockwise => azimuth,
                        };
                        let sensor = share_of(&motion(), share);
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
            Revolution {
                spin,
                motion: motion(),
            }
            .compensate(&mut points);
            assert!(off(&points) < 5e-3, "{spin:?}: {}", off(&points));
        }
    }
}
