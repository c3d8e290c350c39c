//! The true poses of a result: where they are from, and how they are matched and aligned.

use std::path::Path;

use anyhow::{Result, ensure};

use crate::app::commands::stages::RecordingInputs;
use crate::app::report::LocalizationResults;
use crate::app::run::input;
use crate::app::settings::{EvaluationConfig, LocalizationConfig, RecordingConfig};
use crate::evaluation::{Alignment, aligned};
use crate::geometry::{Pose2, Pose3, pose2_from_pose3, pose3_from_pose2};
use crate::recording::track::may_be_missing;
use crate::recording::{Frame, PointFormat, PoseTrack, ScanSource, is_topic};

/// Difference of times that are the same [s].
const SAME_S: f64 = 1e-4;

/// Positions that determine no rigid alignment.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the positions are on a straight line, which determines no rigid alignment; set alignment to first"
)]
pub struct NoRigidAlignment;

/// Reads the configured true poses: `pose_file`, which may be a topic of the recording, else those that the recording
/// contains. The recording of a topic is by default that of the localization.
pub fn read_track(
    config: &EvaluationConfig,
    localized: Option<&LocalizationConfig>,
) -> Result<Option<PoseTrack>> {
    let scan_folder = config.scan_folder.as_deref();
    let of_localization = localized.map(|it| it.recording.scan_folder.as_path());
    let topic = config.topic.as_ref();
    let recording = RecordingConfig {
        scan_folder: scan_folder
            .or(of_localization)
            .unwrap_or(Path::new(""))
            .into(),
        layout: (config.layout).or(localized.and_then(|it| it.recording.layout)),
        topic: topic
            .or(localized.and_then(|it| it.recording.topic.as_ref()))
            .cloned(),
        ..RecordingConfig::default()
    };
    let inputs = RecordingInputs::new(&recording, &config.given_poses);
    let mut files = inputs.files();
    // Without poses of its own, the recording is not read.
    files.retain(|&(key, _)| key != "scan_folder");
    input::require(&files)?;
    let recording = || inputs.open();
    match &config.given_poses.pose_file {
        Some(path) => {
            if is_topic(path) {
                return inputs.track(path, &recording()?).map(Some);
            }
            config.given_poses.track(path).map(Some)
        }
        None if scan_folder.is_some() => Ok(Some(recording()?.own_track()?)),
        None => Ok(None),
    }
}

/// The results with their true poses: by time where both have one, interpolated between two rows of the track, else by
/// number. Results without a true pose are left out with a warning: by time up to half of them, by number one and a hundredth
/// of all.
pub fn with_truth(
    mut results: LocalizationResults,
    track: &PoseTrack,
    result_file: &Path,
) -> Result<LocalizationResults> {
    let poses = match (results.recorded_times(), &track.times_s) {
        (Some(times_s), Some(true_times_s)) => {
            poses_by_time(&results, times_s, track, true_times_s, result_file)?
        }
        _ => poses_by_number(&results, track, result_file)?,
    };
    let rows: Vec<usize> = (0..poses.len())
        .filter(|&row| poses[row].is_some())
        .collect();
    if rows.len() < results.len() {
        results = results.select(&rows);
    }
    let truth: Vec<Pose3> = poses.into_iter().flatten().collect();
    results.ground_truth = Some(truth.iter().map(pose2_from_pose3).collect());
    results.ground_truth_in_space = Some(truth.into());
    Ok(results)
}

