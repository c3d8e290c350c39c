//! From scans with poses, or a point cloud, to the mesh of a map.
//!
//! > [`plan`] divides the drive into local maps, [`path_check`] and [`scan_agreement`] refuse poses that cannot be,
//! > [`scan_cloud`] prepares each scan, [`visibility`] finds moving points and surfaces that beams pass through,
//! > [`local_map`] meshes and cuts what belongs to it, [`changes`] compares with an older map. [`builder`] does all
//! > of it.

pub(crate) mod builder;
pub(crate) mod changes;
pub(crate) mod config;
pub(crate) mod local_map;
pub(crate) mod path_check;
pub(crate) mod plan;
pub(crate) mod scan_agreement;
pub(crate) mod scan_cloud;
mod seam;
pub(crate) mod vertex_ground;
pub(crate) mod visibility;
// Point clouds from elsewhere.
pub(crate) mod cloud;
mod cloud_normals;

#[cfg(test)]
mod seam_tests;
