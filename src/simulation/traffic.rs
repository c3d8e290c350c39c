//! Traffic: everything that moves along the street during a drive; every drive has its own.

use std::f64::consts::TAU;
use std::ops::Range;

use glam::DVec2;
use rand::{Rng, RngExt as _};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::builder::{LabelledMesh, MeshBuilder};
use super::ego_motion::{EgoMotion, SCAN_PERIOD_S};
use super::ground::GroundField;
use super::layout::{EXTENSION_M, random_side};
use super::vehicles::Vehicle;
use crate::validation::{InvalidValue, Validate, in_range, not_negative, require};

/// Distance from the lidar beyond which road users are not simulated [m].
const VISIBLE_M: f64 = 90.0;

/// Density of the traffic.
///
/// Defaults: a town in the afternoon.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct TrafficConfig {
    /// Whether a vehicle drives ahead during the whole drive.
    #[default(true)]
    pub has_lead_vehicle: bool,
    /// Mean distance between oncoming vehicles [m]; 0 for none.
    #[default(70.0)]
    pub oncoming_spacing_m: f64,
    /// Speed of oncoming vehicles [m/s].
    #[default(9.0)]
    pub oncoming_speed_m_s: f64,
    /// Cyclists per 100 m of path.
    #[default(1.0)]
    pub cyclists_per_100_m: f64,
    /// Pedestrians per 100 m of path.
    #[default(3.0)]
    pub pedestrians_per_100_m: f64,
    /// Time from which a lorry drives close on the left and occludes half of the view, a test of
    /// localization [s]; null: never.
    pub lorry_from_s: Option<f64>,
    /// Duration for which it does [s].
    #[default(3.0)]
    pub lorry_for_s: f64,
}

impl Validate for TrafficConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        not_negative("lorry_from_s", self.lorry_from_s.unwrap_or_default())?;
        not_negative("lorry_for_s", self.lorry_for_s)?;
        require(
            self.oncoming_spacing_m == 0.0 || (1.0..=1e6).contains(&self.oncoming_spacing_m),
            "oncoming_spacing_m",
            self.oncoming_spacing_m,
            "it must lie between 1 and 1000000; 0 is for none",
        )?;
        in_range("oncoming_speed_m_s", self.oncoming_speed_m_s, 0.0..=100.0)?;
        in_range("cyclists_per_100_m", self.cyclists_per_100_m, 0.0..=1000.0)?;
        in_range(
            "pedestrians_per_100_m",
            self.pedestrians_per_100_m,
            0.0..=1000.0,
        )
    }
}

/// Motion along the path.
#[derive(Clone, Debug, PartialEq)]
enum AlongPath {
    /// `gap_m` ahead of where the ego vehicle will be `headway_s` later, during a time interval.
    WithEgo {
        headway_s: f64,
        gap_m: f64,
        present_s: Range<f64>,
    },
    /// At a constant speed (negative: oncoming) from a station at time 0.
    Constant { start_m: f64, speed_m_s: f64 },
}

/// Position across the path.
#[derive(Clone, Copy, Debug, PartialEq)]
enum AcrossPath {
    /// Offset to the left of the path [m].
    Lane(f64),
    /// On the sidewalk of a side, at a distance from the kerb.
    Sidewalk { side: f64, kerb_m: f64 },
}

/// A vehicle or pedestrian with its motion.
#[derive(Clone, Debug)]
struct RoadUser {
    vehicle: Vehicle,
    along: AlongPath,
    across: AcrossPath,
}

/// Occludes what is left of the ego vehicle up to 75 degrees from its side.
const LORRY: Vehicle = Vehicle::Van {
    length_m: 17.0,
    height_m: 4.0,
    reflectance: 0.6,
};
/// Offset of the lorry to the left of the path [m].
const LORRY_LATERAL_M: f64 = 3.4;

/// The road users of a drive.
#[derive(Clone, Debug)]
pub struct Traffic(Vec<RoadUser>);

