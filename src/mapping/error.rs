//! Errors of mapping: the way from a recording to a map.

use super::lost_path::LostPath;
use super::pose_report::PoseReport;
use crate::georeference::AlignmentError;
use crate::localization::SecondDriveError;
use crate::map::BuildError;
use crate::map::build::path_check::ImplausiblePath;
use crate::memory::MemoryError;
use crate::odometry::{OdometryError, TimingError};
use crate::recording::RecordingError;
use crate::sensor::SensorError;
use crate::validation::InvalidValue;

/// Why a recording cannot be mapped.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum MappingError {
    #[error("interrupted")]
    Interrupted,
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error(transparent)]
    Path(#[from] ImplausiblePath),
    #[error("the poses do not fit the scans: {0}")]
    PosesDoNotFit(Box<PoseReport>),
    #[error(transparent)]
    Lost(#[from] LostPath),
    #[error(transparent)]
    Odometry(#[from] OdometryError),
    #[error(transparent)]
    Timing(#[from] TimingError),
    #[error(transparent)]
    Sensor(#[from] SensorError),
    #[error(transparent)]
    InvalidValue(#[from] InvalidValue),
    #[error(transparent)]
    Memory(#[from] MemoryError),
    #[error(transparent)]
    SecondDrive(#[from] SecondDriveError),
    #[error("the map has no place on the Earth: {0}")]
    Alignment(#[from] AlignmentError),
    #[error(transparent)]
    Build(BuildError),
}
