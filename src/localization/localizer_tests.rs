//! The localizer on scans as values.

use std::fs;
use std::path::Path;

use glam::Vec3;
use nalgebra::Vector2;

use super::*;
use crate::geometry::TriangleMesh;
use crate::lidar::LidarModel;
use crate::localization::{ObservationConfig, ProposalConfig, State};
use crate::map::world_for_tests::TestWorld;
use crate::map::{MapCache, MapOptions, MappingPath, TileConfig, TileGrid};
use crate::rendering::Backend;

impl LocalizerConfig {
    /// Small enough for a test, else the defaults.
    pub fn of_test(num_particles: usize) -> Self {
        let mut proposal = ProposalConfig::default();
        proposal.registration.map_error_m = 0.0;
        Self {
            num_particles,
            proposal,
            observation: ObservationConfig {
                beams: 600,
                min_beams: 150,
                ray_budget: 60_000,
                ..ObservationConfig::default()
            },
            ..Self::default()
        }
    }
}

/// A localizer runs on one thread at a time, a map is shared by several.
const _: () = {
    const fn is_send<T: Send>() {}
    const fn is_shared<T: Send + Sync>() {}
    is_send::<Localizer>();
    is_shared::<Map>();
};

/// A sensor with small range images.
fn sensor() -> Sensor {
    Sensor::new(LidarModel {
        height: 32,
        width: 360,
        ..LidarModel::default()
    })
}

fn config() -> LocalizerConfig {
    LocalizerConfig::of_test(500)
}

/// A drive along the street, 0.8 m per frame.
fn drive(world: &TestWorld, from_x: f64, frames: usize) -> Vec<Pose2> {
    (0..frames)
        .map(|frame| world.pose_at(from_x + 0.8 * frame as f64, 0.3, 0.02))
        .collect()
}

fn scan(world: &TestWorld, pose: &Pose2) -> Scan {
    Scan {
        points: world.scan(pose).points,
        ..Scan::default()
    }
}

fn near(pose: &Pose2) -> Start {
    Start::Pose {
        map_from_lidar: *pose,
        height_m: None,
        spread: StartSpread::default(),
    }
}

/// Localizes a drive with exact odometry.
fn localize(world: &TestWorld, start: Start, truth: &[Pose2], seed: u64) -> Vec<Estimate> {
    let mut localizer = Localizer::new(&world.map(), &sensor(), config(), start, seed).unwrap();
    let mut previous = truth[0];
    truth
        .iter()
        .map(|pose| {
            let increment = previous.inverse() * pose;
            previous = *pose;
            let odometry = Odometry::Increment(increment);
            localizer.step(&scan(world, pose), odometry).unwrap()
        })
        .collect()
}

/// The street as a map on disk, in a folder: its walls and, red, its ground.
fn on_disk(world: &TestWorld) -> (tempfile::TempDir, Map) {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("street.ply");
    let map = world.map();
    let mut mesh = TriangleMesh::clone(&map.mesh().unwrap());
    mesh.colors = vec![[0, 0, 255]; mesh.vertices.len()];
    let first = mesh.vertices.len() as u32;
    for (x, y) in [(-90.0, -90.0), (180.0, -90.0), (180.0, 90.0), (-90.0, 90.0)] {
        let corner = world.pose_at(x, y, 0.0).translation.vector;
        let height_m = map
            .ground
            .patch_at(0.0, 0.0, 2.0, None)
            .unwrap()
            .unwrap()
            .height_m;
        (mesh.vertices).push(Vec3::new(corner.x as f32, corner.y as f32, height_m as f32));
        mesh.colors.push([255, 0, 0]);
    }
    mesh.triangles
        .extend([[0, 1, 2], [0, 2, 3]].map(|corners| corners.map(|it| first + it)));
    let options = MapOptions {
        backend: Backend::Cpu,
        cache: MapCache::NextToMap,
        ..MapOptions::default()
    };
    let saved = Map::new(mesh, MappingPath::clone(&map.path), &options).unwrap();
    saved.save(&file).unwrap();
    let map = Map::load(&file, &options).unwrap();
    (folder, map)
}

