//! Pictures of a run.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Result;
use glam::DVec3;

use super::{INTERACTIVE, RunFiles};
use crate::app::report::plotting::color::{MCL, REFINED, Rgb, STATES};
use crate::app::report::plotting::{
    FRAME, InteractivePath, LineChart, LocalizationPicture, MapImage, MapPlot, Mark, Panel,
    ParticlePanels, PathPlot, SURFACES, Series, drift_chart, error_chart, muted, save_animation,
};
use crate::app::report::results::LocalizationResults;
use crate::evaluation::planar_errors;
use crate::evaluation::trust::Axes;
use crate::geometry::{Pose2, TriangleMesh, pose2_from_pose3};
use crate::localization::{Estimate, State};
use crate::map::Map;

/// Cells along the longer side of the map image in plots.
const MAP_CELLS: usize = 1400;

/// Triangles of a map in pictures; larger maps are drawn coarser.
pub const MOST_TRIANGLES: usize = 2_000_000;

/// Number of frames whose particles are drawn.
const MOMENTS: usize = 4;

/// Draws the plots of a run in `plots/`.
pub fn draw_run(
    files: &RunFiles,
    mesh: Option<&TriangleMesh>,
    results: &LocalizationResults,
) -> Result<()> {
    let mesh = mesh.map(muted);
    let image = (mesh.as_ref()).map(|mesh| MapImage::of_colors(mesh, MAP_CELLS));
    let trajectories = Trajectories::of(results);
    draw_path(files, image.as_ref(), results, &trajectories)?;
    InteractivePath {
        results,
        estimates: &trajectories.estimates,
        map: image.as_ref(),
    }
    .save(&files.plot(INTERACTIVE)?)?;
    draw_errors(files, results, &trajectories)?;
    draw_states(files, results, &trajectories)?;
    draw_drift(files, trajectories.estimate_name(), results)?;
    draw_runtimes(files, results)?;
    draw_particles(files, image.as_ref(), results)?;
    let Some(mesh) = &mesh else {
        return Ok(());
    };
    MapPlot {
        title: "Map from above",
        mesh,
        path: Some(match trajectories.truth {
            Some(truth) => ("true path", truth),
            None => ("found path", &trajectories.estimates),
        }),
        keys: &SURFACES,
        numbers: None,
    }
    .save(&files.plot("map.png")?)
}

/// The map around some poses, for pictures: of large maps coarser.
pub fn map_around<'a>(
    map: &Map,
    poses: impl IntoIterator<Item = &'a Pose2>,
) -> Result<Arc<TriangleMesh>> {
    /// What is shown around the poses [m].
    const RADIUS_M: f64 = 100.0;
    let most_triangles = MOST_TRIANGLES as u64;
    if map.triangle_count() <= most_triangles {
        return Ok(map.mesh()?);
    }
    let places = poses.into_iter().map(|pose| pose.translation.vector.into());
    let places: Vec<_> = places.collect();
    Ok(map.mesh_near(&places, RADIUS_M, DVec3::ZERO, most_triangles)?)
}

/// Name and values of the horizontal axis of charts over the frames of a run.
pub fn time_axis(results: &LocalizationResults) -> (&'static str, Vec<f64>) {
    match results.times_s.as_deref() {
        Some(times_s @ [start_s, ..]) => {
            let from_start = times_s.iter().map(|time_s| time_s - start_s);
            ("time from the start [s]", from_start.collect())
        }
        _ => {
            let frames = results.frames.iter().map(|&frame| frame as f64);
            (FRAME, frames.collect())
        }
    }
}

/// The trajectories of a run in the plane.
struct Trajectories<'a> {
    /// Whether there is no filter: the estimates come from elsewhere.
    is_given: bool,
    estimates: Vec<Pose2>,
    refined: Option<&'a [Pose2]>,
    truth: Option<&'a [Pose2]>,
}

impl<'a> Trajectories<'a> {
    fn of(results: &'a LocalizationResults) -> Self {
        Self {
            is_given: results.particles.is_empty(),
            estimates: match (&results.estimates, &results.estimates_in_space) {
                (Some(estimates), _) => estimates.clone(),
                (None, Some(estimates)) => estimates.iter().map(pose2_from_pose3).collect(),
                (None, None) => Vec::new(),
            },
            refined: results.refined.as_deref(),
            truth: results.ground_truth.as_deref(),
        }
    }

    fn estimate_name(&self) -> &'static str {
        if self.is_given { "estimate" } else { "MCL" }
    }

    /// Name, color and poses of what was found, the best last.
    fn found(&self) -> Vec<(&'static str, Rgb, &[Pose2])> {
        let refined = self.refined.map(|poses| ("refined", REFINED, poses));
        std::iter::once((self.estimate_name(), MCL, self.estimates.as_slice()))
            .chain(refined)
            .collect()
    }
}

