use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::scene::Single;
use super::*;
use crate::geometry::{TriangleMesh, Vec3};
#[cfg(target_arch = "x86_64")]
use crate::simd::avx2::Avx2;
use crate::simd::{Baseline, SimdTask, dispatch};

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
fn random_triangles_are_hit_as_by_testing_all_of_them() {
    for is_snapped in [false, true] {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        for (triangles, size_m) in [(1, 5.0), (3, 5.0), (30, 4.0), (500, 2.0), (3000, 0.5)] {
            let mut mesh = soup(triangles, size_m, &mut rng);
            if is_snapped {
                mesh.snap();
            }
            let scene = Scene::new(&mesh);
            let mut hit_count = 0;
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
                        hit_count += 1;
                        let corners = mesh.corners(hit.triangle as usize);
                        let own = range_by_hand(origin, direction, corners);
                        assert!((own - nearest).abs() < 1e-4, "{own} {nearest}");
                        assert!((f64::from(hit.range_m) - nearest).abs() < 1e-4);
                    }
                }
            }
            assert!(triangles < 30 || hit_count > 10);
        }
    }
}

#[test]
fn a_snapped_scene_takes_forty_bytes_per_triangle_and_is_off_by_less_than_half_a_millimetre() {
    let exact = ball(20.0, 300, 600);
    let mut snapped = exact.clone();
    snapped.snap();
    for (before, after) in exact.vertices.iter().zip(&snapped.vertices) {
        assert!((*before - *after).length() < 0.43e-3);
    }
    let [of_exact, of_snapped] = [&exact, &snapped].map(Scene::new);
    let bytes = of_snapped.bytes() as f64 / snapped.triangles.len() as f64;
    assert!(bytes < 45.0, "{bytes}");
    let mut rng = ChaCha8Rng::seed_from_u64(19);
    for _ in 0..500 {
        let direction = direction(&mut rng);
        let [a, b] = [&of_exact, &of_snapped].map(|scene| cast_one(scene, Vec3::ONE, direction));
        assert!((a.range_m - b.range_m).abs() < 0.5e-3, "{a:?} {b:?}");
    }
    let mut again = snapped.clone();
    again.snap();
    assert_eq!(again, snapped);
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

/// A closed ball of triangles around the origin.
fn ball(radius_m: f32, rows: u32, columns: u32) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for row in 0..=rows {
        for column in 0..columns {
            let up = std::f32::consts::PI * (row as f32 / rows as f32 - 0.5);
            let around = std::f32::consts::TAU * column as f32 / columns as f32;
            let (ring, height) = match row {
                0 => (0.0, -1.0),
                last if last == rows => (0.0, 1.0),
                _ => (up.cos(), up.sin()),
            };
            let place = Vec3::new(ring * around.cos(), ring * around.sin(), height);
            mesh.vertices.push(radius_m * place);
        }
    }
    for row in 0..rows {
        for column in 0..columns {
            let next = (column + 1) % columns;
            let [a, b] = [row * columns + column, row * columns + next];
            let [c, d] = [b + columns, a + columns];
            mesh.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    mesh
}

#[test]
fn a_ball_is_round_to_its_sagitta() {
    let (radius_m, rows, columns) = (3.0, 60, 120);
    let scene = Scene::new(&ball(radius_m, rows, columns));
    // Half the diagonal of a quad, seen from the middle.
    let half = 0.5 * std::f32::consts::PI / rows as f32 * std::f32::consts::SQRT_2;
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    for _ in 0..500 {
        let range_m = cast_one(&scene, Vec3::ZERO, direction(&mut rng)).range_m;
        assert!(range_m <= radius_m * (1.0 + 1e-6));
        assert!(range_m >= radius_m * half.cos() - 1e-6, "{range_m}");
    }
}

#[test]
fn no_ray_leaves_a_closed_surface_along_its_edges_and_corners() {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut snapped = ball(3.0, 100, 200);
    snapped.snap();
    for (mesh, inside_m) in [
        (cube(0.5), 0.2),
        (cube(77.7), 60.0),
        (ball(3.0, 20, 40), 1.0),
        (snapped, 1.0),
    ] {
        let scene = Scene::new(&mesh);
        for _ in 0..20 {
            let origin = inside_m * in_cube(&mut rng) * std::f32::consts::FRAC_1_SQRT_2;
            let mut directions = Vec::new();
            for triangle in 0..mesh.triangles.len() {
                let [a, b, c] = mesh.corners(triangle);
                for (p, q) in [(a, b), (b, c), (c, a)] {
                    for part in [0.0, 0.1, 1.0 / 3.0, 0.5, rng.random_range(0.0..1.0)] {
                        directions.push((p.lerp(q, part) - origin).normalize());
                    }
                }
            }
            let mut hits = vec![Hit::MISS; directions.len()];
            scene.cast(origin, &directions, &mut hits);
            let misses = hits.iter().filter(|&&hit| hit == Hit::MISS).count();
            assert_eq!(misses, 0, "of {} rays at edges", hits.len());
        }
    }
}

#[test]
fn rays_along_the_axes_hit_a_floor_of_squares_also_between_them() {
    let mut mesh = TriangleMesh::default();
    for (x, y) in (-4..4).flat_map(|x| (-4..4).map(move |y| (x as f32, y as f32))) {
        let first = mesh.vertices.len() as u32;
        let corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)];
        mesh.vertices
            .extend(corners.map(|(right, up)| Vec3::new(x + right, y + up, -1.0)));
        mesh.triangles
            .extend([[0, 1, 2], [0, 2, 3]].map(|triangle| triangle.map(|v: u32| v + first)));
    }
    let scene = Scene::new(&mesh);
    for (x, y) in (-3..4).flat_map(|x| (-6..7).map(move |y| (x as f32, 0.5 * y as f32))) {
        for slope in [Vec3::ZERO, Vec3::X, Vec3::NEG_X] {
            let direction = Vec3::NEG_Z + 0.5 * slope;
            let range_m = cast_one(&scene, Vec3::new(x, y, 0.0), direction).range_m;
            assert!(
                (range_m - direction.length()).abs() < 1e-6,
                "{x} {y} {slope}"
            );
        }
    }
}

