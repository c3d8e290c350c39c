//! Checks that several commands share.

use std::path::Path;

use crate::validation::{InvalidValue, require};

/// Requires a path that is not empty.
pub(super) fn path(key: &str, value: &Path) -> Result<(), InvalidValue> {
    let is_given = !value.as_os_str().is_empty();
    require(is_given, key, "empty", "give a path")
}

/// Requires a path that is not empty, where one is given.
pub(super) fn optional_path(key: &str, value: Option<&Path>) -> Result<(), InvalidValue> {
    value.map_or(Ok(()), |value| path(key, value))
}
