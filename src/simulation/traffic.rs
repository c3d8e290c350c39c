//! What moves on the street while the sensor passes; every drive has its own.

use glam::DVec2;
use rand::RngExt as _;
use serde::{Deserialize, Serialize};

use super::builder::{Builder, Paint, PaintedMesh};
use super::classes;
use super::drive::{Drive, SCAN_PERIOD_S};
use super::ground::Ground;
use super::path::Path;
use super::random::{Purpose, stream};
use super::street::{PROLONGATION_M, lying_on};
use super::vehicles::Vehicle;

/// Things farther from the lidar are not simulated [m].
const VISIBLE_M: f64 = 90.0;

/// How much traffic there is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrafficConfig {
    /// Whether a vehicle drives ahead all the way.
    pub has_lead_vehicle: bool,
    /// Mean distance between oncoming vehicles [m]; 0 for none.
    pub oncoming_spacing_m: f64,
    /// Of oncoming vehicles [m/s].
    pub oncoming_speed_m_s: f64,
    /// Cyclists per 100 m of path.
    pub cyclists_per_100_m: f64,
    /// Pedestrians per 100 m of path.
    pub pedestrians_per_100_m: f64,
    /// From this time on a lorry drives close on the left and hides half of the view [s]: a trial
    /// for a localization; null: never.
    pub lorry_from_s: Option<f64>,
    /// For how long [s].
    pub lorry_for_s: f64,
}

impl Default for TrafficConfig {
    /// A town in the afternoon.
    fn default() -> Self {
        Self {
            has_lead_vehicle: true,
            oncoming_spacing_m: 70.0,
            oncoming_speed_m_s: 9.0,
            cyclists_per_100_m: 1.0,
            pedestrians_per_100_m: 3.0,
            lorry_from_s: None,
            lorry_for_s: 3.0,
        }
    }
}

impl TrafficConfig {
    /// An empty street.
    pub const NONE: Self = Self {
        has_lead_vehicle: false,
        oncoming_spacing_m: 0.0,
        oncoming_speed_m_s: 0.0,
        cyclists_per_100_m: 0.0,
        pedestrians_per_100_m: 0.0,
        lorry_from_s: None,
        lorry_for_s: 0.0,
    };
}

/// How something moves along the path.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Track {
    /// Where the car will be `ahead_s` later, and `gap_m` farther.
    Ahead { ahead_s: f64, gap_m: f64 },
    /// From a station at a speed (negative: oncoming), to the left of the path.
    Lane {
        start_m: f64,
        speed_m_s: f64,
        lateral_m: f64,
    },
    /// Beside the car for some time, to its left.
    Beside {
        from_s: f64,
        until_s: f64,
        lateral_m: f64,
    },
    /// On the pavement of a side, beyond the kerb.
    Pavement {
        start_m: f64,
        speed_m_s: f64,
        side: f64,
        kerb_m: f64,
    },
}

/// Hides what is left of the car up to 75 degrees from its side.
const LORRY: Vehicle = Vehicle::Van {
    length_m: 17.0,
    height_m: 4.0,
    reflectance: 0.6,
};
/// Where it drives, from the path [m].
const LORRY_LATERAL_M: f64 = 3.4;

/// Everything that moves during a drive.
#[derive(Clone, Debug)]
pub struct Traffic {
    path: Path,
    movers: Vec<(Vehicle, Track)>,
}

impl Traffic {
    /// Traffic for a drive. Lanes are `lane_width_m` apart, the oncoming one on the left.
    pub fn new(
        drive: &Drive,
        path: &Path,
        lane_width_m: f64,
        config: &TrafficConfig,
        (seed, number): (u64, u32),
    ) -> Self {
        let mut rng = stream(seed, Purpose::Traffic, u64::from(number));
        let duration_s = drive.frames() as f64 * SCAN_PERIOD_S;
        let length_m = path.length_m();
        let mut movers = Vec::new();
        if config.has_lead_vehicle {
            let vehicle = if rng.random_bool(0.5) {
                Vehicle::random_van(&mut rng)
            } else {
                Vehicle::random_car(&mut rng)
            };
            let track = Track::Ahead {
                ahead_s: rng.random_range(0.5..1.2),
                gap_m: rng.random_range(8.0..14.0),
            };
            movers.push((vehicle, track));
        }
        if let Some(from_s) = config.lorry_from_s {
            let track = Track::Beside {
                from_s,
                until_s: from_s + config.lorry_for_s,
                lateral_m: LORRY_LATERAL_M,
            };
            movers.push((LORRY, track));
        }
        if config.oncoming_spacing_m > 0.0 {
            let mut start_m = rng.random_range(0.2..1.0) * config.oncoming_spacing_m;
            while start_m < length_m + config.oncoming_speed_m_s * duration_s {
                let vehicle = if rng.random_bool(0.2) {
                    Vehicle::random_van(&mut rng)
                } else {
                    Vehicle::random_car(&mut rng)
                };
                let track = Track::Lane {
                    start_m,
                    speed_m_s: -config.oncoming_speed_m_s,
                    lateral_m: lane_width_m + rng.random_range(-0.15..0.2),
                };
                movers.push((vehicle, track));
                start_m += config.oncoming_spacing_m * rng.random_range(0.4..1.6);
            }
        }
        let mut count = |per_100_m: f64| {
            let expected = per_100_m * length_m / 100.0;
            (expected + rng.random_range(0.0..1.0)).floor() as usize
        };
        let (cyclists, pedestrians) = (
            count(config.cyclists_per_100_m),
            count(config.pedestrians_per_100_m),
        );
        for _ in 0..cyclists {
            let is_oncoming = rng.random_bool(0.5);
            let speed_m_s = rng.random_range(3.0..6.0);
            let edge_m = 0.5 * lane_width_m - 0.3;
            let (speed_m_s, lateral_m) = if is_oncoming {
                (-speed_m_s, lane_width_m + edge_m)
            } else {
                (speed_m_s, -edge_m)
            };
            // Spread so that the street is as full at the end of the drive as at its start.
            let start_m = rng.random_range(0.0..length_m) - 0.5 * speed_m_s * duration_s;
            let track = Track::Lane {
                start_m,
                speed_m_s,
                lateral_m,
            };
            movers.push((Vehicle::Cyclist, track));
        }
        for _ in 0..pedestrians {
            let speed_m_s =
                rng.random_range(0.9..1.7) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            let track = Track::Pavement {
                start_m: rng.random_range(0.0..length_m) - 0.5 * speed_m_s * duration_s,
                speed_m_s,
                side: if rng.random_bool(0.5) { 1.0 } else { -1.0 },
                kerb_m: rng.random_range(0.7..1.5),
            };
            movers.push((Vehicle::random_pedestrian(&mut rng), track));
        }
        Self {
            path: path.clone(),
            movers,
        }
    }

