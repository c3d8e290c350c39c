//! Oriented points on known surfaces, and the topology of meshes.

use std::collections::BTreeMap;

use glam::Vec3;
use rand::{RngExt, SeedableRng, rngs::StdRng};
use rand_distr::{Distribution, StandardNormal};

use super::adjacency::chain_start;
use crate::geometry::{PointCloud, TriangleMesh};

/// Points all over a sphere around the origin, normals outwards.
pub fn sphere(radius_m: f32, count: usize) -> PointCloud {
    // A Fibonacci lattice: even, without poles.
    let golden = std::f32::consts::PI * (3.0 - 5.0_f32.sqrt());
    let mut cloud = PointCloud::default();
    for i in 0..count {
        let z = 1.0 - (2 * i + 1) as f32 / count as f32;
        let (sin, cos) = (golden * i as f32).sin_cos();
        let normal = Vec3::new(cos, sin, 0.0) * (1.0 - z * z).sqrt() + Vec3::Z * z;
        cloud.push(radius_m * normal, normal, 0.0);
    }
    cloud
}

/// A street of 40 m: ground, two walls of 6 m and four poles; `noise_m` along the normals.
pub fn street(count: usize, noise_m: f32, seed: u64) -> PointCloud {
    let mut rng = StdRng::seed_from_u64(seed);
    let mut cloud = PointCloud::default();
    for _ in 0..count {
        let (x, t): (f32, f32) = (rng.random_range(-20.0..20.0), rng.random());
        let (position, normal) = match rng.random_range(0..100) {
            0..60 => (Vec3::new(x, 16.0 * t - 8.0, 0.0), Vec3::Z),
            60..78 => (Vec3::new(x, 8.0, 6.0 * t), Vec3::NEG_Y),
            78..96 => (Vec3::new(x, -8.0, 6.0 * t), Vec3::Y),
            pole => {
                let (sin, cos) = (std::f32::consts::TAU * rng.random::<f32>()).sin_cos();
                let around = Vec3::new(cos, sin, 0.0);
                let foot = Vec3::new(10.0 * (pole - 97) as f32 - 5.0, 5.0, 4.0 * t);
                (foot + 0.2 * around, around)
            }
        };
        let noise: f32 = StandardNormal.sample(&mut rng);
        cloud.push(position + noise_m * noise * normal, normal, 0.0);
    }
    cloud
}

/// Topology of a mesh.
#[derive(Debug, PartialEq)]
pub struct Topology {
    /// Number of edges with one triangle.
    pub open_edges: usize,
    /// Number of edges with more than two triangles or inconsistent orientation.
    pub bad_edges: usize,
    /// Number of vertices whose triangles do not form one fan.
    pub bad_vertices: usize,
    /// Euler characteristic: vertices − edges + triangles.
    pub euler: i64,
}

impl Topology {
    /// The topology of a mesh.
    pub fn of(mesh: &TriangleMesh) -> Self {
        let mut edges: BTreeMap<(u32, u32), [u32; 2]> = BTreeMap::new();
        let mut links: Vec<Vec<(u32, u32)>> = vec![Vec::new(); mesh.vertices.len()];
        for &[a, b, c] in &mesh.triangles {
            for (from, to, other) in [(a, b, c), (b, c, a), (c, a, b)] {
                edges.entry((from.min(to), from.max(to))).or_default()[usize::from(from < to)] += 1;
                links[from as usize].push((to, other));
            }
        }
        let count = |is_such: fn(&[u32; 2]) -> bool| edges.values().filter(|e| is_such(e)).count();
        Self {
            open_edges: count(|[a, b]| a + b == 1),
            bad_edges: count(|&[a, b]| a > 1 || b > 1),
            bad_vertices: links.iter().filter(|link| !is_one_fan(link)).count(),
            euler: mesh.vertices.len() as i64 - edges.len() as i64 + mesh.triangles.len() as i64,
        }
    }

    /// Whether the mesh is a manifold without boundary.
    pub fn is_closed_manifold(&self) -> bool {
        self.open_edges == 0 && self.is_manifold()
    }

    /// Whether the mesh is a manifold, with or without boundary.
    pub fn is_manifold(&self) -> bool {
        self.bad_edges == 0 && self.bad_vertices == 0
    }
}

/// Whether the edges opposite to a vertex form one chain or one ring.
fn is_one_fan(link: &[(u32, u32)]) -> bool {
    let Some(start) = chain_start(link).or(link.first().copied()) else {
        return false;
    };
    let (mut reached, mut end) = (1, start.1);
    while end != start.0 && reached <= link.len() {
        match link.iter().find(|(from, _)| *from == end) {
            Some(next) => (reached, end) = (reached + 1, next.1),
            None => break,
        }
    }
    reached == link.len()
}
