//! What the graphics device renders is what a plain ray caster in `f64` finds.
//!
//! Runs on any adapter, be it a software one. Without any the tests say that they did not run,
//! unless `FPMCL_REQUIRE_GPU=1`.
#![cfg(feature = "gpu")]

mod brute_force;
#[expect(clippy::unwrap_used, reason = "a failing test may panic")]
mod common;

use std::path::{Path, PathBuf};

use fpmcl::geometry::{Pose3, TriangleMesh, Vec3};
use fpmcl::lidar::{Beam, LidarModel, RangeImage};
use fpmcl::rendering::cpu::CpuRenderer;
use fpmcl::rendering::gpu::{GpuRenderer, ImageMethod};
use fpmcl::rendering::{Backend, RangeDifference, RangeRenderer, RenderError};

use brute_force::{BruteForce, room, street};

const METHODS: [ImageMethod; 2] = [ImageMethod::Cast, ImageMethod::Draw];

/// A renderer on any adapter; `None`, and said so, where there is none.
#[expect(
    clippy::print_stderr,
    reason = "a test that did not run must not look like one that did"
)]
fn renderer(tiles: &[TriangleMesh]) -> Option<GpuRenderer> {
    match GpuRenderer::new(tiles, Backend::Gpu) {
        Ok(renderer) => Some(renderer),
        Err(RenderError::NoAdapter) => {
            let required = std::env::var_os("FPMCL_REQUIRE_GPU").is_some_and(|value| value == "1");
            assert!(
                !required,
                "FPMCL_REQUIRE_GPU=1, and there is no graphics adapter"
            );
            eprintln!("not run: there is no graphics adapter");
            None
        }
        Err(error) => panic!("{error}"),
    }
}

fn small_model() -> LidarModel {
    LidarModel {
        height: 24,
        width: 180,
        ..LidarModel::default()
    }
}

fn pose(x: f64, y: f64, z: f64, angles: [f64; 3]) -> Pose3 {
    let [roll, pitch, yaw] = angles;
    let rotation = nalgebra::UnitQuaternion::from_euler_angles(roll, pitch, yaw);
    Pose3::from_parts(nalgebra::Translation3::new(x, y, z), rotation)
}

/// Poses along the street, one of them tilted.
fn street_poses() -> Vec<Pose3> {
    vec![
        pose(-20.3, 0.4, 1.73, [0.0, 0.0, 0.0]),
        pose(3.1, -1.2, 1.76, [0.02, -0.03, 1.1]),
        pose(17.7, 1.9, 1.70, [0.0, 0.01, -3.0]),
    ]
}

/// Checks ranges against the plain ones: within 1 mm on 99.9 % of the rays, and wherever not,
/// a ray turned by 0.02 mrad does find what the device found: it passes along an edge.
fn assert_same(truth: &BruteForce, pose: &Pose3, directions: &[Vec3], ranges: &[f32], what: &str) {
    assert_eq!(directions.len(), ranges.len());
    let mut differ = 0;
    for (&direction, &range_m) in directions.iter().zip(ranges) {
        let expected = truth.range(pose, direction);
        if same(expected, range_m) {
            continue;
        }
        differ += 1;
        let turned = sideways(truth, pose, direction);
        assert!(
            turned.iter().any(|&near| same(near, range_m)),
            "{what}: {range_m} m instead of {expected} m along {direction}, no edge"
        );
    }
    assert!(
        differ * 1000 <= ranges.len(),
        "{what}: {differ} of {}",
        ranges.len()
    );
}

/// Ranges along six directions a hair (0.02 mrad) beside one.
fn sideways(truth: &BruteForce, pose: &Pose3, direction: Vec3) -> [f64; 6] {
    [Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z]
        .map(|aside| truth.range(pose, (direction + 2e-5 * aside).normalize()))
}

fn same(expected: f64, range_m: f32) -> bool {
    expected == f64::from(range_m) || (expected - f64::from(range_m)).abs() < 1e-3
}

#[test]
fn both_ways_show_the_street_as_a_plain_ray_caster_does() {
    let tiles = street();
    let Some(renderer) = renderer(&tiles) else {
        return;
    };
    let model = small_model();
    let poses = street_poses();
    let truth = BruteForce::new(&tiles).between(model.min_range, model.max_range);
    for method in METHODS {
        let images = renderer.render_by(method, &poses, &model).unwrap();
        for (pose, image) in poses.iter().zip(&images) {
            assert_same(
                &truth,
                pose,
                &model.directions(),
                image,
                &format!("{method:?}"),
            );
            assert!(image.iter().filter(|r| r.is_finite()).count() > image.len() / 2);
        }
    }
}

