//! One block of ground with fewer triangles: vertices are drawn onto a neighbour, one by one; those
//! on the rim of the ground along the rim.
//!
//! ```text
//! cost of drawing v onto w = Σ over the triangles around v of  A (n·(w − v))²,  plus a little A |w − v|²
//! ```
//!
//! The planes are those of Garland and Heckbert, *Surface Simplification Using Quadric Error
//! Metrics* (1997), but the quadrics only rank the neighbours. What decides is measured: each
//! triangle knows the removed vertices that lie on it, and none of them may get farther from the
//! surface than the tolerance. Without a heap: sweeps over the block in which no two collapses
//! touch each other, first with a small tolerance, then with larger ones.

use std::ops::Range;

use glam::Vec3;

use super::fan::{Fan, Planes, distance_squared};

/// How far a removed vertex may be from the surface, sweep after sweep [m].
const TOLERANCES_M: [f32; 3] = [0.0025, 0.005, MAX_ERROR_M];
/// No removed vertex gets farther from the surface than this [m].
const MAX_ERROR_M: f32 = 0.01;
/// How far the rim may be from where it was, over the tolerance (unitless): where a dent is filled
/// no vertex is left behind, and the dent may be the deeper.
const RIM_FACTOR: f32 = 2.0;
/// Weight of the length of the edge beside the distance to the planes (unitless): among equally
/// flat ways the short one is taken.
const LENGTH_WEIGHT: f32 = 1e-4;
/// How many of the cheapest ways are tried.
const MAX_TRIES: usize = 4;
/// The end of a list.
const NONE: u32 = u32::MAX;

/// Where a vertex may go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Freedom {
    /// Nowhere.
    Fixed,
    /// Onto any neighbour: triangles are all around it.
    Inner,
    /// Onto the neighbours along the open border that it is on.
    Rim,
}

/// A piece of a mesh in which vertices are numbered from 0.
pub struct Block {
    /// The vertices [m].
    vertices: Vec<Vec3>,
    /// Where the vertices were measured, then the removed ones [m].
    measured: Vec<Vec3>,
    /// Where the vertices may go. All triangles around the free ones and around their neighbours are
    /// here.
    freedom: Vec<Freedom>,
    /// Whether a measured place was on the rim.
    is_rim: Vec<bool>,
    triangles: Vec<[u32; 3]>,
    /// First removed vertex on each triangle, and the next one on the same triangle.
    first_point: Vec<u32>,
    next_point: Vec<u32>,
    /// First corner at each vertex, and the next one at the same vertex. Corner 3 t + k is
    /// corner k of triangle t.
    first_corner: Vec<u32>,
    next_corner: Vec<u32>,
}

/// What a triangle that was removed looks like.
pub const DEAD: [u32; 3] = [NONE; 3];

impl Block {
    /// A block of vertices; `measured` are the places that must stay near the surface: those of
    /// the vertices, then those of removed vertices, `is_rim` says whether they were on the rim, and
    /// `lies_on` has the triangles of the removed ones.
    pub fn new(
        vertices: Vec<Vec3>,
        (measured, is_rim): (Vec<Vec3>, Vec<bool>),
        freedom: Vec<Freedom>,
        triangles: Vec<[u32; 3]>,
        lies_on: &[u32],
    ) -> Self {
        let mut block = Self {
            first_point: vec![NONE; triangles.len()],
            next_point: vec![NONE; measured.len()],
            first_corner: vec![NONE; freedom.len()],
            next_corner: vec![NONE; 3 * triangles.len()],
            vertices,
            measured,
            freedom,
            is_rim,
            triangles,
        };
        for corner in 0..block.next_corner.len() {
            block.push_corner(corner as u32);
        }
        for (index, &triangle) in lies_on.iter().enumerate() {
            block.push_point((block.freedom.len() + index) as u32, triangle);
        }
        block
    }

