//! The street: ground, houses, furniture, plants and parked cars as one mesh with a material per
//! triangle. It depends on its seed and its path alone: every drive has the same street.

use std::f64::consts::TAU;

use glam::{DVec2, Vec3};
use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;

use super::builder::{LabelledMesh, MeshBuilder};
use super::buildings::{HouseShape, add_garage, add_house};
use super::centreline::{Centreline, CentrelinePoint};
use super::classes;
use super::furniture::{Barrier, add_box, add_bush, add_lamp, add_monument, add_sign, add_tree};
use super::ground::GroundField;
use super::ground_mesh::ground_mesh;
use super::layout::{BAY_WIDTH_M, EXTENSION_M, Footprint, Occupancy, StreetLayout, Strip};
use super::random::{Purpose, stream};
use super::street_config::StreetConfig;
use super::vehicles::Vehicle;

/// The static world and its ground truth.
#[derive(Clone, Debug)]
pub struct Street {
    /// Every surface, world frame (z up, the path begins near the origin).
    pub surface: LabelledMesh,
    /// Heights and zones of the ground.
    pub ground: GroundField,
}

impl Street {
    /// Builds the street along a driven path.
    pub fn new(path: &Centreline, config: &StreetConfig, seed: u64) -> Self {
        let lane = path.extended(EXTENSION_M);
        let layout = StreetLayout::new(&lane, config, &mut stream(seed, Purpose::Layout, 0));
        let ground = GroundField::new(&lane, &layout, &config.ground, seed);
        let mut site = Site {
            street: Self {
                surface: ground_mesh(&ground),
                ground,
            },
            occupied: Occupancy::default(),
            config,
        };
        if let Some(square) = &layout.square {
            site.fill_square(square, &mut stream(seed, Purpose::Square, 0));
        }
        let before = site.mark();
        site.park_cars(&layout.bays, &mut stream(seed, Purpose::ParkedCar, 0));
        let parked = before.1..site.occupied.len();
        if config.changes.parked_cars {
            // Their ground stays occupied until all else is built, which is the same without them.
            site.remove_surface_after(before.0);
        }
        for (number, road) in layout.roads.iter().enumerate() {
            for (side, offset) in [(1.0, 0), (-1.0, 1)] {
                let side = RoadSide { road, side };
                let index = 2 * number as u64 + offset;
                let (mut houses, mut changes) = (
                    stream(seed, Purpose::House, index),
                    stream(seed, Purpose::Change, 16 + index),
                );
                site.add_houses(side, &mut houses, &mut changes);
                site.add_furniture(side, &mut stream(seed, Purpose::Furniture, index));
                site.add_plants(side, &mut stream(seed, Purpose::Plant, index));
            }
        }
        if config.changes.parked_cars {
            site.occupied.release(parked);
            site.park_cars(&layout.bays, &mut stream(seed, Purpose::Change, 1));
        }
        let Self {
            mut surface,
            ground,
        } = site.street;
        for structure in &config.structures {
            structure.add_to(&mut surface, path, &|at| ground.at(at).height_m);
        }
        if config.changes.foliage_m > 0.0 {
            displace_foliage(&mut surface, config.changes.foliage_m as f32, seed);
        }
        Self { surface, ground }
    }
}

/// Displaces the surfaces of crowns, bushes and hedges by waves of a metre or two.
fn displace_foliage(surface: &mut LabelledMesh, largest_m: f32, seed: u64) {
    let mut rng = stream(seed, Purpose::Change, 2);
    let waves: [[Vec3; 2]; 3] = [(); 3].map(|()| {
        [(); 2].map(|()| Vec3::from_array([(); 3].map(|()| rng.random_range(-6.0..6.0))))
    });
    let LabelledMesh { mesh, materials } = surface;
    for (corners, material) in mesh.triangles.iter().zip(materials) {
        if material.class == classes::VEGETATION {
            for &corner in corners {
                // Each triangle has vertices of its own.
                let vertex = &mut mesh.vertices[corner as usize];
                let place = *vertex;
                let shift = waves.map(|[wave, phase]| (wave.dot(place) + phase.x).sin());
                *vertex += largest_m * Vec3::from_array(shift);
            }
        }
    }
}

/// One side of a road.
#[derive(Clone, Copy)]
struct RoadSide<'a> {
    road: &'a Strip,
    /// Left +1, right -1.
    side: f64,
}

impl RoadSide<'_> {
    fn length_m(&self) -> f64 {
        self.road.centreline.length_m()
    }

    fn at(&self, station_m: f64) -> CentrelinePoint {
        self.road.centreline.at(station_m)
    }

    /// The position `kerb_m` behind the kerb; `None` if that is more than `extra_m` farther from
    /// the centreline than behind a parking bay.
    fn beyond_kerb(
        &self,
        ground: &GroundField,
        station_m: f64,
        kerb_m: f64,
        extra_m: f64,
    ) -> Option<DVec2> {
        let limit_m = self.road.half_width_m + BAY_WIDTH_M + kerb_m + extra_m;
        ground.beyond_kerb(&self.at(station_m), self.side, kerb_m, limit_m)
    }
}

