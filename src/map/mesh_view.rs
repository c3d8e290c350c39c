//! Meshes whose vertices and triangles are read by their indices, in memory or in a file, so that a map is never in
//! memory whole.

use std::collections::{HashMap, HashSet};

use glam::{DVec3, IVec3, Vec3};

use super::build::vertex_ground::is_ground_color;
use crate::geometry::{TriangleMesh, mesh::on_lattice};

/// A vertex of a map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Vertex {
    /// Map frame [m].
    pub position: DVec3,
    /// Unit normal.
    pub normal: Vec3,
    /// Red, green, blue.
    pub color: [u8; 3],
}

/// A mesh whose vertices and triangles are read by their indices.
pub trait MeshView: Send + Sync {
    /// Number of vertices.
    fn vertices(&self) -> usize;

    /// Number of triangles.
    fn triangles(&self) -> usize;

    /// A vertex by its index.
    fn vertex(&self, index: u32) -> Vertex;

    /// Indices of the corners of a triangle, counter-clockwise seen from the front.
    fn triangle(&self, index: usize) -> [u32; 3];

    /// Position of a vertex [m], map frame.
    fn position(&self, index: u32) -> DVec3 {
        self.vertex(index).position
    }

    /// Corners of a triangle [m], map frame.
    fn corners(&self, index: usize) -> [DVec3; 3] {
        self.triangle(index).map(|vertex| self.position(vertex))
    }

    /// Whether a triangle is coloured as ground.
    fn is_red(&self, index: usize) -> bool {
        (self.triangle(index).iter()).all(|&vertex| is_ground_color(&self.vertex(vertex).color))
    }

    /// Area of a triangle [m²].
    fn area_m2(&self, index: usize) -> f64 {
        let [a, b, c] = self.corners(index);
        0.5 * (b - a).cross(c - a).length()
    }
}

/// Missing normals point up, missing colours are grey.
impl MeshView for TriangleMesh {
    fn vertices(&self) -> usize {
        self.vertices.len()
    }

    fn triangles(&self) -> usize {
        self.triangles.len()
    }

    fn vertex(&self, index: u32) -> Vertex {
        let index = index as usize;
        Vertex {
            position: self.vertices[index].as_dvec3(),
            normal: self.normals.get(index).copied().unwrap_or(Vec3::Z),
            color: self.colors.get(index).copied().unwrap_or([128; 3]),
        }
    }

    fn triangle(&self, index: usize) -> [u32; 3] {
        self.triangles[index]
    }

    fn position(&self, index: u32) -> DVec3 {
        self.vertices[index as usize].as_dvec3()
    }
}

/// A mesh without some of its triangles, and without the vertices that only these have.
pub struct Without<'a> {
    mesh: &'a dyn MeshView,
    /// Indices of what is left, ascending.
    triangles: Vec<u32>,
    vertices: Vec<u32>,
}

impl<'a> Without<'a> {
    /// The mesh without the triangles whose indices are in `gone`, ascending.
    pub fn new(mesh: &'a dyn MeshView, gone: &[u32]) -> Self {
        let is_kept = |triangle: &u32| gone.binary_search(triangle).is_err();
        let triangles: Vec<u32> = (0..mesh.triangles() as u32).filter(is_kept).collect();
        let mut is_used = vec![false; mesh.vertices()];
        for &triangle in &triangles {
            for vertex in mesh.triangle(triangle as usize) {
                is_used[vertex as usize] = true;
            }
        }
        let vertices = (0..mesh.vertices() as u32).filter(|&vertex| is_used[vertex as usize]);
        Self {
            vertices: vertices.collect(),
            triangles,
            mesh,
        }
    }
}

impl MeshView for Without<'_> {
    fn vertices(&self) -> usize {
        self.vertices.len()
    }

    fn triangles(&self) -> usize {
        self.triangles.len()
    }

    fn vertex(&self, index: u32) -> Vertex {
        self.mesh.vertex(self.vertices[index as usize])
    }

    fn triangle(&self, index: usize) -> [u32; 3] {
        let corners = self.mesh.triangle(self.triangles[index] as usize);
        corners.map(|vertex| self.vertices.partition_point(|&kept| kept < vertex) as u32)
    }
}

/// The mesh of some triangles, relative to `origin`, on the lattice of maps. Vertices are in the order of the whole mesh.
pub(super) fn part_on_lattice(
    mesh: &dyn MeshView,
    triangles: &[u32],
    origin: DVec3,
) -> TriangleMesh {
    let indices = || triangles.iter().map(|&index| mesh.triangle(index as usize));
    let mut used: Vec<u32> = indices().flatten().collect();
    used.sort_unstable();
    used.dedup();
    let position = |&vertex: &u32| (on_lattice(mesh.position(vertex)) - origin).as_vec3();
    let local_index = |vertex: u32| used.partition_point(|&index| index < vertex) as u32;
    TriangleMesh {
        vertices: used.iter().map(position).collect(),
        triangles: indices().map(|corners| corners.map(local_index)).collect(),
        ..TriangleMesh::default()
    }
}

