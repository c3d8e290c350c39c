//! Simplification of a submesh by half-edge collapses: vertices move onto a neighbor, boundary
//! vertices along the boundary.
//!
//! ```text
//! cost of the collapse v → w = Σ over the triangles around v of  A (n·(w − v))² / Σ A  +  ε |w − v|²
//! ```
//!
//! Error quadrics as in Garland and Heckbert, *Surface Simplification Using Quadric Error Metrics*
//! (1997), rank the neighbors; the decision uses measured errors: each triangle keeps the removed
//! vertices that are on it, and none of them may be farther from the surface than the tolerance.
//! Instead of a priority queue there are sweeps over independent collapses, with increasing tolerance.

use glam::Vec3;

use super::adjacency::{chain_start, opposite_edge};
use super::fan::{Fan, Quadric, distance_squared};

/// Tolerances of the removed vertices, in the order of the sweeps [m].
const TOLERANCES_M: [f32; 3] = [0.0025, 0.005, 0.01];
/// Tolerance of the boundary relative to that of the surface (unitless); larger, because a filled
/// notch leaves no vertex behind.
const BOUNDARY_FACTOR: f32 = 2.0;
/// Weight ε of the edge length in the cost (unitless): of equally flat collapses the shortest is
/// preferred.
const LENGTH_WEIGHT: f32 = 1e-4;
/// Maximum number of collapses tried per vertex.
const MAX_TRIES: usize = 4;
/// The end of a linked list.
const NONE: u32 = u32::MAX;

/// Collapses that a vertex allows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VertexKind {
    /// None.
    Fixed,
    /// Onto any neighbor; the vertex is surrounded by triangles.
    Interior,
    /// Onto the neighbors along the boundary.
    Boundary,
}

/// Triangle of a removed triangle's index.
pub const REMOVED: [u32; 3] = [NONE; 3];

/// A part of a mesh.
pub struct Submesh {
    /// Vertices [m].
    vertices: Vec<Vec3>,
    /// Original positions of the vertices, then of the removed ones [m].
    originals: Vec<Vec3>,
    /// Kinds of the vertices. All triangles around the free ones and their neighbors are included.
    kinds: Vec<VertexKind>,
    /// Whether an original position was on the boundary.
    is_boundary: Vec<bool>,
    triangles: Vec<[u32; 3]>,
    /// First removed vertex on each triangle, and the next one on the same triangle.
    first_point: Vec<u32>,
    next_point: Vec<u32>,
    /// First corner at each vertex, and the next one at the same vertex. Corner 3 t + k is corner k
    /// of triangle t.
    first_corner: Vec<u32>,
    next_corner: Vec<u32>,
}

impl Submesh {
    /// A submesh of vertices and their triangles. `originals` and `is_boundary` are of the vertices
    /// and of previously removed vertices, whose triangles are `removed_on`.
    pub fn new(
        vertices: Vec<Vec3>,
        (originals, is_boundary): (Vec<Vec3>, Vec<bool>),
        kinds: Vec<VertexKind>,
        triangles: Vec<[u32; 3]>,
        removed_on: &[u32],
    ) -> Self {
        let mut submesh = Self {
            first_point: vec![NONE; triangles.len()],
            next_point: vec![NONE; originals.len()],
            first_corner: vec![NONE; kinds.len()],
            next_corner: vec![NONE; 3 * triangles.len()],
            vertices,
            originals,
            kinds,
            is_boundary,
            triangles,
        };
        for corner in 0..submesh.next_corner.len() {
            submesh.push_corner(corner as u32);
        }
        for (point, &triangle) in (submesh.kinds.len() as u32..).zip(removed_on) {
            submesh.push_point(point, triangle);
        }
        submesh
    }

    /// All triangles in their original order; removed ones are [`REMOVED`].
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Collapses edges until none is possible; new edges are at most `max_edge_m` long.
    pub fn simplify(&mut self, max_edge_m: f32) {
        let mut workspace = Workspace::new(self.kinds.len(), max_edge_m);
        let mut blocked_in = vec![0_u32; self.kinds.len()];
        let mut sweep = 0;
        for tolerance_m in TOLERANCES_M {
            let mut is_pending: Vec<bool> =
                (0..self.kinds.len()).map(|v| self.is_free(v)).collect();
            let mut has_changed = true;
            while has_changed {
                has_changed = false;
                sweep += 1;
                for vertex in 0..self.kinds.len() {
                    if !is_pending[vertex] || blocked_in[vertex] == sweep {
                        continue;
                    }
                    is_pending[vertex] = false;
                    if self.remove(vertex as u32, tolerance_m, &mut workspace) {
                        has_changed = true;
                        for &(neighbor, _) in &workspace.ring {
                            blocked_in[neighbor as usize] = sweep;
                            is_pending[neighbor as usize] = self.is_free(neighbor as usize);
                        }
                    }
                }
            }
        }
    }

