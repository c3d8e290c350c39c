//! The recording of a map, with its poses.

use std::fmt::Write as _;
use std::path::Path;

use anyhow::Result;

use super::files::prepare;
use super::older::{self, OlderMap};
use super::parts::{Parts, Role};
use super::poses;
use crate::app::commands::trajectory::poses_next_to;
use crate::app::run::artefact::hash::hash_of_debug;
use crate::app::run::{Claims, Context, version};
use crate::app::settings::{self, BuildMapConfig, OutputConfig};
use crate::file_path::{FilePath, text_of};
use crate::georeference::AlignedPath;
use crate::map::build::plan::{self, LocalMapPlan};
use crate::map::{MapBuilder, MapPlan};
use crate::mapping::{PoseSearch, TrajectorySummary, georeferenced, key_frames, poses_of};
use crate::recording::{Frame, Recording};
use crate::sensor::Sensor;

/// The recording of a map.
pub struct Opened {
    /// The configuration, with what the scans show about the sensor.
    pub config: BuildMapConfig,
    /// The recording with its poses.
    pub sequence: Recording,
    /// The sensor.
    pub sensor: Sensor,
    /// What the poses show about themselves, where they were found in this run.
    pub trajectory: Option<TrajectorySummary>,
    /// The place of the map on the Earth, where fixes of a receiver are given.
    pub georeferenced: Option<AlignedPath>,
    /// The map to which the recording is added.
    pub older: Option<OlderMap>,
    /// The key scans that build the map.
    pub mapped: Vec<Frame>,
    /// The key scans that are held out to evaluate it.
    pub held_out: Vec<Frame>,
    /// The local maps that are finished.
    pub parts: Parts,
}

/// Opens the recording with its poses, or finds them, which only a build does, and completes the configuration by what the
/// scans show about the sensor. The parts are locked before anything changes.
pub fn open(config: &BuildMapConfig, role: Role, context: &Context) -> Result<(Opened, Claims)> {
    if role != Role::Build {
        // Where no jobs are listed, nothing is left behind.
        Parts::lock(&config.mesh_file, role)?;
    }
    let mut claims = prepare(config, context)?;
    let parts = Parts::lock(&config.mesh_file, role)?;
    let mut config = config.clone();
    let (older, older_map) = older::open(&config, context)?.unzip();
    let recording = poses::open(&config, older.as_ref())?;
    let (mut sequence, sensor) = poses::check(recording, &mut config)?;
    let gnss = config.gnss.read(&sequence)?;
    let mut trajectory = None;
    if PoseSearch::is_needed(&sequence, &config.map) {
        let has_times = sequence.has_times;
        let search = PoseSearch::new(sequence, &sensor, older_map.as_ref(), &config.map);
        let search = search.with_gnss(gnss.as_ref());
        let mut localized_by = older.as_ref().map_or_else(String::new, |older| {
            let map = &config.map;
            format!("{}{sensor:?}{:?}{}", older.hash, map.ground, map.seed)
        });
        if let Some(gnss) = &gnss {
            write!(localized_by, "{gnss:?}")?;
        }
        let found = poses::find(search, has_times, &config, &localized_by, role, context)?;
        (sequence, trajectory) = (found.0, Some(found.1));
    } else if let Some(name) = poses_next_to(&config.mesh_file).file_name()
        && role == Role::Build
    {
        claims.remove(&[&text_of(Path::new(name))])?;
    }
    let georeferenced = gnss
        .map(|gnss| georeferenced(&sequence, &gnss))
        .transpose()?;
    let sequence = sequence.compensated_by_poses();
    let (mapped, held_out) = hold_out(&sequence.frames, &config);
    parts.keep_those_of(&inputs_of(&config, &mapped, older.as_ref())?)?;
    let opened = Opened {
        config,
        sequence,
        mapped,
        held_out,
        sensor,
        trajectory,
        georeferenced,
        older,
        parts,
    };
    Ok((opened, claims))
}

impl Opened {
    /// The local maps of the key scans.
    pub fn local_maps(&self) -> Vec<LocalMapPlan> {
        let poses = poses_of(&self.mapped);
        let config = &self.config.map;
        plan::local_maps(&poses, config.local_map_size, config.overlap_m)
    }

    /// The plan of a builder for the key scans, which are added to the older map where there is one.
    pub fn plan<'a>(&'a self, builder: &'a MapBuilder) -> Result<MapPlan<'a>> {
        let mut plan = builder.plan(&self.sensor, poses_of(&self.mapped))?;
        plan.older = self.older.as_ref().map(|older| &*older.mesh);
        Ok(plan)
    }
}

/// The key scans that build the map, and those that are held out to evaluate it.
fn hold_out(frames: &[Frame], config: &BuildMapConfig) -> (Vec<Frame>, Vec<Frame>) {
    let keys = key_frames(frames, config.map.displacement_threshold_m);
    let step = config.holdout_step;
    let is_held_out = |row: usize| step > 0 && row % step == step - 1;
    let frames_where = |held_out: bool| {
        let rows = keys.iter().enumerate();
        let rows = rows.filter(|&(row, _)| is_held_out(row) == held_out);
        rows.map(|(_, key)| key.clone()).collect()
    };
    (frames_where(false), frames_where(true))
}

/// Inputs on which all local maps depend: the program, the configuration without the paths of outputs,
/// the older map, and the poses. The content of the scans is recorded with each local map.
fn inputs_of(
    config: &BuildMapConfig,
    frames: &[Frame],
    older: Option<&OlderMap>,
) -> Result<String> {
    let relevant = BuildMapConfig {
        mesh_file: FilePath::default(),
        truth_mesh: None,
        output: OutputConfig::default(),
        ..config.clone()
    };
    let mut text = format!("# {}\n", version::program()?);
    text += &settings::to_yaml(&relevant)?;
    if let Some(older) = older {
        writeln!(text, "onto {}", older.hash)?;
    }
    if let Some(gyroscope) = frames.first().and_then(|frame| frame.gyroscope.as_ref()) {
        writeln!(text, "{}", hash_of_debug(gyroscope))?;
    }
    for frame in frames {
        let path = &frame.source;
        let pose = frame.map_from_lidar.unwrap_or_default();
        let (t, q) = (pose.translation.vector, pose.rotation.coords);
        writeln!(text, "{path} {t:?} {q:?} {:?}", frame.motion)?;
    }
    Ok(text)
}
