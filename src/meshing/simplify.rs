//! Fewer triangles for the ground, block by block.
//!
//! The plane is cut into square blocks that are simplified independently of each other, see
//! [`super::collapse`]; then again with the cuts a third and two thirds of a block farther on, so
//! every place is away from the cuts at least once. Vertices that touch other triangles stay where
//! they are: no crack opens. Those on the open border go where it is almost straight.

use glam::{IVec2, Vec3};
use rayon::prelude::*;

use super::collapse::{Block, DEAD, Freedom};
use crate::geometry::TriangleMesh;

/// Edge of the blocks [m].
const BLOCK_M: f32 = 9.0;
/// Farthest way of a vertex when the ground is smoothed [m].
const MAX_MOVE_M: f32 = 0.005;
/// The triangle of a vertex that is not removed.
const NOWHERE: u32 = u32::MAX;

/// The mesh with fewer triangles where `is_ground`: new edges up to `resolution_m` long, every vertex
/// that was there within a centimetre of the surface that is left. Before, the ground's inner
/// vertices are drawn `smoothing_iterations` times halfway to the mean of their neighbours along
/// their normals, by at most five millimetres in all; the centimetre includes that.
///
/// `is_ground` is per triangle. Vertices of other triangles are not touched, nor are those that
/// `is_held` has, per vertex; both count as false where they end early. The open border moves by at
/// most two centimetres. Normals and colours are kept; no vertex is left without a triangle.
pub fn simplify_ground(
    mesh: &TriangleMesh,
    is_ground: &[bool],
    is_held: &[bool],
    resolution_m: f32,
    smoothing_iterations: usize,
) -> TriangleMesh {
    let mut ground = Ground::new(mesh.clone(), is_ground, is_held);
    ground.smooth(smoothing_iterations);
    for third in 0..3 {
        ground.simplify_blocks(third as f32 / 3.0 * BLOCK_M, resolution_m);
    }
    ground.finish()
}

struct Ground {
    mesh: TriangleMesh,
    /// Vertices of ground triangles.
    is_ground: Vec<bool>,
    /// Vertices that may go: only ground triangles are around them.
    freedom: Vec<Freedom>,
    /// Vertices that were on the rim of the ground, and could go.
    is_rim: Vec<bool>,
    /// The vertices before smoothing.
    measured: Vec<Vec3>,
    /// The triangle on which each removed vertex lies.
    lies_on: Vec<u32>,
}

impl Ground {
    fn new(mesh: TriangleMesh, is_ground: &[bool], is_held: &[bool]) -> Self {
        let count = mesh.vertices.len();
        let (mut in_ground, mut in_rest) = (vec![false; count], vec![false; count]);
        for (index, triangle) in mesh.triangles.iter().enumerate() {
            let is_ground = is_ground.get(index).copied().unwrap_or(false);
            for &vertex in triangle {
                in_ground[vertex as usize] |= is_ground;
                in_rest[vertex as usize] |= !is_ground;
            }
        }
        let is_held = is_held.iter().copied().chain(std::iter::repeat(false));
        let is_pure: Vec<bool> = (in_ground.iter().zip(&in_rest).zip(is_held))
            .map(|((&ground, &rest), held)| ground && !rest && !held)
            .collect();
        let freedom = freedom(&mesh.triangles, &is_pure);
        Self {
            is_rim: freedom.iter().map(|&f| f == Freedom::Rim).collect(),
            freedom,
            is_ground: in_ground,
            measured: mesh.vertices.clone(),
            lies_on: vec![NOWHERE; count],
            mesh,
        }
    }

    fn smooth(&mut self, iterations: usize) {
        let before = &self.measured;
        if self.mesh.normals.len() != before.len() {
            return;
        }
        for _ in 0..iterations {
            let means = self.neighbor_means();
            for vertex in (0..before.len()).filter(|&vertex| self.freedom[vertex] == Freedom::Inner)
            {
                let now = self.mesh.vertices[vertex];
                let normal = self.mesh.normals[vertex];
                let rise = (means[vertex] - now).dot(normal);
                let moved = (now - before[vertex]).dot(normal) + 0.5 * rise;
                self.mesh.vertices[vertex] =
                    before[vertex] + moved.clamp(-MAX_MOVE_M, MAX_MOVE_M) * normal;
            }
        }
    }

