//! Places where a car may be, and what a sensor sees there.

pub mod cells;
pub(crate) mod descriptor;
pub mod panorama;
pub(crate) mod panorama_file;
mod scan_panorama;
