//! Poses, angles, points and meshes: the words that every other module speaks.
//!
//! Poses are `f64` (nalgebra), points and directions are `f32` (glam): a map of five
//! kilometres keeps half a millimetre in `f32`, and half the memory is twice the speed.
//! A transform says both its frames, `p_map = map_from_lidar * p_lidar`.

pub mod angle;
pub mod cloud;
pub mod grid;
pub mod mesh;
pub mod plane;
pub mod pose;
pub mod trajectory;

pub use angle::{circular_mean, wrap_angle};
pub use cloud::PointCloud;
pub use grid::Grid2;
pub use mesh::{Aabb, TriangleMesh};
pub use plane::{PlaneFit, PlaneSums};
pub use pose::{Pose2, Pose3, Rigid3f, planar, spatial, yaw};
pub use trajectory::{StampedPose, Trajectory};

pub use glam::Vec3;
