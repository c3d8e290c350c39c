//! The particles of the next frame: resampled, or spread anew where the filter is lost.

use rand::Rng;

use super::super::particles::ParticleSet;
use super::super::resampling::{jitter, kld_sample_size, occupied_bins, systematic};
use super::super::vigilance::{State, Vigilance};
use super::Localizer;
use crate::lidar::RangeImage;
use crate::map::Stance;
use crate::rendering::RenderError;

impl Localizer<'_> {
    /// Gets the particles ready for the next frame: begins anew when lost, else resamples.
    pub(super) fn prepare_next(
        &mut self,
        scan: &RangeImage,
        stance: &Stance,
        rng: &mut impl Rng,
    ) -> Result<(), RenderError> {
        if self.state == State::Lost && self.begin_anew(scan, stance, rng)? {
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

    /// Spreads particles over the places where the scan may have been taken; those that there were
    /// stay among them, for an alarm may be false. `false` without panoramas.
    fn begin_anew(
        &mut self,
        scan: &RangeImage,
        stance: &Stance,
        rng: &mut impl Rng,
    ) -> Result<bool, RenderError> {
        let Some(panoramas) = self.surroundings.panoramas else {
            return Ok(false);
        };
        let index = panoramas.index()?;
        let mut hypotheses = index.sample(scan, stance, self.config.num_particles, rng);
        if hypotheses.is_empty() {
            return Ok(false);
        }
        let kept = systematic(&self.particles.weights(), self.config.num_reduced, rng);
        let before = self.particles.particles();
        hypotheses.extend(kept.into_iter().map(|index| before[index].hypothesis()));
        self.particles = ParticleSet::uniform(hypotheses);
        // Until the next frame is weighed, this is all that is known.
        self.estimate = self.particles.mean();
        self.covariance = self.particles.covariance_about(&self.estimate);
        self.is_narrow = false;
        self.last_increment = None;
        self.vigilance = Vigilance::default();
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

    /// How many particles the belief needs while it is wide.
    fn searching_size(&self) -> usize {
        let average = 1.0 / self.particles.len() as f64;
        // A particle that weighs nothing occupies nothing.
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
