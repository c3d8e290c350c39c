//! Mapping of numbers to the sheet: axes with round ticks, equal scales, legends, color bars.

use anyhow::Result;

use super::bitmap::Bitmap;
use super::color::{Colormap, FRAME, GRID, INK, Rgb};
use super::sheet::{
    self, HPos, LABEL, Point, Rect, Sheet, TICK, VPos, stroke, text_style, text_width, upwards,
};
use crate::geometry::Pose2;

/// Range of numbers along an axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AxisRange {
    pub min: f64,
    pub max: f64,
}

impl AxisRange {
    pub fn new(min: f64, max: f64) -> Self {
        Self { min, max }
    }

    /// Range of the finite numbers; `None` without any.
    pub fn of(numbers: impl IntoIterator<Item = f64>) -> Option<Self> {
        let empty = Self::new(f64::INFINITY, f64::NEG_INFINITY);
        let range = numbers
            .into_iter()
            .filter(|number| number.is_finite())
            .fold(empty, |range, number| {
                Self::new(range.min.min(number), range.max.max(number))
            });
        (range.min <= range.max).then_some(range)
    }

    pub fn length(&self) -> f64 {
        self.max - self.min
    }

    /// Extends the range about its center to at least a length.
    pub fn at_least(self, length: f64) -> Self {
        self.padded(0.5 * (length - self.length()).max(0.0))
    }

    /// Extends the range by a margin on both sides.
    pub fn padded(self, margin: f64) -> Self {
        Self::new(self.min - margin, self.max + margin)
    }
}

/// Numbers on a rectangle of the sheet, y up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    pub rect: Rect,
    pub x: AxisRange,
    pub y: AxisRange,
}

impl View {
    /// View with equal scales on both axes: the shorter range is extended.
    pub fn equal(rect: Rect, x: AxisRange, y: AxisRange) -> Self {
        let scale = (x.length() / rect.width()).max(y.length() / rect.height());
        Self {
            rect,
            x: x.at_least(scale * rect.width()),
            y: y.at_least(scale * rect.height()),
        }
    }

    /// Point on the sheet of a pair of numbers.
    pub fn at(&self, x: f64, y: f64) -> Point {
        (
            self.rect.left + (x - self.x.min) / self.x.length() * self.rect.width(),
            self.rect.bottom - (y - self.y.min) / self.y.length() * self.rect.height(),
        )
    }

    /// Pixels per unit of x.
    pub fn scale(&self) -> f64 {
        self.rect.width() / self.x.length()
    }

    /// Draws thin lines at the ticks.
    pub fn grid(&self, sheet: &Sheet, x_ticks: &Ticks) -> Result<()> {
        let Rect { left, right, .. } = self.rect;
        for &x in &x_ticks.places {
            let (column, bottom) = self.at(x, self.y.min);
            sheet.line((column, self.rect.top), (column, bottom), stroke(GRID, 1.0))?;
        }
        for y in self.y_ticks().places {
            let (_, row) = self.at(self.x.min, y);
            sheet.line((left, row), (right, row), stroke(GRID, 1.0))?;
        }
        Ok(())
    }

    /// Draws the frame, the ticks and the names of the axes.
    pub fn frame(&self, sheet: &Sheet, x_ticks: &Ticks, names: [&str; 2]) -> Result<()> {
        let rect @ Rect { left, bottom, .. } = self.rect;
        let line = stroke(FRAME, 1.0);
        sheet.outline(&rect, line)?;
        let below = text_style(TICK, HPos::Center, VPos::Top);
        for (x, text) in x_ticks.labelled() {
            let (column, _) = self.at(x, self.y.min);
            sheet.line((column, bottom), (column, bottom + 5.0), line)?;
            sheet.text(&text, (column, bottom + 9.0), &below)?;
        }
        let style = text_style(TICK, HPos::Right, VPos::Center);
        for (y, text) in self.y_ticks().labelled() {
            let (_, row) = self.at(self.x.min, y);
            sheet.line((left - 5.0, row), (left, row), line)?;
            sheet.text(&text, (left - 9.0, row), &style)?;
        }
        let style = text_style(LABEL, HPos::Center, VPos::Center);
        let center = (0.5 * (left + rect.right), bottom + 46.0);
        sheet.text(names[0], center, &style)?;
        let center = (left - 78.0, 0.5 * (rect.top + bottom));
        sheet.text(names[1], center, &upwards(&style))
    }

