//! A street of 300 m as a mesh of about 1.3 million triangles: bumpy ground, house fronts with
//! windows, trees and parked cars. Deterministic for a seed.

use std::f32::consts::TAU;

use fpmcl::geometry::{TriangleMesh, Vec3};
use glam::{Mat3, Vec2};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

const LENGTH_M: f32 = 300.0;
const HALF_WIDTH_M: f32 = 20.0;
/// Edge length of the triangles [m].
const STEP_M: f32 = 0.2;
/// Heading of the street, not parallel to an axis [rad].
const HEADING_RAD: f32 = 0.3;

/// The street in one mesh.
pub fn street(seed: u64) -> TriangleMesh {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut mesh = ground();
    for side in [-1.0, 1.0] {
        mesh.append(&fronts(side));
    }
    for number in 0..60 {
        let side = if number % 2 == 0 { 1.0 } else { -1.0 };
        let along_m = 5.0 * number as f32 + rng.random_range(0.0..3.0);
        let foot = Vec3::new(along_m, side * rng.random_range(8.0..9.5), 0.0);
        let crown_m = rng.random_range(1.5..2.5);
        mesh.append(&tree(foot, crown_m));
        mesh.append(&car(foot + Vec3::new(2.5, -1.5 * side, 0.7)));
    }
    let turn = Mat3::from_rotation_z(HEADING_RAD);
    for vertex in &mut mesh.vertices {
        *vertex = turn * *vertex;
    }
    mesh
}

/// Position 1.73 m above the road at a fraction of the length of the street.
pub fn on_the_road(fraction: f32, lateral_m: f32) -> Vec3 {
    Mat3::from_rotation_z(HEADING_RAD) * Vec3::new(fraction * LENGTH_M, lateral_m, 1.73)
}

/// Splits a mesh into square tiles by the centroids of its triangles, in row-major order.
pub fn tiles(mesh: &TriangleMesh, size_m: f32) -> Vec<TriangleMesh> {
    let bounds = mesh.bounds();
    let cells = (bounds.size() / size_m).ceil();
    let tile_of = |triangle: usize| {
        let [a, b, c] = mesh.corners(triangle);
        let cell = (((a + b + c) / 3.0 - bounds.min) / size_m).floor();
        (cell.y * cells.x + cell.x) as usize
    };
    (0..(cells.x * cells.y) as usize)
        .map(|tile| {
            let mut part = mesh.clone();
            part.retain_triangles(|index, _| tile_of(index) == tile);
            part
        })
        .collect()
}

/// Parametric surface of `columns` x `rows` quads; the parameters range from 0 to 1.
fn surface(columns: usize, rows: usize, position: impl Fn(Vec2) -> Vec3) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for row in 0..=rows {
        for column in 0..=columns {
            let at = Vec2::new(column as f32 / columns as f32, row as f32 / rows as f32);
            mesh.vertices.push(position(at));
        }
    }
    for row in 0..rows {
        for column in 0..columns {
            let corner =
                |right: usize, up: usize| ((row + up) * (columns + 1) + column + right) as u32;
            let [a, b, c, d] = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
            mesh.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh
}

fn bump(x: f32, y: f32) -> f32 {
    0.03 * (1.7 * x).sin() * (1.3 * y).cos() + 0.02 * (0.31 * x + 0.7 * y).sin()
}

fn ground() -> TriangleMesh {
    let columns = (LENGTH_M / STEP_M) as usize;
    let rows = (2.0 * HALF_WIDTH_M / STEP_M) as usize;
    surface(columns, rows, |at| {
        let (x, y) = (at.x * LENGTH_M, (2.0 * at.y - 1.0) * HALF_WIDTH_M);
        let kerb = if y.abs() > 6.0 { 0.12 } else { 0.0 };
        Vec3::new(x, y, kerb + bump(x, y))
    })
}

fn fronts(side: f32) -> TriangleMesh {
    const HEIGHT_M: f32 = 10.0;
    let columns = (LENGTH_M / STEP_M) as usize;
    let rows = (HEIGHT_M / STEP_M) as usize;
    surface(columns, rows, |at| {
        let (x, z) = (at.x * LENGTH_M, at.y * HEIGHT_M);
        let window = (x % 3.0) > 1.8 && (z % 2.8) > 1.2;
        let house = 0.8 * ((x / 14.0).floor() * 12.9898).sin();
        let depth_m = house + if window { 0.25 } else { 0.0 } + bump(x, z);
        Vec3::new(x, side * (12.0 + depth_m), z)
    })
}

/// A trunk and a rough crown.
fn tree(foot: Vec3, crown_m: f32) -> TriangleMesh {
    let mut mesh = surface(12, 20, |at| {
        let turn = Vec2::from_angle(at.x * TAU);
        foot + Vec3::new(0.18 * turn.x, 0.18 * turn.y, 3.0 * at.y)
    });
    mesh.append(&ellipsoid(
        foot + Vec3::Z * (2.6 + crown_m),
        Vec3::splat(crown_m),
        0.25,
    ));
    mesh
}

fn car(center: Vec3) -> TriangleMesh {
    ellipsoid(center, Vec3::new(2.1, 0.9, 0.7), 0.02)
}

/// An ellipsoid with a rough surface; `roughness` is relative to the radii.
fn ellipsoid(center: Vec3, radii: Vec3, roughness: f32) -> TriangleMesh {
    surface(56, 28, |at| {
        let around = Vec2::from_angle(at.x * TAU);
        let up = Vec2::from_angle((at.y - 0.5) * 0.5 * TAU);
        let scale = 1.0 + roughness * (7.0 * at.x * TAU).sin() * (23.0 * at.y).sin();
        center + scale * radii * Vec3::new(up.x * around.x, up.x * around.y, up.y)
    })
}
