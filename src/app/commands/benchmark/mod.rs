//! `benchmark`: odometry, map and localization of a public sequence, next to published figures.
//!
//! ```text
//! odometry      the first session by its scans alone, compared with its truth by KITTI's rules
//! map           of the first session, at its true poses where there are any; without a second session, of every other scan
//! localization  of the second session, or of the other scans, and refined
//! ```
//!
//! Each stage has a folder `stages/KEY`, whose key is a hash of its configuration, of the scans and poses that it reads and of
//! the program: what is finished is used again.

mod figures;
mod page;
mod published;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use clap::Args;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Value, json};

pub use self::figures::BenchmarkReport;
use self::figures::OdometryFigures;
use super::evaluate::NoRigidAlignment;
use super::stages::{RecordingInputs, path_value, settings_of};
use super::{build_map, evaluate, localize, odometry, refine};
use crate::app::report::{Report, RunFiles};
use crate::app::run::artefact::hash::{hash_of_file, hash_of_recording, hash_of_texts};
use crate::app::run::artefact::{self, SharedResult};
use crate::app::run::{Context, Form, MachineArgs, Outputs, Printed, machine, output, version};
use crate::app::settings::{
    self, BuildMapConfig, EvaluationConfig, LocalizationConfig, OdometryCommandConfig,
    PoseInputConfig, RecordingConfig,
};
use crate::configuration::Configuration;
use crate::evaluation::Alignment;
use crate::file_path::FilePath;
use crate::recording::Layout;

/// Arguments of `benchmark`.
#[derive(Clone, Debug, Args)]
pub struct BenchmarkArgs {
    /// Layout of the data set, such as kitti, mulran or helipr; auto: as its files show.
    #[arg(value_name = "LAYOUT", value_parser = layout)]
    pub layout: LayoutArg,

    /// The sequence.
    #[arg(value_name = "FOLDER")]
    pub recording: FilePath,

    /// Another session of the place, which is localized in the map of the first; by default every other scan of the first.
    #[arg(long, value_name = "FOLDER")]
    pub second: Option<FilePath>,

    /// Lidar or scene, where the folder has several, or topic of a bag.
    #[arg(long, value_name = "NAME")]
    pub topic: Option<String>,

    /// The same of the second session; by default that of the first.
    #[arg(long, value_name = "NAME")]
    pub second_topic: Option<String>,

    /// True poses of the sequence; by default those of its layout.
    #[arg(long, value_name = "FILE")]
    pub truth: Option<FilePath>,

    /// True poses of the second session; by default those of its layout.
    #[arg(long, value_name = "FILE")]
    pub second_truth: Option<FilePath>,

    /// Calibration of the camera, if true poses that are given are those of a camera.
    #[arg(long = "calib", value_name = "FILE")]
    pub calibration: Option<FilePath>,

    /// Output folder.
    #[arg(long, value_name = "FOLDER", default_value = "results/benchmark")]
    pub output: FilePath,

    /// Value of a key of any stage that has it; repeatable.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = crate::app::run::arguments::settings_parser())]
    pub settings: Vec<(String, String)>,

    /// Seed of all random choices.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,

    /// Renderer and threads.
    #[command(flatten)]
    pub machine: MachineArgs,
}

impl BenchmarkArgs {
    /// Requires that each key of `--set` is one of some stage.
    fn require_known_keys(&self) -> Result<()> {
        for (key, _) in &self.settings {
            let is_known = settings::has_key::<OdometryCommandConfig>(key)?
                || settings::has_key::<BuildMapConfig>(key)?
                || settings::has_key::<LocalizationConfig>(key)?
                || settings::has_key::<EvaluationConfig>(key)?;
            ensure!(
                is_known,
                "--set {key}: none of odometry, build-map, localize and evaluate has this key; `fpmcl config localize --full` prints the keys of localize, and so for the others"
            );
        }
        Ok(())
    }
}

/// A layout that was named; `None`: as the files show.
#[derive(Clone, Copy, Debug)]
pub struct LayoutArg(pub Option<Layout>);