    /// Ticks of the x axis.
    pub fn x_ticks(&self) -> Ticks {
        Ticks::of(self.x, self.rect.width() / 110.0)
    }

    /// Ticks of an x axis of whole numbers.
    pub fn whole_x_ticks(&self) -> Ticks {
        Ticks::every(self.x_ticks().step.max(1.0), self.x)
    }

    fn y_ticks(&self) -> Ticks {
        // On a map both axes have ticks at the same distance.
        let y_scale = self.rect.height() / self.y.length();
        if (self.scale() / y_scale - 1.0).abs() < 1e-6 {
            return Ticks::every(self.x_ticks().step, self.y);
        }
        Ticks::of(self.y, self.rect.height() / 60.0)
    }

    /// Draws a bar of a round length above the upper right corner, for maps.
    pub fn scale_bar(&self, sheet: &Sheet) -> Result<()> {
        let (right, row) = (self.rect.right, self.rect.top - 26.0);
        let length = round_step(0.12 * self.x.length());
        let left = right - length * self.scale();
        sheet.line((left, row), (right, row), stroke(INK, 3.0))?;
        for end in [left, right] {
            sheet.line((end, row - 6.0), (end, row + 6.0), stroke(INK, 2.0))?;
        }
        let style = text_style(TICK, HPos::Right, VPos::Center);
        sheet.text(&in_metres(length), (left - 10.0, row), &style)
    }
}

/// Round numbers along an axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Ticks {
    places: Vec<f64>,
    step: f64,
}

impl Ticks {
    /// About `count` ticks, at least two.
    fn of(range: AxisRange, count: f64) -> Self {
        Self::every(round_step(range.length() / count.max(2.0)), range)
    }

    /// Ticks at the multiples of a step.
    pub fn every(step: f64, range: AxisRange) -> Self {
        let first = (range.min / step - 1e-6).ceil() as i64;
        let last = (range.max / step + 1e-6).floor() as i64;
        Self {
            // At most a hundred, whatever the numbers.
            places: (first..=last).take(100).map(|k| k as f64 * step).collect(),
            step,
        }
    }

    /// Places with their labels.
    fn labelled(&self) -> impl Iterator<Item = (f64, String)> {
        let decimals = (-self.step.log10().floor()).clamp(0.0, 9.0) as usize;
        self.places.iter().map(move |&place| {
            // Not "-0".
            let place = place + 0.0;
            (place, format!("{place:.decimals$}"))
        })
    }
}

/// Rounds a length to 1, 2 or 5 times a power of ten.
fn round_step(length: f64) -> f64 {
    let length = if length.is_finite() && length > 0.0 {
        length
    } else {
        1.0
    };
    let power = 10.0_f64.powi(length.log10().floor() as i32);
    let round = match length / power {
        digit if digit < 1.5 => 1.0,
        digit if digit < 3.5 => 2.0,
        digit if digit < 7.5 => 5.0,
        _ => 10.0,
    };
    // 0.3 rather than 3 × 0.1.
    if power < 1.0 {
        round / (1.0 / power).round()
    } else {
        round * power
    }
}

/// A length with its unit: centimetres below a metre.
fn in_metres(length_m: f64) -> String {
    if length_m < 1.0 {
        format!("{} cm", (1e4 * length_m).round() / 100.0)
    } else {
        format!("{length_m} m")
    }
}

/// How data are drawn, and their key in the legend.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    /// Line through the points, with a gap where one is not finite.
    Line,
    /// Dashed line.
    Dashes,
    /// Dot per point.
    Dots,
    /// Area of a color; in legends only.
    Area,
}

/// Entry of a legend.
#[derive(Clone, Debug, PartialEq)]
pub struct LegendEntry {
    name: String,
    color: Rgb,
    mark: Mark,
}

