//! Checks that several commands share.

use std::path::Path;

use crate::ground::GroundConfig;
use crate::validation::{InvalidValue, Validate as _, nested, require};

/// Requires a path that is not empty.
pub(super) fn path(key: &str, value: &Path) -> Result<(), InvalidValue> {
    let is_given = !value.as_os_str().is_empty();
    require(is_given, key, "empty", "give a path")
}

/// Requires a path that is not empty, where one is given.
pub(super) fn optional_path(key: &str, value: Option<&Path>) -> Result<(), InvalidValue> {
    value.map_or(Ok(()), |value| path(key, value))
}

/// Validates a ground classifier whose RANSAC keys are at the top level.
pub(super) fn ground(config: &GroundConfig) -> Result<(), InvalidValue> {
    nested("fuzzy", &config.fuzzy)?;
    nested("pca", &config.pca)?;
    config.ransac.validate()
}
