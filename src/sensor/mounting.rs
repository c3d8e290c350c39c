//! Height of the sensor above the ground, and its tilt.
//!
//! The ground of each scan is segmented and a plane fitted to it ([`road_plane`]). A sensor that is tilted by
//! some degrees sees a slope; the points are therefore turned level by the first plane and segmented once more.

use glam::{Quat, Vec3};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::ground::{GroundClassifier, GroundConfig, RoadConfig, RoadPlane, road_plane};
use crate::lidar::Scan;

/// Height and tilt of a sensor: medians over the scans, and their spread.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Mounting {
    /// Height above the ground, along its normal [m].
    pub height_m: f64,
    /// Rotation about the x axis [rad].
    pub roll_rad: f64,
    /// Rotation about the y axis [rad].
    pub pitch_rad: f64,
    /// Median deviation of the height in single scans [m]; 0 of one scan.
    pub height_spread_m: f64,
    /// Median deviation of roll and pitch in single scans [rad]; 0 of one scan.
    pub tilt_spread_rad: f64,
}

/// Some scans with the ground around the sensor.
pub struct Surroundings<'a> {
    /// Points of each scan [m], and the plane of the ground if enough of it is visible.
    pub scans: Vec<(&'a [Vec3], Option<RoadPlane>)>,
}

impl<'a> Surroundings<'a> {
    /// Largest number of scans, spread over all.
    const MAX_SCANS: usize = 20;

    /// Finds the ground.
    pub fn of(scans: &'a [Scan]) -> Self {
        let step = scans.len().div_ceil(Self::MAX_SCANS).max(1);
        let scans = scans.iter().step_by(step);
        let Ok(classifier) = GroundConfig::default().classifier(None) else {
            return Self { scans: vec![] };
        };
        let with_ground = |scan: &'a Scan| {
            let points = scan.points.as_slice();
            (points, ground(points, classifier.as_ref()))
        };
        Self {
            scans: scans.map(with_ground).collect(),
        }
    }
}

fn ground(points: &[Vec3], classifier: &dyn GroundClassifier) -> Option<RoadPlane> {
    let road = RoadConfig::default();
    let first = road_plane(points, &classifier.ground_confidence(points), &road)?;
    let level_from_lidar = Quat::from_rotation_arc(first.up, Vec3::Z);
    let level: Vec<Vec3> = points
        .iter()
        .map(|&point| level_from_lidar * point)
        .collect();
    let second = road_plane(&level, &classifier.ground_confidence(&level), &road)?;
    Some(RoadPlane {
        up: level_from_lidar.inverse() * second.up,
        ..second
    })
}

/// Height and tilt; `None` if fewer than half of the scans show ground, or none.
pub fn find(surroundings: &Surroundings) -> Option<Mounting> {
    let scans = &surroundings.scans;
    let planes: Vec<RoadPlane> = scans.iter().filter_map(|&(_, plane)| plane).collect();
    if 2 * planes.len() < scans.len().max(1) {
        return None;
    }
    let [height, roll, pitch] = [
        spread(planes.iter().map(|plane| plane.height_m)),
        spread(
            planes
                .iter()
                .map(|plane| f64::from(plane.up.y.atan2(plane.up.z))),
        ),
        spread(planes.iter().map(|plane| f64::from((-plane.up.x).asin()))),
    ];
    Some(Mounting {
        height_m: height.0,
        roll_rad: roll.0,
        pitch_rad: pitch.0,
        height_spread_m: height.1,
        tilt_spread_rad: roll.1.max(pitch.1),
    })
}

/// Angle between z and the mean of directions up, and the median of the angles to this mean [rad]; `None` of none.
pub fn tilt(ups: &[Vector3<f64>]) -> Option<(f64, f64)> {
    let mean: Vector3<f64> = ups.iter().sum();
    let angles = ups.iter().map(|up| up.angle(&mean));
    (!ups.is_empty()).then(|| (mean.angle(&Vector3::z()), spread(angles).0))
}

/// Median, and median of the absolute deviations from it.
fn spread(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let median = |mut values: Vec<f64>| {
        values.sort_by(f64::total_cmp);
        values[values.len() / 2]
    };
    let values: Vec<f64> = values.collect();
    let middle = median(values.clone());
    (
        middle,
        median(values.iter().map(|value| (value - middle).abs()).collect()),
    )
}
