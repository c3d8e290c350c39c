//! The loop of Monte Carlo localization on range images.
//!
//! ```text
//! propagate      x ~ p(x | x_before, odometry)           motion
//! reweight       w ∝ w · p(scan | x, map)ᵝ               observation, tempering
//! estimate       weighted mean, covariance, state        particles, tracking_loss
//! resample       when few particles carry the weight     resampling
//! ```
//!
//! While the filter searches, reweighting and resampling alternate several times within one frame,
//! with an increasingly peaked likelihood (annealing). Once the distribution is narrow, `num_reduced`
//! particles are enough; they are drawn where odometry and scan agree ([`proposal`](super::proposal)).

use std::time::Duration;

use nalgebra::Matrix3;
use rand::Rng;

use super::config::LocalizerConfig;
use super::convergence::{is_converged, is_narrow};
use super::estimate::Estimate;
use super::motion::{TurnDriveTurn, VelocityCommand};
use super::observation::{
    BeamAgreement, above_road, choose_beams, costs, ground_patch_of, near_points,
};
use super::odometry::Odometry;
use super::particles::{Particle, ParticleSet, spread};
use super::resampling::systematic;
use super::tempering::exponent;
use super::tracking_loss::{AgreementMonitor, State};
use crate::geometry::{Pose2, Pose3};
use crate::lidar::{Beam, RangeImage};
use crate::map::{GroundPatch, Map, PanoramaRequest, SensorAttitude};
use crate::rendering::RenderError;

mod coast;
mod propose;
mod resample;

/// A distribution over planar poses, `map_from_lidar`, updated frame by frame.
pub struct ParticleFilter {
    /// Configuration.
    pub config: LocalizerConfig,
    map: Map,
    /// Panoramas of the places where the search restarts once tracking is lost; without them the
    /// filter reports the loss and stays lost.
    restart: Option<PanoramaRequest>,
    particles: ParticleSet,
    /// Motion since the last update, `updated_from_current`.
    pending: Pose2,
    /// Duration of the velocity commands since then.
    pending_duration: Duration,
    /// The last estimate, whether the distribution around it was narrow, and the motion into it, once
    /// that is known: for frames without odometry.
    estimate: Pose2,
    is_narrow: bool,
    last_increment: Option<Pose2>,
    /// Covariance of the last estimate of an updated frame [m², m·rad, rad²].
    covariance: Matrix3<f64>,
    patch: Option<GroundPatch>,
    attitude: Option<SensorAttitude>,
    state: State,
    agreement: AgreementMonitor,
    updates_in_state: usize,
    is_first: bool,
}

/// Result of an update of the weights.
struct Update {
    effective_sample_size: f64,
    mean_cost_m: Option<f64>,
    /// The beams of the last round.
    beams: Vec<Beam>,
    /// Attitude of the sensor as estimated in this frame.
    attitude: SensorAttitude,
}

impl ParticleFilter {
    /// Starts with a distribution; see [`initialization`](super::initialization).
    pub fn new(
        config: LocalizerConfig,
        map: Map,
        restart: Option<PanoramaRequest>,
        particles: ParticleSet,
    ) -> Self {
        let estimate = particles.mean();
        let level_m = particles.best().level_m;
        let covariance = particles.covariance_about(&estimate);
        Self {
            patch: map.ground.patch_under(&estimate, level_m),
            config,
            map,
            restart,
            covariance,
            particles,
            pending: Pose2::identity(),
            pending_duration: Duration::ZERO,
            estimate,
            is_narrow: false,
            last_increment: None,
            attitude: None,
            state: State::Searching,
            agreement: AgreementMonitor::default(),
            updates_in_state: 0,
            is_first: true,
        }
    }

