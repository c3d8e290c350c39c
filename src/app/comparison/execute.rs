//! Execution of runs.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context as _, Result};

use super::keys::{self, KeyCache, Keys};
use super::layout::Layout;
use super::plan::PlannedRun;
use super::record::{Outcome, RECORD_FILE, RunRecord};
use crate::app::commands::simulate::{self, Existing};
use crate::app::commands::{build_map, localize, refine};
use crate::app::report::run_output::{self, REFINEMENT_FILES};
use crate::app::report::run_page::RunPage;
use crate::app::report::{LocalizationResults, Report, RunFiles, TrajectoryReport};
use crate::app::run::artefact::{self, FINISHED_FILE, SharedResult};
use crate::app::run::{
    CLAIMS_FILE, Claims, Context, Interrupted, Lock, Outputs, machine, output, version,
};
use crate::app::settings::{BuildMapConfig, LocalizationConfig, RefinementConfig};
use crate::evaluation::trust::{Trust, TrustedRun};
use crate::evaluation::{EvaluatedTrajectory, RangeMclRules};
use crate::localization::State;
use crate::statistics::median;

const MAP_FILE: &str = "map.ply";
const RESULT_FILE: &str = "localization.npz";
const MAP_CONFIG_FILE: &str = "effective_build_map.yml";
const LOG_FILE: &str = "log.txt";

/// Executes runs, sharing maps and localizations between them.
pub struct Executor<'a> {
    layout: &'a Layout,
    context: &'a Context,
    keys: KeyCache,
}

impl<'a> Executor<'a> {
    /// An executor for the runs below an output folder.
    pub fn new(layout: &'a Layout, context: &'a Context) -> Self {
        let keys = KeyCache::default();
        Self {
            layout,
            context,
            keys,
        }
    }

    /// Returns the record of a run; executes the run unless it finished with the same key.
    pub fn finish(&mut self, run: &PlannedRun) -> Result<RunRecord> {
        let keys = self.keys(run)?;
        let folder = self.layout.run(&run.id);
        if let Some(record) = RunRecord::read(&folder)?
            && record.key == keys.run
            && record.metrics().is_some()
        {
            tracing::info!("{} is already finished", run.id);
            return Ok(record);
        }
        let record = self.execute(run, keys)?;
        output::write_json(&folder.join(RECORD_FILE), &record)?;
        Ok(record)
    }

    /// Simulates the drives of a run and builds its map; returns the folder of the map.
    pub fn prepare_map(&mut self, run: &PlannedRun) -> Result<PathBuf> {
        let keys = self.keys(run)?;
        self.simulate_drives(run)?;
        Ok(self.map(run, &keys)?.folder)
    }

    /// Keys of a run; an error after an interrupt.
    fn keys(&mut self, run: &PlannedRun) -> Result<Keys> {
        if self.context.interrupt.requested() {
            let kept = format!(
                "finished runs are kept in {}; run the same command again to resume",
                self.layout.root.display()
            );
            return Err(Interrupted { kept }.into());
        }
        let keys = self.keys.keys(run);
        keys.with_context(|| format!("while reading the inputs of {}", run.id))
    }

    /// Executes a run. Its previous record is removed first, since it does not describe the new
    /// files. A failure becomes the outcome; only an interrupt is an error.
    fn execute(&self, run: &PlannedRun, keys: Keys) -> Result<RunRecord> {
        let folder = self.layout.run(&run.id);
        prepare(
            &folder,
            [LOG_FILE, MAP_CONFIG_FILE].map(str::to_owned).to_vec(),
        )?;
        output::remove_if_exists(&folder.join(RECORD_FILE))?;
        let _log = self.context.log.write_to(&folder.join(LOG_FILE))?;
        let mut stages = Stages::default();
        let outcome = match self.run_stages(run, &keys, &mut stages) {
            Ok(report) => Outcome::Finished(Box::new(report)),
            Err(error) if error.is::<Interrupted>() => return Err(error),
            Err(error) => {
                tracing::error!("{error:#}");
                Outcome::Failed(format!("{error:#}"))
            }
        };
        let record = RunRecord {
            id: run.id.clone(),
            key: keys.run,
            settings: keys::settings_hash(run)?,
            program: version::program()?,
            machine: self.machine(stages.report.as_ref()),
            stage_seconds: stages.seconds,
            trust: match &outcome {
                Outcome::Finished(_) => trust(&folder.join(RESULT_FILE))?,
                Outcome::Failed(_) => None,
            },
            outcome,
        };
        if let Some(report) = &stages.report {
            RunPage {
                files: &RunFiles::new(&folder.join(RESULT_FILE)),
                title: &format!("Run {}", run.id),
                report,
                stage_seconds: &record.stage_seconds,
                machine: &record.machine,
            }
            .write()?;
        }
        Ok(record)
    }

