//! A drive along the street: where the lidar is at any time.
//!
//! The car stands with four wheels on the road; the lidar hangs over it and nods with the
//! suspension. Drives of the same street differ in lane offset, speed, nodding and traffic.

use std::f64::consts::TAU;

use glam::DVec2;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt as _;
use serde::{Deserialize, Serialize};

use super::ground::{Ground, Surface};
use super::path::Path;
use super::random::{Purpose, stream};
use crate::geometry::Pose3;

/// Time between two scans [s].
pub const SCAN_PERIOD_S: f64 = 0.1;
/// Half of the wheelbase and of the track [m].
const HALF_WHEELBASE_M: f64 = 1.35;
const HALF_TRACK_M: f64 = 0.75;
/// Lane offsets of the drives where the configuration gives none [m].
const LANE_OFFSETS_M: [f64; 5] = [0.0, 0.4, -0.4, 0.25, -0.25];

/// How the car drives.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MotionConfig {
    /// Mean speed on a path of segments; a recorded path has its own [m/s].
    pub speed_m_s: f64,
    /// To the left of the path [m]; null: 0 for drive 1, then +0.4, -0.4, +0.25, -0.25.
    pub lane_offset_m: Option<f64>,
    /// Slow weaving about that offset [m].
    pub weaving_m: f64,
    /// Of the lidar over the road [m].
    pub sensor_height_m: f64,
    /// Amplitude of the nodding of the car [deg].
    pub nodding_deg: f64,
    /// Amplitude of the rolling of the car [deg].
    pub rolling_deg: f64,
    /// Amplitude of the heaving of the car [m].
    pub heaving_m: f64,
    /// From this frame on the car is somewhere else, and its odometry did not notice: a trial for
    /// a localization; null: never.
    pub kidnapped_at_frame: Option<usize>,
    /// How far ahead on the path it is set then [m].
    pub kidnapped_by_m: f64,
}

impl Default for MotionConfig {
    /// KITTI's car at a residential pace.
    fn default() -> Self {
        Self {
            speed_m_s: 8.0,
            lane_offset_m: None,
            weaving_m: 0.08,
            sensor_height_m: 1.73,
            nodding_deg: 0.3,
            rolling_deg: 0.2,
            heaving_m: 0.01,
            kidnapped_at_frame: None,
            kidnapped_by_m: 150.0,
        }
    }
}

/// A drive: station and lidar pose as functions of time.
#[derive(Clone, Debug)]
pub struct Drive {
    path: Path,
    motion: MotionConfig,
    lane_offset_m: f64,
    /// Station at every scan [m].
    stations_m: Vec<f64>,
    /// The first frame after the car was set somewhere else.
    kidnapped_at: Option<usize>,
    phases: [f64; 8],
}

impl Drive {
    /// Drive number `drive` (from 1) along a path. `recorded_m` are the stations of a recorded
    /// drive, one per scan; without them the car goes from one end to the other at its speed.
    pub fn new(
        path: &Path,
        recorded_m: Option<&[f64]>,
        motion: &MotionConfig,
        seed: u64,
        drive: u32,
    ) -> Self {
        let mut rng = stream(seed, Purpose::Drive, u64::from(drive));
        let phases = std::array::from_fn(|_| rng.random_range(0.0..TAU));
        let mut stations_m = match recorded_m {
            Some(recorded_m) => replayed(recorded_m, drive, phases[0]),
            None => cruising(path.length_m(), motion.speed_m_s, phases[0]),
        };
        let kidnapped_at = motion
            .kidnapped_at_frame
            .filter(|&frame| leap(&mut stations_m, frame, motion.kidnapped_by_m));
        let default_m = LANE_OFFSETS_M[(drive.max(1) as usize - 1) % LANE_OFFSETS_M.len()];
        Self {
            path: path.clone(),
            motion: motion.clone(),
            lane_offset_m: motion.lane_offset_m.unwrap_or(default_m),
            stations_m,
            kidnapped_at,
            phases,
        }
    }

    /// The first frame after the car was set somewhere else, if it was.
    pub fn kidnapped_at(&self) -> Option<usize> {
        self.kidnapped_at
    }

    /// Number of scans.
    pub fn frames(&self) -> usize {
        self.stations_m.len()
    }

    /// Drops the frames from `frames` on.
    pub fn truncate(&mut self, frames: usize) {
        self.stations_m.truncate(frames);
    }

