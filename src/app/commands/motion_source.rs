//! Source of the motion between frames, and its description in reports.

use std::collections::VecDeque;
use std::ops::Range;
use std::path::PathBuf;

use anyhow::Result;
use rand::Rng;

use super::pose_remedy::remedy;
use super::stages::RecordingInputs;
use crate::app::settings::{MotionSourceConfig, OdometrySource};
use crate::geometry::{Pose2, Pose3, pose2_from_pose3, pose3_from_pose2};
use crate::localization::odometry::{are_in_space, demonstration_noise, motions, with_noise};
use crate::mapping::PoseReport;
use crate::odometry::PoseFit;
use crate::recording::layout::Layout;
use crate::recording::{Frame, PoseTrack, Recording};

/// The motion `previous_from_current` into each frame.
pub enum MotionSource {
    /// Known for all frames.
    Given(Vec<FrameMotion>),
    /// From the scans themselves, also from those between the selected ones, which are listed until they are taken.
    Scans(VecDeque<Frame>),
    /// Not known.
    Unknown,
}

impl MotionSource {
    /// Opens the configured source for the frames of a recording; returns also the file or, in a bag, the topic that
    /// is used.
    pub fn open(
        config: &MotionSourceConfig,
        inputs: &RecordingInputs,
        recording: &Recording,
        rng: &mut impl Rng,
    ) -> Result<(Self, Option<PathBuf>)> {
        let file = config.odometry_file.clone().map(PathBuf::from);
        let motion = match (config.odometry, &file) {
            (OdometrySource::None, _) => Self::Unknown,
            (OdometrySource::File | OdometrySource::Auto, Some(file)) => {
                Self::of_track(&inputs.track(file, recording)?, recording)?
            }
            // A bag may have a topic of odometry.
            (OdometrySource::Auto, None) if recording.files.layout == Layout::Bag => {
                match recording.odometry_track() {
                    Ok(track) => {
                        return Ok((Self::of_track(&track, recording)?, Some(track.path)));
                    }
                    Err(error) => {
                        tracing::info!(
                            "odometry from the scans, because the bag has none to use: {error}"
                        );
                        Self::of_scans(recording)
                    }
                }
            }
            (OdometrySource::GroundTruth, _) => {
                let poses = recording.frames.iter().map(|frame| frame.map_from_lidar);
                let motions = motions(&without_gaps(poses.collect()));
                let increments: Vec<Pose2> = motions.iter().map(pose2_from_pose3).collect();
                let noisy = with_noise(&increments, &demonstration_noise(), rng);
                let moved = motions.iter().zip(&increments).zip(&noisy);
                let with_noise = moved.map(|((motion, increment), noisy)| {
                    motion * pose3_from_pose2(&(increment.inverse() * noisy), 0.0)
                });
                Self::given(with_noise.collect(), &noisy)
            }
            _ => Self::of_scans(recording),
        };
        Ok((motion, file))
    }

    fn of_scans(recording: &Recording) -> Self {
        /// Larger steps are not bridged by the scans between.
        const MAX_STEP: usize = 10;
        let steps = recording.frames.windows(2);
        let largest = steps.map(|pair| pair[1].number - pair[0].number).max();
        let is_bridged = largest.is_some_and(|step| step <= MAX_STEP);
        let skipped = is_bridged.then(|| recording.skipped.clone());
        Self::Scans(skipped.unwrap_or_default().into())
    }

    /// The motion of a track, or that of the scans where they show another one.
    fn of_track(track: &PoseTrack, recording: &Recording) -> Result<Self> {
        let report = PoseReport::of_motion(recording, Some(track))?;
        if report.fit() != PoseFit::Fits {
            // A topic of a bag has no key.
            let poses = track.path.display().to_string();
            tracing::warn!(
                "the poses of {poses} and the scans contradict each other, so that the motion of the scans is used: {report}{}, or leave the poses out",
                remedy(&report, &poses)
            );
            return Ok(Self::of_scans(recording));
        }
        let poses = track.matched(&recording.frames, recording.has_times)?;
        let motions = motions(&without_gaps(poses));
        let increments: Vec<Pose2> = motions.iter().map(pose2_from_pose3).collect();
        Ok(Self::given(motions, &increments))
    }

    /// Known motions in space and in the plane; only the latter if all stay in the plane.
    fn given(motions: Vec<Pose3>, increments: &[Pose2]) -> Self {
        let are_in_space = are_in_space(&motions);
        let both = motions.into_iter().zip(increments);
        Self::Given(
            both.map(|(motion, &increment)| FrameMotion {
                increment,
                in_space: are_in_space.then_some(motion),
            })
            .collect(),
        )
    }

    /// The known motion over the steps into the frames of some rows.
    pub fn given_over(&self, rows: Range<usize>) -> Option<FrameMotion> {
        match self {
            Self::Given(motions) => (motions.get(rows)?.iter().copied()).reduce(FrameMotion::then),
            Self::Scans(_) | Self::Unknown => None,
        }
    }

    /// Takes the frames between the selected ones, which only the odometry of the scans needs.
    pub fn take_frames_between(&mut self) -> VecDeque<Frame> {
        match self {
            Self::Scans(between) => std::mem::take(between),
            Self::Given(_) | Self::Unknown => VecDeque::new(),
        }
    }

    /// Takes those before a selected frame, in order.
    pub fn frames_before<'a>(
        between: &'a mut VecDeque<Frame>,
        frame: &Frame,
    ) -> impl Iterator<Item = Frame> + 'a {
        let count = between.partition_point(|it| it.number < frame.number);
        between.drain(..count)
    }
}

/// The motion `previous_from_current` into a frame.
#[derive(Clone, Copy, Debug)]
pub struct FrameMotion {
    /// In the plane.
    pub increment: Pose2,
    /// In space; `None` if it was measured in the plane.
    pub in_space: Option<Pose3>,
}

impl FrameMotion {
    /// A motion that was measured in space.
    pub fn from_motion(motion: Pose3) -> Self {
        Self {
            increment: pose2_from_pose3(&motion),
            in_space: Some(motion),
        }
    }

    /// A motion that wheels or another sensor measured.
    pub fn measured(motion: Pose3) -> Self {
        Self {
            increment: pose2_from_pose3(&motion),
            in_space: are_in_space(&[motion]).then_some(motion),
        }
    }

    /// This motion, followed by another one.
    fn then(self, next: Self) -> Self {
        let in_space = self.in_space.zip(next.in_space);
        Self {
            increment: self.increment * next.increment,
            in_space: in_space.map(|(motion, next)| motion * next),
        }
    }
}

/// A pose per frame: gaps have the last known pose, and frames before the first known pose have that one.
fn without_gaps(poses: Vec<Option<Pose3>>) -> Vec<Pose3> {
    let mut last = poses.iter().flatten().next().copied().unwrap_or_default();
    let known = poses.into_iter().map(|pose| {
        last = pose.unwrap_or(last);
        last
    });
    known.collect()
}

/// Description of the odometry for reports.
pub fn description(config: &MotionSourceConfig) -> String {
    match (config.odometry, &config.odometry_file) {
        (OdometrySource::None, _) => "none (constant velocity)".to_owned(),
        (OdometrySource::File | OdometrySource::Auto, Some(file)) => file.display().to_string(),
        (OdometrySource::GroundTruth, _) => {
            "ground truth with noise (a demonstration, as in range-mcl)".to_owned()
        }
        _ => "from the scans".to_owned(),
    }
}