    /// Processes a frame: the motion since the previous frame, the scan, and the attitude of the
    /// sensor. The odometry of the first frame is ignored.
    pub fn step(
        &mut self,
        odometry: Odometry,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Estimate, RenderError> {
        if !self.is_first {
            self.pending *= self.increment(odometry);
            if let Odometry::Velocity(command) = odometry {
                self.pending_duration += command.duration;
            }
        }
        if !self.is_update_due(odometry) {
            return Ok(self.coast(odometry, attitude));
        }
        self.propagate(odometry, rng);
        let update = match self.propose(scan, attitude, rng)? {
            Some(proposal) => self.sample_and_weight(proposal, rng)?,
            None => self.reweight_in_rounds(scan, attitude, rng)?,
        };
        let mut frame = self.estimate_of(&update);
        frame.agreement = self.agreement(&frame.map_from_lidar, &update.beams, &update.attitude)?;
        self.attitude = Some(update.attitude);
        self.change_state(frame.agreement, odometry);
        frame.state = self.state;
        self.prepare_next(scan, attitude, rng)?;
        Ok(frame)
    }

    /// Searching, tracking or lost.
    pub fn state(&self) -> State {
        self.state
    }

    /// The particles with which the next frame starts.
    pub fn particles(&self) -> &ParticleSet {
        &self.particles
    }

    /// Attitude of the sensor in the last frame if it is a good start for the next: while tracking it
    /// comes from the map, which is more accurate than the ground plane of a single scan.
    pub fn attitude(&self) -> Option<SensorAttitude> {
        let proposes = self.config.proposal.scan && self.state == State::Tracking;
        self.attitude.filter(|_| proposes)
    }

    fn increment(&self, odometry: Odometry) -> Pose2 {
        match odometry {
            Odometry::Increment(previous_from_current) => previous_from_current,
            Odometry::Velocity(command) => command.compose(),
            Odometry::Unknown => self.last_increment.unwrap_or_else(Pose2::identity),
        }
    }

    /// Without odometry every scan is used: nothing else shows whether the car moves.
    fn is_update_due(&self, odometry: Odometry) -> bool {
        self.is_first
            || odometry == Odometry::Unknown
            || self.pending.translation.vector.norm() > self.config.move_thres_m
            || self.pending.rotation.angle().abs() > self.config.turn_thres_rad
    }

    fn propagate(&mut self, odometry: Odometry, rng: &mut impl Rng) {
        if !self.is_first {
            if odometry == Odometry::Unknown && self.last_increment.is_none() {
                // The distribution becomes as wide as at the start and needs as many particles.
                let weights = self.particles.weights();
                let members = systematic(&weights, self.config.num_particles, rng);
                self.particles = self.particles.selected(&members);
            }
            let motion = TurnDriveTurn::decompose(&self.pending);
            let config = &self.config;
            let noise = match (odometry, self.last_increment) {
                (Odometry::Unknown, None) => &config.unknown_velocity,
                (Odometry::Unknown, Some(_)) => &config.constant_velocity,
                _ => &config.motion,
            };
            if let Odometry::Velocity(_) = odometry {
                let held = VelocityCommand::driving(&self.pending, self.pending_duration);
                self.particles
                    .propagate(|pose| pose * held.sample(&config.velocity, rng));
            } else {
                self.particles
                    .propagate(|pose| pose * motion.sample(noise, rng));
            }
        }
        self.is_first = false;
        self.pending = Pose2::identity();
        self.pending_duration = Duration::ZERO;
    }

    /// Reweights the particles by the scan, in one round or several.
    fn reweight_in_rounds(
        &mut self,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Update, RenderError> {
        let rounds = match self.state {
            State::Tracking => self.config.tempering.tracking_rounds,
            State::Searching | State::Lost => self.config.tempering.searching_rounds,
        };
        let (mut left, mut round) = (1.0, 1);
        loop {
            let observation = &self.config.observation;
            let count = observation.beams_for(self.particles.len());
            let beams = choose_beams(scan, count, observation.road_share, attitude, rng);
            let refined = self.refined_attitude(scan, attitude);
            let (logs, costs) = self.log_likelihoods(&beams, &refined)?;
            let used = self.reweight(&logs, left);
            left -= used;
            if round >= rounds || left <= 0.0 || used <= 0.0 {
                return Ok(Update {
                    effective_sample_size: self.particles.effective_sample_size(),
                    mean_cost_m: weighted_mean(&self.particles, &costs),
                    beams,
                    attitude: self.refined_attitude(scan, attitude),
                });
            }
            self.resample(rng);
            round += 1;
        }
    }

    /// Attitude of the sensor: where the distribution is narrow, from the distances of ground returns
    /// to the mapped ground; otherwise from the scan alone.
    fn refined_attitude(&self, scan: &RangeImage, attitude: &SensorAttitude) -> SensorAttitude {
        if !self.is_narrow() {
            return *attitude;
        }
        let points = near_points(scan);
        self.map
            .ground
            .attitude_at(&self.particles.mean(), self.level_m(), attitude, &points)
            .unwrap_or(*attitude)
    }

    /// Ground patch under a pose near the particles.
    fn patch_at(&self, pose: &Pose2) -> Option<GroundPatch> {
        self.map.ground.patch_under(pose, self.level_m())
    }

    /// Height of the ground below the best particle [m].
    fn level_m(&self) -> Option<f64> {
        self.particles.best().level_m
    }

    /// Aligns the particles to the ground of the map and returns their poses in space.
    fn align_to_ground(&mut self, attitude: &SensorAttitude) -> Vec<Option<Pose3>> {
        let remembered = self.patch.filter(|_| self.state == State::Tracking);
        let members = self.particles.particles();
        let patches: Vec<Option<GroundPatch>> = members
            .iter()
            .map(|particle| ground_patch_of(&particle.hypothesis(), &self.map, remembered.as_ref()))
            .collect();
        let lift = |(particle, patch): (&Particle, &Option<GroundPatch>)| {
            Some(patch.as_ref()?.lift(&particle.map_from_lidar, attitude))
        };
        let poses = members.iter().zip(&patches).map(lift).collect();
        let levels_m = patches
            .iter()
            .map(|patch| patch.map(|patch| patch.height_m));
        self.particles.set_levels(levels_m);
        poses
    }

    /// Log-likelihoods of the particles, up to a constant, and their mean costs [m].
    fn log_likelihoods(
        &mut self,
        beams: &[Beam],
        attitude: &SensorAttitude,
    ) -> Result<(Vec<f64>, Vec<Option<f64>>), RenderError> {
        let poses = self.align_to_ground(attitude);
        let observation = &self.config.observation;
        let difference = observation.difference();
        let costs = costs(&*self.map.renderer, &poses, beams, &difference)?;
        let log = |cost: &Option<f64>| {
            cost.map_or(observation.floor_log_likelihood(), |cost_m| {
                observation.log_likelihood(cost_m)
            })
        };
        Ok((costs.iter().map(log).collect(), costs))
    }

    /// Multiplies the weights by a power of the likelihoods, at most `most`. Returns the power.
    fn reweight(&mut self, logs: &[f64], most: f64) -> f64 {
        let min_effective =
            self.config.tempering.min_effective_fraction * self.particles.len() as f64;
        let power = exponent(&self.particles.weights(), logs, min_effective, most);
        let tempered: Vec<f64> = logs.iter().map(|log| power * log).collect();
        self.particles.reweight(&tempered);
        power
    }

    /// Estimate of an updated frame, which is kept for the next frames.
    fn estimate_of(&mut self, update: &Update) -> Estimate {
        let pose = self.particles.mean();
        let is_narrow = self.is_narrow();
        let was_narrow = std::mem::replace(&mut self.is_narrow, is_narrow);
        // A jump of a wide distribution is not a motion of the car.
        if was_narrow && is_narrow {
            self.last_increment = Some(self.estimate.inverse() * pose);
        }
        self.estimate = pose;
        self.covariance = self.particles.covariance_of_estimate();
        let (map_from_lidar, on_mapped_ground) = self.lift_estimate(&pose, &update.attitude);
        Estimate {
            pose,
            map_from_lidar,
            attitude: update.attitude,
            level_m: self.patch.map(|patch| patch.height_m),
            covariance: self.covariance,
            effective_sample_size: update.effective_sample_size,
            mean_cost_m: update.mean_cost_m,
            agreement: None,
            state: self.state,
            updated: true,
            on_mapped_ground,
            particles: self.particles.clone(),
        }
    }

    /// Lifts the estimate onto the ground below it (`true`) or onto the last known ground (`false`).
    fn lift_estimate(&mut self, pose: &Pose2, attitude: &SensorAttitude) -> (Pose3, bool) {
        let found = self.patch_at(pose);
        self.patch = found.or(self.patch);
        let level = GroundPatch {
            height_m: 0.0,
            normal: nalgebra::Vector3::z(),
        };
        let patch = self.patch.unwrap_or(level);
        (patch.lift(pose, attitude), found.is_some())
    }

    fn agreement(
        &self,
        map_from_lidar: &Pose3,
        beams: &[Beam],
        attitude: &SensorAttitude,
    ) -> Result<Option<f64>, RenderError> {
        /// Kerbs and low plants do not distinguish places [m].
        const CLEARANCE_M: f32 = 0.5;
        let beams = above_road(beams, attitude, CLEARANCE_M);
        let directions: Vec<_> = beams.iter().map(|beam| beam.direction).collect();
        let rendered = self.map.renderer.cast(&[*map_from_lidar], &directions)?;
        let tolerance_m = self.config.tracking_loss.tolerance_m;
        Ok(rendered
            .first()
            .and_then(|rendered_m| BeamAgreement::of(&beams, rendered_m, tolerance_m).share()))
    }

    fn is_narrow(&self) -> bool {
        is_narrow(&self.particles, &self.config.convergence)
    }

    fn is_converged(&self) -> bool {
        let convergence = &self.config.convergence;
        is_converged(&self.particles, &self.map.tiles, convergence)
    }

    fn change_state(&mut self, agreement: Option<f64>, odometry: Odometry) {
        // Without a known motion the next frame cannot be predicted.
        let knows_motion = odometry != Odometry::Unknown || self.last_increment.is_some();
        let converged = self.is_converged() && knows_motion;
        if converged || self.state == State::Tracking {
            self.agreement
                .observe(agreement, &self.config.tracking_loss);
        }
        let covariance = self.particles.covariance_about(&self.particles.mean());
        let is_spread = self.state == State::Tracking
            && spread(&covariance).0 > self.config.tracking_loss.max_spread_m;
        let is_lost = is_spread || self.agreement.is_lost(&self.config.tracking_loss);
        let is_stuck = self.updates_in_state >= self.config.tracking_loss.patience;
        let next = match self.state {
            _ if is_lost => State::Lost,
            State::Searching if converged => State::Tracking,
            State::Searching if is_stuck => State::Lost,
            State::Lost if converged => State::Tracking,
            state => state,
        };
        self.updates_in_state = if next == self.state {
            self.updates_in_state + 1
        } else {
            0
        };
        self.state = next;
    }
}

/// Weighted mean of the costs of the particles that have one [m].
fn weighted_mean(particles: &ParticleSet, costs: &[Option<f64>]) -> Option<f64> {
    let (sum, weight) = particles
        .particles()
        .iter()
        .zip(costs)
        .filter_map(|(particle, cost)| cost.map(|cost_m| (particle.weight, cost_m)))
        .fold((0.0, 0.0), |(sum, weight), (w, cost_m)| {
            (sum + w * cost_m, weight + w)
        });
    (weight > 0.0).then(|| sum / weight)
}

#[cfg(test)]
#[path = "filter_tests.rs"]
mod tests;

#[cfg(test)]
#[path = "level_tests.rs"]
mod level_tests;
