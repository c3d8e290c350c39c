//! Trajectories over the ground truth, and their errors.

use std::path::Path;

use anyhow::{Context as _, Result};

use super::MapImage;
use super::bitmap::Bitmap;
use super::chart::{LineChart, Panel, Series};
use super::color::{Rgb, TRUTH, WHITE};
use super::sheet::{HPos, Sheet, TICK, VPos, bold, save_png, stroke, text_style};
use super::top_view::{TopView, positions};
use super::view::{AxisRange, LegendEntry, Mark, View};
use crate::evaluation::PlanarError;
use crate::geometry::Pose2;

/// Trajectories over the ground truth, from above.
#[derive(Clone, Copy, Debug)]
pub struct PathPlot<'a> {
    /// Title.
    pub title: &'a str,
    /// Ground truth, if known.
    pub ground_truth: Option<&'a [Pose2]>,
    /// Name, color and poses in the map frame of each trajectory, drawn in this order.
    pub paths: &'a [(&'a str, Rgb, &'a [Pose2])],
    /// Map, drawn pale below everything.
    pub map: Option<&'a MapImage>,
}

impl PathPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        save_png(path, self.draw())
    }

    fn draw(&self) -> Result<Bitmap> {
        let truth = self
            .ground_truth
            .map(|poses| ("ground truth", TRUTH, poses));
        let all = || truth.iter().chain(self.paths);
        let positions = || {
            all()
                .flat_map(|&(_, _, poses)| poses)
                .map(|p| p.translation)
        };
        let x = AxisRange::of(positions().map(|t| t.x));
        let ranges = x.zip(AxisRange::of(positions().map(|t| t.y)));
        let (x, y) = ranges.context("there is nothing to draw: all trajectories are empty")?;
        let margin = (0.05 * x.length().max(y.length())).max(2.0);
        let view = TopView {
            title: self.title,
            legend: all()
                .map(|&(name, color, _)| LegendEntry::new(name, color, Mark::Line))
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
        for (number, &(_, color, poses)) in self.paths.iter().enumerate() {
            let width = if number == 0 { 3.0 } else { 2.0 };
            let stroke = stroke(color, width);
            sheet.polyline(&positions(poses, view), &view.rect, stroke)?;
        }
        let longest = self
            .ground_truth
            .or(self.paths.first().map(|&(_, _, poses)| poses));
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

/// Name and color of a trajectory, and its errors over time, frame number or distance.
pub type NamedErrors<'a> = (&'a str, Rgb, Vec<(f64, PlanarError)>);

/// Position and heading error of trajectories.
pub fn error_chart(title: &str, x_name: &str, trajectories: &[NamedErrors]) -> LineChart {
    let panel = |y_name: &str, value: fn(&PlanarError) -> f64| {
        let series = trajectories.iter().map(|(name, color, errors)| {
            let points = errors.iter().map(|(x, error)| (*x, value(error)));
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
        title: title.to_owned(),
        x_name: x_name.to_owned(),
        panels: vec![
            panel("position error [m]", PlanarError::distance_m),
            panel("heading error [deg]", |error| {
                error.turn_rad.abs().to_degrees()
            }),
        ],
        marks: Vec::new(),
    }
}
