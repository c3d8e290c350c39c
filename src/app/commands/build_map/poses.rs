//! Poses of the scans of a map: given, polished, or from the scans themselves.

use std::fs;
use std::io::Write as _;
use std::path::Path;

use anyhow::{Result, ensure};

use super::older::OlderMap;
use super::parts::{Role, not_listed};
use crate::app::commands::stages::RecordingInputs;
use crate::app::commands::trajectory;
use crate::app::report::odometry;
use crate::app::report::run_output::stamped;
use crate::app::run::artefact::hash::hash_of_texts;
use crate::app::run::memory;
use crate::app::run::{Context, output, version};
use crate::app::settings::BuildMapConfig;
use crate::geometry::Pose3;
use crate::map::{Map, PoseSource};
use crate::mapping::{
    self, MappingError, PoseReport, TrajectorySummary, find_poses, find_poses_in,
};
use crate::odometry::{PoseFit, PoseMeaning, TrajectoryConfig};
use crate::recording::poses::write_tum;
use crate::recording::{Frame, PoseTrack, Recording};
use crate::sensor::Sensor;

/// Start of the line of a file of poses with their summary.
const SUMMARY: &str = "# ";

/// Opens the recording with the poses that are given, if they are used.
pub fn open(config: &BuildMapConfig, older: Option<&OlderMap>) -> Result<Recording> {
    let inputs = RecordingInputs::new(&config.recording, &config.given_poses);
    let mut recording = inputs.open()?;
    let is_found = config.map.poses == PoseSource::Auto && older.is_some();
    if let Some(older) = older.filter(|_| is_found) {
        let map = older.file.display();
        match &config.given_poses.pose_file {
            Some(path) => tracing::warn!(
                "pose_file {} is not used: the poses are found from the scans in {map}; set poses to given if they are in the world of that map",
                path.display()
            ),
            None => tracing::info!(
                "the poses are found from the scans in {map}; set poses to given to use those of the recording"
            ),
        }
    } else if let Some(path) = &config.given_poses.pose_file
        && config.map.poses != PoseSource::Odometry
    {
        recording.track = Some(inputs.track(path, &recording)?);
    }
    let world = older.map(|older| older.path.world_from_map);
    let recording = mapping::with_given_poses(recording, config.map.poses, world.as_ref())?;
    if let Some(origin) = origin(&recording) {
        trajectory::check(&recording, config.map.max_step_m, &origin)?;
    }
    Ok(recording)
}

/// Where the poses of a recording are from.
pub fn origin(recording: &Recording) -> Option<String> {
    let track = recording.track.as_ref()?;
    Some(format!("pose_file is {}", track.path.display()))
}

/// The recording with poses from its scans, in an older map where there is one, or with its own ones polished, and what
/// they show about themselves. Both are kept in a file next to the map, from which they are read where it belongs to the
/// same scans; otherwise only a build finds them.
pub fn find(
    mut recording: Recording,
    sensor: &Sensor,
    config: &BuildMapConfig,
    older: Option<(&OlderMap, &Map)>,
    role: Role,
    context: &Context,
) -> Result<(Recording, Option<TrajectorySummary>)> {
    let path = trajectory::poses_next_to(&config.mesh_file);
    let is_given = recording.track.is_some();
    let frames = if is_given {
        recording.frames.clone()
    } else {
        recording.dense_frames()
    };
    let localized_by = match older {
        Some((older, _)) => format!("{}{sensor:?}{:?}", older.hash, config.map.ground),
        None => String::new(),
    };
    let hash = inputs(&frames, is_given, &localized_by)?;
    let heading = format!("# fpmcl poses {hash}\n");
    let found = fs::read_to_string(&path).unwrap_or_default();
    let found = found.strip_prefix(&heading).and_then(summary_in);
    let world = older.map(|(_, map)| map.path.world_from_map);
    let mut summary = found;
    if summary.is_some() {
        tracing::info!("the poses in {} are finished already", path.display());
    } else {
        ensure!(role == Role::Build, not_listed(&config.mesh_file));
        let settings = TrajectoryConfig::default();
        let name = match (older, is_given) {
            (Some(_), _) => "localize",
            (None, true) => "polish",
            (None, false) => "odometry",
        };
        let found = trajectory::find(name, frames.len(), context, |on_event| match older {
            Some((_, map)) => find_poses_in(map, &frames, sensor, &config.map, on_event),
            None => find_poses(&frames, is_given, &settings, memory::budget(), on_event),
        })?;
        let found_now = TrajectorySummary::new(&found, recording.has_times);
        odometry::warn(&found_now);
        let kept = serde_json::to_string(&found_now.without_times())?;
        summary = Some(found_now);
        // Rows of the lidar in the world of the given poses, or of the older map.
        let world_from_map = world.unwrap_or(recording.world().0);
        let poses: Vec<Pose3> = found
            .poses
            .iter()
            .map(|pose| world_from_map * pose)
            .collect();
        let stamped = stamped(&frames, &poses);
        output::write_file(&path, |file| {
            writeln!(file, "{heading}{SUMMARY}{kept}")?;
            write_tum(file, &stamped)
        })?;
    }
    context.interrupt.keeps(format!(
        "the poses are kept in {}; run the same command again to continue",
        path.display()
    ));
    // Its rows have the times of the frames, also where these are assumed.
    recording.has_times = true;
    let mut track = PoseTrack::read(&path, None)?;
    if let Some(world_from_map) = world {
        track = track.in_map(&world_from_map);
    }
    Ok((recording.with_poses(track)?, summary))
}