    /// The removed vertices and their triangles.
    pub fn removed_vertices(&self) -> impl Iterator<Item = (u32, usize)> {
        (0..self.triangles.len())
            .flat_map(|triangle| self.points_on(triangle as u32).map(move |p| (p, triangle)))
    }

    /// Collapses a vertex onto the best neighbor; false if there is none.
    fn remove(&mut self, from: u32, tolerance_m: f32, workspace: &mut Workspace) -> bool {
        self.rank_neighbors(from, tolerance_m, workspace);
        for index in 0..workspace.targets.len().min(MAX_TRIES) {
            let to = workspace.targets[index].1;
            if self.satisfies_link_condition(from, to, workspace)
                && self.build_fan(to, workspace)
                && self.is_within(tolerance_m, from, to, workspace)
            {
                self.collapse(from, to, workspace);
                return true;
            }
        }
        false
    }

    /// Collects the ring around a vertex and sorts the neighbors by cost.
    fn rank_neighbors(&self, from: u32, tolerance_m: f32, workspace: &mut Workspace) {
        workspace.ring.clear();
        workspace.around.clear();
        workspace.targets.clear();
        let mut quadric = Quadric::default();
        let origin = self.at(from);
        for corner in self.corners_at(from) {
            let (b, c) = opposite_edge(&self.triangles, corner);
            workspace.ring.push((b, c));
            workspace.around.push(corner / 3);
            quadric.add((self.at(b) - origin).cross(self.at(c) - origin));
        }
        workspace.normal = quadric.normal.normalize_or_zero();
        if workspace.normal == Vec3::ZERO {
            return;
        }
        workspace.boundary = match self.kinds[from as usize] {
            VertexKind::Boundary => chain_ends(&workspace.ring),
            VertexKind::Fixed | VertexKind::Interior => None,
        };
        let boundary = workspace.boundary;
        let is_allowed = |to: &u32| boundary.is_none_or(|ends| ends.contains(to));
        let last = boundary.map(|ends| ends[1]);
        let starts = workspace.ring.iter().map(|&(to, _)| to);
        for to in starts.chain(last).filter(is_allowed) {
            let edge = self.at(to) - origin;
            let error = quadric.error(edge);
            if error <= 4.0 * tolerance_m * tolerance_m {
                let cost = error + LENGTH_WEIGHT * edge.length_squared();
                workspace.targets.push((cost, to));
            }
        }
        (workspace.targets).sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    }

    /// Link condition of an edge: the two vertices have no common neighbors but those opposite to
    /// the edge, two or, on the boundary, one, and no common triangle but those at the edge.
    fn satisfies_link_condition(&self, from: u32, to: u32, workspace: &mut Workspace) -> bool {
        workspace.round += 2;
        let (unseen, seen) = (workspace.round, workspace.round + 1);
        for &(neighbor, _) in &workspace.ring {
            workspace.marks[neighbor as usize] = unseen;
        }
        let mut common = 0;
        for corner in self.corners_at(to) {
            let (b, c) = opposite_edge(&self.triangles, corner);
            let is_marked = [b, c].map(|v| workspace.marks[v as usize] >= unseen);
            if is_marked == [true, true] && b != from && c != from {
                return false;
            }
            for vertex in [b, c] {
                if workspace.marks[vertex as usize] == unseen {
                    workspace.marks[vertex as usize] = seen;
                    common += 1;
                }
            }
        }
        common == if workspace.boundary.is_some() { 1 } else { 2 }
    }

    /// Builds the fan of new triangles; false if one of them is invalid.
    fn build_fan(&self, to: u32, workspace: &mut Workspace) -> bool {
        workspace.fan.start(self.at(to), workspace.normal);
        for (index, &(b, c)) in workspace.ring.iter().enumerate() {
            if b != to && c != to {
                let (b, c) = (self.at(b), self.at(c));
                if !workspace.fan.add(index, b, c, workspace.max_edge_m) {
                    return false;
                }
            }
        }
        !workspace.fan.is_empty()
    }

