//! `info`: what a recording, a scan, a map or a result contains, and what is missing for which command.

use std::fmt;
use std::path::Path;

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::json;

use crate::app::report::georeference::GeoreferenceReport;
use crate::app::report::results::Value;
use crate::app::report::{LocalizationResults, RunSummary};
use crate::app::run::arguments::{settings_parser, yaml};
use crate::app::run::{MachineArgs, Printed, RecordingArgs, gibibytes, input, memory};
use crate::app::settings;
use crate::evaluation::RangeMclRules;
use crate::file_path::FilePath;
use crate::geometry::Aabb;
use crate::lidar::Scan;
use crate::map::MapCache;
use crate::map::files::ply;
use crate::map::tiles::contents::{self, CacheKind};
use crate::map::unit_doubt;
use crate::recording::{Layout, PoseTrack, Recording, Selection, TimeSource, scan_files};
use crate::sensor::{BeamSource, Sensor, SensorConfig, spread_scans};
use crate::validation::{InvalidValue, Validate};

/// Arguments of `info`.
#[derive(Clone, Debug, Args)]
pub struct InfoArgs {
    /// Recording (its folder, the folder of its scans, or a bag), scan or point cloud (.bin, .pcd, .ply, .npy), map (.ply), or result (.npz).
    pub path: FilePath,

    /// The recording.
    #[command(flatten)]
    pub recording: RecordingArgs,

    /// Set the key topic, the topic of the scans in a bag with several, or a lidar or scene in a folder with several: topic=/NAME.
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = settings_parser())]
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
    /// Layout of the recording; `None`: as its files show.
    layout: Option<Layout>,
    /// Topic of the point clouds in a bag with several, or name of a lidar or scene in a folder with several.
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
    let layout =
        (args.recording.layout.iter()).map(|name| ("layout".to_owned(), yaml(&json!(name))));
    let settings: Vec<_> = args.settings.iter().cloned().chain(layout).collect();
    let config = settings::with_settings(InfoConfig::default(), &settings)?;
    ensure!(
        path.exists(),
        "{} does not exist; give a recording (a folder or a bag), a scan or point cloud, a map (.ply) or a result (.npz)",
        path.display()
    );
    if args.clear_cache {
        clear_cache(path)?;
    }
    if path.is_dir() || input::is_bag(path) {
        recording(path, &config)
    } else if settings::is_result(path) {
        result(path)
    } else if scan_files::is_mesh(path) {
        map(path)
    } else if scan_files::is_scan(path) {
        cloud(path)
    } else {
        bail!(
            "{} is neither a recording (a folder, .mcap, .db3 or .bag) nor a scan or point cloud (.bin, .pcd, .ply, .npy) nor a map (.ply) nor a result (.npz)",
            path.display()
        )
    }
}

/// What a recording contains.
#[derive(Debug, Serialize, JsonSchema)]
pub struct RecordingInfo {
    /// Layout of its files.
    layout: &'static str,
    /// Number of scans.
    scans: usize,
    /// Number of the first scan.
    first_scan: usize,
    /// Number of the last scan.
    last_scan: usize,
    /// Time between the first and the last scan [s]; `None` without times.
    duration_s: Option<f64>,
    /// Where the times are from: `names` of the scans, `messages` of a bag, or a file; `None` without times.
    times_from: Option<String>,
    /// Mean number of points of a scan.
    points_per_scan: usize,
    /// Fields of the points: x, y and z, and those of intensity, ring and time that there are.
    fields: Vec<&'static str>,
    /// The sensor, as the scans show it.
    sensor: Sensor,
    /// Poses in the recording; `None` if there are none that can be read.
    poses: Option<PosesInfo>,
    /// Why the poses cannot be used, or that there are none; `None` if they can be.
    poses_problem: Option<String>,
}

