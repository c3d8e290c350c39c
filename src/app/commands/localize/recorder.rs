//! Results of localize, collected frame by frame.

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Result;
use bytemuck::Pod;

use super::frame_tracker::TrackedFrame;
use super::opened::Opened;

use crate::app::report::LocalizationResults;
use crate::app::report::results::{
    Column, LiveSummary, ParticleLog, ResultWriter, RowLog, ScanOutline, unknown_pose,
};
use crate::app::report::run_output::{self, Movie};
use crate::app::run::{Claims, Interrupted};
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::{Motion, Scan};
use crate::localization::{Distortion, State};
use crate::recording::{Frame, ScanSource};

/// A column of the results, where it is kept.
fn column<T: Pod>(is_kept: bool, folder: &Path) -> Option<Column<T>> {
    is_kept.then(|| Column::in_folder(folder))
}

/// The localized frames.
pub struct Run {
    pub results: LocalizationResults,
    /// The result on its way into its file; `None` once it is there, and if it is not kept.
    writer: Option<ResultWriter>,
    /// Numbers of the frames to localize.
    selected: Vec<usize>,
    result_path: PathBuf,
    /// The claimed outputs.
    pub claims: Claims,
    /// Pictures of the frames, if they were requested.
    pub movie: Option<Movie>,
    /// Number of frames without mapped ground below the estimate.
    off_ground: usize,
    /// What is wrong with all scans, and the number of frames in which it was certain.
    distorted: Option<(Distortion, usize)>,
    /// Number of frames that were left out: of a recording that is replayed, those that nobody waited for.
    pub missed: usize,
    /// What a run at the pace of the recording showed.
    pub live: Option<LiveSummary>,
    /// The error that ended the run before its last frame.
    pub failure: Option<anyhow::Error>,
}

impl Run {
    pub fn new(opened: &Opened, claims: Claims) -> Result<Self> {
        let config = &opened.config;
        let (has_truth, is_refined) = (config.given_poses.pose_file.is_some(), config.refine);
        let folder = opened.files.folder();
        let selected: Vec<usize> = (opened.recording.frames.iter())
            .map(|frame| frame.number)
            .collect();
        let rows = selected.len();
        let mut run = Self {
            results: LocalizationResults {
                frames: Column::in_folder(folder),
                particles: ParticleLog::new(config.tracker.localizer.num_particles, folder),
                estimates: column(true, folder),
                refined: column(is_refined, folder),
                ground_truth: column(has_truth, folder),
                estimates_in_space: column(true, folder),
                refined_in_space: column(is_refined, folder),
                ground_truth_in_space: column(has_truth, folder),
                odometry: column(true, folder),
                covariances: column(true, folder),
                refined_covariances: column(is_refined, folder),
                times_s: column(true, folder),
                runtimes_s: column(true, folder),
                refine_runtimes_s: column(is_refined, folder),
                agreements: column(true, folder),
                places: column(true, folder),
                states: column(true, folder),
                trajectory_in_space: None,
                trajectory_states: None,
                refined_states: column(is_refined, folder),
                refinement_costs_m: column(is_refined, folder),
                refinement_agreements: column(is_refined, folder),
                scan_outlines: (rows <= ScanOutline::MOST_FRAMES)
                    .then(|| RowLog::in_folder(folder)),
                selected: (!opened.is_driving()).then_some(rows),
                times_are_assumed: !opened.recording.has_times,
            },
            writer: None,
            selected,
            result_path: opened.files.result.clone(),
            claims,
            movie: if config.visualize {
                Some(Movie::begin(&opened.files, &opened.map)?)
            } else {
                None
            },
            off_ground: 0,
            distorted: None,
            missed: 0,
            live: None,
            failure: None,
        };
        if config.save_result {
            run.begin_result()?;
        }
        Ok(run)
    }

    /// Begins the file of the result with the frames so far.
    fn begin_result(&mut self) -> Result<()> {
        let writer = self.results.writer(&self.result_path, &self.selected)?;
        self.writer = Some(writer);
        Ok(())
    }

    /// Completes the file of the result, once.
    pub fn finish_result(&mut self) -> Result<()> {
        let finish = |writer: ResultWriter| writer.finish(&self.results);
        self.writer.take().map_or(Ok(()), finish)
    }

