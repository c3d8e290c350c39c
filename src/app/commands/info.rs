//! `info`: what a recording, a scan, a map or a result contains, and what is missing for which command.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::app::report::results::Value;
use crate::app::report::{LocalizationResults, RunSummary};
use crate::app::run::arguments::setting;
use crate::app::run::input::is_bag;
use crate::app::run::{MachineArgs, Printed, gibibytes};
use crate::app::settings;
use crate::evaluation::RangeMclRules;
use crate::geometry::Aabb;
use crate::lidar::Scan;
use crate::map::MapCache;
use crate::map::files::ply;
use crate::map::tiles::contents::{self, CacheKind};
use crate::map::unit_doubt;
use crate::recording::{PoseTrack, Recording, Selection, scan_files};
use crate::sensor::{BeamSource, Sensor, SensorConfig, spread_scans};
use crate::validation::{InvalidValue, Validate};

/// Arguments of `info`.
#[derive(Clone, Debug, Args)]
pub struct InfoArgs {
    /// Recording (its folder, the folder of its scans, or a bag), scan or point cloud (.bin, .pcd, .ply, .npy), map (.ply), or result (.npz).
    pub path: PathBuf,

    /// Set the key topic, the topic of the scans in a bag with several: topic=/NAME.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = setting)]
    pub settings: Vec<(String, String)>,

    /// Largest memory that a stage may plan for; by default half of the machine's.
    #[arg(long, value_name = "GIB", value_parser = gibibytes)]
    pub memory: Option<f64>,

    /// Remove the tiles and panoramas that are kept next to the map, before it is described.
    #[arg(long)]
    pub clear_cache: bool,
}

impl InfoArgs {
    /// The memory that may be planned for.
    pub fn machine(&self) -> MachineArgs {
        MachineArgs {
            memory: self.memory,
            ..MachineArgs::default()
        }
    }
}

/// Keys of `info`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct InfoConfig {
    /// Topic of the point clouds, in a bag with several.
    topic: Option<String>,
}

impl Validate for InfoConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        Ok(())
    }
}

/// Describes what is at a path.
pub fn run(args: &InfoArgs) -> Result<Printed> {
    let path = args.path.as_path();
    let config = settings::with_settings(InfoConfig::default(), &args.settings)?;
    ensure!(
        path.exists(),
        "{} does not exist; give a recording (a folder or a bag), a scan or point cloud, a map (.ply) or a result (.npz)",
        path.display()
    );
    if args.clear_cache {
        clear_cache(path)?;
    }
    let extension = path.extension().and_then(|extension| extension.to_str());
    match extension {
        _ if path.is_dir() || is_bag(path) => recording(path, config.topic.as_deref()),
        Some("npz") => result(path),
        _ if scan_files::is_mesh(path) => map(path),
        _ if scan_files::is_scan(path) => cloud(path),
        _ => bail!(
            "{} is neither a recording (a folder, .mcap, .db3 or .bag) nor a scan or point cloud (.bin, .pcd, .ply, .npy) nor a map (.ply) nor a result (.npz)",
            path.display()
        ),
    }
}

fn recording(path: &Path, topic: Option<&str>) -> Result<Printed> {
    let recording = Recording::open_with(path, topic, &Selection::default())?;
    let frames = &recording.frames;
    let (first, last) = (&frames[0], &frames[frames.len() - 1]);
    let scans = spread_scans(&recording)?;
    let points = scans.iter().map(Scan::len).sum::<usize>() / scans.len();
    let sensor = Sensor::infer(&scans, &SensorConfig::default())?;
    let duration = if recording.has_times {
        format!("{:.1} s", last.time_s - first.time_s)
    } else {
        "unknown: there are no times, 10 scans per second are assumed".to_owned()
    };
    let mut rows = vec![
        ("layout", recording.files.layout.name().to_owned()),
        (
            "scans",
            format!("{}, {} to {}", frames.len(), first.number, last.number),
        ),
        ("duration", duration),
        (
            "points per scan",
            format!("{points} ({})", fields(&scans[0])),
        ),
    ];
    rows.extend(sensor_rows(&sensor));
    let track = recording.own_track();
    let poses = match &track {
        Ok(track) => track_in_words(track, &recording),
        Err(error) => error.to_string(),
    };
    let has_poses = track.is_ok_and(|track| track.matched(frames, recording.has_times).is_ok());
    let build_map = if has_poses {
        "ready".to_owned()
    } else {
        "ready; poses from the scans, or --poses FILE".to_owned()
    };
    rows.extend([
        ("poses", poses),
        ("build-map", build_map),
        ("localize", "ready; needs a map: --map MAP".to_owned()),
    ]);
    Ok(Printed::rows(&rows))
}

/// The fields of the points.
fn fields(scan: &Scan) -> String {
    let mut fields = vec!["x y z"];
    let has_intensity = scan.intensities.iter().any(|&value| value != 0.0);
    fields.extend(has_intensity.then_some("intensity"));
    fields.extend((!scan.rings.is_empty()).then_some("ring"));
    fields.extend((!scan.times_s.is_empty()).then_some("time"));
    fields.join(", ")
}

