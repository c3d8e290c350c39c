//! LiDAR odometry: poses of scans from the scans themselves, in six degrees of freedom.
//!
//! Each scan is registered to a local map of the scans before it. The pose of the scan determines the motion since
//! the previous one, and this motion compensates the scan: a point measured at a time t after the moment of
//! the pose is
//!
//! ```text
//! q(t)   = odom_from_lidar · exp(t / T · log(previous_from_current)) · p        T: time between the scans
//! Σ wᵢ (nᵢ · (qᵢ − sᵢ))² + ‖log(predicted⁻¹ · odom_from_lidar)‖²_P  → min       surface s with normal n
//! ```
//!
//! by Gauss-Newton on SE(3). Surfaces are principal components of the mapped points around q, at the finest scale
//! at which they are a plane. The prediction is constant velocity. Where scans have a calibrated gyroscope, it has measured the
//! rotation of the prediction, and that within the sweep: the rotation of q(t). Lengths are shares of the sensor's range.
//!
//! [`TrajectoryBuilder`] does this for a whole drive and keeps a sample of each scan:
//!
//! ```text
//! Odometer      pose of each scan, scan by scan
//! level         with an inertial sensor: tilt from gravity, and the height that follows
//! loops         submaps of the path, recognized by position and appearance, registered, confirmed by a second loop
//! pose_graph    poses of the submaps, with a robust kernel for loops; the scans between move along
//! gnss          fixes of a receiver, where there are some, as further edges of the graph
//! adjustment    all poses and the planes that the scans have in common
//! ```
//!
//! Vizzo et al., *KISS-ICP* (RA-L 2023), for the adaptive kernel; Lee et al., *GenZ-ICP* (RA-L 2025), for planar
//! and other points blended by their share; Dellenbach et al., *CT-ICP* (ICRA 2022), for compensation by the
//! motion that is estimated; Magnusson, *The Three-Dimensional Normal-Distributions Transform* (2009), for
//! distributions of points in voxels; Blanco-Claraco, *MOLA* (2025), for scales relative to the range.

mod adjustment;
mod alignment;
mod anchors;
mod block_system;
mod config;
mod drive;
mod elevation_bias;
mod gnss;
mod imu_calibrator;
mod level;
mod loops;
mod odometer;
mod path_graph;
mod planes;
mod pose_check;
mod pose_graph;
mod residuals;
mod sampling;
mod scan_context;
mod search;
mod state;
pub(crate) mod timing;
mod trajectory;
mod voxel_map;

pub use adjustment::{Adjusted, AdjustmentConfig};
pub use anchors::{NotInMap, PlacementError};
pub use config::{LoopConfig, OdometryConfig};
pub use elevation_bias::ElevationBias;
pub use gnss::GnssConstraints;
pub use imu_calibrator::ImuCalibrator;
pub use loops::{Loop, LoopVerdict};
pub use odometer::{Odometer, OdometryError, OdometryEstimate, StepState};
pub use pose_check::{MotionDifference, PoseCheck, PoseFit, PoseMeaning};
pub use timing::TimingError;
pub use trajectory::{InertialEstimate, Trajectory, TrajectoryBuilder, TrajectoryConfig};

pub(crate) use config::MAX_ACCELERATION_M_PER_S2;
pub(crate) use pose_check::{GivenPoses, check_poses};
pub(crate) use timing::{TimingComparison, compare_timings, fits_best};

#[cfg(test)]
mod gyroscope_tests;
#[cfg(test)]
mod tests;
