//! Fewer triangles for the ground: edges collapse in the order of the error that they cost.
//!
//! ```text
//! cost of a point p = Σ over the planes (n, d) met so far of  A (n·p + d)²  /  Σ A
//! ```
//!
//! Garland and Heckbert, *Surface Simplification Using Quadric Error Metrics* (1997). A vertex is
//! drawn onto one of its neighbours, so positions, normals and colours stay what they were.
//! Vertices that touch other triangles or the border stay where they are: no crack opens.

use std::cmp::Ordering;
use std::collections::BinaryHeap;

use glam::{DVec3, Vec3};

use crate::geometry::TriangleMesh;

/// Deviation at which a collapse is refused, root mean square over the planes it replaces [m].
const MAX_ERROR_M: f64 = 0.01;
/// A triangle must not turn farther than this: cosine of 25 degrees.
const MIN_COSINE: f32 = 0.9;
/// A triangle must not become thinner than this: twice its area over its longest edge squared.
const MIN_SHAPE: f32 = 0.05;

/// The mesh with fewer triangles where `is_ground`: edges up to `resolution_m` long, within two
/// centimetres of what was there. Before, the ground's inner vertices are drawn
/// `smoothing_iterations` times halfway to the mean of their neighbours along their normals, by at
/// most a centimetre in all.
///
/// `is_ground` is per triangle. Vertices of other triangles, and of the open border, are not
/// touched; normals and colours are kept; no vertex is left without a triangle.
pub fn simplify_ground(
    mesh: &TriangleMesh,
    is_ground: &[bool],
    resolution_m: f32,
    smoothing_iterations: usize,
) -> TriangleMesh {
    let mut work = Collapse::new(mesh, is_ground, resolution_m);
    work.smooth(smoothing_iterations);
    work.run();
    work.finish()
}

/// A symmetric quadratic form over points, and the area it stands for.
#[derive(Clone, Copy, Default)]
struct Quadric {
    /// xx xy xz yy yz zz
    square: [f64; 6],
    linear: DVec3,
    constant: f64,
    area: f64,
}

impl Quadric {
    fn of_plane(normal: DVec3, offset: f64, area: f64) -> Self {
        let n = normal;
        Self {
            square: [
                n.x * n.x,
                n.x * n.y,
                n.x * n.z,
                n.y * n.y,
                n.y * n.z,
                n.z * n.z,
            ]
            .map(|x| area * x),
            linear: area * offset * n,
            constant: area * offset * offset,
            area,
        }
    }

    fn plus(mut self, other: &Self) -> Self {
        for (a, b) in self.square.iter_mut().zip(other.square) {
            *a += b;
        }
        self.linear += other.linear;
        self.constant += other.constant;
        self.area += other.area;
        self
    }

    /// Mean squared distance of a point to the planes [m²].
    fn error(&self, p: DVec3) -> f64 {
        let [xx, xy, xz, yy, yz, zz] = self.square;
        let square = xx * p.x * p.x
            + yy * p.y * p.y
            + zz * p.z * p.z
            + 2.0 * (xy * p.x * p.y + xz * p.x * p.z + yz * p.y * p.z);
        let sum = square + 2.0 * self.linear.dot(p) + self.constant;
        (sum / self.area.max(1e-12)).max(0.0)
    }
}

/// Vertex `from` drawn onto `to`; the cheapest comes first, then the lower indices.
#[derive(PartialEq)]
struct Candidate {
    cost: f64,
    from: u32,
    to: u32,
    stamp: u32,
}

