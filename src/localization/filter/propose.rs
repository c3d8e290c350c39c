//! Particles of a narrow distribution: sampled where odometry and scan agree
//! ([`proposal`](crate::localization::proposal)) and weighted by importance.

use rand::Rng;

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