    /// The surfaces of all that is near the car at a time, world frame.
    pub fn surface_at(&self, time_s: f64, drive: &Drive, ground: &Ground) -> PaintedMesh {
        let mut target = PaintedMesh::default();
        let t = drive.world_from_lidar(ground, time_s).translation.vector;
        let car = DVec2::new(t.x, t.y);
        let heading = self.path.at(drive.station_m(time_s)).forward;
        for (vehicle, track) in &self.movers {
            let Some((position, forward)) = self.place(track, time_s, drive, ground) else {
                continue;
            };
            let offset = position - car;
            let [half_length_m, half_width_m] = vehicle.half_size_m();
            // Where the path meets itself, traffic of one passage makes way for the car on another.
            let is_in_the_way = offset.dot(heading).abs() < 2.5 + half_length_m
                && offset.dot(heading.perp()).abs() < 0.95 + half_width_m;
            if offset.length() > VISIBLE_M || is_in_the_way {
                continue;
            }
            let primer = Paint {
                class: classes::OTHER_OBJECT,
                reflectance: 0.5,
            };
            let mut builder =
                Builder::new(&mut target, lying_on(ground, position, forward), primer);
            let stride = (time_s * std::f64::consts::TAU * 0.9) as f32;
            vehicle.add_to(&mut builder, true, stride);
        }
        target
    }

    /// Position and direction; `None` beyond the street and where there is no pavement.
    fn place(
        &self,
        track: &Track,
        time_s: f64,
        drive: &Drive,
        ground: &Ground,
    ) -> Option<(DVec2, DVec2)> {
        let (station_m, sense) = match *track {
            Track::Ahead { ahead_s, gap_m } => (drive.station_m(time_s + ahead_s) + gap_m, 1.0),
            Track::Beside {
                from_s, until_s, ..
            } => {
                if !(from_s..until_s).contains(&time_s) {
                    return None;
                }
                (drive.station_m(time_s), 1.0)
            }
            Track::Lane {
                start_m, speed_m_s, ..
            }
            | Track::Pavement {
                start_m, speed_m_s, ..
            } => (start_m + speed_m_s * time_s, speed_m_s.signum()),
        };
        let margin_m = PROLONGATION_M - 8.0;
        if station_m < -margin_m || station_m > self.path.length_m() + margin_m {
            return None;
        }
        let point = self.path.at(station_m);
        let position = match *track {
            Track::Ahead { .. } => point.position,
            Track::Lane { lateral_m, .. } | Track::Beside { lateral_m, .. } => {
                point.beside(lateral_m)
            }
            Track::Pavement { side, kerb_m, .. } => {
                self.on_pavement(ground, station_m, side, kerb_m)?
            }
        };
        Some((position, sense * point.forward))
    }

    /// The mean of the places beyond the kerb a few metres before and behind, because nobody
    /// jumps where a row of bays begins.
    fn on_pavement(
        &self,
        ground: &Ground,
        station_m: f64,
        side: f64,
        kerb_m: f64,
    ) -> Option<DVec2> {
        const LIMIT_M: f64 = 14.0;
        let lateral_m = (-3..=3)
            .map(|step| {
                let point = self.path.at(station_m + f64::from(step));
                let place = ground.beside(&point, side, kerb_m, LIMIT_M)?;
                Some((place - point.position).dot(point.left()))
            })
            .sum::<Option<f64>>()?
            / 7.0;
        Some(self.path.at(station_m).beside(lateral_m))
    }
}
