//! Particles of a narrow distribution: sampled from the product of prediction and registration
//! ([`proposal`](crate::localization::proposal)).

use rand::Rng;
use rayon::prelude::*;

use super::phase::Phase;
use super::reweight::Update;
use super::search::{APART_M, PLACE_BEAMS, within_place};
use super::state::{ParticleFilter, attitude_above};
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::{Beam, RangeImage};
use crate::localization::observation::{
    ClassifiedReturns, above_road, agreement, agrees_better, costs_of_scan, ranges_along,
};
use crate::localization::odometry::Odometry;
use crate::localization::particles::{Particle, ParticleSet};
use crate::localization::places::{best_of_each, is_same};
use crate::localization::proposal::{Gaussian, regular};
use crate::map::{GroundPatch, SensorAttitude};
use crate::registration::{RegistrationConfig, approach, register_informative, registered_pose};
use crate::rendering::RenderError;

/// Distance from the prior beyond which a registration is rejected (standard deviations): of normal errors of x, y and heading,
/// one in 13 million is beyond 6, so that one farther off is no error of the prediction.
const MAX_SIGMAS: f64 = 6.0;

/// Where a registration may lead.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Basin {
    /// To a pose that the prediction allows, from a start or else from the prediction.
    Pose { start: Option<Pose3> },
    /// To any pose in the place, from the prediction and, if it is searched, from the best of many poses around it.
    Place { is_searched: bool },
}

/// Distribution of the pose of a frame, given prediction and scan.
pub(super) struct Posterior {
    gaussian: Gaussian,
    /// Beams that are compared with the map there.
    beams: Vec<Beam>,
    mean_cost_m: Option<f64>,
    pub(super) attitude: SensorAttitude,
    /// Above which the attitude is.
    pub(super) ground: GroundPatch,
    /// Whether the registration refutes the prediction, or replaces one that no scan confirmed.
    pub(super) refutes: bool,
    /// Poses in the place, the registered one among them, that fit as well, if it was searched.
    alike: Vec<Pose3>,
}

/// What a search around the prediction shows of the pose to which a scan led.
pub(super) enum Searched {
    /// No other pose fits as well.
    Best,
    /// Others fit as well.
    Alike,
    /// Another one fits better: the sensor moved otherwise than predicted.
    Elsewhere {
        posterior: Box<Posterior>,
        /// Whether no other pose fits as well as that one.
        is_best: bool,
    },
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

    /// Searches the surroundings of the prediction for poses that fit as well as one in space to which a scan led, or better, by the mean
    /// costs of the same beams.
    pub(super) fn search_around(
        &self,
        scan: &RangeImage,
        attitude: (&SensorAttitude, Option<Pose3>),
        here: &Pose3,
        rng: &mut impl Rng,
    ) -> Result<Searched, RenderError> {
        /// Distance from which on a pose is another one: its position is wrong if the first one is right [m].
        const OTHER_M: f64 = 0.5;
        let place = Basin::Place { is_searched: true };
        let Some(found) = self.propose_in(scan, attitude, place, rng)? else {
            return Ok(Searched::Best);
        };
        let are_apart =
            |a: &Pose3, b: &Pose3| (a.translation.vector - b.translation.vector).norm() >= OTHER_M;
        if !found.alike.iter().any(|pose| are_apart(pose, here)) {
            return Ok(Searched::Best);
        }
        let there = found.ground.lift(&found.gaussian.mean, &found.attitude);
        let (both, observation) = ([Some(*here), Some(there)], &self.config.observation);
        let costs_m = costs_of_scan(
            &*self.map.renderer,
            &both,
            (scan, &found.beams),
            observation,
        )?;
        let [here_m, there_m] = [costs_m[0], costs_m[1]].map(|m| m.unwrap_or(f64::INFINITY));
        let tolerance_m = self.config.places.tolerance_m;
        Ok(
            if there_m + tolerance_m < here_m && are_apart(&there, here) {
                Searched::Elsewhere {
                    is_best: !found.alike.iter().any(|pose| are_apart(pose, &there)),
                    posterior: Box::new(Posterior {
                        refutes: true,
                        ..found
                    }),
                }
            } else if there_m <= here_m + tolerance_m {
                Searched::Alike
            } else {
                Searched::Best
            },
        )
    }

