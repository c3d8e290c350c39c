//! Laws of a path that follows fixes.

use nalgebra::UnitQuaternion;
use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};
use rand_distr::StandardNormal;

use super::super::level::Levels;
use super::super::sampling::Sample;
use super::*;
use crate::georeference::{Geodetic, GeodeticFix, Georeference, HeightReference, UtmZone};

/// A drive around a block twice, 10 m/s, and its times.
fn truth() -> (Vec<Pose3>, Vec<f64>) {
    let times_s: Vec<f64> = (0..1500).map(|row| 0.1 * f64::from(row)).collect();
    let pose = |time_s: &f64| {
        let angle = time_s / 12.0;
        let position = Vector3::new(120.0 * angle.sin(), 120.0 * (1.0 - angle.cos()), 0.0);
        let rotation = UnitQuaternion::from_euler_angles(0.0, 0.0, angle);
        Pose3::from_parts(position.into(), rotation)
    };
    (times_s.iter().map(pose).collect(), times_s)
}

/// What odometry with a bias of its turns finds: metres off after two rounds.
fn drifting(truth: &[Pose3]) -> Drive {
    drifting_by(truth, Vector3::new(0.0, 1e-5, 6e-5))
}

/// The same with another bias per scan [rad].
fn drifting_by(truth: &[Pose3], bias_rad: Vector3<f64>) -> Drive {
    let bias = Pose3::new(Vector3::zeros(), bias_rad);
    let mut poses = vec![truth[0]];
    for pair in truth.windows(2) {
        let step = pair[0].inverse() * pair[1];
        poses.push(poses[poses.len() - 1] * step * bias);
    }
    Drive {
        samples: vec![Sample::empty(); poses.len()],
        times_s: (0..poses.len()).map(|row| 0.1 * row as f64).collect(),
        poses,
        range_m: 80.0,
        voxel_m: 0.8,
        levels: None,
    }
}

/// Fixes of the true path; one of twelve is moved by `reflected_m`.
fn fixes(truth: &[Pose3], times_s: &[f64], sigma_m: f64, reflected_m: f64) -> GnssConstraints {
    let origin = Geodetic {
        latitude_deg: 49.0,
        longitude_deg: 8.4,
        height_m: 110.0,
    };
    let place = Georeference {
        latitude_deg: origin.latitude_deg,
        longitude_deg: origin.longitude_deg,
        height_m: origin.height_m,
        height_above: HeightReference::Ellipsoid,
        roll_deg: 0.0,
        pitch_deg: 0.0,
        yaw_deg: 70.0,
        utm: UtmZone::of(&origin),
        horizontal_m: 0.0,
        vertical_m: 0.0,
        heading_deg: 0.0,
    };
    let earth = place.on_earth().unwrap();
    let mut rng = StdRng::seed_from_u64(1);
    let fix = |row: usize| {
        let noise = Vector3::from_fn(|_, _| sigma_m * rng.sample::<f64, _>(StandardNormal));
        let is_reflected = row / 10 % 12 == 7;
        let reflection = if is_reflected { reflected_m } else { 0.0 };
        let moved = noise + Vector3::new(reflection, -reflection, reflection);
        GeodeticFix {
            time_s: times_s[row],
            position: earth
                .geodetic(&(truth[row].translation.vector + moved))
                .unwrap(),
            horizontal_m: Some(sigma_m.max(0.01)),
            vertical_m: Some(sigma_m.max(0.01)),
        }
    };
    GnssConstraints {
        fixes: GeodeticFixes {
            path: "fixes".into(),
            fixes: (0..truth.len()).step_by(5).map(fix).collect(),
            height_above: HeightReference::Ellipsoid,
            without_position: 0,
            bad_lines: 0,
            antenna_m: None,
        },
        config: GnssConfig {
            correlation_s: 0.2,
            ..GnssConfig::default()
        },
    }
}

