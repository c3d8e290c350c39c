//! A sheet of paper: lines, text and pixels in a bitmap that is drawn twice as large and shrunk,
//! which smooths every edge.

use std::path::Path;
use std::sync::Once;

use plotters::backend::BitMapBackend;
use plotters::coord::Shift;
use plotters::drawing::{DrawingArea, IntoDrawingArea as _};
use plotters::element::{Circle, PathElement, Polygon, Rectangle, Text};
use plotters::style::text_anchor::Pos;
use plotters::style::{
    Color as _, FontDesc, FontFamily, FontStyle, FontTransform, RGBColor, ShapeStyle, TextStyle,
    register_font,
};

pub use plotters::style::text_anchor::{HPos, VPos};

use super::bitmap::Bitmap;
use super::color::{INK, Rgb, WHITE};
use super::error::{DrawError, PlotError};
use crate::app::output::write_atomically;

/// How much larger the bitmap is drawn than it is saved.
pub const SCALE: u32 = 2;

/// Sizes of text [px].
pub const TITLE: f64 = 25.0;
pub const LABEL: f64 = 20.0;
pub const TICK: f64 = 17.0;

/// A rectangle on the sheet [px], y down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rect {
    pub left: f64,
    pub top: f64,
    pub right: f64,
    pub bottom: f64,
}

impl Rect {
    pub fn width(&self) -> f64 {
        self.right - self.left
    }

    pub fn height(&self) -> f64 {
        self.bottom - self.top
    }

    pub fn holds(&self, (x, y): Point) -> bool {
        (self.left..=self.right).contains(&x) && (self.top..=self.bottom).contains(&y)
    }
}

/// A point on the sheet [px], y down.
pub type Point = (f64, f64);

/// What is drawn on; all lengths in pixels of the saved picture.
pub struct Sheet<'a> {
    root: DrawingArea<BitMapBackend<'a>, Shift>,
}

/// How a stroke looks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pen {
    pub color: Rgb,
    pub width: f64,
    pub alpha: f64,
}

impl Pen {
    pub fn new(color: Rgb, width: f64) -> Self {
        Self {
            color,
            width,
            alpha: 1.0,
        }
    }

    pub fn alpha(self, alpha: f64) -> Self {
        Self { alpha, ..self }
    }

    fn style(self, filled: bool) -> ShapeStyle {
        ShapeStyle {
            color: rgb(self.color).mix(self.alpha),
            filled,
            stroke_width: scaled(self.width).max(1) as u32,
        }
    }
}

/// How text looks and which point of it is given.
#[derive(Clone, Copy)]
pub struct Lettering {
    pub size: f64,
    pub color: Rgb,
    pub bold: bool,
    pub horizontal: HPos,
    pub vertical: VPos,
    pub upwards: bool,
}

impl Lettering {
    pub fn new(size: f64, horizontal: HPos, vertical: VPos) -> Self {
        Self {
            size,
            color: INK,
            bold: false,
            horizontal,
            vertical,
            upwards: false,
        }
    }

    pub fn bold(self) -> Self {
        Self { bold: true, ..self }
    }

    pub fn upwards(self) -> Self {
        Self {
            upwards: true,
            ..self
        }
    }

    pub fn color(self, color: Rgb) -> Self {
        Self { color, ..self }
    }

    fn font(&self) -> FontDesc<'static> {
        register_fonts();
        let style = if self.bold {
            FontStyle::Bold
        } else {
            FontStyle::Normal
        };
        let size = self.size * f64::from(SCALE);
        FontDesc::new(FontFamily::SansSerif, size, style)
    }
}

/// Draws a picture of a size in pixels on white.
pub fn draw(
    (width, height): (u32, u32),
    picture: impl FnOnce(&Sheet) -> Result<(), DrawError>,
) -> Result<Bitmap, DrawError> {
    let size = (width * SCALE, height * SCALE);
    let mut large = Bitmap::from_fn(size.0, size.1, |_, _| WHITE);
    let sheet = Sheet {
        root: BitMapBackend::with_buffer(large.pixels.as_flattened_mut(), size).into_drawing_area(),
    };
    picture(&sheet)?;
    sheet.root.present()?;
    drop(sheet);
    Ok(large.resized(width, height))
}

/// Draws a picture and writes it as PNG.
pub fn save(
    path: &Path,
    size: (u32, u32),
    picture: impl FnOnce(&Sheet) -> Result<(), DrawError>,
) -> Result<(), PlotError> {
    let image = draw(size, picture).map_err(PlotError::draw(path))?;
    write_atomically(path, |file| image.write_png(file)).map_err(|source| PlotError::Write {
        path: path.to_owned(),
        source,
    })
}

