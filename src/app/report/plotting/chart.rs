//! Line charts: panels one above the other, by default over a common x axis.

use std::path::Path;

use anyhow::{Context as _, Result};

use super::bitmap::Bitmap;
use super::color::{INK, Rgb, WHITE};
use super::sheet::{self, HPos, Point, Rect, Sheet, TICK, VPos, save_png, stroke, text_style};
use super::view::{AxisRange, LegendEntry, Mark, View, legend};

const WIDTH: f64 = 1400.0;
const LEFT: f64 = 118.0;
const RIGHT: f64 = 30.0;
const HEADER: f64 = 60.0;
const LEGEND: f64 = 46.0;
const PANEL: f64 = 300.0;
const BELOW_PANEL: f64 = 78.0;

/// Named points.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// Name in the legend; empty for no entry.
    pub name: String,
    /// Color.
    pub color: Rgb,
    /// Line, dashes or dots.
    pub mark: Mark,
    /// Points (x, y), x ascending for lines.
    pub points: Vec<(f64, f64)>,
}

impl Series {
    /// Solid line.
    pub fn line(name: &str, color: Rgb, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        Self {
            name: name.to_owned(),
            color,
            mark: Mark::Line,
            points: points.into_iter().collect(),
        }
    }
}

/// Axes with series; the y axis starts at zero unless there are negative values.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Panel {
    /// Name of the y axis with its unit.
    pub y_name: String,
    /// Name of a separate x axis, which spans the series of the panel; `None` for the common axis.
    pub own_x_name: Option<String>,
    /// Series.
    pub series: Vec<Series>,
    /// Whether rare values far above all others are cut off, with a note.
    pub clip_outliers: bool,
}

/// Panels over a common x axis, except those that have a separate one.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LineChart {
    /// Title.
    pub title: String,
    /// Name of the common x axis with its unit.
    pub x_name: String,
    /// Whether the numbers on the common x axis are whole, such as those of frames.
    pub is_x_whole: bool,
    /// Panels from the top.
    pub panels: Vec<Panel>,
    /// Vertical lines: x and label.
    pub marks: Vec<(f64, String)>,
}

/// Name of an x axis of frame numbers, which are whole.
pub const FRAME: &str = "frame";

impl LineChart {
    /// Panels one above the other, without those that show nothing.
    pub fn new(title: &str, x_name: &str, panels: impl IntoIterator<Item = Panel>) -> Self {
        let is_shown = |(x, y): &(f64, f64)| x.is_finite() && y.is_finite();
        let has_points =
            |panel: &Panel| panel.series.iter().any(|it| it.points.iter().any(is_shown));
        Self {
            title: title.to_owned(),
            x_name: x_name.to_owned(),
            is_x_whole: x_name == FRAME,
            panels: panels.into_iter().filter(has_points).collect(),
            ..Self::default()
        }
    }

    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        save_png(path, self.draw())
    }

    fn draw(&self) -> Result<Bitmap> {
        let x = x_range(&self.panels).context("there is nothing to draw: all series are empty")?;
        // Whole numbers at the ends are not on the frame.
        let x = if self.is_x_whole { x.padded(0.5) } else { x };
        let panel_height = LEGEND + PANEL + BELOW_PANEL;
        let height = HEADER + self.panels.len() as f64 * panel_height;
        sheet::draw((WIDTH as u32, height as u32), |sheet| {
            sheet.title(&self.title, LEFT)?;
            for (number, panel) in self.panels.iter().enumerate() {
                self.draw_panel(sheet, panel, x, HEADER + number as f64 * panel_height)?;
            }
            Ok(())
        })
    }

    fn draw_panel(&self, sheet: &Sheet, panel: &Panel, x: AxisRange, top: f64) -> Result<()> {
        let right = WIDTH - RIGHT;
        let named = panel.series.iter().filter(|series| !series.name.is_empty());
        let entries: Vec<LegendEntry> = named
            .map(|series| LegendEntry::new(&series.name, series.color, series.mark))
            .collect();
        legend(sheet, &entries, (LEFT, top + 12.0), right)?;
        let top = top + LEGEND;
        let rect = Rect {
            left: LEFT,
            top,
            right,
            bottom: top + PANEL,
        };
        let (x_name, x) = match &panel.own_x_name {
            Some(name) => (name, x_range([panel]).unwrap_or(x)),
            None => (&self.x_name, x),
        };
        let (y, cut_off) = panel.y_range();
        let view = View { rect, x, y };
        let x_ticks = if self.is_x_whole && panel.own_x_name.is_none() {
            view.whole_x_ticks()
        } else {
            view.x_ticks()
        };
        view.grid(sheet, &x_ticks)?;
        self.draw_marks(sheet, &view)?;
        for series in &panel.series {
            series.draw(sheet, &view)?;
        }
        if let Some(highest) = cut_off {
            let text = format!(
                "some values are above, up to {} {}",
                rounded(highest),
                panel.unit()
            );
            let style = text_style(TICK, HPos::Right, VPos::Top);
            sheet.text(&text, (rect.right - 10.0, rect.top + 8.0), &style)?;
        }
        view.frame(sheet, &x_ticks, [x_name, &panel.y_name])
    }

    fn draw_marks(&self, sheet: &Sheet, view: &View) -> Result<()> {
        let style = text_style(TICK, HPos::Center, VPos::Center);
        for (x, label) in &self.marks {
            let (column, bottom) = view.at(*x, view.y.min);
            let ends = [(column, view.rect.top), (column, bottom)];
            sheet.dashes(&ends, &view.rect, stroke(INK, 1.5), (6.0, 5.0))?;
            sheet.text(label, (column, view.rect.top - 12.0), &style)?;
        }
        Ok(())
    }
}

