//! Where the car was and where it was thought to be; how far apart, and how long that took.

use std::path::Path;

use super::MapImage;
use super::chart::{LineChart, Panel, Series};
use super::color::{MCL, REFINED, Rgb, TRUTH};
use super::error::PlotError;
use super::sheet::{self, HPos, Lettering, Pen, Point, Rect, Sheet, TICK, VPos};
use super::view::{Key, KeyShape, Span, View, legend, title};
use crate::evaluation::PlanarError;
use crate::geometry::Pose2;

/// A trajectory with its name and colour.
#[derive(Clone, Copy, Debug)]
pub struct Path2<'a> {
    /// What the legend calls it.
    pub name: &'a str,
    /// One of [`color`](super::color).
    pub color: Rgb,
    /// In the map frame.
    pub poses: &'a [Pose2],
}

impl<'a> Path2<'a> {
    /// The filter's estimates.
    pub fn mcl(poses: &'a [Pose2]) -> Self {
        Self {
            name: "MCL",
            color: MCL,
            poses,
        }
    }

    /// The refined trajectory.
    pub fn refined(poses: &'a [Pose2]) -> Self {
        Self {
            name: "refined",
            color: REFINED,
            poses,
        }
    }
}

/// Trajectories over the ground truth, seen from above.
#[derive(Clone, Copy, Debug)]
pub struct PathPlot<'a> {
    /// Above everything.
    pub title: &'a str,
    /// The ground truth, where there is one.
    pub ground_truth: Option<&'a [Pose2]>,
    /// Drawn over it, in this order.
    pub paths: &'a [Path2<'a>],
    /// Drawn pale below everything.
    pub map: Option<&'a MapImage>,
}

impl PathPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<(), PlotError> {
        let everything = || self.all_poses().map(|pose| pose.translation.vector);
        let spans = Span::of(everything().map(|t| t.x)).zip(Span::of(everything().map(|t| t.y)));
        let (x, y) = spans.ok_or_else(|| PlotError::Nothing {
            path: path.to_owned(),
            what: "all trajectories are empty",
        })?;
        let margin = (0.05 * x.length().max(y.length())).max(2.0);
        let (view, size) = map_view(x.padded(margin), y.padded(margin), 96.0, 30.0);
        sheet::save(path, size, |sheet| {
            title(sheet, self.title, view.rect.left)?;
            legend(sheet, &self.keys(), (view.rect.left, 70.0), view.rect.right)?;
            view.grid(sheet)?;
            if let Some(map) = self.map {
                map.draw(sheet, &view, 0.6)?;
            }
            self.draw_paths(sheet, &view)?;
            view.frame(sheet, "x [m]", "y [m]")?;
            view.scale_bar(sheet)
        })
    }

    fn all_poses(&self) -> impl Iterator<Item = &Pose2> {
        let paths = self.paths.iter().flat_map(|path| path.poses);
        self.ground_truth.into_iter().flatten().chain(paths)
    }

    fn keys(&self) -> Vec<Key> {
        let truth = self.ground_truth.map(|_| ("ground truth", TRUTH));
        let paths = self.paths.iter().map(|path| (path.name, path.color));
        truth
            .into_iter()
            .chain(paths)
            .map(|(name, color)| Key {
                name: name.to_owned(),
                color,
                shape: KeyShape::Line,
            })
            .collect()
    }

    fn draw_paths(&self, sheet: &Sheet, view: &View) -> Result<(), super::error::DrawError> {
        if let Some(truth) = self.ground_truth {
            sheet.polyline(&places(truth, view), &view.rect, Pen::new(TRUTH, 6.0))?;
        }
        for (number, path) in self.paths.iter().enumerate() {
            let width = if number == 0 { 3.0 } else { 2.0 };
            let pen = Pen::new(path.color, width);
            sheet.polyline(&places(path.poses, view), &view.rect, pen)?;
        }
        let longest = self
            .ground_truth
            .or(self.paths.first().map(|path| path.poses));
        if let Some([first, .., last]) = longest {
            let lettering = |h| Lettering::new(TICK, h, VPos::Bottom).bold();
            for (pose, word, side) in [(first, "start", HPos::Right), (last, "end", HPos::Left)] {
                let place = view.at(pose.translation.x, pose.translation.y);
                sheet.dot(place, 9.0, [255, 255, 255], 1.0)?;
                sheet.dot(place, 7.0, TRUTH, 1.0)?;
                let aside = if matches!(side, HPos::Right) {
                    -12.0
                } else {
                    12.0
                };
                sheet.text(word, (place.0 + aside, place.1 - 10.0), lettering(side))?;
            }
        }
        Ok(())
    }
}

