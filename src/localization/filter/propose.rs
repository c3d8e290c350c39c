//! Particles of a narrow distribution: sampled from the product of prediction and registration
//! ([`proposal`](crate::localization::proposal)).

use rand::Rng;

use super::phase::Phase;
use super::reweight::{Others, Update};
use super::state::{ParticleFilter, attitude_above};
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::{Beam, RangeImage};
use crate::localization::observation::{
    ClassifiedReturns, above_road, agreement, agrees_better, costs_of_scan, ranges_along,
};
use crate::localization::odometry::Odometry;
use crate::localization::particles::{Particle, ParticleSet};
use crate::localization::places::is_same;
use crate::localization::proposal::{Gaussian, regular};
use crate::map::{GroundPatch, SensorAttitude};
use crate::registration::{RegistrationConfig, approach, register_informative, registered_pose};
use crate::rendering::RenderError;

/// Distance from the prior beyond which a registration is rejected (standard deviations): of normal errors of x, y and heading,
/// one in 13 million is beyond 6, so that one farther off is no error of the prediction.
const MAX_SIGMAS: f64 = 6.0;

/// Where a registration may lead.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Basin {
    /// To a pose that the prediction allows, from a start or else from the prediction.
    Pose { start: Option<Pose3> },
    /// To any pose in the place, from the prediction and, if it is searched, from the best of many poses around it.
    Place { is_searched: bool },
}

