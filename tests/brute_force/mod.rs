//! Brute-force ray casting in `f64`, and scenes for it.

use fpmcl::geometry::{Pose3, TriangleMesh, Vec3};
use fpmcl::lidar::Beam;
use fpmcl::rendering::RangeDifference;
use nalgebra::Vector3;

/// Ray caster that intersects every ray with every triangle.
#[derive(Clone)]
pub struct BruteForce {
    triangles: Vec<[Vector3<f64>; 3]>,
    limits_m: (f64, f64),
}

fn double(v: Vec3) -> Vector3<f64> {
    Vector3::new(v.x, v.y, v.z).cast()
}

impl BruteForce {
    pub fn new(tiles: &[TriangleMesh]) -> Self {
        let triangles = tiles
            .iter()
            .flat_map(|tile| (0..tile.triangles.len()).map(|t| tile.corners(t).map(double)))
            .collect();
        Self {
            triangles,
            limits_m: (0.0, f64::INFINITY),
        }
    }

    /// Sets limits outside which ranges are infinite [m].
    pub fn between(mut self, min_m: f32, max_m: f32) -> Self {
        self.limits_m = (f64::from(min_m), f64::from(max_m));
        self
    }

    /// Range along a direction of the lidar frame [m].
    pub fn range(&self, map_from_lidar: &Pose3, direction: Vec3) -> f64 {
        let origin = map_from_lidar.translation.vector;
        let direction = map_from_lidar.rotation * double(direction);
        let ranges = self
            .triangles
            .iter()
            .filter_map(|t| intersect(t, origin, direction));
        let nearest = ranges.fold(f64::INFINITY, f64::min);
        let (min_m, max_m) = self.limits_m;
        if min_m < nearest && nearest < max_m {
            nearest
        } else {
            f64::INFINITY
        }
    }

    /// Mean cost of the beams [m].
    pub fn mean_cost(&self, pose: &Pose3, beams: &[Beam], difference: &RangeDifference) -> f64 {
        let costs = beams.iter().map(|beam| {
            let rendered_m = self.range(pose, beam.direction) as f32;
            f64::from(difference.cost(beam.range_m, rendered_m))
        });
        costs.sum::<f64>() / beams.len() as f64
    }
}

/// Möller and Trumbore, *Fast, Minimum Storage Ray/Triangle Intersection*, 1997.
fn intersect(corners: &[Vector3<f64>; 3], origin: Vector3<f64>, d: Vector3<f64>) -> Option<f64> {
    let [a, b, c] = corners;
    let (ab, ac) = (b - a, c - a);
    let p = d.cross(&ac);
    let determinant = ab.dot(&p);
    if determinant == 0.0 {
        return None;
    }
    let s = (origin - a) / determinant;
    let q = s.cross(&ab);
    let (u, v, range_m) = (s.dot(&p), d.dot(&q), ac.dot(&q));
    // Tolerance for rounding in `f64`.
    let inside = u >= -1e-12 && v >= -1e-12 && u + v <= 1.0 + 1e-12;
    (inside && range_m > 1e-4).then_some(range_m)
}

/// Adds a rectangle at `corner` with two edges, as `cuts` by `cuts` quads of two triangles.
fn rectangle(mesh: &mut TriangleMesh, corner: Vec3, edges: [Vec3; 2], cuts: u32) {
    let first = mesh.vertices.len() as u32;
    for i in 0..=cuts {
        for j in 0..=cuts {
            let (s, t) = (i as f32 / cuts as f32, j as f32 / cuts as f32);
            mesh.vertices.push(corner + s * edges[0] + t * edges[1]);
        }
    }
    for i in 0..cuts {
        for j in 0..cuts {
            let at = first + i * (cuts + 1) + j;
            let above = at + cuts + 1;
            mesh.triangles.push([at, above, above + 1]);
            mesh.triangles.push([at, above + 1, at + 1]);
        }
    }
}

fn cuboid(mesh: &mut TriangleMesh, center: Vec3, half: Vec3, cuts: u32) {
    let (x, y, z) = (
        2.0 * half.x * Vec3::X,
        2.0 * half.y * Vec3::Y,
        2.0 * half.z * Vec3::Z,
    );
    let low = center - half;
    for (side, edges) in [(z, [x, y]), (y, [x, z]), (x, [y, z])] {
        rectangle(mesh, low, edges, cuts);
        rectangle(mesh, low + side, edges, cuts);
    }
}

/// A cube around the origin, seen from inside.
pub fn room(half_m: f32, cuts: u32) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    cuboid(&mut mesh, Vec3::ZERO, Vec3::splat(half_m), cuts);
    mesh
}

/// A street of 80 m in two tiles: an undulating road, houses, cars, poles and a bridge.
pub fn street() -> Vec<TriangleMesh> {
    [-40.0_f32, 0.0].map(half_street).to_vec()
}

fn half_street(from_m: f32) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    rectangle(
        &mut mesh,
        Vec3::new(from_m, -10.0, 0.0),
        [40.0 * Vec3::X, 20.0 * Vec3::Y],
        20,
    );
    for vertex in &mut mesh.vertices {
        vertex.z = 0.1 * (0.3 * vertex.x).sin() - 0.002 * vertex.y * vertex.y;
    }
    for house in 0..4_u8 {
        let x = from_m + 5.0 + 10.0 * f32::from(house);
        let height = 2.0 + 0.7 * f32::from(house);
        for side in [-1.0, 1.0] {
            let center = Vec3::new(x, side * 12.0, height - 0.5);
            cuboid(&mut mesh, center, Vec3::new(4.0, 3.0, height), 3);
            let pole = Vec3::new(x + 4.5, side * 5.5, 2.0);
            cuboid(&mut mesh, pole, Vec3::new(0.08, 0.08, 2.5), 1);
        }
        let car = Vec3::new(x, 4.0, 0.7);
        cuboid(&mut mesh, car, Vec3::new(2.1, 0.9, 0.7), 2);
    }
    cuboid(
        &mut mesh,
        Vec3::new(from_m + 20.0, 0.0, 6.0),
        Vec3::new(2.0, 9.0, 0.3),
        1,
    );
    mesh
}
