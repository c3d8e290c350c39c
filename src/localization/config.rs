//! Configuration of the localizer.

use super::convergence::ConvergenceConfig;
use super::motion::{OdometryNoise, VelocityNoise};
use super::observation::ObservationConfig;
use super::places::PlacesConfig;
use super::proposal::ProposalConfig;
use super::resampling::{KldConfig, ResamplingConfig};
use super::tempering::TemperingConfig;
use super::tracking_loss::TrackingLossConfig;
use crate::ground::GroundConfig;
use crate::map::PanoramaConfig;
use crate::validation::{InvalidValue, Validate, in_range, nested, not_negative};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

/// Configuration of the localizer.
///
/// Defaults: numbers of particles and motion threshold of range-mcl.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct LocalizerConfig {
    /// Ground segmentation of the scans.
    pub ground: GroundConfig,
    /// Largest number of particles while searching.
    #[default(10_000)]
    pub num_particles: usize,
    /// Number of particles while tracking.
    #[default(100)]
    pub num_reduced: usize,
    /// Motion after which the weights are updated [m].
    #[default(0.2)]
    pub move_thres_m: f64,
    /// Turn after which the weights are updated [rad].
    #[default(0.05)]
    pub turn_thres_rad: f64,
    /// Noise of odometry increments, per update.
    pub motion: OdometryNoise,
    /// Noise of velocity commands.
    pub velocity: VelocityNoise,
    /// Noise of the constant-velocity prediction without odometry over a tenth of a second, in proportion to the time.
    #[default(OdometryNoise::constant(0.02, 0.2, 0.03))]
    pub constant_velocity: OdometryNoise,
    /// The same while the velocity is unknown: up to 100 km/h within two standard deviations.
    #[default(OdometryNoise::constant(0.03, 1.4, 0.05))]
    pub unknown_velocity: OdometryNoise,
    /// Observation model.
    pub observation: ObservationConfig,
    /// Tempering of the likelihood.
    pub tempering: TemperingConfig,
    /// Search among several places.
    pub places: PlacesConfig,
    /// Update by a registration while tracking.
    pub proposal: ProposalConfig,
    /// Resampling.
    pub resampling: ResamplingConfig,
    /// KLD sampling, for the number of particles while searching.
    pub kld: KldConfig,
    /// Detection of convergence.
    pub convergence: ConvergenceConfig,
    /// Detection of tracking loss.
    pub tracking_loss: TrackingLossConfig,
    /// Search for a start without a pose, and after a loss.
    pub panorama: PanoramaConfig,
}

/// Largest number of particles.
const MAX_PARTICLES: usize = 1_000_000;

impl Validate for LocalizerConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("ground", &self.ground)?;
        in_range("num_particles", self.num_particles, 1..=MAX_PARTICLES)?;
        in_range("num_reduced", self.num_reduced, 1..=MAX_PARTICLES)?;
        not_negative("move_thres_m", self.move_thres_m)?;
        not_negative("turn_thres_rad", self.turn_thres_rad)?;
        nested("motion", &self.motion)?;
        nested("velocity", &self.velocity)?;
        nested("constant_velocity", &self.constant_velocity)?;
        nested("unknown_velocity", &self.unknown_velocity)?;
        nested("observation", &self.observation)?;
        nested("tempering", &self.tempering)?;
        nested("places", &self.places)?;
        nested("proposal", &self.proposal)?;
        nested("resampling", &self.resampling)?;
        nested("kld", &self.kld)?;
        nested("convergence", &self.convergence)?;
        nested("tracking_loss", &self.tracking_loss)?;
        nested("panorama", &self.panorama)
    }
}