    /// All triangles, in the order in which they were given; those that went are [`DEAD`].
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.triangles
    }

    /// Draws free vertices onto their neighbours as long as one can go; no edge gets longer than
    /// `resolution_m`.
    pub fn simplify(&mut self, resolution_m: f32) {
        let mut scratch = Scratch::new(self.freedom.len(), resolution_m);
        let mut rests_until = vec![0_u32; self.freedom.len()];
        let mut sweep = 0;
        for tolerance_m in TOLERANCES_M {
            let mut is_waiting: Vec<bool> =
                (0..self.freedom.len()).map(|v| self.is_free(v)).collect();
            let mut has_changed = true;
            while has_changed {
                has_changed = false;
                sweep += 1;
                for vertex in 0..self.freedom.len() {
                    if !is_waiting[vertex] || rests_until[vertex] == sweep {
                        continue;
                    }
                    is_waiting[vertex] = false;
                    if self.remove(vertex as u32, tolerance_m, &mut scratch) {
                        has_changed = true;
                        for &(neighbor, _) in &scratch.ring {
                            rests_until[neighbor as usize] = sweep;
                            is_waiting[neighbor as usize] = self.is_free(neighbor as usize);
                        }
                    }
                }
            }
        }
    }

    /// The removed vertices and the triangles on which they lie.
    pub fn points(&self) -> impl Iterator<Item = (u32, usize)> {
        (0..self.triangles.len())
            .flat_map(|triangle| self.points_on(triangle as u32).map(move |p| (p, triangle)))
    }

    /// Draws a vertex onto the best neighbour. Whether there is one.
    fn remove(&mut self, from: u32, tolerance_m: f32, scratch: &mut Scratch) -> bool {
        self.look_around(from, tolerance_m, scratch);
        for index in 0..scratch.targets.len().min(MAX_TRIES) {
            let to = scratch.targets[index].1;
            if self.stays_a_surface(from, to, scratch)
                && self.lay_fan(to, scratch)
                && self.is_within(tolerance_m, from, to, scratch)
            {
                self.collapse(from, to, scratch);
                return true;
            }
        }
        false
    }

    /// The ring around a vertex, and the neighbours in the order of their cost.
    fn look_around(&self, from: u32, tolerance_m: f32, scratch: &mut Scratch) {
        scratch.ring.clear();
        scratch.around.clear();
        let mut planes = Planes::default();
        let origin = self.at(from);
        for corner in self.corners_at(from) {
            let (b, c) = self.opposite(corner);
            scratch.ring.push((b, c));
            scratch.around.push(corner / 3);
            planes.add((self.at(b) - origin).cross(self.at(c) - origin));
        }
        scratch.normal = planes.normal.normalize_or_zero();
        let mut targets = std::mem::take(&mut scratch.targets);
        targets.clear();
        if scratch.normal == Vec3::ZERO {
            scratch.targets = targets;
            return;
        }
        scratch.rim = match self.freedom[from as usize] {
            Freedom::Rim => rim_neighbors(&scratch.ring),
            Freedom::Fixed | Freedom::Inner => None,
        };
        let allowed = |to: u32| scratch.rim.is_none_or(|rim| rim.contains(&to));
        let ends = scratch.rim.into_iter().flatten().skip(1);
        let starts = scratch.ring.iter().map(|&(to, _)| to);
        for to in starts.chain(ends).filter(|&to| allowed(to)) {
            let edge = self.at(to) - origin;
            let cost = planes.cost(edge);
            if cost <= 4.0 * tolerance_m * tolerance_m {
                let cost = cost + LENGTH_WEIGHT * edge.length_squared();
                targets.push((cost, to));
            }
        }
        scratch.targets = targets;
        (scratch.targets).sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    }

    /// Whether the two vertices have only those neighbours in common that the edge faces, two or, on
    /// the rim, one, and no triangle with both of them is left over.
    fn stays_a_surface(&self, from: u32, to: u32, scratch: &mut Scratch) -> bool {
        scratch.round += 2;
        let (unseen, seen) = (scratch.round, scratch.round + 1);
        for &(neighbor, _) in &scratch.ring {
            scratch.marks[neighbor as usize] = unseen;
        }
        let mut common = 0;
        for corner in self.corners_at(to) {
            let (b, c) = self.opposite(corner);
            let is_marked = [b, c].map(|v| scratch.marks[v as usize] >= unseen);
            if is_marked == [true, true] && b != from && c != from {
                return false;
            }
            for vertex in [b, c] {
                if scratch.marks[vertex as usize] == unseen {
                    scratch.marks[vertex as usize] = seen;
                    common += 1;
                }
            }
        }
        common == if scratch.rim.is_some() { 1 } else { 2 }
    }

    /// Spreads the new triangles in the plane of the old ones. Whether all of them may be.
    fn lay_fan(&self, to: u32, scratch: &mut Scratch) -> bool {
        scratch.fan.start(self.at(to), scratch.normal);
        for (index, &(b, c)) in scratch.ring.iter().enumerate() {
            if b == to || c == to {
                continue;
            }
            let [b, c] = [b, c].map(|v| self.at(v));
            if !scratch.fan.add(index, b, c, scratch.max_edge_m) {
                return false;
            }
        }
        !scratch.fan.is_empty()
    }

    /// Finds the new triangle of each point. Whether all are within the tolerance, and those of the
    /// rim near the new rim. These are kept with the triangle at the rim, so that they are asked again
    /// when the rim changes once more.
    fn is_within(&self, tolerance_m: f32, from: u32, to: u32, scratch: &mut Scratch) -> bool {
        scratch.places.clear();
        let is_end = |vertex: u32| vertex != to && scratch.rim.is_some_and(|r| r.contains(&vertex));
        let rim_blade = (scratch.ring.iter())
            .position(|&(b, c)| b != to && c != to && (is_end(b) || is_end(c)));
        let rim = (scratch.rim).map(|[a, b]| [self.at(a), self.at(b)]);
        let off_rim_m = RIM_FACTOR * tolerance_m;
        let points = (scratch.around.iter()).flat_map(|&triangle| self.points_on(triangle));
        for point in std::iter::once(from).chain(points) {
            let place = self.measured[point as usize];
            let (nearest, off_surface_squared) = scratch.fan.nearest(place);
            if off_surface_squared > tolerance_m * tolerance_m {
                return false;
            }
            let mut blade = nearest;
            if let Some([a, b]) = rim
                && self.is_rim[point as usize]
            {
                if distance_squared(place, a, b) > off_rim_m * off_rim_m {
                    return false;
                }
                blade = rim_blade.unwrap_or(nearest);
            }
            scratch.places.push((point, scratch.around[blade]));
        }
        true
    }

    fn collapse(&mut self, from: u32, to: u32, scratch: &Scratch) {
        for (&triangle, &(b, c)) in scratch.around.iter().zip(&scratch.ring) {
            self.first_point[triangle as usize] = NONE;
            let corners = corners_of(triangle as usize);
            let is_dead = b == to || c == to;
            for corner in corners {
                let vertex = self.vertex_of(corner);
                if is_dead && vertex != from {
                    self.drop_corner(corner);
                } else if !is_dead && vertex == from {
                    self.triangles[triangle as usize][corner as usize % 3] = to;
                    self.push_corner(corner);
                }
            }
            if is_dead {
                self.triangles[triangle as usize] = DEAD;
            }
        }
        self.first_corner[from as usize] = NONE;
        self.freedom[from as usize] = Freedom::Fixed;
        for &(point, triangle) in &scratch.places {
            self.push_point(point, triangle);
        }
    }

    fn is_free(&self, vertex: usize) -> bool {
        self.freedom[vertex] != Freedom::Fixed
    }

    fn at(&self, vertex: u32) -> Vec3 {
        self.vertices[vertex as usize]
    }

    fn vertex_of(&self, corner: u32) -> u32 {
        self.triangles[corner as usize / 3][corner as usize % 3]
    }

    /// The other two corners of a corner's triangle, in order.
    fn opposite(&self, corner: u32) -> (u32, u32) {
        let [a, b, c] = self.triangles[corner as usize / 3];
        match corner % 3 {
            0 => (b, c),
            1 => (c, a),
            _ => (a, b),
        }
    }

    fn corners_at(&self, vertex: u32) -> impl Iterator<Item = u32> {
        walk(&self.next_corner, self.first_corner[vertex as usize])
    }

    fn points_on(&self, triangle: u32) -> impl Iterator<Item = u32> {
        walk(&self.next_point, self.first_point[triangle as usize])
    }

    fn push_corner(&mut self, corner: u32) {
        let first = &mut self.first_corner
            [self.triangles[corner as usize / 3][corner as usize % 3] as usize];
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

fn corners_of(triangle: usize) -> Range<u32> {
    3 * triangle as u32..3 * triangle as u32 + 3
}

/// The ends of the chain around a vertex on the rim; `None` if it is no chain.
fn rim_neighbors(chain: &[(u32, u32)]) -> Option<[u32; 2]> {
    let first = chain
        .iter()
        .find(|(from, _)| chain.iter().all(|(_, to)| to != from))?;
    let last = chain
        .iter()
        .find(|(_, to)| chain.iter().all(|(from, _)| from != to))?;
    Some([first.0, last.1])
}

/// The members of a list.
fn walk(next: &[u32], first: u32) -> impl Iterator<Item = u32> {
    let some = |index: u32| (index != NONE).then_some(index);
    std::iter::successors(some(first), move |&index| some(next[index as usize]))
}

/// What is written anew for each vertex.
struct Scratch {
    max_edge_m: f32,
    /// Next and last corner of each triangle around the vertex.
    ring: Vec<(u32, u32)>,
    /// On the rim: its two neighbours along it.
    rim: Option<[u32; 2]>,
    /// These triangles.
    around: Vec<u32>,
    /// Their mean normal.
    normal: Vec3,
    /// Cost and neighbour.
    targets: Vec<(f32, u32)>,
    fan: Fan,
    /// Each point with its new triangle.
    places: Vec<(u32, u32)>,
    marks: Vec<u32>,
    round: u32,
}

impl Scratch {
    fn new(vertices: usize, resolution_m: f32) -> Self {
        Self {
            max_edge_m: resolution_m,
            ring: Vec::new(),
            rim: None,
            around: Vec::new(),
            normal: Vec3::ZERO,
            targets: Vec::new(),
            fan: Fan::default(),
            places: Vec::new(),
            marks: vec![0; vertices],
            round: 0,
        }
    }
}
