//! Source of the motion between frames, and its description in reports.

use std::path::Path;

use anyhow::Result;
use rand::Rng;

use super::stages::RecordingInputs;
use crate::app::config::OdometrySource;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::Scan;
use crate::localization::odometry::{demonstration_noise, increments, with_noise};
use crate::odometry::{Odometer, OdometryConfig};
use crate::recording::layout::Layout;
use crate::recording::{PoseTrack, Recording};

/// The motion `previous_from_current` into each frame.
pub enum MotionSource {
    /// Known for all frames.
    Given(Vec<Pose2>),
    /// From the scans themselves.
    Scans(Box<Odometer>),
    /// Not known.
    Unknown,
}

impl MotionSource {
    /// Opens the configured source for the frames of a recording.
    pub fn open(
        source: OdometrySource,
        file: Option<&Path>,
        inputs: &RecordingInputs,
        recording: &Recording,
        rng: &mut impl Rng,
    ) -> Result<Self> {
        Ok(match (source, file) {
            (OdometrySource::None, _) => Self::Unknown,
            (OdometrySource::File | OdometrySource::Auto, Some(file)) => {
                Self::of_track(&inputs.track(file, recording)?, recording)?
            }
            // A bag may have a topic of odometry.
            (OdometrySource::Auto, None) if recording.files.layout == Layout::Bag => {
                match recording.own_track() {
                    Ok(track) => Self::of_track(&track, recording)?,
                    Err(error) => {
                        tracing::info!("odometry from the scans: {error}");
                        Self::of_scans()?
                    }
                }
            }
            (OdometrySource::GroundTruth, _) => {
                let poses = recording
                    .frames
                    .iter()
                    .filter_map(|frame| frame.map_from_lidar);
                let increments = increments(&poses.collect::<Vec<_>>());
                Self::Given(with_noise(&increments, &demonstration_noise(), rng))
            }
            _ => Self::of_scans()?,
        })
    }

    fn of_scans() -> Result<Self> {
        Ok(Self::Scans(Box::new(Odometer::new(
            OdometryConfig::default(),
        )?)))
    }

    fn of_track(track: &PoseTrack, recording: &Recording) -> Result<Self> {
        let mut last = Pose3::identity();
        let poses = track.matched(&recording.frames, recording.has_times)?;
        let known = poses.into_iter().map(|pose| {
            last = pose.unwrap_or(last);
            last
        });
        Ok(Self::Given(increments(&known.collect::<Vec<_>>())))
    }

    /// The motion into a frame by its row and scan; every scan has to be given, in order.
    pub fn into_frame(&mut self, row: usize, scan: &Scan) -> Result<Option<Pose2>> {
        Ok(match self {
            Self::Given(increments) => increments.get(row).copied(),
            Self::Scans(odometer) => Some(pose2_from_pose3(
                &odometer.step(scan)?.previous_from_current,
            )),
            Self::Unknown => None,
        })
    }
}

/// Description of the odometry for reports.
pub fn description(source: OdometrySource, file: Option<&Path>) -> String {
    match (source, file) {
        (OdometrySource::None, _) => "none (constant velocity)".to_owned(),
        (OdometrySource::File | OdometrySource::Auto, Some(file)) => file.display().to_string(),
        (OdometrySource::GroundTruth, _) => {
            "ground truth with noise (a demonstration, as in range-mcl)".to_owned()
        }
        _ => "from the scans".to_owned(),
    }
}
