//! Particles of the next frame: resampled, or drawn from the panoramas when tracking is lost.

use rand::Rng;

use super::super::initialization::from_panoramas;
use super::super::particles::ParticleSet;
use super::super::resampling::{jitter, kld_sample_size, occupied_bins, systematic};
use super::super::tracking_loss::{AgreementMonitor, State};
use super::ParticleFilter;
use crate::lidar::RangeImage;
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
        if self.state == State::Lost && self.restart_search(scan, attitude, rng)? {
            return Ok(());
        }
        let size = self.particles.len();
        let threshold = self.config.resampling.min_effective_fraction * size as f64;
        let shrinks = self.state == State::Tracking && size != self.config.num_reduced;
        if shrinks || self.particles.effective_sample_size() < threshold {
            self.resample(rng);
        }
        Ok(())
    }

    /// Draws particles in the places whose panoramas resemble the scan and keeps some of the previous
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
        let mut hypotheses = from_panoramas(&index, scan, attitude, count, rng);
        if hypotheses.is_empty() {
            return Ok(false);
        }
        let kept = systematic(&self.particles.weights(), self.config.num_reduced, rng);
        let before = self.particles.particles();
        hypotheses.extend(kept.into_iter().map(|index| before[index].hypothesis()));
        self.particles = ParticleSet::uniform(hypotheses);
        // Valid until the next update.
        self.estimate = self.particles.mean();
        self.covariance = self.particles.covariance_about(&self.estimate);
        self.is_narrow = false;
        self.last_increment = None;
        self.agreement = AgreementMonitor::default();
        self.updates_in_state = 0;
        self.state = State::Searching;
        Ok(true)
    }

    pub(super) fn resample(&mut self, rng: &mut impl Rng) {
        let count = match self.state {
            State::Tracking => self.config.num_reduced,
            State::Searching | State::Lost => self.searching_size(),
        };
        let covariance = self.particles.covariance_about(&self.particles.mean());
        let members = systematic(&self.particles.weights(), count, rng);
        self.particles = self.particles.selected(&members);
        jitter(
            &mut self.particles,
            &covariance,
            &self.config.resampling,
            rng,
        );
    }

    /// Number of particles that the distribution needs while it is wide.
    fn searching_size(&self) -> usize {
        let average = 1.0 / self.particles.len() as f64;
        // Particles of negligible weight do not occupy bins.
        let alive = self
            .particles
            .particles()
            .iter()
            .filter(|particle| particle.weight > 0.1 * average)
            .map(|particle| &particle.map_from_lidar);
        let bins = occupied_bins(alive, &self.config.kld);
        let most = self.particles.len().max(self.config.num_reduced);
        kld_sample_size(bins, &self.config.kld).clamp(self.config.num_reduced.min(most), most)
    }
}