/// Root mean square of the distances of a path from the true one, aligned as a whole, horizontal and vertical [m].
fn errors_m(poses: &[Pose3], truth: &[Pose3], times_s: &[f64]) -> [f64; 2] {
    let exact = fixes(truth, times_s, 0.0, 0.0);
    let path = PathOverTime {
        times_s,
        map_from_lidar: poses,
    };
    let targets = align(path, &exact.fixes, &exact.config).unwrap().targets;
    let mean = |square: &dyn Fn(Vector3<f64>) -> f64| {
        let squares = targets
            .iter()
            .map(|it| square(it.fix_in_map - it.antenna_in_map));
        (squares.sum::<f64>() / targets.len() as f64).sqrt()
    };
    [mean(&|it| it.xy().norm_squared()), mean(&|it| it.z.powi(2))]
}

fn odometry(count: usize) -> Vec<OdometryEstimate> {
    vec![OdometryEstimate::first(0.1); count]
}

#[test]
fn a_path_that_drifts_follows_the_fixes_and_not_those_that_are_reflected() {
    let (truth, times_s) = truth();
    let before = errors_m(&drifting(&truth).poses, &truth, &times_s);
    assert!(before[0] > 1.0, "{before:?}");
    for reflected_m in [0.0, 40.0] {
        let mut drive = drifting(&truth);
        let gnss = fixes(&truth, &times_s, 0.5, reflected_m);
        bend(&mut drive, &times_s, &odometry(truth.len()), &[], &gnss).unwrap();
        let after = errors_m(&drive.poses, &truth, &times_s);
        assert!(
            after[0] < 0.25 * before[0] && after[1] < 0.4,
            "{before:?} {after:?}"
        );
        assert!((drive.poses[0].translation.vector - truth[0].translation.vector).norm() < 1e-9);
    }
}

#[test]
fn a_path_that_is_right_stays() {
    let (truth, times_s) = truth();
    let mut drive = Drive {
        poses: truth.clone(),
        ..drifting(&truth)
    };
    let gnss = fixes(&truth, &times_s, 0.0, 0.0);
    bend(&mut drive, &times_s, &odometry(truth.len()), &[], &gnss).unwrap();
    let errors = (drive.poses.iter().zip(&truth))
        .map(|(a, b)| (a.translation.vector - b.translation.vector).norm());
    let largest_m = errors.fold(0.0, f64::max);
    assert!(largest_m < 0.02, "{largest_m}");
}

#[test]
fn a_path_that_follows_fixes_keeps_the_directions_up_of_an_accelerometer() {
    let (truth, times_s) = truth();
    let mut gnss = fixes(&truth, &times_s, 0.5, 0.0);
    // Heights that do not show the tilt of the path.
    for fix in &mut gnss.fixes.fixes {
        fix.vertical_m = Some(30.0);
    }
    let drifting = drifting_by(&truth, Vector3::new(0.0, 1e-4, 6e-5));
    let bent = |levels: Option<Levels>| {
        let mut drive = Drive {
            levels,
            ..drifting.clone()
        };
        bend(&mut drive, &times_s, &odometry(truth.len()), &[], &gnss).unwrap();
        let up = |pose: &Pose3| pose.rotation.inverse() * Vector3::z();
        let tilts = zip(&drive.poses, &truth).map(|(found, truth)| up(found).angle(&up(truth)));
        let tilt_deg = (tilts.sum::<f64>() / truth.len() as f64).to_degrees();
        (tilt_deg, errors_m(&drive.poses, &truth, &times_s)[0])
    };
    let before_m = errors_m(&drifting.poses, &truth, &times_s)[0];
    let (without_deg, _) = bent(None);
    let (with_deg, with_m) = bent(Some(Levels::new(vec![Vector3::z(); truth.len()], 1e6)));
    assert!(without_deg > 0.3, "{without_deg}");
    assert!(with_deg < 0.3 * without_deg, "{without_deg} {with_deg}");
    // They are followed in the plane as without.
    assert!(with_m < 0.5 * before_m, "{before_m} {with_m}");
}
