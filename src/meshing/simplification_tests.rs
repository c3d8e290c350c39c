//! Laws of the simplification.

use std::collections::BTreeSet;

use glam::Vec3;

use super::shapes_for_tests::{Topology, street};
use super::{PoissonConfig, reconstruct, simplify};
use crate::geometry::{Aabb, TriangleMesh};
use crate::memory::MemoryBudget;

/// A square of 20 m with heights `height` and a number of cells per side.
fn square(cells: u32, height: impl Fn(f32, f32) -> f32) -> TriangleMesh {
    let side = cells + 1;
    let mut mesh = TriangleMesh::default();
    for i in 0..side * side {
        let [x, y] = [i % side, i / side].map(|k| k as f32 * 20.0 / cells as f32);
        mesh.vertices.push(Vec3::new(x, y, height(x, y)));
        mesh.colors.push([(i % 256) as u8, 0, 0]);
    }
    for a in (0..side * cells).filter(|a| a % side != cells) {
        mesh.triangles.push([a, a + 1, a + side + 1]);
        mesh.triangles.push([a, a + side + 1, a + side]);
    }
    mesh.compute_normals();
    mesh
}

/// A field with a crown of 10 cm, ripples of 5 mm and a step to a platform that is not ground.
fn field(cells: u32) -> (TriangleMesh, Vec<bool>) {
    let mesh = square(cells, |x, y| {
        let step = if y > 15.0 { 0.5 } else { 0.0 };
        step - 0.001 * (x - 10.0).powi(2) + 0.005 * (3.0 * x).sin() * (4.0 * y).cos()
    });
    let is_ground = (0..mesh.triangles.len())
        .map(|t| mesh.corners(t).iter().all(|v| v.y < 15.0))
        .collect();
    (mesh, is_ground)
}

/// The reconstruction of a street with 1 cm of noise, and its ground.
fn noisy_street() -> (TriangleMesh, Vec<bool>) {
    let config = PoissonConfig {
        depth: Some(8),
        ..PoissonConfig::default()
    };
    let mesh = reconstruct(&street(100_000, 0.01, 5), &config, MemoryBudget::default())
        .unwrap()
        .mesh;
    let is_ground = (0..mesh.triangles.len())
        .map(|t| {
            let is_low = |v: &Vec3| v.x.abs() < 18.0 && v.y.abs() < 7.5 && v.z.abs() < 0.1;
            mesh.corners(t).iter().all(is_low)
        })
        .collect();
    (mesh, is_ground)
}

fn ground_vertices(mesh: &TriangleMesh, is_ground: &[bool]) -> Vec<Vec3> {
    let of_ground = |(_, is_ground): &(_, &bool)| **is_ground;
    let indices: BTreeSet<u32> = (mesh.triangles.iter().zip(is_ground))
        .filter(of_ground)
        .flat_map(|(triangle, _)| *triangle)
        .collect();
    indices.iter().map(|&v| mesh.vertices[v as usize]).collect()
}

#[test]
fn the_ground_loses_four_fifths_of_its_triangles_with_an_error_below_a_centimeter() {
    for (name, (mesh, is_ground)) in [("field", field(100)), ("street", noisy_street())] {
        for smoothing in [0, 1, 4] {
            let simple = simplify(&mesh, &is_ground, &[], 1.0, smoothing);
            let ground = is_ground.iter().filter(|&&is_ground| is_ground).count();
            let left = simple.triangles.len() + ground - mesh.triangles.len();
            assert!(5 * left <= ground, "{name} {smoothing}: {left} of {ground}");
            let surface = SurfaceIndex::new(&simple);
            for vertex in ground_vertices(&mesh, &is_ground) {
                let distance_m = surface.distance_m(vertex);
                assert!(distance_m < 0.01001, "{name} {vertex} {distance_m}");
            }
        }
    }
}

#[test]
fn other_triangles_and_the_topology_are_unchanged() {
    for (mesh, is_ground) in [field(60), noisy_street()] {
        let simple = simplify(&mesh, &is_ground, &[], 1.0, 1);
        let [before, after] = [&mesh, &simple].map(Topology::of);
        assert!(after.is_manifold() || !before.is_manifold());
        assert_eq!(before.euler, after.euler);
        let corners =
            |mesh: &TriangleMesh, t: usize| mesh.corners(t).map(|v| v.to_array().map(f32::to_bits));
        let kept: BTreeSet<_> = (0..simple.triangles.len())
            .map(|t| corners(&simple, t))
            .collect();
        for triangle in (0..mesh.triangles.len()).filter(|&t| !is_ground[t]) {
            assert!(kept.contains(&corners(&mesh, triangle)));
        }
        let referenced: BTreeSet<u32> = simple.triangles.iter().flatten().copied().collect();
        assert_eq!(referenced.len(), simple.vertices.len());
        assert_eq!(simple.colors.len(), mesh.colors.len().min(referenced.len()));
    }
}

