//! Where numbers lie on the sheet: axes with round ticks, equal scales, legends, colour bars.

use super::color::{Colormap, FRAME, GRID, INK, Rgb};
use super::error::DrawError;
use super::sheet::{HPos, LABEL, Lettering, Pen, Point, Rect, Sheet, TICK, VPos, text_width};

/// A range of numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Span {
    pub min: f64,
    pub max: f64,
}

impl Span {
    pub fn new(min: f64, max: f64) -> Self {
        Self { min, max }
    }

    /// The range of some numbers, those that are not finite left out; `None` of none.
    pub fn of(numbers: impl IntoIterator<Item = f64>) -> Option<Self> {
        let empty = Self::new(f64::INFINITY, f64::NEG_INFINITY);
        let span = numbers
            .into_iter()
            .filter(|number| number.is_finite())
            .fold(empty, |span, number| Self {
                min: span.min.min(number),
                max: span.max.max(number),
            });
        (span.min <= span.max).then_some(span)
    }

    pub fn length(&self) -> f64 {
        self.max - self.min
    }

    /// At least as long as `length`, about the same middle.
    pub fn at_least(self, length: f64) -> Self {
        let missing = 0.5 * (length - self.length()).max(0.0);
        Self::new(self.min - missing, self.max + missing)
    }

    pub fn padded(self, margin: f64) -> Self {
        Self::new(self.min - margin, self.max + margin)
    }
}

/// Numbers on a rectangle of the sheet, y up.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    pub rect: Rect,
    pub x: Span,
    pub y: Span,
}

impl View {
    /// Equal scales on both axes: the shorter range is made longer.
    pub fn equal(rect: Rect, x: Span, y: Span) -> Self {
        let scale = (x.length() / rect.width()).max(y.length() / rect.height());
        Self {
            rect,
            x: x.at_least(scale * rect.width()),
            y: y.at_least(scale * rect.height()),
        }
    }

    /// Where a pair of numbers lies.
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

    /// Thin lines at the ticks.
    pub fn grid(&self, sheet: &Sheet) -> Result<(), DrawError> {
        let pen = Pen::new(GRID, 1.0);
        for x in self.x_ticks().places {
            let (column, _) = self.at(x, self.y.min);
            sheet.line((column, self.rect.top), (column, self.rect.bottom), pen)?;
        }
        for y in self.y_ticks().places {
            let (_, row) = self.at(self.x.min, y);
            sheet.line((self.rect.left, row), (self.rect.right, row), pen)?;
        }
        Ok(())
    }

    /// Ticks, frame and names of the axes, without a grid.
    pub fn frame(&self, sheet: &Sheet, x_name: &str, y_name: &str) -> Result<(), DrawError> {
        self.frame_with(sheet, &self.x_ticks(), x_name, y_name)
    }

    /// The same around a panorama whose x runs from +180 to −180 degrees.
    pub fn panorama_frame(
        &self,
        sheet: &Sheet,
        x_name: &str,
        y_name: &str,
    ) -> Result<(), DrawError> {
        let ticks = Ticks {
            places: (-3..=3).map(|k| 60.0 * f64::from(k)).collect(),
            step: 60.0,
        };
        self.frame_with(sheet, &ticks, x_name, y_name)
    }

    fn frame_with(
        &self,
        sheet: &Sheet,
        x_ticks: &Ticks,
        x_name: &str,
        y_name: &str,
    ) -> Result<(), DrawError> {
        let Rect {
            left,
            right,
            top,
            bottom,
        } = self.rect;
        let pen = Pen::new(FRAME, 1.0);
        sheet.outline(&self.rect, pen)?;
        let below = Lettering::new(TICK, HPos::Center, VPos::Top);
        for (x, text) in x_ticks.labelled() {
            let (column, _) = self.at(x, self.y.min);
            sheet.line((column, bottom), (column, bottom + 5.0), pen)?;
            sheet.text(&text, (column, bottom + 9.0), below)?;
        }
        let beside = Lettering::new(TICK, HPos::Right, VPos::Center);
        for (y, text) in self.y_ticks().labelled() {
            let (_, row) = self.at(self.x.min, y);
            sheet.line((left - 5.0, row), (left, row), pen)?;
            sheet.text(&text, (left - 9.0, row), beside)?;
        }
        let name = Lettering::new(LABEL, HPos::Center, VPos::Center);
        let middle = (0.5 * (left + right), bottom + 46.0);
        sheet.text(x_name, middle, name)?;
        let middle = (left - 78.0, 0.5 * (top + bottom));
        sheet.text(y_name, middle, name.upwards())
    }

