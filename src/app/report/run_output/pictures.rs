//! Pictures of a run.

use std::borrow::Cow;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Context as _, Result};
use glam::DVec3;

use super::{INTERACTIVE, RunFiles};
use crate::app::report::plotting::color::{MCL, REFINED, STATES};
use crate::app::report::plotting::{
    FRAME, InteractivePath, LineChart, LocalizationPicture, MapImage, MapPlot, Mark, Panel,
    PathPlot, RangeImageStrip, SURFACES, Series, drift_chart, error_chart, muted, save_animation,
};
use crate::app::report::results::{LocalizationResults, with_gaps};
use crate::app::run::output::remove_if_exists;
use crate::evaluation::trust::Axes;
use crate::evaluation::{ParticleRow, PlanarError, planar_errors};
use crate::geometry::{Pose2, Pose3, TriangleMesh, pose2_from_pose3};
use crate::lidar::{LidarModel, RangeImage};
use crate::localization::Estimate;
use crate::map::Map;
use crate::recording::Frame;

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
    let drawing = Drawing::new(files, image.as_ref(), results);
    drawing.path()?;
    drawing.interactive_path()?;
    drawing.errors()?;
    drawing.states()?;
    drawing.drift()?;
    drawing.runtimes()?;
    drawing.particles()?;
    mesh.map_or(Ok(()), |mesh| drawing.map_with_path(&mesh))
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

/// Draws the range image of a frame, that of the map from a pose, and their difference.
pub fn draw_range_images(
    files: &RunFiles,
    map: &Map,
    frame: &Frame,
    map_from_lidar: &Pose3,
    model: &LidarModel,
) -> Result<()> {
    let rendered = map.renderer.render(&[*map_from_lidar], model)?;
    RangeImageStrip {
        title: &format!("Frame {}: observed, rendered, difference", frame.number),
        observed: &RangeImage::project(&frame.read()?.points, model),
        rendered: rendered.first().context("one pose gives one image")?,
    }
    .save(&files.plot("range_images.png")?)
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

/// A run with its trajectories in the plane.
struct Drawing<'a> {
    files: &'a RunFiles,
    map: Option<&'a MapImage>,
    results: &'a LocalizationResults,
    /// Name of the estimates: those of the filter, or of a trajectory from elsewhere.
    name: &'static str,
    estimates: Cow<'a, [Pose2]>,
    /// The trajectory of the filter, with gaps where it is not trusted.
    trajectory: Vec<Pose2>,
    truth: Option<&'a [Pose2]>,
}

impl<'a> Drawing<'a> {
    fn new(
        files: &'a RunFiles,
        map: Option<&'a MapImage>,
        results: &'a LocalizationResults,
    ) -> Self {
        let is_given = results.particles.is_empty();
        let in_space = results.estimates_in_space.iter().flatten();
        let estimates = results.estimates.as_deref().map(Cow::from);
        let estimates = estimates.unwrap_or_else(|| in_space.map(pose2_from_pose3).collect());
        Self {
            files,
            map,
            results,
            name: if is_given { "estimate" } else { "MCL" },
            trajectory: with_gaps(&results.trajectory(&estimates), &results.trusted()),
            estimates,
            truth: results.ground_truth.as_deref(),
        }
    }

    /// The refined trajectory, with gaps where it is not trusted.
    fn refined_with_gaps(&self) -> Option<Vec<Pose2>> {
        let refined = self.results.refined.as_deref()?;
        Some(with_gaps(refined, &self.results.refined_trusted()))
    }

    /// Frames of which the estimate of the filter is trusted, and not only a pose that was filled back.
    fn tracked(&self) -> Vec<bool> {
        let tracked = self.results.tracked();
        tracked.unwrap_or_else(|| self.results.trusted())
    }

    /// Saves a chart in `plots/`, or removes that of an earlier run if it shows nothing.
    fn save(&self, chart: &LineChart, name: &str) -> Result<()> {
        if chart.panels.is_empty() {
            return remove_if_exists(&self.files.file("plots").join(name));
        }
        chart.save(&self.files.plot(name)?)
    }

