//! Source of the motion between frames, and its description in reports.

use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use rand::Rng;

use super::input;
use crate::app::config::OdometrySource;
use crate::geometry::{Pose2, Pose3};
use crate::localization::odometry::{demonstration_noise, increments, with_noise};
use crate::recording::Sequence;
use crate::recording::poses::DrivePoses;

/// Reads `previous_from_current` into each frame of the sequence; `None` without odometry.
pub fn read_increments(
    source: OdometrySource,
    file: Option<&Path>,
    sequence: &Sequence,
    rng: &mut impl Rng,
) -> Result<Vec<Option<Pose2>>> {
    let increments = match (source, file) {
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
    Ok(increments.into_iter().map(Some).collect())
}

/// Reads the lidar poses of an odometry file, in the frame of the file or of its first pose.
fn recorded(file: &Path, sequence: &Sequence) -> Result<Vec<Pose3>> {
    let drive = DrivePoses::read_with(file, || Ok(sequence.calibration))
        .with_context(|| format!("odometry_file is {}", file.display()))?;
    // Rows of TUM, which have times, are poses of the lidar as they are.
    Ok(match drive.times_s {
        Some(_) => drive.camera.world_from_cam0,
        None => drive.map_from_lidar(),
    })
}

/// Description of the odometry for reports.
pub fn description(source: OdometrySource, file: Option<&Path>) -> String {
    match (source, file) {
        (OdometrySource::None, _) => "none (constant velocity)".to_owned(),
        (OdometrySource::File, Some(file)) => file.display().to_string(),
        _ => "ground truth with noise (a demonstration, as in range-mcl)".to_owned(),
    }
}
