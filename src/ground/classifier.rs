//! The interface of every ground classifier.

use glam::Vec3;

/// Segments a scan into ground and everything else.
pub trait GroundClassifier: Send + Sync {
    /// Returns the confidence that each point is ground, 0 to 1, in the order of the points.
    ///
    /// `points` are one revolution, or a subset of it, in the lidar frame [m], z approximately up.
    /// The confidence of a point that is not finite is 0.
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32>;
}
