//! Motion of the vehicle that carries the lidar: the sensor pose at any time of a drive.
//!
//! The vehicle stands with four wheels on the road; the lidar is mounted above it and pitches and
//! rolls with the suspension. Drives along the same street differ in lane offset, speed,
//! suspension and traffic.

use std::f64::consts::TAU;

use glam::DVec2;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt as _;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::centreline::Centreline;
use super::ground::{GroundField, GroundZone};
use super::random::{Purpose, stream};
use crate::geometry::Pose3;
use crate::validation::{InvalidValue, Validate, in_range, positive};

/// Time between two scans [s].
pub const SCAN_PERIOD_S: f64 = 0.1;
/// Half of the wheelbase [m].
const HALF_WHEELBASE_M: f64 = 1.35;
/// Half of the track width [m].
const HALF_TRACK_M: f64 = 0.75;
/// Lane offsets of the drives where the configuration gives none [m].
const LANE_OFFSETS_M: [f64; 5] = [0.0, 0.4, -0.4, 0.25, -0.25];

/// Motion of the vehicle.
///
/// Defaults: the vehicle of KITTI at a residential speed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct MotionConfig {
    /// Mean speed on a path of segments; a recorded path has its own [m/s].
    #[default(8.0)]
    pub speed_m_s: f64,
    /// Offset to the left of the path [m]; null: 0 for drive 1, then +0.4, -0.4, +0.25, -0.25.
    pub lane_offset_m: Option<f64>,
    /// Amplitude of the slow weaving about that offset [m].
    #[default(0.08)]
    pub weaving_m: f64,
    /// Height of the lidar above the road [m].
    #[default(1.73)]
    pub sensor_height_m: f64,
    /// Amplitude of the pitch of the suspension [deg].
    #[default(0.3)]
    pub nodding_deg: f64,
    /// Amplitude of the roll of the suspension [deg].
    #[default(0.2)]
    pub rolling_deg: f64,
    /// Amplitude of the heave of the suspension [m].
    #[default(0.01)]
    pub heaving_m: f64,
    /// First frame at which the vehicle is somewhere else without its odometry noticing (the
    /// kidnapped robot problem); null: never.
    pub kidnapped_at_frame: Option<usize>,
    /// Distance along the path by which it is then displaced [m].
    #[default(150.0)]
    pub kidnapped_by_m: f64,
}

impl Validate for MotionConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("speed_m_s", self.speed_m_s, 0.1..=100.0)?;
        let offset_m = self.lane_offset_m.unwrap_or_default();
        in_range("lane_offset_m", offset_m, -100.0..=100.0)?;
        in_range("weaving_m", self.weaving_m, 0.0..=10.0)?;
        in_range("sensor_height_m", self.sensor_height_m, 0.1..=100.0)?;
        in_range("nodding_deg", self.nodding_deg, 0.0..=45.0)?;
        in_range("rolling_deg", self.rolling_deg, 0.0..=45.0)?;
        in_range("heaving_m", self.heaving_m, 0.0..=1.0)?;
        positive("kidnapped_by_m", self.kidnapped_by_m)
    }
}

/// Station and lidar pose as functions of time.
#[derive(Clone, Debug)]
pub struct EgoMotion {
    /// Centreline of the driven path.
    pub centreline: Centreline,
    /// Station of the vehicle at each scan [m].
    pub stations_m: Vec<f64>,
    /// First frame after the vehicle was displaced, if it was.
    pub kidnapped_at: Option<usize>,
    config: MotionConfig,
    lane_offset_m: f64,
    phases_rad: [f64; 8],
}

impl EgoMotion {
    /// Drive number `drive` (from 1) along a centreline. `recorded_m` are the stations of a
    /// recorded drive, one per scan; without them the vehicle drives the whole length at the
    /// configured speed.
    pub fn new(
        centreline: Centreline,
        recorded_m: Option<&[f64]>,
        config: &MotionConfig,
        seed: u64,
        drive: u32,
    ) -> Self {
        let mut rng = stream(seed, Purpose::Drive, u64::from(drive));
        let phases_rad = std::array::from_fn(|_| rng.random_range(0.0..TAU));
        let mut stations_m = match recorded_m {
            Some(recorded_m) => replayed(recorded_m, drive, phases_rad[0]),
            None => cruising(centreline.length_m(), config.speed_m_s, phases_rad[0]),
        };
        let kidnapped_at = config
            .kidnapped_at_frame
            .filter(|&frame| skip_ahead(&mut stations_m, frame, config.kidnapped_by_m));
        let default_m = LANE_OFFSETS_M[(drive.max(1) as usize - 1) % LANE_OFFSETS_M.len()];
        Self {
            centreline,
            stations_m,
            kidnapped_at,
            config: config.clone(),
            lane_offset_m: config.lane_offset_m.unwrap_or(default_m),
            phases_rad,
        }
    }

    /// Station on the path [m]; before the first and after the last scan the vehicle stands still.
    pub fn station_m(&self, time_s: f64) -> f64 {
        let index = time_s / SCAN_PERIOD_S;
        if let Some(kidnapped_at) = self.kidnapped_at
            && index > (kidnapped_at - 1) as f64
            && index < kidnapped_at as f64
        {
            // Until it is displaced it continues at its speed.
            let last_m = self.stations_m[kidnapped_at - 1];
            let step_m = last_m - self.stations_m[kidnapped_at - 2];
            return last_m + (index - (kidnapped_at - 1) as f64) * step_m;
        }
        interpolate(&self.stations_m, index)
    }