/// Places on the sheet of poses.
pub(super) fn places(poses: &[Pose2], view: &View) -> Vec<Point> {
    poses
        .iter()
        .map(|pose| view.at(pose.translation.x, pose.translation.y))
        .collect()
}

/// Equal axes that suit a part of the plane, below a header of some height and with a margin to
/// the right, and the size of the picture around them.
pub(super) fn map_view(x: Span, y: Span, header: f64, right: f64) -> (View, (u32, u32)) {
    const WIDTH: f64 = 1400.0;
    const LEFT: f64 = 118.0;
    let width = WIDTH - LEFT - right;
    let height = (width * y.length() / x.length())
        .clamp(380.0, 1150.0)
        .round();
    let rect = Rect {
        left: LEFT,
        top: header,
        right: WIDTH - right,
        bottom: header + height,
    };
    let size = (WIDTH as u32, (header + height + 74.0) as u32);
    (View::equal(rect, x, y), size)
}

/// Position and heading error over time, one series per trajectory.
#[derive(Clone, Copy, Debug)]
pub struct ErrorPlot<'a> {
    /// Above everything.
    pub title: &'a str,
    /// Name of the x axis with its unit.
    pub x_name: &'a str,
    /// Time, frame number or distance, one per frame.
    pub x: &'a [f64],
    /// Name, colour and errors of each trajectory, one error per frame.
    pub errors: &'a [(&'a str, Rgb, &'a [PlanarError])],
}

impl ErrorPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<(), PlotError> {
        for (_, _, errors) in self.errors {
            if errors.len() != self.x.len() {
                return Err(PlotError::WrongLength {
                    path: path.to_owned(),
                    what: "errors",
                    found: errors.len(),
                    expected: self.x.len(),
                });
            }
        }
        let panel = |y_name: &str, number: fn(&PlanarError) -> f64| Panel {
            y_name: y_name.to_owned(),
            series: self
                .errors
                .iter()
                .map(|(name, color, errors)| {
                    let points = self.x.iter().copied().zip(errors.iter().map(number));
                    Series::line(name, *color, points)
                })
                .collect(),
            from_zero: true,
            clip_outliers: true,
            ..Panel::default()
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

/// Time that was spent on each frame.
#[derive(Clone, Copy, Debug)]
pub struct RuntimePlot<'a> {
    /// Above everything.
    pub title: &'a str,
    /// Numbers of the frames.
    pub frames: &'a [usize],
    /// Name, colour and time per frame of each stage [s].
    pub stages: &'a [(&'a str, Rgb, &'a [f64])],
    /// Row in which the filter converged.
    pub converged_row: Option<usize>,
}

impl RuntimePlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<(), PlotError> {
        let series = |(name, color, times_s): &(&str, Rgb, &[f64])| {
            let points = self.frames.iter().zip(*times_s);
            Series::line(
                name,
                *color,
                points.map(|(&frame, time_s)| (frame as f64, 1e3 * time_s)),
            )
        };
        let converged = self.converged_row.and_then(|row| self.frames.get(row));
        LineChart {
            title: self.title.to_owned(),
            x_name: "frame".to_owned(),
            panels: vec![Panel {
                y_name: "time per frame [ms]".to_owned(),
                series: self.stages.iter().map(series).collect(),
                from_zero: true,
                clip_outliers: true,
                ..Panel::default()
            }],
            marks: converged
                .map(|&frame| (frame as f64, "converged".to_owned()))
                .into_iter()
                .collect(),
        }
        .save(path)
    }
}
