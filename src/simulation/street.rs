//! The street: ground, houses, furniture, plants and parked cars as one mesh with a class per
//! triangle. It depends on its seed and its path alone; every drive finds the same street.

use glam::{DVec2, Mat3, Vec3};
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::builder::{Builder, Paint, PaintedMesh};
use super::buildings::{HouseShape, add_garage, add_house};
use super::classes;
use super::furniture::{Barrier, add_box, add_bush, add_lamp, add_monument, add_sign, add_tree};
use super::ground::{Ground, GroundConfig};
use super::ground_mesh::ground_mesh;
use super::layout::{BAY_WIDTH_M, Footprint, Layout, Occupancy, Road};
use super::path::{Path, PathPoint};
use super::random::{Purpose, stream};
use super::vehicles::Vehicle;
use crate::geometry::{Rigid3f, TriangleMesh};

/// The street goes on for this far before and behind the path that is driven [m].
pub const PROLONGATION_M: f64 = 40.0;

/// What stands along the street.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StreetConfig {
    /// Of each of the two lanes [m].
    pub lane_width_m: f64,
    /// Mean distance between side streets [m].
    pub side_street_spacing_m: f64,
    /// Whether there is an open square beside the road.
    pub has_square: bool,
    /// Share of the frontage that is built on.
    pub built_share: f64,
    /// Share of the parking bays that are taken.
    pub parked_share: f64,
    /// Mean distance between street lamps on one side [m].
    pub lamp_spacing_m: f64,
    /// Trees and bushes per 100 m of each side.
    pub plants_per_100_m: f64,
    /// The cross-section.
    pub ground: GroundConfig,
}

impl Default for StreetConfig {
    /// A residential street.
    fn default() -> Self {
        Self {
            lane_width_m: 3.3,
            side_street_spacing_m: 75.0,
            has_square: true,
            built_share: 0.93,
            parked_share: 0.75,
            lamp_spacing_m: 32.0,
            plants_per_100_m: 16.0,
            ground: GroundConfig::default(),
        }
    }
}

/// The static world and its ground truth.
#[derive(Clone, Debug)]
pub struct Street {
    /// Every surface, world frame (z up, the path begins near the origin).
    pub mesh: TriangleMesh,
    /// SemanticKITTI class of each triangle.
    pub classes: Vec<u16>,
    /// Share of light returned at normal incidence, of each triangle, 0 to 1.
    pub reflectances: Vec<f32>,
    /// Heights and borders of the ground.
    pub ground: Ground,
    /// The line that is driven, world frame.
    pub path: Path,
}

impl Street {
    /// Builds the street along a path.
    pub fn new(path: &Path, config: &StreetConfig, seed: u64) -> Self {
        let line = path.prolonged(PROLONGATION_M);
        let layout = Layout::new(&line, config, &mut stream(seed, Purpose::Layout, 0));
        let ground = Ground::new(
            std::slice::from_ref(&line),
            &layout.pavings(),
            &config.ground,
            seed,
        );
        let mut site = Site {
            surface: ground_mesh(&ground),
            taken: Occupancy::default(),
            ground,
            config,
        };
        site.fill_square(&layout, &mut stream(seed, Purpose::Square, 0));
        site.park_cars(&layout, &mut stream(seed, Purpose::ParkedCar, 0));
        for (number, road) in layout.roads.iter().enumerate() {
            for (side, offset) in [(1.0, 0), (-1.0, 1)] {
                let index = 2 * number as u64 + offset;
                site.line_with_houses(road, side, &mut stream(seed, Purpose::House, index));
                site.furnish(road, side, &mut stream(seed, Purpose::Furniture, index));
                site.plant(road, side, &mut stream(seed, Purpose::Plant, index));
            }
        }
        Self {
            classes: site.surface.paints.iter().map(|p| p.class).collect(),
            reflectances: site.surface.paints.iter().map(|p| p.reflectance).collect(),
            mesh: site.surface.mesh,
            ground: site.ground,
            path: path.clone(),
        }
    }
}

