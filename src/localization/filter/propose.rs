//! Particles of a narrow distribution: sampled where odometry and scan agree
//! ([`proposal`](crate::localization::proposal)) and weighted by importance.

use rand::Rng;

use super::phase::Phase;
use super::reweight::Update;
use super::state::ParticleFilter;
use crate::geometry::{Pose3, pose2_from_pose3};
use crate::lidar::{Beam, RangeImage};
use crate::localization::observation::choose_beams;
use crate::localization::odometry::Odometry;
use crate::localization::particles::{Particle, ParticleSet};
use crate::localization::proposal::{Gaussian, regular};
use crate::map::SensorAttitude;
use crate::registration::register;
use crate::rendering::RenderError;

/// Factor k of the standard deviations of the proposal, at least 1, so that its tails are heavier than those of the
/// target (unitless).
const WIDENING: f64 = 1.5;
/// Distance from the prior beyond which a registration is rejected (standard deviations).
const MAX_SIGMAS: f64 = 6.0;

/// Proposal distribution of a frame, with what is needed to weight its samples.
pub(super) struct Proposal {
    prior: Gaussian,
    /// Already widened.
    proposal: Gaussian,
    beams: Vec<Beam>,
    /// Beams that weight the samples. Not every n-th of `beams`: one more or less there would change them all.
    weighed_beams: Vec<Beam>,
    /// Height of the ground [m].
    level_m: f64,
    attitude: SensorAttitude,
}

