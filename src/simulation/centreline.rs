//! Centrelines of roads and lanes: smooth curves in the plane with a height profile.
//!
//! Knots every two metres, joined by a natural cubic spline, so that heading and curvature are continuous: a car does not turn
//! its wheels at once. A *station* is the arc length from the start of the centreline.

use glam::DVec2;
use serde::{Deserialize, Serialize};

use crate::geometry::Pose3;
use crate::validation::{InvalidValue, Validate, bounded, in_range};

/// Distance between knots [m].
const KNOT_SPACING_M: f64 = 2.0;

/// Standard deviation of the Gaussian that smooths the joints of segments and the noise of
/// recorded poses [m].
const SMOOTHING_M: f64 = 4.0;

/// Length of the shortest path that can be driven [m].
pub(super) const SHORTEST_M: f64 = 10.0;

/// A piece of the driven path: an arc (straight where `turn_deg` is 0) of constant grade.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PathSegment {
    /// Length of the arc [m].
    pub length_m: f64,
    /// Change of heading over the segment, positive to the left [deg].
    pub turn_deg: f64,
    /// Grade, negative downhill [m per 100 m].
    pub grade_percent: f64,
}

impl PathSegment {
    /// A segment of a length [m], change of heading [deg] and grade [%].
    pub const fn new(length_m: f64, turn_deg: f64, grade_percent: f64) -> Self {
        Self {
            length_m,
            turn_deg,
            grade_percent,
        }
    }
}

impl Default for PathSegment {
    /// Straight and level for 50 m.
    fn default() -> Self {
        Self::new(50.0, 0.0, 0.0)
    }
}

impl Validate for PathSegment {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("length_m", self.length_m, 0.1..=100_000.0)?;
        bounded("turn_deg", self.turn_deg)?;
        in_range("grade_percent", self.grade_percent, -100.0..=100.0)
    }
}

/// A point on a centreline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CentrelinePoint {
    /// Position [m].
    pub position: DVec2,
    /// Unit tangent.
    pub forward: DVec2,
    /// Height of the road [m].
    pub height_m: f64,
}

impl CentrelinePoint {
    /// Unit normal to the left.
    pub fn left(&self) -> DVec2 {
        self.forward.perp()
    }

    /// The position `lateral_m` to the left.
    pub fn beside(&self, lateral_m: f64) -> DVec2 {
        self.position + lateral_m * self.left()
    }
}

/// A knot of a centreline.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Knot {
    /// Position [m].
    pub position: DVec2,
    /// Height of the road [m].
    pub height_m: f64,
    /// Arc length from the start [m].
    pub station_m: f64,
    /// Derivative of the position with the station.
    tangent: DVec2,
}

/// A smooth curve through at least two knots.
#[derive(Clone, Debug, PartialEq)]
pub struct Centreline {
    /// The knots, their stations ascending from 0.
    pub knots: Vec<Knot>,
}

impl Centreline {
    /// Joins segments, starting at the origin along x at `height_m`; joints are smoothed.
    pub fn from_segments(segments: &[PathSegment], height_m: f64) -> Self {
        const STEP_M: f64 = 0.5;
        let (mut position, mut heading_rad, mut height_m) = (DVec2::ZERO, 0.0_f64, height_m);
        let mut points = vec![(position, height_m)];
        for segment in segments {
            let steps = (segment.length_m / STEP_M).round().max(1.0) as usize;
            let step_m = segment.length_m / steps as f64;
            let turn_rad = segment.turn_deg.to_radians() / steps as f64;
            for _ in 0..steps {
                position += step_m * DVec2::from_angle(heading_rad + 0.5 * turn_rad);
                heading_rad += turn_rad;
                height_m += step_m * segment.grade_percent / 100.0;
                points.push((position, height_m));
            }
        }
        Self::from_points(points).resampled().smoothed()
    }

