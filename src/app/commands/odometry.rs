//! Where the motion between frames comes from, and how a report names it.

use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use rand::Rng;

use super::input;
use crate::app::config::OdometrySource;
use crate::geometry::{Pose2, Pose3, pose3_from_pose2};
use crate::lidar::RotationDirection;
use crate::localization::odometry::{demonstration_noise, increments, with_noise};
use crate::recording::poses::{CameraPoses, read_tum};
use crate::recording::{RecordingError, Sequence};

/// `previous_from_current` into each frame of the sequence; `None` where nothing is known.
pub fn read_increments(
    source: OdometrySource,
    file: Option<&Path>,
    sequence: &Sequence,
    rng: &mut impl Rng,
) -> Result<Vec<Option<Pose2>>> {
    let known = match (source, file) {
        (OdometrySource::None, _) => return Ok(vec![None; sequence.frames.len()]),
        (OdometrySource::File, Some(file)) => {
            input::require_file("odometry_file", file)?;
            let poses = recorded(file, sequence)?;
            let numbers = sequence.frames.iter().map(|frame| frame.number);
            let last = sequence.frames.last().map_or(0, |frame| frame.number);
            ensure!(
                last < poses.len(),
                "{} has {} rows, but frame {last} is to be localized; the odometry needs one row per frame of the recording",
                file.display(),
                poses.len()
            );
            increments(&numbers.map(|number| poses[number]).collect::<Vec<_>>())
        }
        _ => {
            let poses: Vec<Pose3> = sequence.frames.iter().map(|f| f.map_from_lidar).collect();
            with_noise(&increments(&poses), &demonstration_noise(), rng)
        }
    };
    Ok(known.into_iter().map(Some).collect())
}

/// Lidar poses from an odometry file: KITTI rows (12 numbers, camera) or TUM rows (8, lidar).
fn recorded(file: &Path, sequence: &Sequence) -> Result<Vec<Pose3>> {
    let context = || format!("odometry_file is {}", file.display());
    match CameraPoses::read(file) {
        Ok(poses) => Ok(poses.map_from_lidar(&sequence.calibration)),
        Err(RecordingError::WrongCount { found: 8, .. }) => {
            let trajectory = read_tum(file).with_context(context)?;
            Ok(trajectory
                .poses
                .iter()
                .map(|pose| pose.map_from_lidar)
                .collect())
        }
        Err(error) => Err(error).with_context(context),
    }
}

/// The sequence with its scans compensated by an odometry, where that is wanted.
pub fn compensated(
    sequence: Sequence,
    direction: Option<RotationDirection>,
    increments: &[Option<Pose2>],
) -> Sequence {
    let Some(direction) = direction else {
        return sequence;
    };
    let in_space =
        |increment: &Option<Pose2>| increment.map(|motion| pose3_from_pose2(&motion, 0.0));
    sequence.compensated_by(
        direction,
        &increments.iter().map(in_space).collect::<Vec<_>>(),
    )
}

/// For reports.
pub fn description(source: OdometrySource, file: Option<&Path>) -> String {
    match (source, file) {
        (OdometrySource::None, _) => "none: the car goes on as it went".to_owned(),
        (OdometrySource::File, Some(file)) => file.display().to_string(),
        _ => "ground truth with noise (a demonstration, as in range-mcl)".to_owned(),
    }
}
