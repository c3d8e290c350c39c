//! Laws of trajectories of whole drives, on scans of a drawn world.

use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use rand::{SeedableRng as _, rngs::StdRng};
use rand_distr::{Distribution as _, StandardNormal};

use super::super::tests::{World, drive};
use super::*;
use crate::inertial::{GRAVITY_M_S2, ImuSample, ImuSamples};

/// A scan of the world every 0.25 s from a time on.
fn scans(world: &World, first_s: f64, count: usize) -> (Vec<Scan>, Vec<Pose3>) {
    let times_s = (0..count).map(|number| first_s + 0.25 * number as f64);
    times_s
        .map(|time_s| {
            let mut scan = world.scan(|_| drive(time_s), None);
            scan.time_s = Some(time_s);
            (scan, drive(time_s))
        })
        .unzip()
}

fn noise(rng: &mut StdRng, shift_m: f64, turn_deg: f64) -> Pose3 {
    let mut vector = |sigma: f64| {
        Vector3::from_fn(|_, _| {
            let deviate: f64 = StandardNormal.sample(rng);
            sigma * deviate
        })
    };
    Pose3::new(vector(shift_m), vector(turn_deg.to_radians()))
}

/// Adds scans with the estimates of an odometry that drifts in each step; returns its last pose.
fn add_drifting(
    builder: &mut TrajectoryBuilder,
    scans: &[Scan],
    truth: &[Pose3],
    drift: Pose3,
) -> Pose3 {
    let mut drifted = Pose3::identity();
    for (row, scan) in scans.iter().enumerate() {
        builder.keep(scan).unwrap();
        let motion = match row {
            0 => Pose3::identity(),
            row => truth[row - 1].inverse() * truth[row] * drift,
        };
        drifted *= motion;
        builder.estimates.push(OdometryEstimate {
            odom_from_lidar: drifted,
            previous_from_current: motion,
            state: StepState::Registered,
            ..OdometryEstimate::first(0.25)
        });
    }
    drifted
}

#[test]
fn the_samples_of_all_scans_are_within_the_budget_of_memory() {
    let (scans, _) = scans(&World::around_a_block(), 0.0, 2);
    let points = |count: usize| -> usize {
        let mut builder = TrajectoryBuilder::new(TrajectoryConfig::default()).unwrap();
        let added = scans[..count]
            .iter()
            .map(|scan| builder.keep(scan).unwrap());
        added.for_each(drop);
        builder
            .samples
            .iter()
            .map(|sample| sample.points.len())
            .sum()
    };
    let (one, both) = (points(1), points(2));
    assert!(one > 0 && both > one);
    let needs = |count: usize| (count as f64 * POINT_BYTES) as u64;
    for (bytes, is_enough) in [
        (needs(both), true),
        (needs(both) - 1, false),
        (needs(one), false),
    ] {
        let mut builder = TrajectoryBuilder::new(TrajectoryConfig::default())
            .unwrap()
            .with_memory_budget(MemoryBudget { bytes });
        assert!(builder.keep(&scans[0]).is_ok());
        assert_eq!(builder.keep(&scans[1]).is_ok(), is_enough);
    }
}

#[test]
fn the_time_between_given_poses_is_that_of_their_scans_or_a_period_where_these_do_not_ascend() {
    let mut builder = TrajectoryBuilder::new(TrajectoryConfig::default()).unwrap();
    for time_s in [None, Some(7.0), Some(7.25), Some(7.25), Some(7.2), None] {
        let scan = Scan {
            time_s,
            ..Scan::default()
        };
        builder.add_given(&scan, Pose3::identity()).unwrap();
    }
    let expected_s = [PERIOD_S, PERIOD_S, 0.25, PERIOD_S, PERIOD_S, PERIOD_S];
    assert_eq!(builder.estimates.len(), expected_s.len());
    for (found, expected_s) in builder.estimates.iter().zip(expected_s) {
        assert!((found.duration_s - expected_s).abs() < 1e-9, "{found:?}");
    }
}

#[test]
fn times_of_scans_are_the_sums_of_the_intervals_since_the_first() {
    let estimates = [9.0, 0.25, 0.5, 0.25].map(OdometryEstimate::first);
    assert_eq!(times_s(&estimates), [0.0, 0.25, 0.75, 1.0]);
    assert!(times_s(&[]).is_empty());
}

