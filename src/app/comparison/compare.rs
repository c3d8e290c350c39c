//! `compare`: sequences × configurations × seeds, summarized in tables and a page; see
//! [`comparison`](crate::app::comparison).

use anyhow::{Context as _, Result, bail};
use clap::Args;

use super::{Executor, Layout, Outcome, PlannedRun, RunId, collect, planned_runs};
use crate::app::comparison::config::ComparisonConfig;
use crate::app::run::arguments::command_of_job;
use crate::app::run::{ConfigArgs, Context, Form, Printed, output};
use crate::app::settings::{self, CommandConfig as _};

/// Arguments of `compare`.
#[derive(Clone, Debug, Args)]
pub struct CompareArgs {
    /// Configuration and machine.
    #[command(flatten)]
    pub source: ConfigArgs,

    /// Print one independent command per run and exit.
    #[arg(long, group = "part")]
    pub list_jobs: bool,

    /// Build sequences and maps only, before runs are distributed.
    #[arg(long, group = "part")]
    pub prepare: bool,

    /// Execute one run only: SEQUENCE/CONFIGURATION/SEED.
    #[arg(long, value_name = "RUN", group = "part")]
    pub job: Option<RunId>,

    /// Write tables and pages of the finished runs only.
    #[arg(long, group = "part")]
    pub collect: bool,
}

/// Executes the missing runs, or the requested part of the work; returns what to print.
pub fn run(args: &CompareArgs, form: Form, context: &Context) -> Result<Printed> {
    let path = args.source.config.as_deref();
    let config: ComparisonConfig = settings::load(path, &args.source.settings)?;
    let context = &context.with_config_file(path, ComparisonConfig::PATH);
    let runs = planned_runs(&config)?;
    let layout = Layout {
        root: config.output_folder.to_path_buf(),
    };
    let mut executor = Executor::new(&layout, context);
    if args.list_jobs {
        Ok(Printed::text(job_commands(&runs)))
    } else if args.prepare {
        Ok(Printed::text(prepare(&runs, &mut executor)?))
    } else if let Some(id) = &args.job {
        Ok(Printed::text(run_one(&runs, id, &mut executor)?))
    } else if args.collect {
        collect(&config, &runs, &layout, context)
    } else {
        let failed = run_all(&runs, &mut executor)?;
        let tables = collect(&config, &runs, &layout, context)?;
        if failed.is_empty() {
            return Ok(tables);
        }
        output::print(&tables.in_form(form))?;
        bail!(
            "{} of {} runs failed: {}; see log.txt in the folder of each; run the same command to try them again",
            failed.len(),
            runs.len(),
            failed.join(", ")
        )
    }
}

/// One shell command per run, for the current folder: the command line of this process with
/// `--job` instead of `--list-jobs`.
fn job_commands(runs: &[PlannedRun]) -> String {
    let jobs = runs.iter().map(|run| format!("--job {}", run.id));
    jobs.map(|job| command_of_job(&job) + "\n").collect()
}

/// Simulates the drives and builds the maps; returns the folders of the maps.
fn prepare(runs: &[PlannedRun], executor: &mut Executor) -> Result<String> {
    let mut folders = String::new();
    for run in runs {
        let map = executor
            .prepare_map(run)
            .with_context(|| format!("while preparing {}", run.id))?;
        let line = format!("{}\n", map.display());
        if !folders.contains(&line) {
            folders.push_str(&line);
        }
    }
    Ok(folders)
}

fn run_one(runs: &[PlannedRun], id: &RunId, executor: &mut Executor) -> Result<String> {
    let run = runs.iter().find(|run| run.id == *id).with_context(|| {
        format!("there is no run {id} in this comparison; --list-jobs lists all of them")
    })?;
    match executor.finish(run)?.outcome {
        Outcome::Finished(report) => Ok(format!(
            "{id}: average positional error {:.4} m\n",
            report.metrics.position_m.mean
        )),
        Outcome::Failed(message) => bail!("{id} failed: {message}"),
    }
}

/// Executes all unfinished runs, also after a failure; returns the names of failed runs.
fn run_all(runs: &[PlannedRun], executor: &mut Executor) -> Result<Vec<String>> {
    let mut failed = Vec::new();
    for (index, run) in runs.iter().enumerate() {
        tracing::info!("run {} of {}: {}", index + 1, runs.len(), run.id);
        if let Outcome::Failed(message) = executor.finish(run)?.outcome {
            tracing::warn!("{} failed: {message}", run.id);
            failed.push(run.id.to_string());
        }
    }
    Ok(failed)
}
