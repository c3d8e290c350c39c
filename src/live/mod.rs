//! Localization while the robot drives: scans that arrive faster than they are understood, states to act on, and what is
//! known between two scans.
//!
//! ```text
//! one thread receives    Inbox     bounded; the oldest waiting scan is dropped for a newer one
//! another one computes   Tracker   an estimate per scan; the motion over dropped scans is that of all of them
//!                        Monitor   state with its reason, map_from_odom while the pose is believed
//!                        Latencies from the arrival of a scan to its pose
//! ```
//!
//! Nothing here grows with time.

mod clock;
mod inbox;
mod latency;
mod monitor;
mod state;

pub use clock::{StampClock, Tick};
pub use inbox::{Arrival, Inbox, Received};
pub use latency::Latencies;
pub use monitor::{LivePose, Monitor, Outage};
pub use state::{LiveState, Reason};
