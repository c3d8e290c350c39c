//! Laws of the whole simulation: street, drive, traffic and scans together.

use std::path::PathBuf;

use approx::assert_relative_eq;
use glam::{DVec2, Vec3};

use super::*;

/// 60 m with a bend and a slope, scanned by a coarse sensor.
fn small() -> SimulationConfig {
    SimulationConfig {
        path: vec![
            PathSegment::new(25.0, 0.0, 0.0),
            PathSegment::new(35.0, 40.0, 6.0),
        ],
        scanner: ScannerConfig {
            beams: 32,
            azimuth_steps: 500,
            ..ScannerConfig::default()
        },
        ..SimulationConfig::default()
    }
}

const NO_TRAFFIC: TrafficConfig = TrafficConfig {
    has_lead_vehicle: false,
    oncoming_spacing_m: 0.0,
    oncoming_speed_m_s: 0.0,
    cyclists_per_100_m: 0.0,
    pedestrians_per_100_m: 0.0,
    lorry_from_s: None,
    lorry_for_s: 0.0,
};

fn is_ground(class: u16) -> bool {
    use classes::{PARKING, ROAD, SIDEWALK, TERRAIN};
    [ROAD, PARKING, SIDEWALK, TERRAIN].contains(&class)
}

fn is_moving(class: u16) -> bool {
    (252..=259).contains(&class)
}

fn simulate(config: &SimulationConfig) -> Simulation {
    Simulation::new(config, None, MemoryBudget::default()).unwrap()
}

/// The poses of KITTI 07, if the recorded data is there.
fn kitti_07() -> Option<Vec<Pose3>> {
    let data = std::env::var_os("FPMCL_DATA")
        .map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from)
        .join("kitti-odometry-poses");
    let poses = crate::recording::poses::CameraPoses::read(&data.join("poses/07.txt"));
    let calibration = Calibration::read(&data.join("sequences/07/calib.txt"));
    match (poses, calibration) {
        (Ok(poses), Ok(calibration)) => Some(poses.map_from_lidar(&calibration)),
        _ => {
            let reason = format!("there are no poses of KITTI 07 in {}", data.display());
            crate::skips_for_tests::skipped(reason);
            None
        }
    }
}

fn in_world(simulation: &Simulation, frame: usize) -> (Vec<Vec3>, Vec<u16>) {
    let world_from_lidar = Rigid3f::from(&simulation.poses()[frame]);
    let labelled = simulation.scan(frame);
    let points = labelled.scan.points.iter();
    (
        points.map(|&p| world_from_lidar.apply(p)).collect(),
        labelled.classes,
    )
}

#[test]
fn ground_points_lie_on_the_ground_of_their_class_within_noise() {
    let simulation = simulate(&small());
    let ground = &simulation.street.ground;
    let mut counts = [0; 3];
    for frame in [0, 30, 60] {
        let (points, classes) = in_world(&simulation, frame);
        for (point, class) in points.iter().zip(classes) {
            let sample = ground.at(DVec2::new(point.x.into(), point.y.into()));
            let (zone, index) = match class {
                classes::ROAD | classes::PARKING => (GroundZone::Carriageway, 0),
                classes::SIDEWALK if sample.kerb_m > 0.2 => (GroundZone::Sidewalk, 1),
                classes::TERRAIN => (GroundZone::Terrain, 2),
                _ => continue,
            };
            counts[index] += 1;
            // Five sigma of the range along the beam, and what the plane of a cell leaves out.
            let error_m = point.z - ground.zone_height_m(&sample, zone);
            assert!(error_m.abs() < 0.1 + 0.02, "{class}: {error_m}");
        }
    }
    assert!(counts.iter().all(|&count| count > 1000), "{counts:?}");
}

#[test]
fn all_classes_of_a_street_are_scanned() {
    let simulation = simulate(&SimulationConfig::default());
    let mut seen = std::collections::BTreeSet::new();
    for frame in (0..simulation.frames()).step_by(25) {
        seen.extend(simulation.scan(frame).classes);
    }
    for class in [10, 40, 44, 48, 50, 51, 52, 70, 71, 72, 80, 81, 252, 254] {
        assert!(seen.contains(&class), "no {class} in {seen:?}");
    }
}