/// A street under construction.
struct Site<'a> {
    street: Street,
    occupied: Occupancy,
    config: &'a StreetConfig,
}

impl Site<'_> {
    /// A builder at a position, upright, x along `forward`.
    fn upright(&mut self, position: DVec2, forward: DVec2) -> MeshBuilder<'_> {
        let world_from_local = self.street.ground.upright_frame(position, forward);
        MeshBuilder::new(&mut self.street.surface, world_from_local)
    }

    /// Number of triangles and of occupied places so far.
    fn mark(&self) -> (usize, usize) {
        (self.street.surface.materials.len(), self.occupied.len())
    }

    /// Removes the triangles from a number on, which have three vertices each.
    fn remove_surface_after(&mut self, triangles: usize) {
        let LabelledMesh { mesh, materials } = &mut self.street.surface;
        let kept = mesh.triangles.get(triangles).map(|corners| corners[0]);
        mesh.vertices
            .truncate(kept.map_or(mesh.vertices.len(), |first| first as usize));
        mesh.triangles.truncate(triangles);
        materials.truncate(triangles);
    }

    fn fill_square(&mut self, square: &Footprint, rng: &mut ChaCha8Rng) {
        let &Footprint {
            center,
            forward,
            half_m,
        } = square;
        if self.is_off_road(center, 4.0) && self.occupied.claim_around(center, 2.2) {
            add_monument(&mut self.upright(center, forward), rng);
        }
        for _ in 0..14 {
            let [x, y] = [half_m.x, half_m.y].map(|half_m| rng.random_range(-half_m..half_m));
            let position = center + forward.rotate(DVec2::new(x, y));
            let direction = DVec2::from_angle(rng.random_range(0.0..TAU));
            if !self.is_off_road(position, 2.5) {
                continue;
            }
            match rng.random_range(0..4) {
                0 if self.occupied.claim_around(position, 0.8) => {
                    add_tree(&mut self.upright(position, direction), true, rng);
                }
                1 if self.occupied.claim_around(position, 1.0) => {
                    add_box(&mut self.upright(position, direction), rng);
                }
                2 | 3 => self.park_car(position, forward.perp(), rng),
                _ => {}
            }
        }
    }

    fn park_cars(&mut self, bays: &[Strip], rng: &mut ChaCha8Rng) {
        for Strip { centreline, .. } in bays {
            let mut station_m = 3.0;
            while station_m < centreline.length_m() - 2.0 {
                let point = centreline.at(station_m);
                if rng.random_bool(self.config.parked_share) {
                    let turn = DVec2::from_angle(rng.random_range(-0.04..0.04));
                    let direction = if rng.random_bool(0.7) { 1.0 } else { -1.0 };
                    let position = point.beside(rng.random_range(-0.12..0.12));
                    self.park_car(position, direction * turn.rotate(point.forward), rng);
                }
                station_m += rng.random_range(5.4..6.6);
            }
        }
    }

    /// Parks a random vehicle if the position is free and next to the roads.
    fn park_car(&mut self, position: DVec2, forward: DVec2, rng: &mut ChaCha8Rng) {
        let vehicle = Vehicle::random(0.12, rng);
        let footprint = Footprint {
            center: position,
            forward,
            half_m: vehicle.half_size_m(),
        };
        let ground = &self.street.ground;
        let mut outline = footprint.outline().into_iter();
        if outline.all(|place| ground.at(place).road_m > -0.05) && self.occupied.claim(footprint) {
            let world_from_local = ground.tangent_frame(position, forward);
            let mut builder = MeshBuilder::new(&mut self.street.surface, world_from_local);
            vehicle.add_to(&mut builder, false, 0.0);
        }
    }

    fn add_houses(&mut self, side: RoadSide, rng: &mut ChaCha8Rng, changes: &mut ChaCha8Rng) {
        let mut station_m = rng.random_range(2.0..10.0);
        while station_m < side.length_m() - 4.0 {
            if !rng.random_bool(self.config.built_share) {
                station_m += rng.random_range(6.0..18.0);
                continue;
            }
            let shape = HouseShape::random(rng);
            let is_garage = rng.random_bool(0.12);
            let size_m = if is_garage {
                DVec2::new(4.0, 6.5)
            } else {
                DVec2::new(f64::from(shape.width_m), f64::from(shape.depth_m))
            };
            let middle_m = station_m + 0.5 * size_m.x;
            let setback_m = rng.random_range(0.4..6.0);
            let Some(front) = self.claim_lot(side, middle_m, setback_m, size_m) else {
                station_m += 2.0;
                continue;
            };
            let jitter = DVec2::from_angle(rng.random_range(-0.04..0.04));
            let along = jitter.rotate(side.side * side.at(middle_m).forward);
            let (triangles, _) = self.mark();
            let mut builder = self.upright(front, along);
            if is_garage {
                add_garage(&mut builder, rng);
            } else {
                add_house(&mut builder, &shape, rng);
                if changes.random_bool(self.config.changes.demolished_share) {
                    self.remove_surface_after(triangles);
                }
            }
            let gap_m = if rng.random_bool(0.3) {
                0.3
            } else {
                rng.random_range(1.0..7.0)
            };
            if rng.random_bool(0.65) {
                let ends_m = [station_m - 0.5 * gap_m, station_m + size_m.x + 0.5 * gap_m];
                self.add_barrier(side, ends_m, rng);
            }
            station_m += size_m.x + gap_m;
        }
    }

    /// Occupies a free lot, farther from the street if need be; returns the middle of its front.
    fn claim_lot(
        &mut self,
        side: RoadSide,
        station_m: f64,
        setback_m: f64,
        size_m: DVec2,
    ) -> Option<DVec2> {
        let sidewalk_m = self.config.ground.sidewalk_width_m;
        let ground = &self.street.ground;
        let point = side.at(station_m);
        [0.0, 4.0, 9.0].into_iter().find_map(|extra_m| {
            let kerb_m = sidewalk_m + setback_m + extra_m;
            // Far enough for the far side of the square and the end of a side street.
            let front = side.beyond_kerb(ground, station_m, kerb_m, 40.0)?;
            let inwards = side.side * point.left();
            // The footprint includes a balcony in front and a slight turn.
            let footprint = Footprint {
                center: front + 0.5 * size_m.y * inwards,
                forward: point.forward,
                half_m: 0.5 * size_m + DVec2::new(0.1, 0.35),
            };
            let mut outline = footprint.outline().into_iter();
            let is_clear = outline.all(|place| ground.kerb_distance_m(place) > sidewalk_m * 0.8);
            (is_clear && self.occupied.claim(footprint)).then_some(front)
        })
    }

    /// Adds a barrier with a gate behind the sidewalk between two stations.
    fn add_barrier(&mut self, side: RoadSide, [from_m, to_m]: [f64; 2], rng: &mut ChaCha8Rng) {
        let Street { surface, ground } = &mut self.street;
        let barrier = Barrier::random(rng);
        let kerb_m = self.config.ground.sidewalk_width_m + 0.5 * f64::from(barrier.thickness_m);
        let pieces = ((to_m - from_m) / 1.8).ceil() as usize;
        let gate = rng.random_range(0..pieces.max(1));
        let places: Vec<Option<DVec2>> = (0..=pieces)
            .map(|piece| {
                let share = piece as f64 / pieces as f64;
                side.beyond_kerb(ground, from_m + share * (to_m - from_m), kerb_m + 0.1, 1.0)
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
            if piece != gate && from.distance(to) < 3.0 && self.occupied.claim(footprint) {
                barrier.add_between(surface, ground, [from, to], rng);
            }
        }
    }

    fn add_furniture(&mut self, side: RoadSide, rng: &mut ChaCha8Rng) {
        let mut station_m = rng.random_range(3.0..0.6 * self.config.lamp_spacing_m);
        while station_m < side.length_m() {
            if let Some(mut builder) = self.beside(side, station_m, 0.45) {
                add_lamp(&mut builder, rng);
            }
            let sign_m = station_m + rng.random_range(4.0..25.0);
            if rng.random_bool(0.6)
                && let Some(mut builder) = self.beside(side, sign_m, 0.35)
            {
                add_sign(&mut builder, rng);
            }
            let box_m = station_m + rng.random_range(3.0..20.0);
            let kerb_m = self.config.ground.sidewalk_width_m - 0.35;
            if rng.random_bool(0.5)
                && let Some(mut builder) = self.beside(side, box_m, kerb_m)
            {
                add_box(&mut builder, rng);
            }
            station_m += self.config.lamp_spacing_m * rng.random_range(0.7..1.3);
        }
    }

    /// A builder on the sidewalk, x towards the road, if the position is free.
    fn beside(&mut self, side: RoadSide, station_m: f64, kerb_m: f64) -> Option<MeshBuilder<'_>> {
        let position = side.beyond_kerb(&self.street.ground, station_m, kerb_m, 1.0)?;
        let is_free = self.occupied.claim_around(position, 0.3);
        is_free.then(|| self.upright(position, -side.side * side.at(station_m).left()))
    }

    fn add_plants(&mut self, side: RoadSide, rng: &mut ChaCha8Rng) {
        let spacing_m = 100.0 / self.config.plants_per_100_m;
        let sidewalk_m = self.config.ground.sidewalk_width_m;
        let mut station_m = rng.random_range(0.0..spacing_m);
        while station_m < side.length_m() {
            let is_street_tree = rng.random_bool(0.2);
            let (kerb_m, half_m) = if is_street_tree {
                (0.7, 0.3)
            } else {
                let share = rng.random_range(0.9..1.0_f64);
                (sidewalk_m + share * rng.random_range(1.0..26.0), 0.9)
            };
            let is_bush = !is_street_tree && rng.random_bool(0.4);
            if let Some(position) = side.beyond_kerb(&self.street.ground, station_m, kerb_m, 2.0)
                && self.occupied.claim_around(position, half_m)
            {
                let forward = DVec2::from_angle(rng.random_range(0.0..TAU));
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
        self.street.ground.at(position).road_m > distance_m
    }
}
