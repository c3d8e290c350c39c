//! What a command leaves behind: reports, results, tables, pages, pictures and exports.

// Of a run: localization, refinement, evaluation.
pub mod results;
pub mod run_output;
pub mod run_page;
// Of the other commands.
pub mod georeference;
pub mod ground;
pub mod map;
pub mod odometry;
// Forms.
pub mod export;
pub mod pages;
pub mod plotting;

pub use results::{LocalizationResults, Report, RunSummary, TrajectoryReport};
pub use run_output::RunFiles;

#[cfg(test)]
mod memory_tests;
