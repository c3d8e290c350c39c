//! A run of a command: what it was called with, its progress, log, interruption and outputs.

pub mod arguments;
pub mod artefact;
mod context;
pub mod failure;
pub mod input;
pub mod interrupt;
pub mod logging;
pub mod machine;
pub mod memory;
pub mod output;
pub mod progress;
mod remedy;
pub mod version;
pub mod visible;

pub use arguments::{ConfigArgs, RecordingArgs, RunArgs};
pub use artefact::{CLAIMS_FILE, Claims, Lock, Outputs, PLY};
pub use context::{Context, MachineArgs, gibibytes};
pub use interrupt::{Interrupt, Interrupted};
pub use output::{Form, Printed};
pub use progress::{Progress, Task};
