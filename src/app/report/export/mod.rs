//! Maps and runs in the formats of other programs: models and logs for viewers, tiles for Autoware.

// Messages of a finished run and of one that goes on, to files and viewers.
mod live_log;
mod log;
mod messages;
mod sinks;
#[cfg(feature = "viewer")]
mod viewer;
// Models and tiles.
mod glb;
pub mod tiles;

pub use glb::{Model, Ribbon};
#[cfg(feature = "viewer")]
pub use live_log::live_topics;
pub use live_log::{LiveFrame, LiveLog, live_log};
pub use log::{MOST_POINTS, RunLog, write_mcap};
pub use sinks::{McapFile, Sinks, unfinished_log};
#[cfg(feature = "viewer")]
pub use viewer::Viewer;
