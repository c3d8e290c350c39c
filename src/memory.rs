//! The memory that the process may use: stages check an estimate before they allocate.
//!
//! Without [`set_budget`] there is no limit. Estimates are beside the calls of [`require`]; they are
//! upper bounds of what grows with a configuration or an input, not of everything.

use std::sync::atomic::{AtomicU64, Ordering};

/// Largest amount that a stage may need [bytes].
static BUDGET: AtomicU64 = AtomicU64::new(u64::MAX);

const GIB: f64 = (1_u64 << 30) as f64;

/// A stage needs more memory than the budget.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "{what} would need {needed_gib:.1} GiB of memory, more than the budget of {budget_gib:.1} GiB; {remedy}, or raise the budget with --memory"
)]
pub struct MemoryError {
    /// What needs it.
    pub what: &'static str,
    /// Estimate [GiB].
    pub needed_gib: f64,
    /// Budget [GiB].
    pub budget_gib: f64,
    /// What to change.
    pub remedy: &'static str,
}

/// Sets the budget of the process [bytes].
pub fn set_budget(bytes: u64) {
    BUDGET.store(bytes, Ordering::Relaxed);
}

/// Requires that an estimate [bytes] is within the budget.
pub fn require(what: &'static str, bytes: f64, remedy: &'static str) -> Result<(), MemoryError> {
    let budget = BUDGET.load(Ordering::Relaxed) as f64;
    if bytes <= budget {
        return Ok(());
    }
    Err(MemoryError {
        what,
        needed_gib: bytes / GIB,
        budget_gib: budget / GIB,
        remedy,
    })
}
