//! The map from above, in its own colors or colored by a number.

use std::path::Path;

use anyhow::{Result, ensure};

use super::MapImage;
use super::bitmap::Bitmap;
use super::color::{Colormap, MISSING, Rgb, TRUTH, WHITE};
use super::sheet::{save_png, stroke};
use super::top_view::{TopView, WIDTH, positions};
use super::view::{AxisRange, ColorBar, LegendEntry, Mark};
use crate::geometry::{Pose2, TriangleMesh};

/// Maximum number of columns and rows of the raster: the resolution of drawing.
const RASTER: usize = 2500;

/// The map from above in the colors of its vertices.
#[derive(Clone, Copy, Debug)]
pub struct MapPlot<'a> {
    /// Title.
    pub title: &'a str,
    /// Map.
    pub mesh: &'a TriangleMesh,
    /// Path to draw, with its name.
    pub path: Option<(&'a str, &'a [Pose2])>,
    /// Names of colors of the map.
    pub keys: &'a [(&'a str, Rgb)],
}

impl MapPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        let colors = self.keys.iter();
        let colors = colors.map(|&(name, color)| LegendEntry::new(name, color, Mark::Area));
        let driven = self
            .path
            .map(|(name, _)| LegendEntry::new(name, TRUTH, Mark::Line));
        let legend = colors.chain(driven).collect();
        let image = || MapImage::of_colors(self.mesh, RASTER);
        let poses = self.path.map(|(_, poses)| poses);
        save_png(
            path,
            draw(self.title, self.mesh, legend, None, image, poses),
        )
    }
}

/// The map from above, colored by a number per vertex, such as a residual.
#[derive(Clone, Copy, Debug)]
pub struct ScalarMapPlot<'a> {
    /// Title.
    pub title: &'a str,
    /// Map.
    pub mesh: &'a TriangleMesh,
    /// One number per vertex; not finite where unknown.
    pub values: &'a [f32],
    /// Name of the numbers with their unit.
    pub value_name: &'a str,
    /// Numbers at the ends of the color bar; numbers beyond have the color of the end.
    pub limits: (f64, f64),
    /// Colors.
    pub colormap: Colormap,
    /// Mapping trajectory to draw.
    pub trajectory: Option<&'a [Pose2]>,
}

impl ScalarMapPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        save_png(path, self.draw())
    }

    fn draw(&self) -> Result<Bitmap> {
        debug_assert_eq!(self.values.len(), self.mesh.vertices.len());
        let bar = ColorBar {
            range: AxisRange::new(self.limits.0, self.limits.1).at_least(1e-9),
            colormap: self.colormap,
            name: self.value_name,
        };
        let unknown = LegendEntry::new("not known", MISSING, Mark::Area);
        let image = || {
            let color = |value| bar.color(f64::from(value));
            MapImage::of_scalar(self.mesh, self.values, RASTER, color)
        };
        let legend = vec![unknown];
        draw(
            self.title,
            self.mesh,
            legend,
            Some(bar),
            image,
            self.trajectory,
        )
    }
}

/// Draws a raster of the map and a path over it.
fn draw(
    title: &str,
    mesh: &TriangleMesh,
    legend: Vec<LegendEntry>,
    color_bar: Option<ColorBar>,
    image: impl FnOnce() -> MapImage,
    path: Option<&[Pose2]>,
) -> Result<Bitmap> {
    let bounds = mesh.bounds();
    ensure!(
        !bounds.is_empty() && !mesh.triangles.is_empty(),
        "there is nothing to draw: the mesh has no triangles"
    );
    let range = |min: f32, max: f32| {
        let range = AxisRange::new(f64::from(min), f64::from(max)).at_least(1.0);
        range.padded(0.02 * range.length())
    };
    let view = TopView {
        title,
        width: WIDTH,
        legend,
        x: range(bounds.min.x, bounds.max.x),
        y: range(bounds.min.y, bounds.max.y),
        color_bar,
    };
    let image = image();
    view.draw(|sheet, view| {
        image.draw(sheet, view, 0.0)?;
        let path = positions(path.unwrap_or_default(), view);
        sheet.polyline(&path, &view.rect, stroke(WHITE, 5.0))?;
        sheet.polyline(&path, &view.rect, stroke(TRUTH, 2.5))
    })
}
