//! Houses: facades with recessed windows and doors, roofs, and what projects from them.
//!
//! House frame: origin in the middle of the front on the ground, x along the front, y into the
//! house, z up.

use glam::Vec3;
use rand::{Rng, RngExt as _};

use super::builder::MeshBuilder;
use super::classes;

/// Depth of the walls below the ground at the front, for sloping ground [m].
const FOUNDATION_M: f32 = 1.5;
const GLASS_REFLECTANCE: f32 = 0.08;
const DOOR_REFLECTANCE: f32 = 0.3;

/// Size of a house.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HouseShape {
    /// Extent along the street [m].
    pub width_m: f32,
    /// Extent away from the street [m].
    pub depth_m: f32,
    /// Number of storeys.
    pub storeys: usize,
}

impl HouseShape {
    /// A random terraced, detached or apartment house.
    pub fn random(rng: &mut impl Rng) -> Self {
        Self {
            width_m: rng.random_range(7.0..16.0),
            depth_m: rng.random_range(7.0..11.5),
            storeys: [1, 2, 2, 2, 3, 3, 4][rng.random_range(0..7)],
        }
    }
}

/// Adds a house.
pub fn add_house(builder: &mut MeshBuilder, shape: &HouseShape, rng: &mut impl Rng) {
    let storey_m = rng.random_range(2.7..3.2_f32);
    let wall_m = storey_m * shape.storeys as f32 + rng.random_range(0.2..0.8);
    let plaster_reflectance = rng.random_range(0.3..0.8);
    let (half, depth_m) = (0.5 * shape.width_m, shape.depth_m);
    let sill_m = rng.random_range(0.8..1.1);
    let window_rows: Vec<[f32; 2]> = (0..shape.storeys)
        .map(|storey| {
            let floor_m = storey as f32 * storey_m + 0.3;
            [floor_m + sill_m, floor_m + sill_m + 1.25]
        })
        .collect();
    let recess_m = rng.random_range(0.1..0.3);
    let corners = [(-half, 0.0), (half, 0.0), (half, depth_m), (-half, depth_m)];
    for (side, (x, y)) in corners.into_iter().enumerate() {
        let is_gable = side % 2 == 1;
        let (length_m, spacing_m) = if is_gable {
            (depth_m, rng.random_range(3.5..6.0))
        } else {
            (shape.width_m, rng.random_range(2.2..3.4))
        };
        let breaks_m = window_breaks(length_m, spacing_m, rng);
        let door = (side == 0).then(|| 2 * rng.random_range(0..breaks_m.len() / 2) + 1);
        let facade = Facade {
            origin: Vec3::new(x, y, 0.0),
            along: [Vec3::X, Vec3::Y, -Vec3::X, -Vec3::Y][side],
            height_m: wall_m,
            plaster_reflectance,
            breaks_m,
            window_rows: &window_rows,
            door,
            recess_m,
        };
        facade.add_to(builder);
    }
    builder.set_material(classes::BUILDING, rng.random_range(0.2..0.4));
    add_roof(builder, shape, wall_m, rng);
    builder.set_material(classes::BUILDING, plaster_reflectance);
    add_projections(builder, shape, storey_m, rng);
}

/// Boundaries of alternating intervals of wall and window, starting and ending with wall [m].
fn window_breaks(length_m: f32, spacing_m: f32, rng: &mut impl Rng) -> Vec<f32> {
    let count = ((length_m - 0.8) / spacing_m).floor().max(1.0) as usize;
    let pitch_m = length_m / count as f32;
    let mut breaks_m = vec![0.0];
    for window in 0..count {
        let width_m = rng.random_range(0.9..1.5_f32).min(0.6 * pitch_m);
        let left_m = (window as f32 + 0.5) * pitch_m - 0.5 * width_m + rng.random_range(-0.1..0.1);
        breaks_m.extend([left_m, left_m + width_m]);
    }
    breaks_m.push(length_m);
    breaks_m
}

/// A wall with rows of openings.
struct Facade<'a> {
    origin: Vec3,
    along: Vec3,
    height_m: f32,
    plaster_reflectance: f32,
    /// Even intervals between these are wall, odd ones hold openings.
    breaks_m: Vec<f32>,
    /// Lower and upper edge of the windows of each storey.
    window_rows: &'a [[f32; 2]],
    /// Interval that holds a door instead of a window on the lowest row.
    door: Option<usize>,
    recess_m: f32,
}

