//! Accuracy of estimated trajectories and of maps.
//!
//! [`metrics`] computes the errors of the literature, [`range_mcl`] those of range-mcl's
//! evaluation script. Everything here works on values; files are read and written elsewhere.

pub mod alignment;
pub mod convergence;
pub mod drift;
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
pub mod trust;

pub use alignment::{Alignment, aligned, rigid_alignment};
pub use convergence::{Convergence, StrictSuccess};
pub use drift::{DriftPoint, drift};
pub use ground_score::{
    GroundMethodReport, GroundProtocol, GroundScore, GroundScores, GroundTally, LabelledPoints,
};
pub use map_quality::MapQuality;
pub use map_truth::TruthAgreement;
pub use metrics::{EvaluatedTrajectory, MetricsConfig, MetricsError, TrajectoryMetrics};
pub use planar::{PlanarError, distances_m, planar_errors};
pub use pose_error::{
    KITTI_FRAME_STEP, KITTI_LENGTHS_M, Pairs, SHORT_LENGTHS_M, Segment, SegmentErrors,
    absolute_pose_error, kitti_segment_errors, relative_pose_error, segments,
};
pub use range_mcl::{ParticleRow, RangeMclErrors, RangeMclRules};
pub use spatial::{LengthErrors, SpatialMetrics};
pub use statistics::Summary;