fn distance_m(a: &Pose3, b: &Pose3) -> f64 {
    (a.translation.vector - b.translation.vector).norm()
}

#[test]
fn given_poses_that_are_disturbed_by_5_cm_come_back_to_1_cm_in_their_frame() {
    let (scans, truth) = scans(&World::around_a_block(), 0.0, 24);
    let mut rng = StdRng::seed_from_u64(3);
    let given: Vec<Pose3> = (truth.iter())
        .map(|pose| pose * noise(&mut rng, 0.05, 0.1))
        .collect();
    let mut builder = TrajectoryBuilder::new(TrajectoryConfig::default()).unwrap();
    for (scan, pose) in scans.iter().zip(&given) {
        builder.add_given(scan, *pose).unwrap();
    }
    let found = builder.finish().unwrap().poses;
    let errors = |poses: &[Pose3]| {
        let motion = |poses: &[Pose3], row: usize| poses[row - 8].inverse() * poses[row];
        let rows = 8..poses.len();
        let squares = rows.map(|row| distance_m(&motion(poses, row), &motion(&truth, row)).powi(2));
        (squares.sum::<f64>() / (poses.len() - 8) as f64).sqrt()
    };
    let (before, after) = (errors(&given), errors(&found));
    assert!(before > 0.05 && after < 0.01, "{before} {after}");
    let farthest = (found.iter().zip(&given)).map(|(a, b)| distance_m(a, b));
    assert!(farthest.fold(0.0, f64::max) < 0.3);
}

#[test]
fn a_round_closes_its_loop_and_takes_the_drift_away() {
    // A round takes 25 s; the drive goes on for a fifth of another.
    let (scans, truth) = scans(&World::around_a_block(), 0.0, 120);
    let mut builder = TrajectoryBuilder::new(TrajectoryConfig {
        adjust: false,
        ..TrajectoryConfig::default()
    })
    .unwrap();
    let drift = Pose3::new(
        Vector3::new(0.01, 0.0, 0.005),
        Vector3::new(0.0, 0.0, 0.0006),
    );
    let drifted = add_drifting(&mut builder, &scans, &truth, drift);
    let mut strict = builder.clone();
    strict.config.loop_closure.min_common_share = 1.0;
    assert!(strict.finish().unwrap().loops.is_empty());
    let found = builder.finish().unwrap();
    let error_m = |pose: &Pose3| distance_m(pose, &(truth[0].inverse() * truth[119]));
    let before = error_m(&drifted);
    let after = error_m(&found.poses[119]);
    assert!(before > 1.5 && after < 0.2 * before, "{before} {after}");
    let accepted = (found.loops.iter()).filter(|it| it.verdict == LoopVerdict::Accepted);
    assert!(accepted.clone().count() >= 2, "{:?}", found.loops);
    for found in accepted {
        let true_transform = truth[found.first].inverse() * truth[found.second];
        let error_m = distance_m(&found.first_from_second, &true_transform);
        assert!(error_m < 0.1, "{found:?}");
    }
}

#[test]
fn a_loop_that_no_other_confirms_does_not_move_the_poses() {
    let poses: Vec<Pose3> = (0..12_u8)
        .map(|row| Pose3::translation(10.0 * f64::from(row), 0.0, 0.0))
        .collect();
    let mut drive = Drive {
        samples: vec![],
        times_s: vec![],
        poses: poses.clone(),
        range_m: 50.0,
        voxel_m: 0.5,
        levels: None,
    };
    let maps = drive.submaps(5.0);
    let edges = odometry_edges(&drive, &maps, &vec![OdometryEstimate::first(0.1); 12]);
    let drift = Drift {
        share: 0.02,
        least_m: 0.5,
    };
    let found = |first: usize, second: usize, off_m: f64| FoundLoop {
        maps: [first, second],
        first_from_second: Pose3::translation(10.0 * (second - first) as f64, off_m, 0.0),
        covariance: nalgebra::Matrix6::identity() * 1e-4,
        common_share: 0.8,
    };
    let config = LoopConfig::default();
    let mut close = |found: &[FoundLoop]| {
        let loops = close(&mut drive, &maps, &edges, found, drift, &config);
        let verdicts: Vec<LoopVerdict> = loops.iter().map(|it| it.verdict).collect();
        (verdicts, drive.poses.clone())
    };
    let (verdicts, unmoved) = close(&[found(0, 9, 0.5)]);
    assert_eq!(verdicts, [LoopVerdict::Unconfirmed]);
    assert_eq!(unmoved, poses);
    let (verdicts, moved) = close(&[found(0, 9, 0.5), found(2, 11, 0.5)]);
    assert_eq!(verdicts, [LoopVerdict::Accepted; 2]);
    assert!(moved[11].translation.y > 0.25, "{}", moved[11]);
}

