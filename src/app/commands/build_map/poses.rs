//! Poses of the scans of a map: given, polished, or from the scans themselves.

use std::fs;
use std::io::Write as _;
use std::path::Path;

use anyhow::{Context as _, Result, ensure};

use super::older::OlderMap;
use super::parts::{Role, not_listed};
use crate::app::commands::pose_remedy::remedy;
use crate::app::commands::stages::RecordingInputs;
use crate::app::commands::trajectory::{self, poses_next_to};
use crate::app::report::odometry;
use crate::app::run::artefact::hash::hash_of_texts;
use crate::app::run::memory;
use crate::app::run::{Context, output, version};
use crate::app::settings::BuildMapConfig;
use crate::geometry::StampedPose;
use crate::map::PoseSource;
use crate::mapping::{self, MappingError, PoseReport, PoseSearch, TrajectorySummary};
use crate::odometry::PoseFit;
use crate::recording::poses::{read_tum, write_exact_tum};
use crate::recording::{Frame, Recording};
use crate::sensor::{Sensor, SensorConfig};

/// Start of the line of a file of poses with their summary.
const SUMMARY: &str = "# ";

/// Opens the recording with the poses that are given, if they are used.
pub fn open(config: &BuildMapConfig, older: Option<&OlderMap>) -> Result<Recording> {
    let inputs = RecordingInputs::new(&config.recording, &config.given_poses);
    let mut recording = config.inertial.open(inputs.open()?)?;
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
    Ok(mapping::with_given_poses(
        recording,
        config.map.poses,
        world.as_ref(),
    )?)
}

/// Checks the recording and its poses, warns of what is doubtful, and completes what is known about the sensor.
pub fn check(recording: Recording, config: &mut BuildMapConfig) -> Result<(Recording, Sensor)> {
    let track = recording.track.as_ref();
    let origin = track.map(|track| format!("pose_file is {}", track.path.display()));
    let checked = mapping::checked(recording, None, &config.map);
    let (recording, sensor, report) = checked.map_err(|error| explained(error, origin))?;
    if let Some(report) = report {
        warn_of(&report);
    }
    config.map.sensor = SensorConfig::from(&sensor);
    Ok((recording, sensor))
}

/// The recording with the poses of a search, and what they show about themselves. Both are kept in a file next to the map,
/// from which they are read where it belongs to the same scans; otherwise only a build finds them.
pub fn find(
    search: PoseSearch,
    has_times: bool,
    config: &BuildMapConfig,
    localized_by: &str,
    role: Role,
    context: &Context,
) -> Result<(Recording, TrajectorySummary)> {
    let path = poses_next_to(&config.mesh_file);
    let hash = inputs(&search, localized_by)?;
    let heading = format!("# fpmcl poses {hash}\n{SUMMARY}");
    let (summary, rows) = if let Some(kept) = kept_in(&path, &heading, &search.frames) {
        tracing::info!("the poses in {} are finished already", path.display());
        kept
    } else {
        ensure!(role == Role::Build, not_listed(&config.mesh_file));
        let (name, count) = (search.name(), search.frames.len());
        let found = trajectory::find(name, count, context, |on_event| {
            search.find(memory::budget(), on_event)
        })?;
        let summary = TrajectorySummary::new(&found, has_times);
        odometry::warn(&summary, None);
        let summary_line = serde_json::to_string(&summary.without_times())?;
        let rows = search.rows(&found);
        output::write_file(&path, |file| {
            writeln!(file, "{heading}{summary_line}")?;
            write_exact_tum(file, &rows)
        })?;
        (summary, rows)
    };
    context.interrupt.keeps(format!(
        "the poses are kept in {}; run the same command again to continue",
        path.display()
    ));
    let recording = search.into_recording(rows, summary.inertial.is_some());
    let origin = || format!("the poses from the scans are in {}", path.display());
    Ok((recording.with_context(origin)?, summary))
}

/// The summary and the rows of a file of poses with this heading and these frames.
fn kept_in(
    path: &Path,
    heading: &str,
    frames: &[Frame],
) -> Option<(TrajectorySummary, Vec<StampedPose>)> {
    let text = fs::read_to_string(path).ok()?;
    let summary = text.strip_prefix(heading)?.lines().next()?;
    let rows = read_tum(path).ok()?;
    let is_same = |(row, frame): (&StampedPose, &Frame)| row.time_s == frame.time_s;
    let are_same = rows.len() == frames.len() && rows.iter().zip(frames).all(is_same);
    are_same.then_some((serde_json::from_str(summary).ok()?, rows))
}

/// Hash of what the poses depend on, also the older map and how scans are localized there; of a scan its place and size.
fn inputs(search: &PoseSearch, localized_by: &str) -> Result<String> {
    let mut parts = vec![version::program()?, localized_by.to_owned()];
    for frame in &search.frames {
        let source = frame.source.to_string();
        let bytes = fs::metadata(Path::new(&source)).map_or(0, |file| file.len());
        let given = frame.map_from_lidar.filter(|_| search.is_given());
        parts.push(format!(
            "{source} {bytes} {} {:?} {} {} {given:?}",
            frame.time_s, frame.timing, frame.is_timed, frame.elevation_bias_rad
        ));
    }
    if let Some(imu) = search.imu() {
        parts.push(format!("{:?} {:?}", imu.lidar_from_imu, imu.samples.rows()));
    }
    Ok(hash_of_texts(&parts))
}

/// Warns where the poses are doubtful or the map is not level.
fn warn_of(report: &PoseReport) {
    match report.fit() {
        PoseFit::Fits => tracing::debug!("the poses fit the scans: {report}"),
        _ => tracing::warn!(
            "the poses fit the scans badly: {report}{}",
            remedy(report, "pose_file")
        ),
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
}

/// An error with what to do about it, and where the poses are from if it is about them.
fn explained(error: MappingError, origin: Option<String>) -> anyhow::Error {
    let origin = origin.unwrap_or_default();
    match &error {
        MappingError::PosesDoNotFit(report) => {
            anyhow::anyhow!("{error}{}", remedy(report, "pose_file")).context(origin)
        }
        MappingError::Path(_) => anyhow::Error::from(error).context(origin),
        _ => error.into(),
    }
}
