//! Houses: walls with recessed windows and doors, roofs, and what sticks out of them.
//!
//! The frame of a house: origin in the middle of its front on the ground, x along the front, y
//! into the house, z up.

use glam::Vec3;
use rand::{Rng, RngExt as _};

use super::builder::Builder;
use super::classes;

/// How deep the walls go below the ground at the front, for slopes [m].
const FOUNDATION_M: f32 = 1.5;
const GLASS_REFLECTANCE: f32 = 0.08;

/// The size of a house.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HouseShape {
    /// Along the street [m].
    pub width_m: f32,
    /// Away from the street [m].
    pub depth_m: f32,
    /// Number of storeys.
    pub storeys: usize,
}

impl HouseShape {
    /// A terraced, detached or apartment house.
    pub fn random(rng: &mut impl Rng) -> Self {
        Self {
            width_m: rng.random_range(7.0..16.0),
            depth_m: rng.random_range(7.0..11.5),
            storeys: [1, 2, 2, 2, 3, 3, 4][rng.random_range(0..7)],
        }
    }
}

/// Openings of a wall as breaks along it: even intervals are wall, odd ones hold openings.
struct Openings {
    along_m: Vec<f32>,
    rows: Vec<[f32; 2]>,
    /// Interval that holds a door instead of a window on the lowest row.
    door: Option<usize>,
    recess_m: f32,
}

/// Adds a house.
pub fn add_house(builder: &mut Builder, shape: &HouseShape, rng: &mut impl Rng) {
    let storey_m = rng.random_range(2.7..3.2_f32);
    let wall_m = storey_m * shape.storeys as f32 + rng.random_range(0.2..0.8);
    let plaster = rng.random_range(0.3..0.8);
    let (half, depth_m) = (0.5 * shape.width_m, shape.depth_m);
    let sill_m = rng.random_range(0.8..1.1);
    let rows: Vec<[f32; 2]> = (0..shape.storeys)
        .map(|storey| {
            let floor_m = storey as f32 * storey_m + 0.3;
            [floor_m + sill_m, floor_m + sill_m + 1.25]
        })
        .collect();
    let recess_m = rng.random_range(0.1..0.3);
    let walls = [
        (Vec3::new(-half, 0.0, 0.0), Vec3::X, shape.width_m, true),
        (Vec3::new(half, 0.0, 0.0), Vec3::Y, depth_m, false),
        (Vec3::new(half, depth_m, 0.0), -Vec3::X, shape.width_m, true),
        (Vec3::new(-half, depth_m, 0.0), -Vec3::Y, depth_m, false),
    ];
    for (index, (origin, along, length_m, has_many)) in walls.into_iter().enumerate() {
        let spacing_m = if has_many {
            rng.random_range(2.2..3.4)
        } else {
            rng.random_range(3.5..6.0)
        };
        let along_m = window_breaks(length_m, spacing_m, rng);
        let door = (index == 0).then(|| 2 * rng.random_range(0..along_m.len() / 2) + 1);
        let openings = Openings {
            along_m,
            rows: rows.clone(),
            door,
            recess_m,
        };
        add_wall(builder, origin, along, wall_m, &openings, plaster);
    }
    builder.paint(classes::BUILDING, rng.random_range(0.2..0.4));
    add_roof(builder, shape, wall_m, rng);
    builder.paint(classes::BUILDING, plaster);
    add_extras(builder, shape, storey_m, rng);
}

/// Alternating widths of wall and window along a wall, starting and ending with wall.
fn window_breaks(length_m: f32, spacing_m: f32, rng: &mut impl Rng) -> Vec<f32> {
    let count = ((length_m - 0.8) / spacing_m).floor().max(1.0) as usize;
    let pitch_m = length_m / count as f32;
    let mut breaks = vec![0.0];
    for window in 0..count {
        let width_m = rng.random_range(0.9..1.5_f32).min(0.6 * pitch_m);
        let left_m = (window as f32 + 0.5) * pitch_m - 0.5 * width_m + rng.random_range(-0.1..0.1);
        breaks.extend([left_m, left_m + width_m]);
    }
    breaks.push(length_m);
    breaks
}

fn add_wall(
    builder: &mut Builder,
    origin: Vec3,
    along: Vec3,
    height_m: f32,
    openings: &Openings,
    plaster: f32,
) {
    let inwards = Vec3::Z.cross(along);
    let at = |x: f32, z: f32, depth_m: f32| origin + along * x + Vec3::Z * z + inwards * depth_m;
    for (interval, ends) in openings.along_m.windows(2).enumerate() {
        let [x0, x1] = [ends[0], ends[1]];
        let mut z = -FOUNDATION_M;
        let panel = |builder: &mut Builder, z0: f32, z1: f32, depth_m: f32| {
            builder.quad([
                at(x0, z0, depth_m),
                at(x1, z0, depth_m),
                at(x1, z1, depth_m),
                at(x0, z1, depth_m),
            ]);
        };
        if interval % 2 == 1 {
            for (row, &[low, high]) in openings.rows.iter().enumerate() {
                let is_door = row == 0 && openings.door == Some(interval);
                let low = if is_door { 0.1 } else { low };
                builder.paint(classes::BUILDING, plaster);
                panel(builder, z, low, 0.0);
                let depth_m = openings.recess_m;
                add_reveal(builder, &at, [x0, x1], [low, high], depth_m);
                let pane = if is_door { 0.3 } else { GLASS_REFLECTANCE };
                builder.paint(classes::BUILDING, pane);
                panel(builder, low, high, depth_m);
                z = high;
            }
        }
        builder.paint(classes::BUILDING, plaster);
        panel(builder, z, height_m, 0.0);
    }
}

