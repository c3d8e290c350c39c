//! Errors of the library as exceptions.

use anyhow::anyhow;
use pyo3::exceptions::PyException;
use pyo3::prelude::*;

use crate::logging;

pyo3::create_exception!(
    fpmcl,
    Error,
    PyException,
    "An input or a setting that cannot be used; the message is that of the program."
);

/// The exception of an error, with the message of the program; an exception that was raised by Python code stays.
pub fn raised(error: impl Into<anyhow::Error>) -> PyErr {
    match error.into().downcast::<PyErr>() {
        Ok(exception) => exception,
        Err(error) => Error::new_err(chain(&error)),
    }
}

/// An error and its causes, without repetitions.
fn chain(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain().map(ToString::to_string) {
        if !text.contains(&cause) {
            text += if text.is_empty() { "" } else { ": " };
            text += &cause;
        }
    }
    text
}

/// Calls the library without the interpreter lock.
pub fn released<T: Send, E: Into<anyhow::Error> + Send>(
    py: Python<'_>,
    work: impl FnOnce() -> Result<T, E> + Send,
) -> PyResult<T> {
    logging::start();
    py.detach(work).map_err(raised)
}

/// An error of a source of scans.
pub fn of_scan(error: Box<dyn std::error::Error + Send + Sync>) -> anyhow::Error {
    match error.downcast::<PyErr>() {
        Ok(exception) => anyhow::Error::new(*exception),
        Err(error) => anyhow!(error),
    }
}