impl Eq for Candidate {}
impl Ord for Candidate {
    fn cmp(&self, other: &Self) -> Ordering {
        (other.cost.total_cmp(&self.cost))
            .then_with(|| (other.from, other.to).cmp(&(self.from, self.to)))
    }
}
impl PartialOrd for Candidate {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

struct Collapse {
    mesh: TriangleMesh,
    alive: Vec<bool>,
    /// Triangles around each vertex, dead ones included until a collapse cleans up.
    around: Vec<Vec<u32>>,
    locked: Vec<bool>,
    quadrics: Vec<Quadric>,
    /// Counts the changes around each vertex: older candidates are void.
    stamps: Vec<u32>,
    resolution_m: f32,
    /// Where quadrics are accumulated around; keeps them exact far from the map's origin.
    center: Vec3,
}

impl Collapse {
    fn new(mesh: &TriangleMesh, is_ground: &[bool], resolution_m: f32) -> Self {
        let mut around = vec![Vec::new(); mesh.vertices.len()];
        let mut locked = vec![false; mesh.vertices.len()];
        for (index, triangle) in mesh.triangles.iter().enumerate() {
            let is_ground = is_ground.get(index).copied().unwrap_or(false);
            for &vertex in triangle {
                around[vertex as usize].push(index as u32);
                locked[vertex as usize] |= !is_ground;
            }
        }
        let mut work = Self {
            alive: vec![true; mesh.triangles.len()],
            quadrics: vec![Quadric::default(); mesh.vertices.len()],
            stamps: vec![0; mesh.vertices.len()],
            center: mesh.bounds().center(),
            mesh: mesh.clone(),
            around,
            locked,
            resolution_m,
        };
        for vertex in 0..work.locked.len() {
            work.locked[vertex] |= !work.is_inner(vertex);
        }
        work
    }

    /// Whether the triangles around a vertex form one closed ring.
    fn is_inner(&self, vertex: usize) -> bool {
        let mut out: Vec<u32> = Vec::new();
        let mut back: Vec<u32> = Vec::new();
        for &triangle in &self.around[vertex] {
            let (to, from) = opposite(self.mesh.triangles[triangle as usize], vertex as u32);
            out.push(to);
            back.push(from);
        }
        out.sort_unstable();
        back.sort_unstable();
        let is_simple = out.windows(2).all(|pair| pair[0] != pair[1]);
        is_simple && !out.is_empty() && out == back
    }

    fn neighbors(&self, vertex: usize) -> Vec<u32> {
        let mut all: Vec<u32> = self.around[vertex]
            .iter()
            .flat_map(|&triangle| self.mesh.triangles[triangle as usize])
            .filter(|&other| other as usize != vertex)
            .collect();
        all.sort_unstable();
        all.dedup();
        all
    }

    fn smooth(&mut self, iterations: usize) {
        const MAX_MOVE_M: f32 = 0.01;
        let before = self.mesh.vertices.clone();
        let has_normals = self.mesh.normals.len() == before.len();
        if !has_normals {
            return;
        }
        for _ in 0..iterations {
            let now = self.mesh.vertices.clone();
            for vertex in (0..now.len()).filter(|&vertex| !self.locked[vertex]) {
                let neighbors = self.neighbors(vertex);
                let sum: Vec3 = neighbors.iter().map(|&other| now[other as usize]).sum();
                let normal = self.mesh.normals[vertex];
                let rise = (sum / neighbors.len() as f32 - now[vertex]).dot(normal);
                let moved = (now[vertex] - before[vertex]).dot(normal) + 0.5 * rise;
                self.mesh.vertices[vertex] =
                    before[vertex] + moved.clamp(-MAX_MOVE_M, MAX_MOVE_M) * normal;
            }
        }
    }

    fn at(&self, vertex: u32) -> DVec3 {
        (self.mesh.vertices[vertex as usize] - self.center).as_dvec3()
    }

    fn run(&mut self) {
        for triangle in self.mesh.triangles.clone() {
            let [a, b, c] = triangle.map(|vertex| self.at(vertex));
            let scaled = (b - a).cross(c - a);
            let normal = scaled.normalize_or_zero();
            let plane = Quadric::of_plane(normal, -normal.dot(a), 0.5 * scaled.length());
            for vertex in triangle {
                let quadric = &mut self.quadrics[vertex as usize];
                *quadric = quadric.plus(&plane);
            }
        }
        let mut heap = BinaryHeap::new();
        for vertex in 0..self.locked.len() {
            self.propose(vertex as u32, &mut heap);
        }
        while let Some(candidate) = heap.pop() {
            if candidate.stamp != self.stamps[candidate.from as usize] {
                continue;
            }
            if self.may_collapse(candidate.from, candidate.to) {
                self.collapse(candidate.from, candidate.to, &mut heap);
            }
        }
    }

