//! Particles of the next frame: resampled, or sampled with the panoramas when tracking is lost.

use rand::Rng;

use super::phase::{Phase, Search};
use super::state::{ParticleFilter, Updated};
use crate::lidar::RangeImage;
use crate::localization::initialization::from_panoramas;
use crate::localization::particles::ParticleSet;
use crate::localization::resampling::{jitter, kld_sample_size, occupied_bins, systematic};
use crate::localization::tracking_loss::AgreementMonitor;
use crate::map::SensorAttitude;
use crate::rendering::RenderError;

impl ParticleFilter {
    /// Prepares the particles of the next frame: restarts the search when lost, else resamples.
    pub(super) fn prepare_next(
        &mut self,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<(), RenderError> {
        let is_lost = matches!(self.phase, Phase::Lost { .. });
        if is_lost && self.restart_search(scan, attitude, rng)? {
            return Ok(());
        }
        let size = self.particles.len();
        let threshold = self.config.resampling.min_effective_fraction * size as f64;
        let shrinks = self.phase.is_tracking() && size != self.config.num_reduced;
        let is_depleted =
            !self.compares_places() && self.particles.effective_sample_size() < threshold;
        if shrinks || is_depleted {
            self.resample(rng);
        }
        Ok(())
    }

    /// Samples particles in the places whose panoramas resemble the scan and keeps some of the previous
    /// ones, because the alarm may be false. Returns `false` without panoramas.
    fn restart_search(
        &mut self,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<bool, RenderError> {
        let Some(request) = &self.restart else {
            return Ok(false);
        };
        let index = self.map.panoramas(request)?;
        let count = self.config.num_particles;
        let places = &self.config.places;
        let mut particles = from_panoramas(&index, scan, attitude, count, places, rng)?;
        if particles.is_empty() {
            return Ok(false);
        }
        let kept = systematic(&self.particles.weights(), self.config.num_reduced, rng);
        let before = self.particles.particles();
        particles.extend(kept.into_iter().map(|index| before[index]));
        self.particles = ParticleSet::uniform(particles);
        self.phase = Phase::searching(Search::Anywhere);
        // Valid until the next update.
        self.updated = Updated::from_particles(&self.particles);
        self.last_motion = None;
        self.agreement = AgreementMonitor::default();
        Ok(true)
    }

    /// Resamples as many particles as the distribution needs, with jitter.
    pub(super) fn resample(&mut self, rng: &mut impl Rng) {
        let count = if self.phase.is_tracking() {
            self.config.num_reduced
        } else {
            self.searching_size()
        };
        let covariance = self.particles.covariance_about(&self.particles.mean());
        let indices = systematic(&self.particles.weights(), count, rng);
        self.particles = self.particles.selected(&indices);
        let config = &self.config.resampling;
        jitter(&mut self.particles, &covariance, config, rng);
    }

    /// Number of particles that the distribution needs while it is wide.
    fn searching_size(&self) -> usize {
        let average = 1.0 / self.particles.len() as f64;
        // Particles of negligible weight do not occupy bins.
        let relevant = self.particles.particles().iter();
        let relevant = relevant
            .filter(|particle| particle.weight > 0.1 * average)
            .map(|particle| &particle.map_from_lidar);
        let bins = occupied_bins(relevant, &self.config.kld);
        let least = self.config.num_reduced;
        let most = self.particles.len().max(least);
        kld_sample_size(bins, &self.config.kld).clamp(least, most)
    }
}
