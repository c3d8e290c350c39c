//! Poses around a prediction with which a scan is consistent.

use rand::Rng;
use rayon::prelude::*;

use super::search::{APART_M, PLACE_BEAMS, within_place};
use super::state::ParticleFilter;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::{Beam, RangeImage};
use crate::localization::observation::{ClassifiedReturns, costs_of_scan};
use crate::localization::places::{best_of_each, is_same};
use crate::localization::proposal::Gaussian;
use crate::map::{GroundPatch, SensorAttitude};
use crate::rendering::RenderError;

impl ParticleFilter {
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
        const BEAMS: usize = 100;
        /// Largest number of poses that are returned.
        const STARTS: usize = 8;
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
        let observation = &self.config.observation;
        let costs_m = costs_of_scan(&*self.map.renderer, &lifted, (scan, &beams), observation)?;
        let best = best_of_each(&poses, &costs_m, STARTS, APART_M);
        Ok(best.into_iter().filter_map(|index| lifted[index]).collect())
    }

    /// The best of the poses to which beams are registered from some starts in a place: those whose costs exceed the least by no more
    /// than the tolerance of places, beginning with the nearest to the centre of the place. None if no registration succeeds.
    pub(super) fn best_registered(
        &self,
        starts: &[Pose3],
        place: &Pose2,
        scan: &RangeImage,
        (registered, compared): (&[Beam], &[Beam]),
    ) -> Result<Vec<Pose3>, RenderError> {
        let step = registered.len().div_ceil(PLACE_BEAMS).max(1);
        let some: Vec<Beam> = registered.iter().step_by(step).copied().collect();
        let register = |start| self.registered_in_place(&some, start, place);
        let found: Result<Vec<_>, RenderError> = starts.par_iter().map(register).collect();
        let found = found?.into_iter().flatten();
        let poses: Vec<_> = found.map(|found| Some(found.map_from_lidar)).collect();
        if let [Some(only)] = poses[..] {
            return Ok(vec![only]);
        }
        let observation = &self.config.observation;
        let costs_m = costs_of_scan(&*self.map.renderer, &poses, (scan, compared), observation)?;
        let least_m = (costs_m.iter().flatten()).fold(f64::INFINITY, |least, m| least.min(*m));
        let most_m = least_m + self.config.places.tolerance_m;
        let away_m = |pose: &Pose3| {
            let shift_m = pose2_from_pose3(pose).translation.vector - place.translation.vector;
            shift_m.norm()
        };
        let both = poses.into_iter().zip(costs_m);
        let fitting = both.filter(|(_, cost_m)| cost_m.is_some_and(|cost_m| cost_m <= most_m));
        let mut poses: Vec<Pose3> = fitting.filter_map(|(pose, _)| pose).collect();
        poses.sort_by(|a, b| away_m(a).total_cmp(&away_m(b)));
        Ok(poses)
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;
    use rand::{SeedableRng, rngs::StdRng};

    use super::*;
    use crate::localization::{LocalizerConfig, ParticleSet};
    use crate::map::world_for_tests::TestWorld;

    #[test]
    fn starts_on_a_slope_are_at_the_height_of_the_sensor_above_it() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.2, 0.05);
        let (scan, attitude) = (world.scan(&truth), SensorAttitude::default());
        let mut rng = StdRng::seed_from_u64(1);
        let particles = ParticleSet::uniform([truth; 100]);
        let config = LocalizerConfig::of_test(100);
        let filter = ParticleFilter::new(config, world.map(), None, particles).unwrap();
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