    /// Puts the ways in which a vertex may go into the heap.
    fn propose(&self, from: u32, heap: &mut BinaryHeap<Candidate>) {
        if self.locked[from as usize] {
            return;
        }
        for to in self.neighbors(from as usize) {
            let both = self.quadrics[from as usize].plus(&self.quadrics[to as usize]);
            let cost = both.error(self.at(to));
            if cost <= MAX_ERROR_M * MAX_ERROR_M {
                heap.push(Candidate {
                    cost,
                    from,
                    to,
                    stamp: self.stamps[from as usize],
                });
            }
        }
    }

    /// Whether the mesh stays a mesh: no triangle turns over, none becomes a needle, no edge too
    /// long, and the two vertices have no other neighbours in common than the two opposite ones.
    fn may_collapse(&self, from: u32, to: u32) -> bool {
        let theirs = self.neighbors(to as usize);
        let common = self
            .neighbors(from as usize)
            .into_iter()
            .filter(|vertex| theirs.binary_search(vertex).is_ok())
            .count();
        if common != 2 {
            return false;
        }
        let target = self.mesh.vertices[to as usize];
        self.around[from as usize].iter().all(|&triangle| {
            let corners = self.mesh.triangles[triangle as usize];
            if corners.contains(&to) {
                return true;
            }
            let (next, last) = opposite(corners, from);
            let [old, b, c] = [from, next, last].map(|v| self.mesh.vertices[v as usize]);
            let (before, after) = ((b - old).cross(c - old), (b - target).cross(c - target));
            let longest = (b.distance_squared(target))
                .max(c.distance_squared(target))
                .max(b.distance_squared(c));
            let limit = self.resolution_m.max(b.distance(c));
            longest <= limit * limit
                && after.length() >= MIN_SHAPE * longest
                && before.dot(after) >= MIN_COSINE * before.length() * after.length()
                && self.plane_error_m(from, target, after.normalize_or_zero()) <= MAX_ERROR_M
        })
    }

    /// How far the old vertex lies off a new triangle's plane [m].
    fn plane_error_m(&self, from: u32, target: Vec3, normal: Vec3) -> f64 {
        f64::from(
            (self.mesh.vertices[from as usize] - target)
                .dot(normal)
                .abs(),
        )
    }

    fn collapse(&mut self, from: u32, to: u32, heap: &mut BinaryHeap<Candidate>) {
        for triangle in std::mem::take(&mut self.around[from as usize]) {
            let corners = &mut self.mesh.triangles[triangle as usize];
            if corners.contains(&to) {
                self.alive[triangle as usize] = false;
                for vertex in *corners {
                    self.around[vertex as usize].retain(|&other| other != triangle);
                }
            } else {
                *corners = corners.map(|vertex| if vertex == from { to } else { vertex });
                self.around[to as usize].push(triangle);
            }
        }
        self.quadrics[to as usize] = self.quadrics[to as usize].plus(&self.quadrics[from as usize]);
        self.locked[from as usize] = true;
        for vertex in self.neighbors(to as usize).into_iter().chain([to]) {
            self.stamps[vertex as usize] += 1;
            self.propose(vertex, heap);
        }
    }

