//! Errors of configurations, with the place that they are about: the line of a text, or a setting.

use std::path::PathBuf;

use super::names::{Meaning, Names};
use crate::validation::InvalidValue;

/// Longest key that is compared with the known ones [bytes].
const LONGEST_KEY: usize = 200;

/// Why a configuration cannot be used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum ConfigError {
    #[error(
        "cannot read the configuration {}: {source}; give the path of a YAML file",
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
    #[error("{place}: `{key}` is not a key any more: its value is fixed; remove it")]
    RemovedKey { place: String, key: String },
    #[error("{place}: `{key}` is ambiguous: {}; give more of its name", keys.join(" or "))]
    AmbiguousKey {
        place: String,
        key: String,
        keys: Vec<String>,
    },
    #[error("{place}: {invalid}")]
    InvalidValue {
        place: String,
        invalid: InvalidValue,
    },
    #[error("{place}: key `{key}` is given twice; remove one of them")]
    DuplicateKey { place: String, key: String },
    #[error(
        "{place}: its keys are written in a way that is not supported; write one per line, without merge keys"
    )]
    Style { place: String },
    #[error("{place}: {source}")]
    Syntax {
        place: String,
        source: Box<serde_yaml::Error>,
    },
    #[error("cannot write the configuration as YAML: {0}")]
    Serialize(#[from] serde_yaml::SerializeError),
}

/// The error of a setting.
pub(super) fn in_setting(
    place: String,
    key: &str,
    value: &str,
    source: serde_yaml::Error,
) -> ConfigError {
    describe(place, Some((key.to_owned(), value.to_owned())), source)
}

/// The error of a name that stands for no key, or for several.
pub(super) fn unknown(place: String, key: &str, meaning: Meaning, names: &Names) -> ConfigError {
    let key = key.to_owned();
    match meaning {
        Meaning::Removed => ConfigError::RemovedKey { place, key },
        Meaning::Ambiguous(keys) => ConfigError::AmbiguousKey { place, key, keys },
        _ => ConfigError::UnknownKey {
            nearest: nearest(&key, names.0.iter().map(String::as_str)),
            place,
            key,
        },
    }
}

/// A file and a line of it, from 0.
pub(super) fn place(name: &str, line: Option<usize>) -> String {
    match line {
        Some(line) => format!("{name}, line {}", line + 1),
        None => name.to_owned(),
    }
}

fn suggestion(nearest: Option<&str>) -> String {
    match nearest {
        Some(key) => format!("; did you mean `{key}`?"),
        None => "; no known key is similar".to_owned(),
    }
}

/// The last parts of a known key that are most similar; `None` where none are. Keys too long for any configuration are compared with none.
fn nearest<'a>(key: &str, known: impl Iterator<Item = &'a str>) -> Option<String> {
    let distance = |candidate: &str| strsim::damerau_levenshtein(key, candidate);
    let limit = (key.chars().count() / 3).max(2);
    let known = known.filter(|_| key.len() <= LONGEST_KEY);
    let endings = |candidate: &'a str| {
        let dots = candidate.match_indices('.').map(|(dot, _)| dot + 1);
        std::iter::once(0)
            .chain(dots)
            .map(move |start| &candidate[start..])
    };
    known
        .flat_map(endings)
        .map(|candidate| (distance(candidate), candidate))
        .min_by_key(|(distance, _)| *distance)
        .filter(|(distance, _)| *distance <= limit)
        .map(|(_, candidate)| candidate.to_owned())
}

/// The error of the parser at a place, with the key and the value there.
pub(super) fn describe(
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
        "string scalar" => "a string",
        "u8" | "u16" | "u32" | "u64" => "a whole number, not negative",
        "i8" | "i16" | "i32" | "i64" => "a whole number",
        _ => ty,
    }
}
