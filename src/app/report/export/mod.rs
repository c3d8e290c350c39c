//! Maps and runs in the formats of other programs: models and logs for viewers, tiles for Autoware.

mod glb;
mod log;
pub mod tiles;

pub use glb::{Model, Ribbon};
pub use log::{RunLog, write_mcap};