    fn finish(mut self) -> TriangleMesh {
        let alive = std::mem::take(&mut self.alive);
        self.mesh.retain_triangles(|triangle| alive[triangle]);
        self.mesh
    }
}

/// The other two corners of a triangle, in order.
fn opposite(triangle: [u32; 3], vertex: u32) -> (u32, u32) {
    match triangle {
        [a, b, c] if a == vertex => (b, c),
        [a, b, c] if b == vertex => (c, a),
        [a, b, _] => (a, b),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::meshing::shapes::Topology;

    /// A field of 20 m with a crown of 10 cm and ripples of 5 mm, and a step to a platform.
    fn field(cells: u32) -> (TriangleMesh, Vec<bool>) {
        let side = cells + 1;
        let mut mesh = TriangleMesh::default();
        for i in 0..side * side {
            let (x, y) = (
                (i % side) as f32 * 20.0 / cells as f32,
                (i / side) as f32 * 20.0 / cells as f32,
            );
            let step = if y > 15.0 { 0.5 } else { 0.0 };
            let z = step - 0.001 * (x - 10.0).powi(2) + 0.005 * (3.0 * x).sin() * (4.0 * y).cos();
            mesh.vertices.push(Vec3::new(x, y, z));
            mesh.colors.push([(i % 256) as u8, 0, 0]);
        }
        for y in 0..cells {
            for x in 0..cells {
                let a = x + side * y;
                mesh.triangles.push([a, a + 1, a + side + 1]);
                mesh.triangles.push([a, a + side + 1, a + side]);
            }
        }
        mesh.compute_normals();
        let is_ground = (0..mesh.triangles.len())
            .map(|t| mesh.corners(t).iter().all(|v| v.y < 15.0))
            .collect();
        (mesh, is_ground)
    }

    #[test]
    fn the_ground_loses_four_fifths_of_its_triangles_and_stays_within_two_centimetres() {
        let (mesh, is_ground) = field(100);
        let simple = simplify_ground(&mesh, &is_ground, 1.0, 1);
        let rest = is_ground.iter().filter(|&&is_ground| !is_ground).count();
        let (before, after) = (mesh.triangles.len() - rest, simple.triangles.len() - rest);
        assert!(5 * after <= before, "{after} of {before}");
        for vertex in mesh.vertices.iter().filter(|v| v.y < 14.9) {
            let height_m = height_at(&simple, vertex.x, vertex.y).unwrap();
            assert!((height_m - vertex.z).abs() < 0.02, "{vertex} {height_m}");
        }
    }

    #[test]
    fn the_rest_the_border_and_the_topology_stay_as_they_were() {
        let (mesh, is_ground) = field(60);
        let simple = simplify_ground(&mesh, &is_ground, 1.0, 1);
        let (before, after) = (Topology::of(&mesh), Topology::of(&simple));
        assert_eq!(before, after);
        let corners =
            |mesh: &TriangleMesh, t: usize| mesh.corners(t).map(|v| v.to_array().map(f32::to_bits));
        let kept: std::collections::BTreeSet<_> = (0..simple.triangles.len())
            .map(|t| corners(&simple, t))
            .collect();
        for triangle in (0..mesh.triangles.len()).filter(|&t| !is_ground[t]) {
            assert!(kept.contains(&corners(&mesh, triangle)));
        }
        let mut referenced = vec![false; simple.vertices.len()];
        simple
            .triangles
            .iter()
            .flatten()
            .for_each(|&v| referenced[v as usize] = true);
        assert!(referenced.iter().all(|&is| is));
        assert_eq!(simple.colors.len(), simple.vertices.len());
    }

    #[test]
    fn without_ground_nothing_changes() {
        let (mesh, is_ground) = field(10);
        assert_eq!(
            simplify_ground(&mesh, &vec![false; is_ground.len()], 1.0, 3),
            mesh
        );
    }

    /// Height of a mesh at a place of the plane.
    fn height_at(mesh: &TriangleMesh, x: f32, y: f32) -> Option<f32> {
        (0..mesh.triangles.len()).find_map(|triangle| {
            let [a, b, c] = mesh.corners(triangle);
            let (ab, ac, p) = (b - a, c - a, Vec3::new(x, y, 0.0) - a);
            let area = ab.x * ac.y - ab.y * ac.x;
            let u = (p.x * ac.y - p.y * ac.x) / area;
            let v = (ab.x * p.y - ab.y * p.x) / area;
            (u >= -1e-4 && v >= -1e-4 && u + v <= 1.0 + 1e-4).then_some(a.z + u * ab.z + v * ac.z)
        })
    }
}