    /// Follows recorded lidar poses (frame with z up) `sensor_height_m` above the road.
    /// Also returns the station of every pose [m]. `None` if the poses stay in one place.
    pub fn from_poses(poses: &[Pose3], sensor_height_m: f64) -> Option<(Self, Vec<f64>)> {
        let mut points: Vec<(DVec2, f64)> = Vec::new();
        let mut stations_m = Vec::with_capacity(poses.len());
        let (mut length_m, mut farthest_m) = (0.0, 0.0_f64);
        for pose in poses {
            let t = pose.translation.vector;
            let position = DVec2::new(t.x, t.y);
            let step_m = points.last().map(|(last, _)| position.distance(*last));
            let station_m = length_m + step_m.unwrap_or(0.0);
            // The recorded position of a stationary vehicle is noisy: it counts once it has moved.
            if step_m.is_none_or(|step_m| step_m > 0.5) {
                length_m = station_m;
                points.push((position, t.z - sensor_height_m));
            }
            farthest_m = farthest_m.max(station_m);
            stations_m.push(farthest_m);
        }
        if length_m < SHORTEST_M {
            return None;
        }
        let centreline = Self::from_points(points).resampled().smoothed();
        // Smoothing cuts corners a little: stations shrink with the length.
        let shrink = centreline.length_m() / length_m;
        let stations_m = stations_m.iter().map(|s| s * shrink).collect();
        Some((centreline, stations_m))
    }

    /// A straight line between two positions.
    pub fn straight(from: DVec2, to: DVec2) -> Self {
        Self::from_points([(from, 0.0), (to, 0.0)]).resampled()
    }

    /// The parallel curve `lateral_m` to the left.
    pub fn shifted(&self, lateral_m: f64) -> Self {
        Self::from_points(self.knots.iter().map(|knot| {
            let position = self.at(knot.station_m).beside(lateral_m);
            (position, knot.height_m)
        }))
    }

    /// The part between two stations, shifted to the left by `lateral_m`.
    pub fn section(&self, from_m: f64, to_m: f64, lateral_m: f64) -> Self {
        let pieces = ((to_m - from_m) / KNOT_SPACING_M).ceil().max(1.0) as usize;
        Self::from_points((0..=pieces).map(|piece| {
            let share = piece as f64 / pieces as f64;
            let point = self.at(from_m + (to_m - from_m) * share);
            (point.beside(lateral_m), point.height_m)
        }))
    }

    /// The same curve with straight and level extensions of `extra_m` at both ends.
    pub fn extended(&self, extra_m: f64) -> Self {
        let steps = (extra_m / KNOT_SPACING_M).ceil() as i32;
        let beyond = |end_m: f64, step: i32| {
            let end = self.at(end_m);
            let position = end.position + f64::from(step) * KNOT_SPACING_M * end.forward;
            (position, end.height_m)
        };
        let before = (-steps..0).map(|step| beyond(0.0, step));
        let after = (1..=steps).map(|step| beyond(self.length_m(), step));
        let knots = self.knots.iter().map(|knot| (knot.position, knot.height_m));
        Self::from_points(before.chain(knots).chain(after))
    }

    /// Length [m].
    pub fn length_m(&self) -> f64 {
        self.knots.last().map_or(0.0, |knot| knot.station_m)
    }

    /// The point at a station; beyond the ends the curve continues straight.
    pub fn at(&self, station_m: f64) -> CentrelinePoint {
        let inside_m = station_m.clamp(0.0, self.length_m());
        let (index, t) = self.locate(inside_m);
        let [before, after] = [&self.knots[index], &self.knots[index + 1]];
        let span_m = after.station_m - before.station_m;
        let (p, q) = (before.position, after.position);
        let [dp, dq] = [before, after].map(|knot| span_m * knot.tangent);
        let (t2, t3) = (t * t, t * t * t);
        let position = (2.0 * t3 - 3.0 * t2 + 1.0) * p
            + (t3 - 2.0 * t2 + t) * dp
            + (3.0 * t2 - 2.0 * t3) * q
            + (t3 - t2) * dq;
        let derivative =
            6.0 * (t2 - t) * (p - q) + (3.0 * t2 - 4.0 * t + 1.0) * dp + (3.0 * t2 - 2.0 * t) * dq;
        let forward = derivative.normalize_or(DVec2::X);
        CentrelinePoint {
            position: position + (station_m - inside_m) * forward,
            forward,
            height_m: before.height_m * (1.0 - t) + after.height_m * t,
        }
    }

