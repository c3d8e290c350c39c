//! Frame of all pictures of the x-y plane from above: title, legend, equal axes, scale bar.

use anyhow::Result;

use super::bitmap::Bitmap;
use super::sheet::{self, Point, Rect, Sheet};
use super::view::{AxisRange, ColorBar, LegendEntry, View, legend};
use crate::geometry::Pose2;

/// Picture of the x-y plane, 1,400 pixels wide, without its content.
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
        const WIDTH: f64 = 1400.0;
        const LEFT: f64 = 118.0;
        const TOP: f64 = 96.0;
        let right = WIDTH
            - if self.color_bar.is_some() {
                150.0
            } else {
                30.0
            };
        let height = ((right - LEFT) * self.y.length() / self.x.length()).clamp(380.0, 1150.0);
        let rect = Rect {
            left: LEFT,
            top: TOP,
            right,
            bottom: TOP + height.round(),
        };
        let view = View::equal(rect, self.x, self.y);
        sheet::draw((WIDTH as u32, (rect.bottom + 74.0) as u32), |sheet| {
            sheet.title(self.title, LEFT)?;
            legend(sheet, &self.legend, (LEFT, 70.0), right)?;
            view.grid(sheet)?;
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
