//! Frame of all pictures of the x-y plane from above: title, legend, equal axes, scale bar.

use anyhow::Result;

use super::bitmap::Bitmap;
use super::sheet::{self, Point, Rect, Sheet};
use super::view::{AxisRange, ColorBar, LegendEntry, View, legend};
use crate::geometry::Pose2;

/// Width of a picture [px].
pub const WIDTH: f64 = 1400.0;

/// Picture of the x-y plane without its content.
pub struct TopView<'a> {
    pub title: &'a str,
    /// Width [px].
    pub width: f64,
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
        const LEFT: f64 = 118.0;
        // The legend is in a line of its own.
        let top = if self.legend.is_empty() { 66.0 } else { 96.0 };
        let right = self.width
            - if self.color_bar.is_some() {
                150.0
            } else {
                30.0
            };
        let height = ((right - LEFT) * self.y.length() / self.x.length())
            .clamp(0.27 * self.width, 0.82 * self.width);
        let rect = Rect {
            left: LEFT,
            top,
            right,
            bottom: top + height.round(),
        };
        let view = View::equal(rect, self.x, self.y);
        sheet::draw((self.width as u32, (rect.bottom + 74.0) as u32), |sheet| {
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
