//! Simplification of a part of a mesh, such as the ground, block by block.
//!
//! The plane is divided into square blocks that are simplified independently and in parallel, see
//! `collapse`; then twice again with blocks shifted by a third and two thirds, so that every
//! position is inside a block at least once. Vertices shared with other triangles are fixed, so no
//! cracks open; boundary vertices are removed where the boundary is almost straight.

use glam::{IVec2, Vec3};
use rayon::prelude::*;

use super::adjacency::{VertexCorners, chain_start, opposite_edge};
use super::collapse::{REMOVED, Submesh, VertexKind};
use crate::geometry::TriangleMesh;

/// Edge length of the blocks [m].
const BLOCK_M: f32 = 9.0;
/// Maximum displacement of a vertex by smoothing [m].
const MAX_DISPLACEMENT_M: f32 = 0.005;
/// Triangle of a vertex that is not removed.
const NONE: u32 = u32::MAX;

/// Simplifies a part of a mesh: new edges are up to `resolution_m` long, and every original vertex is within
/// a centimeter of the remaining surface. Before, interior vertices of the part are smoothed
/// `smoothing_iterations` times, halfway to the mean of their neighbors along their normals, by at most
/// five millimeters in total; the centimeter includes that.
///
/// `is_part` is per triangle, `is_fixed` per vertex; both count as false beyond their ends. Fixed
/// vertices and vertices of other triangles do not move. The boundary moves by at most two
/// centimeters. Normals and colors are kept; unreferenced vertices are removed.
pub fn simplify(
    mesh: &TriangleMesh,
    is_part: &[bool],
    is_fixed: &[bool],
    resolution_m: f32,
    smoothing_iterations: usize,
) -> TriangleMesh {
    let mut part = Part::new(mesh.clone(), is_part, is_fixed);
    part.smooth(smoothing_iterations);
    for third in 0..3 {
        part.simplify_blocks(third as f32 / 3.0 * BLOCK_M, resolution_m);
    }
    let mut mesh = part.mesh;
    mesh.triangles.retain(|triangle| *triangle != REMOVED);
    mesh.drop_unreferenced_vertices();
    mesh
}

struct Part {
    mesh: TriangleMesh,
    /// Whether a vertex has a triangle of the part.
    is_part: Vec<bool>,
    /// Kinds of the vertices; free ones have only triangles of the part.
    kinds: Vec<VertexKind>,
    /// Whether a vertex was originally on the boundary and free.
    is_boundary: Vec<bool>,
    /// The vertices before smoothing.
    originals: Vec<Vec3>,
    /// Triangle of each removed vertex.
    removed_on: Vec<u32>,
}

impl Part {
    fn new(mesh: TriangleMesh, is_part: &[bool], is_fixed: &[bool]) -> Self {
        let count = mesh.vertices.len();
        let (mut in_part, mut in_rest) = (vec![false; count], vec![false; count]);
        for (index, triangle) in mesh.triangles.iter().enumerate() {
            let is_part = is_part.get(index).copied().unwrap_or(false);
            for &vertex in triangle {
                in_part[vertex as usize] |= is_part;
                in_rest[vertex as usize] |= !is_part;
            }
        }
        let corners = VertexCorners::new(&mesh.triangles, count);
        let kinds: Vec<VertexKind> = (0..count)
            .into_par_iter()
            .map_init(Vec::new, |edges, vertex| {
                let is_fixed = is_fixed.get(vertex).copied().unwrap_or(false);
                edges.clear();
                if in_part[vertex] && !in_rest[vertex] && !is_fixed {
                    let corners = corners.of(vertex).iter();
                    edges.extend(corners.map(|&corner| opposite_edge(&mesh.triangles, corner)));
                }
                vertex_kind(edges)
            })
            .collect();
        Self {
            is_boundary: kinds.iter().map(|&k| k == VertexKind::Boundary).collect(),
            kinds,
            is_part: in_part,
            originals: mesh.vertices.clone(),
            removed_on: vec![NONE; count],
            mesh,
        }
    }

