//! Numbers over a common axis, in panels one above the other.

use std::path::Path;

use super::color::{INK, Rgb, WHITE};
use super::error::{DrawError, PlotError};
use super::sheet::{self, HPos, Lettering, Pen, Point, Rect, Sheet, TICK, VPos};
use super::view::{Key, KeyShape, Span, View, legend, title};

const WIDTH: f64 = 1400.0;
const LEFT: f64 = 118.0;
const RIGHT: f64 = 30.0;
const HEADER: f64 = 60.0;
const LEGEND: f64 = 46.0;
const PANEL: f64 = 300.0;
const BELOW_PANEL: f64 = 78.0;

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    /// A line through its points; a gap where one is not finite.
    Line,
    /// A dashed line.
    Dashes,
    /// A dot per point.
    Dots,
}

/// Named numbers over numbers.
#[derive(Clone, Debug, PartialEq)]
pub struct Series {
    /// What the legend calls it; empty where it belongs to another.
    pub name: String,
    /// Of line or dots.
    pub color: Rgb,
    /// Line or dots.
    pub mark: Mark,
    /// (x, y), x ascending for lines.
    pub points: Vec<(f64, f64)>,
}

impl Series {
    /// A line.
    pub fn line(name: &str, color: Rgb, points: impl IntoIterator<Item = (f64, f64)>) -> Self {
        Self {
            name: name.to_owned(),
            color,
            mark: Mark::Line,
            points: points.into_iter().collect(),
        }
    }
}

/// Axes with series.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Panel {
    /// Name of the y axis with its unit.
    pub y_name: String,
    /// Name of an x axis of its own, as wide as the panel's series; none for the common one.
    pub own_x_name: Option<String>,
    /// What is drawn.
    pub series: Vec<Series>,
    /// Whether the y axis begins at zero.
    pub from_zero: bool,
    /// Whether rare numbers far above all others may leave the panel, which then says so.
    pub clip_outliers: bool,
}

/// Panels over a common x axis, except those that have their own.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LineChart {
    /// Above everything.
    pub title: String,
    /// Name of the x axis with its unit.
    pub x_name: String,
    /// From the top.
    pub panels: Vec<Panel>,
    /// Upright lines at some x, with a word each.
    pub marks: Vec<(f64, String)>,
}

impl LineChart {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<(), PlotError> {
        let all = self.panels.iter().flat_map(|panel| &panel.series);
        let x = Span::of(all.flat_map(|series| series.points.iter().map(|point| point.0)))
            .ok_or_else(|| PlotError::Nothing {
                path: path.to_owned(),
                what: "all series are empty",
            })?;
        let x = x.at_least(1e-9);
        let height = HEADER + self.panels.len() as f64 * (LEGEND + PANEL + BELOW_PANEL);
        sheet::save(path, (WIDTH as u32, height as u32), |sheet| {
            title(sheet, &self.title, LEFT)?;
            for (number, panel) in self.panels.iter().enumerate() {
                let top = HEADER + number as f64 * (LEGEND + PANEL + BELOW_PANEL);
                self.draw_panel(sheet, panel, x, top)?;
            }
            Ok(())
        })
    }

    fn draw_panel(&self, sheet: &Sheet, panel: &Panel, x: Span, top: f64) -> Result<(), DrawError> {
        let named = panel.series.iter().filter(|series| !series.name.is_empty());
        let keys: Vec<Key> = named.map(Series::key).collect();
        legend(sheet, &keys, (LEFT, top + 12.0), WIDTH - RIGHT)?;
        let rect = Rect {
            left: LEFT,
            top: top + LEGEND,
            right: WIDTH - RIGHT,
            bottom: top + LEGEND + PANEL,
        };
        let own_x = panel.own_x_name.as_ref().and_then(|_| panel.x_span());
        let x = own_x.unwrap_or(x);
        let (y, above) = panel.y_span();
        let view = View { rect, x, y };
        view.grid(sheet)?;
        self.draw_marks(sheet, &view)?;
        for series in &panel.series {
            series.draw(sheet, &view)?;
        }
        if let Some(highest) = above {
            let text = format!("some values are above, up to {highest:.1}");
            let lettering = Lettering::new(TICK, HPos::Right, VPos::Top).color(INK);
            sheet.text(&text, (rect.right - 10.0, rect.top + 8.0), lettering)?;
        }
        let x_name = panel.own_x_name.as_ref().unwrap_or(&self.x_name);
        view.frame(sheet, x_name, &panel.y_name)
    }

