//! One run: its drives, its map, its localization, and what it does with them.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::io;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context as _, Result};

use super::Layout;
use super::fingerprint::{self, Fingerprints, Keys};
use super::plan::PlannedRun;
use super::shared::{self, Shared};
use crate::app::commands::interrupt::Interrupted;
use crate::app::commands::run_output::{self, RunFiles};
use crate::app::commands::run_page::RunPage;
use crate::app::commands::simulate::{self, Existing};
use crate::app::commands::{Context, build_map, localize, refine, version};
use crate::app::comparison::{Outcome, RunRecord};
use crate::app::config::{self, BuildMapConfig, LocalizationConfig, RefinementConfig};
use crate::app::results::{LocalizationResults, Report, TrajectoryReport};
use crate::evaluation::{EvaluatedTrajectory, RangeMclRules};

/// Name of a run's record, written last.
pub const RECORD_FILE: &str = "run.json";

/// What a run has from its configuration, the same in every run.
const MAP_FILE: &str = "map.ply";
const RESULT_FILE: &str = "localization.npz";
const LOG_FILE: &str = "log.txt";

/// The record of a run; `None` where there is none, or one of another version of the program.
pub fn read_record(folder: &Path) -> Result<Option<RunRecord>> {
    let path = folder.join(RECORD_FILE);
    if !path.exists() {
        return Ok(None);
    }
    let text =
        fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
    match serde_json::from_str(&text) {
        Ok(record) => Ok(Some(record)),
        Err(error) => {
            tracing::warn!("{} is passed over: {error}", path.display());
            Ok(None)
        }
    }
}

