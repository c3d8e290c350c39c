//! `export`: a result or a map in the formats of other programs.

mod arguments;
mod tiles;

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use schemars::JsonSchema;
use serde::Serialize;

pub use self::arguments::ExportArgs;
use self::tiles::TilesReport;
use super::refine;
use super::stages::{RecordingInputs, infer};
use crate::app::report::export::tiles::TILES_FOLDER;
use crate::app::report::export::{Model, Ribbon, RunLog, write_mcap};
use crate::app::report::plotting::color::{Colormap, TRUTH};
use crate::app::report::results::stretches;
use crate::app::report::{LocalizationResults, run_output};
use crate::app::run::{Claims, Context, Outputs, Printed, input, output};
use crate::app::settings::{self, RefinementConfig};
use crate::evaluation::planar_errors;
use crate::file_path::FilePath;
use crate::geometry::{Pose3, StampedPose, TriangleMesh, pose2_from_pose3};
use crate::georeference::write_geojson;
use crate::map::MappingPath;
use crate::map::files::mesh_file;
use crate::recording::{Frame, scan_files};

/// First bytes of the files.
pub const MCAP: &[u8] = b"\x89MCAP0\r\n";
const GLB: &[u8] = b"glTF";
const GEOJSON: &[u8] = b"{";

/// What was written.
#[derive(Debug, Default, Serialize, JsonSchema)]
pub struct ExportReport {
    /// Files; of tiles, that of their metadata.
    files: Vec<WrittenFile>,
    /// Point cloud tiles, with `--pcd`.
    tiles: Option<TilesReport>,
}

/// A written file.
#[derive(Debug, Serialize, JsonSchema)]
struct WrittenFile {
    /// Path.
    path: FilePath,
    /// Size [MB].
    megabytes: f64,
}

/// Writes the requested files.
pub fn run(args: &ExportArgs, context: &Context) -> Result<Printed> {
    input::require_file("the input", &args.input)?;
    let claims = check(args, context)?;
    let tiles = if settings::is_result(&args.input) {
        export_result(args, context)?
    } else {
        export_map(args, context)?
    };
    let mut files = Vec::new();
    for (mut claims, path) in claims {
        claims.finish(&path)?;
        let megabytes = std::fs::metadata(&path).map_or(0.0, |file| file.len() as f64 / 1e6);
        let path = path.into();
        files.push(WrittenFile { path, megabytes });
    }
    let row = |it: &WrittenFile| format!("{}, {:.1} MB", it.path.display(), it.megabytes);
    let mut rows: Vec<_> = files.iter().map(|it| ("written", row(it))).collect();
    rows.extend(tiles.iter().flat_map(TilesReport::rows));
    Printed::rows(&rows, &ExportReport { files, tiles })
}

/// Checks and claims the files to write.
pub fn check(args: &ExportArgs, context: &Context) -> Result<Vec<(Claims, PathBuf)>> {
    let metadata = args.pcd.as_deref().map(tiles::metadata_file);
    let formats: [(_, _, _, &[&str]); 4] = [
        ("--mcap", args.mcap.as_deref(), Some(MCAP), &[]),
        ("--glb", args.glb.as_deref(), Some(GLB), &[]),
        ("--pcd", metadata.as_deref(), None, &[TILES_FOLDER]),
        ("--geojson", args.geojson.as_deref(), Some(GEOJSON), &[]),
    ];
    let base = refine::base_config(Some(&args.input));
    let map = args.map.as_deref().unwrap_or(&base.map_input.map_file);
    let recording = args
        .recording
        .as_deref()
        .unwrap_or(&base.recording.scan_folder);
    let inputs = [
        ("the input", args.input.as_path()),
        ("the map", map),
        ("the recording", recording),
    ];
    let inputs: Vec<(&str, &Path)> = inputs.into_iter().chain(context.input()).collect();
    let requested = formats
        .into_iter()
        .filter_map(|(key, path, magic, names)| Some((key, path?, magic, names)));
    requested
        .map(|(key, main, magic, names)| {
            let outputs = Outputs {
                key,
                main,
                magic,
                names: names.iter().map(|&name| name.to_owned()).collect(),
                inputs: inputs.clone(),
                force: args.force,
            };
            Ok((outputs.prepare()?, main.to_owned()))
        })
        .collect()
}