    fn draw_marks(&self, sheet: &Sheet, view: &View) -> Result<(), DrawError> {
        for (x, word) in &self.marks {
            let (column, bottom) = view.at(*x, view.y.min);
            let ends = [(column, view.rect.top), (column, bottom)];
            sheet.dashes(&ends, &view.rect, Pen::new(INK, 1.5), (6.0, 5.0))?;
            let lettering = Lettering::new(TICK, HPos::Center, VPos::Center);
            sheet.text(word, (column, view.rect.top - 12.0), lettering)?;
        }
        Ok(())
    }
}

impl Panel {
    /// The range of its own x axis; `None` without numbers.
    fn x_span(&self) -> Option<Span> {
        let points = self.series.iter().flat_map(|series| &series.points);
        Span::of(points.map(|point| point.0)).map(|span| span.at_least(1e-9))
    }

    /// The range of the y axis, and the highest value where some are above it.
    fn y_span(&self) -> (Span, Option<f64>) {
        let mut numbers: Vec<f64> = self
            .series
            .iter()
            .flat_map(|series| series.points.iter().map(|point| point.1))
            .filter(|y| y.is_finite())
            .collect();
        numbers.sort_by(f64::total_cmp);
        let (Some(&lowest), Some(&highest)) = (numbers.first(), numbers.last()) else {
            return (Span::new(0.0, 1.0), None);
        };
        let usual = numbers[(numbers.len() - 1) * 98 / 100];
        let clipped = self.clip_outliers && usual > 0.0 && highest > 3.0 * usual;
        let top = if clipped { 1.5 * usual } else { highest };
        let bottom = if self.from_zero {
            lowest.min(0.0)
        } else {
            lowest
        };
        let margin = 0.06 * (top - bottom).max(1e-6 * top.abs()).max(1e-9);
        let below = if self.from_zero && lowest >= 0.0 {
            0.0
        } else {
            margin
        };
        (
            Span::new(bottom - below, top + margin),
            clipped.then_some(highest),
        )
    }
}

impl Series {
    fn key(&self) -> Key {
        Key {
            name: self.name.clone(),
            color: self.color,
            shape: match self.mark {
                Mark::Line => KeyShape::Line,
                Mark::Dashes => KeyShape::Dashes,
                Mark::Dots => KeyShape::Dot,
            },
        }
    }

    fn draw(&self, sheet: &Sheet, view: &View) -> Result<(), DrawError> {
        let pen = Pen::new(self.color, 2.5);
        for run in self
            .points
            .split(|point| !(point.0.is_finite() && point.1.is_finite()))
        {
            let places: Vec<Point> = run.iter().map(|&(x, y)| view.at(x, y)).collect();
            match self.mark {
                Mark::Line => sheet.polyline(&places, &view.rect, pen)?,
                Mark::Dashes => sheet.dashes(&places, &view.rect, pen, (10.0, 6.0))?,
                Mark::Dots => {
                    for &place in places.iter().filter(|place| view.rect.holds(**place)) {
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
            from_zero: true,
            clip_outliers: true,
            ..Panel::default()
        }
    }

    #[test]
    fn a_few_outliers_leave_the_panel_and_are_told_and_many_do_not() {
        let few = panel(
            (0..200)
                .map(|k| (f64::from(k), if k < 2 { 30.0 } else { 0.3 }))
                .collect(),
        );
        let (span, above) = few.y_span();
        assert!(span.max < 1.0);
        assert_eq!(above, Some(30.0));
        let many = panel(
            (0..200)
                .map(|k| (f64::from(k), if k < 50 { 30.0 } else { 0.3 }))
                .collect(),
        );
        let (span, above) = many.y_span();
        assert!(span.max > 30.0);
        assert_eq!(above, None);
    }

    #[test]
    fn a_chart_of_nothing_is_an_error_that_names_the_file() {
        let folder = tempfile::tempdir().unwrap();
        let chart = LineChart {
            panels: vec![panel(vec![(0.0, f64::NAN); 0])],
            ..LineChart::default()
        };
        let message = chart
            .save(&folder.path().join("errors.png"))
            .unwrap_err()
            .to_string();
        assert!(message.contains("errors.png"), "{message}");
    }

    #[test]
    fn a_constant_series_has_a_span() {
        let (span, _) = panel(vec![(0.0, 2.0), (1.0, 2.0)]).y_span();
        assert!(span.max > span.min);
        let (span, _) = panel(vec![(0.0, 0.0), (1.0, 0.0)]).y_span();
        assert!(span.max > span.min);
    }
}
