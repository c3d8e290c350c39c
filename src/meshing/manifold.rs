//! Vertices where pieces of surface touch in nothing but that vertex, as they are left when triangles
//! have been removed: each piece gets a vertex of its own, and every vertex one fan of triangles.

use crate::geometry::TriangleMesh;

/// Gives each fan of triangles around a vertex a vertex of its own, at the same place and with
/// the same normal and colour; returns how many were added. The surface stays as it is.
pub fn split_fans(mesh: &mut TriangleMesh) -> usize {
    let count = mesh.vertices.len();
    let (starts, corners) = corners_by_vertex(&mesh.triangles, count);
    for vertex in 0..count {
        let corners = &corners[starts[vertex]..starts[vertex + 1]];
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

/// The corners at each vertex: where they start, and all of them. Corner 3 t + k is corner k of
/// triangle t.
fn corners_by_vertex(triangles: &[[u32; 3]], vertices: usize) -> (Vec<usize>, Vec<u32>) {
    let mut ends = vec![0_usize; vertices + 1];
    for vertex in triangles.iter().flatten() {
        ends[*vertex as usize + 1] += 1;
    }
    for index in 1..ends.len() {
        ends[index] += ends[index - 1];
    }
    let starts = ends.clone();
    let mut corners = vec![0; 3 * triangles.len()];
    for (corner, vertex) in triangles.iter().flatten().enumerate() {
        corners[ends[*vertex as usize]] = corner as u32;
        ends[*vertex as usize] += 1;
    }
    (starts, corners)
}

/// The number of the fan of each corner at one vertex, from 0. Triangles of a fan are connected by
/// edges at the vertex.
fn fans(triangles: &[[u32; 3]], corners: &[u32]) -> Vec<usize> {
    let others = |corner: u32| {
        let triangle = triangles[corner as usize / 3];
        [1, 2].map(|step| triangle[(corner as usize + step) % 3])
    };
    let mut fans = vec![usize::MAX; corners.len()];
    let mut fan = 0;
    let mut reached = Vec::new();
    for start in 0..corners.len() {
        if fans[start] != usize::MAX {
            continue;
        }
        fans[start] = fan;
        reached.push(start);
        while let Some(here) = reached.pop() {
            let edges = others(corners[here]);
            for (next, of) in fans.iter_mut().enumerate() {
                let is_beside = || others(corners[next]).iter().any(|v| edges.contains(v));
                if *of == usize::MAX && is_beside() {
                    *of = fan;
                    reached.push(next);
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

    use super::super::shapes::Topology;
    use super::*;

    /// A disc of six triangles around vertex 0, without some of them.
    fn disc(without: &[usize]) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        mesh.vertices.push(Vec3::ZERO);
        for k in 0..6 {
            let (y, x) = (k as f32 / 6.0 * std::f32::consts::TAU).sin_cos();
            mesh.vertices.push(Vec3::new(x, y, 0.0));
        }
        mesh.compute_normals();
        mesh.colors = (0..7).map(|k| [k, 0, 0]).collect();
        mesh.triangles = (0..6).map(|k| [0, 1 + k, 1 + (k + 1) % 6]).collect();
        mesh.retain_triangles(|triangle| !without.contains(&triangle));
        mesh
    }

    #[test]
    fn pieces_that_touch_in_a_vertex_get_one_each_and_no_triangle_moves() {
        for (without, copies) in [(&[0, 3][..], 1), (&[0, 2, 4], 2)] {
            let whole = disc(without);
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
    fn a_ring_and_a_single_fan_stay_as_they_are() {
        for without in [&[][..], &[0], &[0, 1]] {
            let whole = disc(without);
            let mut split = whole.clone();
            assert_eq!(split_fans(&mut split), 0);
            assert_eq!(split, whole);
        }
    }
}
