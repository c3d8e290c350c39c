//! What stands along a street: lamps, signs, trees, hedges, garden walls, bins, benches.

use glam::{DVec2, Vec3};
use rand::{Rng, RngExt as _};

use super::builder::{Builder, Paint, PaintedMesh};
use super::classes;
use super::ground::Ground;

/// A street lamp; its arm reaches along x, over the road.
pub fn add_lamp(builder: &mut Builder, rng: &mut impl Rng) {
    let height_m = rng.random_range(5.0..8.5);
    let arm_m = rng.random_range(0.6..1.8);
    builder.paint(classes::POLE, 0.45);
    builder.cylinder(-0.3 * Vec3::Z, [0.11, 0.06], height_m + 0.3, 8);
    builder.cylinder(-0.3 * Vec3::Z, [0.15, 0.15], 1.2, 8);
    builder.cuboid(
        Vec3::new(-0.05, -0.04, height_m - 0.1),
        Vec3::new(arm_m, 0.04, height_m),
    );
    builder.cuboid(
        Vec3::new(arm_m - 0.2, -0.12, height_m - 0.14),
        Vec3::new(arm_m + 0.4, 0.12, height_m + 0.02),
    );
}

/// A traffic sign on a post; its plate looks along -x.
pub fn add_sign(builder: &mut Builder, rng: &mut impl Rng) {
    let height_m = rng.random_range(2.1..2.7);
    builder.paint(classes::POLE, 0.5);
    builder.cylinder(-0.3 * Vec3::Z, [0.035, 0.035], height_m + 0.75, 6);
    builder.paint(classes::TRAFFIC_SIGN, 0.95);
    if rng.random_bool(0.5) {
        builder.cuboid(
            Vec3::new(-0.06, -0.3, height_m),
            Vec3::new(-0.04, 0.3, height_m + 0.6),
        );
    } else {
        let half_m = rng.random_range(0.3..0.7);
        builder.cuboid(
            Vec3::new(-0.06, -half_m, height_m + 0.1),
            Vec3::new(-0.04, half_m, height_m + 0.5),
        );
    }
}

/// A tree: a stem and lumps for a crown. Beside the street the crown begins over the roofs of cars.
pub fn add_tree(builder: &mut Builder, is_beside_street: bool, rng: &mut impl Rng) {
    let size = rng.random_range(0.7..1.6_f32);
    let free_stem_m = size * rng.random_range(1.6..2.6);
    let stem_m = if is_beside_street {
        free_stem_m.max(3.0 + 0.8 * size)
    } else {
        free_stem_m
    };
    let radius_m = 0.13 * size;
    builder.paint(classes::TRUNK, 0.3);
    builder.cylinder(
        -0.4 * Vec3::Z,
        [1.3 * radius_m, 0.8 * radius_m],
        stem_m + 0.9,
        9,
    );
    builder.paint(classes::VEGETATION, rng.random_range(0.35..0.6));
    let is_conifer = rng.random_bool(0.2) && !is_beside_street;
    if is_conifer {
        for tier in 0..4 {
            let share = tier as f32 / 4.0;
            let width_m = size * 1.7 * (1.0 - share);
            let middle = Vec3::Z * (0.8 + size * (1.2 + 4.5 * share));
            builder.blob(middle, Vec3::new(width_m, width_m, size), 0.2, rng);
        }
        return;
    }
    for _ in 0..rng.random_range(4..8) {
        let angle = rng.random_range(0.0..std::f32::consts::TAU);
        let reach_m = size * rng.random_range(0.2..1.1);
        let middle = Vec3::new(
            reach_m * angle.cos(),
            reach_m * angle.sin(),
            stem_m + size * rng.random_range(0.6..2.2),
        );
        let radii_m = size
            * Vec3::new(
                rng.random_range(0.8..1.4),
                rng.random_range(0.8..1.4),
                rng.random_range(0.6..1.1),
            );
        builder.blob(middle, radii_m, 0.22, rng);
    }
}

/// A bush.
pub fn add_bush(builder: &mut Builder, rng: &mut impl Rng) {
    builder.paint(classes::VEGETATION, rng.random_range(0.35..0.6));
    for _ in 0..rng.random_range(1..4) {
        let radius_m = rng.random_range(0.4..0.9);
        let middle = Vec3::new(
            rng.random_range(-0.6..0.6),
            rng.random_range(-0.6..0.6),
            0.6 * radius_m,
        );
        builder.blob(middle, Vec3::splat(radius_m), 0.25, rng);
    }
}

