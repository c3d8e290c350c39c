//! Frames in which the car hardly moved: not weighed, but carried along.

use nalgebra::Matrix3;

use super::super::estimate::FrameEstimate;
use super::super::motion::{TurnDriveTurn, VelocityCommand};
use super::super::odometry::Odometry;
use super::Localizer;
use crate::map::Stance;

impl Localizer<'_> {
    /// A frame in which the car hardly moved: the last estimate, carried along.
    pub(super) fn coast(&mut self, odometry: Odometry, stance: &Stance) -> FrameEstimate {
        let mut particles = self.particles.clone();
        particles.propagate(|pose| pose * self.pending);
        let pose = particles.mean();
        let covariance = self.covariance_after_pending(odometry);
        FrameEstimate {
            pose,
            lifted: self.lift_estimate(&pose, stance).0,
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

    /// Covariance of the last estimate carried along by the motion since then [m², m·rad, rad²]:
    ///
    /// ```text
    /// Σ = J Σ_last Jᵀ + s R N Rᵀ        J: how turns of the last pose move this one
    /// ```
    ///
    /// N is the noise of one update by its source, in the axes of the car, of which a motion that is due for none
    /// yet has made the share s: a car that stands becomes no less sure of where it is.
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
        // Thresholds of zero mean that every motion is weighed: nothing is ever pending.
        let share = if share.is_finite() {
            share.min(1.0)
        } else {
            0.0
        };
        carried * self.covariance * carried.transpose()
            + share * rotation * noise * rotation.transpose()
    }
}
