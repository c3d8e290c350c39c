//! Checks that several commands share.

use std::path::Path;

use crate::validation::{InvalidValue, require};

/// Requires a path that is not empty.
pub(super) fn path(key: &str, value: &Path) -> Result<(), InvalidValue> {
    let given = !value.as_os_str().is_empty();
    require(given, key, "empty", "give a path")
}

/// Requires a box `[x_min, x_max, y_min, y_max]` [m].
pub(super) fn own_car(key: &str, limits_m: [f32; 4]) -> Result<(), InvalidValue> {
    let [x_min, x_max, y_min, y_max] = limits_m;
    require(
        limits_m.iter().all(|limit| limit.is_finite()) && x_min <= x_max && y_min <= y_max,
        key,
        format_args!("{limits_m:?}"),
        "it must be x_min, x_max, y_min, y_max with x_min up to x_max and y_min up to y_max; \
         [0, 0, 0, 0] keeps every point",
    )
}
