//! Poses, angles, grids, point clouds, planes and meshes.
//!
//! Poses are `f64` (nalgebra), points and directions are `f32` (glam): at five kilometers from the
//! origin `f32` resolves half a millimeter, and half the memory is twice the speed. Names of
//! transforms contain both frames, `p_map = map_from_lidar * p_lidar`.

pub(crate) mod angle;
pub(crate) mod cloud;
pub(crate) mod degeneracy;
pub(crate) mod grid;
pub(crate) mod kd_tree;
pub(crate) mod mesh;
pub(crate) mod morton;
pub(crate) mod plane;
pub(crate) mod ply_vertex;
pub(crate) mod pose;
pub(crate) mod robust_kernel;
pub(crate) mod surface_samples;
pub(crate) mod trajectory;

pub use cloud::PointCloud;
pub use mesh::{Aabb, TriangleMesh};
pub use pose::{Pose2, Pose3, pose_from_degrees, pose2_from_pose3, pose3_from_pose2};
pub use trajectory::StampedPose;

pub(crate) use angle::{azimuth_sector, circular_mean, fast_atan2, wrap_angle};
pub(crate) use degeneracy::Degeneracy;
pub(crate) use grid::Grid2;
pub(crate) use kd_tree::KdTree;
pub(crate) use plane::{PlaneFit, PlaneSums};
pub(crate) use ply_vertex::PlyVertex;
pub(crate) use pose::{FARTHEST_M, Rigid3f, mirrored_motion, yaw};
pub(crate) use robust_kernel::RobustKernel;
pub(crate) use surface_samples::{sample_surface, surface_area_m2};
pub(crate) use trajectory::distances_m;

pub use glam::Vec3;
