//! Everything that can be set about the filter, in one place.

use serde::{Deserialize, Serialize};

use super::convergence::ConvergenceConfig;
use super::motion::{OdometryNoise, VelocityNoise};
use super::observation::ObservationConfig;
use super::proposal::ProposalConfig;
use super::resampling::{KldConfig, ResamplingConfig};
use super::vigilance::VigilanceConfig;
use crate::validation::{InvalidValue, Validate, at_least_one, fraction, nested, not_negative};

/// How the likelihood is sharpened within a frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TemperingConfig {
    /// A frame never leaves a smaller share of effective particles than this; 0 takes the
    /// likelihood at its word, as range-mcl does.
    pub min_effective_fraction: f64,
    /// Rounds of reweighting and resampling per frame while searching.
    pub searching_rounds: usize,
    /// The same while tracking.
    pub tracking_rounds: usize,
}

impl Default for TemperingConfig {
    /// Our own values.
    fn default() -> Self {
        Self {
            min_effective_fraction: 0.2,
            searching_rounds: 4,
            tracking_rounds: 1,
        }
    }
}

impl Validate for TemperingConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        fraction("min_effective_fraction", self.min_effective_fraction)?;
        at_least_one("searching_rounds", self.searching_rounds)?;
        at_least_one("tracking_rounds", self.tracking_rounds)
    }
}

/// Everything that can be set about the filter.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LocalizerConfig {
    /// Particles while searching, at most.
    pub num_particles: usize,
    /// Particles once converged.
    pub num_reduced: usize,
    /// The weights are updated after this much motion [m].
    pub move_thres_m: f64,
    /// Or after this much turning [rad].
    pub turn_thres_rad: f64,
    /// Noise of the odometry, per update.
    pub motion: OdometryNoise,
    /// Noise of velocity commands.
    pub velocity: VelocityNoise,
    /// Noise of the guess that the car goes on as it went, where there is no odometry.
    pub constant_velocity: OdometryNoise,
    /// Noise of the guess that it stands, where there is none and it is not known how it went.
    pub unknown_velocity: OdometryNoise,
    /// The likelihood.
    pub observation: ObservationConfig,
    /// Its sharpness.
    pub tempering: TemperingConfig,
    /// Where particles are drawn while tracking.
    pub proposal: ProposalConfig,
    /// Resampling.
    pub resampling: ResamplingConfig,
    /// Number of particles while searching.
    pub kld: KldConfig,
    /// When a few particles are enough.
    pub convergence: ConvergenceConfig,
    /// When the map disagrees.
    pub vigilance: VigilanceConfig,
}

impl Default for LocalizerConfig {
    /// range-mcl's numbers of particles and threshold of motion.
    fn default() -> Self {
        Self {
            num_particles: 10_000,
            num_reduced: 100,
            move_thres_m: 0.2,
            turn_thres_rad: 0.05,
            motion: OdometryNoise::default(),
            velocity: VelocityNoise::default(),
            constant_velocity: OdometryNoise {
                turn_rad: 0.02,
                drive_m: 0.2,
                side_m: 0.03,
            },
            // Up to 100 km/h at ten frames a second within two standard deviations.
            unknown_velocity: OdometryNoise {
                turn_rad: 0.03,
                drive_m: 1.4,
                side_m: 0.05,
            },
            observation: ObservationConfig::default(),
            tempering: TemperingConfig::default(),
            proposal: ProposalConfig::default(),
            resampling: ResamplingConfig::default(),
            kld: KldConfig::default(),
            convergence: ConvergenceConfig::default(),
            vigilance: VigilanceConfig::default(),
        }
    }
}

impl Validate for LocalizerConfig {
    /// With the keys of `localization.yml`.
    fn validate(&self) -> Result<(), InvalidValue> {
        at_least_one("numParticles", self.num_particles)?;
        at_least_one("num_reduced", self.num_reduced)?;
        not_negative("move_thres", self.move_thres_m)?;
        not_negative("turn_thres_rad", self.turn_thres_rad)?;
        nested("odometry_noise", &self.motion)?;
        nested("velocity_noise", &self.velocity)?;
        nested("constant_velocity_noise", &self.constant_velocity)?;
        nested("unknown_velocity_noise", &self.unknown_velocity)?;
        nested("observation", &self.observation)?;
        nested("tempering", &self.tempering)?;
        nested("proposal", &self.proposal)?;
        nested("resampling", &self.resampling)?;
        nested("kld", &self.kld)?;
        at_least_one("converge_thres", self.convergence.converge_thres)?;
        nested("convergence", &self.convergence)?;
        nested("vigilance", &self.vigilance)
    }
}