#[test]
fn rendering_is_casting_along_the_centre_rays() {
    let Some(renderer) = renderer(&street()) else {
        return;
    };
    let model = LidarModel {
        min_range: 0.0,
        max_range: f32::INFINITY,
        ..small_model()
    };
    let poses = street_poses();
    let rows = renderer.cast(&poses, &model.directions()).unwrap();
    for method in METHODS {
        assert_eq!(renderer.render_by(method, &poses, &model).unwrap(), rows);
    }
}

#[test]
fn rays_in_any_direction_find_what_a_plain_ray_caster_finds() {
    let tiles = street();
    let Some(renderer) = renderer(&tiles) else {
        return;
    };
    let axes = [Vec3::X, Vec3::Y, Vec3::Z];
    let spiral = (0..700).map(|i| {
        let z = 1.0 - 2.0 * (i as f32 + 0.5) / 700.0;
        let azimuth = 2.4 * i as f32;
        Vec3::new(azimuth.cos(), azimuth.sin(), 0.0) * (1.0 - z * z).sqrt() + z * Vec3::Z
    });
    let directions: Vec<Vec3> = axes
        .into_iter()
        .chain(axes.map(|axis| -axis))
        .chain(spiral)
        .collect();
    let poses = street_poses();
    let rows = renderer.cast(&poses, &directions).unwrap();
    let truth = BruteForce::new(&tiles);
    for (pose, row) in poses.iter().zip(&rows) {
        assert_same(&truth, pose, &directions, row, "cast");
    }
    assert!(rows[0].contains(&f32::INFINITY));
}

#[test]
fn a_closed_room_has_no_holes_anywhere_not_at_the_seam_and_not_at_the_poles() {
    let model = LidarModel {
        height: 45,
        width: 90,
        fov_up: 90.0,
        fov_down: 90.0,
        max_range: 100.0,
        min_range: 0.05,
    };
    // Walls of two triangles each, which bend most; and finely cut ones.
    for cuts in [1, 7] {
        let tiles = [room(5.0, cuts)];
        let Some(renderer) = renderer(&tiles) else {
            return;
        };
        // From the middle corners, edges and the seam lie in symmetric places.
        let poses = [
            Pose3::identity(),
            pose(0.3, -1.1, 0.7, [0.1, 0.2, 2.0]),
            pose(-4.9, 0.0, 0.0, [0.0, 0.0, std::f64::consts::PI]),
        ];
        let truth = BruteForce::new(&tiles);
        for method in METHODS {
            let images = renderer.render_by(method, &poses, &model).unwrap();
            for (pose, image) in poses.iter().zip(&images) {
                let holes = image.iter().filter(|range_m| !range_m.is_finite()).count();
                assert_eq!(holes, 0, "{method:?}, walls cut {cuts} times");
                let what = format!("{method:?} in a room");
                assert_same(&truth, pose, &model.directions(), image, &what);
            }
        }
    }
}

#[test]
fn straight_ahead_and_straight_behind_nothing_is_missing() {
    let tiles = street();
    let Some(renderer) = renderer(&tiles) else {
        return;
    };
    let model = LidarModel::default();
    // Off the edges of the triangles, so that some cross the seam.
    let poses = [pose(0.2, 0.37, 1.73, [0.0; 3])];
    let truth = BruteForce::new(&tiles).between(model.min_range, model.max_range);
    let directions = model.directions();
    for method in METHODS {
        let image = &renderer.render_by(method, &poses, &model).unwrap()[0];
        for column in [0, 1, 448, 449, 450, 451, 898, 899] {
            let pixels = (0..model.height).map(|row| row * model.width + column);
            let (rays, ranges): (Vec<Vec3>, Vec<f32>) = pixels
                .map(|pixel| (directions[pixel], image[pixel]))
                .unzip();
            assert_same(
                &truth,
                &poses[0],
                &rays,
                &ranges,
                &format!("{method:?} {column}"),
            );
        }
    }
}

#[test]
fn costs_and_the_weights_that_follow_agree() {
    let tiles = street();
    let Some(renderer) = renderer(&tiles) else {
        return;
    };
    let truth = BruteForce::new(&tiles);
    let (at, elsewhere) = (street_poses(), pose(-19.5, 0.9, 1.73, [0.0, 0.0, 0.05]));
    let directions: Vec<Vec3> = small_model().directions().into_iter().step_by(5).collect();
    let beams: Vec<Beam> = directions
        .iter()
        .map(|&direction| (direction, truth.range(&at[0], direction) as f32))
        .filter(|&(_, range_m)| range_m < 50.0)
        .map(|(direction, range_m)| Beam { direction, range_m })
        .collect();
    let poses: Vec<Pose3> = at.into_iter().chain([elsewhere]).collect();
    let differences = [
        RangeDifference::UNLIMITED,
        RangeDifference::truncated(0.5),
        RangeDifference {
            short_m: 0.4,
            long_m: 0.8,
            no_surface_m: 0.6,
        },
        RangeDifference {
            short_m: 1e9,
            long_m: 1.0,
            no_surface_m: f32::INFINITY,
        },
    ];
    for difference in differences {
        let costs = renderer.compare(&poses, &beams, &difference).unwrap();
        let expected = poses
            .iter()
            .map(|pose| truth.mean_cost(pose, &beams, &difference));
        for (cost, expected) in costs.iter().zip(expected) {
            let weight = |cost: f64| (-0.5 * (cost / 2.0).powi(2)).exp();
            let (ours, theirs) = (weight(f64::from(*cost)), weight(expected));
            assert!(
                (ours - theirs).abs() < 1e-4,
                "{difference:?}: {cost} {expected}"
            );
            assert!(
                (f64::from(*cost) - expected).abs() < 2e-3,
                "{cost} {expected}"
            );
        }
        assert!(costs[0] < 1e-3 && costs[3] > 0.03, "{costs:?}");
    }
}