fn poses_by_time(
    results: &LocalizationResults,
    times_s: &[f64],
    track: &PoseTrack,
    true_times_s: &[f64],
    result_file: &Path,
) -> Result<Vec<Option<Pose3>>> {
    let (first_s, last_s) = (true_times_s[0], true_times_s[true_times_s.len() - 1]);
    // An extrapolated pose is no truth.
    let covered = first_s - SAME_S..=last_s + SAME_S;
    let frames = results.frames.iter().zip(times_s);
    let poses: Vec<Option<Pose3>> = frames
        .map(|(&number, &time_s)| {
            let source = ScanSource::File {
                path: result_file.to_owned(),
                stamp_s: None,
                format: PointFormat::default(),
            };
            let frame = Frame::new(number, source, time_s);
            let pose = track.pose_at(&frame, true);
            pose.filter(|_pose| covered.contains(&time_s))
        })
        .collect();
    let (count, found) = (poses.len(), poses.iter().flatten().count());
    let ranges = || {
        format!(
            "those of {} are from {:.3} to {:.3} s, and the {} true poses of {} from {first_s:.3} to {last_s:.3} s",
            result_file.display(),
            times_s.first().copied().unwrap_or_default(),
            times_s.last().copied().unwrap_or_default(),
            true_times_s.len(),
            track.path.display(),
        )
    };
    ensure!(
        found > 0 && 2 * found >= count,
        "only {found} of {count} poses have a true pose at their time: {}; give the truth of this drive with times of the same clock, or select the frames that it covers with start_idx and n_scans",
        ranges()
    );
    if found < count {
        tracing::warn!(
            "{} of {count} poses are left out, because there is no true pose at their time: {}",
            count - found,
            ranges()
        );
    }
    Ok(poses)
}

fn poses_by_number(
    results: &LocalizationResults,
    track: &PoseTrack,
    result_file: &Path,
) -> Result<Vec<Option<Pose3>>> {
    let poses = &track.map_from_lidar;
    let last = results.frames.last().copied().unwrap_or_default();
    let is_missing = |frame: &&usize| **frame >= poses.len();
    let missing = results.frames.iter().filter(is_missing).count();
    ensure!(
        may_be_missing(missing, results.len()),
        "{} has {} poses, but the result reaches frame {last}, and without times of both they are matched by number: pose_file and result_file belong to different recordings; give the truth of this recording, or give times to both (times.txt of the scans; TUM)",
        track.path.display(),
        poses.len()
    );
    let counts_differ = results.particles.is_empty() && last + 1 != poses.len();
    // Rows with times are of scans that were chosen by them, such as those that `localize` trusts.
    let chosen_by_time = results.estimates.is_none() && results.recorded_times().is_some();
    ensure!(
        !(counts_differ && chosen_by_time),
        "{} has {} poses with times, and {} has {} without, so that it is unknown which of them belong together; give both times (times.txt of the scans; TUM)",
        result_file.display(),
        results.len(),
        track.path.display(),
        poses.len()
    );
    if missing > 0 {
        tracing::warn!(
            "{} has no pose for the last {missing} of {} frames, which are left out",
            track.path.display(),
            results.len()
        );
    }
    if counts_differ {
        tracing::warn!(
            "{} ends at row {last}, and the {} rows of {} are matched by number; give both times (TUM) if they do not begin at the same frame",
            result_file.display(),
            poses.len(),
            track.path.display()
        );
    }
    Ok((results.frames.iter())
        .map(|&frame| poses.get(frame).copied())
        .collect())
}

