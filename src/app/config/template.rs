//! Built-in texts of the configurations.

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::build_map::BuildMapConfig;
use super::comparison::ComparisonConfig;
use super::evaluation::EvaluationConfig;
use super::ground::GroundCommandConfig;
use super::localization::LocalizationConfig;
use super::refinement::RefinementConfig;
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

impl CommandConfig for BuildMapConfig {
    const PATH: &'static str = "config/build_map.yml";
    const SHORT: &'static str = include_str!("../../../config/build_map.yml");
    const FULL: &'static str = include_str!("full/build_map.yml");
}

impl CommandConfig for LocalizationConfig {
    const PATH: &'static str = "config/localization.yml";
    const SHORT: &'static str = include_str!("../../../config/localization.yml");
    const FULL: &'static str = include_str!("full/localization.yml");
}

impl CommandConfig for RefinementConfig {
    const PATH: &'static str = "config/refinement.yml";
    const SHORT: &'static str = include_str!("../../../config/refinement.yml");
    const FULL: &'static str = include_str!("full/refinement.yml");
}

impl CommandConfig for EvaluationConfig {
    const PATH: &'static str = "config/evaluation.yml";
    const SHORT: &'static str = include_str!("../../../config/evaluation.yml");
    const FULL: &'static str = Self::SHORT;
}

impl CommandConfig for GroundCommandConfig {
    const PATH: &'static str = "config/ground.yml";
    const SHORT: &'static str = include_str!("../../../config/ground.yml");
    const FULL: &'static str = include_str!("full/ground.yml");
}

impl CommandConfig for SimulationConfig {
    const PATH: &'static str = "config/simulation.yml";
    const SHORT: &'static str = include_str!("../../../config/simulation.yml");
    const FULL: &'static str = include_str!("full/simulation.yml");
}

impl CommandConfig for ComparisonConfig {
    const PATH: &'static str = "config/comparison.yml";
    const SHORT: &'static str = include_str!("../../../config/comparison.yml");
    const FULL: &'static str = Self::SHORT;
}