#[test]
fn a_ray_that_starts_on_a_surface_hits_the_next_one() {
    let mesh = cube(0.5);
    let scene = Scene::new(&mesh);
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    for _ in 0..200 {
        let (y, z) = (rng.random_range(-0.4..0.4), rng.random_range(-0.4..0.4));
        let start = Vec3::new(-0.5, y, z);
        let across = cast_one(&scene, start, Vec3::X);
        assert!((across.range_m - 1.0).abs() < 1e-6, "{across:?}");
        assert_eq!(cast_one(&scene, start, Vec3::NEG_X), Hit::MISS);
    }
}

#[test]
fn degenerate_triangles_are_never_hit() {
    let mut mesh = cube(0.5);
    let proper = mesh.triangles.len() as u32;
    let nan = mesh.vertices.len() as u32;
    let bad = [
        Vec3::NAN,
        Vec3::INFINITY,
        Vec3::new(0.0, 0.0, f32::NEG_INFINITY),
    ];
    mesh.vertices.extend(bad);
    let line = mesh.vertices.len() as u32;
    mesh.vertices.extend([0.1, 0.2, 0.3].map(Vec3::splat));
    for vertex in nan..line {
        mesh.triangles.push([0, 1, vertex]);
    }
    mesh.triangles
        .extend([[0, 0, 1], [2, 2, 2], [line, line + 1, line + 2]]);
    let scene = Scene::new(&mesh);
    for target in [0.1, 0.2, 0.3].map(Vec3::splat) {
        let origin = Vec3::new(0.4, -0.3, 0.2);
        assert!(cast_one(&scene, origin, target - origin).triangle < proper);
    }
    assert_eq!(scene.normal(&Hit::MISS), Ok(None));
    let hit = cast_one(&scene, Vec3::ZERO, Vec3::new(0.1, 0.2, 1.0));
    assert!((scene.normal(&hit).unwrap().unwrap().abs().z - 1.0).abs() < 1e-6);
}

#[test]
fn rays_miss_an_empty_scene() {
    let scenes = [
        Scene::new(&TriangleMesh::default()),
        Scene::of_tiles(&[]),
        Scene::of_tiles(&[TriangleMesh::default(), TriangleMesh::default()]),
    ];
    for scene in scenes {
        assert_eq!(cast_one(&scene, Vec3::ZERO, Vec3::X), Hit::MISS);
        scene.cast(Vec3::ZERO, &[], &mut []);
    }
}

