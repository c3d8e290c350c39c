//! Configuration of the commands, apart from `simulate` and `compare`, whose configurations are with what they configure: one
//! struct per command, composed of those of the library and of blocks that commands share.
//!
//! ```text
//! defaults  <-  YAML file  <-  --set key=value and flags, in order  ->  validation  ->  effective configuration
//! ```
//!
//! [`configuration`](crate::configuration) reads and writes them, and knows range-mcl's names of the keys.

// One file per command.
mod build_map;
mod evaluation;
mod ground;
mod localization;
mod odometry;
mod refinement;
// Blocks of several commands.
mod blocks;
// From files to configurations.
mod load;
#[cfg(test)]
mod tests;

pub use blocks::{
    GnssInputConfig, InertialConfig, MapInputConfig, MotionSourceConfig, NPZ, OdometrySource,
    OutputConfig, PoseInputConfig, RecordingConfig, is_result, require_path,
};
pub use build_map::BuildMapConfig;
pub use evaluation::EvaluationConfig;
pub use ground::GroundCommandConfig;
pub use load::CommandConfig;
pub(crate) use load::{command_configs, full_text, load, with_settings};
pub use localization::{Initialization, LocalizationConfig, MotionModel};
pub use odometry::OdometryCommandConfig;
pub use refinement::RefinementConfig;

pub use crate::configuration::{ConfigError, has_key, to_yaml};