/// Poses in a recording.
#[derive(Debug, Serialize, JsonSchema)]
struct PosesInfo {
    /// Their file, or their topic.
    path: FilePath,
    /// Number of rows.
    rows: usize,
    /// Time of the first row [s]; `None` where rows or scans have no times.
    first_s: Option<f64>,
    /// Time of the last row [s].
    last_s: Option<f64>,
}

fn recording(path: &Path, config: &InfoConfig) -> Result<Printed> {
    let topic = config.topic.as_deref();
    let (all, budget) = (Selection::default(), memory::budget());
    let recording = Recording::open_with(path, config.layout, topic, &all, budget)?;
    let frames = &recording.frames;
    let (first, last) = (&frames[0], &frames[frames.len() - 1]);
    let scans = spread_scans(&recording)?;
    let points = scans.iter().map(Scan::len).sum::<usize>() / scans.len();
    let has_times = recording.has_times;
    let track = recording.own_track();
    let poses = track.as_ref().ok().map(|it| PosesInfo::new(it, has_times));
    let problem = match &track {
        Ok(track) => (track.matched(frames, has_times).err()).map(|it| it.to_string()),
        Err(error) if error.is_absence() => Some("none in the recording".to_owned()),
        Err(error) => Some(error.to_string()),
    };
    let info = RecordingInfo {
        layout: recording.files.layout.name(),
        scans: frames.len(),
        first_scan: first.number,
        last_scan: last.number,
        duration_s: has_times.then_some(last.time_s - first.time_s),
        times_from: recording.time_source.as_ref().map(TimeSource::to_string),
        points_per_scan: points,
        fields: fields(&scans[0]),
        sensor: Sensor::infer_spread(&recording, &scans, &SensorConfig::default())?,
        poses,
        poses_problem: problem,
    };
    Printed::rows(&info.rows(), &info)
}

impl RecordingInfo {
    fn rows(&self) -> Vec<(&'static str, String)> {
        let times = match self.times_from.as_deref().unwrap_or_default() {
            "names" => "the names of the scans",
            "messages" => "the messages",
            path => path,
        };
        let duration = self.duration_s.map_or_else(
            || "unknown: there are no times, 10 scans per second are assumed".to_owned(),
            |duration_s| format!("{duration_s:.1} s, by the times in {times}"),
        );
        let scans = format!("{}, {} to {}", self.scans, self.first_scan, self.last_scan);
        let points = format!("{} ({})", self.points_per_scan, in_words(&self.fields));
        let mut rows = vec![
            ("layout", self.layout.to_owned()),
            ("scans", scans),
            ("duration", duration),
            ("points per scan", points),
        ];
        rows.extend(sensor_rows(&self.sensor));
        let poses = self.poses.as_ref().map(PosesInfo::in_words);
        let poses: Vec<String> = poses
            .into_iter()
            .chain(self.poses_problem.clone())
            .collect();
        let build_map = if self.poses_problem.is_none() {
            "ready".to_owned()
        } else {
            "ready; poses from the scans, or --poses FILE".to_owned()
        };
        rows.extend([
            ("poses", poses.join("; ")),
            ("build-map", build_map),
            ("localize", "ready; needs a map: --map MAP".to_owned()),
        ]);
        rows
    }
}

impl PosesInfo {
    fn new(track: &PoseTrack, has_times: bool) -> Self {
        let times_s = track.times_s.as_deref().filter(|_| has_times);
        Self {
            path: track.path.clone().into(),
            rows: track.map_from_lidar.len(),
            first_s: times_s.and_then(|it| it.first()).copied(),
            last_s: times_s.and_then(|it| it.last()).copied(),
        }
    }

    fn in_words(&self) -> String {
        let text = format!("{}: {} rows", self.path.display(), self.rows);
        match (self.first_s, self.last_s) {
            (Some(first_s), Some(last_s)) => format!("{text}, {first_s:.1} to {last_s:.1} s"),
            _ => text,
        }
    }
}

