//! Objective of the refinement: the range difference between a scan and the map at a pose.
//!
//! ```text
//! f(x, y, θ) = mean over the beams of cost(measured, rendered from lift(x, y, θ))      [m]
//! Σ ≈ s · H⁻¹        H: second differences of f;  s: the scale of exp(−f / s)
//! ```
//!
//! The pose is aligned to the ground of the map, as in localization: x, y and heading are free.

use nalgebra::{Matrix3, SymmetricEigen, Vector2, Vector3};

use crate::geometry::{Pose2, Pose3, Vec3};
use crate::lidar::Beam;
use crate::localization::observation::costs;
use crate::map::{GroundMap, GroundPatch, SensorAttitude};
use crate::rendering::{RangeDifference, RangeRenderer, RenderError};

/// The objective of one frame.
#[derive(Clone, Copy)]
pub struct FrameObjective<'a> {
    /// Renders the map.
    pub renderer: &'a dyn RangeRenderer,
    /// Ground of the map.
    pub ground: &'a GroundMap,
    /// The beams of the frame whose ranges are compared, lidar frame.
    pub beams: &'a [Beam],
    /// The beams of the frame that the last Gauss-Newton registers.
    pub registered: &'a [Beam],
    /// Approximate height of the ground [m], which selects among several levels; `None` selects the
    /// lowest.
    pub level_m: Option<f64>,
    /// Attitude of the sensor above the ground.
    pub attitude: SensorAttitude,
    /// Cost of a difference.
    pub difference: RangeDifference,
}

