//! The map from above, in its own colors or colored by a number.

use std::path::Path;

use anyhow::{Result, ensure};

use super::MapImage;
use super::bitmap::Bitmap;
use super::color::{Colormap, MISSING, Rgb, TRUTH, WHITE};
use super::sheet::{save_png, stroke};
use super::view::{AxisRange, ColorBar, LegendEntry, Mark, TopView, positions};
use crate::geometry::{Pose2, TriangleMesh};

/// Maximum number of columns and rows of the raster: the resolution of drawing.
const RASTER: usize = 2500;

/// The map from above, in the colors of its vertices or of numbers.
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
    /// Numbers that color the map instead.
    pub numbers: Option<VertexNumbers<'a>>,
}

/// A number per vertex of a map, such as a residual, whose colors are those of viridis.
#[derive(Clone, Copy, Debug)]
pub struct VertexNumbers<'a> {
    /// The numbers; not finite where unknown.
    pub values: &'a [f32],
    /// Name of the numbers with their unit.
    pub name: &'a str,
    /// Number at the end of the color bar, which starts at zero; larger ones have its color.
    pub limit: f64,
}

impl MapPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<()> {
        save_png(path, self.draw())
    }

    fn draw(&self) -> Result<Bitmap> {
        let bounds = self.mesh.bounds();
        ensure!(
            !bounds.is_empty() && !self.mesh.triangles.is_empty(),
            "there is nothing to draw: the mesh has no triangles"
        );
        let range = |min: f32, max: f32| {
            let range = AxisRange::new(f64::from(min), f64::from(max)).at_least(1.0);
            range.padded(0.02 * range.length())
        };
        let color_bar = self.numbers.map(|numbers| ColorBar {
            range: AxisRange::new(0.0, numbers.limit),
            colormap: Colormap::Viridis,
            name: numbers.name,
        });
        let unknown = self.numbers.map(|_| ("not known", MISSING));
        let colors = self.keys.iter().copied().chain(unknown);
        let colors = colors.map(|(name, color)| LegendEntry::new(name, color, Mark::Area));
        let driven = (self.path).map(|(name, _)| LegendEntry::new(name, TRUTH, Mark::Line));
        let view = TopView {
            title: self.title,
            legend: colors.chain(driven).collect(),
            x: range(bounds.min.x, bounds.max.x),
            y: range(bounds.min.y, bounds.max.y),
            color_bar,
        };
        let image = match (self.numbers, color_bar) {
            (Some(numbers), Some(bar)) => {
                let color = |value| bar.color(f64::from(value));
                MapImage::of_scalar(self.mesh, numbers.values, RASTER, color)
            }
            _ => MapImage::of_colors(self.mesh, RASTER),
        };
        view.draw(|sheet, view| {
            image.draw(sheet, view, 0.0)?;
            let path = positions(self.path.map_or(&[], |(_, poses)| poses), view);
            sheet.polyline(&path, &view.rect, stroke(WHITE, 5.0))?;
            sheet.polyline(&path, &view.rect, stroke(TRUTH, 2.5))
        })
    }
}