#[test]
fn no_static_object_is_on_the_driven_path() {
    for (seed, drive) in [(1, 1), (2, 2), (3, 3)] {
        let simulation = simulate(&SimulationConfig {
            seed,
            drive,
            ..SimulationConfig::default()
        });
        let poses: Vec<Pose3> = simulation.poses().into_iter().step_by(4).collect();
        let street = &simulation.street.surface;
        for (triangle, Material { class, .. }) in street.materials.iter().enumerate() {
            if is_ground(*class) {
                continue;
            }
            let [a, b, c] = street.mesh.corners(triangle);
            let middle = (a + b + c) / 3.0;
            for pose in &poses {
                let t = pose.translation.vector;
                let offset = middle - Vec3::new(t.x as f32, t.y as f32, t.z as f32);
                let is_free = offset.truncate().length() > 1.5 || offset.z > 0.5;
                assert!(is_free, "class {class} {offset} from the lidar");
            }
        }
    }
}

#[test]
fn two_drives_share_the_street_and_nothing_else() {
    let first = simulate(&small());
    let second = simulate(&SimulationConfig {
        drive: 2,
        ..small()
    });
    assert_eq!(first.street.surface, second.street.surface);
    assert_ne!(first.scan(10), second.scan(10));
    assert_ne!(first.traffic_at(10).mesh, second.traffic_at(10).mesh);

    // The second drives 0.4 m farther left, apart from weaving.
    let line = &first.ego_motion.centreline;
    let mean_offset_m = |simulation: &Simulation| {
        let poses = simulation.poses();
        let offsets_m: Vec<f64> = (poses.iter().zip(&simulation.ego_motion.stations_m))
            .map(|(pose, station_m)| {
                let t = pose.translation.vector;
                let point = line.at(*station_m);
                (DVec2::new(t.x, t.y) - point.position).dot(point.left())
            })
            .collect();
        offsets_m.iter().sum::<f64>() / offsets_m.len() as f64
    };
    assert_relative_eq!(
        mean_offset_m(&second) - mean_offset_m(&first),
        0.4,
        epsilon = 0.12
    );
}

#[test]
fn another_seed_is_another_street() {
    let other = SimulationConfig { seed: 9, ..small() };
    assert_ne!(
        simulate(&small()).street.surface,
        simulate(&other).street.surface
    );
}

#[test]
fn oncoming_cars_come_nearer_at_their_speed() {
    let config = SimulationConfig {
        traffic: TrafficConfig {
            oncoming_spacing_m: 30.0,
            oncoming_speed_m_s: 10.0,
            ..NO_TRAFFIC
        },
        ..small()
    };
    let simulation = simulate(&config);
    let before = simulation.traffic_at(0).mesh;
    let after = simulation.traffic_at(1).mesh;
    assert!(!before.vertices.is_empty());
    let shared = before.vertices.len().min(after.vertices.len());
    let mut moved = 0;
    for (a, b) in before.vertices[..shared].iter().zip(&after.vertices) {
        // A metre in a tenth of a second; a little more or less off the path in a bend.
        if (a.distance(*b) - 1.0).abs() < 0.2 {
            moved += 1;
        }
    }
    assert!(moved > shared / 2, "{moved} of {shared}");
}

#[test]
fn an_empty_street_has_no_moving_points() {
    let simulation = simulate(&SimulationConfig {
        traffic: NO_TRAFFIC,
        ..small()
    });
    for frame in [0, 40] {
        let labelled = simulation.scan(frame);
        assert!(!labelled.classes.iter().any(|&c| is_moving(c)));
    }
}

