//! Trajectories over the ground truth, and their errors.

use std::path::Path;

use anyhow::{Context as _, Result};
use nalgebra::Vector2;

use super::MapImage;
use super::bitmap::Bitmap;
use super::chart::{LineChart, Panel, Series};
use super::color::{Colormap, INK, Rgb, TRUTH, WHITE};
use super::sheet::{HPos, Point, Rect, Sheet, TICK, VPos, bold, save_png, stroke, text_style};
use super::top_view::{TopView, WIDTH, positions};
use super::view::{AxisRange, ColorBar, LegendEntry, Mark, View};
use crate::evaluation::PlanarError;
use crate::geometry::Pose2;

/// Trajectories over the ground truth, from above; with numbers also enlarged where the last one has its
/// largest.
#[derive(Clone, Copy, Debug)]
pub struct PathPlot<'a> {
    /// Title.
    pub title: &'a str,
    /// Ground truth, if known.
    pub ground_truth: Option<&'a [Pose2]>,
    /// Name, color and poses in the map frame of each trajectory, drawn in this order.
    pub paths: &'a [(&'a str, Rgb, &'a [Pose2])],
    /// Name with unit and number per pose of the last trajectory, which is colored by them.
    pub numbers: Option<(&'a str, &'a [f64])>,
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
        let margin = (0.065 * x.length().max(y.length())).max(2.0);
        // Without an enlarged part, the last trajectory is only in the colors of its numbers.
        let in_own_color = match (truth, self.numbers) {
            (None, Some(_)) => self.paths.len().saturating_sub(1),
            _ => usize::MAX,
        };
        let view = TopView {
            title: self.title,
            width: WIDTH,
            legend: all()
                .take(in_own_color)
                .map(|&(name, color, _)| LegendEntry::new(name, color, Mark::Line))
                .collect(),
            x: x.padded(margin),
            y: y.padded(margin),
            color_bar: self.color_bar(),
        };
        view.draw(|sheet, view| {
            if let Some(map) = self.map {
                map.draw(sheet, view, 0.5)?;
            }
            self.draw_paths(sheet, view)?;
            self.draw_ends(sheet, view)?;
            self.draw_enlarged(sheet, view)
        })
    }

    fn draw_paths(&self, sheet: &Sheet, view: &View) -> Result<()> {
        if let Some(truth) = self.ground_truth {
            sheet.polyline(&positions(truth, view), &view.rect, stroke(TRUTH, 6.0))?;
        }
        for (number, &(_, color, poses)) in self.paths.iter().enumerate() {
            let width = if number == 0 { 3.0 } else { 2.0 };
            let places = positions(poses, view);
            match (self.color_bar(), self.numbers) {
                (Some(bar), Some((_, numbers))) if number + 1 == self.paths.len() => {
                    for (pair, numbers) in places.windows(2).zip(numbers.windows(2)) {
                        let color = bar.color(0.5 * (numbers[0] + numbers[1]));
                        sheet.polyline(pair, &view.rect, stroke(color, 4.5))?;
                    }
                }
                _ => sheet.polyline(&places, &view.rect, stroke(color, width))?,
            }
        }
        Ok(())
    }

    /// Color bar of the numbers; rare ones far above all others have its last color.
    fn color_bar(&self) -> Option<ColorBar<'_>> {
        let (name, numbers) = self.numbers?;
        let mut finite: Vec<f64> = numbers
            .iter()
            .copied()
            .filter(|it| it.is_finite())
            .collect();
        finite.sort_by(f64::total_cmp);
        let &usual = finite.get(finite.len().saturating_sub(1) * 98 / 100)?;
        Some(ColorBar {
            range: AxisRange::new(0.0, usual.max(1e-9)),
            colormap: Colormap::Viridis,
            name,
        })
    }

    /// Marks the first and the last pose.
    fn draw_ends(&self, sheet: &Sheet, view: &View) -> Result<()> {
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

    /// Draws all trajectories where the last one is farthest from the truth, enlarged in a corner.
    fn draw_enlarged(&self, sheet: &Sheet, view: &View) -> Result<()> {
        let Some((center, width_m)) = self.place_to_enlarge() else {
            return Ok(());
        };
        let rect = self.emptiest_corner(view);
        let range = |middle: f64| AxisRange::new(middle, middle);
        let close = View::equal(
            rect,
            range(center.x).at_least(width_m),
            range(center.y).at_least(1e-9),
        );
        sheet.fill(&rect, WHITE)?;
        let truth = self.ground_truth.map(|poses| (TRUTH, poses));
        let paths = self.paths.iter().map(|&(_, color, poses)| (color, poses));
        for (color, poses) in truth.into_iter().chain(paths) {
            let places = positions(poses, &close);
            sheet.polyline(&places, &rect, stroke(color, 3.0))?;
            for place in places.into_iter().filter(|place| rect.contains(*place)) {
                sheet.dot(place, 6.0, color, 1.0)?;
            }
        }
        sheet.outline(&rect, stroke(INK, 1.5))?;
        let place = view.at(center.x, center.y);
        let [near, far] = [rect.left, rect.right].map(|x| (x - place.0).abs());
        let side = if near < far { rect.left } else { rect.right };
        sheet.line(
            place,
            (side, rect.bottom.min(place.1).max(rect.top)),
            stroke(INK, 1.5),
        )?;
        close.scale_bar_inside(sheet)
    }

    /// Center and width of the part around the largest number, after the search at the beginning.
    fn place_to_enlarge(&self) -> Option<(Vector2<f64>, f64)> {
        /// Frames of the search, in which errors may be large.
        const SEARCH: usize = 10;
        const NARROWEST_M: f64 = 0.004;
        let (truth, (_, numbers)) = (self.ground_truth?, self.numbers?);
        let later = (0..numbers.len()).skip(SEARCH.min(numbers.len() / 2));
        let largest = later
            .filter(|&pose| numbers[pose].is_finite())
            .max_by(|&a, &b| numbers[a].total_cmp(&numbers[b]))?;
        let center = truth.get(largest)?.translation.vector;
        let offsets_m: Vec<f64> = (self.paths.iter())
            .filter_map(|(_, _, poses)| {
                Some((poses.get(largest)?.translation.vector - center).norm())
            })
            .collect();
        let last_m = *offsets_m.last()?;
        // A trajectory that is lost does not hide the others.
        let near_m = offsets_m
            .into_iter()
            .filter(|offset_m| *offset_m <= 10.0 * last_m);
        let reach_m = near_m.fold(last_m, f64::max);
        Some((center, 4.0 * reach_m.max(NARROWEST_M)))
    }

    /// The corner of a view with the fewest poses.
    fn emptiest_corner(&self, view: &View) -> Rect {
        const WIDTH: f64 = 300.0;
        const HEIGHT: f64 = 220.0;
        const MARGIN: f64 = 16.0;
        let rect = view.rect;
        let corners = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)].map(|(right, down)| {
            let left = rect.left + MARGIN + right * (rect.width() - WIDTH - 2.0 * MARGIN);
            let top = rect.top + MARGIN + down * (rect.height() - HEIGHT - 2.0 * MARGIN);
            Rect {
                left,
                top,
                right: left + WIDTH,
                bottom: top + HEIGHT,
            }
        });
        let places: Vec<Point> = (self.paths.iter())
            .flat_map(|(_, _, poses)| positions(poses, view))
            .collect();
        let count = |corner: &Rect| places.iter().filter(|it| corner.contains(**it)).count();
        corners.into_iter().min_by_key(count).unwrap_or(rect)
    }
}

/// Name and color of a trajectory, and its errors over time or frame number.
pub type NamedErrors<'a> = (&'a str, Rgb, Vec<(f64, PlanarError)>);

/// Position and heading error of trajectories.
pub fn error_chart(title: &str, x_name: &str, trajectories: &[NamedErrors]) -> LineChart {
    let panel = |y_name: &str, value: fn(&PlanarError) -> f64| {
        let series = trajectories.iter().map(|(name, color, errors)| {
            let points = errors.iter().map(|(x, error)| (*x, value(error)));
            Series::line(name, *color, points)
        });
        Panel::new(y_name, series)
    };
    let panels = [
        panel("position error [cm]", |error| 100.0 * error.distance_m()),
        panel("heading error [deg]", |error| {
            error.turn_rad.abs().to_degrees()
        }),
    ];
    LineChart::new(title, x_name, panels)
}
