//! What the sensor saw, what the map shows from there, and the difference.

use std::path::Path;

use super::color::{Colormap, MISSING, Rgb};
use super::error::{DrawError, PlotError};
use super::sheet::{self, HPos, LABEL, Lettering, Rect, Sheet, VPos};
use super::view::{Key, KeyShape, Span, View, color_bar, legend, title};
use crate::lidar::LidarModel;

const WIDTH: f64 = 1400.0;
const LEFT: f64 = 118.0;
const RIGHT: f64 = 140.0;
const HEADER: f64 = 96.0;
const CAPTION: f64 = 32.0;
const IMAGE: f64 = 170.0;
const BETWEEN: f64 = 34.0;

/// Three range images one above the other: observed, rendered, observed − rendered.
#[derive(Clone, Copy, Debug)]
pub struct RangeImageStrip<'a> {
    /// Above everything.
    pub title: &'a str,
    /// The projection of both.
    pub model: &'a LidarModel,
    /// Ranges of the scan, row-major [m]; not finite or not positive where there is no return.
    pub observed: &'a [f32],
    /// Ranges of the map, likewise.
    pub rendered: &'a [f32],
    /// Differences beyond this have the colour of the end [m].
    pub difference_limit_m: f64,
}

impl RangeImageStrip<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<(), PlotError> {
        for (what, found) in [
            ("observed ranges", self.observed.len()),
            ("rendered ranges", self.rendered.len()),
        ] {
            if found != self.model.len() {
                return Err(PlotError::WrongLength {
                    path: path.to_owned(),
                    what,
                    found,
                    expected: self.model.len(),
                });
            }
        }
        if self.model.is_empty() {
            return Err(PlotError::Nothing {
                path: path.to_owned(),
                what: "the range images have no pixels",
            });
        }
        let height = HEADER + 3.0 * (CAPTION + IMAGE + BETWEEN) + 34.0;
        sheet::save(path, (WIDTH as u32, height as u32), |sheet| {
            self.draw(sheet)
        })
    }

    fn draw(&self, sheet: &Sheet) -> Result<(), DrawError> {
        title(sheet, self.title, LEFT)?;
        let missing = Key {
            name: "no return, or no surface in the map".to_owned(),
            color: MISSING,
            shape: KeyShape::Square,
        };
        legend(sheet, &[missing], (LEFT, 70.0), WIDTH - RIGHT)?;
        let ranges = Span::new(0.0, f64::from(self.model.max_range));
        let limit = self.difference_limit_m.abs().max(1e-3);
        let differences = Span::new(-limit, limit);
        let observed = |index: usize| range(self.observed[index]);
        let rendered = |index: usize| range(self.rendered[index]);
        let difference = |index: usize| observed(index) - rendered(index);
        let band = |number: f64| HEADER + number * (CAPTION + IMAGE + BETWEEN);
        let viridis = Colormap::Viridis;
        self.image(sheet, band(0.0), "observed", (ranges, viridis), observed)?;
        self.image(
            sheet,
            band(1.0),
            "rendered from the map",
            (ranges, viridis),
            rendered,
        )?;
        let scale = (differences, Colormap::Diverging);
        self.image(sheet, band(2.0), "observed − rendered", scale, difference)
    }

    /// One image with its caption, axes and colour bar.
    fn image(
        &self,
        sheet: &Sheet,
        top: f64,
        caption: &str,
        (span, colormap): (Span, Colormap),
        value_m: impl Fn(usize) -> f64,
    ) -> Result<(), DrawError> {
        let rect = Rect {
            left: LEFT,
            top: top + CAPTION,
            right: WIDTH - RIGHT,
            bottom: top + CAPTION + IMAGE,
        };
        let lettering = Lettering::new(LABEL, HPos::Left, VPos::Center);
        sheet.text(caption, (LEFT, top + 0.5 * CAPTION), lettering)?;
        sheet.pixels(&rect, |x, y| {
            let column = ((x * self.model.width as f64) as usize).min(self.model.width - 1);
            let row = ((y * self.model.height as f64) as usize).min(self.model.height - 1);
            let value_m = value_m(row * self.model.width + column);
            Some(self.color(value_m, span, colormap))
        })?;
        let view = View {
            rect,
            // Columns grow clockwise from straight back, azimuth counter-clockwise.
            x: Span::new(180.0, -180.0),
            y: Span::new(
                f64::from(self.model.fov_down_rad().to_degrees()),
                f64::from(self.model.fov_up),
            ),
        };
        let last = caption.contains('−');
        view.panorama_frame(
            sheet,
            if last { "azimuth [deg]" } else { "" },
            "elevation [deg]",
        )?;
        let bar = Rect {
            left: rect.right + 20.0,
            right: rect.right + 44.0,
            ..rect
        };
        let name = if last { "difference [m]" } else { "range [m]" };
        color_bar(sheet, bar, span, colormap, name)
    }

    fn color(&self, value_m: f64, span: Span, colormap: Colormap) -> Rgb {
        colormap.at((value_m - span.min) / span.length())
    }
}

/// NaN where there is no return.
fn range(range_m: f32) -> f64 {
    if range_m.is_finite() && range_m > 0.0 {
        f64::from(range_m)
    } else {
        f64::NAN
    }
}
