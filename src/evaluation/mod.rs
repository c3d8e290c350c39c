//! Accuracy of estimated trajectories and of maps.
//!
//! `metrics` computes the errors of the literature, `range_mcl` those of range-mcl's
//! evaluation script. Everything here works on values; files are read and written elsewhere.

pub(crate) mod alignment;
mod consistency;
pub(crate) mod convergence;
pub(crate) mod drift;
mod ground_score;
pub(crate) mod map_quality;
pub(crate) mod map_truth;
pub(crate) mod metrics;
pub(crate) mod planar;
pub(crate) mod pose_error;
pub(crate) mod range_mcl;
pub(crate) mod smoothness;
pub(crate) mod spatial;
pub(crate) mod statistics;
mod surface_distance;
pub(crate) mod trust;

pub use alignment::{Alignment, aligned};
pub use consistency::Consistency;
pub use convergence::{Convergence, StrictSuccess};
pub use ground_score::{GroundProtocol, GroundScore, LabelledPoints};
pub use metrics::{
    AxisError, EvaluatedTrajectory, MetricsConfig, MetricsError, Smoothness, TrajectoryMetrics,
};
pub use planar::PlanarError;
pub use pose_error::{
    PoseErrors, SegmentErrors, absolute_pose_error, kitti_segment_errors, relative_pose_error,
};
pub use spatial::{LengthErrors, SpatialMetrics};
pub use statistics::Summary;

pub(crate) use alignment::rigid_alignment;
pub(crate) use drift::{DriftPoint, drift};
pub(crate) use ground_score::{GroundMethodReport, GroundTally};
pub(crate) use map_quality::MapQuality;
pub(crate) use map_truth::TruthAgreement;
pub(crate) use planar::planar_errors;
pub(crate) use range_mcl::{ParticleRow, RangeMclErrors, RangeMclRules};