/// Exports a map; returns its tiles, if they are requested.
fn export_map(args: &ExportArgs, context: &Context) -> Result<Option<TilesReport>> {
    let path = args.input.display();
    ensure!(
        scan_files::is_mesh(&args.input),
        "{path} is neither a result (.npz) nor a map (.ply, .obj, .stl)"
    );
    ensure!(
        args.mcap.is_none(),
        "{path} is a map: a log is written of a result (.npz); give --glb FILE, --pcd FOLDER or --geojson FILE"
    );
    let (mesh, path) = mesh_file::read(&args.input)?;
    if args.glb.is_some() {
        let mut model = Model::default();
        model.add_mesh("map", &mesh);
        write_model(args, model, path.as_ref())?;
    }
    if let Some(file) = &args.geojson {
        let driven = path.as_ref().map_or(&[][..], |it| &it.map_from_lidar);
        let row = |(frame, &map_from_lidar): (usize, &Pose3)| StampedPose {
            frame,
            time_s: frame as f64,
            map_from_lidar,
        };
        let driven = driven.iter().enumerate().map(row).collect();
        write_path(file, &args.input, path.as_ref(), &[driven])?;
    }
    tiles::write(args, &mesh, path.as_ref(), context)
}

/// Writes a path in a map as one on the Earth.
fn write_path(
    file: &Path,
    map: &Path,
    path: Option<&MappingPath>,
    stretches: &[Vec<StampedPose>],
) -> Result<()> {
    let georeference = path.and_then(|path| path.georeference.as_ref());
    let georeference = georeference.with_context(|| {
        format!(
            "the place of {} on the Earth is not known; build it with --gnss SOURCE",
            map.display()
        )
    })?;
    output::write_file(file, |file| write_geojson(file, georeference, stretches))
}

/// Exports a result with its map; returns the tiles of the map, if they are requested.
fn export_result(args: &ExportArgs, context: &Context) -> Result<Option<TilesReport>> {
    let results = LocalizationResults::read(&args.input)?;
    run_output::warn_of_shortfall(&results, &args.input);
    let mut config = refine::base_config(Some(&args.input));
    if let Some(map) = &args.map {
        config.map_input.map_file.clone_from(map);
    }
    if let Some(recording) = &args.recording {
        config.recording.scan_folder.clone_from(recording);
    }
    input::require_file(
        "the map of the result (--map MAP)",
        &config.map_input.map_file,
    )?;
    let (mesh, path) = mesh_file::read(&config.map_input.map_file)?;
    if args.glb.is_some() {
        write_model(args, model_of(&mesh, &results)?, path.as_ref())?;
    }
    if let Some(log) = &args.mcap {
        let frames = match args.points {
            0 => None,
            _ => Some(frames_of(&mut config, &results)?),
        };
        let run = RunLog {
            results: &results,
            frames: frames.as_deref(),
            mesh: Some(&mesh),
            georeference: path.as_ref().and_then(|path| path.georeference.as_ref()),
            max_points: args.points,
        };
        write_log(log, &run, context)?;
    }
    if let Some(file) = &args.geojson {
        let stretches = stretches_of(&results)?;
        write_path(file, &config.map_input.map_file, path.as_ref(), &stretches)?;
    }
    tiles::write(args, &mesh, path.as_ref(), context)
}

fn write_log(path: &Path, run: &RunLog, context: &Context) -> Result<()> {
    let task = context.progress.task("export", run.results.len());
    context.interrupt.keeps("nothing was written");
    output::write_file(path, |file| {
        write_mcap(run, file, || {
            task.advance(1);
            Ok(context.interrupt.check()?)
        })
    })
}

