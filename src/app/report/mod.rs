//! What a run leaves behind: results, tables, pages, pictures and exports.

pub mod export;
pub mod pages;
pub mod plotting;
pub mod results;
pub mod run_output;
pub mod run_page;
