//! One step of the filter: propagation, measurement update, change of the state, resampling.

use std::time::Duration;

use rand::Rng;

use super::state::ParticleFilter;
use crate::geometry::{Pose2, Pose3};
use crate::lidar::{Beam, PERIOD_S, RangeImage};
use crate::localization::convergence::is_converged;
use crate::localization::estimate::Estimate;
use crate::localization::motion::{TurnDriveTurn, VelocityCommand};
use crate::localization::observation::{above_road, agreement, ranges_along};
use crate::localization::odometry::Odometry;
use crate::localization::particles::spread;
use crate::localization::resampling::systematic;
use crate::localization::tracking_loss::State;
use crate::map::SensorAttitude;
use crate::rendering::RenderError;

impl ParticleFilter {
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
            self.accumulate(odometry);
        }
        if !self.is_update_due(odometry) {
            return Ok(self.coast(odometry, attitude));
        }
        self.propagate(odometry, rng);
        let update = match self.propose(scan, attitude, rng)? {
            Some(proposal) => self.sample_and_weight(proposal, scan, rng)?,
            None => self.reweight_widely(scan, attitude, rng)?,
        };
        let mut estimate = self.updated_estimate(&update);
        estimate.agreement =
            self.agreement_at(&estimate.map_from_lidar, &update.beams, &update.attitude)?;
        self.attitude = Some(update.attitude);
        self.change_state(estimate.agreement, odometry);
        self.is_sure = self.state != State::Tracking
            || !self.is_too_wide(&estimate.covariance)
                && (self.is_sure
                    || (self.agreement).is_usual(estimate.agreement, &self.config.tracking_loss));
        estimate.places = self.likely_places();
        estimate.state = self.reported_state(&estimate.covariance);
        self.prepare_next(scan, attitude, rng)?;
        Ok(estimate)
    }

    /// Adds the motion into a frame to the motion since the last update.
    fn accumulate(&mut self, odometry: Odometry) {
        self.pending *= self.increment(odometry);
        if let Odometry::Velocity(command) = odometry {
            self.pending_duration += command.duration;
        }
    }

    /// Motion into a frame.
    pub(super) fn increment(&self, odometry: Odometry) -> Pose2 {
        odometry.in_plane().unwrap_or_else(|| {
            let last = self.last_increment.unwrap_or_else(Pose2::identity);
            let share = self.duration_s / self.last_duration_s;
            let translation = last.translation.vector * share;
            Pose2::new(translation, last.rotation.angle() * share)
        })
    }

    /// Without odometry every scan is used: nothing else shows whether the car moves.
    fn is_update_due(&self, odometry: Odometry) -> bool {
        self.is_first
            || odometry == Odometry::Unknown
            || self.pending.translation.vector.norm() > self.config.move_thres_m
            || self.pending.rotation.angle().abs() > self.config.turn_thres_rad
    }

    /// Moves the particles by noisy copies of the motion since the last update.
    fn propagate(&mut self, odometry: Odometry, rng: &mut impl Rng) {
        if !self.is_first {
            if odometry == Odometry::Unknown && self.last_increment.is_none() {
                // The distribution becomes as wide as at the start and needs as many particles.
                let weights = self.particles.weights();
                let indices = systematic(&weights, self.config.num_particles, rng);
                self.particles = self.particles.selected(&indices);
            }
            let config = &self.config;
            if let Odometry::Velocity(_) = odometry {
                let command = VelocityCommand::driving(&self.pending, self.pending_duration);
                self.particles
                    .propagate(|pose| pose * command.sample(&config.velocity, rng));
            } else {
                let motion = TurnDriveTurn::decompose(&self.pending);
                let periods = self.duration_s / PERIOD_S;
                let noise = match (odometry, self.last_increment) {
                    (Odometry::Unknown, None) => config.unknown_velocity.scaled(periods),
                    (Odometry::Unknown, Some(_)) => config.constant_velocity.scaled(periods),
                    _ => config.motion.clone(),
                };
                self.particles
                    .propagate(|pose| pose * motion.sample(&noise, rng));
            }
        }
        self.is_first = false;
        self.pending = Pose2::identity();
        self.pending_duration = Duration::ZERO;
    }

    /// Share of the beams above the road that agree with the map at a pose.
    fn agreement_at(
        &self,
        map_from_lidar: &Pose3,
        beams: &[Beam],
        attitude: &SensorAttitude,
    ) -> Result<Option<f64>, RenderError> {
        /// Kerbs and low plants do not distinguish places [m].
        const CLEARANCE_M: f32 = 0.5;
        let beams = above_road(beams, attitude, CLEARANCE_M);
        let tolerance_m = self.config.tracking_loss.tolerance_m;
        let rendered_m = ranges_along(&*self.map.renderer, map_from_lidar, &beams, tolerance_m)?;
        Ok(agreement(&beams, &rendered_m, tolerance_m))
    }

    fn change_state(&mut self, agreement: Option<f64>, odometry: Odometry) {
        let config = &self.config.tracking_loss;
        // Without a known motion the next frame cannot be predicted.
        let knows_motion = odometry != Odometry::Unknown || self.last_increment.is_some();
        let is_converged = knows_motion
            && is_converged(&self.particles, &self.map.tiles, &self.config.convergence);
        if is_converged || self.state == State::Tracking {
            self.agreement.observe(agreement, config);
        }
        let covariance = self.particles.covariance_about(&self.particles.mean());
        let is_wide = self.state == State::Tracking && spread(&covariance).0 > config.max_spread_m;
        let is_lost = is_wide || self.agreement.is_lost(config);
        let is_found = self.agreement.confirm(is_converged, agreement, config);
        // Places that look alike and agree with the scan are told apart by driving.
        let are_alike = self.compares_places() && agreement >= Some(config.min_agreement);
        let is_stuck = self.updates_in_state >= config.patience;
        let next = match self.state {
            _ if is_lost => State::Lost,
            State::Searching if is_found => State::Tracking,
            State::Searching if is_stuck => State::Lost,
            State::Lost if is_found => State::Tracking,
            state => state,
        };
        self.updates_in_state = match next == self.state && !are_alike {
            true => self.updates_in_state + 1,
            false => 0,
        };
        self.state = next;
    }
}
