//! Range image of a scan, that of the map from the same pose, and their difference.

use std::path::Path;

use anyhow::{Result, ensure};

use super::bitmap::Bitmap;
use super::color::{Colormap, MISSING};
use super::sheet::{self, HPos, LABEL, Rect, Sheet, VPos, save_png, text_style};
use super::view::{AxisRange, ColorBar, LegendEntry, Mark, Ticks, View, legend};
use crate::lidar::RangeImage;

const WIDTH: f64 = 1400.0;
const LEFT: f64 = 118.0;
const RIGHT: f64 = 140.0;
const HEADER: f64 = 96.0;
const CAPTION: f64 = 32.0;
const IMAGE: f64 = 170.0;
const BETWEEN: f64 = 34.0;
/// Differences at the ends of the color bar [m].
const DIFFERENCE_LIMIT_M: f64 = 1.0;

/// Three range images one above the other: observed, rendered, observed − rendered.
#[derive(Clone, Copy, Debug)]
pub struct RangeImageStrip<'a> {
    /// Title.
    pub title: &'a str,
    /// Range image of the scan.
    pub observed: &'a RangeImage,
    /// Ranges of the map in the same projection, row-major [m]; not finite or not positive where
    /// there is no return.
    pub rendered: &'a [f32],
}

impl RangeImageStrip<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        save_png(path, self.draw())
    }

    fn draw(&self) -> Result<Bitmap> {
        ensure!(
            !self.rendered.is_empty(),
            "there is nothing to draw: the range images have no pixels"
        );
        let height = HEADER + 3.0 * (CAPTION + IMAGE + BETWEEN) + 34.0;
        sheet::draw((WIDTH as u32, height as u32), |sheet| self.draw_on(sheet))
    }

    fn draw_on(&self, sheet: &Sheet) -> Result<()> {
        sheet.title(self.title, LEFT)?;
        let name = "no return, or no surface in the map";
        let [nearer, farther] = [0.0, 1.0].map(|end| Colormap::Diverging.at(end));
        let entries = [
            LegendEntry::new(name, MISSING, Mark::Area),
            LegendEntry::new("nearer than the map, such as a car", nearer, Mark::Area),
            LegendEntry::new("farther than the map", farther, Mark::Area),
        ];
        legend(sheet, &entries, (LEFT, 70.0), WIDTH - RIGHT)?;
        let ranges = ColorBar {
            range: AxisRange::new(0.0, f64::from(self.observed.model.max_range)),
            colormap: Colormap::Viridis,
            name: "range [m]",
        };
        let differences = ColorBar {
            range: AxisRange::new(-DIFFERENCE_LIMIT_M, DIFFERENCE_LIMIT_M),
            colormap: Colormap::Diverging,
            name: "difference [m]",
        };
        let observed = |index: usize| range(self.observed.ranges[index]);
        let rendered = |index: usize| range(self.rendered[index]);
        let difference = |index: usize| observed(index) - rendered(index);
        self.image(sheet, 0, ["observed", ""], &ranges, observed)?;
        self.image(sheet, 1, ["rendered from the map", ""], &ranges, rendered)?;
        let names = ["observed − rendered", "azimuth [deg]"];
        self.image(sheet, 2, names, &differences, difference)
    }

    /// Draws the image of a number with its caption, axes and color bar.
    fn image(
        &self,
        sheet: &Sheet,
        number: u32,
        [caption, x_name]: [&str; 2],
        color_bar: &ColorBar,
        value_m: impl Fn(usize) -> f64,
    ) -> Result<()> {
        let top = HEADER + f64::from(number) * (CAPTION + IMAGE + BETWEEN);
        let rect = Rect {
            left: LEFT,
            top: top + CAPTION,
            right: WIDTH - RIGHT,
            bottom: top + CAPTION + IMAGE,
        };
        let style = text_style(LABEL, HPos::Left, VPos::Center);
        sheet.text(caption, (LEFT, top + 0.5 * CAPTION), &style)?;
        let model = &self.observed.model;
        let (width, height) = (model.width, model.height);
        sheet.pixels(&rect, |x, y| {
            let column = ((x * width as f64) as usize).min(width - 1);
            let row = ((y * height as f64) as usize).min(height - 1);
            Some(color_bar.color(value_m(row * width + column)))
        })?;
        let view = View {
            rect,
            // Columns grow clockwise from straight back, azimuth counter-clockwise.
            x: AxisRange::new(180.0, -180.0),
            y: AxisRange::new(
                f64::from(model.fov_down_rad().to_degrees()),
                f64::from(model.fov_up),
            ),
        };
        let x_ticks = Ticks::every(60.0, AxisRange::new(-180.0, 180.0));
        view.frame(sheet, &x_ticks, [x_name, "elevation [deg]"])?;
        color_bar.draw(sheet, &rect, [rect.right + 20.0, rect.right + 44.0])
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
