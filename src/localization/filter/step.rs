//! One step of the filter: propagation, measurement update, change of the phase, resampling.

use std::mem;

use nalgebra::Matrix3;
use rand::Rng;

use super::phase::{Evidence, Phase, Search};
use super::reweight::{Compared, Others, Update};
use super::state::{ParticleFilter, Pending};
use crate::geometry::{Pose2, Pose3};
use crate::lidar::{Beam, PERIOD_S, RangeImage};
use crate::localization::convergence::is_converged;
use crate::localization::estimate::Estimate;
use crate::localization::motion::{TurnDriveTurn, VelocityCommand};
use crate::localization::observation::{above_road, agreement, choose_beams, ranges_along};
use crate::localization::odometry::Odometry;
use crate::localization::particles::{long_axis_m, spread};
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
        let start = self.registration_start.take();
        self.accumulate(odometry);
        if !self.is_update_due(odometry)
            && let Some(coasted) = self.coast_unless_contradicted(odometry, scan, attitude, rng)?
        {
            return Ok(coasted);
        }
        self.propagate(odometry, rng);
        let posterior = if self.phase.is_tracking() {
            self.propose(scan, (attitude, self.predicted), start, rng)?
        } else if self.has_converged_unconfirmed() {
            self.propose_widely(scan, (attitude, None), rng)?
        } else {
            None
        };
        let predicted = self.phase.is_tracking().then(|| self.particles.clone());
        let mut update = match posterior {
            Some(posterior) => self.sample(posterior, rng),
            None => self.reweight_widely(scan, attitude, rng)?,
        };
        let mut compared = self.compared(&update)?;
        let was_one_of_several = self.updated.is_one_of_several;
        let config = &self.config.tracking_loss;
        let is_suspect = matches!(odometry, Odometry::Assumed(_))
            || self.updated.doubtful_s.is_some()
            || update.refutes
            || (self.agreement).suggests_another_pose(compared.agreement, config);
        if let Some(predicted) = predicted.filter(|_| is_suspect) {
            let predicted_mean = predicted.mean();
            let updated = mem::replace(&mut self.particles, predicted);
            let here = compared.in_space.map_from_lidar;
            let (better, others) =
                self.search_around(scan, (attitude, self.predicted), &here, rng)?;
            let is_sure = match better {
                Some(posterior) => {
                    update = self.sample(posterior, rng);
                    compared = self.compared(&update)?;
                    compared.agreement >= Some(self.config.tracking_loss.sure_agreement)
                }
                None => {
                    self.particles = updated;
                    let there = update.pose.unwrap_or_else(|| self.particles.mean());
                    !update.refutes || self.is_reachable(&predicted_mean, &there)
                }
            };
            if is_sure || others == Others::Alike {
                update.others = others;
            }
        }
        let mut estimate = self.updated_estimate(&update, compared)?;
        // The share of this scan is judged by those before it.
        let earlier_agreement = self.agreement;
        let mut evidence = self.evidence(&estimate, odometry, update.needs_confirmation());
        let is_found = evidence.is_confirmed && !self.phase.is_tracking();
        let found_at = (&update.attitude, Some(estimate.map_from_lidar));
        if is_found && let Some(posterior) = self.propose(scan, found_at, None, rng)? {
            if posterior.refutes {
                update = self.sample(posterior, rng);
                let compared = self.compared(&update)?;
                estimate = self.updated_estimate(&update, compared)?;
            } else {
                // The scan was used for the planar pose. Height, roll and pitch are those of the registration where they fit.
                let (attitude, ground) = (&posterior.attitude, Some(posterior.ground));
                let there = self.lift(&estimate.pose, attitude, ground)?;
                let share = self.agreement_at(&there.map_from_lidar, &update.beams, attitude)?;
                if share >= estimate.agreement {
                    self.in_space = Some(there);
                    estimate.map_from_lidar = there.map_from_lidar;
                    estimate.attitude = there.attitude;
                    estimate.agreement = share;
                }
            }
        }
        if update.needs_confirmation() {
            evidence = evidence.refuted();
        }
        self.phase = (self.phase).after(&evidence, self.config.tracking_loss.patience);
        estimate.places = self.likely_places();
        let is_doubtful =
            earlier_agreement.is_doubtful(estimate.agreement, &self.config.tracking_loss);
        let is_sure = evidence.is_precise
            && estimate.agreement.is_some()
            && !(is_doubtful || was_one_of_several);
        estimate.state = self.phase.reported(is_sure);
        self.prepare_next(scan, attitude, rng)?;
        Ok(estimate)
    }

    /// Whether the particles are at one pose that the last scan did not confirm. They have the attitude and height that are assumed,
    /// and converge next to the right pose where a hand tilts the sensor.
    fn has_converged_unconfirmed(&self) -> bool {
        let is_one_place =
            !matches!(self.phase.search(), Some(Search::Places { likely }) if likely > 1);
        self.phase.is_unconfirmed() && is_one_place && self.is_narrow()
    }

    /// Compares the pose of an update with the map.
    pub(super) fn compared(&self, update: &Update) -> Result<Compared, RenderError> {
        let pose = update.pose.unwrap_or_else(|| self.particles.mean());
        let in_space = self.lift(&pose, &update.attitude, update.ground)?;
        let map_from_lidar = &in_space.map_from_lidar;
        Ok(Compared {
            in_space,
            agreement: self.agreement_at(map_from_lidar, &update.beams, &update.attitude)?,
        })
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

    /// Without measured odometry every scan is used: nothing else shows whether the car moves. So is one after a doubtful pose.
    fn is_update_due(&self, odometry: Odometry) -> bool {
        let is_due = |pending: &Pending| {
            pending.motion.translation.vector.norm() > self.config.move_thres_m
                || pending.motion.rotation.angle().abs() > self.config.turn_thres_rad
                || self.is_less_certain(pending, odometry)
        };
        let is_assumed = matches!(odometry, Odometry::Unknown | Odometry::Assumed(_));
        is_assumed || self.updated.doubtful_s.is_some() || self.pending.as_ref().is_none_or(is_due)
    }

    /// Whether a pose that is tracked and registered is less certain, by the motion since the last update, than that left it.
    fn is_less_certain(&self, pending: &Pending, odometry: Odometry) -> bool {
        /// Ratio of the standard deviations of the position.
        const RATIO: f64 = 2.0;
        let of_map = self.config.proposal.registration.of_map();
        let deviation_m = |covariance: Matrix3<f64>| long_axis_m(&(covariance + of_map));
        self.config.proposal.scan
            && self.phase.is_tracking()
            && deviation_m(self.covariance_after(pending, odometry))
                > RATIO * deviation_m(self.updated.covariance)
    }

    /// The prediction of a frame in which the car hardly moved; `None` where its scan contradicts a pose that is tracked:
    /// then it moved, whatever the odometry says.
    fn coast_unless_contradicted(
        &mut self,
        odometry: Odometry,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Option<Estimate>, RenderError> {
        let mut coasted = self.coast(odometry, attitude)?;
        let config = &self.config.proposal;
        let beams = choose_beams(
            scan,
            config.compared_beams,
            config.road_share,
            attitude,
            rng,
        );
        coasted.agreement = self.agreement_at(&coasted.map_from_lidar, &beams, attitude)?;
        let (agreement, config) = (coasted.agreement, &self.config.tracking_loss);
        let contradicts = agreement.is_some_and(|share| share < config.min_agreement)
            || self.agreement.is_far_below_usual(agreement, config);
        if contradicts && self.phase == Phase::Tracking {
            return Ok(None);
        }
        let is_doubtful = contradicts || self.agreement.is_doubtful(agreement, config);
        let is_sure = self.is_precise(&coasted.covariance) && agreement.is_some() && !is_doubtful;
        coasted.state = self.phase.reported(is_sure);
        Ok(Some(coasted))
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
                (Odometry::Unknown, Some(_)) | (Odometry::Assumed(_), _) => {
                    config.constant_velocity.scaled(periods)
                }
                _ => config.motion.clone(),
            };
            self.particles
                .propagate(|pose| pose * motion.sample(&noise, rng));
        }
    }

    /// Share of the beams above the road that agree with the map at a pose.
    pub(super) fn agreement_at(
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

    /// What an update shows, of which the averages of the agreement are kept. A pose that the next scan has to confirm restarts the
    /// count.
    fn evidence(
        &mut self,
        estimate: &Estimate,
        odometry: Odometry,
        needs_confirmation: bool,
    ) -> Evidence {
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
            is_confirmed: self.agreement.confirm(
                is_converged && !needs_confirmation,
                agreement,
                config,
            ),
            are_alike: agreement >= Some(config.min_agreement) && self.compares_places(),
            is_precise: self.is_precise(&estimate.covariance),
            is_twice_as_precise: self.is_precise(&(estimate.covariance * 4.0)),
            is_usual: self.agreement.is_usual(agreement, config),
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use rand::{SeedableRng as _, rngs::StdRng};

    use super::super::phase::Phase;
    use super::super::state::LastMotion;
    use super::*;
    use crate::localization::motion::OdometryNoise;
    use crate::localization::{LocalizerConfig, ParticleSet};
    use crate::map::world_for_tests::TestWorld;

    #[test]
    fn motion_and_noise_of_the_prediction_without_odometry_are_proportional_to_the_time() {
        const COUNT: usize = 10_000;
        let world = TestWorld::street();
        let start = world.pose_at(3.0, 1.0, 0.7);
        // Of the constant velocity, then of an unknown one.
        for (last_m, turn_rad, drive_m, side_m) in
            [(Some(1.0), 0.02, 0.2, 0.1), (None, 0.05, 0.5, 0.3)]
        {
            let noise = OdometryNoise::constant(turn_rad, drive_m, side_m);
            let config = LocalizerConfig {
                constant_velocity: noise.clone(),
                unknown_velocity: noise,
                ..LocalizerConfig::of_test(COUNT)
            };
            for periods in [0.5, 1.0, 3.0] {
                let particles = ParticleSet::uniform(vec![start; COUNT]);
                let map = world.map();
                let mut filter = ParticleFilter::new(config.clone(), map, None, particles).unwrap();
                filter.phase = Phase::Tracking;
                filter.pending = Some(Pending::default());
                filter.last_motion = last_m.map(|last_m| LastMotion {
                    increment: Pose2::translation(last_m, 0.0),
                    duration_s: PERIOD_S,
                });
                filter.set_duration_s(periods * PERIOD_S);
                filter.accumulate(Odometry::Unknown);
                filter.propagate(Odometry::Unknown, &mut StdRng::seed_from_u64(2));
                let moved = |pose: &Pose2| start.inverse() * pose;
                let moved = ParticleSet::uniform(filter.particles.poses().map(moved));
                let ahead_m = periods * last_m.unwrap_or(0.0);
                let mean = Pose2::translation(ahead_m, 0.0);
                let found = moved.covariance_about(&mean).diagonal();
                let [turn_rad, drive_m, side_m] =
                    [turn_rad, drive_m, side_m].map(|sigma| periods * sigma);
                // The first turn moves the end of the way aside, and by its noise the way becomes shorter.
                let expected = [
                    drive_m.powi(2) + 0.75 * (ahead_m * turn_rad * turn_rad).powi(2),
                    side_m.powi(2) + (ahead_m.powi(2) + drive_m.powi(2)) * turn_rad.powi(2),
                    2.0 * turn_rad.powi(2),
                ];
                // Four standard errors of a variance.
                let error = 4.0 * (2.0 / COUNT as f64).sqrt();
                for (found, expected) in found.iter().zip(expected) {
                    assert_relative_eq!(*found, expected, max_relative = error);
                }
                let shift_m = moved.mean().translation.x - ahead_m;
                assert!(shift_m.abs() < 4.0 * drive_m / 100.0 + ahead_m * turn_rad.powi(2));
            }
        }
    }
}