impl Facade<'_> {
    fn add_to(&self, builder: &mut MeshBuilder) {
        for (interval, ends) in self.breaks_m.windows(2).enumerate() {
            let x = [ends[0], ends[1]];
            let mut z = -FOUNDATION_M;
            if interval % 2 == 1 {
                for (row, &[low, high]) in self.window_rows.iter().enumerate() {
                    let is_door = row == 0 && self.door == Some(interval);
                    let (low, reflectance) = if is_door {
                        (0.1, DOOR_REFLECTANCE)
                    } else {
                        (low, GLASS_REFLECTANCE)
                    };
                    builder.set_material(classes::BUILDING, self.plaster_reflectance);
                    builder.quad(self.rectangle(x, [z, low], 0.0));
                    let pane = self.rectangle(x, [low, high], self.recess_m);
                    builder.side_faces(self.rectangle(x, [low, high], 0.0), pane);
                    builder.set_material(classes::BUILDING, reflectance);
                    builder.quad(pane);
                    z = high;
                }
            }
            builder.set_material(classes::BUILDING, self.plaster_reflectance);
            builder.quad(self.rectangle(x, [z, self.height_m], 0.0));
        }
    }

    /// Corners of an upright rectangle at a depth behind the wall.
    fn rectangle(&self, [x0, x1]: [f32; 2], [z0, z1]: [f32; 2], depth_m: f32) -> [Vec3; 4] {
        let inwards = Vec3::Z.cross(self.along);
        [(x0, z0), (x1, z0), (x1, z1), (x0, z1)]
            .map(|(x, z)| self.origin + self.along * x + Vec3::Z * z + inwards * depth_m)
    }
}

/// Adds a flat roof with a parapet, or a gabled or hipped roof with a chimney.
fn add_roof(builder: &mut MeshBuilder, shape: &HouseShape, wall_m: f32, rng: &mut impl Rng) {
    let (half, depth_m) = (0.5 * shape.width_m, shape.depth_m);
    let is_flat = rng.random_bool(0.3);
    if is_flat {
        let (x, y) = ([-half - 0.1, half + 0.1], [-0.1, depth_m + 0.1]);
        builder.cuboid(x, y, [wall_m - 0.1, wall_m + 0.4]);
        return;
    }
    let overhang_m = rng.random_range(0.2..0.7);
    let rise_m = 0.5 * depth_m * rng.random_range(0.5..1.1);
    let is_hipped = rng.random_bool(0.3);
    let ridge_inset_m = if is_hipped {
        rng.random_range(1.0..3.0)
    } else {
        0.0
    };
    let [x0, x1] = [-half - overhang_m, half + overhang_m];
    let [y0, y1] = [-overhang_m, depth_m + overhang_m];
    let [a, b, c, d] =
        [(x0, y0), (x1, y0), (x1, y1), (x0, y1)].map(|(x, y)| Vec3::new(x, y, wall_m - 0.1));
    let [left, right] = [x0 + ridge_inset_m, x1 - ridge_inset_m]
        .map(|x| Vec3::new(x, 0.5 * depth_m, wall_m + rise_m));
    builder.quad([a, b, right, left]);
    builder.quad([c, d, left, right]);
    builder.triangle([b, c, right]);
    builder.triangle([d, a, left]);
    builder.quad([d, c, b, a]);
    let x = rng.random_range(-0.6 * half..0.6 * half);
    let y = depth_m * rng.random_range(0.3..0.7);
    builder.cuboid([x, x + 0.7], [y, y + 0.7], [wall_m, wall_m + rise_m + 0.8]);
}

/// Adds steps, balconies with parapets, and a bay window.
fn add_projections(
    builder: &mut MeshBuilder,
    shape: &HouseShape,
    storey_m: f32,
    rng: &mut impl Rng,
) {
    let half = 0.5 * shape.width_m;
    let x = rng.random_range(-half + 0.5..half - 2.0);
    builder.cuboid([x, x + 1.5], [-1.0, 0.0], [-FOUNDATION_M, 0.25]);
    for storey in 1..shape.storeys {
        if rng.random_bool(0.4) {
            let width_m = rng.random_range(2.0..4.0_f32).min(half);
            let x = rng.random_range(-half..half - width_m);
            let x = [x, x + width_m];
            let floor_m = storey as f32 * storey_m;
            let depth_m = rng.random_range(0.8..1.4);
            builder.cuboid(x, [-depth_m, 0.0], [floor_m, floor_m + 0.2]);
            builder.cuboid(
                x,
                [-depth_m, -depth_m + 0.08],
                [floor_m + 0.2, floor_m + 1.1],
            );
        }
    }
    if rng.random_bool(0.3) {
        let x = rng.random_range(-half..half - 2.5);
        let top_m = storey_m * shape.storeys.min(2) as f32;
        builder.cuboid([x, x + 2.5], [-0.7, 0.0], [-FOUNDATION_M, top_m]);
    }
}

/// Adds a garage with a projecting flat roof.
pub fn add_garage(builder: &mut MeshBuilder, rng: &mut impl Rng) {
    let (half, depth_m) = (rng.random_range(1.5..2.0_f32), rng.random_range(5.0..6.5));
    let height_m = rng.random_range(2.3..2.9);
    builder.set_material(classes::BUILDING, rng.random_range(0.3..0.7));
    builder.cuboid([-half, half], [0.0, depth_m], [-FOUNDATION_M, height_m]);
    let (x, y) = ([-half - 0.15, half + 0.15], [-0.25, depth_m + 0.1]);
    builder.cuboid(x, y, [height_m, height_m + 0.18]);
}