fn layout(name: &str) -> Result<LayoutArg, String> {
    match name {
        "auto" => Ok(LayoutArg(None)),
        name => {
            let layout: Result<Layout, _> = name.parse();
            let layout =
                layout.map_err(|error| format!("{error}; `auto` finds it by the files"))?;
            Ok(LayoutArg(Some(layout)))
        }
    }
}

/// A session: its recording, and the file of its true poses.
struct Session {
    recording: RecordingConfig,
    layout: Layout,
    truth: Option<PathBuf>,
    calibration: Option<PathBuf>,
    /// Hash of the scans, their times and the true poses.
    content: String,
}

/// Runs the stages that are not finished, and writes the page and the file of figures.
pub fn run(args: &BenchmarkArgs, context: &Context) -> Result<Printed> {
    let main = args.output.join("benchmark.json");
    let mut claims = Outputs {
        key: "output",
        main: &main,
        magic: None,
        names: ["benchmark.html", "stages"].map(str::to_owned).into(),
        inputs: vec![("recording", &args.recording)],
        force: true,
    }
    .prepare()?;
    args.require_known_keys()?;
    let first = Session::open(args, &args.recording, &args.topic, args.truth.as_deref())?;
    let second = match &args.second {
        Some(folder) => {
            let topic = args.second_topic.clone().or(args.topic.clone());
            Some(Session::open(
                args,
                folder,
                &topic,
                args.second_truth.as_deref(),
            )?)
        }
        None => None,
    };
    let benchmark = Benchmark { args, context };
    let mut stage_seconds = BTreeMap::new();
    let mut time = |name: &str, stage: &SharedResult| {
        stage_seconds.insert(name.to_owned(), stage.seconds);
    };
    let odometry = benchmark.odometry(&first)?;
    time("1 odometry", &odometry);
    let map = benchmark.map(&first, second.is_some())?;
    time("2 map", &map);
    let located = second.as_ref().unwrap_or(&first);
    let localization = benchmark.localization(located, second.is_some(), &map.folder)?;
    time("3 localization", &localization);
    let aligned = localization.folder.join(ALIGNED).join("report.json");
    let localized = Report::read_json(&localization.folder.join("report.json"))?;
    let mut machine = machine::properties(context.threads);
    let renderer = localized.about.get("renderer");
    machine.extend(renderer.map(|name| ("renderer".to_owned(), name.clone())));
    let report = BenchmarkReport {
        layout: first.layout.name().to_owned(),
        recording: args.recording.clone(),
        second: args.second.clone(),
        program: version::program()?,
        machine,
        stage_seconds,
        odometry: read_json(&odometry.folder.join(FIGURES))?,
        map: read_json(&map.folder.join(MAP_REPORT))?,
        localization: localized,
        localization_aligned: (aligned.exists())
            .then(|| Report::read_json(&aligned))
            .transpose()?,
        published: published::PUBLISHED.to_vec(),
    };
    claims.begin(&main)?;
    let files = RunFiles::new(&localization.folder.join(RESULT));
    let page = page::page(&report, &map.folder.join(MAP).with_extension("png"), &files)?;
    output::write_text(&args.output.join("benchmark.html"), &page.to_html())?;
    output::write_json(&main, &report)?;
    claims.finish(&main)?;
    let rows = report.rows();
    let shown = args.output.join("benchmark.html").display().to_string();
    let rows = rows.into_iter().chain([("page", shown)]);
    let printed = Printed::rows(&rows.collect::<Vec<_>>(), &report)?;
    Ok(printed.of_run(report.localization.localized))
}

const FIGURES: &str = "figures.json";
const MAP: &str = "map.ply";
const MAP_REPORT: &str = "map.report.json";
const RESULT: &str = "localization.npz";
const ALIGNED: &str = "aligned_evaluation";

/// The stages.
struct Benchmark<'a> {
    args: &'a BenchmarkArgs,
    context: &'a Context,
}

