//! One step of the filter: propagation, measurement update, change of the phase, resampling.

use rand::Rng;

use super::phase::Evidence;
use super::state::{ParticleFilter, Pending};
use crate::geometry::{Pose2, Pose3};
use crate::lidar::{Beam, PERIOD_S, RangeImage};
use crate::localization::convergence::is_converged;
use crate::localization::estimate::Estimate;
use crate::localization::motion::{TurnDriveTurn, VelocityCommand};
use crate::localization::observation::{above_road, agreement, ranges_along};
use crate::localization::odometry::Odometry;
use crate::localization::particles::spread;
use crate::localization::resampling::systematic;
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
        self.accumulate(odometry);
        if !self.is_update_due(odometry) {
            return self.coast(odometry, attitude);
        }
        self.propagate(odometry, rng);
        let update = match self.propose(scan, attitude, rng)? {
            Some(proposal) => self.sample_and_weight(proposal, scan, rng)?,
            None => self.reweight_widely(scan, attitude, rng)?,
        };
        let mut estimate = self.updated_estimate(&update)?;
        estimate.agreement =
            self.agreement_at(&estimate.map_from_lidar, &update.beams, &update.attitude)?;
        self.attitude = Some(update.attitude);
        let evidence = self.evidence(&estimate, odometry);
        self.phase = (self.phase).after(&evidence, self.config.tracking_loss.patience);
        estimate.places = self.likely_places();
        estimate.state = self.phase.reported(evidence.is_precise);
        self.prepare_next(scan, attitude, rng)?;
        Ok(estimate)
    }

    /// Adds the motion into a frame to the motion since the last update.
    fn accumulate(&mut self, odometry: Odometry) {
        let increment = self.increment(odometry);
        let Some(pending) = &mut self.pending else {
            return;
        };
        pending.motion *= increment;
        if let Odometry::Velocity(command) = odometry {
            pending.duration += command.duration;
        }
    }

    /// Motion into a frame.
    pub(super) fn increment(&self, odometry: Odometry) -> Pose2 {
        odometry.in_plane().unwrap_or_else(|| {
            let Some(last) = &self.last_motion else {
                return Pose2::identity();
            };
            let share = self.duration_s / last.duration_s;
            let translation = last.increment.translation.vector * share;
            Pose2::new(translation, last.increment.rotation.angle() * share)
        })
    }

    /// Without odometry every scan is used: nothing else shows whether the car moves.
    fn is_update_due(&self, odometry: Odometry) -> bool {
        let moved_far = |pending: &Pending| {
            pending.motion.translation.vector.norm() > self.config.move_thres_m
                || pending.motion.rotation.angle().abs() > self.config.turn_thres_rad
        };
        odometry == Odometry::Unknown || self.pending.as_ref().is_none_or(moved_far)
    }

    /// Moves the particles by noisy copies of the motion since the last update.
    fn propagate(&mut self, odometry: Odometry, rng: &mut impl Rng) {
        let Some(pending) = self.pending.replace(Pending::default()) else {
            return;
        };
        if odometry == Odometry::Unknown && self.last_motion.is_none() {
            // The distribution becomes as wide as at the start and needs as many particles.
            let weights = self.particles.weights();
            let indices = systematic(&weights, self.config.num_particles, rng);
            self.particles = self.particles.selected(&indices);
        }
        let config = &self.config;
        if let Odometry::Velocity(_) = odometry {
            let command = VelocityCommand::driving(&pending.motion, pending.duration);
            self.particles
                .propagate(|pose| pose * command.sample(&config.velocity, rng));
        } else {
            let motion = TurnDriveTurn::decompose(&pending.motion);
            let periods = self.duration_s / PERIOD_S;
            let noise = match (odometry, &self.last_motion) {
                (Odometry::Unknown, None) => config.unknown_velocity.scaled(periods),
                (Odometry::Unknown, Some(_)) => config.constant_velocity.scaled(periods),
                _ => config.motion.clone(),
            };
            self.particles
                .propagate(|pose| pose * motion.sample(&noise, rng));
        }
    }

    /// Share of the beams above the road that agree with the map at a pose.
    fn agreement_at(
        &self,
        map_from_lidar: &Pose3,
        beams: &[Beam],
        attitude: &SensorAttitude,
    ) -> Result<Option<f64>, RenderError> {
        let config = &self.config.tracking_loss;
        let beams = above_road(beams, attitude, config.low_height_m);
        let tolerance_m = config.tolerance_m;
        let rendered_m = ranges_along(&*self.map.renderer, map_from_lidar, &beams, tolerance_m)?;
        Ok(agreement(&beams, &rendered_m, tolerance_m))
    }

    /// What an update shows, of which the averages of the agreement are kept.
    fn evidence(&mut self, estimate: &Estimate, odometry: Odometry) -> Evidence {
        let config = &self.config.tracking_loss;
        let agreement = estimate.agreement;
        // Without a known motion the next frame cannot be predicted.
        let knows_motion = odometry != Odometry::Unknown || self.last_motion.is_some();
        let is_converged = knows_motion
            && is_converged(&self.particles, &self.map.tiles, &self.config.convergence);
        if is_converged || self.phase.is_tracking() {
            self.agreement.observe(agreement, config);
        }
        let covariance = self.particles.covariance_about(&self.particles.mean());
        Evidence {
            disagrees: self.agreement.is_lost(config),
            is_scattered: spread(&covariance).0 > config.max_spread_m,
            is_confirmed: self.agreement.confirm(is_converged, agreement, config),
            are_alike: agreement >= Some(config.min_agreement) && self.compares_places(),
            is_precise: self.is_precise(&estimate.covariance),
            is_usual: self.agreement.is_usual(agreement, config),
        }
    }
}
