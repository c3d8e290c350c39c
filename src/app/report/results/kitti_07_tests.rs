//! The run of range-mcl on KITTI 07 that its authors publish, if the data exists.

use std::path::{Path, PathBuf};

use approx::assert_relative_eq;

use super::LocalizationResults;
use crate::evaluation::{EvaluatedTrajectory, MetricsConfig, RangeMclRules, TrajectoryMetrics};
use crate::geometry::{Pose2, pose2_from_pose3};
use crate::recording::{Calibration, poses::CameraPoses};
use crate::skips_for_tests::skipped;

/// The true lidar poses and the results of range-mcl; `None` with a message if they do not exist.
#[track_caller]
pub fn kitti_07() -> Option<(Vec<Pose2>, LocalizationResults)> {
    let data = std::env::var_os("FPMCL_DATA").map_or_else(
        || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
        PathBuf::from,
    );
    let poses = data.join("kitti-odometry-poses");
    let results = data.join("range-mcl/kitti07_demo_loc_results.npz");
    if !results.exists() || !poses.exists() {
        skipped(format!(
            "{} or {} is missing",
            results.display(),
            poses.display()
        ));
        return None;
    }
    let calibration = Calibration::read(&poses.join("sequences/07/calib.txt")).unwrap();
    let truth = CameraPoses::read(&poses.join("poses/07.txt")).unwrap();
    let truth = truth.map_from_lidar(&calibration);
    let results = LocalizationResults::read(&results).unwrap();
    Some((truth.iter().map(pose2_from_pose3).collect(), results))
}

#[test]
fn the_run_of_range_mcl_on_kitti_07_has_the_errors_that_range_mcl_prints() {
    let Some((truth, results)) = kitti_07() else {
        return;
    };
    assert_eq!(results.len(), 1101);
    assert_eq!(results.particles.capacity(), 10_000);
    let rules = RangeMclRules::default();
    let estimates = results.estimates_or_particle_means(&rules).unwrap();
    let errors = rules.evaluate(&estimates, &truth);
    // range-mcl prints four digits. It uses the rotations of the file, which are orthogonal to
    // four digits only; here they are orthogonalized.
    assert_eq!(errors.success, Some(true));
    assert_relative_eq!(errors.rmse_location_m.unwrap(), 0.379_644, epsilon = 5e-6);
    assert_relative_eq!(errors.rmse_yaw_deg.unwrap(), 2.164_483, epsilon = 5e-6);

    let all: f64 = (estimates.iter().zip(&truth))
        .map(|(a, b)| (a.translation.vector - b.translation.vector).norm_squared())
        .sum();
    assert_relative_eq!((all / 1101.0).sqrt(), 0.379_799, epsilon = 5e-6);
}

/// Against an independent script in NumPy that works on camera poses.
#[test]
fn metrics_on_kitti_07_equal_those_of_an_independent_script() {
    let Some((truth, results)) = kitti_07() else {
        return;
    };
    let estimates = results
        .estimates_or_particle_means(&RangeMclRules::default())
        .unwrap();
    let trajectory = EvaluatedTrajectory {
        estimates: &estimates,
        ground_truth: &truth,
        times_s: None,
        runtimes_s: None,
        trusted: None,
    };
    let config = MetricsConfig {
        skip_frames: 20,
        ..MetricsConfig::default()
    };
    let metrics = TrajectoryMetrics::new(&trajectory, &config).unwrap();
    let position = metrics.position_m;
    let heading = metrics.heading_rad;
    for (ours, theirs, half_digit) in [
        (position.rmse, 0.3694, 6e-5),
        (position.mean, 0.3293, 6e-5),
        (position.p95, 0.6793, 6e-5),
        (position.max, 0.8621, 6e-5),
        (heading.rmse.to_degrees(), 2.1095, 6e-5),
        (heading.max.to_degrees(), 9.214, 6e-4),
        (metrics.smoothness.jitter_m.unwrap(), 0.0287, 6e-5),
    ] {
        assert_relative_eq!(ours, theirs, epsilon = half_digit);
    }
    assert_eq!(metrics.frames, 1081);
}