    /// Lidar pose at a time: `p_world = world_from_lidar * p_lidar`. Before the first and after the last scan the motion is
    /// mirrored at that scan, so that the velocity is continuous there.
    pub fn world_from_lidar(&self, ground: &GroundField, time_s: f64) -> Pose3 {
        let last_s = self.stations_m.len().saturating_sub(1) as f64 * SCAN_PERIOD_S;
        let end_s = time_s.clamp(0.0, last_s);
        if end_s == time_s {
            return self.inside(ground, time_s);
        }
        let [end, mirrored] = [end_s, 2.0 * end_s - time_s].map(|s| self.inside(ground, s));
        end * mirrored.inverse() * end
    }

    /// Lidar pose at a time of the drive.
    fn inside(&self, ground: &GroundField, time_s: f64) -> Pose3 {
        let station_m = self.station_m(time_s);
        let point = self.centreline.at(station_m);
        let lateral_m = |station_m: f64| {
            let phase_rad = TAU * station_m / 43.0 + self.phases_rad[1];
            self.lane_offset_m + self.config.weaving_m * phase_rad.sin()
        };
        let weaving_rad = (lateral_m(station_m + 0.5) - lateral_m(station_m - 0.5)).atan();
        let forward = DVec2::from_angle(weaving_rad).rotate(point.forward);
        let position = point.beside(lateral_m(station_m));
        world_from_body(ground, position, forward) * self.body_from_lidar(time_s)
    }

    /// The suspension: two oscillations of incommensurable periods each for pitch, roll and heave.
    fn body_from_lidar(&self, time_s: f64) -> Pose3 {
        let oscillation = |period_s: f64, phase: usize| {
            let slow = (TAU * time_s / period_s + self.phases_rad[phase]).sin();
            let fast = (TAU * time_s / (0.37 * period_s) + self.phases_rad[phase + 1]).sin();
            0.65 * slow + 0.35 * fast
        };
        let config = &self.config;
        let pitch_rad = config.nodding_deg.to_radians() * oscillation(1.9, 2);
        let roll_rad = config.rolling_deg.to_radians() * oscillation(2.7, 4);
        let height_m = config.sensor_height_m + config.heaving_m * oscillation(1.3, 6);
        Pose3::from_parts(
            Translation3::new(0.0, 0.0, height_m),
            UnitQuaternion::from_euler_angles(roll_rad, pitch_rad, 0.0),
        )
    }
}

/// Pose of the vehicle body on four wheels: origin on the ground, z along the normal of the road.
fn world_from_body(ground: &GroundField, position: DVec2, forward: DVec2) -> Pose3 {
    let left = forward.perp();
    let height_m = |along: f64, across: f64| {
        let wheel = position + along * HALF_WHEELBASE_M * forward + across * HALF_TRACK_M * left;
        f64::from(ground.zone_height_m(&ground.at(wheel), GroundZone::Carriageway))
    };
    let (fl, fr) = (height_m(1.0, 1.0), height_m(1.0, -1.0));
    let (rl, rr) = (height_m(-1.0, 1.0), height_m(-1.0, -1.0));
    let climb = (fl + fr - rl - rr) / (4.0 * HALF_WHEELBASE_M);
    let bank = (fl + rl - fr - rr) / (4.0 * HALF_TRACK_M);
    let along = Vector3::new(forward.x, forward.y, climb).normalize();
    let up = along.cross(&Vector3::new(left.x, left.y, bank)).normalize();
    let axes = Matrix3::from_columns(&[along, up.cross(&along), up]);
    Pose3::from_parts(
        Translation3::new(position.x, position.y, 0.25 * (fl + fr + rl + rr)),
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes)),
    )
}

/// Removes the stations from `frame` on that are less than `by_m` ahead of the frame before.
/// Returns `false` and removes nothing if the drive ends before that or has fewer than two frames
/// before `frame`.
fn skip_ahead(stations_m: &mut Vec<f64>, frame: usize, by_m: f64) -> bool {
    if frame < 2 || frame > stations_m.len() {
        return false;
    }
    let target_m = stations_m[frame - 1] + by_m;
    let Some(next) = (frame..stations_m.len()).find(|&later| stations_m[later] >= target_m) else {
        return false;
    };
    stations_m.drain(frame..next);
    true
}

/// Stations of a vehicle that drives the whole length at a slowly varying speed [m].
fn cruising(length_m: f64, speed_m_s: f64, phase_rad: f64) -> Vec<f64> {
    let mut stations_m = Vec::new();
    let mut station_m = 0.15 * SCAN_PERIOD_S * speed_m_s * phase_rad;
    while station_m <= length_m {
        stations_m.push(station_m);
        let speed_m_s = speed_m_s * (1.0 + 0.2 * (TAU * station_m / 60.0 + phase_rad).sin());
        station_m += speed_m_s * SCAN_PERIOD_S;
    }
    stations_m
}

/// Stations of a recorded drive [m]; from drive 2 on its time is stretched and compressed by at
/// most a quarter.
fn replayed(recorded_m: &[f64], drive: u32, phase_rad: f64) -> Vec<f64> {
    const PERIOD: f64 = 370.0;
    const AMPLITUDE: f64 = 14.0;
    if drive <= 1 {
        return recorded_m.to_vec();
    }
    (0..recorded_m.len())
        .map(|frame| {
            let frame = frame as f64;
            let shift = AMPLITUDE * (TAU * frame / PERIOD + phase_rad).sin();
            interpolate(recorded_m, frame + shift)
        })
        .collect()
}

/// Linear interpolation in a table, constant beyond its ends.
fn interpolate(table: &[f64], index: f64) -> f64 {
    let last = table.len().saturating_sub(1);
    let below = (index.max(0.0) as usize).min(last);
    let above = (below + 1).min(last);
    let share = (index - below as f64).clamp(0.0, 1.0);
    table
        .get(below)
        .zip(table.get(above))
        .map_or(0.0, |(a, b)| a + (b - a) * share)
}
