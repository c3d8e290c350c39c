//! Refinement of a trajectory: a particle swarm and Gauss-Newton per frame, then smoothing.
//!
//! > [`TrajectoryRefiner`] takes the frames of a `trajectory`; `refiner` searches a better pose of
//! > each with a `swarm` that minimizes the `objective`, and finishes with Gauss-Newton
//! > ([`registration`](crate::registration)); from metres away a `wide_search` over `upright` surfaces comes
//! > first; `smoothing` combines all frames with the odometry.
//!
//! No step makes an estimate worse by its own measure: what does not lower the cost is rejected.

pub(crate) mod objective;
pub(crate) mod refiner;
pub(crate) mod smoothing;
pub(crate) mod swarm;
pub(crate) mod trajectory;
pub(crate) mod upright;
pub(crate) mod wide_search;

pub use refiner::{FrameRefinementConfig, Method};
pub use smoothing::SmoothingConfig;
pub use swarm::SwarmConfig;
pub use trajectory::{
    FrameChange, FrameResult, InitialEstimate, RefinedTrajectory, RefinerConfig, RefinerError,
    TrajectoryRefiner,
};
pub use wide_search::WideSearchConfig;