impl ParticleFilter {
    /// Pose of a scan, registered with the map at the predicted pose; `None` while the filter is not
    /// tracking and where registration fails. The filter is not changed.
    pub fn registered(
        &self,
        odometry: Odometry,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Option<Pose3>, RenderError> {
        let config = &self.config.proposal;
        let pending = self.pending.unwrap_or_default().motion;
        let predicted = self.particles.mean() * pending * self.increment(odometry);
        let patch = self.patch_at(&predicted)?.or(self.patch);
        let Some(patch) = patch.filter(|_| self.phase.is_tracking()) else {
            return Ok(None);
        };
        let beams = choose_beams(scan, config.beams, config.road_share, attitude, rng);
        let start = patch.lift(&predicted, attitude);
        let found = register(&*self.map.renderer, &beams, &start, &config.registration)?;
        Ok(found.map(|found| found.map_from_lidar))
    }

    /// Registers the scan with the map and fuses the result with the prediction; `None` while the
    /// distribution is wide, where registration fails, and where its result is implausible.
    pub(super) fn propose(
        &self,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Option<Proposal>, RenderError> {
        let config = &self.config.proposal;
        if !config.scan || !self.phase.is_tracking() {
            return Ok(None);
        }
        let mean = self.particles.mean();
        let Some(patch) = self.patch_at(&mean)?.or(self.patch) else {
            return Ok(None);
        };
        let mut choose = |count| choose_beams(scan, count, config.road_share, attitude, rng);
        let (beams, weighed_beams) = (choose(config.beams), choose(config.weighed_beams));
        let start = patch.lift(&mean, attitude);
        let registration = match self.phase {
            Phase::Tracking => &config.registration,
            _ => &config.registration.cautious(),
        };
        let Some(found) = register(&*self.map.renderer, &beams, &start, registration)? else {
            return Ok(None);
        };
        let prior = Gaussian::new(mean, regular(&self.particles.covariance_about(&mean)));
        let pose = pose2_from_pose3(&found.map_from_lidar);
        let measured = Gaussian::new(pose, regular(&found.planar_covariance()));
        let (Some(prior), Some(measured)) = (prior, measured) else {
            return Ok(None);
        };
        if prior.squared_distance(&measured.mean) > MAX_SIGMAS.powi(2) {
            return Ok(None);
        }
        let fused = prior.fused(&measured);
        Ok(fused
            .and_then(|fused| fused.widened(WIDENING))
            .map(|proposal| Proposal {
                prior,
                proposal,
                beams,
                weighed_beams,
                level_m: patch.height_m,
                attitude: patch.attitude_of(&found.map_from_lidar),
            }))
    }

    /// Samples the particles from a proposal and weights them by the likelihood of the scan and by the
    /// ratio of prediction to proposal (importance sampling).
    pub(super) fn sample_and_weight(
        &mut self,
        proposal: Proposal,
        scan: &RangeImage,
        rng: &mut impl Rng,
    ) -> Result<Update, RenderError> {
        let Proposal {
            prior,
            proposal,
            beams,
            weighed_beams,
            level_m,
            attitude,
        } = proposal;
        let poses = proposal.sample(self.config.num_reduced, rng);
        let particle = |pose| Particle::new(pose, Some(level_m));
        self.particles = ParticleSet::uniform(poses.into_iter().map(particle));
        let (mut logs, costs_m) = self.log_likelihoods((scan, &weighed_beams), &attitude)?;
        for (log, pose) in logs.iter_mut().zip(self.particles.poses()) {
            *log += prior.log_density(pose) - proposal.log_density(pose);
        }
        self.reweight(&logs, 1.0);
        Ok(Update {
            costs_m,
            beams,
            attitude,
            place: None,
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use approx::assert_relative_eq;
    use nalgebra::{Matrix3, Vector3};
    use rand::{SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::geometry::Pose2;
    use crate::localization::LocalizerConfig;
    use crate::localization::particles::deviation;
    use crate::map::gaussian_for_tests::GaussianWorld;
    use crate::map::world_for_tests::TestWorld;

    fn gaussian(mean: [f64; 3], deviations: [f64; 3], correlation: f64) -> Gaussian {
        let scale = Matrix3::from_diagonal(&Vector3::from(deviations));
        let mut shape = Matrix3::identity();
        (shape[(0, 1)], shape[(1, 0)]) = (correlation, correlation);
        let mean = Pose2::new(nalgebra::Vector2::new(mean[0], mean[1]), mean[2]);
        Gaussian::new(mean, scale * shape * scale).unwrap()
    }

    #[test]
    fn samples_represent_the_prior_times_the_likelihood() {
        const COUNT: usize = 20_000;
        let street = TestWorld::street();
        let prior = gaussian([5.0, 0.3, 0.1], [0.04, 0.03, 0.004], 0.5);
        let likelihood = gaussian([5.03, 0.28, 0.104], [0.05, 0.03, 0.004], -0.3);
        // The proposal knows the likelihood of the scan approximately, as a registration does.
        let registration = gaussian([5.025, 0.285, 0.103], [0.04, 0.03, 0.003], 0.0);
        let proposal = prior.fused(&registration).unwrap();
        let config = LocalizerConfig {
            num_reduced: COUNT,
            ..LocalizerConfig::default()
        };
        let mut map = street.map();
        map.renderer = Arc::new(GaussianWorld {
            mean: likelihood.mean,
            information: likelihood.covariance.try_inverse().unwrap(),
            scale_m: config.observation.scale_m,
        });
        let start = ParticleSet::uniform([prior.mean]);
        let mut filter = ParticleFilter::new(config, map, None, start).unwrap();
        let proposed = Proposal {
            prior: prior.clone(),
            proposal: proposal.widened(WIDENING).unwrap(),
            beams: Vec::new(),
            weighed_beams: Vec::new(),
            level_m: -1.73,
            attitude: SensorAttitude::default(),
        };
        let scan = street.scan(&prior.mean);
        let mut rng = StdRng::seed_from_u64(1);
        filter.sample_and_weight(proposed, &scan, &mut rng).unwrap();

        let exact = prior.fused(&likelihood).unwrap();
        // Five standard errors of a mean and of a variance from so many effective particles.
        let effective = filter.particles.effective_sample_size();
        let error = 5.0 / effective.sqrt();
        let found = Gaussian::new(
            filter.particles.mean(),
            filter.particles.covariance_about(&filter.particles.mean()),
        )
        .unwrap();
        let off = deviation(&found.mean, &exact.mean);
        for axis in 0..3 {
            let sigma = exact.covariance[(axis, axis)].sqrt();
            assert_relative_eq!(off[axis] / sigma, 0.0, epsilon = error);
            let ratio = found.covariance[(axis, axis)] / sigma.powi(2);
            assert_relative_eq!(ratio, 1.0, epsilon = error * 2.0_f64.sqrt());
        }
        let shape = |it: &Gaussian| {
            it.covariance[(0, 1)] / (it.covariance[(0, 0)] * it.covariance[(1, 1)]).sqrt()
        };
        assert_relative_eq!(shape(&found), shape(&exact), epsilon = error);
    }
}
