//! Drawing surface: lines, text and pixels in a bitmap of twice the size, which is scaled down so
//! that all edges are smooth.

use std::path::Path;
use std::sync::Once;

use anyhow::{Context as _, Result};
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
use crate::app::run::output;

/// Ratio of the size of the bitmap while drawing to its final size.
const SCALE: u32 = 2;

/// Sizes of text [px].
const TITLE: f64 = 25.0;
pub const LABEL: f64 = 20.0;
pub const TICK: f64 = 17.0;

/// Point on the sheet [px], y down.
pub type Point = (f64, f64);

/// Rectangle on the sheet [px], y down.
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

    pub fn contains(&self, (x, y): Point) -> bool {
        (self.left..=self.right).contains(&x) && (self.top..=self.bottom).contains(&y)
    }
}

/// Drawing surface; all lengths are in pixels of the final picture.
pub struct Sheet<'a> {
    root: DrawingArea<BitMapBackend<'a>, Shift>,
}

/// Draws on a white sheet of a size [px].
pub fn draw(
    (width, height): (u32, u32),
    content: impl FnOnce(&Sheet) -> Result<()>,
) -> Result<Bitmap> {
    let size = (width * SCALE, height * SCALE);
    let mut large = Bitmap::from_fn(size.0, size.1, |_, _| WHITE);
    let pixels = large.pixels.as_flattened_mut();
    let sheet = Sheet {
        root: BitMapBackend::with_buffer(pixels, size).into_drawing_area(),
    };
    content(&sheet)?;
    sheet.root.present()?;
    drop(sheet);
    Ok(large.resized(width, height))
}

/// Writes a picture as PNG; errors of drawing and of writing name the file.
pub fn save_png(path: &Path, picture: Result<Bitmap>) -> Result<()> {
    let picture = picture.with_context(|| format!("cannot draw {}", path.display()))?;
    output::write_file(path, |file| picture.write_png(file))
}

impl Sheet<'_> {
    /// Draws a line through points, clipped to a rectangle.
    pub fn polyline(&self, points: &[Point], clip: &Rect, stroke: ShapeStyle) -> Result<()> {
        for pair in points.windows(2) {
            if let Some((from, to)) = clipped(pair[0], pair[1], clip) {
                self.line(from, to, stroke)?;
                // A round joint, no wider than the line itself.
                let radius = (stroke.stroke_width as i32 - 1) / 2;
                let joint = Circle::new(scaled_point(to), radius, stroke.filled());
                self.root.draw(&joint)?;
            }
        }
        Ok(())
    }

    /// Draws a dashed line through points, clipped to a rectangle, with a gap where one is not finite; `on` and `off` are the
    /// lengths of dashes and gaps.
    pub fn dashes(
        &self,
        points: &[Point],
        clip: &Rect,
        stroke: ShapeStyle,
        (on, off): (f64, f64),
    ) -> Result<()> {
        let mut along = 0.0;
        for pair in points.windows(2) {
            let (from, to) = (pair[0], pair[1]);
            let length = f64::hypot(to.0 - from.0, to.1 - from.1);
            if !length.is_finite() {
                continue;
            }
            let at = |distance: f64| {
                let share = distance / length.max(1e-9);
                (
                    from.0 + share * (to.0 - from.0),
                    from.1 + share * (to.1 - from.1),
                )
            };
            let mut start = 0.0;
            while start < length {
                let phase = (along + start) % (on + off);
                let is_dash = phase < on;
                let rest = if is_dash { on } else { on + off } - phase;
                let end = (start + rest).min(length).max(start + 1e-3);
                if is_dash && let Some((from, to)) = clipped(at(start), at(end), clip) {
                    self.line(from, to, stroke)?;
                }
                start = end;
            }
            along += length;
        }
        Ok(())
    }

    /// Draws a straight line.
    pub fn line(&self, from: Point, to: Point, stroke: ShapeStyle) -> Result<()> {
        let ends = vec![scaled_point(from), scaled_point(to)];
        Ok(self.root.draw(&PathElement::new(ends, stroke))?)
    }

    /// Fills a circle; `alpha` is the opacity, 0 to 1.
    pub fn dot(&self, center: Point, radius: f64, color: Rgb, alpha: f64) -> Result<()> {
        let style = rgb(color).mix(alpha).filled();
        let circle = Circle::new(scaled_point(center), scaled(radius), style);
        Ok(self.root.draw(&circle)?)
    }

    /// Fills a polygon.
    pub fn polygon(&self, corners: &[Point], color: Rgb) -> Result<()> {
        let corners: Vec<(i32, i32)> = corners.iter().map(|&corner| scaled_point(corner)).collect();
        let polygon = Polygon::new(corners, rgb(color).filled());
        Ok(self.root.draw(&polygon)?)
    }

    /// Fills a rectangle.
    pub fn fill(&self, rect: &Rect, color: Rgb) -> Result<()> {
        let corners = [(rect.left, rect.top), (rect.right, rect.bottom)];
        let rectangle = Rectangle::new(corners.map(scaled_point), rgb(color).filled());
        Ok(self.root.draw(&rectangle)?)
    }

    /// Draws the border of a rectangle.
    pub fn outline(&self, rect: &Rect, stroke: ShapeStyle) -> Result<()> {
        let corners = [
            (rect.left, rect.top),
            (rect.right, rect.top),
            (rect.right, rect.bottom),
            (rect.left, rect.bottom),
        ];
        (0..4).try_for_each(|side| self.line(corners[side], corners[(side + 1) % 4], stroke))
    }

    /// Sets the pixels of a rectangle: `color` maps shares of its width and height, from the left
    /// and from the top, to a color; `None` leaves the pixel unchanged.
    pub fn pixels(&self, rect: &Rect, color: impl Fn(f64, f64) -> Option<Rgb>) -> Result<()> {
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

    /// Draws text at a point.
    pub fn text(&self, text: &str, at: Point, style: &TextStyle) -> Result<()> {
        // The library centers the box of a line, in whose upper part the letters are.
        let down = match (&style.pos.v_pos, style.font.get_transform()) {
            (VPos::Center, FontTransform::None) => 0.14 * style.font.get_size() / f64::from(SCALE),
            _ => 0.0,
        };
        let place = scaled_point((at.0, at.1 + down));
        Ok(self.root.draw(&Text::new(text, place, style.clone()))?)
    }

    /// Draws the title of a picture.
    pub fn title(&self, text: &str, left: f64) -> Result<()> {
        let style = bold(text_style(TITLE, HPos::Left, VPos::Center));
        self.text(text, (left, 30.0), &style)
    }
}

