use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::rendering::order::place_and_heading_m;

/// A wavy ground of 40 m in two tiles, the border in the middle.
fn hills(middle: Vec3) -> Vec<TriangleMesh> {
    const STEPS: u32 = 80;
    let mut mesh = TriangleMesh::default();
    for row in 0..=STEPS {
        for column in 0..=STEPS {
            let (x, y) = (0.5 * column as f32 - 20.0, 0.5 * row as f32 - 20.0);
            mesh.vertices
                .push(middle + Vec3::new(x, y, 0.5 * (0.7 * x).sin() * (0.5 * y).cos()));
        }
    }
    for row in 0..STEPS {
        for column in 0..STEPS {
            let a = row * (STEPS + 1) + column;
            let [b, c, d] = [a + 1, a + STEPS + 2, a + STEPS + 1];
            mesh.triangles.extend([[a, b, c], [a, c, d]]);
        }
    }
    let is_left = |triangle: usize| mesh.corners(triangle)[0].x < middle.x;
    let [mut left, mut right] = [mesh.clone(), mesh.clone()];
    left.retain_triangles(|index, _| is_left(index));
    right.retain_triangles(|index, _| !is_left(index));
    vec![left, TriangleMesh::default(), right]
}

fn poses(count: usize) -> Vec<Pose3> {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    (0..count)
        .map(|_| {
            let at = [0, 1].map(|_| rng.random_range(-15.0..15.0));
            let turn = [0.1, 0.1, 3.0].map(|most: f64| rng.random_range(-most..most));
            Pose3::new(Vector3::new(at[0], at[1], 2.5), Vector3::from(turn))
        })
        .collect()
}

fn beams(count: usize) -> Vec<Beam> {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    (0..count)
        .map(|_| Beam {
            direction: Vec3::new(
                rng.random_range(-1.0..1.0),
                rng.random_range(-1.0..1.0),
                rng.random_range(-0.4..0.05),
            )
            .normalize(),
            range_m: rng.random_range(2.0..20.0),
        })
        .collect()
}

fn on_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
    pool.build().unwrap().install(work)
}

#[test]
fn tiles_look_like_the_whole() {
    let tiles = hills(Vec3::ZERO);
    let mut whole = tiles[0].clone();
    whole.append(&tiles[2]);
    let model = LidarModel::default();
    let tiled = CpuRenderer::new(&tiles).render(&poses(3), &model).unwrap();
    let whole = CpuRenderer::new(&[whole])
        .render(&poses(3), &model)
        .unwrap();
    for (a, b) in tiled.iter().flatten().zip(whole.iter().flatten()) {
        assert!(a == b || (a - b).abs() < 1e-4, "{a} {b}");
    }
    assert!(tiled[0].iter().filter(|range| range.is_finite()).count() > 10_000);
}

#[test]
fn five_kilometres_from_the_origin_nothing_looks_different() {
    let far = Vec3::new(4096.0, -3072.0, 128.0);
    let there = |pose: &Pose3| Translation3::new(4096.0, -3072.0, 128.0) * pose;
    let model = LidarModel::default();
    let near = CpuRenderer::new(&hills(Vec3::ZERO))
        .render(&poses(2), &model)
        .unwrap();
    let moved: Vec<Pose3> = poses(2).iter().map(there).collect();
    let moved = CpuRenderer::new(&hills(far))
        .render(&moved, &model)
        .unwrap();
    // The vertices themselves move by up to a quarter of a millimetre, which a flat view magnifies.
    let mut differences: Vec<f32> = std::iter::zip(near.iter().flatten(), moved.iter().flatten())
        .filter(|(a, b)| a.is_finite() && b.is_finite())
        .map(|(a, b)| (a - b).abs())
        .collect();
    differences.sort_by(f32::total_cmp);
    assert!(differences[differences.len() / 2] < 1e-3);
    assert!(differences[differences.len() * 99 / 100] < 2e-2);
}

#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    let renderer = CpuRenderer::new(&hills(Vec3::ZERO));
    let work = || {
        let difference = RangeDifference::truncated(0.5);
        let model = LidarModel::default();
        let images = renderer.render(&poses(2), &model).unwrap();
        let costs = renderer
            .compare(&poses(50), &beams(3600), &difference)
            .unwrap();
        let dense = renderer.compare(&poses(2), &beams(20_000), &difference);
        (images, costs, dense.unwrap())
    };
    assert_eq!(on_threads(1, work), on_threads(3, work));
}

#[test]
fn batches_of_poses_do_not_change_the_ranges() {
    let mut renderer = CpuRenderer::new(&hills(Vec3::ZERO));
    let (poses, model) = (poses(8), LidarModel::default());
    let whole = renderer.render(&poses, &model).unwrap();
    renderer.max_poses = 3;
    assert_eq!(renderer.render(&poses, &model).unwrap(), whole);
}

