//! The subcommands: files, progress and pictures around the library.

// The subcommands, in the order of their use.
pub mod build_map;
mod compare;
mod demo;
mod doctor;
pub mod evaluate;
mod export;
pub mod ground;
mod info;
pub mod localize;
mod odometry;
pub mod refine;
pub mod simulate;
// Shared by them.
pub mod motion_source;
pub mod stages;
pub mod trajectory;

use std::io::Write as _;

use anyhow::anyhow;
use serde::Serialize;

use crate::app::cli::{Cli, Command, ConfigurationArgs, ConfiguredCommand, ExportArgs, RunArgs};
use crate::app::report::results::Report;
use crate::app::settings::{
    self, BuildMapConfig, CommandConfig, ComparisonConfig, ConfigError, EvaluationConfig,
    GroundCommandConfig, LocalizationConfig, OdometryCommandConfig, RefinementConfig,
};
use crate::simulation::SimulationConfig;

use crate::app::run::Context;
use crate::app::run::interrupt::Interrupted;
use crate::app::run::output::{self, Form, Printed};

/// Runs a command, and prints its output in a form.
pub fn run(command: &Command, form: Form, context: &Context) -> anyhow::Result<()> {
    output::print(&printed(command, context)?.in_form(form))
}

fn printed(command: &Command, context: &Context) -> anyhow::Result<Printed> {
    match command {
        Command::Info(args) => info::run(args),
        Command::BuildMap(args) => {
            let base = BuildMapConfig::default;
            let (config, context) = configured(&args.run, args.flags(), base, context)?;
            match args.part() {
                Some(part) => build_map::run_part(&config, part, &context),
                None => build_map::run(&config, &context)?.printed(),
            }
        }
        Command::Odometry(args) => {
            let base = OdometryCommandConfig::default;
            let (config, context) = configured(&args.run, args.flags(), base, context)?;
            odometry::run(&config, &context)
        }
        Command::Localize(args) => {
            let base = LocalizationConfig::default;
            let (config, context) = configured(&args.run, args.flags(), base, context)?;
            let log = args.mcap.as_ref();
            let log = log.map(|path| {
                ExportArgs::log_of(&config.result_path, &config.map_file, path, config.force)
            });
            if let Some(log) = &log {
                export::check(log, &context)?;
            }
            let report = localize::run(&config, &context)?;
            if let Some(log) = &log {
                export::run(log, &context)?;
            }
            of_report(&report)
        }
        Command::Refine(args) => {
            let base = || refine::base_config(args.run.source.input());
            let (config, context) = configured(&args.run, args.flags(), base, context)?;
            of_report(&refine::run(&config, &context)?)
        }
        Command::Evaluate(args) => {
            let base = EvaluationConfig::default;
            let (config, context) = configured(&args.run, args.flags(), base, context)?;
            of_report(&evaluate::run(&config, &context)?)
        }
        Command::Export(args) => export::run(args, context),
        Command::Simulate(args) => {
            let settings = with_flags::<SimulationConfig>(args, args.flags())?;
            let path = args.source.config.as_deref();
            let config: SimulationConfig = settings::load(path, &settings)?;
            let context = context.with_config_file(path, SimulationConfig::PATH);
            let existing = match args.force {
                true => simulate::Existing::Replace,
                false => simulate::Existing::Keep,
            };
            simulate::run(&config, existing, &context)
        }
        Command::Compare(args) => Ok(Printed::text(compare::run(args, context)?)),
        Command::Demo(args) => demo::run(args, context),
        Command::Ground(args) => ground::run(args, context),
        Command::Config(args) => configuration(args),
        Command::Doctor(args) => doctor::run(args, context),
        Command::Completions(args) => Ok(Printed::text(String::from_utf8(Cli::completions(
            args.shell,
        ))?)),
        Command::Man(args) => {
            let name = args.command.as_deref();
            let missing = || {
                anyhow!(
                    "there is no command {}; fpmcl --help lists all",
                    name.unwrap_or_default()
                )
            };
            let page = Cli::manual(name).ok_or_else(missing)??;
            Ok(Printed::text(String::from_utf8(page)?))
        }
    }
}

fn of_report(report: &Report) -> anyhow::Result<Printed> {
    Printed::parts(report.to_text(false), report.to_text(true)).with_json(report)
}