#[test]
fn a_kidnapped_vehicle_is_displaced_without_its_odometry_noticing() {
    let kidnapped_at = |frame| SimulationConfig {
        motion: MotionConfig {
            kidnapped_at_frame: frame,
            kidnapped_by_m: 20.0,
            ..MotionConfig::default()
        },
        odometry: SimulatedOdometryConfig {
            scale_error: 0.0,
            heading_drift_deg_per_m: 0.0,
            step_noise_m: 0.0,
            turn_noise_deg: 0.0,
        },
        ..small()
    };
    let simulation = simulate(&kidnapped_at(Some(10)));
    let step_m = |poses: &[Pose3], frame: usize| {
        (poses[frame].translation.vector - poses[frame - 1].translation.vector).norm()
    };
    let (poses, reported) = (simulation.poses(), simulation.odometry());
    assert!(step_m(&poses, 10) > 18.0);
    for frame in 1..poses.len() {
        assert!(step_m(&reported, frame) < 1.5, "frame {frame}");
        if frame != 10 {
            assert!(step_m(&poses, frame) < 1.5, "frame {frame}");
        }
    }
    // Before, the drive is the same as without.
    let undisturbed = simulate(&kidnapped_at(None)).poses();
    assert_eq!(poses[..10], undisturbed[..10]);
    // During the last revolution before, the vehicle continues at its speed.
    let last_s = 9.0 * SCAN_PERIOD_S;
    let drive = &simulation.ego_motion;
    assert!(drive.station_m(last_s + 0.09) - drive.station_m(last_s) < 1.5);
    // A drive that ends before is not affected.
    let short = SimulationConfig {
        n_scans: 8,
        ..kidnapped_at(Some(10))
    };
    assert_eq!(simulate(&short).odometry().len(), 8);
    let beyond = Simulation::new(&kidnapped_at(Some(70)), None, MemoryBudget::default());
    assert!(matches!(
        beyond,
        Err(SimulationError::KidnappedBeyondPath { frame: 70, .. })
    ));
}

#[test]
fn the_first_and_the_last_revolution_begin_and_end_without_a_jerk() {
    let simulation = simulate(&small());
    let last_s = (simulation.poses().len() - 1) as f64 * SCAN_PERIOD_S;
    for end_s in [0.0, last_s] {
        let [before, end, after] =
            [-0.04, 0.0, 0.04].map(|later_s| simulation.world_from_lidar(end_s + later_s));
        let [into, out_of] = [before.inverse() * end, end.inverse() * after];
        assert!(into.translation.vector.norm() > 0.01);
        let change = into.inverse() * out_of;
        assert!(change.translation.vector.norm() < 1e-9 && change.rotation.angle() < 1e-9);
    }
}

#[test]
fn a_lorry_occludes_the_left_side_for_its_duration() {
    let simulation = simulate(&SimulationConfig {
        traffic: TrafficConfig {
            lorry_from_s: Some(1.0),
            lorry_for_s: 2.0,
            ..NO_TRAFFIC
        },
        ..small()
    });
    let share_of_lorry = |frame: usize| {
        let labelled = simulation.scan(frame);
        let to_the_left = labelled
            .scan
            .points
            .iter()
            .zip(&labelled.classes)
            .filter(|(p, _)| p.y > 0.6 * p.x.abs() && p.z > -0.5);
        let (all, hidden) = to_the_left.fold((0, 0), |(all, hidden), (_, &class)| {
            (all + 1, hidden + usize::from(is_moving(class)))
        });
        hidden as f64 / all.max(1) as f64
    };
    assert_eq!(share_of_lorry(9), 0.0);
    for frame in [10, 20, 29] {
        assert!(share_of_lorry(frame) > 0.8, "{}", share_of_lorry(frame));
    }
    assert_eq!(share_of_lorry(30), 0.0);
}

#[test]
fn a_lorry_before_the_start_or_at_no_finite_time_is_an_error() {
    for lorry_from_s in [-1.0, f64::NAN, f64::INFINITY] {
        let mut config = small();
        config.traffic.lorry_from_s = Some(lorry_from_s);
        let message = config.validate().unwrap_err().to_string();
        assert!(message.contains("traffic.lorry_from_s"), "{message}");
    }
}

#[test]
fn the_lidar_has_its_height_above_the_road_and_the_slope_of_it() {
    let config = SimulationConfig {
        motion: MotionConfig {
            nodding_deg: 0.0,
            rolling_deg: 0.0,
            heaving_m: 0.0,
            ..MotionConfig::default()
        },
        ..small()
    };
    let simulation = simulate(&config);
    let ground = &simulation.street.ground;
    for (frame, pose) in simulation.poses().iter().enumerate() {
        let up = pose.rotation * nalgebra::Vector3::z();
        let foot = pose.translation.vector - 1.73 * up;
        let height_m = f64::from(ground.point_at(DVec2::new(foot.x, foot.y)).z);
        assert_relative_eq!(foot.z, height_m, epsilon = 0.03);
        // The slope of 6 % begins at 25 m, rounded over a few metres.
        let nose = (pose.rotation * nalgebra::Vector3::x()).z;
        let station_m = simulation
            .ego_motion
            .station_m(frame as f64 * SCAN_PERIOD_S);
        if station_m < 10.0 {
            assert_relative_eq!(nose, 0.0, epsilon = 0.01);
        } else if station_m > 38.0 && station_m < 50.0 {
            assert_relative_eq!(nose, 0.06, epsilon = 0.015);
        }
    }
}

