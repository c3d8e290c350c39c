//! Validation of configuration values.
//!
//! The configuration of each stage implements [`Validate`] next to the algorithm that uses it, so
//! that the library's entry points and the program's configuration files have the same limits.

use std::fmt::Display;
use std::ops::RangeInclusive;

/// A configuration that knows the limits of its values.
pub trait Validate {
    /// Returns the first value that cannot be used.
    ///
    /// # Errors
    /// The first field that is out of its range, by its path in the configuration.
    fn validate(&self) -> Result<(), InvalidValue>;
}

/// A configuration value that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{key} is {value}: {remedy}")]
pub struct InvalidValue {
    /// Dotted key, as in a configuration file; an item of a list has its number, from 1.
    pub key: String,
    /// The value as text.
    pub value: String,
    /// What is allowed instead.
    pub remedy: String,
}

impl InvalidValue {
    /// An invalid value of `key`.
    pub(crate) fn new(key: &str, value: impl Display, remedy: impl Into<String>) -> Self {
        Self {
            key: key.to_owned(),
            value: value.to_string(),
            remedy: remedy.into(),
        }
    }
}

/// Validates a nested configuration; its keys get the prefix `block.`.
pub(crate) fn nested(block: &str, config: &impl Validate) -> Result<(), InvalidValue> {
    config.validate().map_err(|invalid| InvalidValue {
        key: format!("{block}.{}", invalid.key),
        ..invalid
    })
}

/// Requires a condition.
pub(crate) fn require(
    condition: bool,
    key: &str,
    value: impl Display,
    remedy: impl Into<String>,
) -> Result<(), InvalidValue> {
    if condition {
        Ok(())
    } else {
        Err(InvalidValue::new(key, value, remedy))
    }
}

/// Smallest and largest positive value: squares, inverses, and their products with the size of a map
/// are finite and precise enough.
const SMALLEST: f64 = 1e-9;
const LARGEST: f64 = 1e6;

/// Requires a value greater than 0, from 1e-9 to a million.
pub(crate) fn positive<N: Into<f64> + Copy + Display>(
    key: &str,
    value: N,
) -> Result<(), InvalidValue> {
    let number: f64 = value.into();
    require(number > 0.0, key, value, "it must be greater than 0")?;
    // Values of single precision are rounded.
    if (0.999 * SMALLEST..=LARGEST).contains(&number) {
        Ok(())
    } else {
        let remedy = format!("it must be between {SMALLEST} and {LARGEST}");
        Err(InvalidValue::new(key, value, remedy))
    }
}

/// Requires a value greater than 0, which may be infinite: no limit.
pub(crate) fn positive_or_infinite<N: Into<f64> + Copy + Display>(
    key: &str,
    value: N,
) -> Result<(), InvalidValue> {
    require(value.into() > 0.0, key, value, "it must be greater than 0")
}

/// Requires a value of 0 or greater, at most a million.
pub(crate) fn not_negative<N: Into<f64> + Copy + Display>(
    key: &str,
    value: N,
) -> Result<(), InvalidValue> {
    let number: f64 = value.into();
    require(number >= 0.0, key, value, "it must be 0 or greater")?;
    bounded(key, value)
}

/// Requires a value between minus and plus a million.
pub(crate) fn bounded<N: Into<f64> + Copy + Display>(
    key: &str,
    value: N,
) -> Result<(), InvalidValue> {
    let remedy = format!("it must lie between -{LARGEST} and {LARGEST}");
    require(value.into().abs() <= LARGEST, key, value, remedy)
}

/// Requires a value within both limits.
pub(crate) fn in_range<N: PartialOrd + Display>(
    key: &str,
    value: N,
    range: RangeInclusive<N>,
) -> Result<(), InvalidValue> {
    let remedy = format!("it must lie between {} and {}", range.start(), range.end());
    require(range.contains(&value), key, value, remedy)
}

/// Requires a value from 0 to 1.
pub(crate) fn fraction<N: Into<f64> + Copy + Display>(
    key: &str,
    value: N,
) -> Result<(), InvalidValue> {
    let holds = (0.0..=1.0).contains(&value.into());
    require(holds, key, value, "it must lie between 0 and 1")
}

/// Requires a count of 1 or greater.
pub(crate) fn at_least_one(key: &str, count: usize) -> Result<(), InvalidValue> {
    require(count >= 1, key, count, "it must be 1 or greater")
}

/// Requires a rectangle `[x_min, x_max, y_min, y_max]`.
pub(crate) fn rectangle(key: &str, limits_m: [f32; 4]) -> Result<(), InvalidValue> {
    let [x_min, x_max, y_min, y_max] = limits_m;
    require(
        limits_m
            .iter()
            .all(|limit| f64::from(limit.abs()) <= LARGEST)
            && x_min <= x_max
            && y_min <= y_max,
        key,
        format_args!("{limits_m:?}"),
        "it must be x_min, x_max, y_min, y_max with x_min <= x_max and y_min <= y_max; \
         [0, 0, 0, 0] is empty",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Inner(f32);

    impl Validate for Inner {
        fn validate(&self) -> Result<(), InvalidValue> {
            positive("width_m", self.0)
        }
    }

    #[test]
    fn values_that_are_not_finite_are_neither_positive_nor_zero() {
        for value in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            assert!(positive("x", value).is_err());
            assert!(not_negative("x", value).is_err());
            assert!(fraction("x", value).is_err());
            assert!(in_range("x", value, 0.0..=1.0).is_err());
        }
        assert!(positive("x", 0.0).is_err() && not_negative("x", 0.0).is_ok());
        assert!(at_least_one("n", 0).is_err() && at_least_one("n", 1).is_ok());
    }

    #[test]
    fn a_nested_value_is_reported_with_its_full_key() {
        assert_eq!(nested("box", &Inner(1.0)), Ok(()));
        let message = nested("box", &Inner(-0.1)).unwrap_err().to_string();
        assert_eq!(message, "box.width_m is -0.1: it must be greater than 0");
    }
}
