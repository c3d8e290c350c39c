use std::f64::consts::FRAC_PI_2;

use super::*;
use crate::odometry::tests::{World, drive, drive_scans};

/// Poses of the lidar on a curve, ten times per second.
fn lidar_poses() -> Vec<Pose3> {
    let start = drive(3.0).inverse();
    (30..42)
        .map(|row| start * drive(0.1 * f64::from(row)))
        .collect()
}

fn motions() -> Vec<Option<Pose3>> {
    let poses = lidar_poses();
    let motions = poses
        .windows(2)
        .map(|pair| Some(pair[0].inverse() * pair[1]));
    std::iter::once(None).chain(motions).collect()
}

fn calibration() -> Pose3 {
    Pose3::translation(0.1, -0.1, -0.3) * camera_from_lidar()
}

/// The check of rows `world_from_body` that are read with a calibration.
fn check_rows(rows: &[Pose3], body_from_lidar: Pose3) -> Option<PoseCheck> {
    let world_from_map = rows[0] * body_from_lidar;
    let map_from_lidar: Vec<Pose3> = (rows.iter())
        .map(|row| world_from_map.inverse() * row * body_from_lidar)
        .collect();
    let given = GivenPoses {
        map_from_lidar: &map_from_lidar,
        world_from_map,
        body_from_lidar,
    };
    compare(&motions(), &given)
}

fn meaning(rows: &[Pose3], body_from_lidar: Pose3) -> Option<PoseMeaning> {
    let check = check_rows(rows, body_from_lidar).unwrap();
    assert_eq!(check.fit, PoseFit::Wrong, "{check:?}");
    Some(check.better?.0)
}

#[test]
fn each_mistake_in_reading_poses_is_found() {
    let world = Pose3::new(Vector3::new(500.0, 80.0, 3.0), Vector3::new(0.1, 0.2, 2.0));
    let lidar: Vec<Pose3> = lidar_poses().iter().map(|pose| world * pose).collect();
    let in_body = |body_from_lidar: Pose3| -> Vec<Pose3> {
        (lidar.iter())
            .map(|row| row * body_from_lidar.inverse())
            .collect()
    };
    let none = Pose3::identity();
    for (rows, calibration) in [(&lidar, none), (&in_body(calibration()), calibration())] {
        let check = check_rows(rows, calibration).unwrap();
        assert_eq!((check.fit, check.better), (PoseFit::Fits, None));
        let inverse: Vec<Pose3> = rows.iter().map(Pose3::inverse).collect();
        assert_eq!(meaning(&inverse, calibration), Some(PoseMeaning::Inverse));
    }
    let mirrored: Vec<Pose3> = lidar_poses().iter().map(mirrored_motion).collect();
    assert_eq!(meaning(&mirrored, none), Some(PoseMeaning::Mirrored));
    let camera = in_body(calibration());
    assert_eq!(meaning(&camera, none), Some(PoseMeaning::Camera));
    assert_eq!(meaning(&lidar, calibration()), Some(PoseMeaning::Lidar));
    for rad in [FRAC_PI_2, -FRAC_PI_2, PI] {
        let turned = in_body(Pose3::rotation(Vector3::z() * rad));
        assert_eq!(meaning(&turned, none), Some(PoseMeaning::Turned(rad)));
    }
}

#[test]
fn poses_of_another_motion_fit_in_no_frame() {
    let other: Vec<Pose3> = (0..12)
        .map(|row| Pose3::translation(1.8 * f64::from(row), 0.0, 0.0))
        .collect();
    assert_eq!(meaning(&other, Pose3::identity()), None);
    let standing = [Pose3::identity(); 12];
    assert_eq!(meaning(&standing, Pose3::identity()), None);
}

#[test]
fn single_errors_and_those_of_centimetres_are_not_judged_and_larger_ones_are_doubtful() {
    let fit = |rows: &[Pose3]| check_rows(rows, Pose3::identity()).unwrap().fit;
    let moved = |step_m: f64| -> Vec<Pose3> {
        let rows = lidar_poses().into_iter().enumerate();
        rows.map(|(row, pose)| Pose3::translation(0.0, 0.0, step_m * row as f64) * pose)
            .collect()
    };
    assert_eq!(fit(&moved(0.05)), PoseFit::Fits);
    assert_eq!(fit(&moved(0.25)), PoseFit::Doubtful);
    let mut one_wrong = lidar_poses();
    one_wrong[5].translation.y += 3.0;
    assert_eq!(fit(&one_wrong), PoseFit::Fits);
}

#[test]
fn nothing_is_said_of_a_sensor_that_stands_or_whose_motion_is_unknown() {
    let poses = lidar_poses();
    let given = |map_from_lidar| GivenPoses {
        map_from_lidar,
        world_from_map: Pose3::identity(),
        body_from_lidar: Pose3::identity(),
    };
    let mut few = motions();
    few[5..].fill(None);
    assert_eq!(compare(&few, &given(&poses)), None);
    let rest = [Pose3::identity(); 12];
    assert_eq!(compare(&rest.map(Some), &given(&rest)), None);
    assert_eq!(compare(&[], &given(&[])), None);
}

#[test]
fn scans_of_a_drive_confirm_its_poses_and_refuse_those_of_a_camera() {
    let scans = drive_scans(8, None);
    let lidar: Vec<Pose3> = (0..8).map(|row| drive(0.1 * f64::from(row))).collect();
    let check = |map_from_lidar: &[Pose3]| {
        let given = GivenPoses {
            map_from_lidar,
            world_from_map: Pose3::identity(),
            body_from_lidar: Pose3::identity(),
        };
        check_poses(&scans, &given, &OdometryConfig::default())
            .unwrap()
            .unwrap()
    };
    let right = check(&lidar);
    assert_eq!(right.fit, PoseFit::Fits);
    assert!(right.given.points_m < 0.05, "{right:?}");
    let camera: Vec<Pose3> = (lidar.iter())
        .map(|pose| camera_from_lidar() * pose * camera_from_lidar().inverse())
        .collect();
    let wrong = check(&camera);
    assert_eq!(wrong.fit, PoseFit::Wrong);
    assert_eq!(wrong.better.unwrap().0, PoseMeaning::Camera);
}

#[test]
fn poses_along_a_tunnel_are_not_refused_for_rings_that_move_with_the_sensor() {
    let poses: Vec<Pose3> = (0..16)
        .map(|row| Pose3::translation(1.5 * f64::from(row), 0.0, 0.0))
        .collect();
    let scans = World::tunnel().scans(&poses);
    let given = GivenPoses {
        map_from_lidar: &poses,
        world_from_map: Pose3::identity(),
        body_from_lidar: Pose3::identity(),
    };
    let config = OdometryConfig::default();
    // After a few scans the rings themselves are mapped as surfaces, at which the sensor stands.
    let slipping = super::motions(&scans, None, &config, is_certain).unwrap();
    assert_eq!(compare(&slipping, &given).unwrap().fit, PoseFit::Wrong);
    let check = check_poses(&scans, &given, &config).unwrap();
    assert!(check.is_none(), "{check:?}");
}
