//! What the filter says about a frame.

use nalgebra::Matrix3;

use super::particles::ParticleSet;
use super::vigilance::State;
use crate::geometry::{Pose2, Pose3};

/// The estimate of a frame, and how far it can be believed.
#[derive(Clone, Debug)]
pub struct FrameEstimate {
    /// Weighted mean of the particles, `p_map = pose * p_lidar` seen from above.
    pub pose: Pose2,
    /// The same pose standing on the map's ground, `p_map = lifted * p_lidar`.
    pub lifted: Pose3,
    /// Height of the ground below it; `None` where there never was any [m].
    pub level_m: Option<f64>,
    /// Covariance of (x, y, heading) in the axes of the map [m², m·rad, rad²].
    pub covariance: Matrix3<f64>,
    /// Effective number of particles after weighing, before resampling.
    pub effective_sample_size: f64,
    /// Weighted mean of the particles' cost; `None` where the frame was not weighed or no
    /// particle was on the map [m].
    pub mean_cost_m: Option<f64>,
    /// Share of beams above the road that meet the map at the estimate; `None` where unknown.
    pub agreement: Option<f64>,
    /// Searching, tracking or lost.
    pub state: State,
    /// Whether the scan was weighed; not so before the car moved far enough.
    pub updated: bool,
    /// Whether there is mapped ground under the estimate; if not, it stands on the last ground
    /// that there was.
    pub on_mapped_ground: bool,
    /// The particles with their weights, before resampling.
    pub particles: ParticleSet,
}
