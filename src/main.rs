//! The command line: parse, start logging, dispatch, exit code.

use std::process::ExitCode;

use clap::Parser as _;
use fpmcl::app::cli::Cli;
use fpmcl::app::commands::{self, Context};

fn main() -> ExitCode {
    let cli = Cli::parse();
    match run(&cli) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            commands::report(&error);
            commands::exit_code(&error)
        }
    }
}

fn run(cli: &Cli) -> anyhow::Result<()> {
    let context = Context::new(cli.level(), cli.command.machine())?;
    commands::run(&cli.command, &context)
}