impl Benchmark<'_> {
    /// Finds the poses of a session by its scans, and their errors.
    fn odometry(&self, session: &Session) -> Result<SharedResult> {
        let config: OdometryCommandConfig = self.configured(session.keys(None, false))?;
        let evaluation: EvaluationConfig = self.configured(session.evaluation_keys())?;
        let configs = (&config, &evaluation);
        self.stage("odometry", &configs, &session.content, |folder| {
            let config = OdometryCommandConfig {
                output_folder: folder.into(),
                ..config.clone()
            };
            let printed = odometry::run(&config, self.context).context("while finding poses")?;
            let found: Value = serde_json::from_str(&printed.in_form(Form::Json))?;
            let errors = |name: &str| -> Result<Option<Box<Report>>> {
                if session.truth.is_none() {
                    return Ok(None);
                }
                let config = EvaluationConfig {
                    result_file: folder.join(format!("{name}_tum.txt")).into(),
                    output_folder: Some(folder.join(format!("{name}_evaluation")).into()),
                    ..evaluation.clone()
                };
                let report = evaluate::run(&config, self.context);
                let report = report.with_context(|| format!("while evaluating {name}"))?;
                Ok(Some(Box::new(report)))
            };
            let figures = OdometryFigures {
                scan_by_scan: errors("odometry")?,
                adjusted: errors("poses")?,
                ..serde_json::from_value(with_nulls(found, ["scan_by_scan", "adjusted"]))?
            };
            output::write_json(&folder.join(FIGURES), &figures)
        })
    }

    /// Builds the map of a session, or of every other scan of it.
    fn map(&self, session: &Session, is_whole: bool) -> Result<SharedResult> {
        let mut keys = session.keys(Some(0), is_whole);
        keys.extend(session.truth_keys());
        let config: BuildMapConfig = self.configured(keys)?;
        self.stage("map", &config, &session.content, |folder| {
            let config = BuildMapConfig {
                mesh_file: folder.join(MAP).into(),
                ..config.clone()
            };
            let built = build_map::run(&config, self.context);
            built.context("while building the map").map(drop)
        })
    }

    /// Localizes a session, or every other scan of it, in a map, and refines it. The truth of another session than that of the
    /// map may be in another frame, so errors after a rigid alignment are computed as well.
    fn localization(&self, session: &Session, is_whole: bool, map: &Path) -> Result<SharedResult> {
        let mut keys = session.keys(Some(1), is_whole);
        keys.extend(session.truth_keys());
        keys.push(("map_input.map_file", path_value(&map.join(MAP))));
        let config: LocalizationConfig = self.configured(keys)?;
        // Settings of the user do not change the alignment: the figures are named after it.
        let evaluation = EvaluationConfig {
            alignment: Some(Alignment::Rigid),
            ..self.configured(vec![("output.plots", json!(false))])?
        };
        let configs = (&config, &evaluation);
        self.stage("localization", &configs, &session.content, |folder| {
            let config = LocalizationConfig {
                result_path: folder.join(RESULT).into(),
                ..config.clone()
            };
            localize::run(&config, self.context).context("while localizing")?;
            let refinement = refine::base_config(Some(&config.result_path));
            let refined = refine::run(&refinement, self.context);
            let refined = refined.context("while refining")?;
            if is_whole && (refined.mcl.is_some() || refined.refined.is_some()) {
                let evaluation = EvaluationConfig {
                    result_file: config.result_path.clone(),
                    output_folder: Some(folder.join(ALIGNED).into()),
                    ..evaluation.clone()
                };
                match evaluate::run(&evaluation, self.context) {
                    Ok(_report) => {}
                    Err(error) if error.is::<NoRigidAlignment>() => tracing::warn!(
                        "there are no errors after a rigid alignment: the trusted or the true poses are on a straight line, or too few"
                    ),
                    Err(error) => {
                        return Err(error.context("while evaluating after a rigid alignment"));
                    }
                }
            }
            Ok(())
        })
    }

    /// Makes what a stage leaves in its folder, unless it is there.
    fn stage(
        &self,
        name: &str,
        config: &impl Serialize,
        content: &str,
        make: impl FnOnce(&Path) -> Result<()>,
    ) -> Result<SharedResult> {
        let text = serde_json::to_string(config)?;
        let key = hash_of_texts(&[name, &text, content, version::executable_hash()?]);
        let folder = self.args.output.join("stages");
        artefact::get_or_create(&folder, &format!("{name}-{}", &key[..16]), make)
    }

    /// A configuration with keys, and with those settings of the command line that it has.
    fn configured<T: Configuration>(&self, keys: Vec<(&str, Value)>) -> Result<T> {
        let mut given = settings_of(&keys);
        given.extend(settings_of(&[("output.force", json!(true))]));
        if let Some(seed) = self.args.seed
            && settings::has_key::<T>("seed")?
        {
            given.push(("seed".to_owned(), seed.to_string()));
        }
        for (key, value) in &self.args.settings {
            if settings::has_key::<T>(key)? {
                given.push((key.clone(), value.clone()));
            }
        }
        Ok(settings::with_settings(T::default(), &given)?)
    }
}