/// The fields of the points.
fn fields(scan: &Scan) -> Vec<&'static str> {
    let mut fields = vec!["x", "y", "z"];
    let has_intensity = scan.intensities.iter().any(|&value| value != 0.0);
    fields.extend(has_intensity.then_some("intensity"));
    fields.extend((!scan.rings.is_empty()).then_some("ring"));
    fields.extend((!scan.times_s.is_empty()).then_some("time"));
    fields
}

/// The fields in words: "x y z, intensity".
fn in_words(fields: &[&str]) -> String {
    [&[&*fields[..3].join(" ")], &fields[3..]]
        .concat()
        .join(", ")
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

/// What a single scan or a point cloud contains.
#[derive(Debug, Serialize, JsonSchema)]
pub struct CloudInfo {
    /// Number of points.
    points: usize,
    /// Fields of the points, as of a recording.
    fields: Vec<&'static str>,
    /// Size and heights.
    #[serde(flatten)]
    extent: Extent,
    /// Whether the points have normals.
    has_normals: bool,
    /// The sensor; `None` of a cloud without the rows of a scan.
    sensor: Option<Sensor>,
}

/// Size of a cloud or a map.
#[derive(Debug, Serialize, JsonSchema)]
struct Extent {
    /// Size along x [m].
    extent_x_m: f32,
    /// Size along y [m].
    extent_y_m: f32,
    /// Lowest z [m].
    lowest_m: f32,
    /// Highest z [m].
    highest_m: f32,
}

impl Extent {
    fn of(bounds: Aabb) -> Self {
        let size = bounds.max - bounds.min;
        Self {
            extent_x_m: size.x,
            extent_y_m: size.y,
            lowest_m: bounds.min.z,
            highest_m: bounds.max.z,
        }
    }
}

impl fmt::Display for Extent {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (x, y, low, high) = (
            self.extent_x_m,
            self.extent_y_m,
            self.lowest_m,
            self.highest_m,
        );
        write!(f, "{x:.0} x {y:.0} m, heights {low:.1} to {high:.1} m")
    }
}

fn cloud(path: &Path) -> Result<Printed> {
    /// Points of the largest scans; more are a cloud of many scans, which show no sensor.
    const MAX_SCAN: usize = 1_000_000;
    let cloud = scan_files::read_cloud(path)?;
    let scan = cloud.scan;
    let finite = scan.points.iter().filter(|point| point.is_finite());
    let mut info = CloudInfo {
        points: scan.len(),
        fields: fields(&scan),
        extent: Extent::of(Aabb::from_points(finite.copied())),
        has_normals: cloud.normals.is_some(),
        sensor: None,
    };
    if scan.len() <= MAX_SCAN {
        let sensor = Sensor::infer(std::slice::from_ref(&scan), &SensorConfig::default())?;
        info.sensor = Some(sensor).filter(|sensor| sensor.has_rows);
    }
    let points = format!("{} ({})", info.points, in_words(&info.fields));
    let mut rows = vec![
        ("layout", "a scan, or a point cloud".to_owned()),
        ("points", points),
        ("extent", info.extent.to_string()),
        ("normals", yes(info.has_normals)),
    ];
    rows.extend(info.sensor.iter().flat_map(sensor_rows));
    let needs = "needs the folder of several scans, and a map: --map MAP";
    rows.extend([
        ("build-map", "ready; as a point cloud".to_owned()),
        ("localize", needs.to_owned()),
    ]);
    Printed::rows(&rows, &info)
}

/// What a map contains.
#[derive(Debug, Serialize, JsonSchema)]
pub struct MapInfo {
    /// Number of triangles.
    triangles: usize,
    /// Size and heights.
    #[serde(flatten)]
    extent: Extent,
    /// Number of poses of the mapping drive; 0 in a map from elsewhere.
    path_poses: usize,
    /// Its place on the Earth, where it is known.
    georeference: Option<GeoreferenceReport>,
    /// Why its unit may not be the metre; `None` if its size is that of a place.
    unit_problem: Option<String>,
    /// Files that are kept next to the map; `None` where there are none.
    cache: Option<CacheInfo>,
}