impl Sheet<'_> {
    /// A line through points, each piece of which is cut off at the border of `clip`.
    pub fn polyline(&self, points: &[Point], clip: &Rect, pen: Pen) -> Result<(), DrawError> {
        for pair in points.windows(2) {
            if let Some((from, to)) = clipped(pair[0], pair[1], clip) {
                self.line(from, to, pen)?;
                // A round joint, no wider than the line itself.
                let style = pen.style(true);
                let radius = (scaled(pen.width) - 1) / 2;
                self.root
                    .draw(&Circle::new(scaled_point(to), radius, style))?;
            }
        }
        Ok(())
    }

    /// The same with gaps: drawn and left out in turn, lengths in pixels.
    pub fn dashes(
        &self,
        points: &[Point],
        clip: &Rect,
        pen: Pen,
        (on, off): (f64, f64),
    ) -> Result<(), DrawError> {
        let mut along = 0.0;
        for pair in points.windows(2) {
            let (from, to) = (pair[0], pair[1]);
            let length = f64::hypot(to.0 - from.0, to.1 - from.1);
            let at = |way: f64| {
                let share = way / length.max(1e-9);
                (
                    from.0 + share * (to.0 - from.0),
                    from.1 + share * (to.1 - from.1),
                )
            };
            let mut begin = 0.0;
            while begin < length {
                let phase = (along + begin) % (on + off);
                let end = if phase < on {
                    begin + on - phase
                } else {
                    begin + on + off - phase
                };
                let end = end.min(length).max(begin + 1e-3);
                if phase < on
                    && let Some((from, to)) = clipped(at(begin), at(end), clip)
                {
                    self.line(from, to, pen)?;
                }
                begin = end;
            }
            along += length;
        }
        Ok(())
    }

    /// A straight line.
    pub fn line(&self, from: Point, to: Point, pen: Pen) -> Result<(), DrawError> {
        let ends = vec![scaled_point(from), scaled_point(to)];
        self.root.draw(&PathElement::new(ends, pen.style(false)))
    }

    /// A filled circle.
    pub fn dot(&self, center: Point, radius: f64, color: Rgb, alpha: f64) -> Result<(), DrawError> {
        let style = Pen::new(color, 1.0).alpha(alpha).style(true);
        self.root
            .draw(&Circle::new(scaled_point(center), scaled(radius), style))
    }

    /// A filled polygon.
    pub fn polygon(&self, corners: &[Point], color: Rgb) -> Result<(), DrawError> {
        let corners: Vec<(i32, i32)> = corners.iter().map(|&corner| scaled_point(corner)).collect();
        self.root.draw(&Polygon::new(corners, rgb(color).filled()))
    }

    /// A filled rectangle.
    pub fn fill(&self, rect: &Rect, color: Rgb) -> Result<(), DrawError> {
        self.rectangle(rect, Pen::new(color, 1.0).style(true))
    }

    /// The border of a rectangle.
    pub fn outline(&self, rect: &Rect, pen: Pen) -> Result<(), DrawError> {
        let Rect {
            left,
            top,
            right,
            bottom,
        } = *rect;
        let corners = [
            (left, top),
            (right, top),
            (right, bottom),
            (left, bottom),
            (left, top),
        ];
        corners
            .windows(2)
            .try_for_each(|side| self.line(side[0], side[1], pen))
    }

    fn rectangle(&self, rect: &Rect, style: ShapeStyle) -> Result<(), DrawError> {
        let corners = [
            scaled_point((rect.left, rect.top)),
            scaled_point((rect.right, rect.bottom)),
        ];
        self.root.draw(&Rectangle::new(corners, style))
    }

    /// Pixels of a rectangle: `color` is asked with shares of its width and height, from the
    /// left and from the top; `None` leaves what is there.
    pub fn pixels(
        &self,
        rect: &Rect,
        color: impl Fn(f64, f64) -> Option<Rgb>,
    ) -> Result<(), DrawError> {
        let (left, top) = scaled_point((rect.left, rect.top));
        let (right, bottom) = scaled_point((rect.right, rect.bottom));
        for row in top..bottom {
            let y = (f64::from(row - top) + 0.5) / f64::from(bottom - top);
            for column in left..right {
                let x = (f64::from(column - left) + 0.5) / f64::from(right - left);
                if let Some(color) = color(x, y) {
                    self.root.draw_pixel((column, row), &rgb(color))?;
                }
            }
        }
        Ok(())
    }

    /// Text at a point.
    pub fn text(&self, text: &str, at: Point, lettering: Lettering) -> Result<(), DrawError> {
        let transform = if lettering.upwards {
            FontTransform::Rotate270
        } else {
            FontTransform::None
        };
        let color = rgb(lettering.color);
        let style = TextStyle::from(lettering.font().transform(transform))
            .color(&color)
            .pos(Pos::new(lettering.horizontal, lettering.vertical));
        // The library centres the box of a line, in which letters sit high.
        let down = match (lettering.vertical, lettering.upwards) {
            (VPos::Center, false) => 0.14 * lettering.size,
            _ => 0.0,
        };
        let place = scaled_point((at.0, at.1 + down));
        self.root.draw(&Text::new(text.to_owned(), place, style))
    }
}