#[test]
fn the_triangles_of_tiles_are_counted_one_after_the_other() {
    let mut small = cube(1.0);
    small.triangles.truncate(2);
    let scene = Scene::of_tiles(&[small, TriangleMesh::default(), cube(2.0)]);
    let below = cast_one(&scene, Vec3::ZERO, Vec3::new(0.1, 0.2, -1.0));
    assert!(below.triangle < 2 && below.range_m < 1.1, "{below:?}");
    let above = cast_one(&scene, Vec3::ZERO, Vec3::new(0.1, 0.2, 1.0));
    assert!((4..6).contains(&above.triangle), "{above:?}");
}

#[test]
fn a_ray_hits_nothing_beyond_its_limit() {
    let scene = Scene::new(&cube(2.0));
    for (max_range_m, is_hit) in [(1.9, false), (2.0, false), (2.1, true)] {
        let mut hits = [Hit::MISS];
        scene.cast_until(Vec3::ZERO, &[Vec3::X], max_range_m, &mut hits);
        assert_eq!(hits[0] != Hit::MISS, is_hit);
    }
}

#[test]
fn if_any_near_surface_is_enough_one_is_found() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let scene = Scene::new(&soup(500, 2.0, &mut rng));
    let directions: Vec<Vec3> = (0..800).map(|_| direction(&mut rng)).collect();
    let mut nearest = vec![Hit::MISS; directions.len()];
    scene.cast(Vec3::ZERO, &directions, &mut nearest);
    let reach = Reach {
        until_m: f32::INFINITY,
        enough_m: 6.0,
        is_window: false,
    };
    let mut hits = nearest.clone();
    let reaches = vec![reach; directions.len()];
    let Ok(()) = scene.cast_packets(Vec3::ZERO.as_dvec3(), &directions, &reaches, &mut hits);
    for (hit, nearest) in hits.iter().zip(&nearest) {
        if nearest.range_m < reach.enough_m {
            assert!((nearest.range_m..reach.enough_m).contains(&hit.range_m));
        } else {
            assert_eq!(hit, nearest);
        }
    }
    assert_ne!(hits, nearest);
}

/// Instruction sets of this CPU.
enum InstructionSet {
    Baseline,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    Best,
}

impl InstructionSet {
    fn run<T: SimdTask>(&self, task: T) -> T::Output {
        match self {
            Self::Baseline => task.run(Baseline),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => match Avx2::detect() {
                Some(avx2) => avx2.run(task),
                None => dispatch(task),
            },
            Self::Best => dispatch(task),
        }
    }
}

/// Expects results that are the same with every instruction set.
fn expect_the_same<R: PartialEq>(mut cast: impl FnMut(InstructionSet) -> R) {
    let portable = cast(InstructionSet::Baseline);
    #[cfg(target_arch = "x86_64")]
    assert!(cast(InstructionSet::Avx2) == portable);
    assert!(cast(InstructionSet::Best) == portable);
}

#[test]
fn every_instruction_set_gives_the_same_bits() {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let scene: Scene = Scene::of_tiles(&[soup(3000, 0.7, &mut rng), soup(300, 2.0, &mut rng)]);
    for _ in 0..20 {
        let origin = 10.0 * in_cube(&mut rng).as_dvec3();
        let directions: Vec<Vec3> = (0..333).map(|_| direction(&mut rng)).collect();
        let reach = vec![Reach::UNLIMITED; directions.len()];
        let mut hits = vec![Hit::MISS; directions.len()];
        expect_the_same(|set| {
            let Ok(()) = set.run(scene.task(origin, &directions, &reach, &mut hits));
            let bits = hits.iter().map(|hit| (hit.range_m.to_bits(), hit.triangle));
            bits.collect::<Vec<_>>()
        });
    }
}

