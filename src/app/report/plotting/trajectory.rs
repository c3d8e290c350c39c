//! Trajectories over the ground truth, and their errors.

use std::path::Path;

use anyhow::{Context as _, Result};

use super::MapImage;
use super::bitmap::Bitmap;
use super::chart::{LineChart, Panel, Series};
use super::color::{Colormap, Rgb, TRUTH, WHITE};
use super::sheet::{HPos, Sheet, TICK, VPos, bold, save_png, stroke, text_style};
use super::view::{AxisRange, ColorBar, LegendEntry, Mark, TopView, View, positions};
use crate::evaluation::{
    DriftPoint, LengthErrors, PlanarError, SpatialMetrics, aligned, drift, rigid_alignment,
};
use crate::geometry::{Pose2, Pose3};

/// Trajectories over the ground truth, from above.
#[derive(Clone, Copy, Debug)]
pub struct PathPlot<'a> {
    /// Title.
    pub title: &'a str,
    /// Ground truth, if known.
    pub ground_truth: Option<&'a [Pose2]>,
    /// Name, color and poses in the map frame of each trajectory, drawn in this order. Poses that are not a number are gaps.
    pub paths: &'a [(&'a str, Rgb, &'a [Pose2])],
    /// Name with unit and number per pose of the last trajectory, which is colored by them.
    pub numbers: Option<(&'a str, &'a [f64])>,
    /// Map, drawn pale below everything.
    pub map: Option<&'a MapImage>,
}

/// Width of the last line [pixels].
const LINE_WIDTH: f64 = 3.0;

impl PathPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        save_png(path, self.draw())
    }

    fn draw(&self) -> Result<Bitmap> {
        let truth = (self.ground_truth).map(|poses| ("ground truth", TRUTH, poses));
        let all: Vec<_> = truth.iter().chain(self.paths).copied().collect();
        let poses = || all.iter().flat_map(|&(_, _, poses)| poses);
        let x = AxisRange::of(poses().map(|pose| pose.translation.x));
        let ranges = x.zip(AxisRange::of(poses().map(|pose| pose.translation.y)));
        let (x, y) = ranges.context("there is nothing to draw: all trajectories are empty")?;
        let margin = (0.065 * x.length().max(y.length())).max(2.0);
        let color_bar = self.color_bar();
        // The last trajectory is only in the colors of its numbers.
        let (plain, colored) = all.split_at(all.len() - usize::from(color_bar.is_some()));
        let entries = plain
            .iter()
            .map(|&(name, color, _)| (name.to_owned(), color));
        let colored_name = |&(name, ..): &(&str, _, _)| format!("{name}, colored");
        let middle = Colormap::Viridis.at(0.6);
        let entries = entries.chain(colored.iter().map(|it| (colored_name(it), middle)));
        let entries: Vec<(String, Rgb)> = entries.collect();
        let view = TopView {
            title: self.title,
            legend: (entries.iter())
                .map(|(name, color)| LegendEntry::new(name, *color, Mark::Line))
                .collect(),
            x: x.padded(margin),
            y: y.padded(margin),
            color_bar,
        };
        view.draw(|sheet, view| {
            if let Some(map) = self.map {
                map.draw(sheet, view, 0.5)?;
            }
            // Where lines coincide, the rims of the earlier ones are visible.
            let width = |row: usize| LINE_WIDTH * (all.len() - row).min(3) as f64;
            for (row, &(_, color, poses)) in plain.iter().enumerate() {
                let stroke = stroke(color, width(row));
                sheet.polyline(&positions(poses, view), &view.rect, stroke)?;
            }
            if let (Some(bar), Some((_, numbers))) = (color_bar, self.numbers) {
                let places = positions(colored[0].2, view);
                for (pair, numbers) in places.windows(2).zip(numbers.windows(2)) {
                    let color = bar.color(0.5 * (numbers[0] + numbers[1]));
                    sheet.polyline(pair, &view.rect, stroke(color, LINE_WIDTH))?;
                }
            }
            draw_ends(sheet, view, all[0].2)
        })
    }

    /// Color bar of the numbers; rare ones far above all others have its last color.
    fn color_bar(&self) -> Option<ColorBar<'_>> {
        let (name, numbers) = self.numbers?;
        let finite = numbers.iter().copied().filter(|it| it.is_finite());
        let mut finite: Vec<f64> = finite.collect();
        finite.sort_by(f64::total_cmp);
        let &usual = finite.get(finite.len().saturating_sub(1) * 98 / 100)?;
        Some(ColorBar {
            range: AxisRange::new(0.0, usual.max(1e-9)),
            colormap: Colormap::Viridis,
            name,
        })
    }
}

