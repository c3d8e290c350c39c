//! Search around a prediction: whether other poses fit as well as that to which a registration led, or better.

use rand::Rng;

use super::propose::{Basin, Posterior};
use super::reweight::Others;
use super::search::{APART_M, PLACE_BEAMS, within_place};
use super::state::ParticleFilter;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::{Beam, PERIOD_S, RangeImage};
use crate::localization::observation::{ClassifiedReturns, costs_of_scan};
use crate::localization::particles::Particle;
use crate::localization::places::{best_of_each, is_same};
use crate::localization::proposal::Gaussian;
use crate::map::{GroundPatch, SensorAttitude};
use crate::odometry::MAX_ACCELERATION_M_PER_S2;
use crate::rendering::RenderError;

impl ParticleFilter {
    /// Compares the pose in space to which a scan led with others around the prediction, by the mean costs of the same beams. Returns
    /// the distribution around a better one, with which as many beams agree, if there is one that the sensor can have reached, and how
    /// others fit.
    pub(super) fn search_around(
        &self,
        scan: &RangeImage,
        attitude: (&SensorAttitude, Option<Pose3>),
        here: &Pose3,
        rng: &mut impl Rng,
    ) -> Result<(Option<Posterior>, Others), RenderError> {
        /// Distance from which on a pose is another one: its position is wrong if the first one is right [m].
        const OTHER_M: f64 = 0.5;
        let place = Basin::Place { is_searched: true };
        let found = self.propose_in(scan, attitude, place, rng)?;
        let Some(found) = found.filter(|found| !found.alike.is_empty()) else {
            return Ok((None, Others::Unknown));
        };
        let (beams, observation) = (&found.beams, &self.config.observation);
        let costs_m = costs_of_scan(
            &*self.map.renderer,
            &[Some(*here)],
            (scan, beams),
            observation,
        )?;
        let here_m = costs_m[0].unwrap_or(f64::INFINITY);
        let least_m = (found.alike.iter()).fold(f64::INFINITY, |least, (_, m)| least.min(*m));
        let tolerance_m = self.config.places.tolerance_m;
        // At the end of a map the cost is also less where more beams meet it.
        let agreement_at = |pose| self.agreement_at(pose, beams, attitude.0);
        let is_better = least_m + tolerance_m < here_m
            && agreement_at(&found.alike[0].0)? >= agreement_at(here)?;
        let predicted = self.particles.mean();
        if is_better && found.refutes && !self.is_reachable(&predicted, &found.gaussian.mean) {
            return Ok((None, Others::Alike));
        }
        let best = if is_better { found.alike[0].0 } else { *here };
        let most_m = least_m.min(here_m) + tolerance_m;
        let is_other = |(pose, cost_m): &(Pose3, f64)| {
            let apart_m = (pose.translation.vector - best.translation.vector).norm();
            apart_m >= OTHER_M && *cost_m <= most_m
        };
        let radius_m = self.config.places.radius_m;
        let others = if found.alike.iter().any(is_other) {
            Others::Alike
        } else if is_same(&predicted, &pose2_from_pose3(&best), radius_m) {
            Others::Worse
        } else {
            Others::Unknown
        };
        let better = is_better.then_some(Posterior {
            refutes: true,
            ..found
        });
        Ok((better, others))
    }

    /// Whether a sensor whose pose was predicted can have accelerated to another pose since it was last certain.
    pub(super) fn is_reachable(&self, predicted: &Pose2, pose: &Pose2) -> bool {
        let shift_m = pose.translation.vector - predicted.translation.vector;
        shift_m.norm() <= MAX_ACCELERATION_M_PER_S2 * self.since_certain_s().powi(2)
    }

    /// Time since the pose was last not doubtful, at least that of a scan [s].
    pub(super) fn since_certain_s(&self) -> f64 {
        (self.updated.doubtful_s.unwrap_or(0.0) + self.duration_s).max(PERIOD_S)
    }

