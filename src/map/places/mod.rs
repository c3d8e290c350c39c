//! Places where a car may be, and what a sensor sees there.

pub(crate) mod cells;
pub(crate) mod descriptor;
pub(crate) mod panorama;
pub(crate) mod panorama_file;
mod scan_panorama;
