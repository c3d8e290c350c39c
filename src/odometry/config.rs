//! Settings of the odometry and of its loops.

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::validation::{InvalidValue, Validate, at_least_one, in_range, positive};

/// Largest acceleration of a sensor [m/s²]: five times that of gravity, for a sensor in the hand.
pub(crate) const MAX_ACCELERATION_M_PER_S2: f64 = 50.0;

/// Settings of the odometry. Lengths are shares of the sensor's range, which 98 % of the points do not exceed.
///
/// Defaults: our own values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct OdometryConfig {
    /// Edge of a voxel of the local map, as a share of the range (unitless).
    #[default(0.01)]
    pub voxel_share: f64,
    /// Distance between mapped points of a scan, in voxels.
    #[default(0.5)]
    pub map_spacing: f64,
    /// Distance between registered points of a scan, in voxels.
    #[default(2.0)]
    pub registration_spacing: f64,
    /// Radius of the local map, as a share of the range (unitless). Voxels without a new point over a path of ten radii are
    /// removed, too.
    #[default(2.0)]
    pub map_radius_share: f64,
    /// Nearer points are dropped, such as those on the own car, as a share of the range (unitless).
    #[default(0.05)]
    pub min_range_share: f64,
    /// Number of points of a voxel after which older ones are forgotten.
    #[default(50.0)]
    pub voxel_points: f32,
    /// Maximum number of Gauss-Newton iterations.
    #[default(20)]
    pub iterations: usize,
    /// Smallest scale of the robust kernel, in voxels.
    #[default(0.1)]
    pub min_kernel: f64,
    /// Longest motion between two scans that a search finds, as a share of the range (unitless).
    #[default(0.2)]
    pub first_motion_share: f64,
    /// Largest acceleration of the sensor [m/s²]: five times that of gravity, for a sensor in the hand. A motion that deviates
    /// more from the prediction is refused once, and taken where the next scan fits as well.
    #[default(MAX_ACCELERATION_M_PER_S2)]
    pub max_acceleration_m_per_s2: f64,
    /// The same of its turns [deg/s²]: 20 degrees within 0.1 s.
    #[default(2000.0)]
    pub max_turn_acceleration_deg_per_s2: f64,
    /// Smallest share of the points near upright planes that lie on them, of a step that is accepted (unitless): 0.3 by
    /// chance; and half of what is usual beyond that. 0: any.
    #[default(0.4)]
    pub min_common_share: f64,
    /// Smallest share of matched points of a step that is accepted (unitless).
    #[default(0.3)]
    pub min_matched_share: f64,
    /// Largest mean robust cost of a step that is accepted, 0 to 1 (unitless).
    #[default(0.85)]
    pub max_cost: f64,
    /// Largest increase of this cost above the mean of the last steps, 0 to 1 (unitless).
    #[default(0.2)]
    pub max_cost_increase: f64,
    /// Number of scans in turn that do not fit, after which the local map restarts and the motion is unknown.
    #[default(3)]
    pub restart_after: usize,
}

impl Validate for OdometryConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("voxel_share", self.voxel_share, 0.001..=0.2)?;
        in_range("map_spacing", self.map_spacing, 0.1..=10.0)?;
        in_range(
            "registration_spacing",
            self.registration_spacing,
            0.1..=20.0,
        )?;
        in_range("map_radius_share", self.map_radius_share, 0.1..=10.0)?;
        in_range("min_range_share", self.min_range_share, 0.0..=0.5)?;
        in_range("voxel_points", self.voxel_points, 1.0..=1e6)?;
        in_range("iterations", self.iterations, 1..=1000)?;
        in_range("min_kernel", self.min_kernel, 0.001..=10.0)?;
        positive("first_motion_share", self.first_motion_share)?;
        let accelerations = [
            ("max_acceleration_m_per_s2", self.max_acceleration_m_per_s2),
            (
                "max_turn_acceleration_deg_per_s2",
                self.max_turn_acceleration_deg_per_s2,
            ),
        ];
        for (key, acceleration) in accelerations {
            positive(key, acceleration)?;
        }
        in_range("min_common_share", self.min_common_share, 0.0..=1.0)?;
        in_range("min_matched_share", self.min_matched_share, 0.0..=1.0)?;
        in_range("max_cost", self.max_cost, 0.0..=1.0)?;
        in_range("max_cost_increase", self.max_cost_increase, 0.0..=1.0)?;
        at_least_one("restart_after", self.restart_after)
    }
}

