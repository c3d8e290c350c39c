//! What can be wrong with a configuration, told with its place.

use std::fmt;
use std::path::{Path, PathBuf};

use super::outline::Outline;
use crate::validation::InvalidValue;

/// Each names the place, quotes what stands there and says what to do.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum ConfigError {
    #[error("cannot read the configuration {}: {source}; give the path of a YAML file like those under config/", path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("cannot write the configuration {}: {source}", path.display())]
    Write {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{place}: unknown key `{key}`{}", suggestion(nearest.as_deref()))]
    UnknownKey {
        place: Place,
        key: String,
        nearest: Option<String>,
    },
    #[error("{place}: `{value}` is not a value for {key}: {expected}")]
    WrongValue {
        place: Place,
        key: String,
        value: String,
        expected: String,
    },
    #[error("{place}: {problem}")]
    Unusable { place: Place, problem: InvalidValue },
    #[error("{place}: key `{key}` is given twice; remove one of them")]
    DuplicateKey { place: Place, key: String },
    #[error("{place}: {source}")]
    Syntax {
        place: Place,
        source: Box<serde_yaml::Error>,
    },
    #[error("the configuration cannot be written as YAML: {0}")]
    Serialize(serde_yaml::SerializeError),
}

/// Where a value was given.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Place {
    /// In a file, at a line counted from 1 where it is known.
    File {
        /// The file.
        path: PathBuf,
        /// The line.
        line: Option<usize>,
    },
    /// On the command line.
    Setting {
        /// The dotted key.
        key: String,
        /// The value as given.
        value: String,
    },
}

impl Place {
    /// The file as a whole, where the line is told otherwise.
    fn without_line(self) -> Self {
        match self {
            Self::File { path, .. } => Self::File { path, line: None },
            setting @ Self::Setting { .. } => setting,
        }
    }
}

impl fmt::Display for Place {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::File { path, line: None } => write!(f, "{}", path.display()),
            Self::File {
                path,
                line: Some(line),
            } => write!(f, "{}, line {line}", path.display()),
            Self::Setting { key, value } => write!(f, "--set {key}={value}"),
        }
    }
}

/// The error of a YAML file, with the key and the value that it is about.
pub(super) fn in_file(path: &Path, text: &str, source: serde_yaml::Error) -> ConfigError {
    let location = source.location();
    let line = location.map(|location| location.line() as usize);
    let place = Place::File {
        path: path.to_owned(),
        line,
    };
    let outline = Outline::of(text);
    let key = line.and_then(|line| outline.key_at(line));
    let value = location.and_then(|location| quoted(text, location));
    describe(place, key, value, source)
}

/// The error of a value on the command line.
pub(super) fn in_setting(
    place: Place,
    key: &str,
    value: &str,
    source: serde_yaml::Error,
) -> ConfigError {
    describe(place, Some(key), Some(value), source)
}

/// A value that was read and cannot be used, at the place where it was given last.
pub(super) fn unusable(
    path: &Path,
    text: &str,
    overrides: &[(String, String)],
    problem: InvalidValue,
) -> ConfigError {
    let setting = overrides
        .iter()
        .rfind(|(key, _)| is_within(&problem.key, key));
    let place = match setting {
        Some((key, value)) => Place::Setting {
            key: key.clone(),
            value: value.clone(),
        },
        None => Place::File {
            path: path.to_owned(),
            line: Outline::of(text).line_of(&problem.key),
        },
    };
    ConfigError::Unusable { place, problem }
}

/// Whether a key is a block, a part of it, or an item of that list.
fn is_within(key: &str, block: &str) -> bool {
    let rest = key.strip_prefix(block);
    rest.is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']))
}

/// The key that was probably meant: the nearest in spelling, by itself or as the last part of
/// a dotted key; `None` where nothing is near.
pub(super) fn nearest<'a>(key: &str, known: impl Iterator<Item = &'a str>) -> Option<String> {
    let distance = |candidate: &str| {
        let last = candidate.rsplit('.').next().unwrap_or(candidate);
        strsim::damerau_levenshtein(key, candidate).min(strsim::damerau_levenshtein(key, last))
    };
    let limit = (key.chars().count() / 3).max(2);
    known
        .map(|candidate| (distance(candidate), candidate))
        .min_by_key(|(distance, _)| *distance)
        .filter(|(distance, _)| *distance <= limit)
        .map(|(_, candidate)| candidate.to_owned())
}

fn describe(
    place: Place,
    key: Option<&str>,
    value: Option<&str>,
    source: serde_yaml::Error,
) -> ConfigError {
    use serde_yaml::Error as Yaml;
    match &source {
        Yaml::SerdeUnknownField {
            field, expected, ..
        } => {
            return ConfigError::UnknownKey {
                place,
                key: field.clone(),
                nearest: nearest(field, expected.iter().copied()),
            };
        }
        Yaml::DuplicateMappingKey { key: Some(key), .. } => {
            return ConfigError::DuplicateKey {
                place,
                key: key.clone(),
            };
        }
        _ => {}
    }
    match (key, value, expected(&source)) {
        (Some(key), Some(value), Some(expected)) => ConfigError::WrongValue {
            place,
            key: key.to_owned(),
            value: if value.is_empty() { "null" } else { value }.to_owned(),
            expected,
        },
        _ => ConfigError::Syntax {
            place: place.without_line(),
            source: Box::new(source),
        },
    }
}

/// What belongs in the place of a wrong value.
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

/// The parser's words for what it expects, as a user reads them.
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

/// The value at a location: its text if it is a plain one, else what follows the key.
fn quoted(text: &str, location: serde_yaml::Location) -> Option<&str> {
    let line = text
        .lines()
        .nth((location.line() as usize).checked_sub(1)?)?;
    let whole = line.split_once(':').map_or(line, |(_, value)| value);
    let whole = whole.split(" #").next()?.trim();
    let span = location.span();
    let start = usize::try_from(span.byte_offset()?).ok()?;
    let length = usize::try_from(span.byte_len()?).ok()?;
    let exact = text.get(start..start + length)?.trim();
    let is_part = exact.chars().any(char::is_alphanumeric) && whole.contains(exact);
    Some(if is_part { exact } else { whole })
}

fn suggestion(nearest: Option<&str>) -> String {
    match nearest {
        Some(key) => format!("; did you mean `{key}`?"),
        None => "; the files under config/ show every key".to_owned(),
    }
}
