//! From texts and settings to configurations.

use std::path::Path;

use super::Configuration;
use super::error::{self, ConfigError};
use super::names::{Meaning, Names};
use super::yaml::{self, FullText, to_yaml};
use crate::memory;

/// Keys with values in YAML, applied in order.
#[derive(Clone, Copy, Debug)]
pub struct Settings<'a> {
    /// What stands before a key where it was given, for errors: such as the name of an option with a space.
    pub before: &'a str,
    /// Name of a key and value.
    pub pairs: &'a [(String, String)],
}

/// Reads a configuration from a file, and applies settings.
pub fn read<T: Configuration>(path: &Path, settings: Settings) -> Result<T, ConfigError> {
    let text = memory::read_text(path).map_err(|source| ConfigError::Read {
        path: path.to_owned(),
        source,
    })?;
    parse(&path.display().to_string(), &text, settings)
}

/// Reads a configuration from a text, whose name errors contain, and applies settings.
pub fn parse<T: Configuration>(
    name: &str,
    text: &str,
    settings: Settings,
) -> Result<T, ConfigError> {
    let full = FullText::new(name, text, &names::<T>()?)?;
    let config = yaml::parse(&full.text).map_err(|source| full.error(name, source))?;
    apply(name, &full, config, settings)
}

/// Applies settings to a configuration and validates it.
pub fn with_settings<T: Configuration>(config: T, settings: Settings) -> Result<T, ConfigError> {
    apply("defaults", &FullText::default(), config, settings)
}

/// Whether a configuration has a key of that name.
pub fn has_key<T: Configuration>(name: &str) -> Result<bool, ConfigError> {
    let names = names::<T>()?;
    Ok(match names.meaning(name) {
        Meaning::Key(key) => names.0.contains(&key),
        _ => false,
    })
}

/// The full names of all keys.
fn names<T: Configuration>() -> Result<Names, ConfigError> {
    Ok(yaml::names(&to_yaml(&T::default())?))
}

fn apply<T: Configuration>(
    name: &str,
    text: &FullText,
    mut config: T,
    settings: Settings,
) -> Result<T, ConfigError> {
    let mut full_settings = Vec::new();
    for (key, value) in settings.pairs {
        let place = format!("{}{key}={value}", settings.before);
        let current = to_yaml(&config)?;
        let names = yaml::names(&current);
        let full = match names.meaning(key) {
            Meaning::Key(full) => full,
            Meaning::Nothing => continue,
            meaning => return Err(error::unknown(place, key, meaning, &names)),
        };
        let Some(replaced) = yaml::with_value(&current, &full, value) else {
            return Err(error::unknown(place, key, Meaning::Unknown, &names));
        };
        config = yaml::parse(&replaced)
            .map_err(|source| error::in_setting(place.clone(), &full, value, source))?;
        full_settings.push((full, place));
    }
    config
        .validate()
        .map_err(|invalid| text.invalid(name, &full_settings, invalid))?;
    Ok(config)
}