/// A mesh for pictures, of some meshes and the colours that they get, if not their own: exact and without normals if they
/// have at most `most_triangles`, otherwise about as many, of vertices merged in cells.
pub fn reduced(meshes: &[(&dyn MeshView, Option<[u8; 3]>)], most_triangles: usize) -> TriangleMesh {
    let count: usize = meshes.iter().map(|(mesh, _)| mesh.triangles()).sum();
    let mut reduced = TriangleMesh::default();
    if count <= most_triangles {
        for &(mesh, color) in meshes {
            let first = reduced.vertices.len() as u32;
            for index in 0..mesh.vertices() as u32 {
                push(&mut reduced, &mesh.vertex(index), color);
            }
            let triangles = (0..mesh.triangles()).map(|index| mesh.triangle(index));
            (reduced.triangles)
                .extend(triangles.map(|corners| corners.map(|vertex| first + vertex)));
        }
        return reduced;
    }
    let area_m2 = |mesh: &dyn MeshView| -> f64 {
        let triangles = 0..mesh.triangles();
        triangles.map(|triangle| mesh.area_m2(triangle)).sum()
    };
    let area_m2: f64 = meshes.iter().map(|(mesh, _)| area_m2(*mesh)).sum();
    // About four triangles per cell that the surface passes through.
    let cell_m = (4.0 * area_m2 / most_triangles as f64).sqrt();
    for &(mesh, color) in meshes {
        let mut merged: HashMap<IVec3, u32> = HashMap::new();
        let mut known: HashSet<[u32; 3]> = HashSet::new();
        for triangle in 0..mesh.triangles() {
            let corners = mesh.triangle(triangle).map(|index| {
                let vertex = mesh.vertex(index);
                let cell = (vertex.position / cell_m).floor().as_ivec3();
                *(merged.entry(cell)).or_insert_with(|| push(&mut reduced, &vertex, color))
            });
            let mut sorted = corners;
            sorted.sort_unstable();
            let [a, b, c] = sorted;
            if a != b && b != c && known.insert(sorted) {
                reduced.triangles.push(corners);
            }
        }
    }
    reduced
}

/// Appends a vertex in a colour, by default its own; returns its index.
fn push(mesh: &mut TriangleMesh, vertex: &Vertex, color: Option<[u8; 3]>) -> u32 {
    mesh.vertices.push(vertex.position.as_vec3());
    mesh.colors.push(color.unwrap_or(vertex.color));
    mesh.vertices.len() as u32 - 1
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of `side` x `side` cells of 1 m at a height.
    fn sheet(side: u32, z: f32) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        for row in 0..=side {
            for column in 0..=side {
                mesh.vertices.push(Vec3::new(column as f32, row as f32, z));
                mesh.colors.push([row as u8, column as u8, 7]);
            }
        }
        for first in
            (0..side).flat_map(|row| (0..side).map(move |column| row * (side + 1) + column))
        {
            let above = first + side + 1;
            mesh.triangles.push([first, first + 1, above + 1]);
            mesh.triangles.push([first, above + 1, above]);
        }
        mesh
    }

    #[test]
    fn a_view_without_triangles_is_the_mesh_without_them() {
        let mesh = sheet(4, 0.0);
        let gone = [0, 1, 8, 9, 31];
        let view = Without::new(&mesh, &gone);
        let mut expected = mesh.clone();
        expected.retain_triangles(|triangle, _| !gone.contains(&(triangle as u32)));
        assert_eq!(view.vertices(), expected.vertices.len());
        assert_eq!(MeshView::triangles(&view), expected.triangles.len());
        for index in 0..expected.triangles.len() {
            assert_eq!(view.triangle(index), expected.triangles[index]);
        }
        for index in 0..expected.vertices.len() as u32 {
            assert_eq!(view.vertex(index), MeshView::vertex(&expected, index));
        }
    }

    #[test]
    fn a_reduced_mesh_has_the_extent_and_area_and_not_more_triangles_than_asked() {
        let (low, high) = (sheet(60, 0.0), sheet(60, 5.0));
        let meshes: [(&dyn MeshView, _); 2] = [(&low, None), (&high, Some([1, 2, 3]))];
        let area_m2 = |mesh: &TriangleMesh| -> f64 {
            (0..mesh.triangles.len())
                .map(|it| MeshView::area_m2(mesh, it))
                .sum()
        };
        for most in [100_000, 2_000] {
            let reduced = reduced(&meshes, most);
            assert!(
                reduced.triangles.len() <= most,
                "{}",
                reduced.triangles.len()
            );
            assert!(reduced.triangles.len() > most.min(14_000) / 3);
            let area_m2 = area_m2(&reduced);
            // Merged vertices are up to a cell inside the rim.
            assert!((5800.0..=7200.1).contains(&area_m2), "{area_m2}");
            let bounds = reduced.bounds();
            assert!(bounds.min.abs().max_element() < 2.0 && bounds.max.x > 56.0);
            assert!(
                (reduced.vertices.iter().zip(&reduced.colors))
                    .all(|(vertex, color)| (vertex.z > 2.0) == (*color == [1, 2, 3]))
            );
        }
    }
}