    fn x_ticks(&self) -> Ticks {
        Ticks::of(self.x, self.rect.width() / 110.0)
    }

    fn y_ticks(&self) -> Ticks {
        // On a map both axes have ticks at the same distance.
        let y_scale = self.rect.height() / self.y.length();
        if (self.scale() / y_scale - 1.0).abs() < 1e-6 {
            return Ticks::every(self.x_ticks().step, self.y);
        }
        Ticks::of(self.y, self.rect.height() / 60.0)
    }

    /// A bar of a round length over the upper right corner, outside the data, for maps.
    pub fn scale_bar(&self, sheet: &Sheet) -> Result<(), DrawError> {
        let length = round_step(0.12 * self.x.length());
        let (right, row) = (self.rect.right, self.rect.top - 26.0);
        let left = right - length * self.scale();
        let pen = Pen::new(INK, 3.0);
        sheet.line((left, row), (right, row), pen)?;
        for end in [left, right] {
            sheet.line((end, row - 6.0), (end, row + 6.0), Pen::new(INK, 2.0))?;
        }
        let beside = Lettering::new(TICK, HPos::Right, VPos::Center);
        sheet.text(&format!("{length} m"), (left - 10.0, row), beside)
    }
}

/// Round numbers along an axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Ticks {
    pub places: Vec<f64>,
    step: f64,
}

impl Ticks {
    /// About `count` of them, at least two.
    pub fn of(span: Span, count: f64) -> Self {
        Self::every(round_step(span.length() / count.max(2.0)), span)
    }

    /// At the multiples of a step.
    fn every(step: f64, span: Span) -> Self {
        let first = (span.min / step - 1e-6).ceil() as i64;
        let last = (span.max / step + 1e-6).floor() as i64;
        Self {
            // At most a hundred, whatever the numbers.
            places: (first..=last).take(100).map(|k| k as f64 * step).collect(),
            step,
        }
    }

    /// Places with their labels.
    pub fn labelled(&self) -> impl Iterator<Item = (f64, String)> {
        let decimals = (-self.step.log10().floor()).clamp(0.0, 9.0) as usize;
        self.places.iter().map(move |&place| {
            // Not "-0".
            let place = place + 0.0;
            (place, format!("{place:.decimals$}"))
        })
    }
}

/// The largest of 1, 2, 5 times a power of ten that is not above a length by more than half.
fn round_step(length: f64) -> f64 {
    let length = if length.is_finite() && length > 0.0 {
        length
    } else {
        1.0
    };
    let power = 10.0_f64.powi(length.log10().floor() as i32);
    let digit = length / power;
    let round = if digit < 1.5 {
        1.0
    } else if digit < 3.5 {
        2.0
    } else if digit < 7.5 {
        5.0
    } else {
        10.0
    };
    // 0.3 rather than 3 × 0.1.
    if power < 1.0 {
        round / (1.0 / power).round()
    } else {
        round * power
    }
}

/// What stands in a legend.
#[derive(Clone, Debug, PartialEq)]
pub struct Key {
    pub name: String,
    pub color: Rgb,
    pub shape: KeyShape,
}

/// How an entry of a legend is marked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KeyShape {
    Line,
    Dashes,
    Dot,
    Square,
}