#[test]
fn the_hit_of_a_ray_does_not_depend_on_its_neighbours() {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let scene = Scene::new(&soup(2000, 1.0, &mut rng));
    let directions: Vec<Vec3> = (0..400).map(|_| direction(&mut rng)).collect();
    let mut hits = vec![Hit::MISS; directions.len()];
    scene.cast(Vec3::ONE, &directions, &mut hits);
    for (&direction, &hit) in directions.iter().zip(&hits) {
        let mut alone = [Hit::MISS];
        scene.cast(Vec3::ONE, &[direction], &mut alone);
        assert_eq!(alone[0], hit);
    }
}

#[test]
fn coinciding_or_converging_centroids_do_not_exceed_the_depth_limit() {
    let mut mesh = TriangleMesh::default();
    for number in 0..300 {
        let scale = if number < 150 {
            1.0
        } else {
            0.5_f32.powi(number - 150)
        };
        let first = mesh.vertices.len() as u32;
        let corners = [Vec3::X, Vec3::Y, Vec3::Z];
        mesh.vertices.extend(corners.map(|corner| scale * corner));
        mesh.triangles.push([first, first + 1, first + 2]);
    }
    let scene = Scene::new(&mesh);
    let hit = cast_one(&scene, Vec3::ONE, -Vec3::ONE);
    assert!((hit.range_m - 2.0 / 3.0_f32.sqrt()).abs() < 1e-6);
}

/// Ranges of single rays from one origin.
fn cast_single(scene: &Scene, origin: Vec3, directions: &[Vec3], reach: Reach) -> Vec<f32> {
    let mut hits = vec![Hit::MISS; directions.len()];
    let reaches = vec![reach; directions.len()];
    let Ok(()) = scene.cast_single(origin.as_dvec3(), directions, &reaches, &mut hits);
    hits.iter().map(|hit| hit.range_m).collect()
}

#[test]
fn a_single_ray_hits_what_it_hits_in_a_packet() {
    let mut rng = ChaCha8Rng::seed_from_u64(12);
    let scene: Scene = Scene::of_tiles(&[soup(3000, 0.7, &mut rng), soup(300, 2.0, &mut rng)]);
    let mut hit_count = 0;
    for until_m in [f32::INFINITY, 8.0] {
        for _ in 0..10 {
            let origin = 10.0 * in_cube(&mut rng);
            let directions: Vec<Vec3> = (0..300)
                .map(|_| direction(&mut rng))
                .chain(Vec3::AXES)
                .collect();
            let mut hits = vec![Hit::MISS; directions.len()];
            scene.cast_until(origin, &directions, until_m, &mut hits);
            let ranges_m = cast_single(&scene, origin, &directions, Reach::until(until_m));
            for (range_m, hit) in ranges_m.iter().zip(&hits) {
                assert_eq!(range_m.to_bits(), hit.range_m.to_bits());
                hit_count += usize::from(*hit != Hit::MISS);
            }
        }
    }
    assert!(hit_count > 1000, "{hit_count}");
}

#[test]
fn single_rays_hit_random_triangles_as_by_testing_all_of_them() {
    let mut rng = ChaCha8Rng::seed_from_u64(13);
    for (triangles, size_m) in [(0, 1.0), (1, 9.0), (30, 4.0), (500, 2.0)] {
        let mesh = soup(triangles, size_m, &mut rng);
        let scene = Scene::new(&mesh);
        let origin = 3.0 * in_cube(&mut rng);
        let directions: Vec<Vec3> = (0..400).map(|_| direction(&mut rng)).collect();
        let ranges_m = cast_single(&scene, origin, &directions, Reach::UNLIMITED);
        for (&direction, range_m) in directions.iter().zip(ranges_m) {
            let nearest = (0..triangles)
                .map(|t| range_by_hand(origin, direction, mesh.corners(t)))
                .fold(f64::INFINITY, f64::min);
            let range_m = f64::from(range_m);
            assert!(
                range_m == nearest || (range_m - nearest).abs() < 1e-4,
                "{range_m} {nearest}"
            );
        }
    }
}