/// The frames of a result in its recording.
fn frames_of(config: &mut RefinementConfig, results: &LocalizationResults) -> Result<Vec<Frame>> {
    let recording = RecordingInputs::new(&config.recording, &config.given_poses).open();
    let recording = recording.context("the scans of the result cannot be read; give --recording RECORDING, or --points 0 for a log without scans")?;
    let (recording, _) = infer(&mut config.sensor, recording)?;
    let mut frames = recording.frames;
    frames.retain(|frame| results.frames.binary_search(&frame.number).is_ok());
    ensure!(
        frames.len() == results.len(),
        "{} has {} of the {} frames of the result; give --recording RECORDING",
        config.recording.scan_folder.display(),
        frames.len(),
        results.len()
    );
    Ok(frames)
}

/// The best trajectory of a result where it is trusted: the refined one, if there is one.
fn stretches_of(results: &LocalizationResults) -> Result<Vec<Vec<StampedPose>>> {
    let (found, trusted) = best_of(results)?;
    let times_s = results.times_s.as_deref();
    let row = |row: usize| StampedPose {
        frame: results.frames[row],
        time_s: times_s.map_or(row as f64, |times_s| times_s[row]),
        map_from_lidar: found[row],
    };
    Ok(stretches(&trusted)
        .map(|rows| rows.map(row).collect())
        .collect())
}

/// The best trajectory of a result, and whether each of its poses is trusted.
fn best_of(results: &LocalizationResults) -> Result<(&[Pose3], Vec<bool>)> {
    let (found, trusted) = match &results.refined_in_space {
        Some(refined) => (Some(refined), results.refined_trusted()),
        None => (results.trajectory_in_space(), results.trusted()),
    };
    let found = found.context("the result holds no poses in space; run localize again")?;
    Ok((&found[..], trusted))
}

/// The map with the path, colored by its error where there is a truth.
fn model_of(mesh: &TriangleMesh, results: &LocalizationResults) -> Result<Model> {
    let (found, trusted) = best_of(results)?;
    let mut model = Model::default();
    model.add_mesh("map", mesh);
    let truth = results.ground_truth_in_space.as_deref();
    let (name, colors) = match truth {
        Some(truth) => colored_by_error(found, truth, &trusted),
        None => (
            "path".to_owned(),
            vec![Colormap::Viridis.at(0.0); found.len()],
        ),
    };
    for rows in stretches(&trusted) {
        model.add_ribbon(&Ribbon {
            name: &name,
            path: &found[rows.clone()],
            colors: colors[rows].to_vec(),
        });
    }
    for rows in stretches(&results.has_truth().unwrap_or_default()) {
        let path = &truth.unwrap_or_default()[rows];
        model.add_ribbon(&Ribbon {
            name: "true path",
            path,
            colors: vec![TRUTH; path.len()],
        });
    }
    Ok(model)
}

/// Name and colors of a path by its planar error; the largest error has the lightest color.
fn colored_by_error(found: &[Pose3], truth: &[Pose3], trusted: &[bool]) -> (String, Vec<[u8; 3]>) {
    let [found, truth] =
        [found, truth].map(|poses| -> Vec<_> { poses.iter().map(pose2_from_pose3).collect() });
    let errors: Vec<f64> = (planar_errors(&found, &truth).iter())
        .map(|error| error.distance_m())
        .collect();
    let known = errors.iter().zip(trusted).filter(|(_, trusted)| **trusted);
    let largest_m = known.map(|(error_m, _)| *error_m).fold(0.0, f64::max);
    let color = |error_m: &f64| Colormap::Viridis.at(error_m / largest_m.max(1e-9));
    let name = format!("path, position error 0 to {:.1} cm", 100.0 * largest_m);
    (name, errors.iter().map(color).collect())
}

fn write_model(args: &ExportArgs, mut model: Model, path: Option<&MappingPath>) -> Result<()> {
    model.georeference = path.and_then(|path| path.georeference.clone());
    args.glb.as_ref().map_or(Ok(()), |path| {
        output::write_file(path, |file| model.write(file))
    })
}