/// Changes a byte of all tiles of the map in a folder: the number of the byte follows from the length of the file.
fn damage_tiles(folder: &Path, byte: fn(usize) -> usize) {
    for entry in fs::read_dir(folder.join("street.ply.tiles")).unwrap() {
        let file = entry.unwrap().path();
        if file.extension().is_some_and(|ending| ending == "tile") {
            let mut bytes = fs::read(&file).unwrap();
            let byte = byte(bytes.len());
            bytes[byte] ^= 1;
            // Replaced as a whole, as files that may be mapped have to be.
            fs::remove_file(&file).unwrap();
            fs::write(&file, bytes).unwrap();
        }
    }
}

#[test]
fn a_tile_that_cannot_be_read_is_an_error_of_each_step_that_needs_it() {
    let world = TestWorld::street();
    let truth = drive(&world, 10.0, 6);
    let is_of_tile = |error: LocalizerError| {
        let message = error.to_string();
        assert!(
            message.contains(".tile") && message.contains("checksum"),
            "{message}"
        );
    };
    // A byte of the surfaces, and one of the ground.
    for byte in [|_| 300, |bytes| bytes - 1] as [fn(usize) -> usize; 2] {
        let (folder, map) = on_disk(&world);
        damage_tiles(folder.path(), byte);
        let mut localizer = Localizer::new(&map, &sensor(), config(), near(&truth[0]), 1).unwrap();
        for pose in &truth {
            let odometry = Odometry::Increment(Pose2::translation(0.8, 0.0));
            is_of_tile(localizer.step(&scan(&world, pose), odometry).unwrap_err());
        }
    }
}

/// Distance between an estimate and the truth [m].
fn error_m(estimate: &Estimate, truth: &Pose2) -> f64 {
    (estimate.pose.translation.vector - truth.translation.vector).norm()
}

#[test]
fn the_same_seed_gives_identical_estimates() {
    let world = TestWorld::street();
    let truth = drive(&world, 10.0, 4);
    let run = |seed| localize(&world, near(&truth[0]), &truth, seed);
    let (a, b, other) = (run(3), run(3), run(4));
    for (a, b) in a.iter().zip(&b) {
        assert_eq!((a.pose, a.covariance), (b.pose, b.covariance));
        assert_eq!(a.particles, b.particles);
    }
    assert_ne!(a[3].pose, other[3].pose);
}

#[test]
fn a_change_of_the_scans_by_a_millimetre_changes_the_estimates_by_less() {
    let world = TestWorld::street();
    let truth = drive(&world, 10.0, 10);
    let run = |changed_m: f32| {
        let start = near(&truth[0]);
        let mut localizer = Localizer::new(&world.map(), &sensor(), config(), start, 3).unwrap();
        let step = |pair: &[Pose2]| {
            let mut scan = scan(&world, &pair[1]);
            // One of eleven thousand points is farther away, and one is missing.
            let far = scan.points[7000].length();
            scan.points[7000] *= 1.0 + changed_m / far.max(1.0);
            if changed_m > 0.0 {
                scan.points[5000] = Vec3::ZERO;
            }
            let odometry = Odometry::Increment(pair[0].inverse() * pair[1]);
            localizer.step(&scan, odometry).unwrap()
        };
        truth.windows(2).map(step).collect::<Vec<_>>()
    };
    for (number, (a, b)) in run(0.0).iter().zip(&run(1e-3)).enumerate() {
        let apart_m = error_m(a, &b.pose);
        assert!(apart_m < 1e-3, "frame {number}: {apart_m} m");
    }
}

#[test]
fn every_start_finds_the_car_in_the_street() {
    let world = TestWorld::street();
    let truth = drive(&world, 31.0, 12);
    for start in [near(&truth[0]), Start::Road, Start::Anywhere] {
        let estimates = localize(&world, start.clone(), &truth, 1);
        let last = estimates.last().unwrap();
        let error_m = error_m(last, &truth[11]);
        assert!(error_m < 0.05, "{start:?}: {error_m} m");
        assert_eq!(last.state, State::Tracking, "{start:?}");
    }
}

