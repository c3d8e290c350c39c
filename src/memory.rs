//! The memory that a stage may use: it checks an estimate against a budget before it allocates.
//!
//! Estimates stand at the calls of `require`; they are upper bounds of what grows with a configuration or an input, not
//! of everything.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::Path;

/// Largest amount of memory that a stage may need; by default, there is no limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct MemoryBudget {
    /// Its size [bytes].
    pub bytes: u64,
}

impl Default for MemoryBudget {
    fn default() -> Self {
        Self { bytes: u64::MAX }
    }
}

/// A stage needs more memory than the budget.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error(
    "{what} would need {} of memory, more than the budget of {}; {remedy}, or raise the budget",
    amount(*needed_bytes), amount(*budget_bytes)
)]
pub struct MemoryError {
    /// What needs it.
    pub what: &'static str,
    /// Estimate [bytes].
    pub needed_bytes: f64,
    /// Budget [bytes].
    pub budget_bytes: f64,
    /// What to change.
    pub remedy: &'static str,
}

/// Words for an amount of memory.
fn amount(bytes: f64) -> String {
    const MIB: f64 = (1_u64 << 20) as f64;
    match bytes / MIB {
        mib if mib < 1024.0 => format!("{mib:.1} MiB"),
        mib => format!("{:.1} GiB", mib / 1024.0),
    }
}

impl MemoryBudget {
    /// Requires that an estimate [bytes] is within the budget.
    pub(crate) fn require(
        self,
        what: &'static str,
        bytes: f64,
        remedy: &'static str,
    ) -> Result<(), MemoryError> {
        let budget_bytes = self.bytes as f64;
        if bytes <= budget_bytes {
            return Ok(());
        }
        Err(MemoryError {
            what,
            needed_bytes: bytes,
            budget_bytes,
            remedy,
        })
    }
}

/// Largest content of a file that does not know its size, such as a pipe [bytes].
const LARGEST_STREAM: u64 = 256 << 20;

/// Reads a whole file; of one that does not know its size, such as a pipe, at most [`LARGEST_STREAM`].
pub(crate) fn read_file(path: &Path) -> io::Result<Vec<u8>> {
    let file = File::open(path)?;
    let size = file.metadata()?.len();
    let mut bytes = Vec::new();
    bytes.try_reserve_exact(usize::try_from(size).unwrap_or(usize::MAX))?;
    let largest = size.max(LARGEST_STREAM);
    file.take(largest + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > largest {
        let text = format!("it has no end within {}", amount(largest as f64));
        return Err(io::Error::new(io::ErrorKind::FileTooLarge, text));
    }
    Ok(bytes)
}

/// Reads a whole text file.
pub(crate) fn read_text(path: &Path) -> io::Result<String> {
    text_of(read_file(path)?)
}

/// The bytes of a file as text.
pub(crate) fn text_of(bytes: Vec<u8>) -> io::Result<String> {
    String::from_utf8(bytes)
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error.utf8_error()))
}
