//! The map from above as a raster: the highest triangle of each cell, shaded by its slope.
//!
//! Where a surface is more than 2 m below others, as the road below crowns, the floor below a ceiling and the road
//! below a bridge, the others are left out.

use anyhow::Result;
use glam::Vec3;

use super::bitmap::Bitmap;
use super::color::{MISSING, Rgb, WHITE, blend};
use super::sheet::Sheet;
use super::view::View;
use crate::geometry::TriangleMesh;

/// Direction to the light: from the upper left, steep.
const LIGHT: Vec3 = Vec3::new(-0.42, 0.42, 0.8);

/// What is higher above the lowest surface of a cell is left out [m].
const HEADROOM_M: f32 = 2.0;

/// Names and colors of the ground and of what is above it, in [`muted`] maps.
pub const SURFACES: [(&str, Rgb); 2] = [("ground", [224, 217, 206]), ("above it", [116, 151, 150])];

/// Raster over the x-y plane, rows from the top (largest y) down.
#[derive(Clone, Debug, PartialEq)]
pub struct MapImage {
    /// Number of columns.
    width: usize,
    /// Number of rows.
    height: usize,
    /// Left edge [m].
    x_min: f64,
    /// Upper edge [m].
    y_max: f64,
    /// Edge length of a cell [m].
    cell_m: f64,
    /// Colors, row by row; `None` where there is no surface.
    cells: Vec<Option<Rgb>>,
}

impl MapImage {
    /// Renders the mesh in its own colors, gray where it has none, with at most `max_cells`
    /// columns and rows.
    pub fn of_colors(mesh: &TriangleMesh, max_cells: usize) -> Self {
        Self::render(mesh, max_cells, |triangle, weights| {
            if mesh.colors.len() != mesh.vertices.len() {
                return MISSING;
            }
            let colors = mesh.triangles[triangle].map(|vertex| mesh.colors[vertex as usize]);
            std::array::from_fn(|channel| {
                let channels = colors.map(|color| f32::from(color[channel]));
                interpolated(channels, weights) as u8
            })
        })
    }

    /// Renders the mesh colored by a number per vertex; `color` maps the interpolated number.
    pub fn of_scalar(
        mesh: &TriangleMesh,
        values: &[f32],
        max_cells: usize,
        color: impl Fn(f32) -> Rgb,
    ) -> Self {
        Self::render(mesh, max_cells, |triangle, weights| {
            let corners = mesh.triangles[triangle].map(|vertex| values[vertex as usize]);
            color(interpolated(corners, weights))
        })
    }

    /// Renders the highest surface of each cell; `color` maps triangle and barycentric weights.
    fn render(
        mesh: &TriangleMesh,
        max_cells: usize,
        color: impl Fn(usize, [f32; 3]) -> Rgb,
    ) -> Self {
        const FINEST_M: f64 = 0.02;
        let bounds = mesh.bounds();
        let (width_m, height_m) = if bounds.is_empty() {
            (1.0, 1.0)
        } else {
            (f64::from(bounds.size().x), f64::from(bounds.size().y))
        };
        let cell_m = (width_m.max(height_m) / max_cells.max(1) as f64).max(FINEST_M);
        let mut image = Self {
            width: ((width_m / cell_m).ceil() as usize).max(1),
            height: ((height_m / cell_m).ceil() as usize).max(1),
            x_min: f64::from(bounds.min.x),
            y_max: f64::from(bounds.max.y),
            cell_m,
            cells: Vec::new(),
        };
        image.cells = vec![None; image.width * image.height];
        if bounds.is_empty() {
            return image;
        }
        let mut bottoms = vec![f32::INFINITY; image.cells.len()];
        let mut tops = vec![f32::NEG_INFINITY; image.cells.len()];
        let triangles = 0..mesh.triangles.len();
        for triangle in triangles.clone() {
            image.for_each_cell(mesh.corners(triangle), |cell, height_m, _| {
                bottoms[cell] = bottoms[cell].min(height_m);
            });
        }
        let mut cells = vec![None; tops.len()];
        for triangle in triangles {
            let shade = shade(mesh.scaled_normal(triangle));
            image.for_each_cell(mesh.corners(triangle), |cell, height_m, weights| {
                if height_m > tops[cell] && height_m <= bottoms[cell] + HEADROOM_M {
                    tops[cell] = height_m;
                    cells[cell] = Some(blend([0, 0, 0], color(triangle, weights), shade));
                }
            });
        }
        image.cells = cells;
        image
    }

    /// Visits the cells whose center a triangle covers, with its height there and its barycentric weights.
    fn for_each_cell(&self, corners: [Vec3; 3], mut visit: impl FnMut(usize, f32, [f32; 3])) {
        // In units of cells, so that the center of cell (column, row) is at + 0.5.
        let [a, b, c] = corners.map(|corner| {
            (
                ((f64::from(corner.x) - self.x_min) / self.cell_m) as f32,
                ((self.y_max - f64::from(corner.y)) / self.cell_m) as f32,
            )
        });
        let area = (b.0 - a.0) * (c.1 - a.1) - (c.0 - a.0) * (b.1 - a.1);
        let span = |low: f32, high: f32, cells: usize| {
            let first = (low - 0.5).ceil().max(0.0) as usize;
            let last = (high - 0.5).floor().min(cells as f32 - 1.0);
            (first, last)
        };
        let (left, right) = span(a.0.min(b.0).min(c.0), a.0.max(b.0).max(c.0), self.width);
        let (top, bottom) = span(a.1.min(b.1).min(c.1), a.1.max(b.1).max(c.1), self.height);
        if area.abs() < 1e-9 || right < 0.0 || bottom < 0.0 {
            return;
        }
        for row in top..=bottom as usize {
            for column in left..=right as usize {
                let (x, y) = (column as f32 + 0.5 - a.0, row as f32 + 0.5 - a.1);
                let v = (x * (c.1 - a.1) - (c.0 - a.0) * y) / area;
                let w = ((b.0 - a.0) * y - x * (b.1 - a.1)) / area;
                let weights = [1.0 - v - w, v, w];
                if weights.iter().any(|weight| *weight < -1e-4) {
                    continue;
                }
                let height_m = interpolated(corners.map(|corner| corner.z), weights);
                visit(row * self.width + column, height_m, weights);
            }
        }
    }

