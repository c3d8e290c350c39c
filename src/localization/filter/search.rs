//! Search among several places ([`places`](crate::localization::places)): each is registered with the map, and its
//! particles are sampled around the registered pose.

use std::collections::BTreeSet;

use nalgebra::{Matrix3, Vector3};
use rand::Rng;
use rayon::prelude::*;

use super::phase::Search;
use super::reweight::{Others, Update};
use super::state::ParticleFilter;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::{Beam, RangeImage};
use crate::localization::observation::{choose_beams, costs_of_scan, ground_patch_of};
use crate::localization::particles::{Particle, ParticleSet};
use crate::localization::places::{best_of_each, is_same, weights_after, weights_in};
use crate::localization::proposal::{Gaussian, regular};
use crate::map::{GroundPatch, SensorAttitude};
use crate::registration::{RegistrationResult, register_coarse_to_fine};
use crate::rendering::RenderError;

/// Number of beams that are registered at a place.
pub(super) const PLACE_BEAMS: usize = 800;

/// Distance between poses from which a registration with a wide kernel starts [m].
pub(super) const APART_M: f64 = 1.0;

/// A place where the car may be.
struct PlaceHypothesis {
    /// Registered pose where registration succeeded, else that of a particle.
    map_from_lidar: Pose3,
    distribution: Gaussian,
    patch: GroundPatch,
}

impl PlaceHypothesis {
    fn pose(&self) -> &Pose2 {
        &self.distribution.mean
    }
}

impl ParticleFilter {
    /// Whether places are compared instead of particles.
    pub(super) fn compares_places(&self) -> bool {
        let search = self.phase.search();
        let are_several = search.is_some_and(|search| search != Search::Around);
        self.config.proposal.scan && are_several && !self.is_narrow()
    }

    /// Number of places where the car may be.
    pub(super) fn likely_places(&self) -> usize {
        match self.phase.search() {
            Some(Search::Places { likely }) if self.compares_places() => likely,
            _ => 1,
        }
    }

