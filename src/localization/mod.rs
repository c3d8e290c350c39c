//! Monte Carlo localization of a car in a mesh map.
//!
//! > [`Tracker`] finds out what the sensor is, measures its motion, and passes both to a [`Localizer`], which turns scans into range images with the attitude of the sensor and feeds the
//! > particle [`filter`]: [`initialization`] samples the first particles, [`motion`] moves them by the
//! > [`odometry`], [`observation`] weights them, [`resampling`] keeps the likely ones, [`places`]
//! > compares those that are far apart, [`convergence`]
//! > decides when few are enough and [`tracking_loss`] when none is right. [`likelihood`] shows how
//! > peaked the likelihood is.
//!
//! Particles are planar poses `map_from_lidar`; the ground of the map gives height, roll and pitch.
//!
//! Dellaert et al., *Monte Carlo Localization for Mobile Robots*, ICRA 1999; Chen et al.,
//! *Range Image-based LiDAR Localization for Autonomous Vehicles*, ICRA 2021.

// State, input and output.
pub mod config;
pub mod estimate;
pub mod odometry;
pub mod particles;
mod preparation;
mod sweep;
// One step of the filter.
pub mod initialization;
pub mod motion;
pub mod observation;
pub mod places;
pub mod proposal;
pub mod resampling;
pub mod tempering;
// Confidence.
pub mod convergence;
pub mod likelihood;
pub mod tracking_loss;
// The loop.
pub mod filter;
pub mod localizer;
mod second_drive;
pub mod tracker;

pub use config::LocalizerConfig;
pub use estimate::Estimate;
pub use filter::ParticleFilter;
pub use initialization::StartSpread;
pub use localizer::{Localizer, LocalizerError, Start};
pub use odometry::Odometry;
pub use particles::{Particle, ParticleSet};
pub(crate) use preparation::ScanPreparation;
pub use second_drive::{SecondDrive, SecondDriveError};
pub use tracker::{Tracker, TrackerConfig, TrackerError};
pub use tracking_loss::{State, TrackingLossConfig};