    /// Poses in the place of a pose with which a scan is most consistent, at least a metre apart, each at the height and the attitude of the
    /// sensor above the ground.
    pub(super) fn starts_around(
        &self,
        place: &Pose2,
        (scan, returns): (&RangeImage, &ClassifiedReturns),
        (patch, attitude): (&GroundPatch, &SensorAttitude),
        rng: &mut impl Rng,
    ) -> Result<Vec<Pose3>, RenderError> {
        /// Number of poses that are compared with the scan: within two standard deviations in a place of 5 m one per half a metre and
        /// tenth of a radian.
        const POSES: usize = 2000;
        /// Number of beams of each comparison.
        const BEAMS: usize = 200;
        /// Largest number of poses that are returned.
        const STARTS: usize = 16;
        let beams = returns.choose(BEAMS, self.config.proposal.road_share, rng);
        let radius_m = self.config.places.radius_m;
        let covariance = within_place(None, radius_m);
        let Some(around) = covariance.and_then(|it| Gaussian::new(*place, it)) else {
            return Ok(Vec::new());
        };
        let mut poses = around.sample(POSES, rng);
        poses.retain(|pose| is_same(place, pose, radius_m));
        let lift = |pose: &Pose2| {
            let shift_m = pose.translation.vector - place.translation.vector;
            Some(patch.shifted(&shift_m).lift(pose, attitude))
        };
        let lifted: Vec<Option<Pose3>> = poses.iter().map(lift).collect();
        let costs_m = self.least_costs(&lifted, (scan, &beams))?;
        let particles: Vec<Particle> = poses.iter().copied().map(Particle::from).collect();
        let best = best_of_each(&particles, &costs_m, STARTS, APART_M);
        Ok(best.into_iter().filter_map(|index| lifted[index]).collect())
    }

    /// The best of the poses to which beams are registered from some starts in a place, with their costs [m]: those whose costs exceed
    /// the least by no more than the tolerance of places, beginning with the nearest to the centre of the place.
    pub(super) fn best_in_place(
        &self,
        starts: &[Pose3],
        place: &Pose2,
        scan: &RangeImage,
        (registered, compared): (&[Beam], &[Beam]),
    ) -> Result<Vec<(Pose3, f64)>, RenderError> {
        let step = registered.len().div_ceil(PLACE_BEAMS).max(1);
        let some: Vec<Beam> = registered.iter().step_by(step).copied().collect();
        let starts: Vec<_> = starts.iter().map(|start| (*start, *place)).collect();
        let found = self.registered_in_places(&starts, scan, &some)?;
        let found = found.into_iter().flatten();
        let poses: Vec<_> = found.map(|found| Some(found.map_from_lidar)).collect();
        let observation = &self.config.observation;
        let costs_m = costs_of_scan(&*self.map.renderer, &poses, (scan, compared), observation)?;
        let least_m = (costs_m.iter().flatten()).fold(f64::INFINITY, |least, m| least.min(*m));
        let most_m = least_m + self.config.places.tolerance_m;
        let away_m = |pose: &Pose3| {
            let shift_m = pose2_from_pose3(pose).translation.vector - place.translation.vector;
            shift_m.norm()
        };
        let both = poses.into_iter().zip(costs_m);
        let both = both.filter_map(|(pose, cost_m)| pose.zip(cost_m));
        let mut fitting: Vec<(Pose3, f64)> = both.filter(|(_, cost_m)| *cost_m <= most_m).collect();
        fitting.sort_by(|(a, _), (b, _)| away_m(a).total_cmp(&away_m(b)));
        Ok(fitting)
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use glam::Vec3;
    use nalgebra::{Matrix3, Vector3};
    use rand::{SeedableRng, rngs::StdRng};

    use super::super::propose;
    use super::*;
    use crate::localization::State;
    use crate::localization::odometry::Odometry;
    use crate::map::world_for_tests::TestWorld;

    /// A filter that tracks a pose, with a standard deviation of a centimetre and of half a degree.
    fn tracking(world: &TestWorld, pose: &Pose2, rng: &mut StdRng) -> ParticleFilter {
        let prior = Gaussian::new(*pose, Matrix3::identity() * 1e-4).unwrap();
        propose::tests::tracking(world, &prior, rng)
    }

    /// A pose next to a house without a car or a pole, its scan, and the part of the scan that looks alike along the wall.
    fn next_to_a_wall(world: &TestWorld) -> (Pose2, [RangeImage; 2]) {
        let pose = world.pose_at(22.0, 0.2, 0.05);
        let whole = world.scan(&pose);
        let is_of_wall = |point: &Vec3| point.y < 0.0 && point.x.abs() < 1.0;
        let ranges_m = (whole.points.iter().zip(&whole.ranges))
            .map(|(point, &range_m)| if is_of_wall(point) { range_m } else { 0.0 });
        let of_wall = RangeImage::from_ranges(ranges_m.collect(), &whole.model);
        (pose, [whole, of_wall])
    }

    #[test]
    fn a_scan_that_fits_much_better_next_to_a_tracked_pose_is_used_there() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let scan = world.scan(&truth);
        let attitude = SensorAttitude::default();
        for (off_m, turned_rad) in [(0.0, 0.0), (0.8, 0.0), (-0.8, 0.0), (2.5, 0.0), (2.0, 0.3)] {
            let pose = truth * Pose2::new(nalgebra::Vector2::new(off_m, 0.0), turned_rad);
            let mut rng = StdRng::seed_from_u64(1);
            let mut filter = tracking(&world, &pose, &mut rng);
            filter.set_duration_s(0.3);
            let lifted = filter.lift(&pose, &attitude, None).unwrap().map_from_lidar;
            let found = filter.search_around(&scan, (&attitude, None), &lifted, &mut rng);
            let found = found.unwrap().0.map(|found| found.gaussian.mean);
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
    fn a_better_pose_is_used_once_the_sensor_can_have_reached_it() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        // 0.5 m within a tenth of a second, and nine times that within three.
        for (off_m, periods, is_used) in [
            (0.4, 1.0, true),
            (0.6, 1.0, false),
            (0.6, 2.0, true),
            (2.5, 2.0, false),
            (2.5, 3.0, true),
        ] {
            let pose = truth * Pose2::translation(off_m, 0.0);
            // Since the last scan, or in scans each of which was doubtful.
            for doubtful_s in [None, Some(PERIOD_S * (periods - 1.0))] {
                let mut rng = StdRng::seed_from_u64(1);
                let mut filter = tracking(&world, &pose, &mut rng);
                filter.updated.doubtful_s = doubtful_s;
                if doubtful_s.is_none() {
                    filter.set_duration_s(periods * PERIOD_S);
                }
                let here = filter.lift(&pose, &attitude, None).unwrap().map_from_lidar;
                let found = filter.search_around(&scan, (&attitude, None), &here, &mut rng);
                let (better, others) = found.unwrap();
                assert_eq!(better.is_some(), is_used, "{off_m} {periods}");
                let expected = if is_used {
                    Others::Worse
                } else {
                    Others::Alike
                };
                assert_eq!(others, expected, "{off_m} {periods}");
            }
        }
    }

    #[test]
    fn the_time_since_a_pose_was_certain_is_that_of_the_scans_and_at_least_a_tenth_of_a_second() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let mut rng = StdRng::seed_from_u64(1);
        let mut filter = tracking(&world, &truth, &mut rng);
        for (doubtful_s, duration_s, since_s) in [
            (None, 0.02, 0.1),
            (None, 0.5, 0.5),
            (Some(0.06), 0.02, 0.1),
            (Some(0.3), 0.1, 0.4),
        ] {
            filter.updated.doubtful_s = doubtful_s;
            filter.set_duration_s(duration_s);
            assert_relative_eq!(filter.since_certain_s(), since_s, epsilon = 1e-12);
        }
    }