/// Marks the first and the last pose, each with its name where the path does not continue.
fn draw_ends(sheet: &Sheet, view: &View, poses: &[Pose2]) -> Result<()> {
    /// Length of the path next to an end that its name leaves free, and distance of the name [pixels].
    const NEAR: f64 = 40.0;
    const ASIDE: f64 = 16.0;
    let mut places = positions(poses, view);
    places.retain(|place| place.0.is_finite());
    let mut reversed = places.clone();
    reversed.reverse();
    for (places, label) in [(places, "start"), (reversed, "end")] {
        let [place, .., far] = places[..] else {
            return Ok(());
        };
        let from_end = |it: &(f64, f64)| (it.0 - place.0, it.1 - place.1);
        let mut others = places.iter().map(from_end);
        let (x, y) = others
            .find(|it| it.0.hypot(it.1) > NEAR)
            .unwrap_or(from_end(&far));
        let side = match x {
            _ if y.abs() > x.abs() => HPos::Center,
            0.0.. => HPos::Right,
            _ => HPos::Left,
        };
        let line = match y {
            _ if y.abs() <= x.abs() => VPos::Center,
            0.0.. => VPos::Bottom,
            _ => VPos::Top,
        };
        let length = x.hypot(y).max(1.0);
        let at = (place.0 - ASIDE * x / length, place.1 - ASIDE * y / length);
        sheet.dot(place, 9.0, WHITE, 1.0)?;
        sheet.dot(place, 7.0, TRUTH, 1.0)?;
        sheet.text(label, at, &bold(text_style(TICK, side, line)))?;
    }
    Ok(())
}

/// Position and heading error of trajectories: name, color, and errors over time or frame number.
pub fn error_chart<'a, E: IntoIterator<Item = (f64, PlanarError)>>(
    title: &str,
    x_name: &str,
    trajectories: impl IntoIterator<Item = (&'a str, Rgb, E)>,
) -> LineChart {
    let series = trajectories.into_iter().map(|(name, color, errors)| {
        let errors = errors.into_iter().map(|(x, error)| {
            let heading_deg = error.turn_rad.abs().to_degrees();
            ((x, 100.0 * error.distance_m()), (x, heading_deg))
        });
        let (position_cm, heading_deg): (Vec<_>, Vec<_>) = errors.unzip();
        [position_cm, heading_deg].map(|points| Series::line(name, color, points))
    });
    let (position, heading): (Vec<_>, Vec<_>) = series.map(<(_, _)>::from).unzip();
    let panels = [
        Panel::new("position error [cm]", position),
        Panel::new("heading error [deg]", heading),
    ];
    LineChart::new(title, x_name, panels)
}

/// A trajectory: name, color, a pose per true pose, where it has any, and whether each is trusted.
pub type NamedPoses<'a> = (&'a str, Rgb, &'a [Pose3], &'a [bool]);

/// A chart of trajectories: position and heading error against the distance, dashed after rigid alignment, and relative
/// errors against the length of segments. Poses that are not trusted are gaps.
pub fn drift_chart(truth: &[Pose3], trajectories: &[NamedPoses]) -> LineChart {
    let mut panels = [
        "position error [m]",
        "heading error [deg]",
        "translation error [%]",
        "rotation error [deg/100 m]",
    ]
    .map(|y_name| Panel {
        y_name: y_name.to_owned(),
        ..Panel::default()
    });
    for &(name, color, estimates, trusted) in trajectories {
        let trusted_of = |poses: &[Pose3]| -> Vec<Pose3> {
            let poses = poses
                .iter()
                .zip(trusted)
                .filter(|(_, is_trusted)| **is_trusted);
            poses.map(|(pose, _)| *pose).collect()
        };
        let (alignment, by_length) = {
            let (of_estimates, of_truth) = (trusted_of(estimates), trusted_of(truth));
            let metrics = SpatialMetrics::new(&of_estimates, &of_truth, 0);
            let by_length = metrics.map(|it| it.by_length).unwrap_or_default();
            (rigid_alignment(&of_estimates, &of_truth), by_length)
        };
        let moved = alignment.map(|it| aligned(&it, estimates));
        let label = format!("{name}, rigidly aligned");
        for (name, mark, poses) in [
            (name, Mark::Line, estimates),
            (&label, Mark::Dashes, moved.as_deref().unwrap_or_default()),
        ] {
            let points = drift(poses, truth);
            let values: [fn(&DriftPoint) -> f64; 2] =
                [|it| it.position_m, |it| it.heading_rad.to_degrees()];
            for (panel, value) in panels.iter_mut().zip(values).filter(|_| !points.is_empty()) {
                let or_gap = |(it, is_trusted): (&DriftPoint, &bool)| {
                    let value = if *is_trusted { value(it) } else { f64::NAN };
                    (it.distance_m, value)
                };
                let points = points.iter().zip(trusted).map(or_gap);
                panel.series.push(Series {
                    mark,
                    ..Series::line(name, color, points)
                });
            }
        }
        let values: [fn(&LengthErrors) -> f64; 2] = [
            |it| it.errors.translation_percent,
            |it| it.errors.rotation_deg_per_100_m(),
        ];
        for (panel, value) in panels[2..].iter_mut().zip(values) {
            let points = by_length.iter().map(|it| (it.length_m, value(it)));
            panel.series.push(Series::line(name, color, points));
            panel.own_x_name = Some("length of the segments [m]".to_owned());
        }
    }
    let title = "Error against the distance driven, and over segments";
    LineChart::new(title, "distance [m]", panels)
}