    fn run_stages(
        &self,
        run: &PlannedRun,
        keys: &Keys,
        stages: &mut Stages,
    ) -> Result<TrajectoryReport> {
        let folder = self.layout.run(&run.id);
        let result = folder.join(RESULT_FILE);
        self.simulate_drives(run).context("while simulating")?;

        let map = self.map(run, keys).context("while building the map")?;
        stages.add("1 build-map", map.seconds);
        self.append_log(&map)?;
        copy_file(
            &map.folder.join("map.effective.yml"),
            &folder.join(MAP_CONFIG_FILE),
        )?;

        let localization = self
            .localization(run, keys, &map)
            .context("while localizing")?;
        stages.add("2 localize", localization.seconds);
        self.append_log(&localization)?;
        // An earlier run in this folder may have refined.
        prepare(&folder, names_to_copy(&localization.folder)?)?.remove(&REFINEMENT_FILES)?;
        copy_folder(&localization.folder, &folder)?;
        stages.report = Some(Report::read_json(&folder.join("report.json"))?);

        if let Some(refinement) = &run.refinement {
            let start = Instant::now();
            let mut config = RefinementConfig {
                result_file: result.clone().into(),
                ..refinement.clone()
            };
            config.map_input.map_file = map.folder.join(MAP_FILE).into();
            config.output.force = true;
            let report = refine::run(&config, self.context).context("while refining")?;
            stages.report = Some(report);
            stages.add("3 refine", start.elapsed().as_secs_f64());
        }
        evaluate(&result, run.refinement.is_some())
    }

    fn simulate_drives(&self, run: &PlannedRun) -> Result<()> {
        if run.drives.is_empty() {
            return Ok(());
        }
        let folder = self.layout.root.join("sequences");
        output::create_folder(&folder)?;
        let _lock = Lock::wait(&folder.join(format!("{}.lock", run.id.sequence)))?;
        for drive in &run.drives {
            simulate::run(drive, Existing::Renew, self.context)?;
        }
        Ok(())
    }

    fn map(&self, run: &PlannedRun, keys: &Keys) -> Result<SharedResult> {
        artefact::get_or_create(&self.layout.shared("maps"), &keys.map, |folder| {
            let _log = self.context.log.write_to(&folder.join(LOG_FILE))?;
            let mut config = BuildMapConfig {
                mesh_file: folder.join(MAP_FILE).into(),
                ..run.build_map.clone()
            };
            config.output.force = true;
            tracing::info!(
                "building the map of {}",
                config.recording.scan_folder.display()
            );
            build_map::run(&config, self.context).map(drop)
        })
    }

    fn localization(
        &self,
        run: &PlannedRun,
        keys: &Keys,
        map: &SharedResult,
    ) -> Result<SharedResult> {
        let shared = self.layout.shared("localizations");
        artefact::get_or_create(&shared, &keys.localization, |folder| {
            let _log = self.context.log.write_to(&folder.join(LOG_FILE))?;
            let mut config = LocalizationConfig {
                result_path: folder.join(RESULT_FILE).into(),
                save_result: true,
                ..run.localization.clone()
            };
            config.map_input.map_file = map.folder.join(MAP_FILE).into();
            config.output.force = true;
            localize::run(&config, self.context).map(drop)
        })
    }

    /// Appends the log of a shared stage to the log of the run.
    fn append_log(&self, stage: &SharedResult) -> Result<()> {
        self.context
            .log
            .clone()
            .append(&stage.folder.join(LOG_FILE))
    }

    /// Description of the machine for the record of a run.
    fn machine(&self, report: Option<&Report>) -> BTreeMap<String, String> {
        let renderer = report.and_then(|report| report.about.get("renderer").cloned());
        let mut properties = machine::properties(self.context.threads);
        properties.insert(
            "renderer".to_owned(),
            renderer.unwrap_or_else(|| "unknown".to_owned()),
        );
        properties
    }
}

