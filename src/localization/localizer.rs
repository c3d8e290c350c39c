//! The loop of Monte Carlo localization: move, weigh, resample, and say where the car is.
//!
//! ```text
//! propagate      x ~ p(x | x_before, odometry)           motion
//! reweight       w ∝ w · p(scan | x, map)ᵝ               observation, tempering
//! estimate       weighted mean, covariance, state        particles, vigilance
//! resample       where few particles carry the weight    resampling
//! ```
//!
//! While the car searches, reweighting and resampling alternate several times within one frame,
//! from a blunt to a sharp likelihood (annealing). Once the belief is narrow, `num_reduced`
//! particles are enough; they are drawn where odometry and scan agree ([`proposal`](super::proposal)).

use std::time::Duration;

use nalgebra::Matrix3;
use rand::Rng;

use super::convergence::{is_converged, is_narrow};
use super::estimate::FrameEstimate;
use super::motion::{TurnDriveTurn, VelocityCommand};
use super::observation::{Fit, above_road, choose_beams, costs, footing, near_points};
use super::odometry::Odometry;
use super::panorama::Panoramas;
use super::particles::{Particle, ParticleSet, spread};
use super::resampling::systematic;
use super::settings::LocalizerConfig;
use super::tempering::exponent;
use super::vigilance::{State, Vigilance};
use crate::geometry::{Pose2, Pose3};
use crate::lidar::{Beam, RangeImage};
use crate::map::{GroundMap, GroundPatch, Stance, TileGrid};
use crate::rendering::{RangeRenderer, RenderError};

mod coasting;
mod drawing;
mod renewal;

/// What the filter knows of the map.
#[derive(Clone, Copy)]
pub struct Surroundings<'a> {
    /// Shows the map.
    pub renderer: &'a dyn RangeRenderer,
    /// Carries the poses.
    pub ground: &'a GroundMap,
    /// Where the map is.
    pub tiles: &'a TileGrid,
    /// Where to begin anew when lost; without it, the filter says that it is lost and stays so.
    pub panoramas: Option<&'a Panoramas<'a>>,
}

/// A belief about where the car is, frame by frame.
pub struct Localizer<'a> {
    /// The settings.
    pub config: LocalizerConfig,
    surroundings: Surroundings<'a>,
    particles: ParticleSet,
    /// Motion since the last update, `updated_from_current`.
    pending: Pose2,
    /// How long velocity commands have been held since then.
    pending_duration: Duration,
    /// The last estimate, whether the belief around it was narrow, and the motion into it, once
    /// that is known: for frames without odometry.
    estimate: Pose2,
    is_narrow: bool,
    last_increment: Option<Pose2>,
    /// Covariance of the last estimate of a weighed frame [m², m·rad, rad²].
    covariance: Matrix3<f64>,
    patch: Option<GroundPatch>,
    stance: Option<Stance>,
    state: State,
    vigilance: Vigilance,
    updates_in_state: usize,
    is_first: bool,
}

/// What weighing found.
struct Weighing {
    effective_sample_size: f64,
    mean_cost_m: Option<f64>,
    /// The beams of the last round.
    beams: Vec<Beam>,
    /// How the sensor stands over the road, as well as the frame can tell.
    stance: Stance,
}

impl<'a> Localizer<'a> {
    /// Begins with a belief; see [`initialization`](super::initialization) and
    /// [`PanoramaIndex::sample`] for where to get it.
    pub fn new(
        config: LocalizerConfig,
        surroundings: Surroundings<'a>,
        particles: ParticleSet,
    ) -> Self {
        let estimate = particles.mean();
        let level_m = particles.best().level_m;
        let covariance = particles.covariance_about(&estimate);
        Self {
            config,
            surroundings,
            covariance,
            particles,
            pending: Pose2::identity(),
            pending_duration: Duration::ZERO,
            estimate,
            is_narrow: false,
            last_increment: None,
            patch: surroundings.ground.patch_under(&estimate, level_m),
            stance: None,
            state: State::Searching,
            vigilance: Vigilance::default(),
            updates_in_state: 0,
            is_first: true,
        }
    }

    /// Takes in a frame: how the car moved since the frame before, what it sees and how the
    /// sensor stands over the road. The odometry of the first frame does not count.
    pub fn step(
        &mut self,
        odometry: Odometry,
        scan: &RangeImage,
        stance: &Stance,
        rng: &mut impl Rng,
    ) -> Result<FrameEstimate, RenderError> {
        if !self.is_first {
            self.pending *= self.increment(odometry);
            if let Odometry::Velocity(command) = odometry {
                self.pending_duration += command.duration;
            }
        }
        if !self.is_update_due(odometry) {
            return Ok(self.coast(odometry, stance));
        }
        self.propagate(odometry, rng);
        let weighing = match self.propose(scan, stance, rng)? {
            Some(proposal) => self.weigh_drawn(proposal, rng)?,
            None => self.weigh_in_rounds(scan, stance, rng)?,
        };
        let mut frame = self.conclude(&weighing);
        frame.agreement = self.agreement(&frame.lifted, &weighing.beams, &weighing.stance)?;
        self.stance = Some(weighing.stance);
        self.change_state(frame.agreement, odometry);
        frame.state = self.state;
        self.prepare_next(scan, stance, rng)?;
        Ok(frame)
    }