    /// Index of the knot before a station, and the share of the way to the next knot.
    fn locate(&self, station_m: f64) -> (usize, f64) {
        let after = self
            .knots
            .partition_point(|knot| knot.station_m <= station_m);
        let index = after.clamp(1, self.knots.len() - 1) - 1;
        let from_m = self.knots[index].station_m;
        let span_m = self.knots[index + 1].station_m - from_m;
        (index, (station_m - from_m) / span_m)
    }

    /// The curve through knots that a Gaussian has smoothed.
    fn smoothed(&self) -> Self {
        let reach = (3.0 * SMOOTHING_M / KNOT_SPACING_M) as usize;
        let last = self.knots.len() - 1;
        Self::from_points((0..=last).map(|index| {
            // Symmetric windows leave the ends where they are.
            let reach = reach.min(index).min(last - index);
            let (mut position, mut height_m, mut sum) = (DVec2::ZERO, 0.0, 0.0);
            for neighbour in index - reach..=index + reach {
                let offset_m = (neighbour as f64 - index as f64) * KNOT_SPACING_M;
                let weight = (-0.5 * (offset_m / SMOOTHING_M).powi(2)).exp();
                position += weight * self.knots[neighbour].position;
                height_m += weight * self.knots[neighbour].height_m;
                sum += weight;
            }
            (position / sum, height_m / sum)
        }))
    }

    /// The curve through equally spaced points of the polyline through the knots.
    fn resampled(&self) -> Self {
        let pieces = (self.length_m() / KNOT_SPACING_M).round().max(1.0) as usize;
        Self::from_points((0..=pieces).map(|piece| {
            let (index, t) = self.locate(self.length_m() * piece as f64 / pieces as f64);
            let [p, q] = [&self.knots[index], &self.knots[index + 1]];
            let height_m = p.height_m * (1.0 - t) + q.height_m * t;
            (p.position.lerp(q.position, t), height_m)
        }))
    }

    /// The curve through points and heights.
    fn from_points(points: impl IntoIterator<Item = (DVec2, f64)>) -> Self {
        let mut knots: Vec<Knot> = Vec::new();
        for (position, height_m) in points {
            let station_m = knots.last().map_or(0.0, |last| {
                // Knots never coincide: a station has one position.
                last.station_m + position.distance(last.position).max(1e-6)
            });
            knots.push(Knot {
                position,
                height_m,
                station_m,
                tangent: DVec2::X,
            });
        }
        set_tangents(&mut knots);
        Self { knots }
    }
}