#[test]
fn the_processor_and_the_device_show_the_same_street() {
    let tiles = street();
    let Some(renderer) = renderer(&tiles) else {
        return;
    };
    let cpu = CpuRenderer::new(&tiles);
    let model = LidarModel::default();
    let poses = street_poses();
    let expected = cpu.render(&poses, &model).unwrap();
    let truth = BruteForce::new(&tiles).between(model.min_range, model.max_range);
    let directions = model.directions();
    for method in METHODS {
        let images = renderer.render_by(method, &poses, &model).unwrap();
        for ((pose, image), expected) in poses.iter().zip(&images).zip(&expected) {
            let differ: Vec<usize> = (0..image.len())
                .filter(|&pixel| !same(f64::from(expected[pixel]), image[pixel]))
                .collect();
            assert!(
                differ.len() * 1000 <= image.len(),
                "{method:?}: {}",
                differ.len()
            );
            for pixel in differ {
                let near = sideways(&truth, pose, directions[pixel]);
                assert!(near.iter().any(|&range_m| same(range_m, image[pixel])));
                assert!(near.iter().any(|&range_m| same(range_m, expected[pixel])));
            }
        }
    }
}

/// A map of a few scans of drive 0005 in one tile; `None`, and said so, where the data is not.
#[expect(
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "a test that did not run must not look like one that did, a failing one may panic"
)]
fn drive_0005() -> Option<TriangleMesh> {
    let project = Path::new(env!("CARGO_MANIFEST_DIR"));
    let data = std::env::var_os("FPMCL_DATA")
        .map_or_else(|| project.join("../shared/data"), PathBuf::from)
        .join("kitti-0926-drive-0005");
    if !data.is_dir() {
        eprintln!("not run: {} is absent", data.display());
        return None;
    }
    let folder = tempfile::tempdir().unwrap();
    let map = folder.path().join("map.ply");
    let path = |path: &Path| path.display().to_string();
    common::fpmcl("build-map")
        .with(project.join("config/build_map.yml"))
        .set("scan_folder", &path(&data.join("velodyne")))
        .set("pose_file", &path(&data.join("poses.txt")))
        .set("calib_file", &path(&data.join("calib.txt")))
        .set("mesh_file", &path(&map))
        .set("n_scans", "6")
        .set("visualize", "False")
        .succeeds();
    Some(fpmcl::map::ply::read(&map).unwrap())
}

#[test]
fn the_processor_and_the_device_show_the_same_map_of_drive_0005() {
    let Some(mesh) = drive_0005() else {
        return;
    };
    let tiles = [mesh];
    let Some(renderer) = renderer(&tiles) else {
        return;
    };
    let model = LidarModel::default();
    let poses = [
        pose(0.0, 0.0, 0.0, [0.0, 0.0, 0.0]),
        pose(2.1, 0.4, 0.05, [0.01, -0.02, 0.7]),
    ];
    let expected = CpuRenderer::new(&tiles).render(&poses, &model).unwrap();
    let images = renderer.render(&poses, &model).unwrap();
    for (image, expected) in images.iter().zip(&expected) {
        let seen = expected
            .iter()
            .filter(|range_m| range_m.is_finite())
            .count();
        let differ = std::iter::zip(image, expected)
            .filter(|&(&range_m, &expected)| !same(f64::from(expected), range_m))
            .count();
        assert!(differ * 1000 <= image.len(), "{differ}");
        assert!(seen * 4 > image.len(), "{seen}");
    }
}

