//! `completions` and `man`, made from the command line's definition.

use anyhow::{Context as _, Result};
use clap::CommandFactory as _;
use clap_complete::Shell;

use crate::app::cli::Cli;

/// The completions of a shell.
pub fn completions(shell: Shell) -> Result<String> {
    let mut command = Cli::command();
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut command, "fpmcl", &mut text);
    Ok(String::from_utf8(text)?)
}

/// The manual page of the program or of one of its commands, in roff.
pub fn page(name: Option<&str>) -> Result<String> {
    let mut program = Cli::command();
    program.build();
    let command = match name {
        None => program,
        Some(name) => program
            .find_subcommand(name)
            .cloned()
            .with_context(|| format!("there is no command {name}; fpmcl --help lists them"))?,
    };
    let mut text = Vec::new();
    clap_mangen::Man::new(command).render(&mut text)?;
    Ok(String::from_utf8(text)?)
}
