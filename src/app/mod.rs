//! The program around the library: command line, configuration files, comparison, plots, reports.

// Configuration.
pub mod settings;
// A run and its surroundings.
pub mod run;
// What a run leaves behind.
pub mod report;
// The commands.
mod commands;
// Many runs.
pub mod comparison;
// The command line, and what it prints for programs.
pub mod cli;
pub mod schemas;

use std::ffi::OsString;
use std::path::PathBuf;

use clap::Parser as _;

use cli::Cli;
use run::visible::visible_in_line;
use run::{Context, failure, output};

/// The program: parses a command line, whose first argument is the name of the program, starts logging, runs the
/// command, and reports its error; returns the exit code. Requests for help end the process.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> u8 {
    let arguments: Vec<OsString> = arguments.into_iter().collect();
    let cli = match Cli::try_parse_from(&arguments) {
        Ok(cli) => cli,
        Err(error) if error.use_stderr() => {
            // The same error, in which each argument is in one line.
            let shown = arguments
                .iter()
                .map(|it| visible_in_line(&it.to_string_lossy()).into_owned());
            failure::report_usage(&Cli::try_parse_from(shown).err().unwrap_or(error));
            return 2;
        }
        Err(help) => help.exit(),
    };
    let run = || {
        let context = Context::new(cli.level(), cli.command.machine())?;
        let printed = cli.command.run(cli.form(), &context)?;
        output::print(&printed.in_form(cli.form()))?;
        anyhow::Ok(printed.exit_code)
    };
    match run() {
        Ok(code) => code,
        Err(error) => {
            failure::report(&error, cli.command.option_of_poses());
            failure::exit_code(&error)
        }
    }
}

/// The program in a library of another program, such as an interpreter, whose file is given: results are reused only by the
/// code that made them.
pub fn main_of_library(arguments: impl IntoIterator<Item = OsString>, library: PathBuf) -> u8 {
    run::version::set_library(library);
    main(arguments)
}
