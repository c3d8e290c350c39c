//! A build as independent jobs, one per local map, on any number of machines that share the folder of the map.

use std::fmt::Write as _;

use anyhow::{Result, bail};

use super::local_maps;
use super::opened::{Opened, open};
use super::parts::Role;
use crate::app::run::{Context, Printed};
use crate::app::settings::BuildMapConfig;

/// One shell command per local map that is not finished, for the current folder: the command line of this process with
/// `--job` instead of `--list-jobs`. The poses are found first.
pub fn list(config: &BuildMapConfig, context: &Context) -> Result<Printed> {
    let (opened, _claims) = open(config, Role::Build, context)?;
    let words = std::env::args_os().map(|word| word.to_string_lossy().into_owned());
    let command = shell_words::join(words.filter(|word| word != "--list-jobs"));
    let mut commands = String::new();
    for number in missing(&opened) {
        writeln!(commands, "{command} --job {number}")?;
    }
    Ok(Printed::text(commands))
}

/// Builds a local map by its number.
pub fn build(config: &BuildMapConfig, number: usize, context: &Context) -> Result<Printed> {
    let (opened, _claims) = open(config, Role::Job, context)?;
    let (counts, count) = local_maps::build_one(&opened, number, context)?;
    let triangles = counts.triangles;
    Ok(Printed::text(format!(
        "local map {number} (0 to {}): {triangles} triangles\n",
        count - 1
    )))
}

/// Requires that all local maps are finished where they are collected.
pub fn require_all(opened: &Opened, role: Role) -> Result<()> {
    let missing = missing(opened);
    if role != Role::Collect || missing.is_empty() {
        return Ok(());
    }
    let names: Vec<String> = missing.iter().map(usize::to_string).collect();
    bail!(
        "local maps {} are not finished: run their jobs (--list-jobs lists them), or leave out --collect to build them here",
        names.join(", ")
    )
}

/// Numbers of the local maps that are not finished.
fn missing(opened: &Opened) -> Vec<usize> {
    let planned = opened.local_maps();
    let numbers = planned.iter().map(|local_map| local_map.number);
    numbers
        .filter(|&number| !opened.parts.has(number))
        .collect()
}
