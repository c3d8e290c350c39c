//! Errors of configurations, with the file and line or the `--set` that they are about.

use std::path::PathBuf;

use super::yaml::{is_within, keys};
use crate::validation::InvalidValue;

/// Longest key that is compared with the known ones [bytes].
const LONGEST_KEY: usize = 200;

/// Why a configuration cannot be used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum ConfigError {
    #[error(
        "cannot read the configuration {}: {source}; give the path of a YAML file, such as one that `fpmcl config` prints",
        path.display()
    )]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{place}: unknown key `{key}`{}", suggestion(nearest.as_deref()))]
    UnknownKey {
        place: String,
        key: String,
        nearest: Option<String>,
    },
    #[error("{place}: {invalid}")]
    InvalidValue {
        place: String,
        invalid: InvalidValue,
    },
    #[error("{place}: key `{key}` is given twice; remove one of them")]
    DuplicateKey { place: String, key: String },
    #[error("{place}: {source}")]
    Syntax {
        place: String,
        source: Box<serde_yaml::Error>,
    },
    #[error("cannot write the configuration as YAML: {0}")]
    Serialize(#[from] serde_yaml::SerializeError),
}

/// The error of a YAML file, with the key and the value of its line.
pub(super) fn in_file(name: &str, text: &str, source: serde_yaml::Error) -> ConfigError {
    let Some(line) = source
        .location()
        .map(|location| (location.line() as usize).saturating_sub(1))
    else {
        return describe(name.to_owned(), None, source);
    };
    let key = keys(text).into_iter().rfind(|key| key.line <= line);
    let value = text.lines().nth(line).map(value_of).unwrap_or_default();
    let at_line = key.map(|key| (key.name, value));
    describe(place(name, Some(line)), at_line, source)
}

/// The error of a `--set`.
pub(super) fn in_setting(key: &str, value: &str, source: serde_yaml::Error) -> ConfigError {
    describe(
        setting(key, value),
        Some((key.to_owned(), value.to_owned())),
        source,
    )
}

/// The error of a `--set` of a key that does not exist.
pub(super) fn unknown_setting<'a>(
    key: &str,
    value: &str,
    known: impl Iterator<Item = &'a str>,
) -> ConfigError {
    ConfigError::UnknownKey {
        place: setting(key, value),
        nearest: nearest(key, known),
        key: key.to_owned(),
    }
}

/// The error of an invalid value, at the place where it was given last.
pub(super) fn invalid(
    name: &str,
    text: &str,
    settings: &[(String, String)],
    invalid: InvalidValue,
) -> ConfigError {
    let set = settings
        .iter()
        .rfind(|(key, _)| is_within(&invalid.key, key) || is_within(key, &invalid.key));
    let place = match set {
        Some((key, value)) => setting(key, value),
        None => {
            let keys = keys(text);
            let innermost = keys.iter().rfind(|key| is_within(&invalid.key, &key.name));
            place(name, innermost.map(|key| key.line))
        }
    };
    ConfigError::InvalidValue { place, invalid }
}

/// A file and a line of it, from 0.
fn place(name: &str, line: Option<usize>) -> String {
    match line {
        Some(line) => format!("{name}, line {}", line + 1),
        None => name.to_owned(),
    }
}

fn setting(key: &str, value: &str) -> String {
    format!("--set {key}={value}")
}

fn suggestion(nearest: Option<&str>) -> String {
    match nearest {
        Some(key) => format!("; did you mean `{key}`?"),
        None => "; `fpmcl config COMMAND --full` prints every key".to_owned(),
    }
}

/// The known key that is most similar, by itself or as the last part of a dotted key; `None` where
/// none is similar. Keys too long for any configuration are compared with none.
fn nearest<'a>(key: &str, known: impl Iterator<Item = &'a str>) -> Option<String> {
    let distance = |candidate: &str| {
        let last = candidate.rsplit('.').next().unwrap_or(candidate);
        strsim::damerau_levenshtein(key, candidate).min(strsim::damerau_levenshtein(key, last))
    };
    let limit = (key.chars().count() / 3).max(2);
    let known = known.filter(|_| key.len() <= LONGEST_KEY);
    known
        .map(|candidate| (distance(candidate), candidate))
        .min_by_key(|(distance, _)| *distance)
        .filter(|(distance, _)| *distance <= limit)
        .map(|(_, candidate)| candidate.to_owned())
}

fn describe(
    place: String,
    key_and_value: Option<(String, String)>,
    source: serde_yaml::Error,
) -> ConfigError {
    use serde_yaml::Error as Yaml;
    match (&source, expected(&source), key_and_value) {
        (
            Yaml::SerdeUnknownField {
                field, expected, ..
            },
            ..,
        ) => ConfigError::UnknownKey {
            place,
            key: field.clone(),
            nearest: nearest(field, expected.iter().copied()),
        },
        (Yaml::DuplicateMappingKey { key: Some(key), .. }, ..) => ConfigError::DuplicateKey {
            place,
            key: key.clone(),
        },
        (_, Some(expected), Some((key, value))) => {
            let value = if value.is_empty() { "null" } else { &value };
            ConfigError::InvalidValue {
                place,
                invalid: InvalidValue::new(&key, format_args!("`{value}`"), expected),
            }
        }
        _ => ConfigError::Syntax {
            place,
            source: Box::new(source),
        },
    }
}

/// What a value must be.
fn expected(source: &serde_yaml::Error) -> Option<String> {
    use serde_yaml::Error as Yaml;
    let expected = match source {
        Yaml::InvalidScalar { ty, .. } => in_words(ty).to_owned(),
        Yaml::Unexpected { expected, .. } => in_words(expected).to_owned(),
        Yaml::SerdeInvalidType { expected, .. } | Yaml::SerdeInvalidValue { expected, .. } => {
            expected.clone()
        }
        Yaml::SerdeInvalidLength { expected, .. } => expected
            .replace("a tuple of size", "a list of length")
            .replace("an array of length", "a list of length"),
        Yaml::SerdeUnknownVariant { expected, .. } => format!("one of {}", expected.join(", ")),
        _ => return None,
    };
    Some(format!("it must be {expected}"))
}

/// The parser's type names in words.
fn in_words(ty: &str) -> &str {
    match ty {
        "floating point" => "a number",
        "boolean" => "True or False",
        "mapping start" => "a block of keys",
        "sequence start" => "a list",
        "string scalar" => "a text",
        "u8" | "u16" | "u32" | "u64" => "a whole number, not negative",
        "i8" | "i16" | "i32" | "i64" => "a whole number",
        _ => ty,
    }
}

/// The value on a line, without its key and its comment.
fn value_of(line: &str) -> String {
    let value = line.split_once(':').map_or(line, |(_, value)| value);
    let value = value.split(" #").next().unwrap_or_default();
    value.trim().to_owned()
}