/// A bin, a transformer box or a bench.
pub fn add_box(builder: &mut Builder, rng: &mut impl Rng) {
    match rng.random_range(0..3) {
        0 => {
            builder.paint(classes::OTHER_OBJECT, 0.2);
            builder.frustum(
                [Vec3::new(-0.25, -0.28, -0.2), Vec3::new(0.25, 0.28, -0.2)],
                [Vec3::new(-0.3, -0.36, 1.05), Vec3::new(0.3, 0.36, 1.05)],
            );
        }
        1 => {
            builder.paint(classes::OTHER_STRUCTURE, 0.5);
            let half_m = rng.random_range(0.3..0.8);
            let height_m = rng.random_range(0.9..1.6);
            builder.cuboid(
                Vec3::new(-0.2, -half_m, -0.3),
                Vec3::new(0.2, half_m, height_m),
            );
        }
        _ => {
            builder.paint(classes::OTHER_STRUCTURE, 0.4);
            builder.cuboid(Vec3::new(-0.25, -0.8, 0.4), Vec3::new(0.25, 0.8, 0.47));
            builder.cuboid(Vec3::new(0.22, -0.8, 0.47), Vec3::new(0.28, 0.8, 0.9));
            for y in [-0.65, 0.65] {
                builder.cuboid(
                    Vec3::new(-0.2, y - 0.05, -0.1),
                    Vec3::new(0.2, y + 0.05, 0.4),
                );
            }
        }
    }
}

/// A monument on steps for the middle of a square.
pub fn add_monument(builder: &mut Builder, rng: &mut impl Rng) {
    builder.paint(classes::OTHER_STRUCTURE, 0.6);
    for step in 0..3 {
        let half_m = 2.0 - 0.5 * step as f32;
        let low_m = 0.2 * step as f32 - if step == 0 { 0.5 } else { 0.0 };
        builder.cuboid(
            Vec3::new(-half_m, -half_m, low_m),
            Vec3::new(half_m, half_m, 0.2 * (step + 1) as f32),
        );
    }
    builder.cylinder(Vec3::Z * 0.6, [0.5, 0.35], rng.random_range(2.5..4.5), 12);
}

/// A garden wall, fence or hedge between two places, following the ground.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Barrier {
    /// Over the ground [m].
    pub height_m: f32,
    /// Across [m].
    pub thickness_m: f32,
    /// How far the corners of a hedge deviate [m].
    pub roughness_m: f32,
    /// Fence or vegetation.
    pub paint: Paint,
}

impl Barrier {
    /// A wall, a fence or a hedge.
    pub fn random(rng: &mut impl Rng) -> Self {
        let paint = |class, reflectance| Paint { class, reflectance };
        match rng.random_range(0..3) {
            0 => Self {
                height_m: rng.random_range(0.5..1.9),
                thickness_m: 0.25,
                roughness_m: 0.0,
                paint: paint(classes::FENCE, rng.random_range(0.3..0.7)),
            },
            1 => Self {
                height_m: rng.random_range(0.9..1.5),
                thickness_m: 0.06,
                roughness_m: 0.0,
                paint: paint(classes::FENCE, rng.random_range(0.2..0.5)),
            },
            _ => Self {
                height_m: rng.random_range(0.8..2.0),
                thickness_m: rng.random_range(0.5..0.9),
                roughness_m: 0.1,
                paint: paint(classes::VEGETATION, 0.45),
            },
        }
    }

    /// Adds a stretch of it.
    pub fn add_between(
        &self,
        target: &mut PaintedMesh,
        ground: &Ground,
        [from, to]: [DVec2; 2],
        rng: &mut impl Rng,
    ) {
        let across = (to - from).normalize_or(DVec2::X).perp() * f64::from(0.5 * self.thickness_m);
        let mut jitter = || {
            let r = self.roughness_m;
            Vec3::new(
                r * rng.random_range(-1.0..1.0),
                r * rng.random_range(-1.0..1.0),
                r * rng.random_range(-1.0..1.0),
            )
        };
        let ring = [from - across, to - across, to + across, from + across];
        let low = ring.map(|place| ground.point_at(place) - 0.4 * Vec3::Z);
        let high = ring.map(|place| ground.point_at(place) + self.height_m * Vec3::Z + jitter());
        let still = crate::geometry::Rigid3f {
            rotation: glam::Mat3::IDENTITY,
            translation: Vec3::ZERO,
        };
        let mut builder = Builder::new(target, still, self.paint);
        for side in 0..4 {
            let next = (side + 1) % 4;
            builder.quad([low[side], low[next], high[next], high[side]]);
        }
        builder.quad(high);
    }
}