#[test]
fn an_unknown_start_is_on_the_road_of_a_large_map_and_anywhere_in_others() {
    let mut map = TestWorld::street().map();
    assert_eq!(Start::unknown(&map), Start::Anywhere);
    let poses: Vec<Pose3> = (0..2000)
        .map(|number| Pose3::translation(5.0 * f64::from(number), 0.0, 1.73))
        .collect();
    map.tiles = TileGrid::around(&poses, &TileConfig::default()).into();
    map.path = MappingPath {
        map_from_lidar: poses,
        ..MappingPath::default()
    }
    .into();
    assert_eq!(Start::unknown(&map), Start::Road);
    map.path = MappingPath::default().into();
    assert_eq!(Start::unknown(&map), Start::Anywhere);
}

#[test]
fn a_start_outside_the_map_is_an_error_that_gives_the_place() {
    let world = TestWorld::street();
    let start = near(&Pose2::new(Vector2::new(9000.0, -50.0), 0.0));
    let mut localizer = Localizer::new(&world.map(), &sensor(), config(), start, 0).unwrap();
    let scan = scan(&world, &world.pose_at(0.0, 0.0, 0.0));
    let error = localizer.step(&scan, Odometry::Unknown).unwrap_err();
    let LocalizerError::StartOutside { x, y } = error else {
        panic!("{error}");
    };
    assert!((x - 9000.0).abs() <= 5.0 && (y + 50.0).abs() <= 5.0);
}

#[test]
fn a_configured_height_of_the_sensor_is_used_where_no_ground_is_visible() {
    let world = TestWorld::street();
    let sensor = Sensor {
        sensor_height_m: Some(2.1),
        ..sensor()
    };
    let start = near(&world.pose_at(0.0, 0.0, 0.0));
    let mut localizer = Localizer::new(&world.map(), &sensor, config(), start, 0).unwrap();
    let estimate = localizer.step(&Scan::default(), Odometry::Unknown).unwrap();
    assert_eq!(estimate.attitude.height_m, 2.1);
    let request = localizer.panorama_request();
    assert!((request.sensor_height_m - 2.1).abs() < 1e-9);
}

#[test]
fn an_invalid_configuration_is_an_error_that_names_its_key() {
    let map = TestWorld::street().map();
    let message = |change: fn(&mut LocalizerConfig)| {
        let mut config = config();
        change(&mut config);
        let result = Localizer::new(&map, &sensor(), config, Start::Road, 0);
        result.err().unwrap().to_string()
    };
    let no_particles = message(|config| config.num_particles = 0);
    assert!(
        no_particles.contains("num_particles is 0"),
        "{no_particles}"
    );
    let no_scale = message(|config| config.observation.scale_m = -1.0);
    assert!(no_scale.contains("observation.scale_m is -1"), "{no_scale}");
}

#[test]
fn library_and_program_refuse_the_same_values() {
    let refused = |change: fn(&mut Sensor)| {
        let mut sensor = sensor();
        change(&mut sensor);
        sensor.validate().unwrap_err().to_string()
    };
    assert!(refused(|sensor| sensor.range_image.width = 0).contains("range_image"));
    assert!(refused(|sensor| sensor.sensor_height_m = Some(-1.0)).contains("sensor_height_m"));
    assert!(refused(|sensor| sensor.sensor_height_m = Some(f64::NAN)).contains("sensor_height_m"));
    assert!(refused(|sensor| sensor.own_car_m = [1.0, -1.0, 0.0, 1.0]).contains("own_car"));
    let mut config = LocalizerConfig::default();
    config.panorama.yaw_sigma_deg = -1.0;
    let error = config.validate().unwrap_err().to_string();
    assert!(error.contains("yaw_sigma"));
}

#[test]
fn scans_of_another_sensor_are_refused() {
    let world = TestWorld::street();
    let pose = world.pose_at(20.0, 0.3, 0.02);
    let mut localizer =
        Localizer::new(&world.map(), &Sensor::vlp16(), config(), near(&pose), 0).unwrap();
    let result = localizer.step(&scan(&world, &pose), Odometry::Unknown);
    let Err(LocalizerError::Sensor(SensorError::OtherSensor { share, .. })) = result else {
        panic!("an answer for beams that a VLP-16 does not have");
    };
    assert!(share > 0.2, "{share}");
}