impl LegendEntry {
    pub fn new(name: impl Into<String>, color: Rgb, mark: Mark) -> Self {
        Self {
            name: name.into(),
            color,
            mark,
        }
    }

    fn draw_key(&self, sheet: &Sheet, (x, y): Point) -> Result<()> {
        let line = |from, to| sheet.line((x + from, y), (x + to, y), stroke(self.color, 5.0));
        match self.mark {
            Mark::Line => line(0.0, 34.0),
            Mark::Dashes => line(0.0, 13.0).and_then(|()| line(21.0, 34.0)),
            Mark::Dots => sheet.dot((x + 18.0, y), 6.0, self.color, 1.0),
            Mark::Area => {
                let square = Rect {
                    left: x + 10.0,
                    top: y - 8.0,
                    right: x + 26.0,
                    bottom: y + 8.0,
                };
                sheet.fill(&square, self.color)?;
                sheet.outline(&square, stroke(FRAME, 1.0))
            }
        }
    }
}

/// Draws a legend from a point to the right; entries beyond `right` wrap to the next line.
pub fn legend(sheet: &Sheet, entries: &[LegendEntry], at: Point, right: f64) -> Result<()> {
    let style = text_style(TICK + 1.0, HPos::Left, VPos::Center);
    let (mut x, mut y) = at;
    for entry in entries {
        let width = 46.0 + text_width(&entry.name, &style);
        if x + width > right && x > at.0 {
            (x, y) = (at.0, y + 28.0);
        }
        entry.draw_key(sheet, (x, y))?;
        sheet.text(&entry.name, (x + 42.0, y), &style)?;
        x += width + 24.0;
    }
    Ok(())
}

/// Vertical bar of the colors of a range of numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColorBar<'a> {
    pub range: AxisRange,
    pub colormap: Colormap,
    /// Name of the quantity with its unit.
    pub name: &'a str,
}

impl ColorBar<'_> {
    /// Color of a number.
    pub fn color(&self, number: f64) -> Rgb {
        let share = (number - self.range.min) / self.range.length();
        self.colormap.at(share)
    }

    /// Draws the bar between two columns at the height of `neighbour`, with its numbers and its name
    /// to the right.
    pub fn draw(&self, sheet: &Sheet, neighbour: &Rect, [left, right]: [f64; 2]) -> Result<()> {
        let rect = Rect {
            left,
            right,
            ..*neighbour
        };
        sheet.pixels(&rect, |_, y| Some(self.colormap.at(1.0 - y)))?;
        let line = stroke(FRAME, 1.0);
        sheet.outline(&rect, line)?;
        let view = View {
            rect,
            x: AxisRange::new(0.0, 1.0),
            y: self.range,
        };
        let style = text_style(TICK, HPos::Left, VPos::Center);
        let mut widest = 0.0_f64;
        for (y, text) in Ticks::of(self.range, (rect.height() / 50.0).min(10.0)).labelled() {
            let (_, row) = view.at(0.0, y);
            sheet.line((right, row), (right + 5.0, row), line)?;
            sheet.text(&text, (right + 9.0, row), &style)?;
            widest = widest.max(text_width(&text, &style));
        }
        let style = text_style(TICK + 1.0, HPos::Center, VPos::Center);
        let center = (right + widest + 28.0, 0.5 * (rect.top + rect.bottom));
        sheet.text(self.name, center, &upwards(&style))
    }
}

/// Picture of the x-y plane without its content.
pub struct TopView<'a> {
    pub title: &'a str,
    pub legend: Vec<LegendEntry>,
    /// Visible range of x [m].
    pub x: AxisRange,
    /// Visible range of y [m].
    pub y: AxisRange,
    pub color_bar: Option<ColorBar<'a>>,
}

