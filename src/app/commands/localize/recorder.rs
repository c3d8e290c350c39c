//! What the filter said, frame by frame.

use anyhow::Result;

use super::Run;
use super::drive::Said;
use crate::app::commands::run_output::{self, Movie, RunFiles};
use crate::app::commands::stages::LoadedMap;
use crate::app::config::LocalizationConfig;
use crate::app::results::{LocalizationResults, ParticleLog};
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::recording::Frame;

/// Collects what the filter says.
pub struct Recorder {
    results: LocalizationResults,
    lifted: Vec<Pose3>,
    refined: Vec<Pose3>,
    movie: Option<Movie>,
    /// Frames with no ground of the map below the estimate.
    off_ground: usize,
}

impl Recorder {
    pub fn new(config: &LocalizationConfig, map: &LoadedMap, files: &RunFiles) -> Self {
        let empty = || Some(Vec::new());
        Self {
            results: LocalizationResults {
                particles: ParticleLog::new(config.num_particles),
                estimates: empty(),
                ground_truth: empty(),
                odometry: empty(),
                covariances: Some(Vec::new()),
                times_s: Some(Vec::new()),
                runtimes_s: Some(Vec::new()),
                states: Some(Vec::new()),
                refined: config.refine.then(Vec::new),
                refined_covariances: config.refine.then(Vec::new),
                refine_runtimes_s: config.refine.then(Vec::new),
                ..LocalizationResults::default()
            },
            lifted: Vec::new(),
            refined: Vec::new(),
            movie: config.visualize.then(|| Movie::begin(files, &map.mesh)),
            off_ground: 0,
        }
    }

    pub fn record(&mut self, frame: &Frame, increment: Option<Pose2>, said: Said) -> Result<()> {
        fn push<T>(column: &mut Option<Vec<T>>, value: T) {
            if let Some(column) = column {
                column.push(value);
            }
        }
        let Said {
            estimate,
            runtime,
            refined,
        } = &said;
        let results = &mut self.results;
        results.frames.push(frame.number);
        results
            .particles
            .push_frame(run_output::particle_rows(&estimate.particles));
        self.off_ground += usize::from(!estimate.on_mapped_ground);
        push(&mut results.estimates, estimate.pose);
        push(
            &mut results.ground_truth,
            pose2_from_pose3(&frame.map_from_lidar),
        );
        push(
            &mut results.odometry,
            increment.unwrap_or_else(Pose2::identity),
        );
        push(&mut results.covariances, estimate.covariance);
        push(&mut results.times_s, frame.time_s);
        push(&mut results.runtimes_s, runtime.as_secs_f64());
        push(&mut results.states, estimate.state as u8);
        let (pose, lifted, covariance, seconds) = match refined {
            Some((refined, runtime)) => {
                let seconds = runtime.as_secs_f64();
                (refined.pose, refined.lifted, refined.covariance, seconds)
            }
            None => (estimate.pose, estimate.lifted, estimate.covariance, 0.0),
        };
        push(&mut results.refined, pose);
        push(&mut results.refined_covariances, covariance);
        push(&mut results.refine_runtimes_s, seconds);
        self.refined.push(lifted);
        self.lifted.push(estimate.lifted);
        if let Some(movie) = &mut self.movie {
            movie.add(results, estimate)?;
        }
        Ok(())
    }

    pub fn finish(self, failure: Option<anyhow::Error>) -> Run {
        if self.off_ground > 0 {
            tracing::warn!(
                "{} of {} frames have no ground of the map below them and stand on the last that there was",
                self.off_ground,
                self.results.len()
            );
        }
        Run {
            results: self.results,
            lifted: self.lifted,
            refined: self.refined,
            failure,
            movie: self.movie,
        }
    }
}
