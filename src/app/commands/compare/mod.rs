//! `compare`: sequences x configurations x seeds, measured and told in tables.
//!
//! ```text
//! comparison.yml
//!   | plan        every run with its effective configurations; overrides in the order
//!   |             defaults <- base <- sequence <- configuration <- seed
//!   v
//! sequences/NAME/drive_1, drive_2          what is simulated
//!   | fingerprint what a stage depends on: configuration without paths, inputs, source (BLAKE3)
//!   v
//! shared/maps/KEY/map.ply                  one per ground method, whoever asks
//! shared/localizations/KEY/...             one per map, filter and seed: refined runs start from it
//!   | execute     one run after another; each uses all threads
//!   v
//! runs/SEQUENCE/CONFIGURATION/SEED/        build_map.yml localization.yml refinement.yml log.txt
//!   |                                      localization.npz report.html plots/ ... and last run.json
//!   | collect     whatever is there
//!   v
//! report.html tables.txt tables.md comparison.json TABLE.csv plots/
//! ```
//!
//! A run whose `run.json` has the key that it would have now is not run again, so an interrupted
//! comparison goes on where it was. What is shared is made under a lock of the file system: runs of
//! one comparison may be processes of their own, on one machine or on many.

mod collect;
mod execute;
mod fingerprint;
mod jobs;
mod page;
mod pictures;
mod plan;
mod shared;

use std::path::PathBuf;

use anyhow::{Context as _, Result, bail, ensure};

use self::fingerprint::Fingerprints;
use self::plan::PlannedRun;
use super::interrupt::Interrupted;
use super::{Context, output};
use crate::app::cli::CompareArgs;
use crate::app::comparison::{Outcome, RunId, RunRecord};
use crate::app::config::{self, ComparisonConfig};

/// Where everything of a comparison lies.
#[derive(Clone, Debug)]
struct Layout {
    root: PathBuf,
}

impl Layout {
    fn run(&self, id: &RunId) -> PathBuf {
        self.root.join("runs").join(id.to_string())
    }

    fn shared(&self, what: &str) -> PathBuf {
        self.root.join("shared").join(what)
    }
}

/// Runs what is missing, or a part of it, and returns what belongs on standard output.
pub fn run(args: &CompareArgs, context: &Context) -> Result<String> {
    let path = args.source.config.as_deref();
    let config: ComparisonConfig = config::load(path, &args.source.settings)?;
    let runs = plan::runs(&config)?;
    let layout = Layout {
        root: config.output_folder.clone(),
    };
    if args.list_jobs {
        return Ok(jobs::lines(&runs, args));
    }
    if args.collect {
        return collect::collect(&config, &runs, &layout);
    }
    if let Some(id) = &args.job {
        return run_one(&runs, id, &layout, context);
    }
    if args.prepare {
        return prepare(&runs, &layout, context);
    }
    run_all(&runs, &layout, context)?;
    let told = collect::collect(&config, &runs, &layout)?;
    failures(&runs, &layout, &told)?;
    Ok(told)
}

/// Makes sequences and maps, and nothing else.
fn prepare(runs: &[PlannedRun], layout: &Layout, context: &Context) -> Result<String> {
    let mut fingerprints = Fingerprints::default();
    let mut told = String::new();
    for run in runs {
        stop_if_asked(layout, context)?;
        let map = execute::map_of(run, layout, &mut fingerprints, context)
            .with_context(|| format!("while preparing {}", run.id))?;
        let line = format!("{}\n", map.folder.display());
        if !told.contains(&line) {
            told.push_str(&line);
        }
    }
    Ok(told)
}

/// Runs all that is not finished; a run that fails is recorded, and the others go on.
fn run_all(runs: &[PlannedRun], layout: &Layout, context: &Context) -> Result<()> {
    let mut fingerprints = Fingerprints::default();
    for (index, run) in runs.iter().enumerate() {
        stop_if_asked(layout, context)?;
        let progress = format!("{} of {}", index + 1, runs.len());
        let (record, is_new) = finish(run, layout, &mut fingerprints, context)?;
        let state = if is_new { "" } else { ", there already" };
        match &record.outcome {
            Outcome::Finished(_) => tracing::info!("run {progress}: {}{state}", run.id),
            Outcome::Failed(why) => tracing::warn!("run {progress}: {} failed: {why}", run.id),
        }
    }
    Ok(())
}

fn run_one(runs: &[PlannedRun], id: &RunId, layout: &Layout, context: &Context) -> Result<String> {
    let run = runs.iter().find(|run| run.id == *id).with_context(|| {
        format!("there is no run {id} in this comparison; --list-jobs shows all of them")
    })?;
    let (record, is_new) = finish(run, layout, &mut Fingerprints::default(), context)?;
    let state = if is_new { "" } else { " (there already)" };
    match &record.outcome {
        Outcome::Finished(judgement) => Ok(format!(
            "{id}: average positional error {:.4} m{state}\n",
            judgement.metrics.position_m.mean
        )),
        Outcome::Failed(why) => bail!("{id} failed: {why}"),
    }
}

/// The record of a run, which is executed if it is not there; whether it was.
fn finish(
    run: &PlannedRun,
    layout: &Layout,
    fingerprints: &mut Fingerprints,
    context: &Context,
) -> Result<(RunRecord, bool)> {
    let key = fingerprints
        .of(run)
        .with_context(|| format!("while looking at the inputs of {}", run.id))?
        .run;
    let folder = layout.run(&run.id);
    let found = execute::read_record(&folder)?;
    let found = found.filter(|record| record.key == key && record.judgement().is_some());
    if let Some(record) = found {
        return Ok((record, false));
    }
    let record = execute::execute(run, layout, fingerprints, context)?;
    output::write_json(&folder.join(execute::RECORD_FILE), &record)?;
    Ok((record, true))
}

fn stop_if_asked(layout: &Layout, context: &Context) -> Result<()> {
    if context.interrupt.requested() {
        let kept = format!(
            "what is finished is kept in {}; run the same command again to go on from there",
            layout.root.display()
        );
        return Err(Interrupted { kept }.into());
    }
    Ok(())
}

/// An error if runs have failed; the tables are written by then.
fn failures(runs: &[PlannedRun], layout: &Layout, told: &str) -> Result<()> {
    let mut failed = Vec::new();
    for run in runs {
        let record = execute::read_record(&layout.run(&run.id))?;
        if record.is_some_and(|record| record.judgement().is_none()) {
            failed.push(run.id.to_string());
        }
    }
    if !failed.is_empty() {
        output::print(told)?;
    }
    ensure!(
        failed.is_empty(),
        "{} of {} runs failed: {}; log.txt in the folder of each says why, and the same command tries them again",
        failed.len(),
        runs.len(),
        failed.join(", ")
    );
    Ok(())
}
