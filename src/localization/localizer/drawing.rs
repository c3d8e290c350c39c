//! Particles of a narrow belief: drawn where odometry and scan agree
//! ([`proposal`](crate::localization::proposal)), and weighed there.

use rand::Rng;

use super::super::observation::choose_beams;
use super::super::particles::{Hypothesis, ParticleSet};
use super::super::proposal::{Gaussian, regular};
use super::super::vigilance::State;
use super::{Localizer, Weighing, weighted_mean};
use crate::geometry::pose2_from_pose3;
use crate::lidar::{Beam, RangeImage};
use crate::map::Stance;
use crate::registration::register;
use crate::rendering::RenderError;

/// Where the particles of a frame are drawn, and from what they are weighed.
pub(super) struct Proposal {
    prior: Gaussian,
    /// Already as wide as it shall be.
    proposal: Gaussian,
    beams: Vec<Beam>,
    /// Height of the ground [m].
    level_m: f64,
    stance: Stance,
}

impl Localizer<'_> {
    /// Lays the scan onto the map, for particles to be drawn where it came to lie; `None` while the
    /// belief is wide and where the scan does not tell, or tells what cannot be.
    pub(super) fn propose(
        &self,
        scan: &RangeImage,
        stance: &Stance,
        rng: &mut impl Rng,
    ) -> Result<Option<Proposal>, RenderError> {
        let config = &self.config.proposal;
        if !config.scan || self.state != State::Tracking {
            return Ok(None);
        }
        let mean = self.particles.mean();
        let Some(patch) = self.patch_at(&mean).or(self.patch) else {
            return Ok(None);
        };
        let beams = choose_beams(scan, config.beams, config.road_share, stance, rng);
        let start = patch.lift(&mean, stance);
        let renderer = self.surroundings.renderer;
        let Some(found) = register(renderer, &beams, &start, &config.registration)? else {
            return Ok(None);
        };
        let prior = Gaussian::new(mean, regular(&self.particles.covariance_about(&mean)));
        let pose = pose2_from_pose3(&found.map_from_lidar);
        let seen = Gaussian::new(pose, regular(&found.planar_covariance()));
        let (Some(prior), Some(seen)) = (prior, seen) else {
            return Ok(None);
        };
        if prior.squared_distance(&seen.mean) > config.max_sigmas.powi(2) {
            return Ok(None);
        }
        let fused = prior.fused(&seen);
        Ok(fused
            .and_then(|fused| fused.widened(config.widening))
            .map(|proposal| Proposal {
                prior,
                proposal,
                beams,
                level_m: patch.height_m,
                stance: patch.stance_of(&found.map_from_lidar),
            }))
    }

    /// Draws the particles from a proposal and weighs them by the scan, and by how much likelier the
    /// motion is to lead there than the proposal.
    pub(super) fn weigh_drawn(
        &mut self,
        drawn: Proposal,
        rng: &mut impl Rng,
    ) -> Result<Weighing, RenderError> {
        let Proposal {
            prior,
            proposal,
            beams,
            level_m,
            stance,
        } = drawn;
        let poses = proposal.sample(self.config.num_reduced, rng);
        self.particles = ParticleSet::uniform(poses.into_iter().map(|pose| Hypothesis {
            map_from_lidar: pose,
            level_m: Some(level_m),
        }));
        let step = beams.len().div_ceil(self.config.proposal.weighed_beams);
        let weighed: Vec<Beam> = beams.iter().step_by(step.max(1)).copied().collect();
        let (mut logs, costs) = self.log_likelihoods(&weighed, &stance)?;
        for (log, pose) in logs.iter_mut().zip(self.particles.poses()) {
            *log += prior.log_density(pose) - proposal.log_density(pose);
        }
        self.reweight(&logs, 1.0);
        Ok(Weighing {
            effective_sample_size: self.particles.effective_sample_size(),
            mean_cost_m: weighted_mean(&self.particles, &costs),
            beams,
            stance,
        })
    }
}