    /// Registers the best particles of each place, weights the places, and samples particles around each; `None` if no
    /// place is on the map.
    pub(super) fn search_places(
        &mut self,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Option<Update>, RenderError> {
        let config = self.config.places.clone();
        let seeds = self.best_particles(scan, attitude, rng)?;
        let registered = self.registered_places(&seeds, scan, attitude, rng)?;
        let (count, road_share) = (
            self.config.observation.beams,
            self.config.observation.road_share,
        );
        let beams = choose_beams(scan, count, road_share, attitude, rng);
        let costs_m = self.costs_of_places(&registered, (scan, &beams))?;
        let poses = registered.iter().map(PlaceHypothesis::pose);
        let (places, costs_m): (Vec<&PlaceHypothesis>, Vec<f64>) =
            (best_of_each(poses, &costs_m, config.most, config.radius_m).into_iter())
                .filter_map(|index| Some((&registered[index], costs_m[index]?)))
                .unzip();
        let before = self.weights_before(&places, config.radius_m);
        let weights = weights_after(&before, &costs_m, &config);
        let Some(best) = (0..places.len()).max_by(|&a, &b| weights[a].total_cmp(&weights[b]))
        else {
            return Ok(None);
        };
        let attitude = places[best].patch.attitude_of(&places[best].map_from_lidar);
        let mean_cost_m = weights
            .iter()
            .zip(&costs_m)
            .map(|(weight, cost_m)| weight * cost_m);
        let mean_cost_m = Some(mean_cost_m.sum::<f64>() / weights.iter().sum::<f64>());
        self.sample_places(&places, &weights, rng);
        let likely = weights
            .iter()
            .filter(|&&weight| weight >= config.likely_weight)
            .count();
        self.phase.set_search(Search::Places { likely });
        Ok(Some(Update {
            mean_cost_m,
            beams,
            attitude,
            ground: Some(places[best].patch),
            pose: Some(*places[best].pose()),
            refutes: false,
            others: Others::Unknown,
        }))
    }

    /// Indices of the best particle of each place, and of the best ones that are a metre apart: along a street without
    /// much structure a place has several optima.
    fn best_particles(
        &mut self,
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Vec<usize>, RenderError> {
        let observation = &self.config.observation;
        let count = observation.beams_for(self.particles.len());
        let beams = choose_beams(scan, count, observation.road_share, attitude, rng);
        let (_, costs_m) = self.log_likelihoods((scan, &beams), attitude)?;
        let config = &self.config.places;
        let best = [config.radius_m, APART_M]
            .map(|radius_m| best_of_each(self.particles.poses(), &costs_m, config.most, radius_m));
        let unique: BTreeSet<usize> = best.into_iter().flatten().collect();
        Ok(unique.into_iter().collect())
    }

    /// Registers [`PLACE_BEAMS`] beams at a pose in a place, half of them with a wide kernel first; `None` where that fails or leads
    /// out of the place.
    pub(super) fn registered_in_place(
        &self,
        beams: &[Beam],
        start: &Pose3,
        place: &Pose2,
    ) -> Result<Option<RegistrationResult>, RenderError> {
        /// Scale of the robust kernel for particles that are a metre off [m].
        const WIDE_KERNEL_M: f64 = 0.4;
        /// Tolerance [m]: the noise of 800 beams is millimetres, and the next scan goes on from there.
        const TOLERANCE_M: f64 = 5e-3;
        let registration = self.config.proposal.registration.cautious();
        let half: Vec<Beam> = beams.iter().step_by(2).copied().collect();
        register_coarse_to_fine(
            &*self.map.renderer,
            [&half, beams],
            start,
            WIDE_KERNEL_M,
            &registration.with_tolerance(TOLERANCE_M),
            |pose| is_same(place, &pose2_from_pose3(pose), self.config.places.radius_m),
        )
    }

    /// Registers the scan at particles.
    fn registered_places(
        &self,
        seeds: &[usize],
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Vec<PlaceHypothesis>, RenderError> {
        let road_share = self.config.proposal.road_share;
        let beams = choose_beams(scan, PLACE_BEAMS, road_share, attitude, rng);
        let radius_m = self.config.places.radius_m;
        let place = |&seed: &usize| {
            let particle = &self.particles.particles()[seed];
            let Some(patch) = ground_patch_of(particle, &self.map, None)? else {
                return Ok(None);
            };
            let start = particle.map_from_lidar;
            let lifted = patch.lift(&start, attitude);
            let found = self.registered_in_place(&beams, &lifted, &start)?;
            let covariance = (found.as_ref()).map(RegistrationResult::planar_covariance);
            let pose = found.map_or(lifted, |found| found.map_from_lidar);
            let mean = pose2_from_pose3(&pose);
            Ok(within_place(covariance, radius_m)
                .and_then(|covariance| Gaussian::new(mean, covariance))
                .map(|distribution| PlaceHypothesis {
                    map_from_lidar: pose,
                    distribution,
                    patch,
                }))
        };
        let places: Result<Vec<_>, RenderError> = seeds.par_iter().map(place).collect();
        Ok(places?.into_iter().flatten().collect())
    }

    fn costs_of_places(
        &self,
        places: &[PlaceHypothesis],
        scan_and_beams: (&RangeImage, &[Beam]),
    ) -> Result<Vec<Option<f64>>, RenderError> {
        let poses: Vec<_> = places
            .iter()
            .map(|place| Some(place.map_from_lidar))
            .collect();
        let observation = &self.config.observation;
        costs_of_scan(&*self.map.renderer, &poses, scan_and_beams, observation)
    }

    /// Weights of the places in the prediction. Those of the first scan are equal: the panoramas from which the
    /// particles were sampled have compared the same scan.
    fn weights_before(&self, places: &[&PlaceHypothesis], radius_m: f64) -> Vec<f64> {
        let poses: Vec<Pose2> = places.iter().map(|place| *place.pose()).collect();
        let weights = weights_in(&poses, self.particles.particles(), radius_m);
        let is_first = !matches!(self.phase.search(), Some(Search::Places { .. }));
        if is_first || weights.iter().sum::<f64>() <= 0.0 {
            return vec![1.0; places.len()];
        }
        weights
    }

    /// Samples the particles of the places, in proportion to their weights and at least a few for each.
    fn sample_places(&mut self, places: &[&PlaceHypothesis], weights: &[f64], rng: &mut impl Rng) {
        /// An unlikely place keeps this part of the particles with which one pose is tracked.
        const LEAST_DIVISOR: usize = 4;
        let most = self.config.num_reduced;
        let least = most.div_ceil(LEAST_DIVISOR);
        let mut particles = Vec::new();
        for (place, &weight) in places.iter().zip(weights) {
            if weight == 0.0 {
                continue;
            }
            let count = ((weight * most as f64) as usize).max(least);
            let poses = place.distribution.sample(count, rng);
            particles.extend(poses.into_iter().map(|pose| Particle {
                weight: weight / count as f64,
                ..Particle::new(pose, Some(place.patch.height_m))
            }));
        }
        self.particles = ParticleSet::weighted(particles);
    }
}

/// Covariance of the pose in a place: that of its registration, if any, and at most as wide as the place.
pub(super) fn within_place(
    registered: Option<Matrix3<f64>>,
    radius_m: f64,
) -> Option<Matrix3<f64>> {
    /// Standard deviations: of the position in radii, and of the heading [rad].
    const SHARE: f64 = 0.5;
    const TURN_RAD: f64 = 0.2;
    let shift_m = SHARE * radius_m;
    let place = Matrix3::from_diagonal(&Vector3::new(shift_m, shift_m, TURN_RAD))
        .map(|sigma: f64| sigma.powi(2));
    let Some(registered) = registered else {
        return Some(place);
    };
    let information = regular(&registered).try_inverse()? + place.try_inverse()?;
    information.try_inverse()
}