    /// What the filter believes about itself.
    pub fn state(&self) -> State {
        self.state
    }

    /// The belief as it goes into the next frame.
    pub fn particles(&self) -> &ParticleSet {
        &self.particles
    }

    /// How the sensor stood over the road in the last frame, where the next can begin from there:
    /// while tracking, the map tells more than the plane of the road that a scan sees.
    pub fn stance(&self) -> Option<Stance> {
        let proposes = self.config.proposal.scan && self.state == State::Tracking;
        self.stance.filter(|_| proposes)
    }

    fn increment(&self, odometry: Odometry) -> Pose2 {
        match odometry {
            Odometry::Increment(previous_from_current) => previous_from_current,
            Odometry::Velocity(command) => command.compose(),
            Odometry::Unknown => self.last_increment.unwrap_or_else(Pose2::identity),
        }
    }

    /// Without odometry only the scan can tell whether the car moves.
    fn is_update_due(&self, odometry: Odometry) -> bool {
        self.is_first
            || odometry == Odometry::Unknown
            || self.pending.translation.vector.norm() > self.config.move_thres_m
            || self.pending.rotation.angle().abs() > self.config.turn_thres_rad
    }

    fn propagate(&mut self, odometry: Odometry, rng: &mut impl Rng) {
        if !self.is_first {
            if odometry == Odometry::Unknown && self.last_increment.is_none() {
                // The belief will be as wide as at the start, and needs as many particles.
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

    /// Weighs the particles by the scan, in one round or several.
    fn weigh_in_rounds(
        &mut self,
        scan: &RangeImage,
        stance: &Stance,
        rng: &mut impl Rng,
    ) -> Result<Weighing, RenderError> {
        let rounds = match self.state {
            State::Tracking => self.config.tempering.tracking_rounds,
            State::Searching | State::Lost => self.config.tempering.searching_rounds,
        };
        let (mut left, mut round) = (1.0, 1);
        loop {
            let observation = &self.config.observation;
            let count = observation.beams_for(self.particles.len());
            let beams = choose_beams(scan, count, observation.road_share, stance, rng);
            let settled = self.settled(scan, stance);
            let (logs, costs) = self.log_likelihoods(&beams, &settled)?;
            let used = self.reweight(&logs, left);
            left -= used;
            if round >= rounds || left <= 0.0 || used <= 0.0 {
                return Ok(Weighing {
                    effective_sample_size: self.particles.effective_sample_size(),
                    mean_cost_m: weighted_mean(&self.particles, &costs),
                    beams,
                    stance: self.settled(scan, stance),
                });
            }
            self.resample(rng);
            round += 1;
        }
    }

    /// How the sensor stands over the road: where the belief is narrow, as the returns from the
    /// road lie on the mapped ground; else as the scan alone says.
    fn settled(&self, scan: &RangeImage, stance: &Stance) -> Stance {
        if !self.is_narrow() {
            return *stance;
        }
        let points = near_points(scan);
        self.surroundings
            .ground
            .stance_at(&self.particles.mean(), self.level_m(), stance, &points)
            .unwrap_or(*stance)
    }

    /// The ground under a pose of about where the particles are.
    fn patch_at(&self, pose: &Pose2) -> Option<GroundPatch> {
        self.surroundings.ground.patch_under(pose, self.level_m())
    }

    /// Height of the ground that the best particle stands on [m].
    fn level_m(&self) -> Option<f64> {
        self.particles.best().level_m
    }

    /// Puts the particles onto the map's ground; returns where in space they are.
    fn stand(&mut self, stance: &Stance) -> Vec<Option<Pose3>> {
        let Surroundings { ground, tiles, .. } = self.surroundings;
        let remembered = self.patch.filter(|_| self.state == State::Tracking);
        let members = self.particles.particles();
        let patches: Vec<Option<GroundPatch>> = members
            .iter()
            .map(|particle| footing(&particle.hypothesis(), ground, tiles, remembered.as_ref()))
            .collect();
        let lift = |(particle, patch): (&Particle, &Option<GroundPatch>)| {
            Some(patch.as_ref()?.lift(&particle.map_from_lidar, stance))
        };
        let poses = members.iter().zip(&patches).map(lift).collect();
        let levels_m = patches
            .iter()
            .map(|patch| patch.map(|patch| patch.height_m));
        self.particles.stand(levels_m);
        poses
    }

    /// Logarithms of the likelihood of the particles, up to a constant, and the mean costs that they
    /// come from [m].
    fn log_likelihoods(
        &mut self,
        beams: &[Beam],
        stance: &Stance,
    ) -> Result<(Vec<f64>, Vec<Option<f64>>), RenderError> {
        let poses = self.stand(stance);
        let observation = &self.config.observation;
        let difference = observation.difference();
        let costs = costs(self.surroundings.renderer, &poses, beams, &difference)?;
        let log = |cost: &Option<f64>| {
            cost.map_or(observation.floor_log_likelihood(), |cost_m| {
                observation.log_likelihood(cost_m)
            })
        };
        Ok((costs.iter().map(log).collect(), costs))
    }

    /// Multiplies the weights by a power of what the logarithms say, at most `most`. Returns the
    /// power.
    fn reweight(&mut self, logs: &[f64], most: f64) -> f64 {
        let min_effective =
            self.config.tempering.min_effective_fraction * self.particles.len() as f64;
        let power = exponent(&self.particles.weights(), logs, min_effective, most);
        let tempered: Vec<f64> = logs.iter().map(|log| power * log).collect();
        self.particles.reweight(&tempered);
        power
    }

    /// The estimate of a weighed frame, which becomes what the filter remembers.
    fn conclude(&mut self, weighing: &Weighing) -> FrameEstimate {
        let pose = self.particles.mean();
        let is_narrow = self.is_narrow();
        let was_narrow = std::mem::replace(&mut self.is_narrow, is_narrow);
        // A wide belief that jumps is no motion.
        if was_narrow && is_narrow {
            self.last_increment = Some(self.estimate.inverse() * pose);
        }
        self.estimate = pose;
        self.covariance = self.particles.covariance_of_estimate();
        let (lifted, on_mapped_ground) = self.lift_estimate(&pose, &weighing.stance);
        FrameEstimate {
            pose,
            lifted,
            level_m: self.patch.map(|patch| patch.height_m),
            covariance: self.covariance,
            effective_sample_size: weighing.effective_sample_size,
            mean_cost_m: weighing.mean_cost_m,
            agreement: None,
            state: self.state,
            updated: true,
            on_mapped_ground,
            particles: self.particles.clone(),
        }
    }

    /// Lifts the estimate onto the ground, or onto the last ground that there was; says which.
    fn lift_estimate(&mut self, pose: &Pose2, stance: &Stance) -> (Pose3, bool) {
        let found = self.patch_at(pose);
        self.patch = found.or(self.patch);
        let level = GroundPatch {
            height_m: 0.0,
            normal: nalgebra::Vector3::z(),
        };
        let patch = self.patch.unwrap_or(level);
        (patch.lift(pose, stance), found.is_some())
    }

    fn agreement(
        &self,
        lifted: &Pose3,
        beams: &[Beam],
        stance: &Stance,
    ) -> Result<Option<f64>, RenderError> {
        /// Kerbs and low plants are not what tells places apart [m].
        const CLEARANCE_M: f32 = 0.5;
        let beams = above_road(beams, stance, CLEARANCE_M);
        let directions: Vec<_> = beams.iter().map(|beam| beam.direction).collect();
        let rendered = self.surroundings.renderer.cast(&[*lifted], &directions)?;
        let tolerance_m = self.config.vigilance.tolerance_m;
        Ok(rendered
            .first()
            .and_then(|rendered_m| Fit::of(&beams, rendered_m, tolerance_m).agreement()))
    }

    fn is_narrow(&self) -> bool {
        is_narrow(&self.particles, &self.config.convergence)
    }

    fn is_converged(&self) -> bool {
        let convergence = &self.config.convergence;
        is_converged(&self.particles, self.surroundings.tiles, convergence)
    }

    fn change_state(&mut self, agreement: Option<f64>, odometry: Odometry) {
        // Who does not know how the car moves does not know where it will be in the next frame.
        let knows_motion = odometry != Odometry::Unknown || self.last_increment.is_some();
        let converged = self.is_converged() && knows_motion;
        if converged || self.state == State::Tracking {
            self.vigilance.observe(agreement, &self.config.vigilance);
        }
        let covariance = self.particles.covariance_about(&self.particles.mean());
        let is_spread = self.state == State::Tracking
            && spread(&covariance).0 > self.config.vigilance.max_spread_m;
        let is_lost = is_spread || self.vigilance.is_lost(&self.config.vigilance);
        let is_stuck = self.updates_in_state >= self.config.vigilance.patience;
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

/// The weighted mean of the costs of the particles that have one [m].
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
#[path = "localizer_tests.rs"]
mod tests;

#[cfg(test)]
#[path = "level_tests.rs"]
mod level_tests;