/// Progress of a run: times of the finished stages, and the latest report.
#[derive(Default)]
struct Stages {
    seconds: BTreeMap<String, f64>,
    report: Option<Report>,
}

impl Stages {
    fn add(&mut self, stage: &str, seconds: f64) {
        self.seconds.insert(stage.to_owned(), seconds);
    }
}

/// Evaluates the final trajectory of a run, with the runtime of all stages per frame.
fn evaluate(result: &Path, is_refined: bool) -> Result<TrajectoryReport> {
    let results = LocalizationResults::read(result)?.into_truth_only();
    let (poses, in_space, covariances, refinement_s) = if is_refined {
        (
            results.refined,
            results.refined_in_space,
            results.refined_covariances,
            results.refine_runtimes_s,
        )
    } else {
        (
            results.estimates,
            results.estimates_in_space,
            results.covariances,
            None,
        )
    };
    let (poses, truth) = poses
        .zip(results.ground_truth)
        .with_context(|| format!("{} has no trajectory to evaluate", result.display()))?;
    let mut runtimes_s = results.runtimes_s;
    for (filter_s, refinement_s) in runtimes_s
        .iter_mut()
        .flatten()
        .zip(refinement_s.iter().flatten())
    {
        *filter_s += refinement_s;
    }
    let trajectory = EvaluatedTrajectory {
        estimates: &poses,
        ground_truth: &truth,
        times_s: results.times_s.as_deref(),
        runtimes_s: runtimes_s.as_deref(),
        trusted: None,
    };
    let in_space = in_space
        .as_deref()
        .zip(results.ground_truth_in_space.as_deref());
    let (covariances, rules) = (covariances.as_deref(), RangeMclRules::default());
    run_output::evaluate_trajectory(&trajectory, in_space, covariances, &rules)
}

/// Trust in the states of the filter; `None` where the result lacks what it needs.
fn trust(result: &Path) -> Result<Option<Trust>> {
    let results = LocalizationResults::read(result)?.into_truth_only();
    let columns = (results.estimates.as_deref())
        .zip(results.ground_truth.as_deref())
        .zip(results.covariances.as_deref())
        .zip(results.states.as_deref());
    let Some((((estimates, ground_truth), covariances), states)) = columns else {
        return Ok(None);
    };
    let is_tracking: Vec<bool> = (states.iter())
        .map(|&state| state == State::Tracking as u8)
        .collect();
    // Frames without times are a tenth of a second apart.
    let by_number = || (0..states.len()).map(|row| 0.1 * row as f64).collect();
    let mut trust = Trust::new(&TrustedRun {
        estimates,
        ground_truth,
        covariances,
        is_tracking: &is_tracking,
        times_s: &results.times_s.unwrap_or_else(by_number),
    });
    let searching = is_tracking
        .iter()
        .take_while(|&&tracking| !tracking)
        .count();
    let places = results.places.as_deref().unwrap_or_default();
    trust.places = median(places.iter().take(searching).copied());
    Ok(Some(trust))
}

/// Prepares the record of a run in its folder, and further files there.
fn prepare(folder: &Path, names: Vec<String>) -> Result<Claims> {
    let record = folder.join(RECORD_FILE);
    let outputs = Outputs {
        key: "output_folder",
        main: &record,
        magic: None,
        names,
        inputs: Vec::new(),
        force: true,
    };
    outputs.prepare()
}

/// Copies the content of a folder, except for [`FINISHED_FILE`], the log and the claims.
fn copy_folder(from: &Path, to: &Path) -> Result<()> {
    output::create_folder(to)?;
    for name in names_to_copy(from)? {
        let (from, to) = (from.join(&name), to.join(&name));
        if from.is_dir() {
            copy_folder(&from, &to)?;
        } else {
            copy_file(&from, &to)?;
        }
    }
    Ok(())
}

fn names_to_copy(folder: &Path) -> Result<Vec<String>> {
    let mut names = Vec::new();
    for entry in
        fs::read_dir(folder).with_context(|| format!("cannot read {}", folder.display()))?
    {
        let name = entry?.file_name().to_string_lossy().into_owned();
        if ![FINISHED_FILE, LOG_FILE, CLAIMS_FILE].contains(&&*name) {
            names.push(name);
        }
    }
    Ok(names)
}

fn copy_file(from: &Path, to: &Path) -> Result<()> {
    fs::copy(from, to)
        .map(drop)
        .with_context(|| format!("cannot copy {} to {}", from.display(), to.display()))
}
