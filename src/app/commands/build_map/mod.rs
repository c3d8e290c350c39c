//! `build-map`: from scans with poses to a triangle-mesh map.

mod parts;
mod report;

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Instant;

use anyhow::{Context as _, Result};

use self::parts::Parts;
pub use self::report::BuildReport;
use super::interrupt::Interrupted;
use super::version;
use super::{Context, input, output};
use crate::app::config::{self, BuildMapConfig};
use crate::app::plotting::color::Colormap;
use crate::app::plotting::{MapPlot, ScalarMapPlot};
use crate::geometry::{Pose2, TriangleMesh, pose2_from_pose3};
use crate::map::local_map::{self, LocalMapCounts, LocalMapError, Watcher};
use crate::map::plan::{self, LocalMapPlan, Ownership};
use crate::map::ply;
use crate::map::quality::{self, BeamResidual, MapQuality};
use crate::map::truth::TruthAgreement;
use crate::recording::{Frame, Sequence};

/// Residual at the end of the colour bar [m].
const PICTURE_LIMIT_M: f64 = 0.2;

/// Builds the map that a configuration describes.
pub fn run(config: &BuildMapConfig, context: &Context) -> Result<BuildReport> {
    let started = Instant::now();
    input::require_folder("scan_folder", &config.scan_folder)?;
    input::require_file("pose_file", &config.pose_file)?;
    input::require_file("calib_file", &config.calib_file)?;
    if let Some(path) = &config.truth_mesh {
        input::require_file("truth_mesh", path)?;
    }
    output::prepare(&config.mesh_file, "mesh_file", config.force)?;
    let mut sequence = Sequence::open(
        &config.scan_folder,
        &config.pose_file,
        &config.calib_file,
        &config.selection(),
    )?;
    if let Some(direction) = config.motion_compensation {
        sequence = sequence.compensated_by_poses(direction);
    }
    let (mapped, held_out) = hold_out(&sequence.frames, config);
    let plans = plan::local_maps(&mapped, config.local_map_size, config.overlap_m);
    let parts = Parts::open(&config.mesh_file, &inputs(config, &mapped)?)?;

    let clock = StageClock::default();
    let local_maps = build_parts(config, context, &mapped, &plans, &parts, &clock)?;
    let mesh = clock.time("join", || parts.join(plans.len()))?;
    let settings = config.local_map_settings();
    let residuals = clock.time("quality", || {
        quality::residuals(&mesh, &held_out, &settings.scan)
    })?;
    write_map(config, &mesh)?;
    let truth = match &config.truth_mesh {
        Some(path) => clock.time("truth", || -> Result<_> {
            let surface = ply::read(path)?;
            Ok(TruthAgreement::of(&mesh, &surface, &mapped, &settings.scan))
        })?,
        None => None,
    };
    if config.visualize {
        draw(config, &mesh, &mapped, &residuals)?;
    }
    let path_m = path_m(&mapped);
    let map_mb = std::fs::metadata(&config.mesh_file).map_or(0.0, |meta| meta.len() as f64 / 1e6);
    let per_100m = |amount: f64| 100.0 * amount / path_m.max(1.0);
    let report = BuildReport {
        frames: sequence.frames.len(),
        mapped_frames: mapped.len(),
        held_out_frames: held_out.len(),
        path_m,
        triangles: mesh.triangles.len(),
        map_mb,
        triangles_per_100m: per_100m(mesh.triangles.len() as f64),
        mb_per_100m: per_100m(map_mb),
        seconds: started.elapsed().as_secs_f64(),
        stage_seconds: clock.seconds(),
        quality: MapQuality::of(&residuals),
        truth,
        local_maps,
    };
    output::write_json(&beside(&config.mesh_file, "report.json"), &report)?;
    config::write(&beside(&config.mesh_file, "yml"), config)?;
    parts.remove()?;
    Ok(report)
}

