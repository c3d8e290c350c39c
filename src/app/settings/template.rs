//! What the configurations of several commands have in common: built-in texts, and the keys that
//! select frames.

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::build_map::BuildMapConfig;
use super::comparison::ComparisonConfig;
use super::evaluation::EvaluationConfig;
use super::ground::GroundCommandConfig;
use super::localization::LocalizationConfig;
use super::odometry_command::OdometryCommandConfig;
use super::refinement::RefinementConfig;
use crate::recording::Selection;
use crate::simulation::SimulationConfig;
use crate::validation::Validate;

/// The configuration of a command, with the texts that `fpmcl config` prints.
pub trait CommandConfig: Validate + Default + Serialize + DeserializeOwned {
    /// Path of the file that is used if it exists and no other is given.
    const PATH: &'static str;
    /// The keys that people change; the configuration where there is no file.
    const SHORT: &'static str;
    /// Every key with its default and a comment.
    const FULL: &'static str;
}

/// Implements [`CommandConfig`] from the name of the file; `short` has one text for both.
macro_rules! command_config {
    ($config:ty, $name:literal, short) => {
        command_config!(@ $config, $name, Self::SHORT);
    };
    ($config:ty, $name:literal) => {
        command_config!(@ $config, $name, include_str!(concat!("full/", $name, ".yml")));
    };
    (@ $config:ty, $name:literal, $full:expr) => {
        impl CommandConfig for $config {
            const PATH: &'static str = concat!("config/", $name, ".yml");
            const SHORT: &'static str = include_str!(concat!("../../../config/", $name, ".yml"));
            const FULL: &'static str = $full;
        }
    };
}

command_config!(BuildMapConfig, "build_map");
command_config!(OdometryCommandConfig, "odometry");
command_config!(LocalizationConfig, "localization");
command_config!(RefinementConfig, "refinement");
command_config!(EvaluationConfig, "evaluation", short);
command_config!(GroundCommandConfig, "ground");
command_config!(SimulationConfig, "simulation");
command_config!(ComparisonConfig, "comparison", short);

/// Adds the frames that the keys `start_idx`, `n_scans` and `frame_step` select.
macro_rules! selection {
    ($($config:ty),*) => {
        $(impl $config {
            /// Selection of the frames.
            pub fn selection(&self) -> Selection {
                Selection {
                    start_idx: self.start_idx,
                    n_scans: self.n_scans,
                    frame_step: self.frame_step,
                }
            }
        })*
    };
}

selection!(
    BuildMapConfig,
    OdometryCommandConfig,
    LocalizationConfig,
    RefinementConfig,
    EvaluationConfig,
    GroundCommandConfig
);
