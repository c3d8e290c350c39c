use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::geometry::{TriangleMesh, Vec3};

/// Random triangles in a cube of 20 m.
fn soup(triangles: usize, size_m: f32, rng: &mut ChaCha8Rng) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for _ in 0..triangles {
        let middle = 10.0 * in_cube(rng);
        let first = mesh.vertices.len() as u32;
        for _ in 0..3 {
            mesh.vertices.push(middle + size_m * in_cube(rng));
        }
        mesh.triangles.push([first, first + 1, first + 2]);
    }
    mesh
}

fn in_cube(rng: &mut ChaCha8Rng) -> Vec3 {
    Vec3::from_array([0, 1, 2].map(|_| rng.random_range(-1.0_f32..1.0)))
}

fn direction(rng: &mut ChaCha8Rng) -> Vec3 {
    loop {
        let vector = in_cube(rng);
        if (0.1..1.0).contains(&vector.length()) {
            return vector.normalize();
        }
    }
}

fn cast_one(scene: &Scene, origin: Vec3, direction: Vec3) -> Hit {
    let mut hits = [Hit::MISS];
    scene.cast(origin, &[direction.normalize()], &mut hits);
    hits[0]
}

/// Range of one triangle in double precision (Möller and Trumbore 1997).
fn range_by_hand(origin: Vec3, direction: Vec3, corners: [Vec3; 3]) -> f64 {
    let (o, d) = (origin.as_dvec3(), direction.as_dvec3());
    let [a, b, c] = corners.map(|corner| corner.as_dvec3());
    let (ab, ac) = (b - a, c - a);
    let p = d.cross(ac);
    let det = ab.dot(p);
    let s = o - a;
    let u = s.dot(p) / det;
    let q = s.cross(ab);
    let v = d.dot(q) / det;
    let t = ac.dot(q) / det;
    if u >= 0.0 && v >= 0.0 && u + v <= 1.0 && t > 0.0 {
        t
    } else {
        f64::INFINITY
    }
}

#[test]
fn a_soup_of_triangles_is_seen_as_by_testing_all_of_them() {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    for (triangles, size_m) in [(1, 5.0), (3, 5.0), (30, 4.0), (500, 2.0), (3000, 0.5)] {
        let mesh = soup(triangles, size_m, &mut rng);
        let scene = Scene::new(&mesh);
        let mut met = 0;
        for _ in 0..20 {
            let origin = 10.0 * in_cube(&mut rng);
            let directions: Vec<Vec3> = (0..37).map(|_| direction(&mut rng)).collect();
            let mut hits = vec![Hit::MISS; directions.len()];
            scene.cast(origin, &directions, &mut hits);
            for (direction, hit) in directions.into_iter().zip(hits) {
                let nearest = (0..triangles)
                    .map(|t| range_by_hand(origin, direction, mesh.corners(t)))
                    .fold(f64::INFINITY, f64::min);
                if hit == Hit::MISS {
                    assert_eq!(nearest, f64::INFINITY);
                } else {
                    met += 1;
                    let corners = mesh.corners(hit.triangle as usize);
                    let own = range_by_hand(origin, direction, corners);
                    assert!((own - nearest).abs() < 1e-4, "{own} {nearest}");
                    assert!((f64::from(hit.range_m) - nearest).abs() < 1e-4);
                }
            }
        }
        assert!(triangles < 30 || met > 10);
    }
}

/// The surface of the box |x|, |y|, |z| ≤ `half_m`.
fn cube(half_m: f32) -> TriangleMesh {
    let vertices = (0..8)
        .map(|bits| {
            Vec3::from_array([0, 1, 2].map(|axis| if bits >> axis & 1 == 0 { -1.0 } else { 1.0 }))
                * half_m
        })
        .collect();
    let faces = [
        [0, 2, 3, 1],
        [4, 5, 7, 6],
        [0, 1, 5, 4],
        [2, 6, 7, 3],
        [0, 4, 6, 2],
        [1, 3, 7, 5],
    ];
    TriangleMesh {
        vertices,
        triangles: faces
            .into_iter()
            .flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]])
            .collect(),
        ..TriangleMesh::default()
    }
}

#[test]
fn the_walls_of_a_cube_are_where_they_are_from_inside_and_outside() {
    let scene = Scene::new(&cube(0.5));
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    for _ in 0..200 {
        let direction = direction(&mut rng);
        let expected = 0.5 / direction.abs().max_element();
        let inside = cast_one(&scene, Vec3::ZERO, direction).range_m;
        assert!((inside - expected).abs() < 1e-6, "{inside} {expected}");
        let outside = cast_one(&scene, -10.0 * direction, direction).range_m;
        assert!((outside - (10.0 - expected)).abs() < 1e-5);
        assert_eq!(cast_one(&scene, 10.0 * direction, direction), Hit::MISS);
    }
}