    fn smooth(&mut self, iterations: usize) {
        let originals = &self.originals;
        if self.mesh.normals.len() != originals.len() {
            return;
        }
        for _ in 0..iterations {
            let means = self.neighbor_means();
            let before = self.mesh.vertices.clone();
            for vertex in (0..originals.len()).filter(|&v| self.kinds[v] == VertexKind::Interior) {
                let position = self.mesh.vertices[vertex];
                let normal = self.mesh.normals[vertex];
                let rise = (means[vertex] - position).dot(normal);
                let displacement = (position - originals[vertex]).dot(normal) + 0.5 * rise;
                self.mesh.vertices[vertex] = originals[vertex]
                    + displacement.clamp(-MAX_DISPLACEMENT_M, MAX_DISPLACEMENT_M) * normal;
            }
            undo_flips(&mut self.mesh, &before);
        }
    }

    /// The mean of the neighbors of each interior vertex.
    fn neighbor_means(&self) -> Vec<Vec3> {
        let mut sums = vec![(Vec3::ZERO, 0.0); self.mesh.vertices.len()];
        for (index, triangle) in self.mesh.triangles.iter().enumerate() {
            let corners = self.mesh.corners(index);
            for (k, &vertex) in triangle.iter().enumerate() {
                if self.kinds[vertex as usize] == VertexKind::Interior {
                    let sum = &mut sums[vertex as usize];
                    // In a closed ring every neighbor is the next corner exactly once.
                    sum.0 += corners[(k + 1) % 3];
                    sum.1 += 1.0;
                }
            }
        }
        sums.into_par_iter()
            .map(|(sum, count)| sum / f32::max(count, 1.0))
            .collect()
    }

    fn simplify_blocks(&mut self, shift_m: f32, resolution_m: f32) {
        let block_of: Vec<IVec2> = (self.mesh.vertices.par_iter())
            .map(|vertex| ((vertex.truncate() - shift_m) / BLOCK_M).floor().as_ivec2())
            .collect();
        let members = self.block_members(&block_of);
        let removed = self.removed_by_triangle();
        let blocks: Vec<Block> = members
            .par_chunk_by(|a, b| a.0 == b.0)
            .map(|members| {
                let mut block = self.extract_block(members, &block_of, &removed);
                block.submesh.simplify(resolution_m);
                block
            })
            .collect();
        for block in &blocks {
            self.insert_block(block);
        }
    }

    /// The triangles at vertices of the part by the blocks of their vertices, so that every block has
    /// complete rings.
    fn block_members(&self, block_of: &[IVec2]) -> Vec<([i32; 2], u32)> {
        let mut members: Vec<_> = (self.mesh.triangles.par_iter().enumerate())
            .filter(|(_, t)| **t != REMOVED && t.iter().any(|&v| self.is_part[v as usize]))
            .flat_map_iter(|(index, triangle)| {
                let [a, b, c] = triangle.map(|v| block_of[v as usize].to_array());
                let (second, third) = (b != a, c != a && c != b);
                [(true, a), (second, b), (third, c)]
                    .into_iter()
                    .filter_map(move |(is_new, key)| is_new.then_some((key, index as u32)))
            })
            .collect();
        members.par_sort_unstable();
        members
    }

    /// Triangles of removed vertices and the vertices, ascending.
    fn removed_by_triangle(&self) -> Vec<(u32, u32)> {
        let mut removed: Vec<(u32, u32)> = (self.removed_on.iter().zip(0..))
            .filter(|(triangle, _)| **triangle != NONE)
            .map(|(&triangle, vertex)| (triangle, vertex))
            .collect();
        removed.par_sort_unstable();
        removed
    }