    /// Draws the best trajectory colored by its error, or without a truth by its standard deviation; gaps are gaps. No
    /// picture where nothing is trusted.
    fn path(&self) -> Result<()> {
        let refined = self.refined_with_gaps();
        let refined = refined.as_deref().map(|poses| ("refined", REFINED, poses));
        let mut paths = vec![(self.name, MCL, self.trajectory.as_slice())];
        paths.extend(refined);
        paths.retain(|(_, _, poses)| poses.iter().any(|pose| pose.translation.x.is_finite()));
        if paths.is_empty() && self.truth.is_none() {
            return remove_if_exists(&self.files.file("plots").join("path.png"));
        }
        let numbers = paths.last().and_then(|&(name, _, poses)| {
            if let Some(truth) = self.truth {
                let errors = planar_errors(poses, truth).into_iter();
                let errors_cm = errors.map(|error| 100.0 * error.distance_m());
                return Some((format!("position error, {name} [cm]"), errors_cm.collect()));
            }
            let covariances = self.results.best_covariances()?.iter();
            let sigmas_cm = (covariances.zip(poses)).map(|(it, pose)| {
                let is_gap = pose.translation.x.is_nan();
                if is_gap {
                    f64::NAN
                } else {
                    100.0 * (it.m11 + it.m22).sqrt()
                }
            });
            let name = format!("standard deviation of the position, {name} [cm]");
            Some((name, sigmas_cm.collect()))
        });
        PathPlot {
            title: match self.truth {
                Some(_) => "Path against ground truth",
                None => "Path",
            },
            ground_truth: self.truth,
            paths: &paths,
            numbers: (numbers.as_ref())
                .map(|(name, numbers): &(String, Vec<f64>)| (name.as_str(), numbers.as_slice())),
            map: self.map,
        }
        .save(&self.files.plot("path.png")?)
    }

    fn interactive_path(&self) -> Result<()> {
        InteractivePath {
            results: self.results,
            estimates: &self.results.trajectory(&self.estimates),
            map: self.map,
        }
        .save(&self.files.plot(INTERACTIVE)?)
    }

    fn errors(&self) -> Result<()> {
        let truth = self.truth.filter(|_| !self.results.particles.is_empty());
        let (x_name, x) = time_axis(self.results);
        let estimates = with_gaps(&self.estimates, &self.tracked());
        let found = [
            (self.name, MCL, Some(estimates)),
            ("refined", REFINED, self.refined_with_gaps()),
        ];
        let errors = found.into_iter().filter_map(|(name, color, poses)| {
            let rows = poses?.into_iter().zip(truth.unwrap_or_default()).zip(&x);
            let errors = rows.map(|((pose, truth), &x)| (x, PlanarError::between(&pose, truth)));
            Some((name, color, errors))
        });
        self.save(
            &error_chart("Errors over time", x_name, errors),
            "errors.png",
        )
    }

    /// Draws how sure the run was of each frame, by state: the standard deviation, and the agreement where it is known.
    fn states(&self) -> Result<()> {
        let (Some(states), Some(covariances)) = (&self.results.states, &self.results.covariances)
        else {
            return Ok(());
        };
        let (x_name, x) = time_axis(self.results);
        let axes = covariances.iter().zip(&*self.estimates);
        let sigmas_cm = axes.map(|(covariance, pose)| 100.0 * Axes::new(covariance, pose).long_m);
        let sigmas_cm: Vec<f64> = sigmas_cm.collect();
        let agreements = self.results.agreements.iter().flatten();
        let percent = agreements.map(|&it| if it < 0.0 { f64::NAN } else { 100.0 * it });
        let percent: Vec<f64> = percent.collect();
        let by_state = |values: &[f64]| -> Vec<Series> {
            let series = STATES.into_iter().map(|(state, color)| {
                let rows = x.iter().zip(values).zip(states);
                let rows = rows.filter(|((_, y), it)| **it == state as u8 && y.is_finite());
                let points = rows.map(|((&x, &y), _)| (x, y));
                Series {
                    mark: Mark::Dots,
                    ..Series::line(state.word(), color, points)
                }
            });
            series.filter(|it| !it.points.is_empty()).collect()
        };
        let panels = [
            Panel::new("standard deviation [cm]", by_state(&sigmas_cm)),
            Panel::new("beams on the map [%]", by_state(&percent)),
        ];
        self.save(
            &LineChart::new("States over time", x_name, panels),
            "states.png",
        )
    }

