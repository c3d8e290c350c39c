//! `demo`: simulation, map, localization and refinement in one command.

use std::num::NonZeroUsize;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context as _, Result};
use clap::Args;
use schemars::JsonSchema;
use serde::Serialize;
use serde_json::{Value, json};

use super::simulate::{self, Existing};
use super::stages::{path_value, settings_of};
use super::{build_map, localize, refine};
use crate::app::report::Report;
use crate::app::report::map::BuildReport;
use crate::app::run::{Context, Form, MachineArgs, Printed};
use crate::app::settings::{self, BuildMapConfig, LocalizationConfig};
use crate::configuration::Configuration;
use crate::file_path::FilePath;
use crate::simulation::SimulationConfig;

/// Arguments of `demo`.
#[derive(Clone, Debug, Args)]
pub struct DemoArgs {
    /// Output folder.
    #[arg(long, value_name = "FOLDER", default_value = "results/demo")]
    pub output: FilePath,

    /// Scans per drive; 160 by default.
    #[arg(long, value_name = "N")]
    pub frames: Option<NonZeroUsize>,

    /// Seed of all random choices.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,

    /// Renderer and threads.
    #[command(flatten)]
    pub machine: MachineArgs,
}

/// Reports of the map and of the second drive.
#[derive(Debug, Serialize, JsonSchema)]
pub struct DemoReport {
    /// The map.
    build_map: BuildReport,
    /// The localized and refined drive.
    localization: Report,
    /// Time of all of it [s].
    seconds: f64,
}

/// Default number of frames per drive.
const FRAMES: usize = 160;

/// Simulates two drives through one street, builds a map from the first, localizes the second in
/// it, refines and evaluates its trajectory; returns what to print.
pub fn run(args: &DemoArgs, context: &Context) -> Result<Printed> {
    let started = Instant::now();
    let seed = args.seed.unwrap_or(1);
    let street = args.output.join("street");
    let drive = |number: u32| SimulationConfig {
        output_folder: street.clone().into(),
        seed,
        drive: number,
        n_scans: args.frames.map_or(FRAMES, usize::from) as i64,
        ..SimulationConfig::default()
    };
    for number in [1, 2] {
        tracing::info!("simulating drive {number}");
        simulate::run(&drive(number), Existing::Renew, context).context("while simulating")?;
    }
    let (first, second) = (drive(1).drive_folder(), drive(2).drive_folder());

    tracing::info!("building the map from drive 1");
    let map_file = args.output.join("map.ply");
    let map: BuildMapConfig = configured(
        &first,
        &[
            ("mesh_file", path_value(&map_file)),
            ("holdout_step", json!(10)),
            ("map.seed", json!(seed)),
            ("output.plots", json!(false)),
        ],
    )?;
    let build = build_map::run(&map, context).context("while building the map")?;

    tracing::info!("localizing drive 2 in the map");
    let localization: LocalizationConfig = configured(
        &second,
        &[
            ("map_input.map_file", path_value(&map_file)),
            (
                "result_path",
                path_value(&args.output.join("localization.npz")),
            ),
            ("pose_tracking", json!(true)),
            ("motion.odometry", json!("file")),
            (
                "motion.odometry_file",
                path_value(&second.join("odometry.txt")),
            ),
            ("tracker.localizer.num_particles", json!(1000)),
            ("tracker.seed", json!(seed)),
        ],
    )?;
    localize::run(&localization, context).context("while localizing")?;

    tracing::info!("refining the trajectory");
    // With the sensor that was inferred.
    let refinement = refine::base_config(Some(&localization.result_path));
    let report = refine::run(&refinement, context).context("while refining")?;

    let seconds = started.elapsed().as_secs_f64();
    let page = args.output.join("report.html");
    let text = |form: Form, all: bool| -> Result<String> {
        Ok(format!(
            "{}\n{}\nall of it took {seconds:.1} s; open {}\n",
            build.printed()?.in_form(form),
            report.to_text(all),
            page.display()
        ))
    };
    let printed = Printed::parts(text(Form::Main, false)?, text(Form::All, true)?);
    let printed = printed.of_run(report.localized);
    printed.with_json(&DemoReport {
        build_map: build,
        localization: report,
        seconds,
    })
}

/// A configuration with the recording of a drive, its true poses, and further keys; existing output is replaced.
fn configured<T: Configuration>(drive: &Path, keys: &[(&str, Value)]) -> Result<T> {
    let keys_of_drive = [
        ("recording.scan_folder", path_value(&drive.join("velodyne"))),
        (
            "given_poses.pose_file",
            path_value(&drive.join("poses.txt")),
        ),
        (
            "given_poses.calib_file",
            path_value(&drive.join("calib.txt")),
        ),
        ("output.force", json!(true)),
    ];
    let settings = settings_of(&[keys, &keys_of_drive].concat());
    Ok(settings::with_settings(T::default(), &settings)?)
}