    /// Station of the car on the path [m]; before the first and after the last scan it stands.
    pub fn station_m(&self, time_s: f64) -> f64 {
        let index = time_s / SCAN_PERIOD_S;
        if let Some(leap) = self.kidnapped_at
            && index > (leap - 1) as f64
            && index < leap as f64
        {
            // It drives on as before until it is taken away.
            let [before_m, last_m] = [leap - 2, leap - 1].map(|frame| self.stations_m[frame]);
            return last_m + (index - (leap - 1) as f64) * (last_m - before_m);
        }
        interpolated(&self.stations_m, time_s / SCAN_PERIOD_S)
    }

    /// `p_world = world_from_lidar * p_lidar` at a time.
    pub fn world_from_lidar(&self, ground: &Ground, time_s: f64) -> Pose3 {
        let station_m = self.station_m(time_s);
        let point = self.path.at(station_m);
        let lateral_m = |station_m: f64| {
            self.lane_offset_m
                + self.motion.weaving_m * (TAU * station_m / 43.0 + self.phases[1]).sin()
        };
        let weaving_rad = (lateral_m(station_m + 0.5) - lateral_m(station_m - 0.5)).atan();
        let forward = DVec2::from_angle(weaving_rad).rotate(point.forward);
        let on_road = standing_on(ground, point.beside(lateral_m(station_m)), forward);
        on_road * self.road_from_lidar(time_s)
    }

    /// The suspension: two oscillations of incommensurable periods for each of nod, roll, heave.
    fn road_from_lidar(&self, time_s: f64) -> Pose3 {
        let swing = |period_s: f64, phase: usize| {
            let slow = (TAU * time_s / period_s + self.phases[phase]).sin();
            let fast = (TAU * time_s / (0.37 * period_s) + self.phases[phase + 1]).sin();
            0.65 * slow + 0.35 * fast
        };
        let motion = &self.motion;
        let nod_rad = motion.nodding_deg.to_radians() * swing(1.9, 2);
        let roll_rad = motion.rolling_deg.to_radians() * swing(2.7, 4);
        let height_m = motion.sensor_height_m + motion.heaving_m * swing(1.3, 6);
        Pose3::from_parts(
            Translation3::new(0.0, 0.0, height_m),
            UnitQuaternion::from_euler_angles(roll_rad, nod_rad, 0.0),
        )
    }
}

/// The pose of a car body on the road: origin on the ground, z along its normal.
fn standing_on(ground: &Ground, position: DVec2, forward: DVec2) -> Pose3 {
    let left = forward.perp();
    let height_m = |along: f64, across: f64| {
        let place = position + along * HALF_WHEELBASE_M * forward + across * HALF_TRACK_M * left;
        f64::from(ground.surface_height_m(&ground.at(place), Surface::Carriageway))
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

/// Leaves out what lies `by_m` ahead from `frame` on; `false`, and nothing done, where the path
/// ends before that or the drive has not begun.
fn leap(stations_m: &mut Vec<f64>, frame: usize, by_m: f64) -> bool {
    let Some(&last_m) = frame.checked_sub(1).and_then(|last| stations_m.get(last)) else {
        return false;
    };
    let landing = (frame..stations_m.len()).find(|&later| stations_m[later] >= last_m + by_m);
    match landing {
        Some(landing) if frame >= 2 => {
            stations_m.drain(frame..landing);
            true
        }
        _ => false,
    }
}

/// Stations of a car that goes along the whole path, a little faster and slower by turns.
fn cruising(length_m: f64, speed_m_s: f64, phase: f64) -> Vec<f64> {
    let mut stations_m = Vec::new();
    let mut station_m = 0.15 * SCAN_PERIOD_S * speed_m_s * phase;
    while station_m <= length_m {
        stations_m.push(station_m);
        let speed_m_s = speed_m_s * (1.0 + 0.2 * (TAU * station_m / 60.0 + phase).sin());
        station_m += speed_m_s * SCAN_PERIOD_S;
    }
    stations_m
}

/// Stations of a recorded drive; from drive 2 on its time runs faster and slower by turns.
fn replayed(recorded_m: &[f64], drive: u32, phase: f64) -> Vec<f64> {
    if drive <= 1 {
        return recorded_m.to_vec();
    }
    // At most a quarter faster or slower.
    let (period, swing) = (370.0, 14.0);
    (0..recorded_m.len())
        .map(|frame| {
            let frame = frame as f64;
            interpolated(
                recorded_m,
                frame + swing * (TAU * frame / period + phase).sin(),
            )
        })
        .collect()
}

/// Linear interpolation in a table, constant beyond its ends.
fn interpolated(table: &[f64], index: f64) -> f64 {
    let last = table.len().saturating_sub(1);
    let below = (index.max(0.0) as usize).min(last);
    let above = (below + 1).min(last);
    let share = (index - below as f64).clamp(0.0, 1.0);
    table
        .get(below)
        .zip(table.get(above))
        .map_or(0.0, |(a, b)| a + (b - a) * share)
}