/// Width of text [px].
pub fn text_width(text: &str, lettering: Lettering) -> f64 {
    let width = lettering
        .font()
        .box_size(text)
        .map_or(0, |(width, _)| width);
    f64::from(width) / f64::from(SCALE)
}

/// DejaVu Sans under the name that all text uses; there is no font of the system.
fn register_fonts() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let name = FontFamily::SansSerif.as_str();
        // Both fonts are compiled in and known to be fonts; without them text has no shape, and
        // drawing it is an error.
        let _ = register_font(name, FontStyle::Normal, dejavu::sans::regular());
        let _ = register_font(name, FontStyle::Bold, dejavu::sans::bold());
    });
}

/// The part of a line inside a rectangle (Liang and Barsky 1984); `None` where it is outside.
fn clipped(from: Point, to: Point, rect: &Rect) -> Option<(Point, Point)> {
    let (dx, dy) = (to.0 - from.0, to.1 - from.1);
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    for (step, room) in [
        (-dx, from.0 - rect.left),
        (dx, rect.right - from.0),
        (-dy, from.1 - rect.top),
        (dy, rect.bottom - from.1),
    ] {
        if step == 0.0 {
            if room < 0.0 {
                return None;
            }
        } else if step < 0.0 {
            enter = enter.max(room / step);
        } else {
            leave = leave.min(room / step);
        }
    }
    let at = |share: f64| (from.0 + share * dx, from.1 + share * dy);
    (enter <= leave && (dx + dy).is_finite()).then(|| (at(enter), at(leave)))
}

fn rgb([red, green, blue]: Rgb) -> RGBColor {
    RGBColor(red, green, blue)
}

fn scaled(length: f64) -> i32 {
    (length * f64::from(SCALE)).round() as i32
}

fn scaled_point((x, y): Point) -> (i32, i32) {
    (scaled(x), scaled(y))
}

#[cfg(test)]
mod tests {
    use super::*;

    const SQUARE: Rect = Rect {
        left: 10.0,
        top: 10.0,
        right: 90.0,
        bottom: 90.0,
    };

    #[test]
    fn a_line_is_drawn_inside_its_clip_only_and_in_its_colour() {
        let pen = Pen::new([200, 0, 0], 4.0);
        let image = draw((100, 100), |sheet| {
            sheet.polyline(&[(-500.0, 50.0), (500.0, 50.0)], &SQUARE, pen)
        })
        .unwrap();
        assert_eq!(image.pixel(50, 50), [200, 0, 0]);
        assert_eq!(image.pixel(5, 50), WHITE);
        assert_eq!(image.pixel(95, 50), WHITE);
        assert_eq!(image.pixel(50, 60), WHITE);
    }

    #[test]
    fn a_line_beside_the_clip_is_not_drawn() {
        assert_eq!(clipped((0.0, 0.0), (5.0, 100.0), &SQUARE), None);
        assert_eq!(clipped((0.0, 15.0), (15.0, 0.0), &SQUARE), None);
        assert!(clipped((0.0, 25.0), (25.0, 0.0), &SQUARE).is_some());
        assert_eq!(clipped((20.0, 20.0), (f64::NAN, 30.0), &SQUARE), None);
    }

    #[test]
    fn text_has_shape_without_any_font_of_the_system() {
        let lettering = Lettering::new(LABEL, HPos::Left, VPos::Top);
        let image = draw((200, 40), |sheet| {
            sheet.text("error [m]", (5.0, 5.0), lettering)
        })
        .unwrap();
        let dark = image.pixels.iter().filter(|pixel| pixel[0] < 120).count();
        assert!(dark > 100, "{dark}");
        assert!(text_width("error [m]", lettering) > text_width("[m]", lettering));
    }
}
