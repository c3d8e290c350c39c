//! Configuration of the commands: one struct per command, composed of the stages' own.
//!
//! ```text
//! defaults  <-  YAML file  <-  --set key=value, in order  ->  validation  ->  effective configuration
//! ```
//!
//! The keys are those of range-mcl's files, which load unchanged, and new ones. Nothing is ignored:
//! an unknown key, a value of the wrong type and a contradiction are errors that name the file and
//! the line, or the `--set`.

// One file per command.
mod build_map;
mod comparison;
mod evaluation;
mod ground;
mod localization;
mod odometry_command;
mod refinement;
// What they share.
mod check;
mod odometry;
mod recording;
// From text to configuration and back.
mod error;
mod load;
mod template;
mod yaml;

pub use build_map::BuildMapConfig;
pub use comparison::{
    ComparisonConfig, Contrast, Overrides, ParticleSweep, SequenceConfig, StageOverrides,
    VariantConfig, settings,
};
pub use error::ConfigError;
pub use evaluation::EvaluationConfig;
pub use ground::GroundCommandConfig;
pub use load::{has_key, load, with_settings};
pub use localization::{Initialization, LocalizationConfig, MotionModel};
pub use odometry::OdometrySource;
pub use odometry_command::OdometryCommandConfig;
pub use recording::body_from_lidar;
pub use refinement::RefinementConfig;
pub use template::CommandConfig;
pub use yaml::to_yaml;
