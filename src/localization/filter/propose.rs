//! Particles of a narrow distribution: sampled where odometry and scan agree
//! ([`proposal`](crate::localization::proposal)), weighted by importance and by the tempered likelihood of the scan.

use rand::Rng;

use super::reweight::Update;
use super::state::ParticleFilter;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::{Beam, RangeImage};
use crate::localization::observation::{choose_beams, costs};
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
    /// Registration of the scan.
    measured: Gaussian,
    /// Already widened.
    proposal: Gaussian,
    beams: Vec<Beam>,
    /// Mean cost of the beams at the registered pose [m].
    cost_m: Option<f64>,
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
        let beams = choose_beams(scan, config.beams, config.road_share, attitude, rng);
        let start = patch.lift(&mean, attitude);
        let Some(found) = register(&*self.map.renderer, &beams, &start, &config.registration)?
        else {
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
        let difference = self.config.observation.difference();
        let poses = [Some(found.map_from_lidar)];
        let cost_m = costs(&*self.map.renderer, &poses, &beams, &difference)?[0];
        let fused = prior.fused(&measured);
        Ok(fused
            .and_then(|fused| fused.widened(WIDENING))
            .map(|proposal| Proposal {
                prior,
                measured,
                proposal,
                beams,
                cost_m,
                level_m: patch.height_m,
                attitude: patch.attitude_of(&found.map_from_lidar),
            }))
    }

    /// Samples the particles from a proposal and weights them by importance, the ratio of prediction to proposal, and
    /// by the likelihood L of the scan. Only the likelihood is tempered: the samples represent `prior · Lᵝ`.
    pub(super) fn sample_and_weight(&mut self, proposal: Proposal, rng: &mut impl Rng) -> Update {
        let Proposal {
            prior,
            measured,
            proposal,
            beams,
            cost_m,
            level_m,
            attitude,
        } = proposal;
        let poses = proposal.sample(self.config.num_reduced, rng);
        let importance = |pose: &Pose2| prior.log_density(pose) - proposal.log_density(pose);
        let ratios: Vec<f64> = poses.iter().map(importance).collect();
        let particle = |pose| Particle::new(pose, Some(level_m));
        self.particles = ParticleSet::uniform(poses.into_iter().map(particle));
        self.particles.reweight(&ratios);
        let likelihood = |pose: &Pose2| measured.log_density(pose);
        let logs: Vec<f64> = self.particles.poses().map(likelihood).collect();
        self.reweight(&logs, 1.0);
        Update {
            costs_m: vec![cost_m; self.particles.len()],
            beams,
            attitude,
            place: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::{Matrix3, Vector2, Vector3};
    use rand::{SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::localization::LocalizerConfig;
    use crate::localization::particles::deviation;
    use crate::map::world_for_tests::TestWorld;

    fn gaussian(mean: [f64; 3], deviations: [f64; 3], correlation: f64) -> Gaussian {
        let scale = Matrix3::from_diagonal(&Vector3::from(deviations));
        let mut shape = Matrix3::identity();
        (shape[(0, 1)], shape[(1, 0)]) = (correlation, correlation);
        let mean = Pose2::new(Vector2::new(mean[0], mean[1]), mean[2]);
        Gaussian::new(mean, scale * shape * scale).unwrap()
    }

    #[test]
    fn samples_represent_the_prior_times_the_tempered_likelihood() {
        const COUNT: usize = 20_000;
        let prior = gaussian([5.0, 0.3, 0.1], [0.04, 0.03, 0.004], 0.5);
        let scan = gaussian([5.03, 0.28, 0.104], [0.02, 0.015, 0.002], -0.3);
        let mut powers = Vec::new();
        // The proposal leaves 57 % of the particles effective: less than the last two ask for.
        for (seed, min_effective_fraction) in [0.0, 0.2, 0.7, 0.9].into_iter().enumerate() {
            let mut config = LocalizerConfig {
                num_reduced: COUNT,
                ..LocalizerConfig::default()
            };
            config.tempering.min_effective_fraction = min_effective_fraction;
            let start = ParticleSet::uniform([prior.mean]);
            let map = TestWorld::street().map();
            let mut filter = ParticleFilter::new(config, map, None, start).unwrap();
            let proposal = prior.fused(&scan).unwrap().widened(WIDENING).unwrap();
            let proposed = Proposal {
                prior: prior.clone(),
                measured: scan.clone(),
                proposal: proposal.clone(),
                beams: Vec::new(),
                cost_m: None,
                level_m: -1.73,
                attitude: SensorAttitude::default(),
            };
            filter.sample_and_weight(proposed, &mut StdRng::seed_from_u64(seed as u64));

            // The power of the likelihood, from the weights of the particles at which it is highest and lowest.
            let particles = filter.particles.particles();
            let log = |it: &Particle| scan.log_density(&it.map_from_lidar);
            let tempered = |it: &Particle| {
                let pose = &it.map_from_lidar;
                it.weight.ln() - prior.log_density(pose) + proposal.log_density(pose)
            };
            let by_log = |a: &&Particle, b: &&Particle| log(a).total_cmp(&log(b));
            let highest = particles.iter().max_by(by_log).unwrap();
            let lowest = particles.iter().min_by(by_log).unwrap();
            let power = (tempered(highest) - tempered(lowest)) / (log(highest) - log(lowest));
            powers.push(power);

            let powered = Gaussian::new(scan.mean, scan.covariance / power).unwrap();
            let exact = prior.fused(&powered).unwrap();
            // Five standard errors of a mean and of a variance from so many effective particles.
            let error = 5.0 / filter.particles.effective_sample_size().sqrt();
            let mean = filter.particles.mean();
            let covariance = filter.particles.covariance_about(&mean);
            let off = deviation(&mean, &exact.mean);
            let sigmas = exact.covariance.diagonal().map(f64::sqrt);
            for row in 0..3 {
                assert_relative_eq!(off[row] / sigmas[row], 0.0, epsilon = error);
                for column in 0..3 {
                    let scale = sigmas[row] * sigmas[column];
                    let (found, exact) =
                        (covariance[(row, column)], exact.covariance[(row, column)]);
                    let error = 2.0_f64.sqrt() * error;
                    assert_relative_eq!(found / scale, exact / scale, epsilon = error);
                }
            }
        }
        let is_tempered: Vec<bool> = powers.iter().map(|&power| power < 0.99).collect();
        assert_eq!(is_tempered, [false, false, true, true], "{powers:?}");
    }
}
