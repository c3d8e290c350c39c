//! The sensor: which pixel a direction falls into, scans, the motion during them, range images and
//! their normals.

pub mod compensation;
pub mod model;
pub mod normals;
pub mod range_image;
pub mod scan;

pub use compensation::{Revolution, Spin, share_of};
pub use model::{LidarModel, Pixel};
pub use normals::{NormalConfig, normals};
pub use range_image::{NO_RETURN, RangeImage};
pub use scan::{Beam, Scan};
