//! Errors of reading and writing result files.

use std::io;
use std::path::{Path, PathBuf};

/// A result file that cannot be read, written or used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum ResultsError {
    #[error("cannot read {}: {source}", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("cannot write {}: {source}", path.display())]
    Write { path: PathBuf, source: io::Error },
    #[error("{} is not a result file (.npz) or is cut off: {source}; run localize again", path.display())]
    NotNpz {
        path: PathBuf,
        source: zip::result::ZipError,
    },
    #[error("{} has no array `{array}`; it needs `particles` and `start_idx`, as localize and range-mcl write them", path.display())]
    MissingArray { path: PathBuf, array: &'static str },
    #[error("{}, array `{array}`: {source}", path.display())]
    BadArray {
        path: PathBuf,
        array: &'static str,
        source: ArrayError,
    },
    #[error("{}, array `{array}`, row {row}: {value} is not a valid value", path.display())]
    BadNumber {
        path: PathBuf,
        array: &'static str,
        row: usize,
        value: f64,
    },
    #[error("{}: start_idx is {start_idx}, but there are {rows} rows", path.display())]
    StartBehindEnd {
        path: PathBuf,
        start_idx: f64,
        rows: usize,
    },
    #[error("{}: `{array}` has {found} rows for {expected} frames", path.display())]
    WrongLength {
        path: PathBuf,
        array: &'static str,
        found: usize,
        expected: usize,
    },
    #[error(
        "the particles of frame {frame} have no weight, and the file holds no estimates; run localize again"
    )]
    ZeroWeights { frame: usize },
    #[error("{} is not a report of fpmcl: {source}; run evaluate again", path.display())]
    BadReport {
        path: PathBuf,
        source: serde_json::Error,
    },
}

impl ResultsError {
    /// Adds the file to an error of reading.
    pub(super) fn read(path: &Path) -> impl FnOnce(io::Error) -> Self {
        |source| Self::Read {
            path: path.to_owned(),
            source,
        }
    }

    /// Adds the file to an error of writing.
    pub(super) fn write(path: &Path) -> impl FnOnce(io::Error) -> Self {
        |source| Self::Write {
            path: path.to_owned(),
            source,
        }
    }
}

/// An array of a result file that cannot be used.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages say it")]
pub enum ArrayError {
    #[error(
        "its elements are of type {found}, but numbers are needed (float32, float64, int32, int64, uint8 or bool); convert it with numpy.asarray(array, float)"
    )]
    NotNumbers { found: String },
    #[error("it is in Fortran order; save it with numpy.ascontiguousarray")]
    FortranOrder,
    #[error("its shape is {found:?}, but {expected} is needed")]
    WrongShape {
        found: Vec<usize>,
        expected: &'static str,
    },
    #[error("its shape {shape:?} needs {needed} bytes of numbers, but there are {found}")]
    WrongSize {
        shape: Vec<u64>,
        needed: u128,
        found: u64,
    },
    #[error("it cannot be read: {0}")]
    Read(#[from] io::Error),
}
