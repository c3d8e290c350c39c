//! A run of a command: what it was called with, its progress, log, interruption and outputs.

pub mod arguments;
pub mod artefact;
mod context;
pub mod failure;
pub mod input;
pub mod interrupt;
pub mod logging;
pub mod machine;
pub mod output;
pub mod progress;
mod remedy;
pub mod version;

pub use context::Context;
