//! A renderer by whose costs the likelihood of a pose is a Gaussian, for tests against exact posteriors.

use nalgebra::{Matrix3, Vector3};

use crate::geometry::{Pose2, Pose3, Vec3, pose2_from_pose3, wrap_angle};
use crate::lidar::{Beam, LidarModel, RangeImage};
use crate::rendering::{RangeDifference, RangeRenderer, RenderError};

/// Every scan costs ½ s · eᵀ A e at a pose that is e off the mean, so that exp(−cost / s) is a Gaussian of information A.
pub struct GaussianWorld {
    pub mean: Pose2,
    /// Inverse of the covariance of (x, y, heading) in the axes of the map [1/m², 1/rad²].
    pub information: Matrix3<f64>,
    /// Increase of the cost that makes a pose e times less likely [m].
    pub scale_m: f64,
}

impl GaussianWorld {
    fn cost_m(&self, pose: &Pose3) -> f32 {
        let pose = pose2_from_pose3(pose);
        let [x, y] = (pose.translation.vector - self.mean.translation.vector).into();
        let turn_rad = wrap_angle(pose.rotation.angle() - self.mean.rotation.angle());
        let off = Vector3::new(x, y, turn_rad);
        (0.5 * self.scale_m * off.dot(&(self.information * off))) as f32
    }
}

impl RangeRenderer for GaussianWorld {
    fn name(&self) -> String {
        "Gaussian".into()
    }

    fn render(&self, poses: &[Pose3], model: &LidarModel) -> Result<Vec<Vec<f32>>, RenderError> {
        self.cast(poses, &model.directions(), f32::INFINITY)
    }

    /// There are no surfaces.
    fn cast(
        &self,
        poses: &[Pose3],
        directions: &[Vec3],
        _until_m: f32,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        Ok(vec![vec![f32::INFINITY; directions.len()]; poses.len()])
    }

    fn compare(
        &self,
        poses: &[Pose3],
        _beams: &[Beam],
        _difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        Ok(poses.iter().map(|pose| self.cost_m(pose)).collect())
    }

    fn compare_images(
        &self,
        poses: &[Pose3],
        _measured: &RangeImage,
        _difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        Ok(poses.iter().map(|pose| self.cost_m(pose)).collect())
    }
}