    /// Assigns the removed vertices to the new triangles; false if one exceeds the tolerance. Removed
    /// boundary vertices are assigned to the triangle at the boundary, so that they are tested
    /// again when the boundary changes.
    fn is_within(&self, tolerance_m: f32, from: u32, to: u32, workspace: &mut Workspace) -> bool {
        workspace.assignment.clear();
        let is_end =
            |vertex: u32| vertex != to && workspace.boundary.is_some_and(|b| b.contains(&vertex));
        let boundary_triangle = (workspace.ring.iter())
            .position(|&(b, c)| b != to && c != to && (is_end(b) || is_end(c)));
        let boundary = (workspace.boundary).map(|[a, b]| [self.at(a), self.at(b)]);
        let boundary_tolerance_m = BOUNDARY_FACTOR * tolerance_m;
        let points = (workspace.around.iter()).flat_map(|&triangle| self.points_on(triangle));
        for point in std::iter::once(from).chain(points) {
            let original = self.originals[point as usize];
            let (mut triangle, error_squared) = workspace.fan.nearest(original);
            if error_squared > tolerance_m * tolerance_m {
                return false;
            }
            if let Some([a, b]) = boundary
                && self.is_boundary[point as usize]
            {
                if distance_squared(original, a, b) > boundary_tolerance_m * boundary_tolerance_m {
                    return false;
                }
                triangle = boundary_triangle.unwrap_or(triangle);
            }
            (workspace.assignment).push((point, workspace.around[triangle]));
        }
        true
    }

    fn collapse(&mut self, from: u32, to: u32, workspace: &Workspace) {
        for (&triangle, &(b, c)) in workspace.around.iter().zip(&workspace.ring) {
            self.first_point[triangle as usize] = NONE;
            let is_removed = b == to || c == to;
            for corner in 3 * triangle..3 * triangle + 3 {
                let vertex = self.vertex_of(corner);
                if is_removed && vertex != from {
                    self.drop_corner(corner);
                } else if !is_removed && vertex == from {
                    self.triangles[triangle as usize][corner as usize % 3] = to;
                    self.push_corner(corner);
                }
            }
            if is_removed {
                self.triangles[triangle as usize] = REMOVED;
            }
        }
        self.first_corner[from as usize] = NONE;
        self.kinds[from as usize] = VertexKind::Fixed;
        for &(point, triangle) in &workspace.assignment {
            self.push_point(point, triangle);
        }
    }

    fn is_free(&self, vertex: usize) -> bool {
        self.kinds[vertex] != VertexKind::Fixed
    }

    fn at(&self, vertex: u32) -> Vec3 {
        self.vertices[vertex as usize]
    }

    fn vertex_of(&self, corner: u32) -> u32 {
        self.triangles[corner as usize / 3][corner as usize % 3]
    }

    fn corners_at(&self, vertex: u32) -> impl Iterator<Item = u32> {
        list(&self.next_corner, self.first_corner[vertex as usize])
    }

    fn points_on(&self, triangle: u32) -> impl Iterator<Item = u32> {
        list(&self.next_point, self.first_point[triangle as usize])
    }

    fn push_corner(&mut self, corner: u32) {
        let vertex = self.vertex_of(corner);
        let first = &mut self.first_corner[vertex as usize];
        self.next_corner[corner as usize] = std::mem::replace(first, corner);
    }

    fn push_point(&mut self, point: u32, triangle: u32) {
        let first = &mut self.first_point[triangle as usize];
        self.next_point[point as usize] = std::mem::replace(first, point);
    }

    fn drop_corner(&mut self, corner: u32) {
        let after = self.next_corner[corner as usize];
        let vertex = self.vertex_of(corner);
        let before = self
            .corners_at(vertex)
            .find(|&c| self.next_corner[c as usize] == corner);
        match before {
            Some(before) => self.next_corner[before as usize] = after,
            None => self.first_corner[vertex as usize] = after,
        }
    }
}

/// The ends of the chain of edges around a boundary vertex; `None` if it is not a chain.
fn chain_ends(chain: &[(u32, u32)]) -> Option<[u32; 2]> {
    let (first, _) = chain_start(chain)?;
    let is_last = |(_, to): &&(u32, u32)| chain.iter().all(|(from, _)| from != to);
    Some([first, chain.iter().find(is_last)?.1])
}

/// The members of a linked list.
fn list(next: &[u32], first: u32) -> impl Iterator<Item = u32> {
    let member = |index: u32| (index != NONE).then_some(index);
    std::iter::successors(member(first), move |&index| member(next[index as usize]))
}

/// State of one collapse, allocated once per submesh.
#[derive(Default)]
struct Workspace {
    max_edge_m: f32,
    /// The edges opposite to the vertex, and their triangles.
    ring: Vec<(u32, u32)>,
    around: Vec<u32>,
    /// The neighbors of a boundary vertex along the boundary.
    boundary: Option<[u32; 2]>,
    /// Mean normal of the triangles.
    normal: Vec3,
    /// Cost and neighbor.
    targets: Vec<(f32, u32)>,
    fan: Fan,
    /// Removed vertices and their new triangles.
    assignment: Vec<(u32, u32)>,
    marks: Vec<u32>,
    round: u32,
}

impl Workspace {
    fn new(vertices: usize, max_edge_m: f32) -> Self {
        Self {
            max_edge_m,
            marks: vec![0; vertices],
            ..Self::default()
        }
    }
}
