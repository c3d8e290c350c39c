//! The program around the library: command line, configuration files, comparison, plots, reports.

pub mod cli;
pub mod commands;
pub mod comparison;
pub mod report;
pub mod run;
pub mod settings;

use std::ffi::OsString;

use clap::Parser as _;

use cli::Cli;
use run::Context;

/// The program: parses a command line, whose first argument is the name of the program, starts logging, runs the
/// command, and reports its error; returns the exit code. Wrong usage and requests for help end the process.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    let cli = Cli::parse_from(arguments);
    let run = || {
        let context = Context::new(cli.level(), cli.command.machine())?;
        commands::run(&cli.command, cli.form(), &context)
    };
    match run() {
        Ok(()) => 0,
        Err(error) => {
            commands::report(&error);
            commands::exit_code(&error)
        }
    }
}