impl Traffic {
    /// Random traffic for a drive. Lanes are `lane_width_m` apart, the oncoming one on the left.
    pub fn new(
        ego: &EgoMotion,
        lane_width_m: f64,
        config: &TrafficConfig,
        rng: &mut impl Rng,
    ) -> Self {
        let duration_s = ego.stations_m.len() as f64 * SCAN_PERIOD_S;
        let length_m = ego.centreline.length_m();
        let mut road_users = Vec::new();
        let mut add = |vehicle, along, across| {
            road_users.push(RoadUser {
                vehicle,
                along,
                across,
            });
        };
        if config.has_lead_vehicle {
            let vehicle = Vehicle::random(0.5, rng);
            let along = AlongPath::WithEgo {
                headway_s: rng.random_range(0.5..1.2),
                gap_m: rng.random_range(8.0..14.0),
                present_s: f64::NEG_INFINITY..f64::INFINITY,
            };
            add(vehicle, along, AcrossPath::Lane(0.0));
        }
        if let Some(from_s) = config.lorry_from_s {
            let along = AlongPath::WithEgo {
                headway_s: 0.0,
                gap_m: 0.0,
                present_s: from_s..from_s + config.lorry_for_s,
            };
            add(LORRY, along, AcrossPath::Lane(LORRY_LATERAL_M));
        }
        if config.oncoming_spacing_m > 0.0 {
            let mut start_m = rng.random_range(0.2..1.0) * config.oncoming_spacing_m;
            while start_m < length_m + config.oncoming_speed_m_s * duration_s {
                let vehicle = Vehicle::random(0.2, rng);
                let speed_m_s = -config.oncoming_speed_m_s;
                let lateral_m = lane_width_m + rng.random_range(-0.15..0.2);
                let along = AlongPath::Constant { start_m, speed_m_s };
                add(vehicle, along, AcrossPath::Lane(lateral_m));
                start_m += config.oncoming_spacing_m * rng.random_range(0.4..1.6);
            }
        }
        let mut count = |per_100_m: f64| {
            let expected = per_100_m * length_m / 100.0;
            (expected + rng.random_range(0.0..1.0)).floor() as usize
        };
        let cyclists = count(config.cyclists_per_100_m);
        let pedestrians = count(config.pedestrians_per_100_m);
        // Starts are distributed so that the density is the same at the end of the drive.
        let constant = |speed_m_s: f64, station_m: f64| AlongPath::Constant {
            start_m: station_m - 0.5 * speed_m_s * duration_s,
            speed_m_s,
        };
        for _ in 0..cyclists {
            let is_oncoming = rng.random_bool(0.5);
            let speed_m_s = rng.random_range(3.0..6.0);
            let edge_m = 0.5 * lane_width_m - 0.3;
            let (speed_m_s, lateral_m) = if is_oncoming {
                (-speed_m_s, lane_width_m + edge_m)
            } else {
                (speed_m_s, -edge_m)
            };
            let along = constant(speed_m_s, rng.random_range(0.0..length_m));
            add(Vehicle::Cyclist, along, AcrossPath::Lane(lateral_m));
        }
        for _ in 0..pedestrians {
            let speed_m_s = rng.random_range(0.9..1.7) * random_side(rng);
            let along = constant(speed_m_s, rng.random_range(0.0..length_m));
            let across = AcrossPath::Sidewalk {
                side: random_side(rng),
                kerb_m: rng.random_range(0.7..1.5),
            };
            add(Vehicle::random_pedestrian(rng), along, across);
        }
        Self(road_users)
    }

    /// Surfaces of all road users near the ego vehicle at a time, world frame.
    pub fn surface_at(&self, time_s: f64, ego: &EgoMotion, ground: &GroundField) -> LabelledMesh {
        let mut target = LabelledMesh::default();
        let t = ego.world_from_lidar(ground, time_s).translation.vector;
        let ego_position = DVec2::new(t.x, t.y);
        let heading = ego.centreline.at(ego.station_m(time_s)).forward;
        for road_user in &self.0 {
            let Some((position, forward)) = road_user.pose_at(time_s, ego, ground) else {
                continue;
            };
            let offset = position - ego_position;
            let half_m = road_user.vehicle.half_size_m();
            // Where the path crosses itself, traffic of one passage does not collide with the ego
            // vehicle on the other.
            let is_colliding = offset.dot(heading).abs() < 2.5 + half_m.x
                && offset.dot(heading.perp()).abs() < 0.95 + half_m.y;
            if offset.length() > VISIBLE_M || is_colliding {
                continue;
            }
            let world_from_local = ground.tangent_frame(position, forward);
            let mut builder = MeshBuilder::new(&mut target, world_from_local);
            let stride_rad = (time_s * TAU * 0.9) as f32;
            road_user.vehicle.add_to(&mut builder, true, stride_rad);
        }
        target
    }
}

impl RoadUser {
    /// Position and direction; `None` beyond the street and where there is no sidewalk.
    fn pose_at(
        &self,
        time_s: f64,
        ego: &EgoMotion,
        ground: &GroundField,
    ) -> Option<(DVec2, DVec2)> {
        let (station_m, direction) = match &self.along {
            AlongPath::WithEgo {
                headway_s,
                gap_m,
                present_s,
            } => {
                let station_m = ego.station_m(time_s + headway_s) + gap_m;
                (present_s.contains(&time_s).then_some(station_m)?, 1.0)
            }
            AlongPath::Constant { start_m, speed_m_s } => {
                (start_m + speed_m_s * time_s, speed_m_s.signum())
            }
        };
        let margin_m = EXTENSION_M - 8.0;
        if station_m < -margin_m || station_m > ego.centreline.length_m() + margin_m {
            return None;
        }
        let point = ego.centreline.at(station_m);
        let lateral_m = match self.across {
            AcrossPath::Lane(lateral_m) => lateral_m,
            AcrossPath::Sidewalk { side, kerb_m } => {
                sidewalk_lateral_m(ego, ground, station_m, side, kerb_m)?
            }
        };
        Some((point.beside(lateral_m), direction * point.forward))
    }
}

/// Lateral offset of a position beyond the kerb, averaged over a few metres before and behind so
/// that pedestrians do not jump where a row of bays begins [m].
fn sidewalk_lateral_m(
    ego: &EgoMotion,
    ground: &GroundField,
    station_m: f64,
    side: f64,
    kerb_m: f64,
) -> Option<f64> {
    const LIMIT_M: f64 = 14.0;
    let sum_m: Option<f64> = (-3..=3)
        .map(|step| {
            let point = ego.centreline.at(station_m + f64::from(step));
            let position = ground.beyond_kerb(&point, side, kerb_m, LIMIT_M)?;
            Some((position - point.position).dot(point.left()))
        })
        .sum();
    Some(sum_m? / 7.0)
}
