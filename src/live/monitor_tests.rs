use approx::assert_relative_eq;
use nalgebra::Vector3;

use super::*;
use crate::geometry::Pose2;
use crate::localization::ParticleSet;
use crate::map::SensorAttitude;

const PERIOD: Duration = Duration::from_millis(100);

fn pose(x: f64, y: f64, heading: f64) -> Pose3 {
    Pose3::new(Vector3::new(x, y, 1.7), Vector3::new(0.01, -0.02, heading))
}

fn estimate(state: State, map_from_lidar: Pose3) -> Estimate {
    Estimate {
        pose: pose2_from_pose3(&map_from_lidar),
        map_from_lidar,
        attitude: SensorAttitude::default(),
        level_m: None,
        covariance: Matrix3::from_diagonal_element(1e-4),
        effective_sample_size: 1.0,
        mean_cost_m: None,
        agreement: Some(0.9),
        places: 1,
        state,
        distortion: None,
        updated: true,
        on_mapped_ground: true,
        motion: None,
        particles: ParticleSet::uniform([Pose2::identity()]),
    }
}

fn monitor() -> Monitor {
    Monitor::new(&LocalizerConfig::default())
}

/// A monitor that follows a pose after a drive of ten steps, and the pose of the odometry.
fn following() -> (Monitor, Pose3) {
    let step = Pose3::new(Vector3::new(1.0, 0.02, 0.0), Vector3::new(0.0, 0.0, 0.03));
    let (mut monitor, mut driven) = (monitor(), Pose3::identity());
    for _ in 0..10 {
        driven *= step;
        monitor.update(
            &estimate(State::Tracking, pose(3.0, 4.0, 0.5) * driven),
            &step,
        );
    }
    (monitor, driven)
}

#[test]
fn map_from_odom_is_published_exactly_while_the_pose_is_believed() {
    for reason in Reason::ALL {
        let (mut monitor, _) = following();
        monitor.set(reason);
        let is_believed = reason.state().is_believed();
        assert_eq!(monitor.map_from_odom().is_some(), is_believed, "{reason:?}");
        assert_eq!(
            monitor.pose_after(&Pose3::identity()).is_some(),
            is_believed
        );
    }
    assert_eq!(monitor().map_from_odom(), None);
}

#[test]
fn map_from_odom_is_constant_where_the_odometry_is_right_and_moves_the_pose_by_its_motion() {
    let (monitor, driven) = following();
    let map_from_odom = monitor.map_from_odom().unwrap();
    assert_relative_eq!(map_from_odom, pose(3.0, 4.0, 0.5), epsilon = 1e-9);
    for moved in [Pose3::identity(), pose(0.7, -0.1, 0.2)] {
        let extrapolated = monitor.pose_after(&moved).unwrap().map_from_lidar;
        assert_relative_eq!(extrapolated, map_from_odom * driven * moved, epsilon = 1e-9);
    }
}

#[test]
fn a_pose_that_was_lost_is_not_believed_before_a_scan_confirms_it() {
    let (mut monitor, _) = following();
    let mut states = vec![];
    for state in [
        State::Searching,
        State::Lost,
        State::Searching,
        State::Tracking,
    ] {
        monitor.update(&estimate(state, pose(9.0, 0.0, 0.0)), &Pose3::identity());
        states.push((monitor.state(), monitor.map_from_odom().is_some()));
    }
    assert_eq!(
        states,
        [
            (LiveState::Coasting, true),
            (LiveState::Lost, false),
            (LiveState::Searching, false),
            (LiveState::Tracking, true)
        ]
    );
}

#[test]
fn a_sensor_that_stalls_is_carried_by_the_motion_until_that_is_too_uncertain() {
    let after = |waited_s: f64, moved: Option<Pose3>| {
        let (mut monitor, _) = following();
        let waited = Duration::from_secs_f64(waited_s);
        monitor.wait(Outage::NoScans, waited, PERIOD, moved.as_ref());
        monitor.reason()
    };
    // Two scans may be missing.
    assert_eq!(after(0.3, None), Reason::ScanAgrees);
    assert_eq!(after(0.31, None), Reason::SensorStalled);
    assert_eq!(after(1.09, None), Reason::SensorStalled);
    assert_eq!(after(1.11, None), Reason::StalledTooLong);
    // A robot whose wheels say that it stands is where it was.
    assert_eq!(
        after(3600.0, Some(Pose3::identity())),
        Reason::SensorStalled
    );
    let driven = |m: f64| Some(Pose3::translation(m, 0.0, 0.0));
    assert_eq!(after(3.0, driven(20.0)), Reason::SensorStalled);
    assert_eq!(after(3.0, driven(200.0)), Reason::StalledTooLong);
}