    /// The raster, white where there is no surface, with its left and upper edge and the edge of a cell [m].
    pub fn bitmap(&self) -> (Bitmap, [f64; 3]) {
        let cell =
            |x: u32, y: u32| self.cells[y as usize * self.width + x as usize].unwrap_or(WHITE);
        let bitmap = Bitmap::from_fn(self.width as u32, self.height as u32, cell);
        (bitmap, [self.x_min, self.y_max, self.cell_m])
    }

    /// Color at a position; `None` where there is no surface.
    fn at(&self, x: f64, y: f64) -> Option<Rgb> {
        let column = ((x - self.x_min) / self.cell_m).floor();
        let row = ((self.y_max - y) / self.cell_m).floor();
        let inside =
            column >= 0.0 && row >= 0.0 && column < self.width as f64 && row < self.height as f64;
        inside.then(|| self.cells[row as usize * self.width + column as usize])?
    }

    /// Draws the part inside a view, mixed with a share of white: 0 unchanged, 1 invisible.
    pub(crate) fn draw(&self, sheet: &Sheet, view: &View, whiteness: f64) -> Result<()> {
        sheet.pixels(&view.rect, |right, down| {
            let x = view.x.min + right * view.x.length();
            let y = view.y.max - down * view.y.length();
            self.at(x, y).map(|color| blend(color, WHITE, whiteness))
        })
    }
}

/// A copy of a map in the colors of [`SURFACES`]: ground is what has more red than blue.
pub fn muted(mesh: &TriangleMesh) -> TriangleMesh {
    let muted = |[red, _, blue]: &Rgb| SURFACES[usize::from(red <= blue)].1;
    TriangleMesh {
        colors: mesh.colors.iter().map(muted).collect(),
        ..mesh.clone()
    }
}

/// Sum of the weighted values.
fn interpolated(values: [f32; 3], weights: [f32; 3]) -> f32 {
    let weighted = values.iter().zip(weights);
    weighted.map(|(value, weight)| value * weight).sum()
}

/// Brightness of a surface, independent of its orientation up or down; 1 if it is level.
fn shade(scaled_normal: Vec3) -> f64 {
    let normal = scaled_normal.normalize_or(Vec3::Z);
    let up = if normal.z < 0.0 { -normal } else { normal };
    0.4 + 0.6 * f64::from(up.dot(LIGHT).max(0.0) / LIGHT.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A red floor of 10 m with a blue box of 2 m in its center, stored before the floor.
    fn floor_and_box() -> TriangleMesh {
        let square = |half: f32, z: f32, color: Rgb| TriangleMesh {
            vertices: vec![
                Vec3::new(-half, -half, z),
                Vec3::new(half, -half, z),
                Vec3::new(half, half, z),
                Vec3::new(-half, half, z),
            ],
            colors: vec![color; 4],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..TriangleMesh::default()
        };
        let mut mesh = square(1.0, 2.0, [0, 0, 255]);
        mesh.append(&square(5.0, 0.0, [255, 0, 0]));
        mesh
    }

    #[test]
    fn higher_surfaces_hide_lower_ones_in_any_order_unless_there_is_headroom_below_them() {
        let mut mesh = floor_and_box();
        let image = MapImage::of_colors(&mesh, 100);
        let [red, _, blue] = image.at(0.0, 0.0).unwrap();
        assert!(blue > 150 && red == 0);
        let [red, _, blue] = image.at(3.0, -3.0).unwrap();
        assert!(red > 150 && blue == 0);
        assert_eq!(image.at(5.1, 0.0), None);
        mesh.vertices.iter_mut().for_each(|vertex| vertex.z *= 1.1);
        let [red, _, blue] = MapImage::of_colors(&mesh, 100).at(0.0, 0.0).unwrap();
        assert!(red > 150 && blue == 0);
    }

    #[test]
    fn ground_and_the_rest_of_a_muted_map_have_their_colors() {
        let colors = muted(&floor_and_box()).colors;
        assert_eq!((colors[0], colors[7]), (SURFACES[1].1, SURFACES[0].1));
    }

    #[test]
    fn every_cell_of_a_floor_is_covered() {
        let image = MapImage::of_colors(&floor_and_box(), 64);
        assert!(image.cells.iter().all(Option::is_some));
    }

    #[test]
    fn a_scalar_is_interpolated_between_vertices() {
        let mesh = floor_and_box();
        let values: Vec<f32> = mesh.vertices.iter().map(|vertex| vertex.x).collect();
        let gray = |value: f32| [(100.0 + 10.0 * value) as u8; 3];
        let image = MapImage::of_scalar(&mesh, &values, 100, gray);
        let [left, ..] = image.at(-4.0, 3.0).unwrap();
        let [right, ..] = image.at(4.0, 3.0).unwrap();
        let flat = shade(Vec3::Z);
        assert!((f64::from(left) - 60.0 * flat).abs() < 2.0);
        assert!((f64::from(right) - 140.0 * flat).abs() < 2.0);
    }

    #[test]
    fn an_empty_mesh_gives_an_empty_image() {
        let image = MapImage::of_colors(&TriangleMesh::default(), 100);
        assert!(image.cells.iter().all(Option::is_none));
    }
}
