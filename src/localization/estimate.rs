//! Result of the filter for a frame.

use nalgebra::Matrix3;

use super::distortion::Distortion;
use super::particles::ParticleSet;
use super::tracking_loss::State;
use crate::geometry::{Pose2, Pose3};
use crate::lidar::Motion;
use crate::map::SensorAttitude;

/// Estimated pose of a frame, with its uncertainty and the state of the filter.
#[derive(Clone, Debug)]
pub struct Estimate {
    /// Weighted mean of the particles, `p_map = pose * p_lidar` seen from above.
    pub pose: Pose2,
    /// The same pose in space, `p_map = map_from_lidar * p_lidar`: height, roll and pitch are those of the registration, else those
    /// above the ground of the map.
    pub map_from_lidar: Pose3,
    /// Attitude of the sensor above that ground.
    pub attitude: SensorAttitude,
    /// Height of the ground below it [m]; `None` before any ground was known.
    pub level_m: Option<f64>,
    /// Covariance of (x, y, heading) in the axes of the map [m², m·rad, rad²].
    pub covariance: Matrix3<f64>,
    /// Effective sample size after the update, before resampling (unitless).
    pub effective_sample_size: f64,
    /// Mean cost at the estimate while tracking, else weighted mean of the costs of the particles [m]; `None` where the scan
    /// was not used or no particle was on the map.
    pub mean_cost_m: Option<f64>,
    /// Share of beams above the road that agree with the map at the estimate; `None` where unknown.
    pub agreement: Option<f64>,
    /// Number of places where the car may be: 1 while the search does not compare several.
    pub places: usize,
    /// Searching, tracking or lost.
    pub state: State,
    /// What is wrong with the points of the scans, where they fit the map only without it: no estimate is to be used.
    pub distortion: Option<Distortion>,
    /// Whether the scan was used; it is not while the car moved too little.
    pub updated: bool,
    /// Whether there is mapped ground under the estimate; otherwise the last known ground is used.
    pub on_mapped_ground: bool,
    /// Motion of the sensor around the frame; `None` while unknown.
    pub motion: Option<Motion>,
    /// The particles with their weights, before resampling.
    pub particles: ParticleSet,
}

impl Estimate {
    /// Standard deviations of x [m], y [m] and heading [rad].
    pub fn standard_deviations(&self) -> [f64; 3] {
        std::array::from_fn(|axis| self.covariance[(axis, axis)].max(0.0).sqrt())
    }
}
