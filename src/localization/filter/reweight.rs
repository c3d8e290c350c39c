//! Measurement update: the weights of the particles, and the estimate that follows from them.

use rand::Rng;

use super::state::{InSpace, LastMotion, ParticleFilter, Updated};
use crate::geometry::{Pose2, Pose3};
use crate::lidar::{Beam, RangeImage};
use crate::localization::estimate::Estimate;
use crate::localization::observation::{choose_beams, costs_of_scan, ground_patch_of, near_points};
use crate::localization::particles::{Particle, ParticleSet};
use crate::localization::tempering::exponent;
use crate::map::{GroundPatch, SensorAttitude};
use crate::rendering::RenderError;

/// Result of a measurement update.
pub(super) struct Update {
    /// Mean cost of the beams [m]; `None` off the map.
    pub(super) mean_cost_m: Option<f64>,
    /// The beams of the last round.
    pub(super) beams: Vec<Beam>,
    /// Attitude of the sensor as estimated in this frame, above `ground`.
    pub(super) attitude: SensorAttitude,
    /// That below the estimate if `None`.
    pub(super) ground: Option<GroundPatch>,
    /// Pose of the posterior, or of the likeliest of several places; `None` for the weighted mean.
    pub(super) pose: Option<Pose2>,
    /// Whether the scan shows that the prediction is wrong, or replaces one that no scan confirmed.
    pub(super) refutes: bool,
    /// How other poses around the prediction fit.
    pub(super) others: Others,
}

/// How other poses around a prediction fit a scan, compared with the pose of an update.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Others {
    /// Not known: none were compared, or not around this pose, or too few beams agree with it.
    Unknown,
    /// None fits as well.
    Worse,
    /// Some fit as well, or one fits better that the sensor cannot have reached.
    Alike,
}

impl Update {
    /// Whether the next scan has to confirm the pose.
    pub fn needs_confirmation(&self) -> bool {
        match self.others {
            Others::Unknown => self.refutes,
            Others::Worse => false,
            Others::Alike => true,
        }
    }
}

/// The pose of an update in space, and its agreement with the map.
#[derive(Clone, Copy)]
pub(super) struct Compared {
    pub in_space: InSpace,
    pub agreement: Option<f64>,
}

