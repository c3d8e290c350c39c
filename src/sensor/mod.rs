//! What a sensor is, inferred from a few of its scans.
//!
//! | question | answer from |
//! |---|---|
//! | [`beams`] and their elevations | the rings of the points, else revolutions in the order of the points, else peaks of the elevations |
//! | [`columns`], field of view | differences of azimuth along a beam, empty azimuths |
//! | [`rotation`] and period | azimuth against time; times of scans |
//! | [`own_car`] | near returns above the ground that stay while everything else moves |
//! | [`mounting`] | ground segmentation and ground plane, per scan |
//! | [`projection`] | the above; limits of range from the ranges |
//!
//! [`dropped`] counts which points a projection loses, and why. Two returns of one pulse are two points of
//! one direction: they count once for beams and columns, and a range image keeps the nearer one.

mod beam;
pub mod beams;
pub mod columns;
mod config;
pub mod dropped;
mod elevations;
pub mod mounting;
pub mod own_car;
pub mod projection;
pub mod rotation;

use serde::{Deserialize, Serialize};

pub use beam::BeamReturns;
pub use beams::BeamSource;
pub use config::{MotionCompensation, RangeImageConfig, SensorConfig};
pub use dropped::{DropReason, DroppedPoints};
pub use mounting::Mounting;

use crate::lidar::{LidarModel, RotationDirection, Scan};

/// What is known about a sensor, and how surely.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SensorDescription {
    /// Projection: rows are the beams that returned, or pixels of about the spacing of the points if there
    /// are no rows.
    pub lidar: LidarModel,
    /// Whether each beam keeps its elevation, as those of spinning sensors do.
    pub has_rows: bool,
    /// Number of beams of the device, which may have more than returned; `None` without rows.
    pub beams: Option<usize>,
    /// What the beams follow from.
    pub beam_source: BeamSource,
    /// Azimuth steps per revolution; 0 without rows.
    pub columns: usize,
    /// Horizontal field of view [deg].
    pub horizontal_fov_deg: f32,
    /// Height over ground and tilt; `None` where too little ground is visible.
    pub mounting: Option<Mounting>,
    /// Rectangle of the lidar frame with returns of the own car: x_min, x_max, y_min, y_max [m]; all 0 if there
    /// are none.
    pub own_car_m: [f32; 4],
    /// Whether the scans show that the sensor moves, without which the own car is unknown.
    pub is_moving: bool,
    /// Duration of a revolution or frame [s]; `None` if no times tell.
    pub period_s: Option<f64>,
    /// Sense of rotation by the times of the points; `None` without times or revolutions.
    pub rotation: Option<RotationDirection>,
    /// Number of scans that it follows from.
    pub scans: usize,
}

/// Infers the sensor of some scans: one suffices for the beams, ten of a drive for the rest, better spread
/// over some seconds than neighbours.
pub fn infer(scans: &[Scan]) -> SensorDescription {
    let scans: Vec<Scan> = scans.iter().map(valid_points).collect();
    let scans: &[Scan] = &scans;
    let beams = beams::find(scans);
    let horizontal_fov_deg = columns::horizontal_fov_deg(scans);
    let columns = columns::count(&beams);
    let surroundings = mounting::Surroundings::of(scans);
    let own_car = own_car::find(&surroundings);
    let mounting = mounting::find(&surroundings);
    SensorDescription {
        lidar: projection::model(scans, &beams, columns, own_car.rectangle_m),
        has_rows: beams.source != BeamSource::None,
        beams: beams.nominal,
        beam_source: beams.source,
        columns,
        horizontal_fov_deg,
        mounting,
        own_car_m: own_car.rectangle_m,
        is_moving: own_car.is_moving,
        period_s: rotation::period_s(scans, horizontal_fov_deg),
        rotation: rotation::direction(scans, horizontal_fov_deg),
        scans: scans.len(),
    }
}

/// The points with a direction.
fn valid_points(scan: &Scan) -> Scan {
    /// Nearer points are marks of missing returns, and have no accurate direction [m].
    const NEAREST_M: f32 = 0.1;
    let any_range = LidarModel {
        min_range: NEAREST_M,
        max_range: f32::MAX,
        ..LidarModel::default()
    };
    let mut scan = scan.clone();
    scan.drop_invalid(&any_range);
    scan
}

#[cfg(test)]
mod tests;