#[test]
fn scans_that_cannot_be_used_are_as_none_with_their_own_reason() {
    let after = |waited_s: f64| {
        let (mut monitor, _) = following();
        let waited = Duration::from_secs_f64(waited_s);
        monitor.wait(Outage::UnusableScans, waited, PERIOD, None);
        (monitor.reason(), monitor.is_carried())
    };
    assert_eq!(after(0.3), (Reason::ScanAgrees, false));
    assert_eq!(after(0.31), (Reason::ScansUnusable, true));
    assert_eq!(after(1.11), (Reason::UnusableTooLong, false));
}

#[test]
fn a_pose_that_is_carried_is_the_less_certain_the_farther_it_is_and_most_across_by_its_heading() {
    let (monitor, _) = following();
    let of = |x: f64| {
        let moved = Pose3::translation(x, 0.0, 0.0);
        monitor.pose_after(&moved).unwrap()
    };
    assert_eq!(of(0.0).covariance, Matrix3::from_diagonal_element(1e-4));
    let spreads = [0.0, 1.0, 10.0, 100.0].map(|x| spread(&of(x).covariance).0);
    assert!(spreads.is_sorted_by(|a, b| a < b), "{spreads:?}");
    // Variances along and across the way: the heading moves the position across only.
    let far = of(100.0);
    let heading = pose2_from_pose3(&far.map_from_lidar).rotation;
    let along = heading * nalgebra::Vector2::x();
    let across = heading * nalgebra::Vector2::y();
    let position = far.covariance.fixed_view::<2, 2>(0, 0).into_owned();
    let variance = |axis: nalgebra::Vector2<f64>| (axis.transpose() * position * axis)[0];
    let noise = OdometryNoise::default();
    let drive_m = noise.drive_m.hypot(100.0 * noise.drive_per_m);
    assert_relative_eq!(variance(along), 1e-4 + drive_m.powi(2), max_relative = 1e-2);
    assert!(variance(across) > 1e-4 * 100.0_f64.powi(2));
}

#[test]
fn waiting_changes_nothing_while_no_pose_is_believed() {
    for reason in Reason::ALL
        .into_iter()
        .filter(|it| !it.state().is_believed())
    {
        let (mut monitor, _) = following();
        monitor.set(reason);
        monitor.wait(Outage::NoScans, Duration::from_secs(9), PERIOD, None);
        assert_eq!(monitor.reason(), reason);
    }
}

#[test]
fn the_reason_is_what_the_estimate_shows() {
    let scattered = |mut it: Estimate| {
        it.covariance = Matrix3::from_diagonal_element(9.0);
        it
    };
    let of = |from: Reason, estimate: &Estimate| {
        let mut monitor = monitor();
        monitor.set(from);
        monitor.update(estimate, &Pose3::identity());
        monitor.reason()
    };
    let searching = estimate(State::Searching, pose(0.0, 0.0, 0.0));
    let lost = estimate(State::Lost, pose(0.0, 0.0, 0.0));
    let several = Estimate {
        places: 4,
        ..searching.clone()
    };
    let disagreeing = Estimate {
        agreement: Some(0.2),
        ..lost.clone()
    };
    assert_eq!(of(Reason::Preparing, &searching), Reason::PositionUnknown);
    assert_eq!(of(Reason::PoseProposed, &searching), Reason::PoseProposed);
    assert_eq!(of(Reason::Preparing, &several), Reason::SeveralPlaces);
    assert_eq!(of(Reason::PositionUnknown, &lost), Reason::NoPlaceFound);
    assert_eq!(
        of(Reason::PositionUnknown, &disagreeing),
        Reason::ScanDisagrees
    );
    assert_eq!(of(Reason::ScanAgrees, &disagreeing), Reason::ScanDisagrees);
    assert_eq!(
        of(Reason::ScanAgrees, &scattered(lost)),
        Reason::ParticlesScattered
    );
}