#[test]
fn a_path_that_crosses_itself_has_one_ground() {
    // A loop of 400 degrees that climbs one metre: the crossing is where both heights meet.
    let path = Centreline::from_segments(&[PathSegment::new(260.0, 400.0, 0.4)], 0.0);
    let ground = Street::new(&path, &StreetConfig::default(), 1).ground;
    let mut previous = ground.at(path.at(0.0).position).height_m;
    for step in 1..=5200 {
        let height_m = ground.at(path.at(0.05 * f64::from(step)).position).height_m;
        let rise = (height_m - previous).abs() / 0.05;
        assert!(rise < 0.15, "a step of {rise} at {step}");
        previous = height_m;
    }
}

#[test]
fn kitti_07_closes_its_loop() {
    let Some(recorded) = kitti_07() else { return };
    let config = SimulationConfig {
        motion: MotionConfig {
            nodding_deg: 0.0,
            rolling_deg: 0.0,
            heaving_m: 0.0,
            ..MotionConfig::default()
        },
        ..SimulationConfig::default()
    };
    let simulation = Simulation::new(&config, Some(&recorded), MemoryBudget::default()).unwrap();
    assert_eq!(simulation.frames(), 1101);
    let poses = simulation.poses();
    for (simulated, recorded) in poses.iter().zip(&recorded) {
        let apart = simulated.translation.vector - recorded.translation.vector;
        assert!(apart.xy().norm() < 2.0, "{apart}");
        assert!(apart.z.abs() < 0.4, "{apart}");
    }
    let mut crossings = 0;
    for i in (0..poses.len()).step_by(3) {
        for j in (i + 300..poses.len()).step_by(3) {
            let apart = poses[i].translation.vector - poses[j].translation.vector;
            if apart.xy().norm() < 4.0 {
                crossings += 1;
                assert!(apart.z.abs() < 0.1 * apart.xy().norm() + 0.05, "{apart}");
            }
        }
    }
    assert!(crossings > 20, "{crossings}");
}

#[test]
fn a_second_drive_along_a_recorded_path_varies_in_speed() {
    let recorded: Vec<Pose3> = (0..200)
        .map(|frame| Pose3::translation(0.6 * f64::from(frame), 0.0, 0.0))
        .collect();
    let drive = |drive| {
        let config = SimulationConfig { drive, ..small() };
        Simulation::new(&config, Some(&recorded), MemoryBudget::default()).unwrap()
    };
    let (first, second) = (drive(1), drive(2));
    assert_eq!(first.frames(), second.frames());
    let apart_m: Vec<f64> = (0..200)
        .map(|frame| {
            let time_s = f64::from(frame) * SCAN_PERIOD_S;
            first.ego_motion.station_m(time_s) - second.ego_motion.station_m(time_s)
        })
        .collect();
    assert!(apart_m.iter().any(|apart_m| apart_m.abs() > 1.0));
    assert!(second.poses().windows(2).all(|pair| {
        let step = pair[0].inverse() * pair[1];
        step.translation.x > -1e-3 && step.translation.x < 0.9
    }));
}

#[test]
fn the_street_in_the_map_frame_has_the_ranges_of_the_first_scan() {
    let simulation = simulate(&small());
    let scene = crate::raycasting::Scene::new(&simulation.street_in_map());
    let labelled = simulation.scan(0);
    let directions: Vec<Vec3> = labelled.scan.points.iter().map(|p| p.normalize()).collect();
    let mut hits = vec![crate::raycasting::Hit::MISS; directions.len()];
    scene.cast(Vec3::ZERO, &directions, &mut hits);
    for ((point, hit), &class) in labelled
        .scan
        .points
        .iter()
        .zip(&hits)
        .zip(&labelled.classes)
    {
        if !is_moving(class) {
            let difference_m = (point.length() - hit.range_m).abs();
            // Six sigma, but for beams that graze an edge after rounding.
            assert!(difference_m < 0.12 || hit.range_m > 20.0, "{difference_m}");
        }
    }
}