impl FrameObjective<'_> {
    /// Aligns a pose to the ground; `remembered` replaces it where the map has none.
    pub fn lift(
        &self,
        pose: &Pose2,
        remembered: Option<&GroundPatch>,
    ) -> Result<Option<Pose3>, RenderError> {
        let patch = self.ground.patch_under(pose, self.level_m)?;
        let patch = patch.as_ref().or(remembered);
        Ok(patch.map(|patch| patch.lift(pose, &self.attitude)))
    }

    /// The ground under a pose, or the nearest part of it within a distance [m].
    pub fn patch_within(
        &self,
        pose: &Pose2,
        distance_m: f64,
    ) -> Result<Option<GroundPatch>, RenderError> {
        let mut patch = self.ground.patch_under(pose, self.level_m)?;
        let t = pose.translation.vector;
        for radius_m in [4.0, 8.0] {
            if patch.is_none() && radius_m <= distance_m + 2.0 {
                patch = self.ground.patch_at(t.x, t.y, radius_m, self.level_m)?;
            }
        }
        Ok(patch)
    }

    /// Returns the objective with the attitude fitted at a pose, so that the beams on the road end on the
    /// mapped ground; unchanged where too few of them do.
    pub fn with_fitted_attitude(&self, pose: &Pose2) -> Result<Self, RenderError> {
        let points: Vec<Vec3> = self.beams.iter().map(Beam::point).collect();
        let attitude = self
            .ground
            .attitude_at(pose, self.level_m, &self.attitude, &points)?;
        Ok(Self {
            attitude: attitude.unwrap_or(self.attitude),
            ..*self
        })
    }

    /// Returns the objective on the level of the ground where it is smallest at a pose, for an unknown
    /// level.
    pub fn on_best_level(&self, pose: &Pose2) -> Result<Self, RenderError> {
        let place = pose.translation.vector;
        let levels = self.ground.levels_at(place.x, place.y)?;
        let mut best = (f64::INFINITY, *self);
        for patch in &levels {
            let level_m = Some(patch.height_m);
            let on_level = Self { level_m, ..*self };
            if levels.len() == 1 {
                return Ok(on_level);
            }
            let fitted = on_level.with_fitted_attitude(pose)?;
            let lifted = patch.lift(pose, &fitted.attitude);
            let cost_m = self.costs_in_space(&[lifted])?[0];
            if cost_m < best.0 {
                best = (cost_m, on_level);
            }
        }
        Ok(best.1)
    }

    /// Returns the mean cost at each pose [m]; infinite where there is no ground.
    pub fn costs(
        &self,
        poses: &[Pose2],
        remembered: Option<&GroundPatch>,
    ) -> Result<Vec<f64>, RenderError> {
        let lifted: Vec<Option<Pose3>> = poses
            .iter()
            .map(|pose| self.lift(pose, remembered))
            .collect::<Result<_, _>>()?;
        let costs = costs(self.renderer, &lifted, self.beams, &self.difference)?;
        Ok(costs
            .into_iter()
            .map(|cost_m| cost_m.unwrap_or(f64::INFINITY))
            .collect())
    }

    /// Returns the mean cost at poses in space [m].
    pub fn costs_in_space(&self, map_from_lidar: &[Pose3]) -> Result<Vec<f64>, RenderError> {
        let costs = self
            .renderer
            .compare(map_from_lidar, self.beams, &self.difference)?;
        Ok(costs.into_iter().map(f64::from).collect())
    }

    /// Returns the covariance of (x, y, heading) in the axes of the map [m², m·rad, rad²] from the
    /// curvature of the objective around a minimum. `scale_m` is the increase of the cost that makes a
    /// pose e times less likely.
    ///
    /// Directions in which the objective is flat get a standard deviation of `MAX_SIGMA` steps, and all
    /// directions do where a pose of the stencil has no ground.
    pub fn covariance(
        &self,
        pose: &Pose2,
        remembered: Option<&GroundPatch>,
        scale_m: f64,
    ) -> Result<Matrix3<f64>, RenderError> {
        /// Standard deviation of an undetermined direction, in steps.
        const MAX_SIGMA: f64 = 10.0;
        let offsets = stencil();
        let poses: Vec<Pose2> = offsets.iter().map(|offset| shifted(pose, offset)).collect();
        let costs = self.costs(&poses, remembered)?;
        let step = Matrix3::from_diagonal(&STEP);
        let curvature = hessian(&costs) / scale_m;
        if !curvature.iter().all(|entry| entry.is_finite()) {
            return Ok(MAX_SIGMA.powi(2) * step * step);
        }
        let SymmetricEigen {
            eigenvectors,
            eigenvalues,
        } = curvature.symmetric_eigen();
        let variances = eigenvalues.map(|value| 1.0 / value.max(MAX_SIGMA.powi(-2)));
        let covariance =
            eigenvectors * Matrix3::from_diagonal(&variances) * eigenvectors.transpose();
        Ok(step * covariance * step)
    }
}

/// Steps of the second differences: x, y [m], heading [rad]. About the width of the minimum.
const STEP: Vector3<f64> = Vector3::new(0.05, 0.05, 0.005);

/// The offsets of the second differences in steps: the center, both directions of every axis, and both
/// directions of the diagonals of every pair of axes.
fn stencil() -> Vec<Vector3<f64>> {
    let mut offsets = vec![Vector3::zeros()];
    for axis in 0..3 {
        offsets.extend([Vector3::ith(axis, 1.0), Vector3::ith(axis, -1.0)]);
    }
    for (a, b) in [(0, 1), (0, 2), (1, 2)] {
        for (sign_a, sign_b) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
            offsets.push(Vector3::ith(a, sign_a) + Vector3::ith(b, sign_b));
        }
    }
    offsets
}

/// Second differences of the values on the [`stencil`], per step².
fn hessian(values: &[f64]) -> Matrix3<f64> {
    let mut hessian = Matrix3::zeros();
    for axis in 0..3 {
        hessian[(axis, axis)] = values[1 + 2 * axis] + values[2 + 2 * axis] - 2.0 * values[0];
    }
    for (pair, (a, b)) in [(0, 1), (0, 2), (1, 2)].into_iter().enumerate() {
        let corner = |number: usize| values[7 + 4 * pair + number];
        let mixed = 0.25 * (corner(0) - corner(1) - corner(2) + corner(3));
        hessian[(a, b)] = mixed;
        hessian[(b, a)] = mixed;
    }
    hessian
}