/// The four narrow faces between a wall and its recessed pane.
fn add_reveal(
    builder: &mut Builder,
    at: &impl Fn(f32, f32, f32) -> Vec3,
    [x0, x1]: [f32; 2],
    [z0, z1]: [f32; 2],
    depth_m: f32,
) {
    let frame = [(x0, z0), (x1, z0), (x1, z1), (x0, z1)];
    for index in 0..4 {
        let (p, q) = (frame[index], frame[(index + 1) % 4]);
        builder.quad([
            at(p.0, p.1, 0.0),
            at(q.0, q.1, 0.0),
            at(q.0, q.1, depth_m),
            at(p.0, p.1, depth_m),
        ]);
    }
}

fn add_roof(builder: &mut Builder, shape: &HouseShape, wall_m: f32, rng: &mut impl Rng) {
    let (half, depth_m) = (0.5 * shape.width_m, shape.depth_m);
    if rng.random_bool(0.3) {
        // Flat, with a parapet.
        builder.cuboid(
            Vec3::new(-half - 0.1, -0.1, wall_m - 0.1),
            Vec3::new(half + 0.1, depth_m + 0.1, wall_m + 0.4),
        );
        return;
    }
    let overhang_m = rng.random_range(0.2..0.7);
    let rise_m = 0.5 * depth_m * rng.random_range(0.5..1.1);
    let ridge_inset_m = if rng.random_bool(0.3) {
        rng.random_range(1.0..3.0) // hipped
    } else {
        0.0
    };
    let eaves = [-overhang_m, depth_m + overhang_m];
    let ends = [-half - overhang_m, half + overhang_m];
    let ridge = |x: f32| Vec3::new(x, 0.5 * depth_m, wall_m + rise_m);
    let eave = |x: f32, y: f32| Vec3::new(x, y, wall_m - 0.1);
    let [left, right] = [
        ridge(ends[0] + ridge_inset_m),
        ridge(ends[1] - ridge_inset_m),
    ];
    builder.quad([
        eave(ends[0], eaves[0]),
        eave(ends[1], eaves[0]),
        right,
        left,
    ]);
    builder.quad([
        eave(ends[1], eaves[1]),
        eave(ends[0], eaves[1]),
        left,
        right,
    ]);
    builder.triangle([eave(ends[1], eaves[0]), eave(ends[1], eaves[1]), right]);
    builder.triangle([eave(ends[0], eaves[1]), eave(ends[0], eaves[0]), left]);
    builder.quad([
        eave(ends[0], eaves[1]),
        eave(ends[1], eaves[1]),
        eave(ends[1], eaves[0]),
        eave(ends[0], eaves[0]),
    ]);
    let x = rng.random_range(-0.6 * half..0.6 * half);
    let y = depth_m * rng.random_range(0.3..0.7);
    builder.cuboid(
        Vec3::new(x, y, wall_m),
        Vec3::new(x + 0.7, y + 0.7, wall_m + rise_m + 0.8),
    );
}

/// Steps, balconies, bay windows, a porch.
fn add_extras(builder: &mut Builder, shape: &HouseShape, storey_m: f32, rng: &mut impl Rng) {
    let half = 0.5 * shape.width_m;
    let step_x = rng.random_range(-half + 0.5..half - 2.0);
    builder.cuboid(
        Vec3::new(step_x, -1.0, -FOUNDATION_M),
        Vec3::new(step_x + 1.5, 0.0, 0.25),
    );
    for storey in 1..shape.storeys {
        if rng.random_bool(0.4) {
            let width_m = rng.random_range(2.0..4.0_f32).min(half);
            let x = rng.random_range(-half..half - width_m);
            let floor_m = storey as f32 * storey_m;
            let depth_m = rng.random_range(0.8..1.4);
            builder.cuboid(
                Vec3::new(x, -depth_m, floor_m),
                Vec3::new(x + width_m, 0.0, floor_m + 0.2),
            );
            builder.cuboid(
                Vec3::new(x, -depth_m, floor_m + 0.2),
                Vec3::new(x + width_m, -depth_m + 0.08, floor_m + 1.1),
            );
        }
    }
    if rng.random_bool(0.3) {
        let x = rng.random_range(-half..half - 2.5);
        let top_m = storey_m * shape.storeys.min(2) as f32;
        builder.cuboid(
            Vec3::new(x, -0.7, -FOUNDATION_M),
            Vec3::new(x + 2.5, 0.0, top_m),
        );
    }
}

/// A garage or shed with a door.
pub fn add_garage(builder: &mut Builder, rng: &mut impl Rng) {
    let (half, depth_m) = (rng.random_range(1.5..2.0_f32), rng.random_range(5.0..6.5));
    let height_m = rng.random_range(2.3..2.9);
    builder.paint(classes::BUILDING, rng.random_range(0.3..0.7));
    builder.cuboid(
        Vec3::new(-half, 0.0, -FOUNDATION_M),
        Vec3::new(half, depth_m, height_m),
    );
    builder.cuboid(
        Vec3::new(-half - 0.15, -0.25, height_m),
        Vec3::new(half + 0.15, depth_m + 0.1, height_m + 0.18),
    );
}