#[test]
fn comparing_is_casting_and_counting_the_cost() {
    let renderer = CpuRenderer::new(&hills(Vec3::ZERO));
    let (poses, beams) = (poses(20), beams(1000));
    let directions: Vec<Vec3> = beams.iter().map(|beam| beam.direction).collect();
    let rows = renderer.cast(&poses, &directions, f32::INFINITY).unwrap();
    let differences = [
        RangeDifference::UNLIMITED,
        RangeDifference::truncated(0.5),
        RangeDifference {
            short_m: 0.5,
            long_m: 1.0,
            no_surface_m: 0.7,
        },
    ];
    for difference in differences {
        let means = renderer.compare(&poses, &beams, &difference).unwrap();
        for (row, mean) in rows.iter().zip(means) {
            let costs = row.iter().zip(&beams);
            let sum: f64 = costs
                .map(|(&range_m, beam)| f64::from(difference.cost(beam.range_m, range_m)))
                .sum();
            let expected = sum / beams.len() as f64;
            assert!(
                (f64::from(mean) - expected).abs() < 1e-6 * expected,
                "{mean} {expected}"
            );
        }
    }
}

#[test]
fn a_cast_along_the_pixels_is_the_image() {
    let renderer = CpuRenderer::new(&hills(Vec3::ZERO));
    let model = LidarModel {
        min_range: 0.0,
        max_range: f32::INFINITY,
        ..LidarModel::default()
    };
    let image = renderer.render(&poses(2), &model).unwrap();
    assert_eq!(
        image,
        renderer
            .cast(&poses(2), &model.directions(), f32::INFINITY)
            .unwrap()
    );
}

/// Beams along directions, five metres long.
fn beams_along(directions: &[Vec3]) -> Vec<Beam> {
    let beam = |&direction| Beam {
        direction,
        range_m: 5.0,
    };
    directions.iter().map(beam).collect()
}

#[test]
fn only_surfaces_near_the_ends_of_beams_are_found() {
    let renderer = CpuRenderer::new(&[TriangleMesh::wall(5.0), TriangleMesh::wall(8.0)]);
    let found = |range_m: f32, within_m: f32| {
        let beam = Beam {
            direction: Vec3::X,
            range_m,
        };
        let surfaces = renderer.surfaces(&Pose3::identity(), &[beam], within_m);
        surfaces.unwrap()[0].map(|hit| hit.range_m)
    };
    assert_eq!(found(4.0, 1.5), Some(5.0));
    assert_eq!(found(6.0, 1.5), Some(5.0));
    assert_eq!(found(3.0, 1.5), None);
    // The far wall is hidden by the near one.
    assert_eq!(found(8.0, 1.5), None);
    assert_eq!(found(8.0, 4.0), Some(5.0));
}

#[test]
fn a_wall_is_seen_with_its_range_and_its_normal_towards_the_sensor() {
    let renderer = CpuRenderer::new(&[TriangleMesh::wall(5.0)]);
    let quarter = UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::FRAC_PI_2);
    let pose = Isometry3::from_parts(Translation3::new(1.0, 0.5, 0.0), quarter);
    // Ahead of the turned sensor is +y of the map, so +x is on its right.
    let surfaces = renderer
        .surfaces(&pose, &beams_along(&[Vec3::NEG_Y, Vec3::Y]), f32::INFINITY)
        .unwrap();
    let hit = surfaces[0].unwrap();
    assert!((hit.range_m - 4.0).abs() < 1e-6);
    assert!((hit.normal_in_map - Vec3::NEG_X).length() < 1e-6);
    assert_eq!(surfaces[1], None);
}

