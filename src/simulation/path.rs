//! A smooth line over the ground: where the lidar drives, and where roads run.
//!
//! Knots every two metres, joined by cubic Hermite curves with Catmull-Rom tangents, so that the
//! heading is continuous.

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::geometry::Pose3;

/// Distance between knots [m].
pub const KNOT_SPACING_M: f64 = 2.0;

/// Spread of the Gaussian that rounds the joints of segments and the noise of recorded poses [m].
const SMOOTHING_M: f64 = 4.0;

/// Shortest recorded drive that makes a path [m].
const SHORTEST_M: f64 = 10.0;

/// A piece of a path: an arc (straight where `turn_deg` is 0) of constant grade.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PathSegment {
    /// Along the arc [m].
    pub length_m: f64,
    /// Change of heading over the piece, positive to the left [deg].
    pub turn_deg: f64,
    /// Climb, negative downhill [m per 100 m].
    pub grade_percent: f64,
}

impl Default for PathSegment {
    /// Straight and level for 50 m.
    fn default() -> Self {
        Self {
            length_m: 50.0,
            turn_deg: 0.0,
            grade_percent: 0.0,
        }
    }
}

/// A place on a path.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PathPoint {
    /// Position [m].
    pub position: DVec2,
    /// Unit direction of the path.
    pub forward: DVec2,
    /// Height of the road [m].
    pub height_m: f64,
}

impl PathPoint {
    /// Unit direction to the left of the path.
    pub fn left(&self) -> DVec2 {
        self.forward.perp()
    }

    /// Direction of the path [rad].
    pub fn heading(&self) -> f64 {
        self.forward.to_angle()
    }

    /// The position `lateral_m` to the left.
    pub fn beside(&self, lateral_m: f64) -> DVec2 {
        self.position + lateral_m * self.left()
    }
}

/// A line of at least two knots with heights.
#[derive(Clone, Debug, PartialEq)]
pub struct Path {
    positions: Vec<DVec2>,
    heights_m: Vec<f64>,
    stations_m: Vec<f64>,
}

impl Path {
    /// Joins segments, starting at the origin along x at `height_m`; joints are rounded.
    pub fn from_segments(segments: &[PathSegment], height_m: f64) -> Self {
        const STEP_M: f64 = 0.5;
        let (mut position, mut heading, mut height_m) = (DVec2::ZERO, 0.0_f64, height_m);
        let mut positions = vec![position];
        let mut heights_m = vec![height_m];
        for segment in segments {
            let steps = (segment.length_m / STEP_M).round().max(1.0) as usize;
            let step_m = segment.length_m / steps as f64;
            let turn_rad = segment.turn_deg.to_radians() / steps as f64;
            for _ in 0..steps {
                position += step_m * DVec2::from_angle(heading + 0.5 * turn_rad);
                heading += turn_rad;
                height_m += step_m * segment.grade_percent / 100.0;
                positions.push(position);
                heights_m.push(height_m);
            }
        }
        Self::smoothed(&positions, &heights_m)
    }

    /// Follows recorded lidar poses (frame with z up) that hang `sensor_height_m` over the road.
    /// Also returns the station of every pose [m]. `None` where the poses stay in one place.
    pub fn from_poses(poses: &[Pose3], sensor_height_m: f64) -> Option<(Self, Vec<f64>)> {
        let mut positions: Vec<DVec2> = Vec::new();
        let mut heights_m = Vec::new();
        let mut raw_m = 0.0;
        let mut raw_stations_m = Vec::with_capacity(poses.len());
        for pose in poses {
            let t = pose.translation.vector;
            let position = DVec2::new(t.x, t.y);
            // Standing still, a recorded position still trembles: it counts once it has moved.
            let step_m = positions.last().map(|last| position.distance(*last));
            if step_m.is_none_or(|step_m| step_m > 0.5) {
                raw_m += step_m.unwrap_or(0.0);
                positions.push(position);
                heights_m.push(t.z - sensor_height_m);
                raw_stations_m.push(raw_m);
            } else {
                raw_stations_m.push(raw_m + step_m.unwrap_or(0.0));
            }
        }
        if raw_m < SHORTEST_M {
            return None;
        }
        let mut highest_m = 0.0_f64;
        for station_m in &mut raw_stations_m {
            highest_m = highest_m.max(*station_m);
            *station_m = highest_m;
        }
        let path = Self::smoothed(&positions, &heights_m);
        // Smoothing cuts corners a little, so that stations shrink with the length.
        let shrink = path.length_m() / raw_m;
        Some((path, raw_stations_m.iter().map(|s| s * shrink).collect()))
    }

    /// A straight line between two places.
    pub fn straight(from: DVec2, to: DVec2) -> Self {
        Self::resampled(&[from, to], &[0.0, 0.0])
    }

