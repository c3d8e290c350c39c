//! Prediction of frames in which the car hardly moved and whose scan is not used.

use nalgebra::Matrix3;

use super::super::estimate::Estimate;
use super::super::motion::{TurnDriveTurn, VelocityCommand};
use super::super::odometry::Odometry;
use super::ParticleFilter;
use crate::map::SensorAttitude;

impl ParticleFilter {
    /// Moves the last estimate by the motion since the last update.
    pub(super) fn coast(&mut self, odometry: Odometry, attitude: &SensorAttitude) -> Estimate {
        let mut particles = self.particles.clone();
        particles.propagate(|pose| pose * self.pending);
        let pose = particles.mean();
        let covariance = self.covariance_after_pending(odometry);
        Estimate {
            pose,
            map_from_lidar: self.lift_estimate(&pose, attitude).0,
            attitude: *attitude,
            level_m: self.patch.map(|patch| patch.height_m),
            covariance,
            effective_sample_size: particles.effective_sample_size(),
            mean_cost_m: None,
            agreement: None,
            state: self.state,
            updated: false,
            on_mapped_ground: self.patch_at(&pose).is_some(),
            particles,
        }
    }

    /// Covariance of the last estimate, propagated by the motion since then [m², m·rad, rad²]:
    ///
    /// ```text
    /// Σ = J Σ_last Jᵀ + s R N Rᵀ        J: Jacobian of the motion by the last pose
    /// ```
    ///
    /// N is the noise of one update, in the axes of the car, and s the share of the motion that triggers an
    /// update: a standing car does not lose certainty.
    fn covariance_after_pending(&self, odometry: Odometry) -> Matrix3<f64> {
        let config = &self.config;
        let moved_m = self.pending.translation.vector.norm();
        let turned_rad = self.pending.rotation.angle().abs();
        let share = (moved_m / config.move_thres_m).max(turned_rad / config.turn_thres_rad);
        let noise = if let Odometry::Velocity(_) = odometry {
            let held = VelocityCommand::driving(&self.pending, self.pending_duration);
            config.velocity.covariance(&held)
        } else {
            let motion = TurnDriveTurn::decompose(&self.pending);
            config.motion.covariance(&motion)
        };
        let turn = self.estimate.rotation;
        let step = turn * self.pending.translation.vector;
        let carried = Matrix3::new(1.0, 0.0, -step.y, 0.0, 1.0, step.x, 0.0, 0.0, 1.0);
        let mut rotation = Matrix3::identity();
        rotation
            .fixed_view_mut::<2, 2>(0, 0)
            .copy_from(turn.to_rotation_matrix().matrix());
        // With thresholds of zero every motion triggers an update, and none is ever pending.
        let share = if share.is_finite() {
            share.min(1.0)
        } else {
            0.0
        };
        carried * self.covariance * carried.transpose()
            + share * rotation * noise * rotation.transpose()
    }
}
