//! Street furniture and plants: lamps, signs, boxes, trees, bushes, fences and hedges.

use std::f32::consts::TAU;

use glam::{DVec2, Vec3};
use rand::{Rng, RngExt as _};

use super::builder::{LabelledMesh, MeshBuilder};
use super::classes;
use super::ground::GroundField;
use crate::geometry::{Pose3, Rigid3f};

/// Adds a street lamp; its arm reaches along x, over the road.
pub fn add_lamp(builder: &mut MeshBuilder, rng: &mut impl Rng) {
    let height_m = rng.random_range(5.0..8.5);
    let arm_m = rng.random_range(0.6..1.8);
    builder.set_material(classes::POLE, 0.45);
    builder.cone(-0.3 * Vec3::Z, [0.11, 0.06], height_m + 0.3, 8);
    builder.cone(-0.3 * Vec3::Z, [0.15, 0.15], 1.2, 8);
    builder.cuboid([-0.05, arm_m], [-0.04, 0.04], [height_m - 0.1, height_m]);
    let (x, z) = (
        [arm_m - 0.2, arm_m + 0.4],
        [height_m - 0.14, height_m + 0.02],
    );
    builder.cuboid(x, [-0.12, 0.12], z);
}

/// Adds a traffic sign on a post; its plate faces along -x.
pub fn add_sign(builder: &mut MeshBuilder, rng: &mut impl Rng) {
    let height_m = rng.random_range(2.1..2.7);
    builder.set_material(classes::POLE, 0.5);
    builder.cone(-0.3 * Vec3::Z, [0.035, 0.035], height_m + 0.75, 6);
    builder.set_material(classes::TRAFFIC_SIGN, 0.95);
    let is_square = rng.random_bool(0.5);
    let (half_m, z) = if is_square {
        (0.3, [height_m, height_m + 0.6])
    } else {
        let half_m = rng.random_range(0.3..0.7);
        (half_m, [height_m + 0.1, height_m + 0.5])
    };
    builder.cuboid([-0.06, -0.04], [-half_m, half_m], z);
}

/// Adds a tree: a trunk and ellipsoids for a crown. Beside the street the crown begins above the
/// roofs of cars.
pub fn add_tree(builder: &mut MeshBuilder, is_beside_street: bool, rng: &mut impl Rng) {
    let size = rng.random_range(0.7..1.6_f32);
    let mut trunk_m = size * rng.random_range(1.6..2.6);
    if is_beside_street {
        trunk_m = f32::max(trunk_m, 3.0 + 0.8 * size);
    }
    let radius_m = 0.13 * size;
    let radii_m = [1.3 * radius_m, 0.8 * radius_m];
    builder.set_material(classes::TRUNK, 0.3);
    builder.cone(-0.4 * Vec3::Z, radii_m, trunk_m + 0.9, 9);
    builder.set_material(classes::VEGETATION, rng.random_range(0.35..0.6));
    let is_conifer = rng.random_bool(0.2) && !is_beside_street;
    if is_conifer {
        for tier in 0..4 {
            let share = tier as f32 / 4.0;
            let width_m = size * 1.7 * (1.0 - share);
            let center = Vec3::Z * (0.8 + size * (1.2 + 4.5 * share));
            builder.ellipsoid(center, Vec3::new(width_m, width_m, size), 0.2, rng);
        }
        return;
    }
    for _ in 0..rng.random_range(4..8) {
        let angle = rng.random_range(0.0..TAU);
        let reach_m = size * rng.random_range(0.2..1.1);
        let height_m = trunk_m + size * rng.random_range(0.6..2.2);
        let center = Vec3::new(reach_m * angle.cos(), reach_m * angle.sin(), height_m);
        let [x, y] = [(); 2].map(|()| rng.random_range(0.8..1.4));
        let radii_m = size * Vec3::new(x, y, rng.random_range(0.6..1.1));
        builder.ellipsoid(center, radii_m, 0.22, rng);
    }
}

/// Adds a bush.
pub fn add_bush(builder: &mut MeshBuilder, rng: &mut impl Rng) {
    builder.set_material(classes::VEGETATION, rng.random_range(0.35..0.6));
    for _ in 0..rng.random_range(1..4) {
        let radius_m = rng.random_range(0.4..0.9);
        let [x, y] = [(); 2].map(|()| rng.random_range(-0.6..0.6));
        let center = Vec3::new(x, y, 0.6 * radius_m);
        builder.ellipsoid(center, Vec3::splat(radius_m), 0.25, rng);
    }
}