fn sensor_rows(sensor: &Sensor) -> Vec<(&'static str, String)> {
    let source = match sensor.beam_source {
        BeamSource::Rings => "from the rings of the points",
        BeamSource::Order => "from the order of the points",
        BeamSource::Elevations => "from peaks of the elevations",
        BeamSource::None => "no rows were found",
    };
    let [x_min, x_max, y_min, y_max] = sensor.own_car_m;
    let own_car = match (sensor.is_moving, x_max > x_min) {
        (false, _) => "unknown: the sensor does not move".to_owned(),
        (true, false) => "no returns".to_owned(),
        (true, true) => format!("x {x_min:.1} to {x_max:.1} m, y {y_min:.1} to {y_max:.1} m"),
    };
    let height = sensor.mounting.map_or_else(
        || "unknown: too little ground is visible".to_owned(),
        |mounting| {
            format!(
                "{:.2} m (±{:.2}), roll {:.1}, pitch {:.1} deg",
                mounting.height_m,
                mounting.height_spread_m,
                mounting.roll_rad.to_degrees(),
                mounting.pitch_rad.to_degrees()
            )
        },
    );
    vec![
        ("sensor", sensor.to_string()),
        ("beams", source.to_owned()),
        (
            "field of view",
            format!("{:.0} deg", sensor.horizontal_fov_deg),
        ),
        ("height", height),
        ("own car", own_car),
    ]
}

fn track_in_words(track: &PoseTrack, recording: &Recording) -> String {
    let (path, count) = (track.path.display(), track.map_from_lidar.len());
    let mut text = format!("{path}: {count} rows");
    if let (Some(times_s), true) = (&track.times_s, recording.has_times) {
        let (first_s, last_s) = (times_s[0], times_s[times_s.len() - 1]);
        let _ = write!(text, ", {first_s:.1} to {last_s:.1} s");
    }
    if let Err(error) = track.matched(&recording.frames, recording.has_times) {
        let _ = write!(text, "; {error}");
    }
    text
}

/// A single scan, or a point cloud.
fn cloud(path: &Path) -> Result<Printed> {
    /// Points of the largest scans; more are a cloud of many scans, which show no sensor.
    const MAX_SCAN: usize = 1_000_000;
    let cloud = scan_files::read_cloud(path)?;
    let (scan, has_normals) = (cloud.scan, cloud.normals.is_some());
    let normals = if has_normals { "yes" } else { "no" };
    let finite = scan.points.iter().filter(|point| point.is_finite());
    let mut rows = vec![
        ("layout", "a scan, or a point cloud".to_owned()),
        ("points", format!("{} ({})", scan.len(), fields(&scan))),
        ("extent", extent(Aabb::from_points(finite.copied()))),
        ("normals", normals.to_owned()),
    ];
    if scan.len() <= MAX_SCAN {
        let sensor = Sensor::infer(std::slice::from_ref(&scan), &SensorConfig::default())?;
        if sensor.has_rows {
            rows.extend(sensor_rows(&sensor));
        }
    }
    let needs = "needs the folder of several scans, and a map: --map MAP";
    rows.extend([
        ("build-map", "ready; as a point cloud".to_owned()),
        ("localize", needs.to_owned()),
    ]);
    Ok(Printed::rows(&rows))
}

fn extent(bounds: Aabb) -> String {
    let size = bounds.max - bounds.min;
    format!(
        "{:.0} x {:.0} m, heights {:.1} to {:.1} m",
        size.x, size.y, bounds.min.z, bounds.max.z
    )
}

/// Removes the cache of a map.
fn clear_cache(map: &Path) -> Result<()> {
    ensure!(
        map.is_file() && scan_files::is_mesh(map),
        "{} is not a map, which alone has a cache; leave out --clear-cache",
        map.display()
    );
    let folder = MapCache::NextToMap.folder_of(map);
    let cleared = folder.as_deref().map_or(Ok(()), contents::clear);
    cleared.with_context(|| format!("the cache of {} cannot be removed", map.display()))
}

/// Number and size of the files of the cache of a map; `None` where there are none.
fn cache_of(map: &Path) -> Option<String> {
    let folder = MapCache::NextToMap.folder_of(map).unwrap_or_default();
    // What cannot be read is not used either.
    let files = contents::files_of(&folder).unwrap_or_default();
    let count = |kind| files.iter().filter(|file| file.kind == kind).count();
    let bytes: u64 = files.iter().map(|file| file.bytes).sum();
    let described = || {
        format!(
            "{} tiles and {} panoramas, {:.1} MB in {}; --clear-cache removes them",
            count(CacheKind::Tile),
            count(CacheKind::Panoramas),
            bytes as f64 / 1e6,
            folder.display()
        )
    };
    (!files.is_empty()).then(described)
}

fn map(file: &Path) -> Result<Printed> {
    let (mesh, mapping_path) = ply::read_map(file)?;
    let path = match mapping_path {
        Some(path) if !path.map_from_lidar.is_empty() => {
            format!("{} poses of the mapping drive", path.map_from_lidar.len())
        }
        _ => "none".to_owned(),
    };
    let bounds = mesh.bounds();
    let mut rows = vec![
        ("triangles", mesh.triangles.len().to_string()),
        ("extent", extent(bounds)),
        ("path", path),
    ];
    rows.extend(unit_doubt(&bounds).map(|doubt| ("unit", doubt)));
    rows.extend(cache_of(file).map(|cache| ("cache", cache)));
    Ok(Printed::rows(&rows))
}

fn result(path: &Path) -> Result<Printed> {
    let results = LocalizationResults::read(path)?;
    let estimates = results.estimates_or_particle_means(&RangeMclRules::default())?;
    let summary = RunSummary::of(&results, &estimates);
    let yes = |is: bool| if is { "yes" } else { "no" }.to_owned();
    let mut rows: Vec<(&str, String)> = (summary.rows().into_iter())
        .filter(|row| row.value != Value::Absent)
        .map(|row| (row.name, format!("{} {}", row.value, row.unit)))
        .collect();
    rows.push(("refined", yes(results.refined.is_some())));
    rows.push(("true poses", yes(results.ground_truth.is_some())));
    Ok(Printed::rows(&rows))
}