#[test]
fn no_single_ray_passes_through_an_edge_or_a_corner() {
    let scene = Scene::new(&cube(2.0));
    // Towards corners, edges and diagonals of the walls, where two or more triangles meet.
    let steps = [-1.0, -0.5, 0.0, 0.5, 1.0];
    let mut directions = Vec::new();
    for x in steps {
        for y in steps {
            for wall in [-1.0, 1.0] {
                let at = Vec3::new(x, y, wall).normalize();
                directions.extend([at, Vec3::new(at.y, at.z, at.x), Vec3::new(at.z, at.x, at.y)]);
            }
        }
    }
    let ranges_m = cast_single(&scene, Vec3::ZERO, &directions, Reach::UNLIMITED);
    for (direction, range_m) in directions.iter().zip(ranges_m) {
        let expected = 2.0 / direction.abs().max_element();
        assert!((range_m - expected).abs() < 1e-5, "{direction} {range_m}");
    }
}

#[test]
fn in_a_window_only_surfaces_inside_it_must_be_reported() {
    let mut rng = ChaCha8Rng::seed_from_u64(14);
    let scene = Scene::new(&soup(500, 2.0, &mut rng));
    let directions: Vec<Vec3> = (0..2000).map(|_| direction(&mut rng)).collect();
    let nearest = cast_single(&scene, Vec3::ZERO, &directions, Reach::UNLIMITED);
    let window = Reach {
        until_m: 6.0,
        enough_m: 4.0,
        is_window: true,
    };
    let in_window = cast_single(&scene, Vec3::ZERO, &directions, window);
    let (mut hidden, mut left_out) = (0, 0);
    for (nearest, range_m) in nearest.into_iter().zip(in_window) {
        if nearest < window.enough_m {
            hidden += usize::from(range_m < window.enough_m);
            left_out += usize::from(range_m == f32::INFINITY);
            assert!(range_m < window.enough_m || range_m == f32::INFINITY);
        } else if nearest < window.until_m {
            assert_eq!(range_m, nearest);
        } else {
            assert_eq!(range_m, f32::INFINITY);
        }
    }
    assert!(hidden > 50 && left_out > 50, "{hidden} {left_out}");
}

#[test]
fn every_instruction_set_gives_single_rays_the_same_bits() {
    let mut rng = ChaCha8Rng::seed_from_u64(15);
    let scene: Scene = Scene::of_tiles(&[soup(3000, 0.7, &mut rng), soup(300, 2.0, &mut rng)]);
    for is_window in [false, true] {
        let reach = Reach {
            until_m: 12.0,
            enough_m: 3.0,
            is_window,
        };
        let origin = in_cube(&mut rng);
        let directions: Vec<Vec3> = (0..2000).map(|_| direction(&mut rng)).collect();
        let reaches = vec![reach; directions.len()];
        let mut hits = vec![Hit::MISS; directions.len()];
        expect_the_same(|set| {
            let origin = Single(origin.as_dvec3());
            let Ok(()) = set.run(scene.task(origin, &directions, &reaches, &mut hits));
            hits.clone()
        });
    }
}

/// Origins within `spread_m` of one, and bundles of rays from them within `turn` of random
/// directions.
fn bundles(
    middle: Vec3,
    spread_m: f32,
    turn: f32,
    rng: &mut ChaCha8Rng,
) -> ([Vec3; RAYS], Vec<[Vec3; RAYS]>) {
    let origins = [0; RAYS].map(|_| middle + spread_m * in_cube(rng));
    let middles: Vec<Vec3> = (0..200).map(|_| direction(rng)).collect();
    let directions = middles
        .into_iter()
        .chain(Vec3::AXES)
        .map(|middle| [0; RAYS].map(|_| (middle + turn * in_cube(rng)).normalize()))
        .collect();
    (origins, directions)
}

#[test]
fn a_ray_in_a_bundle_hits_what_it_hits_as_single_ray() {
    let mut rng = ChaCha8Rng::seed_from_u64(16);
    let scene: Scene = Scene::of_tiles(&[soup(3000, 0.7, &mut rng), soup(300, 2.0, &mut rng)]);
    let mut hit_count = 0;
    for (until_m, spread_m, turn) in [(f32::INFINITY, 0.1, 0.01), (8.0, 5.0, 1.5), (8.0, 0.0, 0.0)]
    {
        for _ in 0..10 {
            let middle = 10.0 * in_cube(&mut rng);
            let (origins, directions) = bundles(middle, spread_m, turn, &mut rng);
            let reach = Reach::until(until_m);
            let mut ranges_m = vec![[0.0; RAYS]; directions.len()];
            let Ok(()) = scene.cast_bundles(
                &origins.map(|origin| origin.as_dvec3()),
                &directions,
                &vec![reach; directions.len()],
                &mut ranges_m,
            );
            for (ray, &origin) in origins.iter().enumerate() {
                let of_one: Vec<Vec3> = directions.iter().map(|bundle| bundle[ray]).collect();
                let single = cast_single(&scene, origin, &of_one, reach);
                for (bundle, single) in ranges_m.iter().zip(single) {
                    assert_eq!(bundle[ray].to_bits(), single.to_bits());
                    hit_count += usize::from(single.is_finite());
                }
            }
        }
    }
    assert!(hit_count > 1000, "{hit_count}");
}

