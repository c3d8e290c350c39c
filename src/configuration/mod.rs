//! Configurations as YAML: one way from a text, or from keys and values, to the structs of the library and back.
//!
//! ```text
//! text      ->  keys with their full names  ->  struct, with defaults for what is missing
//! settings  ->  keys with their full names  ->  replaced values, in order  ->  validation
//! ```
//!
//! The full name of a key is the path of a field, such as `tracker.localizer.num_particles`. `names` accepts shorter
//! ones, and those of range-mcl. Nothing is ignored but two keys of range-mcl that have no effect: an unknown key, a value of the wrong type and a contradiction are
//! errors that name the place, the key and the value.

mod braces;
mod comments;
mod error;
mod keys;
mod load;
mod names;
mod yaml;

pub use comments::commented;
pub use error::ConfigError;
pub use load::{Settings, has_key, parse, read, with_settings};
pub use yaml::to_yaml;

use schemars::JsonSchema;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::validation::Validate;

/// A configuration that is read from YAML.
pub trait Configuration: Validate + Default + Serialize + DeserializeOwned + JsonSchema {}

impl<T: Validate + Default + Serialize + DeserializeOwned + JsonSchema> Configuration for T {}
