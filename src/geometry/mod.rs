//! Poses, angles, grids, point clouds, planes and meshes.
//!
//! Poses are `f64` (nalgebra), points and directions are `f32` (glam): at five kilometers from the
//! origin `f32` resolves half a millimeter, and half the memory is twice the speed. Names of
//! transforms contain both frames, `p_map = map_from_lidar * p_lidar`.

pub mod angle;
pub mod cloud;
pub mod degeneracy;
pub mod grid;
pub mod kd_tree;
pub mod mesh;
pub mod morton;
pub mod plane;
pub mod ply_vertex;
pub mod pose;
pub mod robust_kernel;
pub mod surface_samples;
pub mod trajectory;

pub use angle::{azimuth_sector, circular_mean, fast_atan2, wrap_angle};
pub use cloud::PointCloud;
pub use degeneracy::Degeneracy;
pub use grid::Grid2;
pub use kd_tree::KdTree;
pub use mesh::{Aabb, TriangleMesh};
pub use plane::{PlaneFit, PlaneSums};
pub use ply_vertex::PlyVertex;
pub use pose::{FARTHEST_M, Pose2, Pose3, Rigid3f, pose2_from_pose3, pose3_from_pose2, yaw};
pub use robust_kernel::RobustKernel;
pub use surface_samples::{sample_surface, surface_area_m2};
pub use trajectory::StampedPose;

pub use glam::Vec3;