#[test]
fn no_ray_of_a_bundle_passes_through_an_edge_or_a_corner() {
    let scene = Scene::new(&cube(2.0));
    let corners: Vec<Vec3> = cube(2.0).vertices;
    let origins: [Vec3; RAYS] = std::array::from_fn(|ray| {
        let x = 0.05 * (ray as f32 - 8.0);
        Vec3::new(x, -x, 0.5 * x)
    });
    // From every origin exactly towards the same place on an edge or a diagonal.
    let ends: Vec<Vec3> = corners
        .iter()
        .flat_map(|&a| corners.iter().map(move |&b| a.lerp(b, 0.3)))
        .filter(|end| end.abs().max_element() > 1.99)
        .collect();
    let directions: Vec<[Vec3; RAYS]> = ends
        .iter()
        .map(|&end| origins.map(|origin| (end - origin).normalize()))
        .collect();
    let mut ranges_m = vec![[0.0; RAYS]; directions.len()];
    let reach = vec![Reach::UNLIMITED; directions.len()];
    let from = origins.map(|origin| origin.as_dvec3());
    let Ok(()) = scene.cast_bundles(&from, &directions, &reach, &mut ranges_m);
    for (end, ranges_m) in ends.iter().zip(ranges_m) {
        for (origin, range_m) in origins.iter().zip(ranges_m) {
            assert!((range_m - end.distance(*origin)).abs() < 1e-5, "{range_m}");
        }
    }
    assert!(ends.len() > 30);
}

#[test]
fn if_any_near_surface_is_enough_a_bundle_finds_one() {
    let mut rng = ChaCha8Rng::seed_from_u64(17);
    let scene = Scene::new(&soup(500, 2.0, &mut rng));
    let (origins, directions) = bundles(Vec3::ZERO, 0.2, 0.02, &mut rng);
    let from = origins.map(|origin| origin.as_dvec3());
    let [nearest, enough] = [0.0, 5.0].map(|enough_m| {
        let reach = Reach {
            until_m: 8.0,
            enough_m,
            is_window: false,
        };
        let mut ranges_m = vec![[0.0; RAYS]; directions.len()];
        let reaches = vec![reach; directions.len()];
        let Ok(()) = scene.cast_bundles(&from, &directions, &reaches, &mut ranges_m);
        ranges_m.concat()
    });
    let mut near = 0;
    for (nearest, enough) in nearest.into_iter().zip(enough) {
        if nearest < 5.0 {
            near += 1;
            assert!((nearest..5.0).contains(&enough), "{nearest} {enough}");
        } else {
            assert_eq!(nearest, enough);
        }
    }
    assert!(near > 50, "{near}");
}

#[test]
fn every_instruction_set_gives_bundles_the_same_bits() {
    let mut rng = ChaCha8Rng::seed_from_u64(18);
    let scene: Scene = Scene::of_tiles(&[soup(3000, 0.7, &mut rng), soup(300, 2.0, &mut rng)]);
    for (spread_m, turn) in [(0.1, 0.01), (4.0, 1.0)] {
        let (origins, directions) = bundles(in_cube(&mut rng), spread_m, turn, &mut rng);
        let from = origins.map(|origin| origin.as_dvec3());
        let reach = vec![Reach::until(12.0); directions.len()];
        let mut ranges_m = vec![[0.0; RAYS]; directions.len()];
        expect_the_same(|set| {
            let Ok(()) = set.run(scene.task(from, &directions, &reach, &mut ranges_m));
            ranges_m.clone()
        });
    }
}