    /// Draws the errors in space against the distance driven.
    fn drift(&self) -> Result<()> {
        let truth = self.results.ground_truth_in_space.as_deref();
        let (estimates, refined) = (
            self.results.estimates_in_space.as_deref(),
            self.results.refined_in_space.as_deref(),
        );
        let known = self.results.has_truth().unwrap_or_default();
        let [of_filter, of_refined] =
            [self.tracked(), self.results.refined_trusted()].map(|trusted| -> Vec<bool> {
                trusted.iter().zip(&known).map(|(a, b)| a & b).collect()
            });
        let trajectories = [
            (
                self.name,
                MCL,
                estimates.unwrap_or_default(),
                of_filter.as_slice(),
            ),
            ("refined", REFINED, refined.unwrap_or_default(), &of_refined),
        ];
        let chart = drift_chart(truth.unwrap_or_default(), &trajectories);
        self.save(&chart, "drift.png")
    }

    fn runtimes(&self) -> Result<()> {
        let stages = [
            ("localize", MCL, &self.results.runtimes_s),
            ("refine", REFINED, &self.results.refine_runtimes_s),
        ];
        let series = stages.into_iter().filter_map(|(stage, color, times_s)| {
            let points = self.results.frames.iter().zip(times_s.as_ref()?);
            let points = points.map(|(&frame, time_s)| (frame as f64, 1e3 * time_s));
            Some(Series::line(stage, color, points))
        });
        let panel = Panel::new("time per frame [ms]", series);
        self.save(
            &LineChart::new("Runtime per frame", FRAME, [panel]),
            "runtime.png",
        )
    }

    /// Draws the particles at several moments, colored by it: later ones are on top.
    fn particles(&self) -> Result<()> {
        let moments = moments(self.results);
        let Some(&last) = moments.last() else {
            return Ok(());
        };
        let steps = (moments.len() - 1).max(1) as f32;
        let mut particles: Vec<ParticleRow> = Vec::new();
        for (moment, &row) in moments.iter().enumerate() {
            let of_moment = self.results.particles.frame(row)?.into_iter();
            let colored = |[x, y, heading, _]: ParticleRow| [x, y, heading, moment as f32 / steps];
            particles.extend(of_moment.map(colored));
        }
        LocalizationPicture {
            title: "Particles from the first frame to the last",
            map: self.map,
            particles: &particles,
            color_name: "from the first frame to the last",
            estimate: self.estimates.get(last).copied(),
            ground_truth: self.truth.and_then(|truth| truth.get(last).copied()),
            driven: self.truth.unwrap_or(&self.trajectory),
            window: None,
        }
        .save(&self.files.plot("particles.png")?)
    }

    fn map_with_path(&self, mesh: &TriangleMesh) -> Result<()> {
        MapPlot {
            title: "Map from above",
            mesh,
            path: Some(match self.truth {
                Some(truth) => ("true path", truth),
                None => ("found path", &self.trajectory),
            }),
            keys: &SURFACES,
            numbers: None,
        }
        .save(&self.files.plot("map.png")?)
    }
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
        let name = format!("{number:06}.png");
        let path = self.files.in_subfolder("loc_plots", &name)?;
        LocalizationPicture {
            title: &format!("Frame {number}: {}", estimate.state.word()),
            map: Some(&self.map),
            particles: &results.particles.frame(results.len() - 1)?,
            color_name: "weight / largest",
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
    use std::path::Path;

    use super::*;
    use crate::app::report::results::ParticleLog;

    /// Two particles in each frame.
    fn results(frames: usize) -> LocalizationResults {
        let mut particles = ParticleLog::new(2, Path::new("."));
        (0..frames).for_each(|_| particles.push_frame(&[[5.0, 0.0, 0.0, 0.5]; 2]).unwrap());
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
        results.times_s = Some(vec![1e9, 1e9 + 0.5, 1e9 + 1.0].into());
        assert_eq!(time_axis(&results).1, [0.0, 0.5, 1.0]);
    }
}
