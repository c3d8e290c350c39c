//! Why a scan cannot be tracked.

use super::localizer::LocalizerError;
use crate::odometry::OdometryError;
use crate::sensor::SensorError;
use crate::validation::InvalidValue;

/// Why a scan cannot be tracked.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum TrackerError {
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    #[error(transparent)]
    Sensor(#[from] SensorError),
    #[error(transparent)]
    Odometry(#[from] OdometryError),
    #[error(transparent)]
    Localizer(#[from] LocalizerError),
}
