//! Checks of the given poses against the scans, before a map is built.

use anyhow::{Result, bail};
use nalgebra::Vector3;

use crate::geometry::Pose3;
use crate::lidar::Scan;
use crate::odometry::{
    GivenPoses, MotionDifference, OdometryConfig, PoseCheck, PoseFit, PoseMeaning, check_poses,
};
use crate::recording::{Frame, Recording};
use crate::sensor::mounting;

/// Number of scans whose motion is compared.
const SCANS: usize = 11;

/// Checks the poses of a recording whose scans are not compensated by them: an error where they are of another
/// motion, a warning where they are doubtful or the map is not level.
pub fn check(recording: &Recording) -> Result<()> {
    check_motion(recording)?;
    warn_of_tilt(recording)
}

fn check_motion(recording: &Recording) -> Result<()> {
    let (world_from_map, calibration) = recording.world();
    let run = moving_run(recording);
    let scans: Vec<Scan> = (run.iter())
        .map(|(frame, _)| frame.read())
        .collect::<Result<_, _>>()?;
    let poses: Vec<Pose3> = run.iter().map(|(_, pose)| *pose).collect();
    let given = GivenPoses {
        map_from_lidar: &poses,
        world_from_map,
        body_from_lidar: calibration.cam0_from_lidar,
    };
    let checked = check_poses(&scans, &given, &OdometryConfig::default())?;
    let (Some(checked), [(first, _), .., (last, _)]) = (checked, run.as_slice()) else {
        return Ok(());
    };
    let text = format!(
        "between frames {} and {}, {}",
        first.number,
        last.number,
        description(&checked)
    );
    match checked.fit {
        PoseFit::Fits => tracing::debug!("the poses fit the scans: {text}"),
        PoseFit::Doubtful => tracing::warn!("the poses fit the scans badly: {text}"),
        PoseFit::Wrong => bail!("the poses do not fit the scans: {text}"),
    }
    Ok(())
}

/// Consecutive frames with poses in which the sensor moves, near the middle of the recording.
fn moving_run(recording: &Recording) -> Vec<(&Frame, Pose3)> {
    /// Path that suffices [m].
    const PATH_M: f64 = 3.0;
    let mut frames: Vec<&Frame> = recording.frames.iter().chain(&recording.skipped).collect();
    frames.sort_by_key(|frame| frame.number);
    let pose_of = |frame: &Frame| match &recording.track {
        Some(track) => track.pose_at(frame, recording.has_times),
        None => frame.map_from_lidar,
    };
    let frames: Vec<_> = (frames.into_iter())
        .filter_map(|frame| Some((frame, pose_of(frame)?)))
        .collect();
    let path_m = |run: &[(&Frame, Pose3)]| -> f64 {
        let steps = run.windows(2);
        let step_m = |pair: &[(&Frame, Pose3)]| (pair[0].1.inverse() * pair[1].1).translation;
        steps.map(|pair| step_m(pair).vector.norm()).sum()
    };
    let middle = frames.len().saturating_sub(SCANS) / 2;
    let runs = frames.windows(SCANS.min(frames.len()).max(1)).enumerate();
    let best = runs.max_by(|(i, a), (j, b)| {
        let [a, b] = [a, b].map(|run| path_m(run).min(PATH_M));
        a.total_cmp(&b)
            .then(j.abs_diff(middle).cmp(&i.abs_diff(middle)))
    });
    best.map_or_else(Vec::new, |(_, run)| run.to_vec())
}

fn description(check: &PoseCheck) -> String {
    let difference = |difference: &MotionDifference| {
        format!(
            "{:.2} m and {:.1} degrees",
            difference.translation_m,
            difference.rotation_rad.to_degrees()
        )
    };
    let mut text = format!(
        "their motion differs by {} per frame from that of the scans, which is {}",
        difference(&check.given),
        difference(&check.motion)
    );
    text += &match &check.better {
        Some((meaning, better)) => {
            let (name, advice) = meaning_and_advice(*meaning);
            format!("; as {name} they differ by {}: {advice}", difference(better))
        }
        None if check.fit == PoseFit::Fits => String::new(),
        None => "; check that pose_file belongs to this recording, and that calib_file or body_from_lidar describe the body whose poses it has".to_owned(),
    };
    text
}

fn meaning_and_advice(meaning: PoseMeaning) -> (&'static str, String) {
    match meaning {
        PoseMeaning::Given => ("given", String::new()),
        PoseMeaning::Camera => (
            "poses of a camera",
            "give calib_file with the line Tr".to_owned(),
        ),
        PoseMeaning::Lidar => (
            "poses of the lidar itself",
            "remove calib_file and body_from_lidar".to_owned(),
        ),
        PoseMeaning::Inverse => (
            "inverse poses (lidar_from_world)",
            "invert the rows of pose_file".to_owned(),
        ),
        PoseMeaning::Turned(rad) => (
            "poses of a body about whose z axis the lidar is turned",
            format!(
                "give body_from_lidar with a yaw of {:.0} degrees",
                rad.to_degrees()
            ),
        ),
    }
}

/// Warns if the ground is not level in the map, or its direction up varies along the drive.
fn warn_of_tilt(recording: &Recording) -> Result<()> {
    /// Number of scans whose ground is found, spread over the recording.
    const GROUNDS: usize = 5;
    /// Largest tilt of the map, and deviation of single scans [deg].
    const TILT_DEG: f64 = 15.0;
    const SPREAD_DEG: f64 = 10.0;
    let step = recording.frames.len().div_ceil(GROUNDS).max(1);
    let frames = recording.frames.iter().step_by(step);
    let poses: Vec<Pose3> = (frames.clone())
        .map(|frame| frame.map_from_lidar.unwrap_or_default())
        .collect();
    let scans: Vec<Scan> = frames.map(|frame| frame.read()).collect::<Result<_, _>>()?;
    let grounds = mounting::Surroundings::of(&scans).scans;
    let ups: Vec<Vector3<f64>> = (grounds.iter().zip(poses))
        .filter_map(|((_, plane), pose)| {
            let up = (*plane)?.up.as_dvec3();
            Some(pose.rotation * Vector3::new(up.x, up.y, up.z))
        })
        .collect();
    let Some((tilt, spread)) = mounting::tilt(&ups) else {
        return Ok(());
    };
    let [tilt_deg, spread_deg] = [tilt, spread].map(f64::to_degrees);
    if spread_deg > SPREAD_DEG {
        tracing::warn!(
            "the direction up of the ground varies by {spread_deg:.0} degrees along the drive: check the rotations in pose_file, calib_file and body_from_lidar"
        );
    } else if tilt_deg > TILT_DEG {
        tracing::warn!(
            "the ground is tilted by {tilt_deg:.0} degrees in the map, whose frame is that of the lidar in the first row of the poses: turn scans and poses so that its z axis points up"
        );
    }
    Ok(())
}