/// Distribution of the pose of a frame, given prediction and scan.
pub(super) struct Posterior {
    pub(super) gaussian: Gaussian,
    /// Beams that are compared with the map there.
    pub(super) beams: Vec<Beam>,
    pub(super) mean_cost_m: Option<f64>,
    pub(super) attitude: SensorAttitude,
    /// Above which the attitude is.
    pub(super) ground: GroundPatch,
    /// Whether the registration refutes the prediction, or replaces one that no scan confirmed.
    pub(super) refutes: bool,
    /// Poses that were found in the place and fit alike, with their costs [m], beginning with that from which the scan was registered.
    pub(super) alike: Vec<(Pose3, f64)>,
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
        /// Tolerance [m]: a step is about a fifth of the one before, so that a millimetre of the motion during the sweep is left.
        const TOLERANCE_M: f64 = 5e-3;
        let config = &self.config.proposal;
        let pending = self.pending.unwrap_or_default().motion;
        let predicted = self.particles.mean() * pending * self.increment(odometry);
        let patch = self.patch_at(&predicted)?.or(self.patch);
        let Some(patch) = patch.filter(|_| self.phase.is_tracking()) else {
            return Ok(None);
        };
        let attitude = &attitude_above(&patch, self.predicted, attitude);
        let count = config.compared_beams;
        let beams = ClassifiedReturns::new(scan, attitude).choose(count, config.road_share, rng);
        let start = patch.lift(&predicted, attitude);
        let registration = self.registration().with_tolerance(TOLERANCE_M);
        registered_pose(&*self.map.renderer, &beams, &start, &registration)
    }

    /// Settings of the registration, cautious ones while the pose is not certain.
    fn registration(&self) -> RegistrationConfig {
        let config = &self.config.proposal.registration;
        match self.phase {
            Phase::Tracking => config.clone(),
            _ => config.cautious(),
        }
    }

    /// Registers the scan with the map, from `start` if that is plausible, else from the prediction, and fuses the result with the
    /// prediction; `None` where registration fails, and where its result is implausible and does not refute the prediction. The
    /// attitude is that of a pose in space, where it is known.
    pub(super) fn propose(
        &self,
        scan: &RangeImage,
        attitude: (&SensorAttitude, Option<Pose3>),
        start: Option<Pose3>,
        rng: &mut impl Rng,
    ) -> Result<Option<Posterior>, RenderError> {
        self.propose_in(scan, attitude, Basin::Pose { start }, rng)
    }

    /// The same for particles that have converged to a pose that no scan confirmed: the registration begins with a wide kernel, and a
    /// result elsewhere in the place replaces the prediction until the next scan.
    pub(super) fn propose_widely(
        &self,
        scan: &RangeImage,
        attitude: (&SensorAttitude, Option<Pose3>),
        rng: &mut impl Rng,
    ) -> Result<Option<Posterior>, RenderError> {
        let place = Basin::Place { is_searched: false };
        self.propose_in(scan, attitude, place, rng)
    }

    /// Registers the scan in a basin, and fuses the result with the prediction.
    pub(super) fn propose_in(
        &self,
        scan: &RangeImage,
        (attitude, in_space): (&SensorAttitude, Option<Pose3>),
        basin: Basin,
        rng: &mut impl Rng,
    ) -> Result<Option<Posterior>, RenderError> {
        let config = &self.config.proposal;
        if !config.scan {
            return Ok(None);
        }
        let mean = self.particles.mean();
        let Some(patch) = self.patch_at(&mean)?.or(self.patch) else {
            return Ok(None);
        };
        let attitude = &attitude_above(&patch, in_space, attitude);
        let returns = ClassifiedReturns::new(scan, attitude);
        let mut choose = |count| returns.choose(count, config.road_share, rng);
        let (registered, beams) = (choose(config.beams), choose(config.compared_beams));
        let Some(prior) = Gaussian::new(mean, regular(&self.particles.covariance_about(&mean)))
        else {
            return Ok(None);
        };
        let is_plausible = |pose: &Pose2| prior.squared_distance(pose) <= MAX_SIGMAS.powi(2);
        let predicted = patch.lift(&mean, attitude);
        let renderer = &*self.map.renderer;
        let registration = self.registration();
        let mut alike = Vec::new();
        let start = match basin {
            Basin::Pose { start } => start.filter(|start| is_plausible(&pose2_from_pose3(start))),
            Basin::Place { is_searched } => {
                let mut starts = vec![predicted];
                if is_searched {
                    let above = (&patch, attitude);
                    starts.extend(self.starts_around(&mean, (scan, &returns), above, rng)?);
                }
                alike = self.best_in_place(&starts, &mean, scan, (&registered, &beams))?;
                alike.first().map(|&(pose, _)| pose)
            }
        };
        let start = match start {
            Some(registered) => registered,
            None => approach(renderer, &registered, &predicted, &registration)?,
        };
        let Some(found) = register_informative(renderer, &registered, &start, &registration)?
        else {
            return Ok(None);
        };
        let pose = pose2_from_pose3(&found.map_from_lidar);
        let Some(measured) = Gaussian::new(pose, regular(&found.planar_covariance())) else {
            return Ok(None);
        };
        let refutes = !is_plausible(&pose);
        let is_allowed = matches!(basin, Basin::Place { .. })
            && is_same(&mean, &pose, self.config.places.radius_m);
        if refutes
            && !is_allowed
            && !self.is_refuted(&predicted, &found.map_from_lidar, (&beams, attitude))?
        {
            return Ok(None);
        }
        let prior = if refutes {
            prior.widened_to(&pose)
        } else {
            Some(prior)
        };
        let Some(gaussian) = prior.and_then(|prior| prior.fused(&measured)) else {
            return Ok(None);
        };
        let patch = match basin {
            Basin::Pose { .. } => patch,
            Basin::Place { .. } => self.patch_at(&pose)?.unwrap_or(patch),
        };
        let attitude = patch.attitude_of(&found.map_from_lidar);
        let pose = Some(patch.lift(&gaussian.mean, &attitude));
        let observation = &self.config.observation;
        let costs_m = costs_of_scan(renderer, &[pose], (scan, &beams), observation)?;
        Ok(Some(Posterior {
            gaussian,
            beams,
            mean_cost_m: costs_m[0],
            attitude,
            ground: patch,
            refutes,
            alike,
        }))
    }

    /// Whether a registered pose shows that the predicted one is wrong, as after a place that was confirmed by a pose next to
    /// the right one: nearly all beams above the road agree with the map there, and many more than at the prediction.
    fn is_refuted(
        &self,
        predicted: &Pose3,
        registered: &Pose3,
        (beams, attitude): (&[Beam], &SensorAttitude),
    ) -> Result<bool, RenderError> {
        let config = &self.config.tracking_loss;
        let tolerance_m = config.tolerance_m;
        let beams = above_road(beams, attitude, config.low_height_m);
        let ranges = |pose: &Pose3| ranges_along(&*self.map.renderer, pose, &beams, tolerance_m);
        let (there_m, here_m) = (ranges(registered)?, ranges(predicted)?);
        let share = agreement(&beams, &there_m, tolerance_m);
        let is_sure = share.is_some_and(|share| share >= config.sure_agreement);
        Ok(is_sure && agrees_better(&beams, [&there_m, &here_m], tolerance_m))
    }

    /// Samples the particles from a posterior.
    pub(super) fn sample(&mut self, posterior: Posterior, rng: &mut impl Rng) -> Update {
        let poses = posterior.gaussian.sample(self.config.num_reduced, rng);
        let particle = |pose| Particle::new(pose, Some(posterior.ground.height_m));
        self.particles = ParticleSet::uniform(poses.into_iter().map(particle));
        // Of fewer samples the covariance is that of chance, too.
        let pose = (self.config.num_reduced > 3).then_some(posterior.gaussian.mean);
        Update {
            mean_cost_m: posterior.mean_cost_m,
            beams: posterior.beams,
            attitude: posterior.attitude,
            ground: Some(posterior.ground),
            pose,
            refutes: posterior.refutes,
            others: Others::Unknown,
        }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;
    use rand::{SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::localization::particles::deviation;
    use crate::localization::{LocalizerConfig, State};
    use crate::map::world_for_tests::TestWorld;

    /// A filter that tracks, with particles of a distribution.
    pub fn tracking(world: &TestWorld, prior: &Gaussian, rng: &mut StdRng) -> ParticleFilter {
        let particles = ParticleSet::uniform(prior.sample(100, rng));
        let config = LocalizerConfig::of_test(100);
        let mut filter = ParticleFilter::new(config, world.map(), None, particles).unwrap();
        filter.phase = Phase::Tracking;
        filter
    }

    #[test]
    fn particles_represent_the_product_of_prediction_and_registration() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let mut rng = StdRng::seed_from_u64(1);
        // As certain as the registration, and off by two of its standard deviations.
        let sigmas = Vector3::new(5e-4, 3e-4, 2.5e-5);
        let mean = truth * Pose2::new(nalgebra::Vector2::new(1e-3, -5e-4), 5e-5);
        let covariance = nalgebra::Matrix3::from_diagonal(&sigmas.component_mul(&sigmas));
        let prior = Gaussian::new(mean, covariance).unwrap();
        let mut filter = tracking(&world, &prior, &mut rng);
        let scan = world.scan(&truth);
        let noisy = (scan.ranges.iter().enumerate())
            .map(|(pixel, range_m)| range_m + 0.02 * (pixel as f32).sin());
        let scan = RangeImage::from_ranges(noisy.collect(), &scan.model);
        let attitude = SensorAttitude::default();

        let config = &filter.config.proposal;
        let [mut rng, mut same] = [2; 2].map(StdRng::seed_from_u64);
        let (count, road_share) = (config.beams, config.road_share);
        let beams = ClassifiedReturns::new(&scan, &attitude).choose(count, road_share, &mut same);
        let start = filter.patch_at(&mean).unwrap().unwrap();
        let start = start.lift(&mean, &attitude);
        let registration = &config.registration;
        let start = approach(&world, &beams, &start, registration).unwrap();
        let found = register_informative(&world, &beams, &start, registration).unwrap();
        let found = found.unwrap();
        let measured = regular(&found.planar_covariance()).try_inverse().unwrap();
        let information = regular(&covariance).try_inverse().unwrap() + measured;
        let expected = information.try_inverse().unwrap();
        let off = deviation(&pose2_from_pose3(&found.map_from_lidar), &mean);
        let shift = expected * measured * off;

        let posterior = filter
            .propose(&scan, (&attitude, None), None, &mut rng)
            .unwrap()
            .unwrap();
        filter.sample(posterior, &mut rng);
        let pose = filter.particles.mean();
        assert_eq!(filter.particles.len(), filter.config.num_reduced);
        assert_relative_eq!(deviation(&pose, &mean), shift, epsilon = 1e-6);
        let covariance = filter.particles.covariance_about(&pose);
        assert_relative_eq!(covariance, expected, max_relative = 0.01, epsilon = 1e-13);
    }

    #[test]
    fn a_registration_starts_at_a_plausible_pose_instead_of_the_prediction() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let attitude = SensorAttitude::default();
        let at_truth = world.ground.lift(&truth, &attitude).unwrap();
        let error_m = |mean: Pose2, sigma_m: f64, start: Option<Pose3>| {
            let mut rng = StdRng::seed_from_u64(1);
            let sigmas = Vector3::new(sigma_m, sigma_m, 0.01);
            let covariance = nalgebra::Matrix3::from_diagonal(&sigmas.component_mul(&sigmas));
            let prior = Gaussian::new(mean, covariance).unwrap();
            let filter = tracking(&world, &prior, &mut rng);
            let found = filter.propose(&world.scan(&truth), (&attitude, None), start, &mut rng);
            let off = |found: Posterior| deviation(&found.gaussian.mean, &truth).xy().norm();
            found.unwrap().map_or(f64::INFINITY, off)
        };
        // The prediction is off by more than the gates of the registration.
        let aside = truth * Pose2::translation(0.0, 3.0);
        assert!(error_m(aside, 1.0, at_truth) < 0.01);
        let without_m = error_m(aside, 1.0, None);
        assert!(without_m > 0.1, "{without_m}");
        // The given start is off, by 30 standard deviations.
        let off = world.ground.lift(&aside, &attitude).unwrap();
        assert!(error_m(truth, 0.1, off) < 0.01);
    }

    #[test]
    fn a_registration_that_refutes_the_prediction_replaces_it_where_no_other_pose_fits_as_well() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let attitude = SensorAttitude::default();
        let scan = world.scan(&truth);
        let covariance = nalgebra::Matrix3::identity() * 1e-4;
        let prior = Gaussian::new(truth * Pose2::translation(0.0, 0.4), covariance).unwrap();
        let mut rng = StdRng::seed_from_u64(1);
        let mut filter = tracking(&world, &prior, &mut rng);
        for refuted in [true, false, false] {
            let estimate = filter.step(Odometry::Unknown, &scan, &attitude, &mut rng);
            let estimate = estimate.unwrap();
            assert!(deviation(&estimate.pose, &truth).xy().norm() < 0.01);
            assert_eq!(estimate.state, State::Tracking);
            assert_eq!(filter.updated.refuted, refuted);
        }
    }

    #[test]
    fn a_prediction_is_refuted_where_many_more_beams_agree_at_the_registered_pose() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let attitude = SensorAttitude::default();
        let prior = Gaussian::new(truth, nalgebra::Matrix3::identity() * 1e-4).unwrap();
        let mut rng = StdRng::seed_from_u64(1);
        let filter = tracking(&world, &prior, &mut rng);
        let beams: Vec<Beam> = world.scan(&truth).beams().collect();
        let aside = |aside_m: f64| {
            let pose = truth * Pose2::translation(0.0, aside_m);
            world.ground.lift(&pose, &attitude).unwrap().unwrap()
        };
        let refutes = |predicted_m: f64, registered_m: f64, beams: &[Beam]| {
            let (predicted, registered) = (aside(predicted_m), aside(registered_m));
            let found = filter.is_refuted(&predicted, &registered, (beams, &attitude));
            found.unwrap()
        };
        assert!(refutes(0.6, 0.0, &beams) && !refutes(0.0, 0.6, &beams));
        // Where all beams agree, nothing is refuted.
        assert!(!refutes(0.0, 0.01, &beams));
        // A third of the beams is too short: they agree nowhere.
        let shortened = (beams.iter().enumerate()).map(|(number, beam)| Beam {
            range_m: beam.range_m * if number % 3 == 0 { 0.9 } else { 1.0 },
            ..*beam
        });
        assert!(!refutes(0.6, 0.0, &shortened.collect::<Vec<_>>()));
    }

    #[test]
    fn of_three_particles_or_fewer_the_pose_is_not_that_of_the_posterior() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let covariance = nalgebra::Matrix3::identity() * 1e-6;
        let prior = Gaussian::new(truth, covariance).unwrap();
        for (count, is_of_posterior) in [(3, false), (4, true), (100, true)] {
            let mut rng = StdRng::seed_from_u64(1);
            let mut filter = tracking(&world, &prior, &mut rng);
            filter.config.num_reduced = count;
            let attitude = SensorAttitude::default();
            let posterior = filter.propose(&world.scan(&truth), (&attitude, None), None, &mut rng);
            let posterior = posterior.unwrap().unwrap();
            let mean = posterior.gaussian.mean;
            let update = filter.sample(posterior, &mut rng);
            assert_eq!(update.pose, is_of_posterior.then_some(mean));
            assert_eq!(filter.particles.len(), count);
        }
    }

    #[test]
    fn the_covariance_of_an_estimate_contains_the_error_of_the_map_once() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let covariance_after = |map_error_m: f64, frames: usize| {
            let mut rng = StdRng::seed_from_u64(1);
            let covariance = nalgebra::Matrix3::identity() * 1e-6;
            let prior = Gaussian::new(truth, covariance).unwrap();
            let mut filter = tracking(&world, &prior, &mut rng);
            filter.config.proposal.registration.map_error_m = map_error_m;
            let scan = world.scan(&truth);
            let attitude = SensorAttitude::default();
            let frames = (0..frames).map(|_| {
                let frame = filter.step(Odometry::Unknown, &scan, &attitude, &mut rng);
                frame.unwrap().covariance
            });
            frames.collect::<Vec<_>>().pop().unwrap()
        };
        for frames in [1, 5] {
            let without = covariance_after(0.0, frames);
            let with = covariance_after(0.03, frames);
            let of_map = Vector3::new(9e-4, 9e-4, 1e-6);
            let expected = nalgebra::Matrix3::from_diagonal(&of_map);
            assert_relative_eq!(with - without, expected, epsilon = 1e-12);
        }
    }
}
