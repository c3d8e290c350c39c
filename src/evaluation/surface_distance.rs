//! Distances from points to a mesh, up to a limit.
//!
//! The points are sorted into cubic cells; every triangle is compared with the points of the cells that
//! its bounding box, grown by the limit, overlaps. The memory is proportional to the points, whatever
//! the size of the mesh.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU32, Ordering};

use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::geometry::TriangleMesh;

/// Returns the distance from each point to the nearest triangle of a mesh [m]; infinite beyond `limit_m`,
/// which must be greater than 0.
pub fn distances_m(points: &[Vec3], mesh: &TriangleMesh, limit_m: f32) -> Vec<f32> {
    let cell_of = |point: Vec3| (point / limit_m).floor().as_ivec3();
    let mut order: Vec<([i32; 3], u32)> = points
        .par_iter()
        .zip(0..points.len() as u32)
        .map(|(&point, index)| (cell_of(point).to_array(), index))
        .collect();
    order.par_sort_unstable();
    let mut cells: HashMap<IVec3, &[([i32; 3], u32)]> = HashMap::new();
    for members in order.chunk_by(|a, b| a.0 == b.0) {
        cells.insert(IVec3::from_array(members[0].0), members);
    }
    // Non-negative floats have the order of their bits.
    let least: Vec<AtomicU32> = std::iter::repeat_with(|| AtomicU32::new(f32::INFINITY.to_bits()))
        .take(points.len())
        .collect();
    (0..mesh.triangles.len())
        .into_par_iter()
        .for_each(|triangle| {
            let corners = mesh.corners(triangle);
            for_each_cell_near(corners, limit_m, |cell| {
                for &(_, index) in cells.get(&cell).copied().unwrap_or_default() {
                    let distance_m = to_triangle_m(points[index as usize], corners);
                    if distance_m <= limit_m {
                        least[index as usize].fetch_min(distance_m.to_bits(), Ordering::Relaxed);
                    }
                }
            });
        });
    least
        .into_iter()
        .map(|bits| f32::from_bits(bits.into_inner()))
        .collect()
}

/// Visits the cells of edge `limit_m` that may hold a point within `limit_m` of a triangle.
fn for_each_cell_near([a, b, c]: [Vec3; 3], limit_m: f32, mut visit: impl FnMut(IVec3)) {
    let low = ((a.min(b).min(c) - limit_m) / limit_m).floor().as_ivec3();
    let high = ((a.max(b).max(c) + limit_m) / limit_m).floor().as_ivec3();
    let normal = (b - a).cross(c - a).normalize_or_zero();
    // Most cells in the bounding box of a large triangle are far from its plane.
    let reach_m = limit_m * (1.0 + 0.5 * 3.0_f32.sqrt());
    for z in low.z..=high.z {
        for y in low.y..=high.y {
            for x in low.x..=high.x {
                let cell = IVec3::new(x, y, z);
                let middle = (cell.as_vec3() + 0.5) * limit_m;
                if normal.dot(middle - a).abs() <= reach_m {
                    visit(cell);
                }
            }
        }
    }
}

/// Returns the distance from a point to a triangle [m].
fn to_triangle_m(p: Vec3, [a, b, c]: [Vec3; 3]) -> f32 {
    let normal = (b - a).cross(c - a).normalize_or_zero();
    let sides = [(a, b), (b, c), (c, a)];
    let is_over = (sides.iter()).all(|(s, e)| (e - s).cross(p - s).dot(normal) >= 0.0);
    if is_over && normal != Vec3::ZERO {
        return (p - a).dot(normal).abs();
    }
    sides.iter().fold(f32::INFINITY, |least, &(s, e)| {
        let along = (p - s).dot(e - s) / (e - s).length_squared().max(f32::MIN_POSITIVE);
        least.min(p.distance(s + along.clamp(0.0, 1.0) * (e - s)))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn triangle() -> TriangleMesh {
        TriangleMesh {
            vertices: vec![
                Vec3::new(0.0, 0.0, 1.0),
                Vec3::new(4.0, 0.0, 1.0),
                Vec3::new(0.0, 4.0, 1.0),
            ],
            triangles: vec![[0, 1, 2]],
            ..TriangleMesh::default()
        }
    }

    #[test]
    fn the_distance_is_to_the_face_an_edge_or_a_corner() {
        let cases = [
            (Vec3::new(1.0, 1.0, 1.3), 0.3),
            (Vec3::new(1.0, 1.0, 0.6), 0.4),
            (Vec3::new(2.0, -0.2, 1.0), 0.2),
            (Vec3::new(-0.3, -0.3, 1.0), 0.3 * 2.0_f32.sqrt()),
            (Vec3::new(4.1, 0.0, 1.0), 0.1),
        ];
        let points = cases.map(|(point, _)| point);
        for (found, (point, expected)) in distances_m(&points, &triangle(), 0.5)
            .into_iter()
            .zip(cases)
        {
            assert!((found - expected).abs() < 1e-5, "{point}: {found}");
        }
    }

    #[test]
    fn beyond_the_limit_and_without_a_mesh_the_distance_is_infinite() {
        let point = [Vec3::new(1.0, 1.0, 1.6)];
        assert_eq!(distances_m(&point, &triangle(), 0.5), [f32::INFINITY]);
        let empty = TriangleMesh::default();
        assert_eq!(distances_m(&point, &empty, 0.5), [f32::INFINITY]);
    }
}