/// Files that are kept next to a map, and made again where they are missing.
#[derive(Debug, Serialize, JsonSchema)]
struct CacheInfo {
    /// Their folder.
    folder: FilePath,
    /// Number of tiles.
    tiles: usize,
    /// Number of files of panoramas.
    panoramas: usize,
    /// Size of all of them [MB].
    megabytes: f64,
}

impl CacheInfo {
    fn of(map: &Path) -> Option<Self> {
        let folder = MapCache::NextToMap.folder_of(map).unwrap_or_default();
        // What cannot be read is not used either.
        let files = contents::files_of(&folder).unwrap_or_default();
        let count = |kind| files.iter().filter(|file| file.kind == kind).count();
        let bytes: u64 = files.iter().map(|file| file.bytes).sum();
        (!files.is_empty()).then(|| Self {
            tiles: count(CacheKind::Tile),
            panoramas: count(CacheKind::Panoramas),
            megabytes: bytes as f64 / 1e6,
            folder: folder.into(),
        })
    }

    fn in_words(&self) -> String {
        format!(
            "{} tiles and {} panoramas, {:.1} MB in {}; --clear-cache removes them",
            self.tiles,
            self.panoramas,
            self.megabytes,
            self.folder.display()
        )
    }
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

fn map(file: &Path) -> Result<Printed> {
    let (mesh, mapping_path) = ply::read_map(file)?;
    let bounds = mesh.bounds();
    let info = MapInfo {
        triangles: mesh.triangles.len(),
        extent: Extent::of(bounds),
        path_poses: (mapping_path.as_ref()).map_or(0, |path| path.map_from_lidar.len()),
        georeference: mapping_path
            .and_then(|path| path.georeference)
            .map(|it| GeoreferenceReport::of(&it))
            .transpose()?,
        unit_problem: unit_doubt(&bounds),
        cache: CacheInfo::of(file),
    };
    let path = match info.path_poses {
        0 => "none".to_owned(),
        count => format!("{count} poses of the mapping drive"),
    };
    let mut rows = vec![
        ("triangles", info.triangles.to_string()),
        ("extent", info.extent.to_string()),
        ("path", path),
    ];
    rows.extend(info.georeference.iter().flat_map(GeoreferenceReport::rows));
    rows.extend(info.unit_problem.iter().map(|it| ("unit", it.clone())));
    rows.extend(info.cache.iter().map(|it| ("cache", it.in_words())));
    Printed::rows(&rows, &info)
}

/// What a result contains.
#[derive(Debug, Serialize, JsonSchema)]
pub struct ResultInfo {
    /// What the run shows about itself.
    #[serde(flatten)]
    summary: RunSummary,
    /// Whether it has a refined trajectory.
    is_refined: bool,
    /// Whether it has the true poses.
    has_true_poses: bool,
}

fn result(path: &Path) -> Result<Printed> {
    let results = LocalizationResults::read(path)?;
    let estimates = results.estimates_or_particle_means(&RangeMclRules::default())?;
    let info = ResultInfo {
        summary: RunSummary::of(&results, &estimates),
        is_refined: results.refined.is_some(),
        has_true_poses: results.ground_truth.is_some(),
    };
    let mut rows: Vec<(&str, String)> = (info.summary.rows().into_iter())
        .filter(|row| row.value != Value::Absent)
        .map(|row| (row.name, format!("{} {}", row.value, row.unit)))
        .collect();
    rows.push(("refined", yes(info.is_refined)));
    rows.push(("true poses", yes(info.has_true_poses)));
    Printed::rows(&rows, &info)
}

fn yes(is: bool) -> String {
    if is { "yes" } else { "no" }.to_owned()
}
