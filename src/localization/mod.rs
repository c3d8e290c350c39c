//! Monte Carlo localization of a car in a mesh map.
//!
//! > [`Tracker`] infers the sensor, measures its motion, and passes both to a [`Localizer`], which turns scans into
//! > range images with the attitude of the sensor and feeds the particle `filter`: `initialization` samples the first
//! > particles, `motion` moves them by the `odometry`, `observation` weights them, `resampling` keeps the likely ones,
//! > `places` compares those that are far apart, `convergence` decides when few are enough and `tracking_loss` when
//! > none is right, and `distortion_search` what is wrong with all scans.
//!
//! Particles are planar poses `map_from_lidar`; the ground of the map gives height, roll and pitch.
//!
//! Dellaert et al., *Monte Carlo Localization for Mobile Robots*, ICRA 1999; Chen et al.,
//! *Range Image-based LiDAR Localization for Autonomous Vehicles*, ICRA 2021.

// State, input and output.
pub(crate) mod config;
mod error;
pub(crate) mod estimate;
pub(crate) mod odometry;
pub(crate) mod particles;
mod preparation;
mod sweep;
// One step of the filter.
pub(crate) mod initialization;
pub(crate) mod motion;
pub(crate) mod observation;
pub(crate) mod places;
pub(crate) mod proposal;
pub(crate) mod resampling;
pub(crate) mod tempering;
// Confidence.
pub(crate) mod convergence;
mod distortion;
mod distortion_search;
pub(crate) mod tracking_loss;
// The loop.
pub(crate) mod filter;
mod front_end;
pub(crate) mod localizer;
mod second_drive;
pub(crate) mod tracker;

pub use config::LocalizerConfig;
pub use convergence::ConvergenceConfig;
pub use distortion::Distortion;
pub use error::TrackerError;
pub use estimate::Estimate;
pub use front_end::{FrontEnd, Measured};
pub use initialization::{StartDistribution, StartSpread};
pub use localizer::{Localizer, LocalizerError, Start};
pub use motion::{OdometryNoise, VelocityCommand, VelocityNoise};
pub use observation::{Likelihood, ObservationConfig};
pub use odometry::Odometry;
pub use particles::{Particle, ParticleSet};
pub use places::PlacesConfig;
pub use proposal::ProposalConfig;
pub use resampling::{KldConfig, ResamplingConfig};
pub use second_drive::{SecondDrive, SecondDriveError};
pub use tempering::TemperingConfig;
pub use tracker::{BackEnd, Tracker, TrackerConfig};
pub use tracking_loss::{State, TrackingLossConfig};

pub(crate) use preparation::ScanPreparation;
