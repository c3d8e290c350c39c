//! Checks of the poses of a recording against its scans.

use nalgebra::Vector3;

use super::error::MappingError;
use super::pose_report::{PoseReport, Tilt};
use crate::geometry::Pose3;
use crate::lidar::Scan;
use crate::odometry::{GivenPoses, OdometryConfig, PoseCheck, PoseFit, check_poses};
use crate::recording::{Frame, PoseTrack, Recording};
use crate::sensor::mounting;

/// Number of scans whose motion is compared.
const SCANS: usize = 11;

impl PoseReport {
    /// Checks the poses of a recording whose scans are not yet deskewed by them.
    pub(crate) fn new(recording: &Recording) -> Result<Self, MappingError> {
        let track = recording.track.as_ref();
        Ok(Self {
            tilt: tilt(recording)?,
            ..Self::of_motion(recording, track)?
        })
    }

    /// Checks the motion of a track, such as that of an odometry, against the scans of a recording; without a track that of
    /// its poses. The ground is not compared.
    pub(crate) fn of_motion(
        recording: &Recording,
        track: Option<&PoseTrack>,
    ) -> Result<Self, MappingError> {
        let known = known_poses(recording, track);
        let mut runs = vec![moving_run(&known), turning_run(&known)];
        runs.dedup_by_key(|run| run.as_ptr());
        let mut checked = Vec::new();
        for run in runs {
            checked.push((run, check_motion(track, run)?));
        }
        let fit = |motion: &Option<PoseCheck>| motion.as_ref().map(|it| it.fit);
        let worst = checked
            .into_iter()
            .rev()
            .max_by_key(|(_, motion)| fit(motion));
        let (run, motion) = worst.unwrap_or_default();
        let ends = [run.first(), run.last()];
        Ok(Self {
            frames: ends.map(|end| end.map_or(0, |(frame, _)| frame.number)),
            motion,
            tilt: None,
        })
    }

    /// An error where the poses are of another motion than that of the scans.
    pub(crate) fn require_fit(&self) -> Result<(), MappingError> {
        match self.fit() {
            PoseFit::Wrong => Err(MappingError::PosesDoNotFit(Box::new(self.clone()))),
            PoseFit::Fits | PoseFit::Doubtful => Ok(()),
        }
    }
}

fn check_motion(
    track: Option<&PoseTrack>,
    run: &[(&Frame, Pose3)],
) -> Result<Option<PoseCheck>, MappingError> {
    let frames = track.map(|it| (it.world_from_map, it.calibration.cam0_from_lidar));
    let (world_from_map, body_from_lidar) = frames.unwrap_or_default();
    let scans: Vec<Scan> = (run.iter())
        .map(|(frame, _)| frame.read())
        .collect::<Result<_, _>>()?;
    let poses: Vec<Pose3> = run.iter().map(|(_, pose)| *pose).collect();
    let given = GivenPoses {
        map_from_lidar: &poses,
        world_from_map,
        body_from_lidar,
    };
    let checked = check_poses(&scans, &given, &OdometryConfig::default())?;
    Ok(checked.filter(|_| run.len() > 1))
}

/// The frames that have poses, in order: those of a track, or else their own.
fn known_poses<'a>(recording: &'a Recording, track: Option<&PoseTrack>) -> Vec<(&'a Frame, Pose3)> {
    let mut frames: Vec<&Frame> = recording.frames.iter().chain(&recording.skipped).collect();
    frames.sort_by_key(|frame| frame.number);
    let pose_of = |frame: &Frame| match track {
        Some(track) => track.pose_at(frame, recording.has_times),
        None => frame.map_from_lidar,
    };
    (frames.into_iter())
        .filter_map(|frame| Some((frame, pose_of(frame)?)))
        .collect()
}

/// Consecutive frames in which the sensor moves, near the middle of the recording.
fn moving_run<'a, 'b>(frames: &'a [(&'b Frame, Pose3)]) -> &'a [(&'b Frame, Pose3)] {
    /// Path that suffices [m].
    const PATH_M: f64 = 3.0;
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
    best.map_or(&[], |(_, run)| run)
}

/// Consecutive frames in which the sensor turns most: a straight path looks the same mirrored.
fn turning_run<'a, 'b>(frames: &'a [(&'b Frame, Pose3)]) -> &'a [(&'b Frame, Pose3)] {
    let turn_rad = |run: &[(&Frame, Pose3)]| {
        let ends = run.first().zip(run.last());
        ends.map_or(0.0, |(first, last)| {
            first.1.rotation.angle_to(&last.1.rotation)
        })
    };
    let runs = frames.windows(SCANS.min(frames.len()).max(1));
    let best = runs.max_by(|a, b| turn_rad(a).total_cmp(&turn_rad(b)));
    best.unwrap_or(&[])
}

/// Whether the ground is level in the map, and its direction up the same along the drive.
fn tilt(recording: &Recording) -> Result<Option<Tilt>, MappingError> {
    /// Number of scans whose ground is found, spread over the recording.
    const GROUNDS: usize = 5;
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
    Ok(mounting::tilt(&ups).map(|(tilt_rad, spread_rad)| Tilt {
        tilt_rad,
        spread_rad,
    }))
}