/// Stroke of a width [px].
pub fn stroke(color: Rgb, width: f64) -> ShapeStyle {
    let width = scaled(width).max(1) as u32;
    rgb(color).stroke_width(width)
}

/// Text of a size [px] that is anchored at its given point.
pub fn text_style(size: f64, horizontal: HPos, vertical: VPos) -> TextStyle<'static> {
    register_fonts();
    let size = size * f64::from(SCALE);
    let font = FontDesc::new(FontFamily::SansSerif, size, FontStyle::Normal);
    let anchor = Pos::new(horizontal, vertical);
    font.color(&rgb(INK)).pos(anchor)
}

/// The style in bold.
pub fn bold(style: TextStyle<'static>) -> TextStyle<'static> {
    // `FontDesc::style` would keep the regular font.
    let size = style.font.get_size();
    TextStyle {
        font: FontDesc::new(FontFamily::SansSerif, size, FontStyle::Bold),
        ..style
    }
}

/// The style, rotated to read from bottom to top.
pub fn upwards(style: &TextStyle<'static>) -> TextStyle<'static> {
    style.transform(FontTransform::Rotate270)
}

/// Width of text [px].
pub fn text_width(text: &str, style: &TextStyle) -> f64 {
    let width = style.font.box_size(text).map_or(0, |(width, _)| width);
    f64::from(width) / f64::from(SCALE)
}

/// Registers DejaVu Sans under the family that all text uses; fonts of the system are not used.
fn register_fonts() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| {
        let name = FontFamily::SansSerif.as_str();
        // Both fonts are compiled in and known to be valid; without them, drawing text is an error.
        let _ = register_font(name, FontStyle::Normal, dejavu::sans::regular());
        let _ = register_font(name, FontStyle::Bold, dejavu::sans::bold());
    });
}

/// The part of a line inside a rectangle (Liang and Barsky 1984); `None` if it is outside.
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
    fn a_line_is_drawn_only_inside_its_clip_and_in_its_color() {
        let image = draw((100, 100), |sheet| {
            let ends = [(-500.0, 50.0), (500.0, 50.0)];
            sheet.polyline(&ends, &SQUARE, stroke([200, 0, 0], 4.0))
        })
        .unwrap();
        assert_eq!(image.pixel(50, 50), [200, 0, 0]);
        assert_eq!(image.pixel(5, 50), WHITE);
        assert_eq!(image.pixel(95, 50), WHITE);
        assert_eq!(image.pixel(50, 60), WHITE);
    }

    #[test]
    fn a_line_outside_the_clip_is_not_drawn() {
        assert_eq!(clipped((0.0, 0.0), (5.0, 100.0), &SQUARE), None);
        assert_eq!(clipped((0.0, 15.0), (15.0, 0.0), &SQUARE), None);
        assert!(clipped((0.0, 25.0), (25.0, 0.0), &SQUARE).is_some());
        assert_eq!(clipped((20.0, 20.0), (f64::NAN, 30.0), &SQUARE), None);
    }

    #[test]
    fn text_is_drawn_without_any_font_of_the_system() {
        let style = text_style(LABEL, HPos::Left, VPos::Top);
        let image = draw((200, 40), |sheet| {
            sheet.text("error [m]", (5.0, 5.0), &style)
        })
        .unwrap();
        let dark = image.pixels.iter().filter(|pixel| pixel[0] < 120).count();
        assert!(dark > 100, "{dark}");
        assert!(text_width("error [m]", &style) > text_width("[m]", &style));
        let bold = bold(style.clone());
        assert!(text_width("error [m]", &bold) > text_width("error [m]", &style));
    }
}