/// Level ground with wavy and zigzag boundaries.
fn island() -> TriangleMesh {
    let mut mesh = square(100, |_, _| 0.0);
    for vertex in &mut mesh.vertices {
        let (x, y) = (vertex.x, vertex.y);
        // Waves of 3 cm along one side, teeth of 2 cm and of 10 cm along two others.
        let tooth = |place: f32| {
            if (5.0 * place).round() % 2.0 == 0.0 {
                1.0
            } else {
                0.0
            }
        };
        if y == 0.0 {
            vertex.y -= 0.03 * (0.7 * x).sin();
        } else if x == 0.0 {
            vertex.x -= 0.02 * tooth(y);
        } else if y == 20.0 {
            vertex.y += 0.1 * tooth(x);
        }
    }
    mesh
}

#[test]
fn an_almost_straight_boundary_is_simplified_within_its_tolerance() {
    let mesh = island();
    let all = vec![true; mesh.triangles.len()];
    let simple = simplify(&mesh, &all, &[], 1.0, 0);
    let [before, after] = [&mesh, &simple].map(Topology::of);
    assert_eq!((before.open_edges, before.euler), (400, 1));
    // The teeth of 10 cm remain; the other sides keep at most a third of their vertices.
    assert!((100..200).contains(&after.open_edges), "{after:?}");
    assert!(after.is_manifold());
    let (old, new) = (SurfaceIndex::new(&mesh), SurfaceIndex::new(&simple));
    for vertex in &mesh.vertices {
        assert!(new.distance_m(*vertex) < 0.01001, "{vertex}");
    }
    for triangle in 0..simple.triangles.len() {
        let [a, b, c] = simple.corners(triangle);
        for place in [a, 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)] {
            assert!(old.distance_m(place) < 0.02001, "{place}");
        }
    }
}

#[test]
fn fixed_vertices_remain_on_the_boundary_and_inside() {
    let mesh = island();
    let all = vec![true; mesh.triangles.len()];
    let fixed: Vec<bool> = mesh.vertices.iter().map(|vertex| vertex.y < 3.0).collect();
    let simple = simplify(&mesh, &all, &fixed, 1.0, 3);
    let left: BTreeSet<_> = (simple.vertices.iter())
        .map(|vertex| vertex.to_array().map(f32::to_bits))
        .collect();
    for (vertex, _) in mesh
        .vertices
        .iter()
        .zip(&fixed)
        .filter(|(_, fixed)| **fixed)
    {
        assert!(
            left.contains(&vertex.to_array().map(f32::to_bits)),
            "{vertex}"
        );
    }
    assert!(simple.vertices.len() < mesh.vertices.len() / 3);
}

#[test]
fn new_triangles_are_level_and_their_edges_within_the_limit() {
    let (mesh, is_ground) = noisy_street();
    let bits = |[a, b, c]: [Vec3; 3]| [a, b, c].map(|v| v.to_array().map(f32::to_bits));
    let old: BTreeSet<_> = (0..mesh.triangles.len())
        .map(|triangle| bits(mesh.corners(triangle)))
        .collect();
    for resolution_m in [0.5, 1.0] {
        let simple = simplify(&mesh, &is_ground, &[], resolution_m, 0);
        let new: Vec<usize> = (0..simple.triangles.len())
            .filter(|&triangle| !old.contains(&bits(simple.corners(triangle))))
            .collect();
        assert!(new.len() > 500);
        for triangle in new {
            let [a, b, c] = simple.corners(triangle);
            let up = simple.scaled_normal(triangle).normalize().z;
            assert!(up > 0.7, "{a} {b} {c} {up}");
            let longest_m = a.distance(b).max(b.distance(c)).max(c.distance(a));
            assert!(longest_m < 1.0001 * resolution_m, "{longest_m}");
        }
    }
}

#[test]
fn smoothing_flips_no_triangle() {
    let (mesh, is_ground) = noisy_street();
    let turned = |mesh: &TriangleMesh| {
        let is_inside = |v: &Vec3| v.x.abs() < 17.0 && v.y.abs() < 7.0 && v.z.abs() < 0.1;
        (0..mesh.triangles.len())
            .filter(|&t| mesh.corners(t).iter().all(is_inside) && mesh.scaled_normal(t).z <= 0.0)
            .count()
    };
    for iterations in [1, 4] {
        let simple = simplify(&mesh, &is_ground, &[], 1.0, iterations);
        assert!(
            turned(&simple) <= turned(&mesh),
            "{} {}",
            turned(&simple),
            turned(&mesh)
        );
    }
}