impl TopView<'_> {
    /// Draws the picture; `content` draws over the grid and below the frame.
    pub fn draw(&self, content: impl FnOnce(&Sheet, &View) -> Result<()>) -> Result<Bitmap> {
        /// Of the picture [px].
        const WIDTH: f64 = 1400.0;
        const LEFT: f64 = 118.0;
        // The legend is in a line of its own.
        let top = if self.legend.is_empty() { 66.0 } else { 96.0 };
        let margin = if self.color_bar.is_some() {
            150.0
        } else {
            30.0
        };
        let right = WIDTH - margin;
        let height =
            ((right - LEFT) * self.y.length() / self.x.length()).clamp(0.27 * WIDTH, 0.82 * WIDTH);
        let rect = Rect {
            left: LEFT,
            top,
            right,
            bottom: top + height.round(),
        };
        let view = View::equal(rect, self.x, self.y);
        sheet::draw((WIDTH as u32, (rect.bottom + 74.0) as u32), |sheet| {
            sheet.title(self.title, LEFT)?;
            legend(sheet, &self.legend, (LEFT, 70.0), right)?;
            view.grid(sheet, &view.x_ticks())?;
            content(sheet, &view)?;
            view.frame(sheet, &view.x_ticks(), ["x [m]", "y [m]"])?;
            view.scale_bar(sheet)?;
            match self.color_bar {
                Some(bar) => bar.draw(sheet, &rect, [right + 22.0, right + 48.0]),
                None => Ok(()),
            }
        })
    }
}

/// Points on the sheet of the positions of poses.
pub fn positions(poses: &[Pose2], view: &View) -> Vec<Point> {
    let positions = poses.iter().map(|pose| pose.translation);
    positions.map(|t| view.at(t.x, t.y)).collect()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn a_metre_is_as_long_up_as_it_is_wide() {
        let rect = Rect {
            left: 100.0,
            top: 50.0,
            right: 900.0,
            bottom: 350.0,
        };
        for (x, y) in [(30.0, 2.0), (5.0, 300.0), (1.0, 1.0)] {
            let view = View::equal(rect, AxisRange::new(0.0, x), AxisRange::new(-y, 0.0));
            let origin = view.at(0.0, 0.0);
            let (ahead, up) = (view.at(1.0, 0.0), view.at(0.0, 1.0));
            assert_relative_eq!(ahead.0 - origin.0, origin.1 - up.1, epsilon = 1e-9);
            assert!(view.x.length() >= x - 1e-9 && view.y.length() >= y - 1e-9);
        }
    }

    #[test]
    fn ticks_are_round_and_inside() {
        for (min, max) in [
            (0.0, 1.0),
            (-3.7, 11.2),
            (0.0, 0.013),
            (1e5, 1.3e5),
            (-7.0, -7.0),
        ] {
            let range = AxisRange::new(min, max).at_least(1e-3);
            let ticks = Ticks::of(range, 6.0);
            assert!(
                (2..=14).contains(&ticks.places.len()),
                "{range:?} {ticks:?}"
            );
            for (place, text) in ticks.labelled() {
                assert!(place >= range.min - 1e-9 && place <= range.max + 1e-9);
                assert_relative_eq!(text.parse::<f64>().unwrap(), place, epsilon = 1e-9);
            }
        }
    }

    #[test]
    fn ticks_of_whole_numbers_are_whole() {
        let rect = Rect {
            left: 0.0,
            top: 0.0,
            right: 1200.0,
            bottom: 300.0,
        };
        for (min, max) in [(0.5, 1.5), (0.5, 3.5), (0.0, 7.0), (-0.5, 1200.0)] {
            let x = AxisRange::new(min, max);
            let view = View { rect, x, y: x };
            let ticks = view.whole_x_ticks();
            assert!(!ticks.places.is_empty());
            for (place, text) in ticks.labelled() {
                assert_eq!(text.parse::<i64>().unwrap() as f64, place);
            }
        }
    }

    #[test]
    fn the_range_of_numbers_ignores_what_is_not_finite() {
        let range = AxisRange::of([1.0, f64::NAN, -2.0, f64::INFINITY]);
        assert_eq!(range, Some(AxisRange::new(-2.0, 1.0)));
        assert_eq!(AxisRange::of([f64::NAN]), None);
    }
}