/// The configuration file of a command: the keys that people change, or all of them; in JSON, the defaults.
fn configuration(args: &ConfigurationArgs) -> anyhow::Result<Printed> {
    fn text<T: CommandConfig + Default + Serialize>(full: bool) -> anyhow::Result<Printed> {
        Printed::text(if full { T::FULL } else { T::SHORT }).with_json(&T::default())
    }
    match args.command {
        ConfiguredCommand::BuildMap => text::<BuildMapConfig>(args.full),
        ConfiguredCommand::Odometry => text::<OdometryCommandConfig>(args.full),
        ConfiguredCommand::Localize => text::<LocalizationConfig>(args.full),
        ConfiguredCommand::Refine => text::<RefinementConfig>(args.full),
        ConfiguredCommand::Evaluate => text::<EvaluationConfig>(args.full),
        ConfiguredCommand::Compare => text::<ComparisonConfig>(args.full),
        ConfiguredCommand::Simulate => text::<SimulationConfig>(args.full),
        ConfiguredCommand::Ground => text::<GroundCommandConfig>(args.full),
    }
}

/// Prints an error with its causes on standard error.
pub fn report(error: &anyhow::Error) {
    let text = format!("error: {}\n", format_error_chain(error));
    // There is nowhere to report that standard error is closed.
    let _ = std::io::stderr().write_all(text.as_bytes());
}

/// Exit code of a failed run: 130 if it was interrupted, as in shells, else 1; 2 is wrong usage.
pub fn exit_code(error: &anyhow::Error) -> u8 {
    if error.is::<Interrupted>() { 130 } else { 1 }
}

/// Loads the configuration of a command, and notes its file. Where the argument of the command is no
/// configuration, flags and settings change `base`.
fn configured<T: CommandConfig>(
    args: &RunArgs,
    flags: Vec<(String, String)>,
    base: impl FnOnce() -> T,
    context: &Context,
) -> Result<(T, Context), ConfigError> {
    let path = args.source.config_file();
    let settings = with_flags::<T>(args, flags)?;
    if args.source.input().is_some() {
        return Ok((settings::with_settings(base(), &settings)?, context.clone()));
    }
    let config = settings::load(path, &settings)?;
    Ok((config, context.with_config_file(path, T::PATH)))
}

/// The settings of a command; those of flags are the last, where the configuration has their keys.
fn with_flags<T: CommandConfig>(
    args: &RunArgs,
    flags: Vec<(String, String)>,
) -> Result<Vec<(String, String)>, ConfigError> {
    let mut settings = args.source.settings.clone();
    for (key, value) in flags {
        if settings::has_key::<T>(&key)? {
            settings.push((key, value));
        }
    }
    Ok(settings)
}

/// Formats an error and its causes, without repetitions.
pub fn format_error_chain(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let words = cause.to_string();
        if text.contains(&words) {
            continue;
        }
        text += match (text.is_empty(), cause.is::<std::io::Error>()) {
            (true, _) => "",
            // What the operating system reports, such as a full disk.
            (false, true) => ": ",
            (false, false) => "\n  because: ",
        };
        text += &words;
    }
    text
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;
    use crate::recording::RecordingError;

    fn loaded<T: CommandConfig>(arguments: &[&str]) -> T {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("own.yml");
        std::fs::write(&path, "").unwrap();
        let start = ["fpmcl", "localize", path.to_str().unwrap()];
        let Command::Localize(args) = Cli::parse_from(start.iter().chain(arguments)).command else {
            unreachable!("the command is localize")
        };
        let settings = with_flags::<T>(&args.run, args.flags()).unwrap();
        settings::load(args.run.source.config_file(), &settings).unwrap()
    }

    #[test]
    fn flags_override_settings_and_are_ignored_by_a_configuration_without_their_keys() {
        let arguments = ["--seed", "7", "--set", "n_scans=5", "--force"];
        let config: LocalizationConfig = loaded(&arguments);
        assert_eq!((config.seed, config.n_scans, config.force), (7, 5, true));
        let config: LocalizationConfig = loaded(&["--seed", "7", "--set", "seed=3"]);
        assert_eq!(config.seed, 7);
        let config: EvaluationConfig = loaded(&arguments);
        assert_eq!(config.n_scans, 5);
    }

    #[test]
    fn a_cause_is_printed_once() {
        let source = std::io::Error::new(std::io::ErrorKind::NotFound, "no such file");
        let error = anyhow::Error::new(RecordingError::Read {
            path: "poses.txt".into(),
            source,
        })
        .context("while building the map");
        assert_eq!(
            format_error_chain(&error),
            "while building the map\n  because: cannot read poses.txt: no such file"
        );
    }

    #[test]
    fn an_interrupted_run_has_an_exit_code_of_its_own() {
        let interrupted = anyhow::Error::new(Interrupted {
            kept: "12 scans are in results/map.ply".to_owned(),
        });
        assert_eq!(
            exit_code(&interrupted.context("while building the map")),
            130
        );
        assert_eq!(exit_code(&anyhow::anyhow!("else")), 1);
    }
}