/// Builds the local maps that are not finished yet; returns the counts of all.
fn build_parts(
    config: &BuildMapConfig,
    context: &Context,
    frames: &[Frame],
    plans: &[LocalMapPlan],
    parts: &Parts,
    clock: &StageClock,
) -> Result<Vec<LocalMapCounts>> {
    let settings = config.local_map_settings();
    let classifier = config
        .ground()
        .classifier()
        .context("cannot build the ground classifier")?;
    let reach_m = f64::from(settings.scan.crop_m.length());
    let ownership = Ownership::new(frames, plans, reach_m);
    let scans = plans.iter().map(|plan| plan.used.len()).sum();
    let task = context.progress.task("build-map", scans);
    let mut all = Vec::with_capacity(plans.len());
    for plan in plans {
        if let Some(counts) = finished(parts, frames, plan) {
            tracing::info!(
                "local map {} of {} is there already",
                plan.number + 1,
                plans.len()
            );
            task.advance(counts.scans);
            all.push(counts);
            continue;
        }
        let stage = |name: &'static str| {
            task.note(name);
            clock.begin(name);
        };
        let watcher = Watcher {
            scan_done: &|| task.advance(1),
            stage: &stage,
            cancelled: &|| context.interrupt.requested(),
        };
        let built = local_map::build(frames, plan, &ownership, &settings, &*classifier, &watcher);
        clock.end();
        let built = built.map_err(|error| told(error, all.len(), plans.len(), parts))?;
        if built.counts.is_empty {
            tracing::warn!(
                "frames {} to {} have too few points to mesh: the map has a hole there",
                frames[plan.own.start].number,
                frames[plan.own.end - 1].number
            );
        }
        parts.save(plan.number, &built)?;
        all.push(built.counts);
    }
    Ok(all)
}

/// The counts of a local map that is there already, made of the scans as they are now.
fn finished(parts: &Parts, frames: &[Frame], plan: &LocalMapPlan) -> Option<LocalMapCounts> {
    let part = parts.finished(plan.number)?;
    // A scan that cannot be read is told of by the build.
    let is_same = local_map::scans_hash(frames, plan).is_ok_and(|now| now == part.scans_hash);
    is_same.then_some(part.counts)
}

/// An interrupted build says what it keeps.
fn told(error: LocalMapError, finished: usize, all: usize, parts: &Parts) -> anyhow::Error {
    match error {
        LocalMapError::Interrupted => anyhow::Error::new(Interrupted {
            kept: format!(
                "{finished} of {all} local maps are finished and kept in {}; run the same command again to go on from there",
                parts.folder().display()
            ),
        }),
        error => error.into(),
    }
}

/// The frames that build the map, and those that judge it.
fn hold_out(frames: &[Frame], config: &BuildMapConfig) -> (Vec<Frame>, Vec<Frame>) {
    let counted = plan::counted_frames(frames, config.displacement_threshold_m);
    let is_held = |index: usize| {
        config.holdout_step > 0 && index % config.holdout_step == config.holdout_step - 1
    };
    let (held, mapped): (Vec<_>, Vec<_>) = counted
        .into_iter()
        .enumerate()
        .partition(|(index, _)| is_held(*index));
    let strip = |frames: Vec<(usize, Frame)>| frames.into_iter().map(|(_, frame)| frame).collect();
    (strip(mapped), strip(held))
}

/// What all local maps depend on: the program, the configuration without where results go, and
/// the poses. The scans each of them knows itself.
fn inputs(config: &BuildMapConfig, frames: &[Frame]) -> Result<String> {
    let relevant = BuildMapConfig {
        mesh_file: PathBuf::new(),
        truth_mesh: None,
        visualize: false,
        force: false,
        ..config.clone()
    };
    let mut text = format!("# {}\n", version::program()?);
    text += &config::to_yaml(&relevant)?;
    for frame in frames {
        let t = frame.map_from_lidar.translation.vector;
        let q = frame.map_from_lidar.rotation.coords;
        writeln!(
            text,
            "{} {} {} {} {} {} {} {} {:?}",
            frame.scan_path.display(),
            t.x,
            t.y,
            t.z,
            q.x,
            q.y,
            q.z,
            q.w,
            frame.sweep
        )?;
    }
    Ok(text)
}

