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
use crate::localization::observation::{Likelihood, choose_beams, costs_of_scan, ground_patch_of};
use crate::localization::particles::{Particle, ParticleSet};
use crate::localization::places::{
    PlaceCosts, best_of_each, is_same, is_same_place, weights_after, weights_in,
};
use crate::localization::proposal::{Gaussian, regular};
use crate::map::{GroundPatch, LEVEL_GAP_M, SensorAttitude};
use crate::registration::{RegistrationResult, approach_widely, register};
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

    /// A particle at its pose, on its level.
    fn particle(&self) -> Particle {
        Particle::new(*self.pose(), Some(self.patch.height_m))
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
        let best = self.best_particles(scan, attitude, rng)?;
        let mut seeds: Vec<Particle> = (best.into_iter())
            .map(|index| self.particles.particles()[index])
            .collect();
        if self.is_first_search() {
            seeds.extend(self.on_other_levels(&seeds)?);
        }
        let registered = self.registered_places(&seeds, scan, attitude, rng)?;
        let (count, road_share) = (
            self.config.observation.beams,
            self.config.observation.road_share,
        );
        let beams = choose_beams(scan, count, road_share, attitude, rng);
        let found = self.costs_of_places(&registered, (scan, &beams))?;
        let costs_m: Vec<Option<f64>> = (found.iter())
            .map(|costs| costs.as_ref().map(PlaceCosts::mean_m))
            .collect();
        let particles: Vec<Particle> = registered.iter().map(PlaceHypothesis::particle).collect();
        let (places, costs): (Vec<&PlaceHypothesis>, Vec<PlaceCosts>) =
            (best_of_each(&particles, &costs_m, config.most, config.radius_m).into_iter())
                .filter_map(|index| Some((&registered[index], found[index].clone()?)))
                .unzip();
        let before = self.weights_before(&places, config.radius_m);
        let weights = weights_after(&before, &costs, &config);
        let Some(best) = (0..places.len()).max_by(|&a, &b| weights[a].total_cmp(&weights[b]))
        else {
            return Ok(None);
        };
        let attitude = places[best].patch.attitude_of(&places[best].map_from_lidar);
        let mean_cost_m =
            (weights.iter().zip(&costs)).map(|(weight, costs)| weight * costs.mean_m());
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
        let costs_m = if self.is_first_search() {
            let poses = self.align_to_ground(attitude)?;
            self.least_costs(&poses, (scan, &beams))?
        } else {
            self.log_likelihoods((scan, &beams), attitude)?.1
        };
        let config = &self.config.places;
        let best = [config.radius_m, APART_M].map(|radius_m| {
            best_of_each(self.particles.particles(), &costs_m, config.most, radius_m)
        });
        let unique: BTreeSet<usize> = best.into_iter().flatten().collect();
        Ok(unique.into_iter().collect())
    }

    /// Particles below and above others, on the other levels of the ground. Storeys of a building are alike, and of many places that
    /// are alike only some are searched: those of each storey.
    fn on_other_levels(&self, particles: &[Particle]) -> Result<Vec<Particle>, RenderError> {
        let mut found = Vec::new();
        for particle in particles {
            let [x, y] = particle.map_from_lidar.translation.vector.into();
            let levels = self.map.ground.levels_at(x, y)?;
            let at_level = |level: &GroundPatch| Particle {
                level_m: Some(level.height_m),
                ..*particle
            };
            let is_new = |other: &Particle| {
                (particles.iter()).all(|known| !is_same_place(known, other, APART_M))
            };
            found.extend(levels.iter().map(at_level).filter(is_new));
        }
        Ok(found)
    }

    /// Whether no places have been registered yet.
    fn is_first_search(&self) -> bool {
        !matches!(self.phase.search(), Some(Search::Places { .. }))
    }

    /// Mean costs of poses [m]; `None` off the map, and where the first comparison, with few of the beams, is worse than that of most
    /// poses.
    pub(super) fn least_costs(
        &self,
        poses: &[Option<Pose3>],
        (scan, beams): (&RangeImage, &[Beam]),
    ) -> Result<Vec<Option<f64>>, RenderError> {
        /// Divisor of the number of beams in the first comparison, and of the number of poses that stay after it.
        const PART: usize = 4;
        let costs = |poses: &[Option<Pose3>], beams: &[Beam]| {
            let observation = &self.config.observation;
            costs_of_scan(&*self.map.renderer, poses, (scan, beams), observation)
        };
        let some: Vec<Beam> = beams.iter().step_by(PART).copied().collect();
        let first_m = costs(poses, &some)?;
        let mut ascending_m: Vec<f64> = first_m.iter().flatten().copied().collect();
        ascending_m.sort_by(f64::total_cmp);
        // As many as the particles that track one pose stay in any case.
        let count = (ascending_m.len() / PART).max(self.config.num_reduced);
        let most_m = ascending_m.get(count).copied().unwrap_or(f64::INFINITY);
        let is_left = |cost_m: &Option<f64>| cost_m.is_some_and(|cost_m| cost_m <= most_m);
        let left: Vec<Option<Pose3>> = (poses.iter().zip(&first_m))
            .map(|(pose, cost_m)| pose.filter(|_| is_left(cost_m)))
            .collect();
        costs(&left, beams)
    }

    /// Registers [`PLACE_BEAMS`] beams at poses, each in its place, half of them with a wide kernel first, and all of them where that fits
    /// about as well as at the best pose. `None` elsewhere, and where registration fails or leads out of the place.
    pub(super) fn registered_in_places(
        &self,
        starts: &[(Pose3, Pose2)],
        scan: &RangeImage,
        beams: &[Beam],
    ) -> Result<Vec<Option<RegistrationResult>>, RenderError> {
        /// Scale of the robust kernel for particles that are a metre off [m].
        const WIDE_KERNEL_M: f64 = 0.4;
        /// Tolerance [m]: the noise of 800 beams is millimetres, and the next scan goes on from there.
        const TOLERANCE_M: f64 = 5e-3;
        /// Factor on the excess at which a place is given up, up to which the registration goes on: a place may have had a larger weight by
        /// as much.
        const EXCESS_FACTOR: f64 = 2.0;
        let renderer = &*self.map.renderer;
        let registration = self.config.proposal.registration.cautious();
        let registration = registration.with_tolerance(TOLERANCE_M);
        let places = &self.config.places;
        let is_in = |(start, place): &(Pose3, Pose2), pose: &Pose3| {
            let risen_m = pose.translation.z - start.translation.z;
            risen_m.abs() < LEVEL_GAP_M && is_same(place, &pose2_from_pose3(pose), places.radius_m)
        };
        let half: Vec<Beam> = beams.iter().step_by(2).copied().collect();
        let approach = |at: &(Pose3, Pose2)| {
            let near = approach_widely(renderer, &half, &at.0, WIDE_KERNEL_M, &registration)?;
            Ok(Some(near).filter(|near| is_in(at, near)))
        };
        let near: Result<Vec<Option<Pose3>>, RenderError> =
            starts.par_iter().map(approach).collect();
        let near = near?;
        let observation = &self.config.observation;
        let costs_m = costs_of_scan(renderer, &near, (scan, beams), observation)?;
        let least_m = (costs_m.iter().flatten()).fold(f64::INFINITY, |least, m| least.min(*m));
        let most_m = least_m + EXCESS_FACTOR * places.excess_given_up_m();
        let is_left = |cost_m: &Option<f64>| cost_m.is_some_and(|cost_m| cost_m <= most_m);
        let left: Vec<Option<Pose3>> = (near.iter().zip(&costs_m))
            .map(|(near, cost_m)| near.filter(|_| is_left(cost_m)))
            .collect();
        let register = |(near, at): (&Option<Pose3>, &(Pose3, Pose2))| {
            let Some(near) = near else {
                return Ok(None);
            };
            let found = register(renderer, beams, near, &registration)?;
            Ok(found.filter(|found| is_in(at, &found.map_from_lidar)))
        };
        left.par_iter().zip(starts).map(register).collect()
    }

    /// Registers the scan at particles.
    fn registered_places(
        &self,
        seeds: &[Particle],
        scan: &RangeImage,
        attitude: &SensorAttitude,
        rng: &mut impl Rng,
    ) -> Result<Vec<PlaceHypothesis>, RenderError> {
        let road_share = self.config.proposal.road_share;
        let beams = choose_beams(scan, PLACE_BEAMS, road_share, attitude, rng);
        let (mut starts, mut patches) = (Vec::new(), Vec::new());
        for particle in seeds {
            if let Some(patch) = ground_patch_of(particle, &self.map, None)? {
                let place = particle.map_from_lidar;
                starts.push((patch.lift(&place, attitude), place));
                patches.push(patch);
            }
        }
        let found = self.registered_in_places(&starts, scan, &beams)?;
        let place =
            |((found, (lifted, _)), patch): ((Option<RegistrationResult>, &(Pose3, _)), _)| {
                let covariance = (found.as_ref()).map(RegistrationResult::planar_covariance);
                let map_from_lidar = found.map_or(*lifted, |found| found.map_from_lidar);
                let mean = pose2_from_pose3(&map_from_lidar);
                let covariance = within_place(covariance, self.config.places.radius_m)?;
                Some(PlaceHypothesis {
                    map_from_lidar,
                    distribution: Gaussian::new(mean, covariance)?,
                    patch,
                })
            };
        let all = found.into_iter().zip(&starts).zip(patches);
        Ok(all.filter_map(place).collect())
    }

    /// Costs of a scan at each place; `None` off the map.
    fn costs_of_places(
        &self,
        places: &[PlaceHypothesis],
        (scan, beams): (&RangeImage, &[Beam]),
    ) -> Result<Vec<Option<PlaceCosts>>, RenderError> {
        /// Number of sectors: a car that is parked next to the road takes one or two.
        const SECTORS: usize = 24;
        let poses: Vec<_> = places
            .iter()
            .map(|place| Some(place.map_from_lidar))
            .collect();
        let observation = &self.config.observation;
        let mut sectors = vec![Vec::new(); SECTORS];
        match observation.likelihood {
            Likelihood::Reference => sectors[0] = beams.to_vec(),
            Likelihood::Robust => {
                for beam in beams {
                    let turns = beam.direction.y.atan2(beam.direction.x) / std::f32::consts::TAU;
                    let sector = (turns.rem_euclid(1.0) * SECTORS as f32) as usize;
                    sectors[sector.min(SECTORS - 1)].push(*beam);
                }
            }
        }
        let begin = |place: &PlaceHypothesis| PlaceCosts {
            by_sector_m: Vec::new(),
            level_m: Some(place.patch.height_m),
        };
        let mut all: Vec<_> = places.iter().map(|place| Some(begin(place))).collect();
        for sector in sectors.iter().filter(|sector| !sector.is_empty()) {
            let share = sector.len() as f64 / beams.len() as f64;
            let costs_m = costs_of_scan(&*self.map.renderer, &poses, (scan, sector), observation)?;
            for (costs, cost_m) in all.iter_mut().zip(costs_m) {
                match (costs.as_mut(), cost_m) {
                    (Some(costs), Some(cost_m)) => costs.by_sector_m.push(share * cost_m),
                    _ => *costs = None,
                }
            }
        }
        Ok(all)
    }

    /// Weights of the places in the prediction. Those of the first scan are equal: the panoramas from which the
    /// particles were sampled have compared the same scan.
    fn weights_before(&self, places: &[&PlaceHypothesis], radius_m: f64) -> Vec<f64> {
        let at_poses: Vec<Particle> = places.iter().map(|place| place.particle()).collect();
        let weights = weights_in(&at_poses, self.particles.particles(), radius_m);
        if self.is_first_search() || weights.iter().sum::<f64>() <= 0.0 {
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

#[cfg(test)]
mod tests {
    use rand::{SeedableRng as _, rngs::StdRng};

    use super::super::propose::tests::tracking;
    use super::*;
    use crate::map::world_for_tests::TestWorld;

    #[test]
    fn the_particles_that_are_left_by_few_beams_have_the_costs_of_all_and_the_best_is_among_them() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        let mut rng = StdRng::seed_from_u64(1);
        let widely = Matrix3::from_diagonal(&Vector3::new(4.0, 4.0, 0.04));
        let prior = Gaussian::new(truth, widely).unwrap();
        let mut filter = tracking(&world, &prior, &mut rng);
        filter.config.num_reduced = 10;
        let beams = choose_beams(&scan, 100, 0.2, &attitude, &mut rng);
        let (_, all_m) = filter.log_likelihoods((&scan, &beams), &attitude).unwrap();
        let poses = filter.align_to_ground(&attitude).unwrap();
        let left_m = filter.least_costs(&poses, (&scan, &beams)).unwrap();
        assert_eq!(left_m.len(), 100);
        let count = left_m.iter().flatten().count();
        assert!((25..30).contains(&count), "{count}");
        let is_as_of_all = |(left, all): (&Option<f64>, _)| left.is_none() || left == all;
        assert!(left_m.iter().zip(&all_m).all(is_as_of_all));
        let least_m = |costs_m: &[Option<f64>]| {
            let known = costs_m.iter().flatten();
            known.fold(f64::INFINITY, |least, m| least.min(*m))
        };
        assert_eq!(least_m(&left_m), least_m(&all_m));
    }

    #[test]
    fn a_scan_is_not_registered_in_a_place_that_fits_much_worse_than_another() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        let mut rng = StdRng::seed_from_u64(1);
        let prior = Gaussian::new(truth, Matrix3::identity() * 1e-4).unwrap();
        let mut filter = tracking(&world, &prior, &mut rng);
        let beams = choose_beams(&scan, PLACE_BEAMS, 0.2, &attitude, &mut rng);
        let starts = [0.5, 12.0].map(|ahead_m| {
            let place = truth * Pose2::translation(ahead_m, 0.0);
            let lifted = filter.lift(&place, &attitude, None).unwrap();
            (lifted.map_from_lidar, place)
        });
        for (given_up_weight, expected) in [(1e-6, [true, false]), (0.0, [true, true])] {
            filter.config.places.given_up_weight = given_up_weight;
            let found = filter.registered_in_places(&starts, &scan, &beams).unwrap();
            let is_found = [0, 1].map(|index| found[index].is_some());
            assert_eq!(is_found, expected, "{given_up_weight}");
            let pose = pose2_from_pose3(&found[0].as_ref().unwrap().map_from_lidar);
            assert!((pose.inverse() * truth).translation.vector.norm() < 0.01);
        }
    }
}