/// Adds a bin, a transformer box or a bench.
pub fn add_box(builder: &mut MeshBuilder, rng: &mut impl Rng) {
    match rng.random_range(0..3) {
        0 => {
            builder.set_material(classes::OTHER_OBJECT, 0.2);
            let top = ([-0.3, 0.3], [-0.36, 0.36], 1.05);
            builder.frustum(([-0.25, 0.25], [-0.28, 0.28], -0.2), top);
        }
        1 => {
            builder.set_material(classes::OTHER_STRUCTURE, 0.5);
            let half_m = rng.random_range(0.3..0.8);
            let height_m = rng.random_range(0.9..1.6);
            builder.cuboid([-0.2, 0.2], [-half_m, half_m], [-0.3, height_m]);
        }
        _ => {
            builder.set_material(classes::OTHER_STRUCTURE, 0.4);
            builder.cuboid([-0.25, 0.25], [-0.8, 0.8], [0.4, 0.47]);
            builder.cuboid([0.22, 0.28], [-0.8, 0.8], [0.47, 0.9]);
            for y in [-0.65, 0.65] {
                builder.cuboid([-0.2, 0.2], [y - 0.05, y + 0.05], [-0.1, 0.4]);
            }
        }
    }
}

/// Adds a monument on steps for the middle of a square.
pub fn add_monument(builder: &mut MeshBuilder, rng: &mut impl Rng) {
    builder.set_material(classes::OTHER_STRUCTURE, 0.6);
    for step in 0..3 {
        let half_m = 2.0 - 0.5 * step as f32;
        let low_m = 0.2 * step as f32 - if step == 0 { 0.5 } else { 0.0 };
        let x = [-half_m, half_m];
        builder.cuboid(x, x, [low_m, 0.2 * (step + 1) as f32]);
    }
    builder.cone(Vec3::Z * 0.6, [0.5, 0.35], rng.random_range(2.5..4.5), 12);
}

/// A garden wall, fence or hedge that follows the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Barrier {
    /// Height above the ground [m].
    pub height_m: f32,
    /// Thickness [m].
    pub thickness_m: f32,
    /// Largest displacement of the upper corners of a hedge [m].
    pub roughness_m: f32,
    /// Class "fence" or "vegetation".
    pub class: u16,
    /// Share of the light that is returned at normal incidence, 0 to 1.
    pub reflectance: f32,
}

impl Barrier {
    /// A random wall, fence or hedge.
    pub fn random(rng: &mut impl Rng) -> Self {
        match rng.random_range(0..3) {
            0 => Self {
                height_m: rng.random_range(0.5..1.9),
                thickness_m: 0.25,
                roughness_m: 0.0,
                class: classes::FENCE,
                reflectance: rng.random_range(0.3..0.7),
            },
            1 => Self {
                height_m: rng.random_range(0.9..1.5),
                thickness_m: 0.06,
                roughness_m: 0.0,
                class: classes::FENCE,
                reflectance: rng.random_range(0.2..0.5),
            },
            _ => Self {
                height_m: rng.random_range(0.8..2.0),
                thickness_m: rng.random_range(0.5..0.9),
                roughness_m: 0.1,
                class: classes::VEGETATION,
                reflectance: 0.45,
            },
        }
    }

    /// Adds a piece between two positions.
    pub fn add_between(
        &self,
        target: &mut LabelledMesh,
        ground: &GroundField,
        [from, to]: [DVec2; 2],
        rng: &mut impl Rng,
    ) {
        let across = (to - from).normalize_or(DVec2::X).perp() * f64::from(0.5 * self.thickness_m);
        let corners = [from - across, to - across, to + across, from + across];
        let low = corners.map(|position| ground.point_at(position) - 0.4 * Vec3::Z);
        let high = corners.map(|position| {
            let jitter = [(); 3].map(|()| self.roughness_m * rng.random_range(-1.0..1.0));
            ground.point_at(position) + self.height_m * Vec3::Z + Vec3::from(jitter)
        });
        let mut builder = MeshBuilder::new(target, Rigid3f::from(&Pose3::identity()));
        builder.set_material(self.class, self.reflectance);
        builder.side_faces(low, high);
        builder.quad(high);
    }
}