/// Range of x of all series; `None` without points.
fn x_range<'a>(panels: impl IntoIterator<Item = &'a Panel>) -> Option<AxisRange> {
    let series = panels.into_iter().flat_map(|panel| &panel.series);
    let points = series.flat_map(|series| &series.points);
    AxisRange::of(points.map(|point| point.0)).map(|range| range.at_least(1e-9))
}

impl Panel {
    /// A panel over the common x axis, whose rare high values are cut off.
    pub fn new(y_name: &str, series: impl IntoIterator<Item = Series>) -> Self {
        Self {
            y_name: y_name.to_owned(),
            series: series.into_iter().collect(),
            clip_outliers: true,
            ..Self::default()
        }
    }

    /// Unit in the name of the y axis, empty without.
    fn unit(&self) -> &str {
        let in_brackets = self.y_name.split_once('[').map_or("", |(_, unit)| unit);
        in_brackets.trim_end_matches(']')
    }

    /// Range of the y axis, and the highest value if it is cut off.
    fn y_range(&self) -> (AxisRange, Option<f64>) {
        let points = self.series.iter().flat_map(|series| &series.points);
        let mut numbers: Vec<f64> = points.map(|p| p.1).filter(|y| y.is_finite()).collect();
        numbers.sort_by(f64::total_cmp);
        let (Some(&lowest), Some(&highest)) = (numbers.first(), numbers.last()) else {
            return (AxisRange::new(0.0, 1.0), None);
        };
        let usual = numbers[(numbers.len() - 1) * 98 / 100];
        let clipped = self.clip_outliers && usual > 0.0 && highest > 3.0 * usual;
        let top = if clipped { 1.5 * usual } else { highest };
        let starts_at_zero = lowest >= 0.0;
        let bottom = if starts_at_zero { 0.0 } else { lowest };
        let margin = 0.06 * (top - bottom).max(1e-6 * top.abs()).max(1e-9);
        let below = if starts_at_zero { 0.0 } else { margin };
        let range = AxisRange::new(bottom - below, top + margin);
        (range, clipped.then_some(highest))
    }
}

/// A positive number with two digits or all digits before the point.
fn rounded(number: f64) -> String {
    let decimals = (1.0 - number.log10().floor()).clamp(0.0, 9.0) as usize;
    format!("{number:.decimals$}")
}

impl Series {
    fn draw(&self, sheet: &Sheet, view: &View) -> Result<()> {
        let stroke = stroke(self.color, 2.5);
        for run in self
            .points
            .split(|point| !(point.0.is_finite() && point.1.is_finite()))
        {
            let places: Vec<Point> = run.iter().map(|&(x, y)| view.at(x, y)).collect();
            match self.mark {
                Mark::Line => sheet.polyline(&places, &view.rect, stroke)?,
                Mark::Dashes => sheet.dashes(&places, &view.rect, stroke, (10.0, 6.0))?,
                Mark::Dots | Mark::Area => {
                    for &place in places.iter().filter(|place| view.rect.contains(**place)) {
                        sheet.dot(place, 5.0, WHITE, 1.0)?;
                        sheet.dot(place, 4.0, self.color, 1.0)?;
                    }
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn panel(points: Vec<(f64, f64)>) -> Panel {
        Panel {
            y_name: "error [m]".to_owned(),
            series: vec![Series::line("error", [213, 94, 0], points)],
            clip_outliers: true,
            ..Panel::default()
        }
    }

    #[test]
    fn a_few_outliers_are_cut_off_with_a_note_and_many_are_not() {
        let few = panel(
            (0..200)
                .map(|k| (f64::from(k), if k < 2 { 30.0 } else { 0.3 }))
                .collect(),
        );
        let (range, cut_off) = few.y_range();
        assert!(range.max < 1.0);
        assert_eq!(cut_off, Some(30.0));
        let many = panel(
            (0..200)
                .map(|k| (f64::from(k), if k < 50 { 30.0 } else { 0.3 }))
                .collect(),
        );
        let (range, cut_off) = many.y_range();
        assert!(range.max > 30.0);
        assert_eq!(cut_off, None);
    }

    #[test]
    fn the_highest_value_is_noted_in_the_unit_of_the_axis() {
        assert_eq!(panel(vec![]).unit(), "m");
        let values = [1234.5, 45.2, 4.52, 0.0452].map(rounded);
        assert_eq!(values, ["1234", "45", "4.5", "0.045"]);
    }

    #[test]
    fn a_chart_of_nothing_is_an_error_that_names_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let chart = LineChart {
            panels: vec![panel(vec![(0.0, f64::NAN); 0])],
            ..LineChart::default()
        };
        let error = chart.save(&folder.path().join("errors.png")).unwrap_err();
        let message = format!("{error:#}");
        assert!(message.contains("errors.png"), "{message}");
    }

    #[test]
    fn a_constant_series_has_a_nonempty_range() {
        let (range, _) = panel(vec![(0.0, 2.0), (1.0, 2.0)]).y_range();
        assert!(range.max > range.min);
        let (range, _) = panel(vec![(0.0, 0.0), (1.0, 0.0)]).y_range();
        assert!(range.max > range.min);
    }
}