    /// Adds a frame.
    pub fn record(&mut self, frame: &Frame, scan: &Scan, tracked: &TrackedFrame) -> Result<()> {
        fn push<T: Pod>(column: &mut Option<Column<T>>, value: T) {
            if let Some(column) = column {
                column.push(value);
            }
        }
        let TrackedFrame {
            motion,
            estimate,
            refined,
            runtimes: [runtime, refine_runtime],
        } = tracked;
        let increment = motion.map(|motion| motion.increment);
        let results = &mut self.results;
        let particles = run_output::particle_rows(&estimate.particles);
        results.particles.push_frame(&particles)?;
        self.off_ground += usize::from(!estimate.on_mapped_ground);
        if let Some(distortion) = estimate.distortion {
            let frames = self.distorted.map_or(0, |(_, frames)| frames);
            self.distorted = Some((distortion, frames + 1));
        }
        push(&mut results.estimates, estimate.pose);
        let truth = frame.map_from_lidar.unwrap_or_else(unknown_pose);
        push(&mut results.ground_truth, pose2_from_pose3(&truth));
        push(&mut results.ground_truth_in_space, truth);
        push(
            &mut results.odometry,
            increment.unwrap_or_else(Pose2::identity),
        );
        push(&mut results.covariances, estimate.covariance);
        let motion = (results.times_s.as_ref().and_then(|all| all.last()))
            .zip(
                results
                    .estimates_in_space
                    .as_ref()
                    .and_then(|all| all.last()),
            )
            .map(|(&before_s, before)| Motion {
                previous_from_current: before.inverse() * estimate.map_from_lidar,
                duration_s: frame.time_s - before_s,
            });
        let motion = motion.filter(|motion| motion.duration_s > 0.0);
        if let Some(outlines) = &mut results.scan_outlines {
            outlines.push(&ScanOutline::of(scan, motion.as_ref()).0)?;
        }
        results.frames.push(frame.number);
        push(&mut results.times_s, frame.time_s);
        push(&mut results.runtimes_s, runtime.as_secs_f64());
        push(&mut results.agreements, estimate.agreement.unwrap_or(-1.0));
        push(&mut results.places, estimate.places as f64);
        push(&mut results.states, estimate.state as u8);
        let refined_pose = refined.map_or(estimate.pose, |refined| refined.pose);
        let covariance = refined.map_or(estimate.covariance, |refined| refined.covariance);
        let in_space = refined.and_then(|refined| refined.map_from_lidar);
        let refined_in_space = in_space.unwrap_or(estimate.map_from_lidar);
        push(&mut results.estimates_in_space, estimate.map_from_lidar);
        push(&mut results.refined_in_space, refined_in_space);
        push(&mut results.refined, refined_pose);
        push(&mut results.refined_covariances, covariance);
        let state = refined.map_or(estimate.state, |refined| refined.state);
        push(&mut results.refined_states, state as u8);
        let change = refined.and_then(|it| it.change);
        let (costs_m, agreements) = run_output::before_and_after(change);
        push(&mut results.refinement_costs_m, costs_m);
        push(&mut results.refinement_agreements, agreements);
        push(&mut results.refine_runtimes_s, refine_runtime.as_secs_f64());
        if results.len() > ScanOutline::MOST_FRAMES {
            results.scan_outlines = None;
        }
        if let Some(writer) = &mut self.writer {
            if particles.len() > writer.capacity() {
                self.begin_result()?;
            } else {
                writer.push(&self.results, self.results.len() - 1)?;
            }
        }
        if let Some(movie) = &mut self.movie {
            movie.add(&self.results, estimate)?;
        }
        Ok(())
    }