#[test]
fn block_boundaries_leave_no_denser_seams() {
    let mesh = square(160, |_, _| 0.0);
    let simple = simplify(&mesh, &vec![true; mesh.triangles.len()], &[], 1.0, 0);
    // Counts in squares of 1 m away from the boundary.
    let mut counts = [[0; 16]; 16];
    for triangle in 0..simple.triangles.len() {
        let [a, b, c] = simple.corners(triangle);
        let [x, y, _] = ((a + b + c) / 3.0 - 2.0).to_array();
        if (0.0..16.0).contains(&x) && (0.0..16.0).contains(&y) {
            counts[y as usize][x as usize] += 1;
        }
    }
    // 128 before.
    assert!(
        counts.iter().flatten().all(|&count| count < 16),
        "{counts:?}"
    );
}

#[test]
fn a_bump_above_the_tolerance_remains() {
    let is_bump = |x: f32, y: f32| (x - 7.0).abs() < 0.01 && (y - 12.0).abs() < 0.01;
    let mesh = square(100, |x, y| if is_bump(x, y) { 0.03 } else { 0.0 });
    let simple = simplify(&mesh, &vec![true; mesh.triangles.len()], &[], 1.0, 0);
    assert!(simple.triangles.len() < mesh.triangles.len() / 5);
    assert!(simple.vertices.iter().any(|v| is_bump(v.x, v.y)));
}

#[test]
fn the_result_does_not_depend_on_the_number_of_threads() {
    let (mesh, is_ground) = field(80);
    let with_threads = |count: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build();
        let simplified = || simplify(&mesh, &is_ground, &[], 1.0, 1);
        pool.unwrap().install(simplified)
    };
    assert_eq!(with_threads(1), with_threads(2));
}

#[test]
fn without_ground_nothing_changes() {
    let (mesh, is_ground) = field(10);
    assert_eq!(
        simplify(&mesh, &vec![false; is_ground.len()], &[], 1.0, 3),
        mesh
    );
}

/// Distances to an approximately level mesh.
struct SurfaceIndex<'a> {
    mesh: &'a TriangleMesh,
    bounds: Aabb,
    /// The triangles over each square meter, row-major.
    cells: Vec<Vec<usize>>,
    columns: usize,
}

impl<'a> SurfaceIndex<'a> {
    fn new(mesh: &'a TriangleMesh) -> Self {
        let bounds = mesh.bounds();
        let columns = bounds.size().x as usize + 1;
        let rows = bounds.size().y as usize + 1;
        let mut surface = Self {
            mesh,
            bounds,
            cells: vec![Vec::new(); columns * rows],
            columns,
        };
        for triangle in 0..mesh.triangles.len() {
            let extent = Aabb::from_points(mesh.corners(triangle));
            let [low, high] = [extent.min, extent.max].map(|corner| surface.cell(corner));
            for row in low.1..=high.1 {
                for column in low.0..=high.0 {
                    surface.cells[row * columns + column].push(triangle);
                }
            }
        }
        surface
    }

    fn cell(&self, point: Vec3) -> (usize, usize) {
        let point = point - self.bounds.min;
        (point.x as usize, point.y as usize)
    }

    /// Distance to the nearest triangle over the same square meter, an upper bound of the true one.
    fn distance_m(&self, point: Vec3) -> f32 {
        let (column, row) = self.cell(point);
        (self.cells[row * self.columns + column].iter())
            .map(|&triangle| distance_m(point, self.mesh.corners(triangle)))
            .fold(f32::INFINITY, f32::min)
    }
}

/// Distance to a triangle: to its plane if the projection is inside, otherwise to its edges.
fn distance_m(point: Vec3, corners: [Vec3; 3]) -> f32 {
    let [a, b, c] = corners;
    let normal = (b - a).cross(c - a).normalize_or_zero();
    let is_left = |from: Vec3, to: Vec3| (to - from).cross(point - from).dot(normal) >= 0.0;
    if normal != Vec3::ZERO && is_left(a, b) && is_left(b, c) && is_left(c, a) {
        return (point - a).dot(normal).abs();
    }
    [(a, b), (b, c), (c, a)]
        .map(|(from, to)| {
            let edge = to - from;
            let share = (point - from).dot(edge) / edge.length_squared().max(1e-12);
            point.distance(from + share.clamp(0.0, 1.0) * edge)
        })
        .into_iter()
        .fold(f32::INFINITY, f32::min)
}
