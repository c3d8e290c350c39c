//! One file per subcommand; each `run` reads as a paragraph.

// The subcommands, in the order of their use.
pub mod build_map;
mod demo;
mod doctor;
pub mod evaluate;
pub mod localize;
pub mod refine;
pub mod simulate;
// What they share.
pub mod interrupt;
mod logging;
mod odometry;
pub mod output;
pub mod progress;
mod run_output;
mod stages;

use std::io::Write as _;
use std::path::Path;
use std::process::ExitCode;

use anyhow::Context as _;
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::cli::{Command, ConfigArgs, MachineArgs, RunArgs, Verbosity};
use crate::config::{
    self, BuildMapConfig, Check, ConfigError, EvaluationConfig, LocalizationConfig,
    RefinementConfig,
};
use crate::rendering::backend::Backend;
use crate::simulation::SimulationConfig;
use interrupt::{Interrupt, Interrupted};
use progress::Progress;

/// What every command is given beside its configuration.
#[derive(Clone, Debug)]
pub struct Context {
    /// Threads that share the work.
    pub threads: usize,
    /// What renders the map.
    pub backend: Backend,
    /// How much is said on standard error.
    pub verbosity: Verbosity,
    /// Whether the user wants to stop.
    pub interrupt: Interrupt,
    /// How far the work has come, for the user to see.
    pub progress: Progress,
}

impl Context {
    /// Starts logging, the threads and the handling of Ctrl-C; once per process.
    pub fn new(verbosity: Verbosity, machine: MachineArgs) -> anyhow::Result<Self> {
        let progress = Progress::new(verbosity);
        logging::start(verbosity, &progress);
        let threads = machine.threads.map_or(0, usize::from);
        rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build_global()
            .context("starting the threads; choose fewer with --threads")?;
        Ok(Self {
            threads: rayon::current_num_threads(),
            backend: machine.backend.into(),
            verbosity,
            interrupt: Interrupt::install().context("listening for Ctrl-C")?,
            progress,
        })
    }
}

/// Runs a command.
pub fn run(command: &Command, context: &Context) -> anyhow::Result<()> {
    match command {
        Command::BuildMap(args) => {
            let config: BuildMapConfig = load_run(args, "config/build_map.yml")?;
            output::print(&build_map::run(&config, context)?.table())
        }
        Command::Localize(args) => {
            let config: LocalizationConfig = load_run(args, "config/localization.yml")?;
            output::print(&localize::run(&config, context)?.to_text())
        }
        Command::Refine(args) => {
            let config: RefinementConfig = load_run(args, "config/refinement.yml")?;
            output::print(&refine::run(&config, context)?.to_text())
        }
        Command::Evaluate(args) => {
            let config: EvaluationConfig = load(args, "config/evaluation.yml", &args.settings)?;
            output::print(&evaluate::run(&config)?.to_text())
        }
        Command::Simulate(args) => {
            // `force` is no key of a simulation.
            let settings = args.settings();
            let (force, settings): (Vec<_>, Vec<_>) =
                settings.into_iter().partition(|(key, _)| key == "force");
            let config: SimulationConfig = load(&args.source, "config/simulation.yml", &settings)?;
            output::print(&simulate::run_with_progress(
                &config,
                !force.is_empty(),
                context,
            )?)
        }
        Command::Demo(args) => output::print(&demo::run(args, context)?),
        Command::Doctor => doctor::run(context),
    }
}

/// Tells an error once, on standard error: what failed, then each cause that says more.
pub fn report(error: &anyhow::Error) {
    // Standard error may be closed; there is nowhere else to say so.
    let _ = std::io::stderr().write_all(told(error).as_bytes());
}

/// 130 for an interrupted run, as shells have it, else 1; 2 is wrong usage.
pub fn exit_code(error: &anyhow::Error) -> ExitCode {
    ExitCode::from(if error.is::<Interrupted>() { 130 } else { 1 })
}

/// Loads the configuration of a stage, with `--seed` and `--force`.
fn load_run<T>(args: &RunArgs, default_path: &str) -> Result<T, ConfigError>
where
    T: Check + Serialize + DeserializeOwned,
{
    load(&args.source, default_path, &args.settings())
}

fn load<T>(
    args: &ConfigArgs,
    default_path: &str,
    settings: &[(String, String)],
) -> Result<T, ConfigError>
where
    T: Check + Serialize + DeserializeOwned,
{
    config::load(args.config.as_deref(), Path::new(default_path), settings)
}

/// The chain of an error without what was said already.
fn told(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        if text.contains(&cause) {
            continue;
        }
        text.push_str(if text.is_empty() {
            "error: "
        } else {
            "  because: "
        });
        text.push_str(&cause);
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kitti::KittiError;

    #[test]
    fn a_cause_is_told_once() {
        let source = std::io::Error::new(std::io::ErrorKind::NotFound, "no such file");
        let error = anyhow::Error::new(KittiError::Read {
            path: "poses.txt".into(),
            source,
        })
        .context("while building the map");
        assert_eq!(
            told(&error),
            "error: while building the map\n  because: cannot read poses.txt: no such file\n"
        );
    }

    #[test]
    fn an_interrupted_run_has_an_exit_code_of_its_own() {
        let interrupted = anyhow::Error::new(Interrupted {
            kept: "12 scans are in results/map.ply".to_owned(),
        });
        assert_eq!(
            exit_code(&interrupted.context("while building the map")),
            ExitCode::from(130)
        );
        assert_eq!(exit_code(&anyhow::anyhow!("else")), ExitCode::from(1));
    }
}