fn remove_record(folder: &Path) -> Result<()> {
    let path = folder.join(RECORD_FILE);
    match fs::remove_file(&path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(error).with_context(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}

/// Does a run, whose record, if there is one, is removed first: numbers of before never stand beside
/// what it makes. A failure is its outcome; only an interruption is an error.
pub fn execute(
    run: &PlannedRun,
    layout: &Layout,
    fingerprints: &mut Fingerprints,
    context: &Context,
) -> Result<RunRecord> {
    let keys = fingerprints.of(run)?;
    let folder = layout.run(&run.id);
    fs::create_dir_all(&folder).with_context(|| format!("cannot create {}", folder.display()))?;
    remove_record(&folder)?;
    let _log = context.log.write_to(&folder.join(LOG_FILE))?;
    let mut stages = Stages::default();
    let outcome = match stages.run(run, layout, &keys, context) {
        Ok(judgement) => Outcome::Finished(Box::new(judgement)),
        Err(error) if error.is::<Interrupted>() => return Err(error),
        Err(error) => {
            tracing::error!("{error:#}");
            Outcome::Failed(format!("{error:#}"))
        }
    };
    let record = RunRecord {
        id: run.id.clone(),
        key: keys.run,
        settings: fingerprint::settings_of(run)?,
        program: version::program()?,
        machine: machine(context, &stages),
        stage_seconds: stages.seconds,
        outcome,
    };
    if let Some(report) = &stages.report {
        RunPage {
            files: &RunFiles::beside(&folder.join(RESULT_FILE)),
            title: &format!("Run {}", run.id),
            report,
            stage_seconds: &record.stage_seconds,
            machine: &record.machine,
        }
        .write()?;
    }
    Ok(record)
}

/// The map of a run, which is built if it is not there; the drive before it.
pub fn map_of(
    run: &PlannedRun,
    layout: &Layout,
    fingerprints: &mut Fingerprints,
    context: &Context,
) -> Result<Shared> {
    let keys = fingerprints.of(run)?;
    simulate_drives(run, layout, context)?;
    shared_map(run, layout, &keys, context)
}

/// What was done so far.
#[derive(Default)]
struct Stages {
    seconds: BTreeMap<String, f64>,
    report: Option<Report>,
}

impl Stages {
    fn run(
        &mut self,
        run: &PlannedRun,
        layout: &Layout,
        keys: &Keys,
        context: &Context,
    ) -> Result<TrajectoryReport> {
        let folder = layout.run(&run.id);
        simulate_drives(run, layout, context).context("while simulating")?;
        let map = shared_map(run, layout, keys, context).context("while building the map")?;
        self.note("1 build-map", map.seconds);
        context.log.clone().append(&map.folder.join(LOG_FILE))?;
        copy_file(&map.folder.join("map.yml"), &folder.join("build_map.yml"))?;

        let found =
            shared_localization(run, layout, keys, &map, context).context("while localizing")?;
        self.note("2 localize", found.seconds);
        context.log.clone().append(&found.folder.join(LOG_FILE))?;
        let result = folder.join(RESULT_FILE);
        // Another run of this name may have refined.
        run_output::remove_refined(&RunFiles::beside(&result))?;
        copy_all(&found.folder, &folder)?;
        self.report = Some(Report::read_json(&folder.join("report.json"))?);

        if let Some(refinement) = &run.refinement {
            let started = Instant::now();
            let config = RefinementConfig {
                map_file: map.folder.join(MAP_FILE),
                result_file: result.clone(),
                force: true,
                ..refinement.clone()
            };
            self.report = Some(refine::run(&config, context).context("while refining")?);
            self.note("3 refine", started.elapsed().as_secs_f64());
        }
        judgement(&result, run.refinement.is_some())
    }

    fn note(&mut self, stage: &str, seconds: f64) {
        self.seconds.insert(stage.to_owned(), seconds);
    }
}

fn simulate_drives(run: &PlannedRun, layout: &Layout, context: &Context) -> Result<()> {
    let Some(drives) = &run.drives else {
        return Ok(());
    };
    let folder = layout.root.join("sequences");
    let _alone = shared::lock(&folder, &run.id.sequence)?;
    for drive in drives {
        simulate::run(drive, Existing::Renew, context)?;
    }
    Ok(())
}

fn shared_map(run: &PlannedRun, layout: &Layout, keys: &Keys, context: &Context) -> Result<Shared> {
    shared::get(&layout.shared("maps"), &keys.map, |folder| {
        let _log = context.log.write_to(&folder.join(LOG_FILE))?;
        tracing::info!(
            "building the map of {}",
            run.build_map.scan_folder.display()
        );
        let config = BuildMapConfig {
            mesh_file: folder.join(MAP_FILE),
            force: true,
            ..run.build_map.clone()
        };
        build_map::run(&config, context).map(drop)
    })
}

fn shared_localization(
    run: &PlannedRun,
    layout: &Layout,
    keys: &Keys,
    map: &Shared,
    context: &Context,
) -> Result<Shared> {
    shared::get(
        &layout.shared("localizations"),
        &keys.localization,
        |folder| {
            let _log = context.log.write_to(&folder.join(LOG_FILE))?;
            let config = LocalizationConfig {
                map_file: map.folder.join(MAP_FILE),
                result_path: folder.join(RESULT_FILE),
                save_result: true,
                force: true,
                ..run.localization.clone()
            };
            localize::run(&config, context).map(drop)
        },
    )
}

/// The judgement of the trajectory that the configuration ends with, with all the time that was
/// spent on a frame.
fn judgement(result: &Path, is_refined: bool) -> Result<TrajectoryReport> {
    let results = LocalizationResults::read(result)?;
    let poses = if is_refined {
        results.refined.as_deref()
    } else {
        results.estimates.as_deref()
    };
    let (poses, truth) = poses
        .zip(results.ground_truth.as_deref())
        .with_context(|| format!("{} has no trajectory to judge", result.display()))?;
    let refining = results.refine_runtimes_s.as_deref().filter(|_| is_refined);
    let runtimes_s: Option<Vec<f64>> = results.runtimes_s.as_deref().map(|filtering| {
        let refining = |row| refining.map_or(0.0, |times: &[f64]| times[row]);
        (0..filtering.len())
            .map(|row| filtering[row] + refining(row))
            .collect()
    });
    let trajectory = EvaluatedTrajectory {
        estimates: poses,
        ground_truth: truth,
        times_s: results.times_s.as_deref(),
        runtimes_s: runtimes_s.as_deref(),
    };
    run_output::evaluate_trajectory(&trajectory, &RangeMclRules::default())
}

/// What the run was done on, for its record.
fn machine(context: &Context, stages: &Stages) -> BTreeMap<String, String> {
    let renderer = stages
        .report
        .as_ref()
        .and_then(|report| report.about.get("renderer").cloned());
    [
        ("processor", processor()),
        ("threads", context.threads.to_string()),
        (
            "system",
            format!("{} {}", std::env::consts::OS, std::env::consts::ARCH),
        ),
        ("renderer", renderer.unwrap_or_else(|| "unknown".to_owned())),
    ]
    .map(|(key, value)| (key.to_owned(), value))
    .into()
}

/// Name of the processor, where the system tells it.
fn processor() -> String {
    let told = fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = told.lines().find_map(|line| {
        let (key, value) = line.split_once(':')?;
        (key.trim() == "model name").then(|| value.trim().to_owned())
    });
    name.unwrap_or_else(|| "unknown".to_owned())
}

/// Copies a folder with what is in it, but for the mark that it is finished and its log.
fn copy_all(from: &Path, to: &Path) -> Result<()> {
    fs::create_dir_all(to).with_context(|| format!("cannot create {}", to.display()))?;
    for entry in fs::read_dir(from).with_context(|| format!("cannot read {}", from.display()))? {
        let path = entry?.path();
        let is_own = |name: &&OsStr| **name != *shared::MARK && **name != *LOG_FILE;
        let Some(name) = path.file_name().filter(is_own) else {
            continue;
        };
        if path.is_dir() {
            copy_all(&path, &to.join(name))?;
        } else {
            copy_file(&path, &to.join(name))?;
        }
    }
    Ok(())
}

fn copy_file(from: &Path, to: &Path) -> Result<()> {
    fs::copy(from, to)
        .with_context(|| format!("cannot copy {} to {}", from.display(), to.display()))?;
    Ok(())
}

/// The effective configuration of the comparison beside what it made.
pub fn write_config(config: &crate::app::config::ComparisonConfig, layout: &Layout) -> Result<()> {
    Ok(config::write(&layout.root.join("comparison.yml"), config)?)
}
