//! The memory that the process may use: stages check an estimate before they allocate.
//!
//! Without [`set_budget`] there is no limit. Estimates stand at the calls of `require`; they are
//! upper bounds of what grows with a configuration or an input, not of everything.

use std::fs::File;
use std::io::{self, Read as _};
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};

/// Largest amount that a stage may need [bytes].
static BUDGET: AtomicU64 = AtomicU64::new(u64::MAX);

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

/// Sets the budget of the process [bytes].
pub fn set_budget(bytes: u64) {
    BUDGET.store(bytes, Ordering::Relaxed);
}

/// Requires that an estimate [bytes] is within the budget.
pub(crate) fn require(
    what: &'static str,
    bytes: f64,
    remedy: &'static str,
) -> Result<(), MemoryError> {
    let budget = BUDGET.load(Ordering::Relaxed) as f64;
    if bytes <= budget {
        return Ok(());
    }
    Err(MemoryError {
        what,
        needed_bytes: bytes,
        budget_bytes: budget,
        remedy,
    })
}

/// Reads a whole file within the budget, also one whose size is not known before, such as a pipe.
pub(crate) fn read_file(path: &Path) -> io::Result<Vec<u8>> {
    /// Memory for the content and what is made of it, in sizes of the file.
    const COPIES: u64 = 2;
    let file = File::open(path)?;
    let require = |bytes: u64| {
        let needed = COPIES.saturating_mul(bytes) as f64;
        require("the content of the file", needed, "give a smaller one")
            .map_err(|error| io::Error::new(io::ErrorKind::FileTooLarge, error))
    };
    let size = file.metadata()?.len();
    require(size)?;
    let limit = (BUDGET.load(Ordering::Relaxed) / COPIES).saturating_add(1);
    let mut bytes = Vec::new();
    bytes.try_reserve_exact(usize::try_from(size).unwrap_or(usize::MAX))?;
    file.take(limit).read_to_end(&mut bytes)?;
    require(bytes.len() as u64)?;
    Ok(bytes)
}

/// Reads a whole text file within the budget.
pub(crate) fn read_text(path: &Path) -> io::Result<String> {
    String::from_utf8(read_file(path)?)
        .map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error.utf8_error()))
}