/// Aligns the estimates and the refined trajectory with the truth, each by a transform of its own, which its trusted poses
/// determine; [`NoRigidAlignment`] if they do not.
pub fn align(results: &mut LocalizationResults, alignment: Alignment) -> Result<()> {
    if alignment == Alignment::None {
        return Ok(());
    }
    let truth = results.ground_truth.clone().unwrap_or_default();
    let truth_in_space = results.ground_truth_in_space.clone();
    let [of_filter, of_refined] = [results.trusted(), results.refined_trusted()];
    for (trusted, poses, in_space, trajectory, covariances) in [
        (
            of_filter,
            &mut results.estimates,
            &mut results.estimates_in_space,
            &mut results.trajectory_in_space,
            &mut results.covariances,
        ),
        (
            of_refined,
            &mut results.refined,
            &mut results.refined_in_space,
            &mut None,
            &mut results.refined_covariances,
        ),
    ] {
        let transform = |estimates: &[Pose3], truth: &[Pose3]| {
            let [estimates, truth] = [estimates, truth].map(|poses| select(poses, &trusted));
            alignment.transform(&estimates, &truth)
        };
        // Where frames were filled back, the trajectory has their poses.
        let best = trajectory.as_ref().or(in_space.as_ref());
        let transform = match (best, &truth_in_space, &*poses) {
            (Some(estimates), Some(truth), _) => transform(estimates, truth),
            (_, _, Some(estimates)) => transform(&level(estimates), &level(&truth)),
            _ => continue,
        };
        let transform = transform.ok_or(NoRigidAlignment)?;
        let turn = pose2_from_pose3(&transform).rotation;
        let turn = turn.to_rotation_matrix().to_homogeneous();
        for covariance in covariances.iter_mut().flatten() {
            *covariance = turn * *covariance * turn.transpose();
        }
        if let Some(trajectory) = trajectory {
            *trajectory = aligned(&transform, trajectory).into();
        }
        if let Some(poses) = poses {
            let moved = aligned(&transform, &level(poses));
            *poses = moved.iter().map(pose2_from_pose3).collect();
        }
        if let Some(estimates) = in_space {
            *estimates = aligned(&transform, estimates).into();
        }
        if let (Some(poses), Some(in_space)) = (poses, in_space) {
            *poses = in_space.iter().map(pose2_from_pose3).collect();
        }
    }
    Ok(())
}

/// The trusted poses; all, if none is.
fn select(poses: &[Pose3], trusted: &[bool]) -> Vec<Pose3> {
    let chosen = poses.iter().zip(trusted);
    let chosen: Vec<Pose3> = chosen.filter(|it| *it.1).map(|it| *it.0).collect();
    if chosen.is_empty() {
        poses.to_vec()
    } else {
        chosen
    }
}

fn level(poses: &[Pose2]) -> Vec<Pose3> {
    (poses.iter())
        .map(|pose| pose3_from_pose2(pose, 0.0))
        .collect()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::localization::State;

    #[test]
    fn poses_that_are_not_trusted_do_not_determine_the_alignment() {
        let [searching, tracking] = [State::Searching, State::Tracking].map(|it| it as u8);
        let truth: Vec<Pose2> = (0..20)
            .map(|k| Pose2::new([f64::from(k), (0.1 * f64::from(k)).sin()].into(), 0.1))
            .collect();
        let estimate_from_truth = Pose2::new([5.0, -3.0].into(), 0.4);
        let mut estimates: Vec<Pose2> = truth.iter().map(|it| estimate_from_truth * it).collect();
        estimates[0] = Pose2::new([-70.0, 40.0].into(), 2.0);
        let mut states = vec![tracking; 20];
        states[0] = searching;
        for alignment in [Alignment::First, Alignment::Rigid] {
            let mut results = LocalizationResults {
                frames: (0..20).collect(),
                estimates: Some(estimates.clone().into()),
                ground_truth: Some(truth.clone().into()),
                states: Some(states.clone().into()),
                ..LocalizationResults::default()
            };
            align(&mut results, alignment).unwrap();
            let found = results.estimates.unwrap();
            for (found, truth) in found.iter().zip(&truth).skip(1) {
                assert_relative_eq!(found, truth, epsilon = 1e-9);
            }
        }
    }

    #[test]
    fn a_straight_line_is_an_error_of_its_own() {
        let line: Vec<Pose2> = (0..20)
            .map(|k| Pose2::translation(f64::from(k), 0.0))
            .collect();
        let mut results = LocalizationResults {
            frames: (0..20).collect(),
            estimates: Some(line.clone().into()),
            ground_truth: Some(line.into()),
            ..LocalizationResults::default()
        };
        align(&mut results, Alignment::First).unwrap();
        let error = align(&mut results, Alignment::Rigid).unwrap_err();
        assert!(error.is::<NoRigidAlignment>(), "{error:#}");
    }
}