#[test]
fn invalid_values_are_reported_with_their_key() {
    let mut config = small();
    config.scanner.min_range_m = 100.0;
    let message = config.validate().unwrap_err().to_string();
    assert!(message.contains("scanner.min_range_m is 100"), "{message}");
    config = small();
    config.street.parked_share = 1.5;
    let message = config.validate().unwrap_err().to_string();
    assert!(message.contains("street.parked_share is 1.5"), "{message}");
    config = small();
    config.path[1].length_m = -5.0;
    let message = config.validate().unwrap_err().to_string();
    assert!(message.contains("path.2.length_m is -5"), "{message}");
    config = small();
    config.path.clear();
    let message = Simulation::new(&config, None, MemoryBudget::default())
        .err()
        .unwrap()
        .to_string();
    assert!(message.contains("the path is"), "{message}");
}

#[test]
fn the_default_configuration_is_the_file_in_config() {
    let file: SimulationConfig =
        serde_yaml::from_str(include_str!("../../config/simulation.yml")).unwrap();
    assert_eq!(file, SimulationConfig::default());
}

#[test]
fn changes_leave_everything_else_of_the_street_where_it_is() {
    let count = |street: &Street, class: u16| {
        let materials = street.surface.materials.iter();
        materials.filter(|material| material.class == class).count()
    };
    let changed = |changes: ChangesConfig| {
        let mut config = small();
        config.street.changes = changes;
        simulate(&config).street
    };
    let before = changed(ChangesConfig::default());
    let others = changed(ChangesConfig {
        parked_cars: true,
        ..ChangesConfig::default()
    });
    let vertices_of = |street: &Street, class: u16| -> Vec<Vec3> {
        let LabelledMesh { mesh, materials } = &street.surface;
        let chosen = (0..materials.len()).filter(|&k| materials[k].class == class);
        chosen.flat_map(|triangle| mesh.corners(triangle)).collect()
    };
    use classes::{BUILDING, CAR, POLE, TRUNK, VEGETATION};
    for class in [BUILDING, POLE, TRUNK, VEGETATION] {
        assert_eq!(
            vertices_of(&before, class),
            vertices_of(&others, class),
            "{class}"
        );
    }
    assert_ne!(vertices_of(&before, CAR), vertices_of(&others, CAR));
    assert!(count(&others, CAR) > 0);

    let demolished = changed(ChangesConfig {
        demolished_share: 0.5,
        ..ChangesConfig::default()
    });
    let share = count(&demolished, BUILDING) as f64 / count(&before, BUILDING) as f64;
    assert!((0.2..0.8).contains(&share), "{share}");
    assert_eq!(
        vertices_of(&before, VEGETATION),
        vertices_of(&demolished, VEGETATION)
    );

    let grown = changed(ChangesConfig {
        foliage_m: 0.3,
        ..ChangesConfig::default()
    });
    assert_eq!(vertices_of(&before, TRUNK), vertices_of(&grown, TRUNK));
    let (old, new) = (
        vertices_of(&before, VEGETATION),
        vertices_of(&grown, VEGETATION),
    );
    let shifts = old
        .iter()
        .zip(&new)
        .map(|(a, b)| (*b - *a).abs().max_element());
    let shifts: Vec<f32> = shifts.collect();
    assert!(shifts.iter().all(|&shift_m| shift_m < 0.301));
    assert!(shifts.iter().sum::<f32>() / shifts.len() as f32 > 0.1);
}

#[test]
fn given_poses_of_delayed_stamps_are_those_of_later() {
    let mut config = small();
    config.given_poses.delay_s = 0.1;
    let simulation = simulate(&config);
    let (truth, given) = (simulation.poses(), simulation.given_poses());
    for (next, given) in truth[1..].iter().zip(&given) {
        assert_relative_eq!(next, given, epsilon = 1e-9);
    }
    // Drive 1 itself is where its given poses are.
    for (in_map, given) in simulation.poses_in_map().iter().zip(&given) {
        assert_relative_eq!(in_map, given, epsilon = 1e-9);
    }
}
