//! Prediction of frames in which the car hardly moved and whose scan is not used.

use nalgebra::Matrix3;

use super::state::{ParticleFilter, Pending, attitude_above};
use crate::localization::estimate::Estimate;
use crate::localization::motion::{TurnDriveTurn, VelocityCommand, jacobian_of_step};
use crate::localization::odometry::Odometry;
use crate::map::SensorAttitude;
use crate::rendering::RenderError;

impl ParticleFilter {
    /// Moves the last estimate by the motion since the last update.
    pub(super) fn coast(
        &mut self,
        odometry: Odometry,
        attitude: &SensorAttitude,
    ) -> Result<Estimate, RenderError> {
        let mut particles = self.particles.clone();
        let pending = self.pending.unwrap_or_default();
        particles.propagate(|pose| pose * pending.motion);
        let covariance = self.covariance_after(&pending, odometry);
        let pose = if self.compares_places() {
            self.updated.pose * pending.motion
        } else {
            particles.mean()
        };
        let ground = self.ground_at(&pose)?;
        let attitude = attitude_above(&ground, self.predicted, attitude);
        let in_space = self.lift(&pose, &attitude, None)?;
        self.estimate_of(pose, particles, covariance, in_space)
    }

    /// Covariance of the last estimate, propagated by the motion since then [m², m·rad, rad²]:
    ///
    /// ```text
    /// Σ = J Σ_last Jᵀ + s R N Rᵀ        J: Jacobian of the motion by the last pose
    /// ```
    ///
    /// N is the noise of one update, in the axes of the car, and s the share of the motion that triggers an
    /// update: a standing car does not lose certainty.
    pub(super) fn covariance_after(&self, pending: &Pending, odometry: Odometry) -> Matrix3<f64> {
        let config = &self.config;
        let motion = &pending.motion;
        let moved_m = motion.translation.vector.norm();
        let turned_rad = motion.rotation.angle().abs();
        let share = (moved_m / config.move_thres_m).max(turned_rad / config.turn_thres_rad);
        let noise = if let Odometry::Velocity(_) = odometry {
            let command = VelocityCommand::driving(motion, pending.duration);
            config.velocity.covariance(&command)
        } else {
            config.motion.covariance(&TurnDriveTurn::decompose(motion))
        };
        let updated = &self.updated;
        let step = updated.pose.rotation * motion.translation.vector;
        let jacobian = jacobian_of_step(&step);
        let rotation = updated.pose.rotation.to_rotation_matrix().to_homogeneous();
        // With thresholds of zero every motion triggers an update, and none is ever pending.
        let share = if share.is_finite() {
            share.min(1.0)
        } else {
            0.0
        };
        jacobian * updated.covariance * jacobian.transpose()
            + share * rotation * noise * rotation.transpose()
    }
}