    /// The same line shifted to the left by `lateral_m`.
    pub fn shifted(&self, lateral_m: f64) -> Self {
        let positions: Vec<DVec2> = self
            .stations_m
            .iter()
            .map(|&station_m| self.at(station_m).beside(lateral_m))
            .collect();
        Self::with_positions(positions, self.heights_m.clone())
    }

    /// The piece between two stations, shifted to the left by `lateral_m`.
    pub fn section(&self, from_m: f64, to_m: f64, lateral_m: f64) -> Self {
        let pieces = ((to_m - from_m) / KNOT_SPACING_M).ceil().max(1.0) as usize;
        let (positions, heights_m) = (0..=pieces)
            .map(|piece| {
                let share = piece as f64 / pieces as f64;
                let point = self.at(from_m + (to_m - from_m) * share);
                (point.beside(lateral_m), point.height_m)
            })
            .unzip();
        Self::with_positions(positions, heights_m)
    }

    /// The same line, prolonged by straight and level pieces of `extra_m` at both ends.
    pub fn prolonged(&self, extra_m: f64) -> Self {
        let (first, last) = (self.at(0.0), self.at(self.length_m()));
        let steps = (extra_m / KNOT_SPACING_M).ceil() as usize;
        let mut positions = Vec::new();
        let mut heights_m = Vec::new();
        for step in (1..=steps).rev() {
            positions.push(first.position - step as f64 * KNOT_SPACING_M * first.forward);
            heights_m.push(first.height_m);
        }
        positions.extend(&self.positions);
        heights_m.extend(&self.heights_m);
        for step in 1..=steps {
            positions.push(last.position + step as f64 * KNOT_SPACING_M * last.forward);
            heights_m.push(last.height_m);
        }
        Self::with_positions(positions, heights_m)
    }

    /// Length [m].
    pub fn length_m(&self) -> f64 {
        self.stations_m.last().copied().unwrap_or(0.0)
    }

    /// The knots.
    pub fn knots(&self) -> impl Iterator<Item = (DVec2, f64)> {
        self.positions
            .iter()
            .copied()
            .zip(self.heights_m.iter().copied())
    }

    /// The place at a station; beyond the ends the line goes straight on.
    pub fn at(&self, station_m: f64) -> PathPoint {
        let last = self.positions.len() - 1;
        let inside_m = station_m.clamp(0.0, self.length_m());
        let index = self
            .stations_m
            .partition_point(|&s| s <= inside_m)
            .clamp(1, last)
            - 1;
        let span_m = self.stations_m[index + 1] - self.stations_m[index];
        let t = (inside_m - self.stations_m[index]) / span_m;
        let (p, q) = (self.positions[index], self.positions[index + 1]);
        let (dp, dq) = (
            span_m * self.tangent(index),
            span_m * self.tangent(index + 1),
        );
        let (t2, t3) = (t * t, t * t * t);
        let position = (2.0 * t3 - 3.0 * t2 + 1.0) * p
            + (t3 - 2.0 * t2 + t) * dp
            + (3.0 * t2 - 2.0 * t3) * q
            + (t3 - t2) * dq;
        let derivative =
            6.0 * (t2 - t) * (p - q) + (3.0 * t2 - 4.0 * t + 1.0) * dp + (3.0 * t2 - 2.0 * t) * dq;
        let forward = derivative.normalize_or(DVec2::X);
        let height_m = self.heights_m[index] * (1.0 - t) + self.heights_m[index + 1] * t;
        PathPoint {
            position: position + (station_m - inside_m) * forward,
            forward,
            height_m,
        }
    }

    /// Catmull-Rom tangent of a knot.
    fn tangent(&self, index: usize) -> DVec2 {
        let last = self.positions.len() - 1;
        let (before, after) = (index.saturating_sub(1), (index + 1).min(last));
        let span_m = self.stations_m[after] - self.stations_m[before];
        (self.positions[after] - self.positions[before]) / span_m
    }

    fn smoothed(positions: &[DVec2], heights_m: &[f64]) -> Self {
        let fine = Self::resampled(positions, heights_m);
        let reach = (3.0 * SMOOTHING_M / KNOT_SPACING_M) as usize;
        let last = fine.positions.len() - 1;
        let smooth = |index: usize| {
            // Symmetric windows leave the ends where they are.
            let reach = reach.min(index).min(last - index);
            let (mut position, mut height_m, mut sum) = (DVec2::ZERO, 0.0, 0.0);
            for neighbour in index - reach..=index + reach {
                let offset_m = (neighbour as f64 - index as f64) * KNOT_SPACING_M;
                let weight = (-0.5 * (offset_m / SMOOTHING_M).powi(2)).exp();
                position += weight * fine.positions[neighbour];
                height_m += weight * fine.heights_m[neighbour];
                sum += weight;
            }
            (position / sum, height_m / sum)
        };
        let (positions, heights_m): (Vec<DVec2>, Vec<f64>) = (0..=last).map(smooth).unzip();
        Self::with_positions(positions, heights_m)
    }

