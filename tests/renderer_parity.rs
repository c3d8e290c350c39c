//! Parity of the GPU renderer with the CPU renderer and with a brute-force ray caster in `f64`.
//!
//! The tests run on any adapter, also a software one. Without an adapter they are skipped with a
//! message; with `FPMCL_REQUIRE_GPU=1` they fail.
#![cfg(feature = "gpu")]

mod brute_force;
#[expect(clippy::unwrap_used, reason = "a failing test may panic")]
mod common;

use std::path::Path;
use std::sync::Arc;

use fpmcl::geometry::{Pose2, Pose3, TriangleMesh, Vec3};
use fpmcl::internals::CpuRenderer;
use fpmcl::internals::{GpuRenderer, ImageMethod, Scene};
use fpmcl::lidar::{Beam, LidarModel, RangeImage};
use fpmcl::localization::ObservationConfig;
use fpmcl::localization::ParticleSet;
use fpmcl::memory::MemoryBudget;
use fpmcl::rendering::{Backend, RangeDifference, RangeRenderer, RenderError, RenderingMethod};

use brute_force::{BruteForce, room, street};

const METHODS: [ImageMethod; 2] = [ImageMethod::Cast, ImageMethod::Raster];

/// A renderer on any adapter; `None`, with a message, without one.
#[track_caller]
fn renderer(tiles: &[TriangleMesh]) -> Option<GpuRenderer> {
    renderer_of(tiles, false)
}

