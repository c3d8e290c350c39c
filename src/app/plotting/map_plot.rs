//! The map from above, in its own colours or coloured by a number.

use std::collections::BTreeMap;
use std::path::Path;

use super::MapImage;
use super::color::{Colormap, MISSING, Rgb, TRUTH};
use super::error::PlotError;
use super::sheet::{self, Pen, Rect, Sheet};
use super::trajectory::{map_view, places};
use super::view::{Key, KeyShape, Span, View, color_bar, legend, title};
use crate::geometry::{Pose2, TriangleMesh};

/// Columns or rows of the raster: as many as the picture is drawn with.
const RASTER: usize = 2500;

/// The map from above, as its vertices are coloured.
#[derive(Clone, Copy, Debug)]
pub struct MapPlot<'a> {
    /// Above everything.
    pub title: &'a str,
    /// The map.
    pub mesh: &'a TriangleMesh,
    /// A path with its name, where it is to be drawn.
    pub path: Option<(&'a str, &'a [Pose2])>,
    /// What the colours of the map are called.
    pub keys: &'a [(&'a str, Rgb)],
}

impl MapPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<(), PlotError> {
        let (x, y) = extent(self.mesh, path)?;
        let image = MapImage::of_colors(self.mesh, RASTER);
        let (view, size) = map_view(x, y, 96.0, 30.0);
        let key = |name: &str, color: Rgb, shape: KeyShape| Key {
            name: name.to_owned(),
            color,
            shape,
        };
        let colors = self.keys.iter();
        let colors = colors.map(|(name, color)| key(name, *color, KeyShape::Square));
        let driven = self.path.map(|(name, _)| key(name, TRUTH, KeyShape::Line));
        let keys: Vec<Key> = colors.chain(driven).collect();
        sheet::save(path, size, |sheet| {
            title(sheet, self.title, view.rect.left)?;
            legend(sheet, &keys, (view.rect.left, 70.0), view.rect.right)?;
            view.grid(sheet)?;
            image.draw(sheet, &view, 0.0)?;
            draw_trajectory(sheet, &view, self.path.map(|(_, poses)| poses))?;
            view.frame(sheet, "x [m]", "y [m]")?;
            view.scale_bar(sheet)
        })
    }
}

/// The most frequent colours of ground (more red than blue) and rest, by which a map from anywhere
/// is told; none of a map without colours.
pub fn ground_and_rest(mesh: &TriangleMesh) -> Vec<(&'static str, Rgb)> {
    let most_frequent = |is_ground: bool| {
        let mut counts = BTreeMap::<Rgb, usize>::new();
        for &color in &mesh.colors {
            if (color[0] > color[2]) == is_ground {
                *counts.entry(color).or_default() += 1;
            }
        }
        let most = counts.into_iter().max_by_key(|&(_, count)| count);
        most.map(|(color, _)| color)
    };
    [("ground", true), ("rest", false)]
        .into_iter()
        .filter_map(|(name, is_ground)| Some((name, most_frequent(is_ground)?)))
        .collect()
}

/// The map from above, coloured by a number per vertex, such as a residual.
#[derive(Clone, Copy, Debug)]
pub struct ScalarMapPlot<'a> {
    /// Above everything.
    pub title: &'a str,
    /// The map.
    pub mesh: &'a TriangleMesh,
    /// One number per vertex; not finite where nothing is known.
    pub values: &'a [f32],
    /// What the numbers are, with their unit.
    pub value_name: &'a str,
    /// Numbers at the ends of the colour bar; those beyond have the colour of the end.
    pub limits: (f64, f64),
    /// Which colours.
    pub colormap: Colormap,
    /// The mapping trajectory, where it is to be drawn.
    pub trajectory: Option<&'a [Pose2]>,
}

impl ScalarMapPlot<'_> {
    /// Writes the picture.
    pub fn save(&self, path: &Path) -> Result<(), PlotError> {
        if self.values.len() != self.mesh.vertices.len() {
            return Err(PlotError::WrongLength {
                path: path.to_owned(),
                what: "values",
                found: self.values.len(),
                expected: self.mesh.vertices.len(),
            });
        }
        let (x, y) = extent(self.mesh, path)?;
        let limits = Span::new(self.limits.0, self.limits.1).at_least(1e-9);
        let image = MapImage::of_scalar(self.mesh, self.values, RASTER, |value| {
            self.colormap
                .at((f64::from(value) - limits.min) / limits.length())
        });
        let (view, size) = map_view(x, y, 96.0, 150.0);
        let unknown = Key {
            name: "not known".to_owned(),
            color: MISSING,
            shape: KeyShape::Square,
        };
        let bar = Rect {
            left: view.rect.right + 22.0,
            right: view.rect.right + 48.0,
            ..view.rect
        };
        sheet::save(path, size, |sheet| {
            title(sheet, self.title, view.rect.left)?;
            legend(sheet, &[unknown], (view.rect.left, 70.0), view.rect.right)?;
            view.grid(sheet)?;
            image.draw(sheet, &view, 0.0)?;
            draw_trajectory(sheet, &view, self.trajectory)?;
            view.frame(sheet, "x [m]", "y [m]")?;
            color_bar(sheet, bar, limits, self.colormap, self.value_name)?;
            view.scale_bar(sheet)
        })
    }
}

fn draw_trajectory(
    sheet: &Sheet,
    view: &View,
    trajectory: Option<&[Pose2]>,
) -> Result<(), super::error::DrawError> {
    let Some(poses) = trajectory else {
        return Ok(());
    };
    let places = places(poses, view);
    sheet.polyline(&places, &view.rect, Pen::new([255, 255, 255], 5.0))?;
    sheet.polyline(&places, &view.rect, Pen::new(TRUTH, 2.5))
}

fn extent(mesh: &TriangleMesh, path: &Path) -> Result<(Span, Span), PlotError> {
    let bounds = mesh.bounds();
    if bounds.is_empty() || mesh.triangles.is_empty() {
        return Err(PlotError::Nothing {
            path: path.to_owned(),
            what: "the mesh has no triangles",
        });
    }
    let span = |min: f32, max: f32| {
        let span = Span::new(f64::from(min), f64::from(max)).at_least(1.0);
        span.padded(0.02 * span.length())
    };
    Ok((
        span(bounds.min.x, bounds.max.x),
        span(bounds.min.y, bounds.max.y),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_legend_of_a_map_has_the_colours_that_the_map_has() {
        let colored = |colors: &[Rgb]| TriangleMesh {
            colors: colors.to_vec(),
            ..TriangleMesh::default()
        };
        let (earth, wall) = ([120, 80, 30], [40, 40, 90]);
        let map = colored(&[earth, wall, earth, [200, 0, 0], wall]);
        let expected = vec![("ground", earth), ("rest", wall)];
        assert_eq!(ground_and_rest(&map), expected);
        assert_eq!(ground_and_rest(&colored(&[wall])), expected[1..]);
        assert_eq!(ground_and_rest(&colored(&[])), []);
    }
}
