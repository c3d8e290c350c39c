//! From scans with poses, or a point cloud, to the mesh of a map.
//!
//! > [`plan`] divides the drive into local maps, [`path_check`] and [`scan_agreement`] refuse poses that cannot be,
//! > [`scan_cloud`] prepares each scan, [`visibility`] finds moving points and surfaces that beams pass through,
//! > [`local_map`] meshes and cuts what belongs to it, [`changes`] compares with an older map. [`builder`] does all
//! > of it.

pub mod builder;
pub mod changes;
pub mod confidence;
pub mod config;
pub mod local_map;
pub mod path_check;
pub mod plan;
pub mod scan_agreement;
pub mod scan_cloud;
mod seam;
pub(crate) mod vertex_ground;
pub mod visibility;
// Point clouds from elsewhere.
pub mod cloud;
mod cloud_normals;

#[cfg(test)]
mod seam_tests;