/// A legend in one line, from a point to the right; entries that do not fit wrap to the next line.
pub fn legend(sheet: &Sheet, keys: &[Key], at: Point, right: f64) -> Result<(), DrawError> {
    const LINE: f64 = 28.0;
    let lettering = Lettering::new(TICK + 1.0, HPos::Left, VPos::Center);
    let (mut x, mut y) = at;
    for key in keys {
        let width = 46.0 + text_width(&key.name, lettering);
        if x + width > right && x > at.0 {
            (x, y) = (at.0, y + LINE);
        }
        draw_key(sheet, key, (x, y))?;
        sheet.text(&key.name, (x + 42.0, y), lettering)?;
        x += width + 24.0;
    }
    Ok(())
}

fn draw_key(sheet: &Sheet, key: &Key, (x, y): Point) -> Result<(), DrawError> {
    let pen = Pen::new(key.color, 5.0);
    let swatch = Rect {
        left: x + 10.0,
        top: y - 8.0,
        right: x + 26.0,
        bottom: y + 8.0,
    };
    match key.shape {
        KeyShape::Line => sheet.line((x, y), (x + 34.0, y), pen),
        KeyShape::Dashes => {
            sheet.line((x, y), (x + 13.0, y), pen)?;
            sheet.line((x + 21.0, y), (x + 34.0, y), pen)
        }
        KeyShape::Dot => sheet.dot((x + 18.0, y), 6.0, key.color, 1.0),
        KeyShape::Square => {
            sheet.fill(&swatch, key.color)?;
            sheet.outline(&swatch, Pen::new(FRAME, 1.0))
        }
    }
}

/// An upright bar of colours with its numbers to the right and its name beside them.
pub fn color_bar(
    sheet: &Sheet,
    rect: Rect,
    span: Span,
    colormap: Colormap,
    name: &str,
) -> Result<(), DrawError> {
    sheet.pixels(&rect, |_, y| Some(colormap.at(1.0 - y)))?;
    let pen = Pen::new(FRAME, 1.0);
    sheet.outline(&rect, pen)?;
    let view = View {
        rect,
        x: Span::new(0.0, 1.0),
        y: span,
    };
    let beside = Lettering::new(TICK, HPos::Left, VPos::Center);
    let mut widest = 0.0_f64;
    for (y, text) in Ticks::of(span, (rect.height() / 50.0).min(10.0)).labelled() {
        let (_, row) = view.at(0.0, y);
        sheet.line((rect.right, row), (rect.right + 5.0, row), pen)?;
        sheet.text(&text, (rect.right + 9.0, row), beside)?;
        widest = widest.max(text_width(&text, beside));
    }
    let lettering = Lettering::new(TICK + 1.0, HPos::Center, VPos::Center);
    let middle = (rect.right + widest + 28.0, 0.5 * (rect.top + rect.bottom));
    sheet.text(name, middle, lettering.upwards())
}

/// The title of a picture.
pub fn title(sheet: &Sheet, text: &str, left: f64) -> Result<(), DrawError> {
    let lettering = Lettering::new(super::sheet::TITLE, HPos::Left, VPos::Center);
    sheet.text(text, (left, 30.0), lettering.bold())
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
            let view = View::equal(rect, Span::new(0.0, x), Span::new(-y, 0.0));
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
            let span = Span::new(min, max).at_least(1e-3);
            let ticks = Ticks::of(span, 6.0);
            assert!((2..=14).contains(&ticks.places.len()), "{span:?} {ticks:?}");
            for (place, text) in ticks.labelled() {
                assert!(place >= span.min - 1e-9 && place <= span.max + 1e-9);
                assert_relative_eq!(text.parse::<f64>().unwrap(), place, epsilon = 1e-9);
            }
        }
    }

    #[test]
    fn the_span_of_numbers_leaves_out_what_is_not_finite() {
        let span = Span::of([1.0, f64::NAN, -2.0, f64::INFINITY]);
        assert_eq!(span, Some(Span::new(-2.0, 1.0)));
        assert_eq!(Span::of([f64::NAN]), None);
    }
}
