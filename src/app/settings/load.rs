//! Configurations of commands from files and `--set`, and the texts that `fpmcl config` prints.

use std::path::Path;

use super::build_map::BuildMapConfig;
use super::evaluation::EvaluationConfig;
use super::ground::GroundCommandConfig;
use super::localization::LocalizationConfig;
use super::odometry::OdometryCommandConfig;
use super::refinement::RefinementConfig;
use crate::configuration::{self, ConfigError, Configuration, Settings, commented};
use crate::simulation::SimulationConfig;

/// The configuration of a command. Other crates read it by these functions, which are compiled with the library and not again with
/// each of those crates.
pub trait CommandConfig: Configuration {
    /// Path of the file that is used if it exists and no other is given.
    const PATH: &'static str;
    /// The keys that people change; the configuration where there is no file.
    const SHORT: &'static str;

    /// See [`load`].
    fn load(path: Option<&Path>, settings: &[(String, String)]) -> Result<Self, ConfigError>;

    /// See [`with_settings`].
    fn with_settings(self, settings: &[(String, String)]) -> Result<Self, ConfigError>;

    /// See [`full_text`].
    fn full_text() -> Result<String, ConfigError>;

    /// All keys with their values.
    fn to_yaml(&self) -> Result<String, ConfigError>;
}

/// Names the files of configurations, which are below `config/`.
macro_rules! command_configs {
    ($($config:ty: $name:literal),* $(,)?) => {
        $(impl $crate::app::settings::CommandConfig for $config {
            const PATH: &'static str = concat!("config/", $name, ".yml");
            const SHORT: &'static str =
                include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/config/", $name, ".yml"));

            fn load(
                path: Option<&std::path::Path>,
                settings: &[(String, String)],
            ) -> Result<Self, $crate::app::settings::ConfigError> {
                $crate::app::settings::load(path, settings)
            }

            fn with_settings(
                self,
                settings: &[(String, String)],
            ) -> Result<Self, $crate::app::settings::ConfigError> {
                $crate::app::settings::with_settings(self, settings)
            }

            fn full_text() -> Result<String, $crate::app::settings::ConfigError> {
                $crate::app::settings::full_text::<Self>()
            }

            fn to_yaml(&self) -> Result<String, $crate::app::settings::ConfigError> {
                Ok($crate::app::settings::to_yaml(self)?)
            }
        })*
    };
}
pub(crate) use command_configs;

command_configs!(
    BuildMapConfig: "build_map",
    OdometryCommandConfig: "odometry",
    LocalizationConfig: "localization",
    RefinementConfig: "refinement",
    EvaluationConfig: "evaluation",
    GroundCommandConfig: "ground",
    SimulationConfig: "simulation",
);

/// Every key of a command with its default and its documentation, below the heading of the short text.
pub(crate) fn full_text<T: CommandConfig>() -> Result<String, ConfigError> {
    let heading = T::SHORT.lines().next().unwrap_or_default();
    let keys = commented::<T>()?;
    Ok(format!(
        "{heading}\n# Every key with its default.\n# Relative paths are relative to the working directory.\n\n{keys}"
    ))
}

/// Loads and validates the configuration of a command from `path`, else from its default path
/// where that file exists, else from the built-in text, with settings (dotted key, YAML value)
/// applied in order.
pub(crate) fn load<T: CommandConfig>(
    path: Option<&Path>,
    settings: &[(String, String)],
) -> Result<T, ConfigError> {
    let settings = from_options(settings);
    let default_path = Path::new(T::PATH);
    match path.or(default_path.exists().then_some(default_path)) {
        Some(path) => configuration::read(path, settings),
        None => configuration::parse("built-in configuration", T::SHORT, settings),
    }
}

/// Applies settings to a configuration and validates it.
pub(crate) fn with_settings<T: Configuration>(
    config: T,
    settings: &[(String, String)],
) -> Result<T, ConfigError> {
    configuration::with_settings(config, from_options(settings))
}

fn from_options(pairs: &[(String, String)]) -> Settings<'_> {
    let before = "--set ";
    Settings { before, pairs }
}
