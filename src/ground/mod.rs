//! Which points are road: a confidence between 0 and 1 per point.

use glam::Vec3;

/// Tells ground from the rest.
pub trait GroundClassifier: Send + Sync {
    /// The confidence, 0 to 1, that each point is ground, in the order of the points.
    ///
    /// `points` are one revolution (or what is left of it) in the lidar frame [m], z about up.
    /// Points that are not finite have confidence 0.
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32>;
}
