//! Loading, overriding and writing of configurations.

use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::error::{self, ConfigError};
use super::template::CommandConfig;
use super::yaml::{self, keys, to_yaml};
use crate::memory;
use crate::validation::Validate;

/// Loads and validates the configuration of a command from `path`, else from its default path
/// where that file exists, else from the built-in text, with settings (dotted key, YAML value)
/// applied in order.
pub fn load<T: CommandConfig>(
    path: Option<&Path>,
    settings: &[(String, String)],
) -> Result<T, ConfigError> {
    let default_path = Path::new(T::PATH);
    let Some(path) = path.or(default_path.exists().then_some(default_path)) else {
        return load_text("built-in configuration", T::SHORT, settings);
    };
    let text = memory::read_text(path).map_err(|source| ConfigError::Read {
        path: path.to_owned(),
        source,
    })?;
    load_text(&path.display().to_string(), &text, settings)
}

/// Applies settings to a configuration and validates it.
pub fn with_settings<T>(config: T, settings: &[(String, String)]) -> Result<T, ConfigError>
where
    T: Validate + Serialize + DeserializeOwned,
{
    with_settings_over("defaults", "", config, settings)
}

/// Whether a configuration has a key.
pub fn has_key<T: Default + Serialize>(key: &str) -> Result<bool, ConfigError> {
    let text = to_yaml(&T::default())?;
    Ok(keys(&text).iter().any(|it| it.name == key))
}

fn load_text<T>(name: &str, text: &str, settings: &[(String, String)]) -> Result<T, ConfigError>
where
    T: Validate + Serialize + DeserializeOwned,
{
    let config = yaml::parse(text).map_err(|source| error::in_file(name, text, source))?;
    with_settings_over(name, text, config, settings)
}

/// Applies settings to the configuration of a text and validates it.
fn with_settings_over<T>(
    name: &str,
    text: &str,
    mut config: T,
    settings: &[(String, String)],
) -> Result<T, ConfigError>
where
    T: Validate + Serialize + DeserializeOwned,
{
    for (key, value) in settings {
        let current = to_yaml(&config)?;
        let Some(replaced) = yaml::with_value(&current, key, value) else {
            let keys = keys(&current);
            let names = keys.iter().map(|key| key.name.as_str());
            let known = names.filter(|name| !name.contains('['));
            return Err(error::unknown_setting(key, value, known));
        };
        config = yaml::parse(&replaced).map_err(|source| error::in_setting(key, value, source))?;
    }
    config
        .validate()
        .map_err(|invalid| error::invalid(name, text, settings, invalid))?;
    Ok(config)
}

#[cfg(test)]
mod tests;