    /// The localized frames.
    pub fn frames<'a>(&self, opened: &'a Opened) -> Cow<'a, [Frame]> {
        if opened.is_driving() {
            let forgotten = Arc::<Scan>::default();
            let frame = |(&number, &time_s)| {
                Frame::new(number, ScanSource::Memory(forgotten.clone()), time_s)
            };
            let times_s = self.results.times_s.iter().flatten();
            return self.results.frames.iter().zip(times_s).map(frame).collect();
        }
        let (all, localized) = (&opened.recording.frames, &self.results.frames);
        // Both ascend.
        let first = all.get(..localized.len()).unwrap_or_default();
        if first.last().map(|frame| frame.number) == localized.last().copied() {
            return first.into();
        }
        let is_localized = |frame: &&Frame| localized.binary_search(&frame.number).is_ok();
        all.iter().filter(is_localized).cloned().collect()
    }

    /// Number of frames to localize; of a robot, those that arrived.
    fn expected(&self, opened: &Opened) -> usize {
        if opened.is_driving() {
            self.results.len() + self.missed
        } else {
            opened.recording.frames.len()
        }
    }

    /// Whether no frame is left.
    pub fn is_complete(&self, opened: &Opened) -> bool {
        self.results.len() + self.missed == self.expected(opened)
    }

    /// The frames up to the first tracked one, if there are any before it.
    pub fn searched(&self) -> Option<LocalizationResults> {
        let mut states = self.results.states.as_ref()?.iter();
        let first = states.position(|&state| state == State::Tracking as u8)?;
        (first > 0).then(|| self.results.select(&(0..=first).collect::<Vec<_>>()))
    }

    /// Makes poses of frames that were not tracked part of the trajectory, and of the refined one.
    pub fn fill(&mut self, filled: &[(usize, Pose3)]) {
        let results = &mut self.results;
        results
            .trajectory_in_space
            .clone_from(&results.estimates_in_space);
        results.trajectory_states.clone_from(&results.states);
        for &(row, pose) in filled {
            for (poses, states) in [
                (
                    &mut results.trajectory_in_space,
                    &mut results.trajectory_states,
                ),
                (&mut results.refined_in_space, &mut results.refined_states),
            ] {
                if let (Some(poses), Some(states)) = (poses, states) {
                    (poses[row], states[row]) = (pose, State::Tracking as u8);
                }
            }
            if let Some(refined) = &mut results.refined {
                refined[row] = pose2_from_pose3(&pose);
            }
        }
    }

    /// Completes the run after its last frame; an error where no frame was finished.
    pub fn complete(&mut self) -> Result<()> {
        let frames = self.results.len();
        if frames == 0 {
            let kept = "no frame was finished".to_owned();
            let failure = self.failure.take();
            return Err(failure.unwrap_or_else(|| Interrupted { kept }.into()));
        }
        if self.off_ground > 0 {
            tracing::warn!(
                "{} of {frames} frames have no mapped ground below them; the last known ground is used",
                self.off_ground
            );
        }
        Ok(())
    }

    /// Marks all frames as lost, with a warning, if their scans are distorted in more of them than a pose was tracked in.
    pub fn refuse_distorted(&mut self) {
        let states = self.results.states.iter().flatten();
        let tracking = states.filter(|&&state| state == State::Tracking as u8);
        let tracking = tracking.count();
        let Some((distortion, frames)) = self.distorted.filter(|(_, it)| *it > tracking) else {
            return;
        };
        let remedy = match distortion {
            Distortion::Mirrored => "their frame is left-handed; y must point to the left of x",
            Distortion::Scaled { .. } => "check the unit and the factor of the ranges",
        };
        tracing::warn!(
            "by the map, {frames} scans have {distortion}: {remedy}; no pose is trusted"
        );
        let results = &mut self.results;
        let of_both = [&mut results.states, &mut results.refined_states];
        for state in of_both
            .into_iter()
            .flatten()
            .flat_map(|states| states.iter_mut())
        {
            *state = State::Lost as u8;
        }
    }
}

impl Run {
    /// What is kept of the run after an interruption.
    pub fn kept(&self, opened: &Opened) -> String {
        let (config, frames) = (&opened.config, self.expected(opened));
        let found = self.results.len();
        if found == 0 {
            "no frame was finished".to_owned()
        } else if config.save_result {
            let path = config.result_path.display();
            format!("{found} of {frames} frames are localized and kept in {path}")
        } else {
            format!(
                "{found} of {frames} frames were localized; nothing is kept: save_result is False"
            )
        }
    }

    /// Finishes the animation; an error where not all frames were localized, which names what is kept.
    pub fn finish(self, opened: &Opened) -> Result<()> {
        let kept = self.kept(opened);
        let is_complete = self.is_complete(opened);
        let animation = self.movie.map_or(Ok(()), |movie| movie.finish());
        let failure = self.failure.or(animation.err());
        if is_complete && failure.is_none() {
            if !opened.config.save_result {
                tracing::warn!("the result is not kept: save_result is False");
            }
            return Ok(());
        }
        Err(match failure {
            Some(failure) => failure.context(kept),
            None => Interrupted { kept }.into(),
        })
    }
}
