//! The memory that the stages of a command may use.

use std::sync::OnceLock;

use crate::memory::MemoryBudget;

static BUDGET: OnceLock<MemoryBudget> = OnceLock::new();

/// Sets the budget of this process, once.
pub(super) fn set(budget: MemoryBudget) {
    BUDGET.get_or_init(|| budget);
}

/// The budget of this process: that of `--memory`.
pub fn budget() -> MemoryBudget {
    BUDGET.get().copied().unwrap_or_default()
}