/// A pose moved by a number of steps.
fn shifted(pose: &Pose2, steps: &Vector3<f64>) -> Pose2 {
    let offset = STEP.component_mul(steps);
    Pose2::new(
        pose.translation.vector + Vector2::new(offset.x, offset.y),
        pose.rotation.angle() + offset.z,
    )
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::map::gaussian_for_tests::GaussianWorld;
    use crate::map::world_for_tests::TestWorld;

    impl TestWorld {
        /// The objective of a scan from the street.
        pub fn objective<'a>(&'a self, beams: &'a [Beam]) -> FrameObjective<'a> {
            FrameObjective {
                renderer: self,
                ground: &self.ground,
                beams,
                registered: beams,
                level_m: None,
                attitude: SensorAttitude::default(),
                difference: RangeDifference::truncated(0.5),
            }
        }
    }

    #[test]
    fn second_differences_of_a_quadratic_are_its_matrix() {
        let matrix = Matrix3::new(4.0, 0.5, -0.2, 0.5, 2.0, 0.1, -0.2, 0.1, 1.0);
        let values: Vec<f64> = stencil()
            .iter()
            .map(|x| 0.5 * x.dot(&(matrix * x)) + 3.0)
            .collect();
        assert_relative_eq!(hessian(&values), matrix, epsilon = 1e-12);
    }

    #[test]
    fn the_covariance_of_a_gaussian_is_its_own() {
        let world = TestWorld::street();
        let mean = world.pose_at(12.0, 0.1, 0.8);
        let covariance = Matrix3::new(
            25e-4, 9e-4, 4e-5, //
            9e-4, 16e-4, 2e-5, //
            4e-5, 2e-5, 16e-6,
        );
        let renderer = GaussianWorld {
            mean,
            information: covariance.try_inverse().unwrap(),
            scale_m: 0.002,
        };
        let objective = FrameObjective {
            renderer: &renderer,
            ..world.objective(&[])
        };
        let found = objective.covariance(&mean, None, 0.002).unwrap();
        assert_relative_eq!(found, covariance, max_relative = 1e-3);
    }

    #[test]
    fn the_covariance_is_symmetric_and_grows_with_the_scale() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.1, 0.05);
        let image = world.scan(&truth);
        let beams: Vec<Beam> = image.beams().collect();
        let objective = world.objective(&beams);
        let one = objective.covariance(&truth, None, 0.002).unwrap();
        let two = objective.covariance(&truth, None, 0.004).unwrap();
        assert_relative_eq!(one, one.transpose(), epsilon = 1e-15);
        assert_relative_eq!(2.0 * one, two, max_relative = 1e-6);
        assert!(one.cholesky().is_some());
        assert!(
            one[(0, 0)].sqrt() < 0.05 && one[(2, 2)].sqrt() < 0.01,
            "{one}"
        );
    }

    #[test]
    fn where_there_is_no_ground_the_cost_is_infinite_unless_ground_is_remembered() {
        let world = TestWorld::street();
        let image = world.scan(&world.pose_at(0.0, 0.0, 0.0));
        let beams: Vec<Beam> = image.beams().collect();
        let objective = world.objective(&beams);
        let off = [Pose2::translation(5e3, 0.0), world.pose_at(0.0, 0.0, 0.0)];
        let costs = objective.costs(&off, None).unwrap();
        assert_eq!(costs[0], f64::INFINITY);
        assert!(costs[1] < 1e-3);
        // The covariance is large where the costs of the poses around it are unknown.
        let unknown = objective.covariance(&off[0], None, 0.002).unwrap();
        assert!(unknown.iter().all(|entry| entry.is_finite()) && unknown[(0, 0)] > 0.1);
        let patch = world.ground.patch_under(&off[1], None).unwrap();
        assert!(objective.costs(&off, patch.as_ref()).unwrap()[0].is_finite());
    }
}