#[test]
fn an_impossible_limit_of_loops_is_named() {
    let mut config = TrajectoryConfig::default();
    config.loop_closure.min_common_share = 1.5;
    let error = TrajectoryBuilder::new(config).unwrap_err();
    assert_eq!(error.key, "loop_closure.min_common_share");
}

/// The walls, ground and boxes that a drawn world consists of, as a mesh in the frame of the first of some scans.
fn surfaces_of(scans: &[Scan], poses: &[Pose3]) -> TriangleMesh {
    let mut mesh = TriangleMesh::default();
    for (scan, pose) in scans.iter().zip(poses) {
        for point in &scan.points {
            // Tiny triangles in the plane of the walls or of the ground.
            let at = pose * nalgebra::Point3::from(point.as_dvec3());
            let at = glam::DVec3::from(at.coords).as_vec3();
            let first = mesh.vertices.len() as u32;
            mesh.vertices.extend([at; 3]);
            mesh.triangles.push([first, first + 1, first + 2]);
        }
    }
    mesh
}

#[test]
fn a_drive_that_leaves_a_map_is_in_its_frame_although_one_pose_in_it_is_wrong() {
    let world = World::around_a_block();
    let (mapped, mapped_poses) = scans(&world, 0.0, 24);
    let mesh = surfaces_of(&mapped, &mapped_poses);
    // The second drive begins in the map and leaves it; its poses in the map are rough.
    let (second, truth) = scans(&world, 1.1, 28);
    let mut builder = TrajectoryBuilder::new(TrajectoryConfig::default()).unwrap();
    for scan in &second {
        builder.add(scan).unwrap();
    }
    let mut rng = StdRng::seed_from_u64(5);
    let mut found: Vec<Option<Pose3>> = (truth.iter().enumerate())
        .map(|(row, pose)| (row < 14).then(|| pose * noise(&mut rng, 0.05, 0.3)))
        .collect();
    found[2] = Some(truth[2] * Pose3::translation(8.0, 3.0, 0.0));
    let trajectory = builder.clone().finish_in_map(&mesh, &found).unwrap();
    let errors_m: Vec<f64> = (trajectory.poses.iter().zip(&truth))
        .map(|(pose, truth)| distance_m(pose, truth))
        .collect();
    let inside_m = errors_m[..14].iter().fold(0.0_f64, |a, b| a.max(*b));
    let last_m = errors_m[27];
    assert!(inside_m < 0.02 && last_m < 0.05, "{errors_m:?}");

    let nowhere = builder.clone().finish_in_map(&mesh, &[None; 28]);
    assert_eq!(nowhere.unwrap_err(), NotInMap.into());
    // A map of what the scans see on their left.
    let of_left = |scan: &Scan| Scan {
        points: scan
            .points
            .iter()
            .copied()
            .filter(|point| point.y > 0.0)
            .collect(),
        ..Scan::default()
    };
    let left: Vec<Scan> = mapped.iter().map(of_left).collect();
    builder.config.loop_closure.min_common_share = 1.0;
    let strict = builder.finish_in_map(&surfaces_of(&left, &mapped_poses), &found);
    let refused = strict.unwrap_err();
    let PlacementError::FewCommonSurfaces { share, least: 1.0 } = refused else {
        panic!("{refused}");
    };
    assert!((0.1..0.9).contains(&share), "{share}");
    assert!(
        refused
            .to_string()
            .contains("more than 100.0 % are required")
    );
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let (scans, _) = scans(&World::crossing(), 0.0, 8);
    let poses = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap().install(|| {
            let mut builder = TrajectoryBuilder::new(TrajectoryConfig::default()).unwrap();
            for scan in &scans {
                builder.add(scan).unwrap();
            }
            builder.finish().unwrap().poses
        })
    };
    assert_eq!(poses(1), poses(3));
}

#[test]
fn scans_without_points_have_poses() {
    let mut builder = TrajectoryBuilder::new(TrajectoryConfig::default()).unwrap();
    assert_eq!(builder.clone().finish().unwrap().poses, []);
    for _ in 0..3 {
        builder.add(&Scan::default()).unwrap();
    }
    assert_eq!(builder.finish().unwrap().poses, [Pose3::identity(); 3]);
}