/// The summary of poses, after the heading of their file.
fn summary_in(text: &str) -> Option<TrajectorySummary> {
    serde_json::from_str(text.strip_prefix(SUMMARY)?.lines().next()?).ok()
}

/// Hash of what the poses depend on, also the older map and how scans are localized there; of a scan its place and size.
fn inputs(frames: &[Frame], is_given: bool, localized_by: &str) -> Result<String> {
    let mut parts = vec![version::program()?, localized_by.to_owned()];
    for frame in frames {
        let source = frame.source.to_string();
        let bytes = fs::metadata(Path::new(&source)).map_or(0, |file| file.len());
        let given = frame.map_from_lidar.filter(|_| is_given);
        parts.push(format!(
            "{source} {bytes} {} {:?} {} {given:?}",
            frame.time_s, frame.rotation, frame.is_timed
        ));
    }
    Ok(hash_of_texts(&parts))
}

/// Checks the poses of a recording whose scans are not compensated by them: an error where they are of another
/// motion, a warning where they are doubtful or the map is not level.
pub fn check(recording: &Recording, config: &BuildMapConfig) -> Result<()> {
    if !config.map.check_poses || recording.track.is_none() {
        return Ok(());
    }
    let report = PoseReport::new(recording)?;
    report.require_fit().map_err(with_remedy)?;
    match report.fit() {
        PoseFit::Fits => tracing::debug!("the poses fit the scans: {report}"),
        _ => tracing::warn!("the poses fit the scans badly: {report}{}", remedy(&report)),
    }
    match report.tilt {
        Some(tilt) if tilt.is_uneven() => tracing::warn!(
            "the normal of the ground varies by {:.0} degrees along the drive: check the rotations in pose_file, calib_file and body_from_lidar",
            tilt.spread_rad.to_degrees()
        ),
        Some(tilt) if tilt.is_steep() => tracing::warn!(
            "the ground is tilted by {:.0} degrees in the map, whose frame is that of the lidar in the first row of the poses: turn scans and poses so that its z axis points up",
            tilt.tilt_rad.to_degrees()
        ),
        _ => {}
    }
    Ok(())
}

fn with_remedy(error: MappingError) -> anyhow::Error {
    match &error {
        MappingError::PosesDoNotFit(report) => anyhow::anyhow!("{error}{}", remedy(report)),
        _ => error.into(),
    }
}

/// What to change in the configuration.
fn remedy(report: &PoseReport) -> String {
    match report.better() {
        None | Some(PoseMeaning::Given) => "; check that pose_file belongs to this recording, and that calib_file or body_from_lidar describe the body whose poses it has".to_owned(),
        Some(PoseMeaning::Camera) => ": give calib_file with the line Tr".to_owned(),
        Some(PoseMeaning::Lidar) => ": remove calib_file and body_from_lidar".to_owned(),
        Some(PoseMeaning::Inverse) => ": invert the rows of pose_file".to_owned(),
        Some(PoseMeaning::Turned(rad)) => format!(
            ": give body_from_lidar with a yaw of {:.0} degrees",
            rad.to_degrees()
        ),
    }
}
