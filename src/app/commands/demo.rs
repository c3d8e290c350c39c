//! `demo`: simulation, map, localization and refinement in one command.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context as _, Result};
use clap::Args;

use super::simulate::{self, Existing};
use super::{build_map, localize, refine};
use crate::app::run::Context;
use crate::app::run::machine::MachineArgs;
use crate::app::run::output::{Form, Printed};
use crate::app::settings::{
    BuildMapConfig, GivenPosesConfig, LocalizationConfig, MapInputConfig, MotionConfig,
    OdometrySource, OutputConfig, RecordingConfig, RefinementConfig,
};
use crate::localization::TrackerConfig;
use crate::map::MapConfig;
use crate::simulation::SimulationConfig;

/// Arguments of `demo`.
#[derive(Clone, Debug, Args)]
pub struct DemoArgs {
    /// Output folder.
    #[arg(long, value_name = "FOLDER", default_value = "results/demo")]
    pub output: PathBuf,

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

/// Default number of frames per drive.
const FRAMES: usize = 160;

/// Simulates two drives through one street, builds a map from the first, localizes the second in
/// it, refines and evaluates its trajectory; returns what to print.
pub fn run(args: &DemoArgs, context: &Context) -> Result<Printed> {
    let started = Instant::now();
    let seed = args.seed.unwrap_or(1);
    let street = args.output.join("street");
    let drive = |number: u32| SimulationConfig {
        output_folder: street.clone(),
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
    let map = build_map_config(&args.output, &first, seed);
    let build = build_map::run(&map, context).context("while building the map")?;

    tracing::info!("localizing drive 2 in the map");
    let localization = localization_config(&args.output, &map, &second, seed);
    localize::run(&localization, context).context("while localizing")?;

    tracing::info!("refining the trajectory");
    let refinement = RefinementConfig::of(localization);
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
    Printed::parts(text(Form::Main, false)?, text(Form::All, true)?).with_json(&serde_json::json!({
        "build_map": build,
        "localization": report,
        "seconds": seconds,
    }))
}

fn recording(drive: &Path) -> RecordingConfig {
    RecordingConfig {
        scan_folder: drive.join("velodyne"),
        ..RecordingConfig::default()
    }
}

fn true_poses(drive: &Path) -> GivenPosesConfig {
    GivenPosesConfig {
        pose_file: Some(drive.join("poses.txt")),
        calib_file: Some(drive.join("calib.txt")),
        ..GivenPosesConfig::default()
    }
}

fn build_map_config(output: &Path, drive: &Path, seed: u64) -> BuildMapConfig {
    BuildMapConfig {
        recording: recording(drive),
        given_poses: true_poses(drive),
        mesh_file: output.join("map.ply"),
        holdout_step: 10,
        map: MapConfig {
            seed,
            ..MapConfig::default()
        },
        output: OutputConfig {
            plots: false,
            force: true,
        },
        ..BuildMapConfig::default()
    }
}

fn localization_config(
    output: &Path,
    map: &BuildMapConfig,
    drive: &Path,
    seed: u64,
) -> LocalizationConfig {
    let mut tracker = TrackerConfig {
        seed,
        ..TrackerConfig::default()
    };
    tracker.localizer.num_particles = 1000;
    LocalizationConfig {
        recording: recording(drive),
        given_poses: true_poses(drive),
        map_input: MapInputConfig {
            map_file: map.mesh_file.clone(),
            ..MapInputConfig::default()
        },
        result_path: output.join("localization.npz"),
        pose_tracking: Some(true),
        motion: MotionConfig {
            odometry: OdometrySource::File,
            odometry_file: Some(drive.join("odometry.txt")),
        },
        tracker,
        output: OutputConfig {
            force: true,
            ..OutputConfig::default()
        },
        ..LocalizationConfig::default()
    }
}