    fn extract_block(
        &self,
        members: &[([i32; 2], u32)],
        block_of: &[IVec2],
        removed: &[(u32, u32)],
    ) -> Block {
        let triangles: Vec<u32> = members.iter().map(|&(_, triangle)| triangle).collect();
        let corners = |&triangle: &u32| self.mesh.triangles[triangle as usize];
        let mut vertices: Vec<u32> = triangles.iter().flat_map(corners).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let local = |vertex: u32| vertices.partition_point(|&other| other < vertex) as u32;
        let locals: Vec<_> = triangles.iter().map(|t| corners(t).map(local)).collect();
        let mut kinds: Vec<VertexKind> = vertices.iter().map(|&v| self.kinds[v as usize]).collect();
        // The vertices of a triangle that is in two blocks are fixed.
        for (triangle, local) in triangles.iter().map(corners).zip(&locals) {
            let [a, b, c] = triangle.map(|v| block_of[v as usize]);
            if a != b || b != c {
                for &vertex in local {
                    kinds[vertex as usize] = VertexKind::Fixed;
                }
            }
        }
        let mut removed_on = Vec::new();
        for (index, &triangle) in (0..).zip(&triangles) {
            let start = removed.partition_point(|&(other, _)| other < triangle);
            for &(_, vertex) in removed[start..].iter().take_while(|r| r.0 == triangle) {
                vertices.push(vertex);
                removed_on.push(index);
            }
        }
        let positions = |of: &[Vec3]| vertices.iter().map(|&v| of[v as usize]).collect();
        let is_boundary = (vertices.iter())
            .map(|&v| self.is_boundary[v as usize])
            .collect();
        let submesh = Submesh::new(
            positions(&self.mesh.vertices),
            (positions(&self.originals), is_boundary),
            kinds,
            locals,
            &removed_on,
        );
        Block {
            submesh,
            vertices,
            triangles,
        }
    }

    fn insert_block(&mut self, block: &Block) {
        for (&triangle, &corners) in block.triangles.iter().zip(block.submesh.triangles()) {
            self.mesh.triangles[triangle as usize] = if corners == REMOVED {
                REMOVED
            } else {
                corners.map(|vertex| block.vertices[vertex as usize])
            };
        }
        for (vertex, triangle) in block.submesh.removed_vertices() {
            let vertex = block.vertices[vertex as usize] as usize;
            self.kinds[vertex] = VertexKind::Fixed;
            self.removed_on[vertex] = block.triangles[triangle];
        }
    }
}

/// The submesh of a block, and the indices of its vertices and triangles in the whole mesh.
struct Block {
    submesh: Submesh,
    vertices: Vec<u32>,
    triangles: Vec<u32>,
}

/// The kind of a vertex by the edges opposite to it: one closed ring, one chain, or neither.
fn vertex_kind(edges: &[(u32, u32)]) -> VertexKind {
    let Some((start, mut end)) = chain_start(edges).or(edges.first().copied()) else {
        return VertexKind::Fixed;
    };
    let mut reached = 1;
    while end != start && reached <= edges.len() {
        match edges.iter().find(|(from, _)| *from == end) {
            Some(next) => (reached, end) = (reached + 1, next.1),
            None => break,
        }
    }
    match (reached == edges.len(), end == start) {
        (true, true) if reached >= 3 => VertexKind::Interior,
        (true, false) if reached >= 2 => VertexKind::Boundary,
        _ => VertexKind::Fixed,
    }
}

/// Returns the vertices of triangles that faced up and do not any more to where they were before, until there are none.
fn undo_flips(mesh: &mut TriangleMesh, before: &[Vec3]) {
    let faces_up = |vertices: &[Vec3], triangle: &[u32; 3]| {
        let [a, b, c] = triangle.map(|vertex| vertices[vertex as usize].truncate());
        (b - a).perp_dot(c - a) > 0.0
    };
    loop {
        let vertices = &mesh.vertices;
        let is_flipped =
            |triangle: &&[u32; 3]| faces_up(before, triangle) && !faces_up(vertices, triangle);
        let triangles = mesh.triangles.par_iter();
        let flipped: Vec<[u32; 3]> = triangles.filter(is_flipped).copied().collect();
        if flipped.is_empty() {
            return;
        }
        for vertex in flipped.into_iter().flatten() {
            mesh.vertices[vertex as usize] = before[vertex as usize];
        }
    }
}
