//! The program around the library: command line, configuration files, comparison, plots, reports.

pub mod cli;
pub mod commands;
pub mod comparison;
pub mod config;
pub mod plotting;
pub mod reporting;
pub mod results;