/// A street while it is built.
struct Site<'a> {
    surface: PaintedMesh,
    taken: Occupancy,
    ground: Ground,
    config: &'a StreetConfig,
}

impl Site<'_> {
    /// Starts building upright at a place, x along `forward`.
    fn upright(&mut self, position: DVec2, forward: DVec2) -> Builder<'_> {
        let origin = self.ground.point_at(position);
        Builder::new(&mut self.surface, standing(origin, forward), PRIMER)
    }

    fn fill_square(&mut self, layout: &Layout, rng: &mut ChaCha8Rng) {
        let Some((frame, half_m)) = &layout.square else {
            return;
        };
        if self.is_off_road(frame.position, 4.0) && self.taken.claim_around(frame.position, 2.2) {
            add_monument(&mut self.upright(frame.position, frame.forward), rng);
        }
        for _ in 0..14 {
            let local = DVec2::new(
                rng.random_range(-half_m.x..half_m.x),
                rng.random_range(-half_m.y..half_m.y),
            );
            let position = frame.position + frame.forward.rotate(local);
            let angle = rng.random_range(0.0..std::f64::consts::TAU);
            let forward = DVec2::from_angle(angle);
            if !self.is_off_road(position, 2.5) {
                continue;
            }
            match rng.random_range(0..4) {
                0 if self.taken.claim_around(position, 0.8) => {
                    add_tree(&mut self.upright(position, forward), true, rng);
                }
                1 if self.taken.claim_around(position, 1.0) => {
                    add_box(&mut self.upright(position, forward), rng);
                }
                2 | 3 => {
                    let turned = frame.forward.perp();
                    self.park(position, turned, rng);
                }
                _ => {}
            }
        }
    }

    fn park_cars(&mut self, layout: &Layout, rng: &mut ChaCha8Rng) {
        for row in &layout.bays {
            let mut station_m = 3.0;
            while station_m < row.path.length_m() - 2.0 {
                let point = row.path.at(station_m);
                if rng.random_bool(self.config.parked_share) {
                    let turn = DVec2::from_angle(rng.random_range(-0.04..0.04));
                    let sense = if rng.random_bool(0.7) { 1.0 } else { -1.0 };
                    let position = point.beside(rng.random_range(-0.12..0.12));
                    self.park(position, sense * turn.rotate(point.forward), rng);
                }
                station_m += rng.random_range(5.4..6.6);
            }
        }
    }

    fn park(&mut self, position: DVec2, forward: DVec2, rng: &mut ChaCha8Rng) {
        let vehicle = if rng.random_bool(0.12) {
            Vehicle::random_van(rng)
        } else {
            Vehicle::random_car(rng)
        };
        let footprint = Footprint {
            center: position,
            forward,
            half_m: DVec2::from(vehicle.half_size_m()),
        };
        let is_beside_the_roads = footprint
            .border()
            .all(|place| self.ground.at(place).road_m > -0.05);
        if is_beside_the_roads && self.taken.claim(footprint) {
            let world_from_local = lying_on(&self.ground, position, forward);
            let mut builder = Builder::new(&mut self.surface, world_from_local, PRIMER);
            vehicle.add_to(&mut builder, false, 0.0);
        }
    }

    fn line_with_houses(&mut self, road: &Road, side: f64, rng: &mut ChaCha8Rng) {
        let mut station_m = rng.random_range(2.0..10.0);
        while station_m < road.path.length_m() - 4.0 {
            if !rng.random_bool(self.config.built_share) {
                station_m += rng.random_range(6.0..18.0);
                continue;
            }
            let shape = HouseShape::random(rng);
            let is_garage = rng.random_bool(0.12);
            let width_m = if is_garage {
                4.0
            } else {
                f64::from(shape.width_m)
            };
            let depth_m = if is_garage {
                6.5
            } else {
                f64::from(shape.depth_m)
            };
            let point = road.path.at(station_m + 0.5 * width_m);
            let setback_m = rng.random_range(0.4..6.0);
            let size_m = DVec2::new(width_m, depth_m);
            let Some(front) = self.claim_lot(road, &point, side, setback_m, size_m) else {
                station_m += 2.0;
                continue;
            };
            let jitter = DVec2::from_angle(rng.random_range(-0.04..0.04));
            let along = jitter.rotate(side * point.forward);
            let mut builder = self.upright(front, along);
            if is_garage {
                add_garage(&mut builder, rng);
            } else {
                add_house(&mut builder, &shape, rng);
            }
            let gap_m = if rng.random_bool(0.3) {
                0.3
            } else {
                rng.random_range(1.0..7.0)
            };
            if rng.random_bool(0.65) {
                let ends_m = [station_m - 0.5 * gap_m, station_m + width_m + 0.5 * gap_m];
                self.fence(road, side, ends_m, rng);
            }
            station_m += width_m + gap_m;
        }
    }

    /// The middle of the front of a free lot, farther from the street if need be.
    fn claim_lot(
        &mut self,
        road: &Road,
        point: &PathPoint,
        side: f64,
        setback_m: f64,
        size_m: DVec2,
    ) -> Option<DVec2> {
        let sidewalk_m = self.config.ground.sidewalk_width_m;
        [0.0, 4.0, 9.0].into_iter().find_map(|extra_m| {
            let kerb_m = sidewalk_m + setback_m + extra_m;
            // Far enough for the far side of the square and the end of a side street.
            let limit_m = road.half_width_m + BAY_WIDTH_M + kerb_m + 40.0;
            let front = self.ground.beside(point, side, kerb_m, limit_m)?;
            let inwards = side * point.left();
            // The footprint has room for a balcony in front and a slight turn.
            let footprint = Footprint {
                center: front + 0.5 * size_m.y * inwards,
                forward: point.forward,
                half_m: 0.5 * size_m + DVec2::new(0.1, 0.35),
            };
            let is_clear = footprint
                .border()
                .all(|place| self.ground.kerb_distance_m(place) > sidewalk_m * 0.8);
            (is_clear && self.taken.claim(footprint)).then_some(front)
        })
    }

    fn fence(&mut self, road: &Road, side: f64, ends_m: [f64; 2], rng: &mut ChaCha8Rng) {
        let barrier = Barrier::random(rng);
        let kerb_m = self.config.ground.sidewalk_width_m + 0.5 * f64::from(barrier.thickness_m);
        let kerb_m = kerb_m + 0.1;
        let limit_m = road.half_width_m + BAY_WIDTH_M + kerb_m + 1.0;
        let pieces = ((ends_m[1] - ends_m[0]) / 1.8).ceil() as usize;
        let gate = rng.random_range(0..pieces.max(1));
        let places: Vec<Option<DVec2>> = (0..=pieces)
            .map(|piece| {
                let share = piece as f64 / pieces as f64;
                let point = road.path.at(ends_m[0] + share * (ends_m[1] - ends_m[0]));
                self.ground.beside(&point, side, kerb_m, limit_m)
            })
            .collect();
        for (piece, ends) in places.windows(2).enumerate() {
            let &[Some(from), Some(to)] = ends else {
                continue;
            };
            let footprint = Footprint {
                center: 0.5 * (from + to),
                forward: (to - from).normalize_or(DVec2::X),
                half_m: DVec2::new(0.45 * from.distance(to), 0.1),
            };
            if piece != gate && from.distance(to) < 3.0 && self.taken.claim(footprint) {
                barrier.add_between(&mut self.surface, &self.ground, [from, to], rng);
            }
        }
    }

    fn furnish(&mut self, road: &Road, side: f64, rng: &mut ChaCha8Rng) {
        let mut station_m = rng.random_range(3.0..0.6 * self.config.lamp_spacing_m);
        while station_m < road.path.length_m() {
            self.stand_beside(road, side, station_m, 0.45, |builder| {
                add_lamp(builder, rng);
            });
            let sign_m = station_m + rng.random_range(4.0..25.0);
            if rng.random_bool(0.6) {
                self.stand_beside(road, side, sign_m, 0.35, |builder| {
                    add_sign(builder, rng);
                });
            }
            let box_m = station_m + rng.random_range(3.0..20.0);
            if rng.random_bool(0.5) {
                let kerb_m = self.config.ground.sidewalk_width_m - 0.35;
                self.stand_beside(road, side, box_m, kerb_m, |builder| {
                    add_box(builder, rng);
                });
            }
            station_m += self.config.lamp_spacing_m * rng.random_range(0.7..1.3);
        }
    }

    /// Builds on the pavement, x towards the road, if the place is free.
    fn stand_beside(
        &mut self,
        road: &Road,
        side: f64,
        station_m: f64,
        kerb_m: f64,
        build: impl FnOnce(&mut Builder),
    ) {
        let point = road.path.at(station_m);
        let limit_m = road.half_width_m + BAY_WIDTH_M + kerb_m + 1.0;
        if let Some(position) = self.ground.beside(&point, side, kerb_m, limit_m)
            && self.taken.claim_around(position, 0.3)
        {
            build(&mut self.upright(position, -side * point.left()));
        }
    }

    fn plant(&mut self, road: &Road, side: f64, rng: &mut ChaCha8Rng) {
        let spacing_m = 100.0 / self.config.plants_per_100_m;
        let sidewalk_m = self.config.ground.sidewalk_width_m;
        let mut station_m = rng.random_range(0.0..spacing_m);
        while station_m < road.path.length_m() {
            let point = road.path.at(station_m);
            let is_street_tree = rng.random_bool(0.2);
            let kerb_m = if is_street_tree {
                0.7
            } else {
                sidewalk_m + rng.random_range(0.9..1.0_f64) * rng.random_range(1.0..26.0)
            };
            let is_bush = !is_street_tree && rng.random_bool(0.4);
            let limit_m = road.half_width_m + BAY_WIDTH_M + kerb_m + 2.0;
            let half_m = if is_street_tree { 0.3 } else { 0.9 };
            if let Some(position) = self.ground.beside(&point, side, kerb_m, limit_m)
                && self.taken.claim_around(position, half_m)
            {
                let forward = DVec2::from_angle(rng.random_range(0.0..std::f64::consts::TAU));
                let mut builder = self.upright(position, forward);
                if is_bush {
                    add_bush(&mut builder, rng);
                } else {
                    add_tree(&mut builder, kerb_m < 6.0, rng);
                }
            }
            station_m += spacing_m * rng.random_range(0.4..1.6);
        }
    }

    fn is_off_road(&self, position: DVec2, distance_m: f32) -> bool {
        self.ground.at(position).road_m > distance_m
    }
}

/// Every builder paints before it builds.
const PRIMER: Paint = Paint {
    class: classes::OTHER_OBJECT,
    reflectance: 0.5,
};

fn standing(origin: Vec3, forward: DVec2) -> Rigid3f {
    let forward = Vec3::new(forward.x as f32, forward.y as f32, 0.0);
    Rigid3f {
        rotation: Mat3::from_cols(forward, Vec3::Z.cross(forward), Vec3::Z),
        translation: origin,
    }
}

/// A frame whose x-y plane touches the ground a metre before, behind and beside a place.
pub fn lying_on(ground: &Ground, position: DVec2, forward: DVec2) -> Rigid3f {
    let height_m = |offset: DVec2| f64::from(ground.at(position + offset).height_m);
    let slope = |direction: DVec2| (0.5 * (height_m(direction) - height_m(-direction))) as f32;
    let left = forward.perp();
    let along = Vec3::new(forward.x as f32, forward.y as f32, slope(forward)).normalize();
    let across = Vec3::new(left.x as f32, left.y as f32, slope(left));
    let up = along.cross(across).normalize();
    Rigid3f {
        rotation: Mat3::from_cols(along, up.cross(along), up),
        translation: ground.point_at(position),
    }
}