    /// The mean of the neighbours of each free vertex.
    fn neighbor_means(&self) -> Vec<Vec3> {
        let mut sums = vec![(Vec3::ZERO, 0.0); self.mesh.vertices.len()];
        for (index, triangle) in self.mesh.triangles.iter().enumerate() {
            let corners = self.mesh.corners(index);
            for (k, &vertex) in triangle.iter().enumerate() {
                if self.freedom[vertex as usize] == Freedom::Inner {
                    let sum = &mut sums[vertex as usize];
                    // In a ring every neighbour is once the next one.
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
        let points = self.points_by_triangle();
        let done: Vec<Piece> = members
            .par_chunk_by(|a, b| a.0 == b.0)
            .map(|members| {
                let mut piece = self.cut_out(members, &block_of, &points);
                piece.block.simplify(resolution_m);
                piece
            })
            .collect();
        for piece in &done {
            self.put_back(piece);
        }
    }

    /// The triangles at ground vertices by the blocks that they reach into: complete rings in
    /// every block.
    fn block_members(&self, block_of: &[IVec2]) -> Vec<([i32; 2], u32)> {
        let mut members: Vec<_> = (self.mesh.triangles.par_iter().enumerate())
            .filter(|(_, t)| **t != DEAD && t.iter().any(|&v| self.is_ground[v as usize]))
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

    /// Removed vertices, ordered by the triangle on which they lie.
    fn points_by_triangle(&self) -> Vec<(u32, u32)> {
        let mut points: Vec<(u32, u32)> = (self.lies_on.iter().enumerate())
            .filter(|(_, triangle)| **triangle != NOWHERE)
            .map(|(vertex, &triangle)| (triangle, vertex as u32))
            .collect();
        points.par_sort_unstable();
        points
    }

    fn cut_out(
        &self,
        members: &[([i32; 2], u32)],
        block_of: &[IVec2],
        points: &[(u32, u32)],
    ) -> Piece {
        let triangles: Vec<u32> = members.iter().map(|&(_, triangle)| triangle).collect();
        let corners = |&triangle: &u32| self.mesh.triangles[triangle as usize];
        let mut vertices: Vec<u32> = triangles.iter().flat_map(corners).collect();
        vertices.sort_unstable();
        vertices.dedup();
        let local = |vertex: u32| vertices.partition_point(|&other| other < vertex) as u32;
        let locals: Vec<_> = triangles.iter().map(|t| corners(t).map(local)).collect();
        let mut freedom: Vec<Freedom> =
            vertices.iter().map(|&v| self.freedom[v as usize]).collect();
        // A triangle that reaches into two blocks must stay as it is, and so its corners.
        for (triangle, local) in triangles.iter().map(corners).zip(&locals) {
            let [a, b, c] = triangle.map(|v| block_of[v as usize]);
            if a != b || b != c {
                local
                    .iter()
                    .for_each(|&v| freedom[v as usize] = Freedom::Fixed);
            }
        }
        let mut lies_on = Vec::new();
        for (index, &triangle) in triangles.iter().enumerate() {
            let start = points.partition_point(|&(other, _)| other < triangle);
            let here = points[start..]
                .iter()
                .take_while(|(other, _)| *other == triangle);
            for &(_, vertex) in here {
                vertices.push(vertex);
                lies_on.push(index as u32);
            }
        }
        let positions = |of: &[Vec3]| vertices.iter().map(|&v| of[v as usize]).collect();
        let measured = positions(&self.measured);
        let is_rim = vertices.iter().map(|&v| self.is_rim[v as usize]).collect();
        let block = Block::new(
            positions(&self.mesh.vertices),
            (measured, is_rim),
            freedom,
            locals,
            &lies_on,
        );
        Piece {
            block,
            vertices,
            triangles,
        }
    }

    fn put_back(&mut self, piece: &Piece) {
        for (&triangle, &corners) in piece.triangles.iter().zip(piece.block.triangles()) {
            self.mesh.triangles[triangle as usize] = if corners == DEAD {
                DEAD
            } else {
                corners.map(|vertex| piece.vertices[vertex as usize])
            };
        }
        for (point, triangle) in piece.block.points() {
            let vertex = piece.vertices[point as usize] as usize;
            self.freedom[vertex] = Freedom::Fixed;
            self.lies_on[vertex] = piece.triangles[triangle];
        }
    }

    fn finish(mut self) -> TriangleMesh {
        self.mesh.triangles.retain(|triangle| *triangle != DEAD);
        self.mesh.drop_unreferenced_vertices();
        self.mesh
    }
}

/// A block and what its vertices and triangles are in the whole mesh.
struct Piece {
    block: Block,
    vertices: Vec<u32>,
    triangles: Vec<u32>,
}

/// What is around each candidate: one closed ring of triangles, one fan that begins and ends on the
/// open border, or anything else.
fn freedom(triangles: &[[u32; 3]], is_candidate: &[bool]) -> Vec<Freedom> {
    let mut ends = vec![0_usize; is_candidate.len() + 1];
    let corners =
        || (triangles.iter()).flat_map(|&[a, b, c]| [(a, (b, c)), (b, (c, a)), (c, (a, b))]);
    for (vertex, _) in corners().filter(|corner| is_candidate[corner.0 as usize]) {
        ends[vertex as usize + 1] += 1;
    }
    for index in 1..ends.len() {
        ends[index] += ends[index - 1];
    }
    let starts = ends.clone();
    let mut links = vec![(0, 0); ends.last().copied().unwrap_or(0)];
    for (vertex, link) in corners().filter(|corner| is_candidate[corner.0 as usize]) {
        links[ends[vertex as usize]] = link;
        ends[vertex as usize] += 1;
    }
    (0..is_candidate.len())
        .into_par_iter()
        .map(|vertex| freedom_within(&links[starts[vertex]..starts[vertex + 1]]))
        .collect()
}

/// Whether the edges opposite to a vertex form one ring or one chain.
fn freedom_within(links: &[(u32, u32)]) -> Freedom {
    let is_start = |&&(from, _): &&(u32, u32)| links.iter().all(|(_, to)| *to != from);
    let chain = links.iter().find(is_start);
    let Some(&(start, mut end)) = chain.or(links.first()) else {
        return Freedom::Fixed;
    };
    let mut reached = 1;
    while end != start && reached <= links.len() {
        match links.iter().find(|(from, _)| *from == end) {
            Some(next) => (reached, end) = (reached + 1, next.1),
            None => break,
        }
    }
    match (reached == links.len(), end == start) {
        (true, true) if reached >= 3 => Freedom::Inner,
        (true, false) if reached >= 2 => Freedom::Rim,
        _ => Freedom::Fixed,
    }
}