#[test]
fn a_wall_that_is_seen_from_behind_hides_another_and_has_a_negative_range() {
    let wall = |x: f32, faces_ahead: bool| {
        let mut wall = TriangleMesh::wall(x);
        if !faces_ahead {
            wall.triangles.iter_mut().for_each(|it| it.swap(1, 2));
        }
        wall
    };
    let directions = [Vec3::X, Vec3::NEG_X, Vec3::Y];
    let half_a_turn = UnitQuaternion::from_euler_angles(0.0, 0.0, std::f64::consts::PI);
    for (yaw, near_faces_ahead, has_fronts, expected) in [
        (UnitQuaternion::identity(), true, true, [-5.0, 6.0]),
        (UnitQuaternion::identity(), false, true, [5.0, 6.0]),
        (UnitQuaternion::identity(), true, false, [5.0, 6.0]),
        (half_a_turn, true, true, [6.0, -5.0]),
    ] {
        let mut scene = Scene::of_tiles(&[
            wall(5.0, near_faces_ahead),
            wall(8.0, false),
            wall(-6.0, true),
        ]);
        scene.has_fronts = has_fronts;
        let renderer = CpuRenderer::over(Arc::new(scene));
        let pose = Pose3::from_parts(Translation3::identity(), yaw);
        let signed = |until_m| renderer.cast_signed(&pose, &directions, until_m).unwrap();
        let [ahead_m, behind_m] = expected;
        assert_eq!(signed(50.0), [ahead_m, behind_m, f32::INFINITY]);
        assert_eq!(signed(4.0), [f32::INFINITY; 3]);
        let ranges = renderer.cast(&[pose], &directions, 50.0).unwrap();
        assert_eq!(
            ranges,
            [signed(50.0).into_iter().map(f32::abs).collect::<Vec<_>>()]
        );
    }
}

#[test]
fn normals_from_three_rays_are_those_of_the_triangles() {
    /// Casts as another renderer does, and knows nothing of triangles.
    struct WithoutTriangles(CpuRenderer);
    impl RangeRenderer for WithoutTriangles {
        fn name(&self) -> String {
            self.0.name()
        }
        fn render(
            &self,
            poses: &[Pose3],
            model: &LidarModel,
        ) -> Result<Vec<Vec<f32>>, RenderError> {
            self.0.render(poses, model)
        }
        fn cast(
            &self,
            poses: &[Pose3],
            directions: &[Vec3],
            until_m: f32,
        ) -> Result<Vec<Vec<f32>>, RenderError> {
            self.0.cast(poses, directions, until_m)
        }
        fn compare(
            &self,
            poses: &[Pose3],
            beams: &[Beam],
            difference: &RangeDifference,
        ) -> Result<Vec<f32>, RenderError> {
            self.0.compare(poses, beams, difference)
        }
        fn compare_images(
            &self,
            poses: &[Pose3],
            measured: &RangeImage,
            difference: &RangeDifference,
        ) -> Result<Vec<f32>, RenderError> {
            self.0.compare_images(poses, measured, difference)
        }
    }
    let renderer = CpuRenderer::new(&[TriangleMesh::wall(5.0)]);
    let turned = UnitQuaternion::from_euler_angles(0.1, -0.2, 0.3);
    let pose = Isometry3::from_parts(Translation3::new(1.0, 0.5, 0.0), turned);
    let directions = [Vec3::X, Vec3::new(0.8, 0.6, 0.0), Vec3::NEG_X, Vec3::Y];
    let beams = beams_along(&directions);
    let exact = renderer.surfaces(&pose, &beams, f32::INFINITY).unwrap();
    let rough = WithoutTriangles(renderer)
        .surfaces(&pose, &beams, f32::INFINITY)
        .unwrap();
    assert_eq!(exact.iter().flatten().count(), 2);
    for (exact, rough) in exact.iter().zip(&rough) {
        assert_eq!(exact.is_some(), rough.is_some());
        if let (Some(exact), Some(rough)) = (exact, rough) {
            assert!((exact.range_m - rough.range_m).abs() < 1e-5);
            assert!((exact.normal_in_map - rough.normal_in_map).length() < 2e-3);
        }
    }
}

#[test]
fn out_of_the_map_there_is_nothing() {
    let renderer = CpuRenderer::new(&hills(Vec3::ZERO));
    let model = LidarModel::default();
    let far = Pose3::translation(1e5, 0.0, 0.0);
    let empty = CpuRenderer::new(&[]);
    for images in [
        renderer.render(&[far], &model),
        empty.render(&[far], &model),
    ] {
        assert!(
            images.unwrap()[0]
                .iter()
                .all(|&range| range == f32::INFINITY)
        );
    }
    let costs = empty.compare(&[far], &beams(7), &RangeDifference::truncated(0.5));
    assert_eq!(costs.unwrap(), [0.5]);
    assert!(renderer.cast(&[far], &[], f32::INFINITY).unwrap()[0].is_empty());
    assert_eq!(
        renderer
            .compare(&[far], &[], &RangeDifference::UNLIMITED)
            .unwrap(),
        [0.0]
    );
}

#[test]
fn the_costs_of_a_pose_have_the_same_bits_alone_and_among_others() {
    let renderer = CpuRenderer::new(&hills(Vec3::ZERO));
    let difference = RangeDifference::truncated(0.5);
    for (count, beams) in [(100, beams(600)), (3, beams(20_000))] {
        let poses = poses(count);
        let together = renderer.compare(&poses, &beams, &difference).unwrap();
        for (pose, cost) in poses.iter().zip(together) {
            let alone = renderer.compare(&[*pose], &beams, &difference).unwrap();
            assert_eq!(alone, [cost]);
        }
    }
}