    #[test]
    fn a_registration_that_leads_farther_than_the_sensor_can_have_is_confirmed_by_the_next_scan() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        for (off_m, state) in [(0.4, State::Tracking), (0.8, State::Searching)] {
            let mut rng = StdRng::seed_from_u64(1);
            let pose = truth * Pose2::translation(0.0, off_m);
            let mut filter = tracking(&world, &pose, &mut rng);
            let stands = Odometry::Motion(Pose3::identity());
            for state in [state, State::Tracking] {
                let frame = filter.step(stands, &scan, &attitude, &mut rng).unwrap();
                assert_relative_eq!(frame.pose, truth, epsilon = 5e-3);
                assert_eq!(frame.state, state, "{off_m}");
            }
        }
    }

    #[test]
    fn a_tracked_pose_next_to_the_right_one_is_searched_until_that_can_be_reached() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        let mut rng = StdRng::seed_from_u64(1);
        let pose = truth * Pose2::translation(1.5, 0.0);
        let mut filter = tracking(&world, &pose, &mut rng);
        filter.config.proposal.registration.kernel_m = 0.02;
        let stands = Odometry::Assumed(Pose3::identity());
        let states = [State::Searching, State::Searching, State::Tracking];
        for (state, off_m) in states.into_iter().zip([1.5, 0.0, 0.0]) {
            let frame = filter.step(stands, &scan, &attitude, &mut rng).unwrap();
            let found_m = (frame.pose.translation.vector - truth.translation.vector).norm();
            assert_relative_eq!(found_m, off_m, epsilon = 0.05);
            assert_eq!(frame.state, state, "{off_m}");
        }
    }

    #[test]
    fn after_an_assumed_motion_a_frame_is_tracked_where_no_other_pose_fits_as_well() {
        let world = TestWorld::street();
        let (truth, [whole, of_wall]) = next_to_a_wall(&world);
        let attitude = SensorAttitude::default();
        let stands = Pose3::identity();
        for (scan, odometry, is_confirmed) in [
            (&whole, Odometry::Motion(stands), true),
            (&whole, Odometry::Assumed(stands), true),
            (&of_wall, Odometry::Motion(stands), true),
            (&of_wall, Odometry::Assumed(stands), false),
        ] {
            let mut rng = StdRng::seed_from_u64(1);
            let mut filter = tracking(&world, &truth, &mut rng);
            let frame = filter.step(odometry, scan, &attitude, &mut rng).unwrap();
            let is_tracking = frame.state == State::Tracking;
            assert_eq!(is_tracking, is_confirmed, "{odometry:?}");
            let is_doubtful = filter.updated.doubtful_s.is_some();
            assert_eq!(is_doubtful, !is_confirmed, "{odometry:?}");
        }
    }

    #[test]
    fn a_pose_of_which_others_fitted_alike_is_tracked_after_two_scans_with_which_none_does() {
        let world = TestWorld::street();
        let (truth, [whole, of_wall]) = next_to_a_wall(&world);
        let attitude = SensorAttitude::default();
        let stands = Odometry::Assumed(Pose3::identity());
        let mut rng = StdRng::seed_from_u64(1);
        let mut filter = tracking(&world, &truth, &mut rng);
        let scans = [&of_wall, &of_wall, &whole, &whole, &whole];
        let states = scans.map(|scan| {
            let frame = filter.step(stands, scan, &attitude, &mut rng);
            frame.unwrap().state
        });
        let is_tracking = states.map(|state| state == State::Tracking);
        assert_eq!(is_tracking, [false, false, false, true, true]);
    }

    #[test]
    fn a_pose_that_is_turned_or_a_little_off_is_replaced() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        for (off_m, turned_rad) in [(0.3, 0.0), (0.0, 0.3)] {
            let pose = truth * Pose2::new(nalgebra::Vector2::new(off_m, 0.0), turned_rad);
            let mut rng = StdRng::seed_from_u64(1);
            let filter = tracking(&world, &pose, &mut rng);
            let here = filter.lift(&pose, &attitude, None).unwrap().map_from_lidar;
            let found = filter.search_around(&scan, (&attitude, None), &here, &mut rng);
            let (better, others) = found.unwrap();
            assert_relative_eq!(better.unwrap().gaussian.mean, truth, epsilon = 5e-3);
            assert_eq!(others, Others::Worse);
        }
    }

    #[test]
    fn a_search_of_another_place_tells_nothing_of_a_pose() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        for (away_m, expected) in [(0.0, Others::Worse), (20.0, Others::Unknown)] {
            let mut rng = StdRng::seed_from_u64(1);
            let elsewhere = truth * Pose2::translation(away_m, 0.0);
            let filter = tracking(&world, &elsewhere, &mut rng);
            let here = filter.lift(&truth, &attitude, None).unwrap().map_from_lidar;
            let found = filter.search_around(&scan, (&attitude, None), &here, &mut rng);
            let (better, others) = found.unwrap();
            assert!(better.is_none());
            assert_eq!(others, expected);
        }
    }

    #[test]
    fn a_search_around_the_prediction_is_the_same_on_any_number_of_threads() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        let pose = truth * Pose2::translation(2.5, 0.0);
        let found = [1, 4].map(|threads| {
            let mut rng = StdRng::seed_from_u64(1);
            let mut filter = tracking(&world, &pose, &mut rng);
            filter.set_duration_s(0.3);
            let lifted = filter.lift(&pose, &attitude, None).unwrap().map_from_lidar;
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
            let found = pool
                .unwrap()
                .install(|| filter.search_around(&scan, (&attitude, None), &lifted, &mut rng));
            found.unwrap().0.map(|found| found.gaussian.mean)
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
        let mut rng = StdRng::seed_from_u64(1);
        let mut filter = tracking(&world, &pose, &mut rng);
        filter.set_duration_s(0.3);
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
        let mut rng = StdRng::seed_from_u64(1);
        let mut filter = tracking(&world, &truth, &mut rng);
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
    fn starts_on_a_slope_are_at_the_height_of_the_sensor_above_it() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        let mut rng = StdRng::seed_from_u64(1);
        let filter = tracking(&world, &truth, &mut rng);
        let slope = GroundPatch {
            height_m: 0.0,
            normal: Vector3::new(-0.1, 0.05, 1.0).normalize(),
        };
        let returns = ClassifiedReturns::new(&scan, &attitude);
        let above = (&slope, &attitude);
        let starts = filter.starts_around(&truth, (&scan, &returns), above, &mut rng);
        let starts = starts.unwrap();
        assert!(starts.len() > 1);
        for start in starts {
            let shift_m = start.translation.vector.xy() - truth.translation.vector;
            let height_m = start.translation.z - (0.1 * shift_m.x - 0.05 * shift_m.y);
            let expected_m = attitude.height_m / slope.normal.z;
            assert_relative_eq!(height_m, expected_m, epsilon = 1e-6);
        }
    }
}