/// Sets the tangents of at least two knots to those of the natural cubic spline (de Boor, *A Practical Guide to Splines*, 1978,
/// chapter IV): with h the distance and d the slope between knots,
///
/// ```text
/// t₋ / h₋ + 2 (1 / h₋ + 1 / h₊) t + t₊ / h₊ = 3 (d₋ / h₋ + d₊ / h₊)
/// ```
fn set_tangents(knots: &mut [Knot]) {
    // Inverse distance to the next knot and slope; none beyond the ends.
    let spans: Vec<(f64, DVec2)> = (knots.windows(2))
        .map(|ends| {
            let inverse = 1.0 / (ends[1].station_m - ends[0].station_m);
            (inverse, inverse * (ends[1].position - ends[0].position))
        })
        .chain([(0.0, DVec2::ZERO)])
        .collect();
    let (mut before, mut eliminated) = ((0.0, DVec2::ZERO), (0.0, DVec2::ZERO));
    // Gaussian elimination downwards, then substitution upwards.
    let mut shares = Vec::with_capacity(knots.len());
    for (knot, &(inverse, slope)) in knots.iter_mut().zip(&spans) {
        let pivot = 2.0 * (before.0 + inverse) - before.0 * eliminated.0;
        let right = 3.0 * (before.0 * before.1 + inverse * slope);
        knot.tangent = (right - before.0 * eliminated.1) / pivot;
        eliminated = (inverse / pivot, knot.tangent);
        shares.push(eliminated.0);
        before = (inverse, slope);
    }
    for index in (0..knots.len() - 1).rev() {
        let next = knots[index + 1].tangent;
        knots[index].tangent -= shares[index] * next;
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

    const BENDS: [PathSegment; 3] = [
        PathSegment::new(40.0, 0.0, 0.0),
        PathSegment::new(30.0, 90.0, 8.0),
        PathSegment::new(40.0, -30.0, 0.0),
    ];

    #[test]
    fn a_centreline_ends_with_the_heading_and_height_of_its_segments() {
        let centreline = Centreline::from_segments(&BENDS, -1.73);
        let end = centreline.at(centreline.length_m());
        assert_relative_eq!(end.forward.to_angle(), 60_f64.to_radians(), epsilon = 0.06);
        assert_relative_eq!(end.height_m, -1.73 + 2.4, epsilon = 1e-6);
        assert_relative_eq!(centreline.length_m(), 110.0, epsilon = 1.5);
    }

    #[test]
    fn position_and_heading_are_continuous() {
        let centreline = Centreline::from_segments(&BENDS, 0.0);
        let mut previous = centreline.at(-5.0);
        for step in 1..=1200 {
            let point = centreline.at(-5.0 + 0.1 * f64::from(step));
            let moved_m = point.position.distance(previous.position);
            assert!((moved_m - 0.1).abs() < 0.01, "{moved_m}");
            assert!(previous.forward.angle_to(point.forward).abs() < 0.02);
            previous = point;
        }
    }

    #[test]
    fn an_arc_through_uneven_knots_has_its_curvature_everywhere() {
        let arc = (0..30).map(|knot| {
            let station_m = 2.0 * f64::from(knot) + 0.4 * f64::from(knot).sin();
            (20.0 * DVec2::from_angle(station_m / 20.0), 0.0)
        });
        let centreline = Centreline::from_points(arc);
        // The ends of the spline are straight.
        for step in 100..=450 {
            let [before, after] =
                [-0.005, 0.005].map(|off_m| centreline.at(0.1 * f64::from(step) + off_m).forward);
            assert_relative_eq!(before.angle_to(after) / 0.01, 0.05, max_relative = 0.02);
        }
    }

    #[test]
    fn recorded_poses_lie_on_their_centreline_at_their_stations() {
        let poses: Vec<Pose3> = (0..200)
            .map(|i| {
                // A stop in the middle, with the noise of a receiver.
                let s = f64::from(if i < 100 { i } else { (i - 40).max(100) });
                let noise = 0.01 * f64::from(i % 3);
                let position = Vector3::new(40.0 * (s / 40.0).sin(), noise, 1.0);
                let bent = Vector3::new(position.x, 40.0 * (1.0 - (s / 40.0).cos()), 1.0);
                Pose3::new(bent, Vector3::zeros())
            })
            .collect();
        let (centreline, stations_m) = Centreline::from_poses(&poses, 1.73).unwrap();
        assert!(stations_m.is_sorted());
        for (pose, &station_m) in poses.iter().zip(&stations_m) {
            let point = centreline.at(station_m);
            let t = pose.translation.vector;
            let distance_m = point.position.distance(DVec2::new(t.x, t.y));
            assert!(distance_m < 0.8, "{distance_m}");
            assert_relative_eq!(point.height_m, 1.0 - 1.73, epsilon = 1e-9);
        }
    }

    #[test]
    fn poses_in_one_place_make_no_centreline() {
        assert_eq!(Centreline::from_poses(&[Pose3::identity(); 5], 1.73), None);
    }

    #[test]
    fn a_shifted_centreline_is_parallel() {
        let centreline = Centreline::from_segments(&BENDS, 0.0);
        let left = centreline.shifted(3.0);
        for knot in &left.knots {
            let nearest_m = (0..=1100)
                .map(|i| {
                    centreline
                        .at(0.1 * f64::from(i))
                        .position
                        .distance(knot.position)
                })
                .fold(f64::INFINITY, f64::min);
            assert_relative_eq!(nearest_m, 3.0, epsilon = 0.05);
        }
    }
}