#[test]
fn the_pose_order_is_a_permutation_with_near_neighbours() {
    let poses = poses(1000);
    let order = pose_order(&poses);
    let place = |pose: u32| place_and_heading_m(&poses[pose as usize]);
    let mean_step_m = |order: &[u32]| {
        let steps = order.windows(2).map(|p| (place(p[0]) - place(p[1])).norm());
        steps.sum::<f64>() / order.len() as f64
    };
    let mut sorted = order.clone();
    sorted.sort_unstable();
    assert!(sorted.iter().copied().eq(0..1000));
    assert!(mean_step_m(&order) < 0.3 * mean_step_m(&sorted));
    assert_eq!(pose_order(&[]), Vec::<u32>::new());
}

/// Poses within centimetres of one.
fn close_poses(count: usize) -> Vec<Pose3> {
    let near = |number: usize, step: f64| 0.05 * ((number as f64 * step).fract() - 0.5);
    (0..count)
        .map(|number| {
            let [x, y, turn] = [0.755, 0.570, 0.618].map(|step| near(number, step));
            Pose3::new(
                Vector3::new(3.0 + x, y, 2.5),
                Vector3::new(0.0, 0.0, 0.1 * turn),
            )
        })
        .collect()
}

#[test]
fn rays_that_are_close_to_each_other_are_grouped() {
    let grouping = |poses: &[Pose3], count: usize| {
        let directions: Vec<Vec3> = beams(count).iter().map(|beam| beam.direction).collect();
        let beams = CastBeams {
            order: coherent_order(&directions),
            reaches: vec![Reach::UNLIMITED; count],
            directions,
        };
        Grouping::of(poses, &beams)
    };
    assert_eq!(grouping(&poses(100), 500), Grouping::Single);
    assert_eq!(grouping(&poses(100), 100_000), Grouping::Packets);
    assert_eq!(grouping(&close_poses(100), 500), Grouping::Bundles);
    assert_eq!(grouping(&close_poses(1), 500), Grouping::Single);
}

#[test]
fn neighbouring_poses_do_not_change_the_cost_of_a_pose() {
    let renderer = CpuRenderer::new(&hills(Vec3::ZERO));
    let difference = RangeDifference::truncated(0.5);
    let beams = beams(600);
    // A number that leaves the last bundle half empty.
    let poses = close_poses(21);
    let together = renderer.compare(&poses, &beams, &difference).unwrap();
    let mut other = 0;
    for (pose, cost) in poses.iter().zip(together) {
        let alone = renderer.compare(&[*pose], &beams, &difference).unwrap()[0];
        assert!((alone - cost).abs() < 1e-5, "{alone} {cost}");
        other += usize::from(alone != cost);
    }
    // Only where a ray passes an edge within rounding.
    assert!(other <= 2, "{other}");
}

#[test]
fn looking_at_the_end_of_a_beam_first_changes_no_cost() {
    let renderer = CpuRenderer::new(&hills(Vec3::new(0.0, 0.0, 1.7)));
    // As one of the poses sees the hills, some a little off and some far, above the ground.
    let directions: Vec<Vec3> = beams(2000).iter().map(|beam| beam.direction).collect();
    let seen = renderer
        .cast(&poses(1), &directions, f32::INFINITY)
        .unwrap()
        .concat();
    let beams: Vec<Beam> = std::iter::zip(directions, seen)
        .zip([0.0, 0.2, -0.2, 0.6, -0.6, 3.0].into_iter().cycle())
        .map(|((direction, range_m), off_m)| Beam {
            direction,
            range_m: range_m + off_m,
        })
        .filter(|beam| beam.range_m.is_finite() && beam.range_m > 1.0)
        .filter(|beam| beam.direction.z * beam.range_m > HIGHEST_GROUND_M)
        .collect();
    let together = RangeDifference::truncated(0.5);
    // Hardly another cost, but no window.
    let apart = RangeDifference {
        long_m: 0.500_000_1,
        ..together
    };
    assert!(beams.iter().all(|b| deciding_reach(b, &together).is_window));
    assert!(beams.iter().all(|b| !deciding_reach(b, &apart).is_window));
    let in_window = renderer.compare(&poses(20), &beams, &together).unwrap();
    let whole = renderer.compare(&poses(20), &beams, &apart).unwrap();
    for (a, b) in in_window.iter().zip(whole) {
        assert!((a - b).abs() < 1e-6, "{a} {b}");
    }
    assert!(beams.len() > 200 && in_window[0] < 0.3, "{}", in_window[0]);
}
