//! What a user configures: one struct per command, composed of the stages' own; loaded,
//! overridden, checked and written back here.
//!
//! ```text
//! defaults  <-  YAML file  <-  --set key=value, in order  ->  check  ->  effective configuration
//! ```
//!
//! The keys are those of range-mcl's files, whose files load unchanged, and new ones beside
//! them. Nothing is ignored: an unknown key, a word where a number belongs and a contradiction
//! are errors that name the file and the line, or the `--set`.

mod build_map;
mod check;
mod comparison;
mod error;
mod evaluation;
mod ground;
mod localization;
mod outline;
mod refinement;

use std::fs;
use std::io::Write as _;
use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;

pub use build_map::BuildMapConfig;
pub use comparison::{
    ComparisonConfig, Overrides, ParticleSweep, SequenceConfig, StageOverrides, VariantConfig,
    settings,
};
pub use error::{ConfigError, Place};
pub use evaluation::EvaluationConfig;
pub use ground::GroundCommandConfig;
pub use localization::{
    Initialization, LocalizationConfig, MotionModel, OdometrySource, RenderedRangeImage,
};
pub use refinement::RefinementConfig;

use crate::validation::Validate;
use outline::Outline;

use crate::app::output::write_atomically;

/// Loads the configuration of a command from `path`, or from `default_path` where none is
/// given, applies the overrides (dotted key, YAML value) in order, and checks the result.
///
/// A key that the file leaves out has its default; so has every key of an empty file.
pub fn load<T>(
    path: Option<&Path>,
    default_path: &Path,
    overrides: &[(String, String)],
) -> Result<T, ConfigError>
where
    T: Validate + Serialize + DeserializeOwned,
{
    let path = path.unwrap_or(default_path);
    let text = fs::read_to_string(path).map_err(|source| ConfigError::Read {
        path: path.to_owned(),
        source,
    })?;
    let config: T = parse(&text).map_err(|source| error::in_file(path, &text, source))?;
    overridden(config, path, &text, overrides)
}

/// The default configuration with overrides, checked, for commands that need no file.
pub fn defaults<T>(overrides: &[(String, String)]) -> Result<T, ConfigError>
where
    T: Validate + Default + Serialize + DeserializeOwned,
{
    with_overrides(T::default(), overrides)
}

/// A configuration with overrides, checked.
pub fn with_overrides<T>(config: T, overrides: &[(String, String)]) -> Result<T, ConfigError>
where
    T: Validate + Serialize + DeserializeOwned,
{
    overridden(config, Path::new("defaults"), "", overrides)
}

/// Applies the overrides in order and checks the result.
fn overridden<T>(
    mut config: T,
    path: &Path,
    text: &str,
    overrides: &[(String, String)],
) -> Result<T, ConfigError>
where
    T: Validate + Serialize + DeserializeOwned,
{
    for (key, value) in overrides {
        config = override_key(&config, key, value)?;
    }
    config
        .validate()
        .map_err(|problem| error::unusable(path, text, overrides, problem))?;
    Ok(config)
}

/// Whether a configuration has a key at its top level.
pub fn has_key<T: Default + Serialize>(key: &str) -> Result<bool, ConfigError> {
    let text = to_yaml(&T::default())?;
    Ok(Outline::of(&text).line_of(key).is_some())
}

/// Writes the effective configuration; loading it gives an equal one.
///
/// The file appears whole under its name or not at all.
pub fn write<T: Serialize>(path: &Path, config: &T) -> Result<(), ConfigError> {
    let text = to_yaml(config)?;
    write_atomically(path, |file| file.write_all(text.as_bytes())).map_err(|source| {
        ConfigError::Write {
            path: path.to_owned(),
            source,
        }
    })
}

/// The effective configuration as YAML, each key on a line of its own.
pub fn to_yaml<T: Serialize>(config: &T) -> Result<String, ConfigError> {
    let options = serde_yaml::ser_options! { prefer_block_scalars: false };
    serde_yaml::to_string_with_options(config, options).map_err(ConfigError::Serialize)
}

fn parse<T: DeserializeOwned>(text: &str) -> Result<T, serde_yaml::Error> {
    serde_yaml::from_str_with_options(text, serde_yaml::options! { with_snippet: false })
}

/// The configuration with the value of one key replaced.
fn override_key<T>(config: &T, key: &str, value: &str) -> Result<T, ConfigError>
where
    T: Serialize + DeserializeOwned,
{
    let text = to_yaml(config)?;
    let outline = Outline::of(&text);
    let place = Place::Setting {
        key: key.to_owned(),
        value: value.to_owned(),
    };
    let Some(replaced) = outline.with_value(key, value) else {
        return Err(ConfigError::UnknownKey {
            nearest: error::nearest(key, outline.keys()),
            key: key.to_owned(),
            place,
        });
    };
    parse(&replaced).map_err(|source| error::in_setting(place, key, value, source))
}

#[cfg(test)]
mod tests;
