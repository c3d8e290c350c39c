//! Trajectories over the ground truth, their errors, and the time per frame.

use std::path::Path;

use anyhow::{Context as _, Result, ensure};

use super::MapImage;
use super::bitmap::Bitmap;
use super::chart::{LineChart, Panel, Series};
use super::color::{MCL, REFINED, Rgb, TRUTH, WHITE};
use super::sheet::{HPos, Sheet, TICK, VPos, bold, save_png, stroke, text_style};
use super::top_view::{TopView, positions};
use super::view::{AxisRange, LegendEntry, Mark, View};
use crate::evaluation::PlanarError;
use crate::geometry::Pose2;

/// Trajectory with its name and color.
#[derive(Clone, Copy, Debug)]
pub struct NamedPath<'a> {
    /// Name in the legend.
    pub name: &'a str,
    /// Color, one of [`color`](super::color).
    pub color: Rgb,
    /// Poses in the map frame.
    pub poses: &'a [Pose2],
}

impl<'a> NamedPath<'a> {
    /// Estimates of the filter.
    pub fn mcl(poses: &'a [Pose2]) -> Self {
        Self {
            name: "MCL",
            color: MCL,
            poses,
        }
    }

    /// Refined trajectory.
    pub fn refined(poses: &'a [Pose2]) -> Self {
        Self {
            name: "refined",
            color: REFINED,
            poses,
        }
    }
}

/// Trajectories over the ground truth, from above.
#[derive(Clone, Copy, Debug)]
pub struct PathPlot<'a> {
    /// Title.
    pub title: &'a str,
    /// Ground truth, if known.
    pub ground_truth: Option<&'a [Pose2]>,
    /// Trajectories, drawn in this order.
    pub paths: &'a [NamedPath<'a>],
    /// Map, drawn pale below everything.
    pub map: Option<&'a MapImage>,
}

impl PathPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        save_png(path, self.draw())
    }

    fn draw(&self) -> Result<Bitmap> {
        let truth = self.ground_truth.map(|poses| NamedPath {
            name: "ground truth",
            color: TRUTH,
            poses,
        });
        let all: Vec<&NamedPath> = truth.iter().chain(self.paths).collect();
        let positions = || {
            all.iter()
                .flat_map(|path| path.poses)
                .map(|p| p.translation)
        };
        let x = AxisRange::of(positions().map(|t| t.x));
        let ranges = x.zip(AxisRange::of(positions().map(|t| t.y)));
        let (x, y) = ranges.context("there is nothing to draw: all trajectories are empty")?;
        let margin = (0.05 * x.length().max(y.length())).max(2.0);
        let entries = all.iter();
        let view = TopView {
            title: self.title,
            legend: entries
                .map(|path| LegendEntry::new(path.name, path.color, Mark::Line))
                .collect(),
            x: x.padded(margin),
            y: y.padded(margin),
            color_bar: None,
        };
        view.draw(|sheet, view| {
            if let Some(map) = self.map {
                map.draw(sheet, view, 0.6)?;
            }
            self.draw_paths(sheet, view)
        })
    }

    fn draw_paths(&self, sheet: &Sheet, view: &View) -> Result<()> {
        if let Some(truth) = self.ground_truth {
            sheet.polyline(&positions(truth, view), &view.rect, stroke(TRUTH, 6.0))?;
        }
        for (number, path) in self.paths.iter().enumerate() {
            let width = if number == 0 { 3.0 } else { 2.0 };
            let stroke = stroke(path.color, width);
            sheet.polyline(&positions(path.poses, view), &view.rect, stroke)?;
        }
        let longest = self
            .ground_truth
            .or(self.paths.first().map(|path| path.poses));
        if let Some([first, .., last]) = longest {
            for (pose, label, side, aside) in [
                (first, "start", HPos::Right, -12.0),
                (last, "end", HPos::Left, 12.0),
            ] {
                let place = view.at(pose.translation.x, pose.translation.y);
                sheet.dot(place, 9.0, WHITE, 1.0)?;
                sheet.dot(place, 7.0, TRUTH, 1.0)?;
                let style = bold(text_style(TICK, side, VPos::Bottom));
                sheet.text(label, (place.0 + aside, place.1 - 10.0), &style)?;
            }
        }
        Ok(())
    }
}

/// Position and heading error over time, one series per trajectory.
#[derive(Clone, Copy, Debug)]
pub struct ErrorPlot<'a> {
    /// Title.
    pub title: &'a str,
    /// Name of the x axis with its unit.
    pub x_name: &'a str,
    /// Time, frame number or distance, one per frame.
    pub x: &'a [f64],
    /// Name, color and errors of each trajectory, one error per frame.
    pub errors: &'a [(&'a str, Rgb, &'a [PlanarError])],
}

impl ErrorPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        let frames = self.x.len();
        for (_, _, errors) in self.errors {
            ensure!(
                errors.len() == frames,
                "cannot draw {}: {} errors where {frames} belong",
                path.display(),
                errors.len()
            );
        }
        let panel = |y_name: &str, number: fn(&PlanarError) -> f64| {
            let series = self.errors.iter().map(|(name, color, errors)| {
                let points = self.x.iter().copied().zip(errors.iter().map(number));
                Series::line(name, *color, points)
            });
            Panel {
                y_name: y_name.to_owned(),
                series: series.collect(),
                clip_outliers: true,
                ..Panel::default()
            }
        };
        LineChart {
            title: self.title.to_owned(),
            x_name: self.x_name.to_owned(),
            panels: vec![
                panel("position error [m]", PlanarError::distance_m),
                panel("heading error [deg]", |error| {
                    error.turn_rad.abs().to_degrees()
                }),
            ],
            marks: Vec::new(),
        }
        .save(path)
    }
}

/// Runtime of each frame.
#[derive(Clone, Copy, Debug)]
pub struct RuntimePlot<'a> {
    /// Title.
    pub title: &'a str,
    /// Frame numbers.
    pub frames: &'a [usize],
    /// Name, color and time per frame of each stage [s].
    pub stages: &'a [(&'a str, Rgb, &'a [f64])],
}

impl RuntimePlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        let series = self.stages.iter().map(|(name, color, times_s)| {
            let points = self.frames.iter().zip(*times_s);
            let points = points.map(|(&frame, time_s)| (frame as f64, 1e3 * time_s));
            Series::line(name, *color, points)
        });
        LineChart {
            title: self.title.to_owned(),
            x_name: "frame".to_owned(),
            panels: vec![Panel {
                y_name: "time per frame [ms]".to_owned(),
                series: series.collect(),
                clip_outliers: true,
                ..Panel::default()
            }],
            marks: Vec::new(),
        }
        .save(path)
    }
}