impl Session {
    fn open(
        args: &BenchmarkArgs,
        folder: &Path,
        topic: &Option<String>,
        truth: Option<&Path>,
    ) -> Result<Self> {
        let recording = RecordingConfig {
            scan_folder: folder.into(),
            layout: args.layout.0,
            topic: topic.clone(),
            ..RecordingConfig::default()
        };
        let no_poses = PoseInputConfig::default();
        let opened = RecordingInputs::new(&recording, &no_poses).open()?;
        let is_given = truth.is_some();
        let (truth, calibration) = match truth {
            Some(truth) => (
                Some(truth.to_owned()),
                args.calibration.clone().map(PathBuf::from),
            ),
            None => (opened.files.poses.clone(), opened.files.calibration.clone()),
        };
        if truth.is_none() {
            tracing::warn!(
                "{} has no true poses, so that there are no errors of it; give --truth",
                folder.display()
            );
        }
        // Poses of the layout are part of the recording.
        let mut content = vec![hash_of_recording(&opened)?];
        if is_given {
            for file in truth.iter().chain(&calibration) {
                content.push(hash_of_file(file)?);
            }
        }
        Ok(Self {
            recording,
            layout: opened.files.layout,
            truth,
            calibration,
            content: hash_of_texts(&content),
        })
    }

    /// Keys of the recording: of all scans, or of every other one from `start` on.
    fn keys(&self, start: Option<usize>, is_whole: bool) -> Vec<(&'static str, Value)> {
        let mut keys = vec![(
            "recording.scan_folder",
            path_value(&self.recording.scan_folder),
        )];
        let layout = self.recording.layout.map(|layout| json!(layout));
        keys.extend(layout.map(|layout| ("recording.layout", layout)));
        let topic = self.recording.topic.as_ref();
        keys.extend(topic.map(|topic| ("recording.topic", json!(topic))));
        if let (Some(start), false) = (start, is_whole) {
            keys.push(("recording.frames.start_idx", json!(start)));
            keys.push(("recording.frames.frame_step", json!(2)));
        }
        keys
    }

    /// Keys of the true poses.
    fn truth_keys(&self) -> Vec<(&'static str, Value)> {
        let keys = [
            ("given_poses.pose_file", &self.truth),
            ("given_poses.calib_file", &self.calibration),
        ];
        let known = keys
            .into_iter()
            .filter_map(|(key, file)| Some((key, path_value(file.as_ref()?))));
        known.collect()
    }

    /// Keys of an evaluation against the true poses.
    fn evaluation_keys(&self) -> Vec<(&'static str, Value)> {
        let mut keys = self.truth_keys();
        let of_recording = self.keys(None, true).into_iter().map(|(key, value)| {
            let name = key.rsplit('.').next().unwrap_or(key);
            (name, value)
        });
        keys.extend(of_recording);
        keys
    }
}

fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    serde_json::from_str(&text)
        .with_context(|| format!("{} is damaged; remove its folder", path.display()))
}

/// A value with further fields that are unknown.
fn with_nulls<const N: usize>(mut value: Value, names: [&str; N]) -> Value {
    for name in names {
        value[name] = Value::Null;
    }
    value
}
