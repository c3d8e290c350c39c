//! Repair of non-manifold vertices, where fans of triangles touch in nothing but the vertex, as they
//! remain after the removal of triangles.

use super::adjacency::{VertexCorners, opposite_edge};
use crate::geometry::TriangleMesh;

/// Gives each fan of triangles around a vertex its own copy of the vertex, with the same position,
/// normal and color; returns the number of copies.
pub fn split_fans(mesh: &mut TriangleMesh) -> usize {
    let count = mesh.vertices.len();
    let vertex_corners = VertexCorners::new(&mesh.triangles, count);
    for vertex in 0..count {
        let corners = vertex_corners.of(vertex);
        let fans = fans(&mesh.triangles, corners);
        for fan in 1..=fans.iter().copied().max().unwrap_or(0) {
            let copy = mesh.vertices.len() as u32;
            mesh.vertices.push(mesh.vertices[vertex]);
            if !mesh.normals.is_empty() {
                mesh.normals.push(mesh.normals[vertex]);
            }
            if !mesh.colors.is_empty() {
                mesh.colors.push(mesh.colors[vertex]);
            }
            for (&corner, _) in corners.iter().zip(&fans).filter(|(_, of)| **of == fan) {
                mesh.triangles[corner as usize / 3][corner as usize % 3] = copy;
            }
        }
    }
    mesh.vertices.len() - count
}

/// The number of the fan of each corner at one vertex, from 0. Triangles of a fan are connected by
/// edges at the vertex.
fn fans(triangles: &[[u32; 3]], corners: &[u32]) -> Vec<usize> {
    let edges: Vec<(u32, u32)> = (corners.iter())
        .map(|&corner| opposite_edge(triangles, corner))
        .collect();
    let is_adjacent = |a: usize, b: usize| {
        let ((a0, a1), (b0, b1)) = (edges[a], edges[b]);
        a0 == b0 || a0 == b1 || a1 == b0 || a1 == b1
    };
    let mut fans = vec![usize::MAX; corners.len()];
    let mut fan = 0;
    let mut open = Vec::new();
    for start in 0..corners.len() {
        if fans[start] != usize::MAX {
            continue;
        }
        fans[start] = fan;
        open.push(start);
        while let Some(here) = open.pop() {
            for (next, of) in fans.iter_mut().enumerate() {
                if *of == usize::MAX && is_adjacent(here, next) {
                    *of = fan;
                    open.push(next);
                }
            }
        }
        fan += 1;
    }
    fans
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::super::shapes_for_tests::Topology;
    use super::*;

    /// A disk of six triangles around vertex 0, without some of them.
    fn disk(without: &[usize]) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        mesh.vertices.push(Vec3::ZERO);
        for k in 0..6 {
            let (y, x) = (k as f32 / 6.0 * std::f32::consts::TAU).sin_cos();
            mesh.vertices.push(Vec3::new(x, y, 0.0));
        }
        mesh.compute_normals();
        mesh.colors = (0..7).map(|k| [k, 0, 0]).collect();
        mesh.triangles = (0..6).map(|k| [0, 1 + k, 1 + (k + 1) % 6]).collect();
        mesh.retain_triangles(|index, _| !without.contains(&index));
        mesh
    }

    #[test]
    fn fans_that_touch_in_a_vertex_are_separated_and_no_triangle_moves() {
        for (without, copies) in [(&[0, 3][..], 1), (&[0, 2, 4], 2)] {
            let whole = disk(without);
            assert!(!Topology::of(&whole).is_manifold());
            let mut split = whole.clone();
            assert_eq!(split_fans(&mut split), copies);
            assert!(Topology::of(&split).is_manifold());
            assert_eq!(split.vertices.len(), whole.vertices.len() + copies);
            assert_eq!(split.normals.len(), split.vertices.len());
            for triangle in 0..whole.triangles.len() {
                assert_eq!(split.corners(triangle), whole.corners(triangle));
                let color = |mesh: &TriangleMesh| {
                    mesh.triangles[triangle].map(|vertex| mesh.colors[vertex as usize])
                };
                assert_eq!(color(&split), color(&whole));
            }
        }
    }

    #[test]
    fn a_ring_and_a_single_fan_are_unchanged() {
        for without in [&[][..], &[0], &[0, 1]] {
            let whole = disk(without);
            let mut split = whole.clone();
            assert_eq!(split_fans(&mut split), 0);
            assert_eq!(split, whole);
        }
    }
}
