//! The sensor: projection model, scans, motion compensation, range images and their normals.

pub(crate) mod deskewing;
pub(crate) mod firing_order;
mod lanes;
pub(crate) mod model;
pub(crate) mod normals;
pub(crate) mod projection;
pub(crate) mod range_image;
pub(crate) mod scan;
pub(crate) mod spatial_normals;

pub use deskewing::{Motion, Rotation, RotationDirection};
pub use firing_order::PointTiming;
pub use model::LidarModel;
pub use normals::NormalConfig;
pub use range_image::RangeImage;
pub use scan::{Beam, Scan};

pub(crate) use deskewing::{PERIOD_S, Sweep, interpolate_motion};
pub(crate) use firing_order::FiringOrder;
pub(crate) use normals::estimate_normals;
pub(crate) use projection::Projection;
pub(crate) use scan::{interval_s, is_inside};
pub(crate) use spatial_normals::estimate_spatial_normals;