/// Draws the best trajectory colored by its error, or without a truth by its standard deviation.
fn draw_path(
    files: &RunFiles,
    map: Option<&MapImage>,
    results: &LocalizationResults,
    trajectories: &Trajectories,
) -> Result<()> {
    let paths = trajectories.found();
    let numbers = paths
        .last()
        .and_then(|&(name, _, poses)| match trajectories.truth {
            Some(truth) => {
                let errors = planar_errors(poses, truth);
                let errors_cm = errors.iter().map(|error| 100.0 * error.distance_m());
                Some((format!("position error, {name} [cm]"), errors_cm.collect()))
            }
            None => {
                let sigmas_cm = position_sigmas_cm(results)?;
                Some((
                    format!("standard deviation of the position, {name} [cm]"),
                    sigmas_cm,
                ))
            }
        });
    PathPlot {
        title: match trajectories.truth {
            Some(_) => "Path against ground truth",
            None => "Path",
        },
        ground_truth: trajectories.truth,
        paths: &paths,
        numbers: (numbers.as_ref())
            .map(|(name, numbers): &(String, Vec<f64>)| (name.as_str(), numbers.as_slice())),
        map,
    }
    .save(&files.plot("path.png")?)
}

/// Standard deviation of each position of the best trajectory [cm]; `None` if it is not known.
fn position_sigmas_cm(results: &LocalizationResults) -> Option<Vec<f64>> {
    let covariances = match results.refined {
        Some(_) => results.refined_covariances.as_ref(),
        None => results.covariances.as_ref(),
    };
    let sigma_cm =
        |covariance: &nalgebra::Matrix3<f64>| 100.0 * (covariance.m11 + covariance.m22).sqrt();
    Some(covariances?.iter().map(sigma_cm).collect())
}

fn draw_errors(
    files: &RunFiles,
    results: &LocalizationResults,
    trajectories: &Trajectories,
) -> Result<()> {
    let Some(truth) = trajectories.truth.filter(|_| !trajectories.is_given) else {
        return Ok(());
    };
    let (x_name, x) = time_axis(results);
    let found = trajectories.found();
    let errors = found.into_iter().map(|(name, color, poses)| {
        let errors = x.iter().copied().zip(planar_errors(poses, truth));
        (name, color, errors.collect())
    });
    let chart = error_chart("Errors over time", x_name, &errors.collect::<Vec<_>>());
    chart.save(&files.plot("errors.png")?)
}

/// Draws how sure the run was of each frame: the standard deviation, and the agreement by state.
fn draw_states(
    files: &RunFiles,
    results: &LocalizationResults,
    trajectories: &Trajectories,
) -> Result<()> {
    let (Some(states), Some(covariances)) = (&results.states, &results.covariances) else {
        return Ok(());
    };
    let (x_name, x) = time_axis(results);
    let axes = covariances.iter().zip(&trajectories.estimates);
    let sigmas_cm = axes.map(|(covariance, pose)| 100.0 * Axes::new(covariance, pose).long_m);
    let agreements = results.agreements.as_deref().unwrap_or_default();
    let in_state = |(state, color): (State, Rgb)| Series {
        mark: Mark::Dots,
        ..Series::line(
            state.word(),
            color,
            (0..agreements.len())
                .filter(|&row| states[row] == state as u8 && agreements[row] >= 0.0)
                .map(|row| (x[row], 100.0 * agreements[row])),
        )
    };
    let by_state = STATES.into_iter().map(in_state);
    let sigmas_cm = x.iter().copied().zip(sigmas_cm);
    let sigma = Series::line("of the position, MCL", MCL, sigmas_cm);
    let by_state = by_state.filter(|it| !it.points.is_empty());
    let panels = [
        Panel::new("standard deviation [cm]", [sigma]),
        Panel::new("beams on the map [%]", by_state),
    ];
    let chart = LineChart::new("States over time", x_name, panels);
    chart.save(&files.plot("states.png")?)
}

/// Draws the errors in space against the distance driven.
fn draw_drift(files: &RunFiles, name: &str, results: &LocalizationResults) -> Result<()> {
    let Some(truth) = results.ground_truth_in_space.as_deref() else {
        return Ok(());
    };
    let trajectories: Vec<_> = [
        (name, MCL, &results.estimates_in_space),
        ("refined", REFINED, &results.refined_in_space),
    ]
    .into_iter()
    .filter_map(|(name, color, poses)| Some((name, color, poses.as_deref()?)))
    .collect();
    if trajectories.is_empty() {
        return Ok(());
    }
    drift_chart(truth, &trajectories).save(&files.plot("drift.png")?)
}

fn draw_runtimes(files: &RunFiles, results: &LocalizationResults) -> Result<()> {
    let stages = [
        ("localize", MCL, &results.runtimes_s),
        ("refine", REFINED, &results.refine_runtimes_s),
    ];
    let series = stages.into_iter().filter_map(|(stage, color, times_s)| {
        let points = results.frames.iter().zip(times_s.as_ref()?);
        let points = points.map(|(&frame, time_s)| (frame as f64, 1e3 * time_s));
        Some(Series::line(stage, color, points))
    });
    let series: Vec<Series> = series.collect();
    if series.is_empty() {
        return Ok(());
    }
    let panel = Panel::new("time per frame [ms]", series);
    let chart = LineChart::new("Runtime per frame", FRAME, [panel]);
    chart.save(&files.plot("runtime.png")?)
}