    /// Registers the scan in a basin, and fuses the result with the prediction.
    fn propose_in(
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
                alike = self.best_registered(&starts, &mean, scan, (&registered, &beams))?;
                alike.first().copied()
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
            is_best: false,
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use glam::Vec3;
    use nalgebra::Vector3;
    use rand::{SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::localization::particles::deviation;
    use crate::localization::{LocalizerConfig, State};
    use crate::map::world_for_tests::TestWorld;

    /// A filter that tracks, with particles of a distribution.
    fn tracking(world: &TestWorld, prior: &Gaussian, rng: &mut StdRng) -> ParticleFilter {
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

    /// A pose beside a house without a car or a pole, its scan, and the part of the scan that looks alike along the wall.
    fn beside_a_wall(world: &TestWorld) -> (Pose2, [RangeImage; 2]) {
        let pose = world.pose_at(22.0, 0.2, 0.05);
        let whole = world.scan(&pose);
        let is_of_wall = |point: &Vec3| point.y < 0.0 && point.x.abs() < 1.0;
        let ranges_m = (whole.points.iter().zip(&whole.ranges))
            .map(|(point, &range_m)| if is_of_wall(point) { range_m } else { 0.0 });
        let of_wall = RangeImage::from_ranges(ranges_m.collect(), &whole.model);
        (pose, [whole, of_wall])
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

    /// The other pose to which a search leads, if there is one.
    fn other(searched: Searched) -> Option<Pose2> {
        match searched {
            Searched::Elsewhere { posterior, .. } => Some(posterior.gaussian.mean),
            Searched::Best | Searched::Alike => None,
        }
    }

    #[test]
    fn a_scan_that_fits_much_better_next_to_a_tracked_pose_is_used_there() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let scan = world.scan(&truth);
        let attitude = SensorAttitude::default();
        for (off_m, turned_rad) in [(0.0, 0.0), (0.8, 0.0), (-0.8, 0.0), (2.5, 0.0), (2.0, 0.3)] {
            let pose = truth * Pose2::new(nalgebra::Vector2::new(off_m, 0.0), turned_rad);
            let prior = Gaussian::new(pose, nalgebra::Matrix3::identity() * 1e-4).unwrap();
            let mut rng = StdRng::seed_from_u64(1);
            let mut filter = tracking(&world, &prior, &mut rng);
            let lifted = filter.lift(&pose, &attitude, None).unwrap().map_from_lidar;
            let found = filter.search_around(&scan, (&attitude, None), &lifted, &mut rng);
            let found = other(found.unwrap());
            assert_eq!(found.is_some(), off_m != 0.0, "{off_m}");
            if let Some(found) = found {
                assert_relative_eq!(found, truth, epsilon = 5e-3);
            }
            // A registration with a narrow kernel does not lead there.
            filter.config.proposal.registration.kernel_m = 0.02;
            filter
                .agreement
                .observe(Some(0.98), &filter.config.tracking_loss);
            let frame = filter
                .step(Odometry::Unknown, &scan, &attitude, &mut rng)
                .unwrap();
            assert_relative_eq!(frame.pose, truth, epsilon = 5e-3);
            // No other pose fits as well.
            assert_eq!(frame.state, State::Tracking, "{off_m}");
            assert_eq!(filter.updated.refuted, off_m != 0.0, "{off_m}");
        }
    }

    #[test]
    fn after_an_assumed_motion_a_frame_is_tracked_where_no_other_pose_fits_as_well() {
        let world = TestWorld::street();
        let (truth, [whole, of_wall]) = beside_a_wall(&world);
        let attitude = SensorAttitude::default();
        let stands = Pose3::identity();
        for (scan, odometry, is_confirmed) in [
            (&whole, Odometry::Motion(stands), true),
            (&whole, Odometry::Assumed(stands), true),
            (&of_wall, Odometry::Motion(stands), true),
            (&of_wall, Odometry::Assumed(stands), false),
        ] {
            let prior = Gaussian::new(truth, nalgebra::Matrix3::identity() * 1e-4).unwrap();
            let mut rng = StdRng::seed_from_u64(1);
            let mut filter = tracking(&world, &prior, &mut rng);
            let frame = filter.step(odometry, scan, &attitude, &mut rng).unwrap();
            let is_tracking = frame.state == State::Tracking;
            assert_eq!(is_tracking, is_confirmed, "{odometry:?}");
            assert_eq!(filter.updated.refuted, !is_confirmed, "{odometry:?}");
        }
    }

    #[test]
    fn a_search_around_the_prediction_is_the_same_on_any_number_of_threads() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        let pose = truth * Pose2::translation(2.5, 0.0);
        let prior = Gaussian::new(pose, nalgebra::Matrix3::identity() * 1e-4).unwrap();
        let found = [1, 4].map(|threads| {
            let mut rng = StdRng::seed_from_u64(1);
            let filter = tracking(&world, &prior, &mut rng);
            let lifted = filter.lift(&pose, &attitude, None).unwrap().map_from_lidar;
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            let found = pool
                .unwrap()
                .install(|| filter.search_around(&scan, (&attitude, None), &lifted, &mut rng));
            other(found.unwrap())
        });
        assert!(found[0].is_some() && found[0] == found[1]);
    }

    #[test]
    fn a_pose_elsewhere_with_which_too_few_beams_agree_is_confirmed_by_the_next_scan() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let attitude = SensorAttitude::default();
        let whole = world.scan(&truth);
        let ranges_m = (whole.ranges.iter().enumerate())
            .map(|(pixel, range_m)| range_m * if pixel % 3 == 0 { 0.9 } else { 1.0 });
        let shortened = RangeImage::from_ranges(ranges_m.collect(), &whole.model);
        let pose = truth * Pose2::translation(2.0, 0.0);
        let prior = Gaussian::new(pose, nalgebra::Matrix3::identity() * 1e-4).unwrap();
        let mut rng = StdRng::seed_from_u64(1);
        let mut filter = tracking(&world, &prior, &mut rng);
        filter.config.proposal.registration.kernel_m = 0.02;
        let stands = Odometry::Assumed(Pose3::identity());
        for (scan, state) in [(&shortened, State::Searching), (&whole, State::Tracking)] {
            let frame = filter.step(stands, scan, &attitude, &mut rng).unwrap();
            assert_relative_eq!(frame.pose, truth, epsilon = 0.01);
            assert_eq!(frame.state, state, "{:?}", frame.agreement);
        }
    }

    #[test]
    fn a_right_pose_with_which_fewer_beams_agree_than_usual_stays() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let scan = world.scan(&truth);
        let ranges_m = (scan.ranges.iter().enumerate())
            .map(|(pixel, range_m)| range_m * if pixel % 4 == 0 { 0.9 } else { 1.0 });
        let scan = RangeImage::from_ranges(ranges_m.collect(), &scan.model);
        let prior = Gaussian::new(truth, nalgebra::Matrix3::identity() * 1e-4).unwrap();
        let mut rng = StdRng::seed_from_u64(1);
        let mut filter = tracking(&world, &prior, &mut rng);
        let config = filter.config.tracking_loss.clone();
        filter.agreement.observe(Some(0.98), &config);
        let attitude = SensorAttitude::default();
        let frame = filter.step(Odometry::Unknown, &scan, &attitude, &mut rng);
        let frame = frame.unwrap();
        assert!(frame.agreement < Some(0.9), "{:?}", frame.agreement);
        assert_relative_eq!(frame.pose, truth, epsilon = 0.01);
        assert!(!filter.updated.refuted);
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
