//! The sensor: projection model, scans, motion compensation, range images and their normals.

pub mod deskewing;
mod lanes;
pub mod model;
pub mod normals;
pub mod projection;
pub mod range_image;
pub mod scan;
pub mod spatial_normals;

pub use deskewing::{Motion, PERIOD_S, Rotation, RotationDirection, Sweep, interpolate_motion};
pub use model::LidarModel;
pub use normals::{NormalConfig, estimate_normals};
pub use projection::Projection;
pub use range_image::{NO_RETURN, RangeImage};
pub use scan::{Beam, Scan, interval_s};
pub use spatial_normals::estimate_spatial_normals;