/// Which loops count. Lengths are shares of the sensor's range.
///
/// Defaults: our own values; `docs/method.md`, Thresholds, has what half and twice of them change on four sensors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct LoopConfig {
    /// Least path between two visits of a place, as a share of the range (unitless): the local map of the odometry
    /// reaches so far.
    #[default(1.5)]
    pub min_path_share: f64,
    /// Largest distance between two visits in addition to the drift, as a share of the range (unitless).
    #[default(0.3)]
    pub max_distance_share: f64,
    /// Drift of the odometry, as a share of the path (unitless): four times that of odometry from scans in the benchmark of
    /// KITTI, 0.5 % (Vizzo et al., *KISS-ICP*, 2023).
    #[default(0.02)]
    pub drift_share: f64,
    /// Drift that remains after loops are closed for the first time, as a share of the path (unitless): the 0.5 % themselves.
    #[default(0.005)]
    pub remaining_drift_share: f64,
    /// Radius of the surroundings by whose appearance places are recognized, as a share of the range (unitless).
    #[default(0.6)]
    pub context_radius_share: f64,
    /// Least similarity of the appearance of a candidate, 0 to 1: one minus the distance of Scan Context (Kim and Kim,
    /// IROS 2018, eq. 6).
    #[default(0.5)]
    pub min_similarity: f64,
    /// Largest number of candidates by appearance for each submap.
    #[default(2)]
    pub similar_candidates: usize,
    /// Radius around a candidate in which the pose is searched, as a share of the range (unitless).
    #[default(0.2)]
    pub search_radius_share: f64,
    /// Radius in which the surfaces of two visits are compared, as a share of the range (unitless).
    #[default(0.4)]
    pub compared_radius_share: f64,
    /// Largest distance of a point from a surface of the other visit that it shares, in voxels of the odometry.
    #[default(0.25)]
    pub surface_tolerance: f64,
    /// Least share of common surfaces of two visits, without the ground (unitless), above the 0.3 of the odometry by chance.
    #[default(0.4)]
    pub min_common_share: f64,
    /// Longest path between a loop and one that confirms it, in the mean of both visits, as a share of the range
    /// (unitless).
    #[default(3.0)]
    pub max_confirmation_share: f64,
    /// Least weight of an accepted loop in the pose graph, 0 to 1: others contradict the odometry and the other loops. Of right
    /// loops, with errors that are normal in six dimensions, one in a hundred million has less than 0.1.
    #[default(0.1)]
    pub min_weight: f64,
}

impl Validate for LoopConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("min_path_share", self.min_path_share, 0.0..=1000.0)?;
        in_range("max_distance_share", self.max_distance_share, 0.0..=10.0)?;
        in_range("drift_share", self.drift_share, 0.0..=1.0)?;
        in_range(
            "remaining_drift_share",
            self.remaining_drift_share,
            0.0..=1.0,
        )?;
        in_range(
            "context_radius_share",
            self.context_radius_share,
            0.01..=10.0,
        )?;
        in_range("min_similarity", self.min_similarity, 0.0..=1.0)?;
        in_range("similar_candidates", self.similar_candidates, 0..=1000)?;
        in_range("search_radius_share", self.search_radius_share, 0.001..=2.0)?;
        in_range(
            "compared_radius_share",
            self.compared_radius_share,
            0.01..=10.0,
        )?;
        in_range("surface_tolerance", self.surface_tolerance, 0.001..=10.0)?;
        in_range("min_common_share", self.min_common_share, 0.0..=1.0)?;
        in_range(
            "max_confirmation_share",
            self.max_confirmation_share,
            0.0..=1000.0,
        )?;
        in_range("min_weight", self.min_weight, 0.0..=1.0)
    }
}
