//! Accuracy of estimated trajectories and of maps.
//!
//! [`metrics`] computes the errors of the literature, [`range_mcl`] those of range-mcl's
//! evaluation script. Everything here works on values; files are read and written elsewhere.

pub mod convergence;
mod ground_score;
pub mod map_quality;
pub mod map_truth;
pub mod metrics;
pub mod planar;
pub mod pose_error;
pub mod range_mcl;
pub mod smoothness;
pub mod spatial;
pub mod statistics;
mod surface_distance;

pub use convergence::{Convergence, StrictSuccess};
pub use ground_score::{
    GroundMethodReport, GroundProtocol, GroundScore, GroundScores, GroundTally, LabelledPoints,
};
pub use map_quality::MapQuality;
pub use map_truth::TruthAgreement;
pub use metrics::{EvaluatedTrajectory, MetricsConfig, MetricsError, TrajectoryMetrics};
pub use planar::{PlanarError, distances_m, planar_errors};
pub use pose_error::{Pairs, absolute_pose_error, kitti_segment_errors, relative_pose_error};
pub use range_mcl::{ParticleRow, RangeMclErrors, RangeMclRules};
pub use spatial::SpatialMetrics;
pub use statistics::Summary;