/// Draws the particles at several moments, from the first on.
fn draw_particles(
    files: &RunFiles,
    map: Option<&MapImage>,
    results: &LocalizationResults,
) -> Result<()> {
    let pose = |poses: &Option<Vec<Pose2>>, row: usize| poses.as_ref()?.get(row).copied();
    let moments = moments(results);
    let titles = (moments.iter()).map(|&row| format!("Frame {}", results.frames[row]));
    let titles: Vec<String> = titles.collect();
    let frames = moments
        .iter()
        .zip(&titles)
        .map(|(&row, title)| LocalizationPicture {
            title,
            map,
            particles: results.particles.frame(row),
            estimate: pose(&results.estimates, row),
            ground_truth: pose(&results.ground_truth, row),
            ..LocalizationPicture::default()
        });
    let frames: Vec<LocalizationPicture> = frames.collect();
    if frames.is_empty() {
        return Ok(());
    }
    ParticlePanels {
        title: "Particles",
        frames: &frames,
    }
    .save(&files.plot("particles.png")?)
}

/// Rows of the first frame, of the last, and of two between them at even ratios: a search is over early.
fn moments(results: &LocalizationResults) -> Vec<usize> {
    let frames = results.particles.len() as f64;
    let rows = (0..=MOMENTS - 1).map(|k| frames.powf(k as f64 / (MOMENTS - 1) as f64) as usize);
    let mut rows: Vec<usize> = rows
        .filter(|row| (1..=results.particles.len()).contains(row))
        .map(|row| row - 1)
        .collect();
    rows.dedup();
    rows
}

/// A picture per frame, and an animation of them.
pub struct Movie {
    files: RunFiles,
    map: MapImage,
    pictures: Vec<PathBuf>,
}

impl Movie {
    /// Prepares the map image of the pictures.
    pub fn begin(files: &RunFiles, map: &Map) -> Result<Self> {
        let path = &map.path.map_from_lidar;
        let places: Vec<Pose2> = path.iter().map(pose2_from_pose3).collect();
        let mesh = map_around(map, &places)?;
        Ok(Self {
            files: files.clone(),
            map: MapImage::of_colors(&muted(&mesh), MAP_CELLS),
            pictures: Vec::new(),
        })
    }

    /// Draws the last frame of the results.
    pub fn add(&mut self, results: &LocalizationResults, estimate: &Estimate) -> Result<()> {
        /// Width of what is shown around the estimate [m].
        const WINDOW_M: f64 = 80.0;
        let Some(&number) = results.frames.last() else {
            return Ok(());
        };
        let truth = results.ground_truth.as_deref().unwrap_or_default();
        let driven = match truth {
            [] => results.estimates.as_deref().unwrap_or_default(),
            truth => truth,
        };
        let t = estimate.pose.translation;
        let path = self
            .files
            .in_subfolder("loc_plots", &format!("{number:06}.png"))?;
        LocalizationPicture {
            title: &format!("Frame {number}: {}", estimate.state.word()),
            map: Some(&self.map),
            particles: results.particles.frame(results.len() - 1),
            estimate: Some(estimate.pose),
            ground_truth: truth.last().copied(),
            driven,
            window: Some(([t.x, t.y], WINDOW_M)),
        }
        .save(&path)?;
        self.pictures.push(path);
        Ok(())
    }

    /// Writes the animation.
    pub fn finish(self) -> Result<()> {
        save_animation(&self.files.file("localization.gif"), &self.pictures)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::report::results::ParticleLog;

    /// Two particles in each frame.
    fn results(frames: usize) -> LocalizationResults {
        let mut particles = ParticleLog::new(2);
        (0..frames).for_each(|_| particles.push_frame([[5.0, 0.0, 0.0, 0.5]; 2]));
        LocalizationResults {
            frames: (0..frames).collect(),
            particles,
            ..LocalizationResults::default()
        }
    }

    #[test]
    fn the_moments_are_the_start_two_early_frames_and_the_end() {
        assert_eq!(moments(&results(1000)), [0, 8, 98, 999]);
        assert_eq!(moments(&results(40)), [0, 2, 10, 39]);
        assert_eq!(moments(&results(2)), [0, 1]);
        assert!(moments(&results(0)).is_empty());
    }

    #[test]
    fn time_starts_at_zero_and_without_times_frames_are_counted() {
        let mut results = results(3);
        assert_eq!(time_axis(&results), (FRAME, vec![0.0, 1.0, 2.0]));
        results.times_s = Some(vec![1e9, 1e9 + 0.5, 1e9 + 1.0]);
        assert_eq!(time_axis(&results).1, [0.0, 0.5, 1.0]);
    }
}