/// Draws the map from above, and where beams were judged also how well they agree with it.
fn draw(
    config: &BuildMapConfig,
    mesh: &TriangleMesh,
    mapped: &[Frame],
    residuals: &[BeamResidual],
) -> Result<()> {
    let settings = config.local_map_settings();
    let driven: Vec<Pose2> = mapped
        .iter()
        .map(|f| pose2_from_pose3(&f.map_from_lidar))
        .collect();
    let picture = beside(&config.mesh_file, "png");
    MapPlot {
        title: "Map from above",
        mesh,
        path: Some(("mapping trajectory", &driven)),
        keys: &[
            ("ground", settings.ground_color),
            ("rest", settings.rest_color),
        ],
    }
    .save(&picture)?;
    tracing::info!("drew {}", picture.display());
    if residuals.is_empty() {
        return Ok(());
    }
    let picture = beside(&config.mesh_file, "residuals.png");
    ScalarMapPlot {
        title: "Distance of held-back beams to the surface that they hit",
        mesh,
        values: &quality::vertex_residuals(mesh, residuals),
        value_name: "mean beam-plane distance [m]",
        limits: (0.0, PICTURE_LIMIT_M),
        colormap: Colormap::Viridis,
        trajectory: Some(&driven),
    }
    .save(&picture)?;
    tracing::info!("drew {}", picture.display());
    Ok(())
}

/// Writes the map under a temporary name and renames it.
fn write_map(config: &BuildMapConfig, mesh: &TriangleMesh) -> Result<()> {
    anyhow::ensure!(
        !mesh.triangles.is_empty(),
        "the map has no triangles: nothing of the scans in {} was left to mesh; check range_image, crop_x, crop_y and crop_z",
        config.scan_folder.display()
    );
    let temporary = beside(&config.mesh_file, "unfinished.ply");
    ply::write(&temporary, mesh)?;
    std::fs::rename(&temporary, &config.mesh_file)
        .with_context(|| format!("cannot write {}", config.mesh_file.display()))
}

/// `results/map.ply` -> `results/map.<extension>`.
fn beside(mesh_file: &Path, extension: &str) -> PathBuf {
    mesh_file.with_extension(extension)
}

fn path_m(frames: &[Frame]) -> f64 {
    let position = |frame: &Frame| frame.map_from_lidar.translation.vector;
    frames
        .windows(2)
        .map(|pair| (position(&pair[1]) - position(&pair[0])).norm())
        .sum()
}

/// Wall time per stage.
#[derive(Default)]
struct StageClock {
    state: Mutex<ClockState>,
}

#[derive(Default)]
struct ClockState {
    running: Option<(&'static str, Instant)>,
    seconds: BTreeMap<String, f64>,
}

impl ClockState {
    fn stop(&mut self) {
        if let Some((name, since)) = self.running.take() {
            *self.seconds.entry(name.to_owned()).or_default() += since.elapsed().as_secs_f64();
        }
    }
}

impl StageClock {
    fn begin(&self, name: &'static str) {
        if let Ok(mut state) = self.state.lock() {
            state.stop();
            state.running = Some((name, Instant::now()));
        }
    }

    fn end(&self) {
        if let Ok(mut state) = self.state.lock() {
            state.stop();
        }
    }

    fn time<T>(&self, name: &'static str, work: impl FnOnce() -> T) -> T {
        self.begin(name);
        let result = work();
        self.end();
        result
    }

    fn seconds(&self) -> BTreeMap<String, f64> {
        self.state
            .lock()
            .map_or_else(|_poisoned| BTreeMap::new(), |state| state.seconds.clone())
    }
}