#[test]
fn the_processor_and_the_device_give_particles_the_same_weights() {
    let tiles = street();
    let Some(renderer) = renderer(&tiles) else {
        return;
    };
    let cpu = CpuRenderer::new(&tiles);
    let at = pose(3.1, -1.2, 1.76, [0.02, -0.03, 1.1]);
    let model = small_model();
    let image = cpu.render(&[at], &model).unwrap().remove(0);
    let beams: Vec<Beam> = RangeImage::from_ranges(image, &model)
        .beams()
        .step_by(3)
        .collect();
    let particles: Vec<Pose3> = (0..60)
        .map(|i| {
            let i = f64::from(i);
            let aside = pose(
                i.sin(),
                (1.7 * i).cos(),
                0.0,
                [0.0, 0.0, 0.02 * (0.9 * i).sin()],
            );
            at * aside
        })
        .collect();
    for (difference, sigma) in [
        (RangeDifference::UNLIMITED, 2.0),
        (RangeDifference::truncated(0.5), 0.05),
    ] {
        let weights = |costs: Vec<f32>| -> Vec<f64> {
            let likelihood = |cost: &f32| (-0.5 * (f64::from(*cost) / sigma).powi(2)).exp();
            let likelihoods: Vec<f64> = costs.iter().map(likelihood).collect();
            let sum: f64 = likelihoods.iter().sum();
            likelihoods
                .iter()
                .map(|likelihood| likelihood / sum)
                .collect()
        };
        let ours = weights(renderer.compare(&particles, &beams, &difference).unwrap());
        let theirs = weights(cpu.compare(&particles, &beams, &difference).unwrap());
        for (ours, theirs) in ours.iter().zip(&theirs) {
            assert!(
                (ours - theirs).abs() < 1e-4,
                "{difference:?}: {ours} {theirs}"
            );
        }
        let least = theirs.iter().copied().fold(f64::INFINITY, f64::min);
        let most = theirs.iter().copied().fold(0.0, f64::max);
        assert!(most > 1.2 * least, "all particles weigh the same");
    }
}

#[test]
fn surfaces_out_of_the_limits_are_infinite_and_hide_what_is_behind() {
    let near = room(1.0, 1);
    let far = room(30.0, 1);
    let Some(renderer) = renderer(&[near, far]) else {
        return;
    };
    let at = [Pose3::identity()];
    let model = |min_range, max_range| LidarModel {
        min_range,
        max_range,
        ..small_model()
    };
    for method in METHODS {
        let finite = |model: &LidarModel| -> usize {
            let images = renderer.render_by(method, &at, model).unwrap();
            images[0]
                .iter()
                .filter(|range_m| range_m.is_finite())
                .count()
        };
        assert_eq!(finite(&model(0.5, 50.0)), small_model().len());
        assert_eq!(finite(&model(2.0, 50.0)), 0);
        assert_eq!(finite(&model(0.1, 0.9)), 0);
    }
}

#[test]
fn far_from_the_origin_of_the_map_nothing_changes() {
    let tiles = street();
    let shift = Vec3::new(81920.0, -163840.0, 256.0);
    let mut shifted = tiles.clone();
    for vertex in shifted.iter_mut().flat_map(|tile| &mut tile.vertices) {
        // Rounded to centimetres, for both: only the poses can lose digits.
        *vertex += shift;
    }
    let Some(renderer) = renderer(&shifted) else {
        return;
    };
    let truth = BruteForce::new(&shifted);
    let to = nalgebra::Translation3::new(81920.0, -163840.0, 256.0);
    let poses: Vec<Pose3> = street_poses().iter().map(|pose| to * pose).collect();
    let directions: Vec<Vec3> = small_model().directions().into_iter().step_by(7).collect();
    let rows = renderer.cast(&poses, &directions).unwrap();
    for (pose, row) in poses.iter().zip(&rows) {
        assert_same(&truth, pose, &directions, row, "far away");
    }
}

#[test]
fn an_empty_map_has_no_surface() {
    let Some(renderer) = renderer(&[TriangleMesh::default()]) else {
        return;
    };
    let poses = street_poses();
    for method in METHODS {
        let images = renderer.render_by(method, &poses, &small_model()).unwrap();
        assert_eq!(images.len(), poses.len());
        assert!(
            images
                .iter()
                .flatten()
                .all(|range_m| *range_m == f32::INFINITY)
        );
    }
    let beam = Beam {
        direction: Vec3::X,
        range_m: 7.0,
    };
    let costs = renderer
        .compare(&poses, &[beam], &RangeDifference::UNLIMITED)
        .unwrap();
    assert_eq!(costs, [7.0; 3]);
}

#[test]
fn no_poses_and_no_rays_are_no_work() {
    let Some(renderer) = renderer(&street()) else {
        return;
    };
    let model = small_model();
    for method in METHODS {
        assert!(renderer.render_by(method, &[], &model).unwrap().is_empty());
    }
    assert_eq!(
        renderer.cast(&street_poses(), &[]).unwrap(),
        vec![Vec::<f32>::new(); 3]
    );
    let costs = renderer.compare(&street_poses(), &[], &RangeDifference::UNLIMITED);
    assert_eq!(costs.unwrap(), [0.0; 3]);
}