    /// Knots at equal spacing along the polyline.
    fn resampled(positions: &[DVec2], heights_m: &[f64]) -> Self {
        let polyline = Self::with_positions(positions.to_vec(), heights_m.to_vec());
        let pieces = (polyline.length_m() / KNOT_SPACING_M).round().max(1.0) as usize;
        let (positions, heights_m) = (0..=pieces)
            .map(|piece| {
                let station_m = polyline.length_m() * piece as f64 / pieces as f64;
                let last = polyline.positions.len() - 1;
                let index = polyline
                    .stations_m
                    .partition_point(|&s| s <= station_m)
                    .clamp(1, last)
                    - 1;
                let span_m = polyline.stations_m[index + 1] - polyline.stations_m[index];
                let t = (station_m - polyline.stations_m[index]) / span_m;
                let height_m =
                    polyline.heights_m[index] * (1.0 - t) + polyline.heights_m[index + 1] * t;
                let [p, q] = [polyline.positions[index], polyline.positions[index + 1]];
                (p.lerp(q, t), height_m)
            })
            .unzip();
        Self::with_positions(positions, heights_m)
    }

    fn with_positions(positions: Vec<DVec2>, heights_m: Vec<f64>) -> Self {
        let mut stations_m = Vec::with_capacity(positions.len());
        let mut station_m = 0.0;
        for (index, position) in positions.iter().enumerate() {
            if index > 0 {
                // Knots never coincide: a station has one place.
                station_m += position.distance(positions[index - 1]).max(1e-6);
            }
            stations_m.push(station_m);
        }
        Self {
            positions,
            heights_m,
            stations_m,
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

    fn bends() -> Vec<PathSegment> {
        [(40.0, 0.0, 0.0), (30.0, 90.0, 8.0), (40.0, -30.0, 0.0)]
            .map(|(length_m, turn_deg, grade_percent)| PathSegment {
                length_m,
                turn_deg,
                grade_percent,
            })
            .to_vec()
    }

    #[test]
    fn a_path_ends_with_the_heading_and_height_that_its_segments_add_up_to() {
        let path = Path::from_segments(&bends(), -1.73);
        let end = path.at(path.length_m());
        assert_relative_eq!(end.heading(), 60_f64.to_radians(), epsilon = 0.06);
        assert_relative_eq!(end.height_m, -1.73 + 2.4, epsilon = 1e-6);
        assert_relative_eq!(path.length_m(), 110.0, epsilon = 1.5);
    }

    #[test]
    fn position_and_heading_are_continuous() {
        let path = Path::from_segments(&bends(), 0.0);
        let mut previous = path.at(-5.0);
        for step in 1..=1200 {
            let point = path.at(-5.0 + 0.1 * f64::from(step));
            let moved_m = point.position.distance(previous.position);
            assert!((moved_m - 0.1).abs() < 0.01, "{moved_m}");
            assert!(previous.forward.angle_to(point.forward).abs() < 0.02);
            previous = point;
        }
    }

    #[test]
    fn recorded_poses_lie_on_their_path_at_their_stations() {
        let poses: Vec<Pose3> = (0..200)
            .map(|i| {
                // A stop in the middle, with the tremble of a receiver.
                let s = f64::from(if i < 100 { i } else { (i - 40).max(100) });
                let tremble = 0.01 * f64::from(i % 3);
                let position = Vector3::new(40.0 * (s / 40.0).sin(), tremble, 1.0);
                let bent = Vector3::new(position.x, 40.0 * (1.0 - (s / 40.0).cos()), 1.0);
                Pose3::new(bent, Vector3::zeros())
            })
            .collect();
        let (path, stations_m) = Path::from_poses(&poses, 1.73).unwrap();
        assert!(stations_m.is_sorted());
        for (pose, &station_m) in poses.iter().zip(&stations_m) {
            let point = path.at(station_m);
            let t = pose.translation.vector;
            let distance_m = point.position.distance(DVec2::new(t.x, t.y));
            assert!(distance_m < 0.8, "{distance_m}");
            assert_relative_eq!(point.height_m, 1.0 - 1.73, epsilon = 1e-9);
        }
    }

    #[test]
    fn poses_in_one_place_make_no_path() {
        assert_eq!(Path::from_poses(&[Pose3::identity(); 5], 1.73), None);
    }

    #[test]
    fn a_shifted_path_runs_beside() {
        let path = Path::from_segments(&bends(), 0.0);
        let left = path.shifted(3.0);
        for knot in left.knots() {
            let nearest_m = (0..=1100)
                .map(|i| path.at(0.1 * f64::from(i)).position.distance(knot.0))
                .fold(f64::INFINITY, f64::min);
            assert_relative_eq!(nearest_m, 3.0, epsilon = 0.05);
        }
    }
}