impl ParticleFilter {
    /// Reweights particles of a wide distribution by the scan.
    pub(super) fn reweight_widely(
        &mut self,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Update, RenderError> {
        if self.compares_places()
            && let Some(update) = self.search_places(scan, attitude, rng)?
        {
            return Ok(update);
        }
        self.reweight_in_rounds(scan, attitude, rng)
    }

    /// Reweights the particles by the scan, in one round or several.
    fn reweight_in_rounds(
        &mut self,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Update, RenderError> {
        let tempering = &self.config.tempering;
        let rounds = if self.phase.is_tracking() {
            1
        } else {
            tempering.searching_rounds
        };
        let (mut power, mut round) = (0.0, 1);
        loop {
            let observation = &self.config.observation;
            // The rounds share the rays of the update.
            let count = observation.beams_for(self.particles.len() * rounds);
            let beams = choose_beams(scan, count, observation.road_share, attitude, rng);
            let refined = self.refined_attitude(scan, attitude)?;
            let (logs, costs_m) = self.log_likelihoods((scan, &beams), &refined)?;
            let used = self.reweight(&logs, 1.0 - power);
            power += used;
            if round >= rounds || power >= 1.0 || used <= 0.0 {
                return Ok(Update {
                    mean_cost_m: weighted_mean(&self.particles, &costs_m),
                    beams,
                    attitude: self.refined_attitude(scan, attitude)?,
                    ground: None,
                    pose: None,
                    refutes: false,
                    others: Others::Unknown,
                });
            }
            self.resample(rng);
            round += 1;
        }
    }

    /// Log-likelihoods of the particles given a scan and a sample of its beams, up to a constant, and their mean costs [m].
    pub(super) fn log_likelihoods(
        &mut self,
        scan_and_beams: (&RangeImage, &[Beam]),
        attitude: &SensorAttitude,
    ) -> Result<(Vec<f64>, Vec<Option<f64>>), RenderError> {
        let poses = self.align_to_ground(attitude)?;
        let observation = &self.config.observation;
        let costs = costs_of_scan(&*self.map.renderer, &poses, scan_and_beams, observation)?;
        let log = |cost: &Option<f64>| {
            cost.map_or(observation.floor_log_likelihood(), |cost_m| {
                observation.log_likelihood(cost_m)
            })
        };
        Ok((costs.iter().map(log).collect(), costs))
    }

    /// Multiplies the weights by a power of the likelihoods, at most `largest`. Returns the power.
    fn reweight(&mut self, logs: &[f64], largest: f64) -> f64 {
        let min_effective =
            self.config.tempering.min_effective_fraction * self.particles.len() as f64;
        let power = exponent(&self.particles.weights(), logs, min_effective, largest);
        let tempered: Vec<f64> = logs.iter().map(|log| power * log).collect();
        self.particles.reweight(&tempered);
        power
    }

    /// Estimate of an updated frame with its agreement with the map, which is kept for the next frames.
    pub(super) fn updated_estimate(
        &mut self,
        update: &Update,
        compared: Compared,
    ) -> Result<Estimate, RenderError> {
        let pose = update.pose.unwrap_or_else(|| self.particles.mean());
        let covariance = match update.pose {
            Some(_) => self.particles.covariance_about(&pose),
            None => self.particles.covariance_of_estimate(),
        };
        let particles = self.particles.clone();
        let mut estimate = self.estimate_of(pose, particles, covariance, compared.in_space)?;
        estimate.updated = true;
        estimate.agreement = compared.agreement;
        estimate.mean_cost_m = update.mean_cost_m;
        let is_narrow = self.is_narrow();
        // A jump of a wide distribution is not a motion of the car, nor is the correction of a refuted prediction. One that follows
        // another is while tracking: the car moved otherwise than predicted.
        let is_motion = !update.refutes || self.updated.refuted && self.phase.is_tracking();
        if self.updated.is_narrow && is_narrow && is_motion {
            self.last_motion = Some(LastMotion {
                increment: self.updated.pose.inverse() * pose,
                duration_s: self.duration_s,
            });
        }
        // Predictions of a search that are wrong in turn had a wrong motion.
        if update.refutes && self.updated.refuted && !self.phase.is_tracking() {
            self.last_motion = None;
        }
        let is_one_of_several = update.others == Others::Alike;
        let is_doubtful = update.refutes || is_one_of_several;
        self.updated = Updated {
            pose,
            covariance,
            is_narrow,
            refuted: update.refutes,
            is_one_of_several,
            doubtful_s: is_doubtful.then(|| self.since_certain_s()),
        };
        Ok(estimate)
    }

    /// Attitude of the sensor: where the distribution is narrow, from the distances of ground returns
    /// to the mapped ground; otherwise from the scan alone.
    fn refined_attitude(
        &self,
        scan: &RangeImage,
        attitude: &SensorAttitude,
    ) -> Result<SensorAttitude, RenderError> {
        if !self.is_narrow() {
            return Ok(*attitude);
        }
        let (mean, points) = (self.particles.mean(), near_points(scan));
        let ground = &self.map.ground;
        let refined = ground.attitude_at(&mean, self.level_m(), attitude, &points)?;
        Ok(refined.unwrap_or(*attitude))
    }

    /// Aligns the particles to the ground of the map and returns their poses in space.
    pub(super) fn align_to_ground(
        &mut self,
        attitude: &SensorAttitude,
    ) -> Result<Vec<Option<Pose3>>, RenderError> {
        let remembered = self.patch.filter(|_| self.phase.is_tracking());
        let particles = self.particles.particles();
        let patches: Vec<Option<GroundPatch>> = particles
            .iter()
            .map(|particle| ground_patch_of(particle, &self.map, remembered.as_ref()))
            .collect::<Result<_, _>>()?;
        let lift = |(particle, patch): (&Particle, &Option<GroundPatch>)| {
            Some(patch.as_ref()?.lift(&particle.map_from_lidar, attitude))
        };
        let poses = particles.iter().zip(&patches).map(lift).collect();
        let levels_m = patches
            .iter()
            .map(|patch| patch.map(|patch| patch.height_m));
        self.particles.set_levels(levels_m);
        Ok(poses)
    }
}

/// Weighted mean of the costs of the particles that have one [m].
fn weighted_mean(particles: &ParticleSet, costs_m: &[Option<f64>]) -> Option<f64> {
    let (sum, weight) = particles
        .particles()
        .iter()
        .zip(costs_m)
        .filter_map(|(particle, cost_m)| cost_m.map(|cost_m| (particle.weight, cost_m)))
        .fold((0.0, 0.0), |(sum, weight), (w, cost_m)| {
            (sum + w * cost_m, weight + w)
        });
    (weight > 0.0).then(|| sum / weight)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use approx::assert_relative_eq;
    use nalgebra::{Matrix3, Vector3};
    use rand::{SeedableRng as _, rngs::StdRng};

    use super::super::phase::{Phase, Search};
    use super::*;
    use crate::lidar::LidarModel;
    use crate::localization::LocalizerConfig;
    use crate::localization::proposal::Gaussian;
    use crate::map::gaussian_for_tests::GaussianWorld;
    use crate::map::world_for_tests::TestWorld;

    #[test]
    fn each_round_of_a_search_leaves_the_requested_share_of_effective_particles() {
        const COUNT: usize = 4000;
        let street = TestWorld::street();
        let start = street.pose_at(0.0, 0.0, 0.0);
        let mut config = LocalizerConfig::of_test(COUNT);
        config.num_reduced = COUNT;
        config.resampling.jitter = 0.0;
        config.tempering.min_effective_fraction = 0.5;
        let scale_m = config.observation.scale_m;
        let mut rng = StdRng::seed_from_u64(1);
        let prior = Matrix3::from_diagonal(&Vector3::new(1.0, 1e-4, 1e-6));
        let poses = Gaussian::new(start, prior).unwrap().sample(COUNT, &mut rng);
        let mut variance_m2 = |rounds: usize| {
            let mut config = config.clone();
            config.tempering.searching_rounds = rounds;
            let mut map = street.map();
            map.renderer = Arc::new(GaussianWorld {
                mean: start,
                information: Matrix3::from_diagonal(&Vector3::new(1e6, 0.0, 0.0)),
                scale_m,
            });
            let particles = ParticleSet::uniform(poses.iter().copied());
            let mut filter = ParticleFilter::new(config, map, None, particles).unwrap();
            let search = Search::Around;
            filter.phase = Phase::Searching { search, updates: 1 };
            let scan = RangeImage::project(&[], &LidarModel::default());
            filter
                .reweight_in_rounds(&scan, &SensorAttitude::default(), &mut rng)
                .unwrap();
            let particles = &filter.particles;
            particles.covariance_about(&particles.mean())[(0, 0)]
        };
        // A normal distribution whose variance is divided by 1 + u leaves a share of sqrt(1 + 2 u) / (1 + u).
        let divided = 4.0 + 12.0_f64.sqrt();
        for rounds in 1..=3 {
            let expected = divided.powi(-(rounds as i32));
            assert_relative_eq!(variance_m2(rounds), expected, max_relative = 0.2);
        }
    }

    #[test]
    fn the_mean_cost_is_that_of_the_particles_on_the_map_by_their_weights() {
        let weighted = [0.2, 0.3, 0.5].map(|weight| Particle {
            weight,
            ..Particle::new(Pose2::identity(), None)
        });
        let particles = ParticleSet::weighted(weighted.into());
        let mean = |costs_m: [Option<f64>; 3]| weighted_mean(&particles, &costs_m);
        assert_eq!(mean([None; 3]), None);
        assert_relative_eq!(mean([Some(0.04); 3]).unwrap(), 0.04, epsilon = 1e-12);
        // Two parts of seven of 0.7 m, and five of 1.4 m.
        let found = mean([Some(0.7), None, Some(1.4)]).unwrap();
        assert_relative_eq!(found, 1.2, epsilon = 1e-12);
    }
}
