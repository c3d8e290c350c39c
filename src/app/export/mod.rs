//! Maps and runs in the formats of other programs' viewers.

mod glb;
mod log;

pub use glb::{Model, Ribbon};
pub use log::{RunLog, write_mcap};