#[test]
fn the_bias_of_the_elevations_follows_from_surfaces_seen_from_far_and_near() {
    let (scans, _) = scans(&World::around_a_block(), 0.0, 24);
    let found_deg = |bias_deg: f64| {
        let mut builder = TrajectoryBuilder::new(TrajectoryConfig::default()).unwrap();
        for scan in &scans {
            let mut scan = scan.clone();
            scan.raise(-bias_deg.to_radians());
            builder.add(&scan).unwrap();
        }
        let adjusted = builder.finish().unwrap().adjusted.unwrap();
        adjusted.elevation_bias.unwrap()
    };
    let none = found_deg(0.0);
    assert!(none.deg.abs() < 0.03, "{none:?}");
    for bias_deg in [-0.3, 0.3] {
        let found = found_deg(bias_deg);
        assert!((found.deg / bias_deg - 1.0).abs() < 0.4, "{found:?}");
        assert!(found.deg.abs() > 4.0 * found.sigma_deg, "{found:?}");
    }
}

/// Measurements of a sensor with the axes of the lidar on the drawn drive, in a world that leans by a rotation.
fn inertial(leaning: UnitQuaternion<f64>, seconds: usize, offset_s: f64) -> Imu {
    const PERIOD_S: f64 = 0.01;
    let at = |row: i32| {
        let pose = drive(PERIOD_S * f64::from(row));
        Pose3::from_parts(
            (leaning * pose.translation.vector).into(),
            leaning * pose.rotation,
        )
    };
    let rows = -50..100 * seconds as i32;
    let samples = rows.map(|row| {
        let [before, here, after] = [row - 1, row, row + 1].map(at);
        let [p, q, r] = [before, here, after].map(|pose| pose.translation.vector);
        let force = (r - q * 2.0 + p) / PERIOD_S.powi(2) + Vector3::z() * GRAVITY_M_S2;
        let turn = (before.rotation.inverse() * after.rotation).scaled_axis();
        ImuSample {
            time_s: PERIOD_S * f64::from(row) + offset_s,
            rate_rad_s: turn / (2.0 * PERIOD_S) + Vector3::new(0.01, -0.02, 0.01),
            force_m_s2: here.rotation.inverse() * force + Vector3::new(0.1, -0.05, 0.02),
        }
    });
    Imu {
        samples: Arc::new(ImuSamples::new(samples.collect()).unwrap()),
        lidar_from_imu: None,
    }
}

#[test]
fn with_an_inertial_sensor_a_drive_is_level_after_loops_and_adjustment() {
    let (scans, truth) = scans(&World::around_a_block(), 0.0, 120);
    let mut builder = TrajectoryBuilder::new(TrajectoryConfig::default()).unwrap();
    let drift = Pose3::rotation(Vector3::new(0.0003, 0.0006, 0.0));
    add_drifting(&mut builder, &scans, &truth, drift);
    let leaning = UnitQuaternion::from_euler_angles(0.05, -0.03, 0.0);
    let tilt_deg = |poses: &[Pose3]| {
        let of_row = |row: usize| {
            let up = (leaning * truth[row].rotation).inverse() * Vector3::z();
            let found = poses[row].rotation.inverse() * Vector3::z();
            up.angle(&found).to_degrees()
        };
        (0..poses.len()).map(of_row).fold(0.0, f64::max)
    };
    let without = builder.clone().finish().unwrap();
    let with = (builder.clone().with_imu(inertial(leaning, 32, 0.03)))
        .finish()
        .unwrap();
    let found = with.inertial.unwrap();
    let tilts = (tilt_deg(&without.poses), tilt_deg(&with.poses));
    eprintln!("{tilts:?} deg, {found:?}");
    assert!(tilts.0 > 2.5 && tilts.1 < 0.15, "{tilts:?}");
    assert!(
        (found.calibration.offset_s - 0.03).abs() < 0.01,
        "{found:?}"
    );
    assert!(with.poses[0].translation.vector.norm() < 1e-6);
    assert!(crate::geometry::yaw(&with.poses[0]).abs() < 0.005);
    // One whose clock is another leaves everything as it is.
    let other = builder
        .with_imu(inertial(leaning, 32, 1e6))
        .finish()
        .unwrap();
    assert_eq!(other, without);
}