#[track_caller]
fn renderer_of(tiles: &[TriangleMesh], has_fronts: bool) -> Option<GpuRenderer> {
    let mut scene = Scene::of_tiles(tiles);
    scene.has_fronts = has_fronts;
    match GpuRenderer::new(
        Arc::new(scene),
        (Backend::Gpu, RenderingMethod::Auto),
        MemoryBudget::default(),
    ) {
        Ok(renderer) => Some(renderer),
        Err(RenderError::NoAdapter) => {
            let required = std::env::var_os("FPMCL_REQUIRE_GPU").is_some_and(|value| value == "1");
            assert!(
                !required,
                "FPMCL_REQUIRE_GPU=1, but there is no graphics adapter"
            );
            common::skips::skipped("there is no graphics adapter");
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

/// Checks ranges against brute force: 99.9 % agree within 1 mm; each other ray passes an edge, so
/// that a ray rotated by 0.02 mrad agrees.
fn assert_ranges_agree(
    truth: &BruteForce,
    pose: &Pose3,
    directions: &[Vec3],
    ranges: &[f32],
    what: &str,
) {
    assert_eq!(directions.len(), ranges.len());
    let mut differ = 0;
    for (&direction, &range_m) in directions.iter().zip(ranges) {
        let expected = truth.range(pose, direction);
        if agree(expected, range_m) {
            continue;
        }
        differ += 1;
        let nearby = ranges_nearby(truth, pose, direction);
        assert!(
            nearby.iter().any(|&near| agree(near, range_m)),
            "{what}: {range_m} m instead of {expected} m along {direction}, without an edge"
        );
    }
    assert!(
        differ * 1000 <= ranges.len(),
        "{what}: {differ} of {}",
        ranges.len()
    );
}

/// Ranges along six directions 0.02 mrad from a direction [m].
fn ranges_nearby(truth: &BruteForce, pose: &Pose3, direction: Vec3) -> [f64; 6] {
    [Vec3::X, Vec3::Y, Vec3::Z, -Vec3::X, -Vec3::Y, -Vec3::Z]
        .map(|axis| truth.range(pose, (direction + 2e-5 * axis).normalize()))
}

fn agree(expected: f64, range_m: f32) -> bool {
    expected == f64::from(range_m) || (expected - f64::from(range_m)).abs() < 1e-3
}

#[test]
fn both_methods_render_the_street_as_brute_force_does() {
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
            assert_ranges_agree(
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
fn rendering_equals_casting_along_the_centre_rays() {
    let Some(renderer) = renderer(&street()) else {
        return;
    };
    let model = LidarModel {
        min_range: 0.0,
        max_range: f32::INFINITY,
        ..small_model()
    };
    let poses = street_poses();
    let rows = renderer
        .cast(&poses, &model.directions(), f32::INFINITY)
        .unwrap();
    for method in METHODS {
        assert_eq!(renderer.render_by(method, &poses, &model).unwrap(), rows);
    }
}

#[test]
fn rays_in_any_direction_agree_with_brute_force() {
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
    let rows = renderer.cast(&poses, &directions, f32::INFINITY).unwrap();
    let truth = BruteForce::new(&tiles);
    for (pose, row) in poses.iter().zip(&rows) {
        assert_ranges_agree(&truth, pose, &directions, row, "cast");
    }
    assert!(rows[0].contains(&f32::INFINITY));
}

#[test]
fn backs_of_surfaces_are_those_of_the_cpu() {
    let directions = small_model().directions();
    for has_fronts in [true, false] {
        let Some(gpu) = renderer_of(&street(), has_fronts) else {
            return;
        };
        let mut scene = Scene::of_tiles(&street());
        scene.has_fronts = has_fronts;
        let cpu = CpuRenderer::over(Arc::new(scene));
        let (mut fronts, mut backs) = (0, 0);
        for pose in street_poses() {
            let [on_gpu, on_cpu] = [&gpu as &dyn RangeRenderer, &cpu]
                .map(|it| it.cast_signed(&pose, &directions, 80.0).unwrap());
            // A ray at an edge may hit either of its triangles.
            let differ = |(a, b): &(&f32, &f32)| a != b && (*a - *b).abs() > 1e-3;
            let pairs = on_gpu.iter().zip(&on_cpu);
            assert!(pairs.filter(differ).count() < directions.len() / 200);
            backs += on_gpu.iter().filter(|range_m| **range_m < 0.0).count();
            fronts += on_gpu.iter().filter(|range_m| range_m.is_finite()).count();
        }
        // The boxes of this street have both.
        assert_eq!(backs > 500, has_fronts, "{backs}");
        assert!(fronts - backs > 500, "{fronts}");
    }
}

#[test]
fn a_closed_room_has_no_holes_at_the_seam_and_at_the_poles() {
    let model = LidarModel {
        height: 45,
        width: 90,
        fov_up: 90.0,
        fov_down: 90.0,
        max_range: 100.0,
        min_range: 0.05,
        elevations: None,
    };
    // Walls of two triangles each, whose projections are curved most, and finer ones.
    for cuts in [1, 7] {
        let tiles = [room(5.0, cuts)];
        let Some(renderer) = renderer(&tiles) else {
            return;
        };
        // From the centre, corners, edges and the seam are in symmetric positions.
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
                assert_ranges_agree(&truth, pose, &model.directions(), image, &what);
            }
        }
    }
}

#[test]
fn the_columns_at_the_centre_and_at_the_seam_are_complete() {
    let tiles = street();
    let Some(renderer) = renderer(&tiles) else {
        return;
    };
    let model = LidarModel::default();
    // Not on the edges of the triangles, so that some triangles cross the seam.
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
            assert_ranges_agree(
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
fn costs_and_weights_agree_with_brute_force() {
    let tiles = street();
    let Some(renderer) = renderer(&tiles) else {
        return;
    };
    let truth = BruteForce::new(&tiles);
    let (near, far) = (street_poses(), pose(-19.5, 0.9, 1.73, [0.0, 0.0, 0.05]));
    let directions: Vec<Vec3> = small_model().directions().into_iter().step_by(5).collect();
    let beams: Vec<Beam> = directions
        .iter()
        .map(|&direction| (direction, truth.range(&near[0], direction) as f32))
        .filter(|&(_, range_m)| range_m < 50.0)
        .map(|(direction, range_m)| Beam { direction, range_m })
        .collect();
    let poses: Vec<Pose3> = near.into_iter().chain([far]).collect();
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
            let difference_of_weights = weight(f64::from(*cost)) - weight(expected);
            assert!(
                difference_of_weights.abs() < 1e-4,
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
fn cpu_and_gpu_render_the_same_street() {
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
                .filter(|&pixel| !agree(f64::from(expected[pixel]), image[pixel]))
                .collect();
            assert!(
                differ.len() * 1000 <= image.len(),
                "{method:?}: {}",
                differ.len()
            );
            for pixel in differ {
                let near = ranges_nearby(&truth, pose, directions[pixel]);
                assert!(near.iter().any(|&range_m| agree(range_m, image[pixel])));
                assert!(near.iter().any(|&range_m| agree(range_m, expected[pixel])));
            }
        }
    }
}

/// A map of a few scans of drive 0005 in one tile; `None`, with a message, where they are missing.
#[expect(clippy::unwrap_used, reason = "a failing test may panic")]
fn drive_0005() -> Option<TriangleMesh> {
    let data = common::real_recording("kitti-0926-drive-0005")?;
    let folder = tempfile::tempdir().unwrap();
    let map = folder.path().join("map.ply");
    let path = |path: &Path| path.display().to_string();
    common::fpmcl("build-map")
        .with(common::config_file("build_map.yml"))
        .set("scan_folder", &path(&data.join("velodyne")))
        .set("pose_file", &path(&data.join("poses.txt")))
        .set("calib_file", &path(&data.join("calib.txt")))
        .set("mesh_file", &path(&map))
        .set("n_scans", "6")
        .set("visualize", "False")
        .succeeds();
    Some(fpmcl::internals::ply::read(&map).unwrap())
}

#[test]
fn cpu_and_gpu_render_the_same_map_of_drive_0005() {
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
            .filter(|&(&range_m, &expected)| !agree(f64::from(expected), range_m))
            .count();
        assert!(differ * 1000 <= image.len(), "{differ}");
        assert!(seen * 4 > image.len(), "{seen}");
    }
}

/// The street on the lattice of maps, alone or 3 km from the middle of a map.
fn streets_of_maps() -> [(&'static str, Vec<TriangleMesh>); 2] {
    let mut near = street();
    near.iter_mut().for_each(TriangleMesh::snap);
    let mut outskirts = room(1.0, 1);
    for vertex in &mut outskirts.vertices {
        *vertex += Vec3::new(4800.0, -3600.0, 0.0);
    }
    let far = [near.clone(), vec![outskirts]].concat();
    [
        ("at the middle of the map", near),
        ("3 km from the middle", far),
    ]
}

/// A scan with noise of a few centimetres from a pose, and particles around it as while tracking.
#[expect(clippy::unwrap_used, reason = "a failing test may panic")]
fn scan_and_particles(cpu: &CpuRenderer) -> (RangeImage, Vec<Pose3>) {
    let at = pose(3.1234, -1.2345, 1.7654, [0.02, -0.03, 1.1]);
    let model = LidarModel::default();
    let mut ranges = cpu.render(&[at], &model).unwrap().remove(0);
    for (range_m, pixel) in ranges.iter_mut().zip(0_u16..) {
        *range_m += 0.04 * (0.7 * f32::from(pixel)).sin();
    }
    let offset = |i: f64| {
        let [x, y, turn] = [0.755, 0.570, 0.618].map(|step: f64| (i * step).fract() - 0.5);
        at * pose(0.1 * x, 0.1 * y, 0.0, [0.0, 0.0, 0.006 * turn])
    };
    let particles = (0..100).map(f64::from).map(offset).collect();
    (RangeImage::from_ranges(ranges, &model), particles)
}

/// Normalized weights of equal particles after an update by their mean costs.
fn weights(config: &ObservationConfig, costs_m: &[f32]) -> Vec<f64> {
    let mut particles = ParticleSet::uniform(vec![Pose2::identity(); costs_m.len()]);
    let log = |cost_m: &f32| config.log_likelihood(f64::from(*cost_m));
    particles.reweight(&costs_m.iter().map(log).collect::<Vec<_>>());
    particles.weights()
}

/// Checks that weights differ by at most a factor of `1 + tolerance`, and that they are worth comparing.
#[expect(clippy::unwrap_used, reason = "a failing test may panic")]
fn assert_weights_agree(one: &[f64], other: &[f64], tolerance: f64, what: &str) {
    let ratio = |(a, b): (&f64, &f64)| (a / b).ln().abs();
    let largest = std::iter::zip(one, other).map(ratio).fold(0.0, f64::max);
    assert!(
        largest <= tolerance.ln_1p(),
        "{what}: a factor of exp({largest:e})"
    );
    let [least, most] = [f64::min, f64::max].map(|f| one.iter().copied().reduce(f).unwrap());
    assert!(
        least > 0.0 && most > 1.01 * least,
        "{what}: {least} to {most}"
    );
}

/// Beams without those that pass an edge from some particle, so that rounding decides which surface they end on; these are
/// at most one of 10,000 rays.
#[expect(clippy::unwrap_used, reason = "a failing test may panic")]
fn beams_beside_edges(
    beams: &[Beam],
    particles: &[Pose3],
    renderers: [&dyn RangeRenderer; 2],
    tiles: &[TriangleMesh],
) -> Vec<Beam> {
    let truth = BruteForce::new(tiles);
    let directions: Vec<Vec3> = beams.iter().map(|beam| beam.direction).collect();
    let cast = |renderer: &dyn RangeRenderer| renderer.cast(particles, &directions, f32::INFINITY);
    let [one, other] = renderers.map(|renderer| cast(renderer).unwrap());
    let mut passes_edge = vec![false; beams.len()];
    let mut count = 0;
    for (pose, (one, other)) in particles.iter().zip(one.iter().zip(&other)) {
        for (beam, &direction) in directions.iter().enumerate() {
            let [one_m, other_m] = [one[beam], other[beam]];
            if !agree(f64::from(one_m), other_m) {
                let near = ranges_nearby(&truth, pose, direction);
                let is_near = |range_m| near.iter().any(|&near_m| agree(near_m, range_m));
                assert!(
                    is_near(one_m) && is_near(other_m),
                    "{one_m} m and {other_m} m"
                );
                (passes_edge[beam], count) = (true, count + 1);
            }
        }
    }
    assert!(count * 10_000 <= beams.len() * particles.len(), "{count}");
    let kept = beams
        .iter()
        .zip(&passes_edge)
        .filter(|(_, passes)| !**passes);
    kept.map(|(beam, _)| *beam).collect()
}

#[test]
fn cpu_and_gpu_give_particles_the_same_weights() {
    /// A mean cost that differs by 4 µm, the step of a range of 50 m in `f32`, with the scale of 2 mm. With a hundred
    /// particles, resampling changes a weight by about its own size.
    const TOLERANCE: f64 = 0.002;
    for (place, tiles) in streets_of_maps() {
        let Some(gpu) = renderer(&tiles) else {
            return;
        };
        let cpu = CpuRenderer::new(&tiles);
        let (scan, particles) = scan_and_particles(&cpu);
        let config = ObservationConfig::default();
        for count in [300, 600, 3600] {
            let every = scan.beams().count() / count;
            let beams: Vec<Beam> = scan.beams().step_by(every).collect();
            let beams = beams_beside_edges(&beams, &particles, [&cpu, &gpu], &tiles);
            let [by_cpu, by_gpu] = [&cpu as &dyn RangeRenderer, &gpu].map(|renderer| {
                let costs_m = renderer.compare(&particles, &beams, &config.difference());
                weights(&config, &costs_m.unwrap())
            });
            let what = format!("{place}, {count} beams");
            assert_weights_agree(&by_cpu, &by_gpu, TOLERANCE, &what);
        }
    }
}

#[test]
fn both_methods_give_particles_the_same_weights_by_whole_images() {
    /// Ranges are the same bits; they are added up in another order.
    const OF_SUMS: f64 = 1e-5;
    /// Of 50,000 pixels, a few pass an edge of a house on the other side, which moves the mean by a tenth of a millimetre
    /// each: a ten-thousandth of the weight with a standard deviation of 2 m.
    const OF_EDGES: f64 = 1e-3;
    let config = ObservationConfig::reference();
    for (place, tiles) in streets_of_maps() {
        let Some(gpu) = renderer(&tiles) else {
            return;
        };
        let cpu = CpuRenderer::new(&tiles);
        let (scan, particles) = scan_and_particles(&cpu);
        // As far apart as particles of a search, so that the wide likelihood tells them apart.
        let start = particles[0];
        let particles: Vec<Pose3> = (particles[..20].iter())
            .map(|near| {
                near * pose(
                    30.0 * (near.translation.x - start.translation.x),
                    1.0,
                    0.0,
                    [0.0; 3],
                )
            })
            .collect();
        let difference = config.difference();
        let [cast, raster] = METHODS.map(|method| {
            let costs_m = gpu.compare_images_by(method, &particles, &scan, &difference);
            weights(&config, &costs_m.unwrap())
        });
        let by_cpu = cpu.compare_images(&particles, &scan, &difference).unwrap();
        assert_weights_agree(&cast, &raster, OF_SUMS, place);
        assert_weights_agree(&weights(&config, &by_cpu), &cast, OF_EDGES, place);
        let chosen = gpu.compare_images(&particles, &scan, &difference).unwrap();
        assert_weights_agree(&weights(&config, &chosen), &cast, OF_SUMS, place);
    }
}

#[test]
fn comparing_images_is_rendering_them_and_counting_the_costs() {
    let tiles = street();
    let Some(gpu) = renderer(&tiles) else {
        return;
    };
    let cpu = CpuRenderer::new(&tiles);
    // A car is nearer than the least range, the ends of the street farther than the greatest.
    let model = LidarModel {
        min_range: 5.0,
        max_range: 30.0,
        ..small_model()
    };
    let poses = street_poses();
    let ranges = cpu.render(&poses[..1], &model).unwrap().remove(0);
    let scan = RangeImage::from_ranges(ranges, &model);
    let limited = RangeDifference {
        short_m: 0.4,
        long_m: 0.8,
        no_surface_m: 0.4,
    };
    for difference in [RangeDifference::UNLIMITED, limited] {
        let images = cpu.render(&poses, &model).unwrap();
        let expected = images.iter().map(|image| {
            let returns = (0..model.len()).filter(|&pixel| scan.has_return(pixel));
            let costs = returns.map(|pixel| difference.cost(scan.ranges[pixel], image[pixel]));
            let costs: Vec<f64> = costs.map(f64::from).collect();
            costs.iter().sum::<f64>() / costs.len() as f64
        });
        let expected: Vec<f64> = expected.collect();
        assert!(expected[0] == 0.0 && expected[1] > 0.1, "{expected:?}");
        let by_cpu = cpu.compare_images(&poses, &scan, &difference).unwrap();
        let by_gpu = METHODS.map(|method| {
            let costs_m = gpu.compare_images_by(method, &poses, &scan, &difference);
            costs_m.unwrap()
        });
        for costs_m in [&by_cpu, &by_gpu[0], &by_gpu[1]] {
            for (cost_m, expected) in costs_m.iter().zip(&expected) {
                assert!(
                    (f64::from(*cost_m) - expected).abs() < 2e-3,
                    "{cost_m} {expected}"
                );
            }
        }
    }
}

#[test]
fn surfaces_outside_the_range_limits_are_infinite_and_occlude_others() {
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
fn ranges_far_from_the_map_origin_agree_with_brute_force() {
    let tiles = street();
    let shift = Vec3::new(81920.0, -163840.0, 256.0);
    let mut shifted = tiles.clone();
    for vertex in shifted.iter_mut().flat_map(|tile| &mut tile.vertices) {
        // Both renderers use the rounded vertices; only the poses can lose precision.
        *vertex += shift;
    }
    let Some(renderer) = renderer(&shifted) else {
        return;
    };
    let truth = BruteForce::new(&shifted);
    let translation = nalgebra::Translation3::new(81920.0, -163840.0, 256.0);
    let poses: Vec<Pose3> = street_poses()
        .iter()
        .map(|pose| translation * pose)
        .collect();
    let directions: Vec<Vec3> = small_model().directions().into_iter().step_by(7).collect();
    let rows = renderer.cast(&poses, &directions, f32::INFINITY).unwrap();
    for (pose, row) in poses.iter().zip(&rows) {
        assert_ranges_agree(&truth, pose, &directions, row, "far away");
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
fn without_poses_or_rays_the_result_is_empty() {
    let Some(renderer) = renderer(&street()) else {
        return;
    };
    let model = small_model();
    for method in METHODS {
        assert!(renderer.render_by(method, &[], &model).unwrap().is_empty());
    }
    assert_eq!(
        renderer.cast(&street_poses(), &[], f32::INFINITY).unwrap(),
        vec![Vec::<f32>::new(); 3]
    );
    let costs = renderer.compare(&street_poses(), &[], &RangeDifference::UNLIMITED);
    assert_eq!(costs.unwrap(), [0.0; 3]);
}

#[test]
fn the_program_rasterizes_or_casts_whole_images_with_the_same_result() {
    if renderer(&street()).is_none() {
        return;
    }
    let recording = common::Recording::street(6);
    recording.fpmcl("build-map").succeeds();
    let localize = |backend: &str, method: &str| {
        common::fpmcl("localize")
            .in_folder(recording.folder())
            .with("localization.yml")
            .with(format!("--backend={backend}"))
            .set("observation.likelihood", "reference")
            .set("proposal.scan", "False")
            // Wide, so that whole images are compared.
            .set("start.position_m", "2")
            .set("rendering.method", method)
            .set(
                "result_path",
                &format!("{backend}_{method}/localization.npz"),
            )
    };
    let errors_m = ["raster", "cast", "auto"].map(|method| {
        // So few particles do not converge.
        let printed = localize("gpu", method).exits_with(3).stderr;
        let measured = "ms by casting rays and";
        assert_eq!(printed.contains(measured), method == "auto", "{printed}");
        let table = recording.path(&format!("gpu_{method}/frames.csv"));
        common::numbers(&table, "mcl_position_error_m")
    });
    assert!(
        errors_m[0].len() == 6 && errors_m[0].iter().all(|m| *m < 5.0),
        "{errors_m:?}"
    );
    for other in &errors_m[1..] {
        let apart = std::iter::zip(&errors_m[0], other).map(|(a, b)| (a - b).abs());
        assert!(apart.fold(0.0, f64::max) < 1e-3, "{errors_m:?}");
    }
    localize("cpu", "raster").fails_with(&["method is raster", "--backend gpu"]);
}
