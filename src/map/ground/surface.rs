//! Ground of a mesh or cloud without marks: the near-horizontal surfaces that do not stand above others.
//!
//! ```text
//! near horizontal    |n_z| > cos 30°, on either side
//! surfaces           per cell of 0.5 m, heights less than 0.3 m apart
//! connected          heights of surfaces within 1 m differ by less than 0.15 m + 0.25 · distance
//! ground             4 m² or more, and less than half of the rim has another surface below it
//! ```
//!
//! The roof of a car or house, a table or a ceiling has another surface around or below its rim; a
//! road, a bridge with its ramps, or the storeys of a car park are connected and end at walls.

use std::collections::HashMap;

use glam::Vec3;
use nalgebra::Point2;

use super::heights::{self, rasterize};
use crate::geometry::TriangleMesh;

/// Edge of a cell [m].
const CELL_M: f64 = 0.5;

/// Cosine of the steepest slope of ground.
const LEVEL_COSINE: f32 = 0.866;

/// Smallest distance between the heights of two surfaces of a cell [m].
const GAP_M: f32 = 0.3;

/// Radius within which surfaces are connected [cells].
const LINK_CELLS: i32 = 2;

/// Largest difference of the heights of connected surfaces [m], and its increase per metre of distance.
const STEP_M: f32 = 0.15;
const STEP_PER_M: f32 = 0.25;

/// Smallest ground [cells], 4 m².
const MIN_CELLS: usize = 16;

/// Radius around the rim in which another surface counts as below [cells].
const RIM_CELLS: i32 = 3;

/// A surface that much below the rim is another surface [m].
const BELOW_M: f32 = 0.4;

/// A near-horizontal surface in a cell.
#[derive(Clone, Copy, Debug)]
struct CellSurface {
    column: i32,
    row: i32,
    /// Lowest and highest height [m].
    low_m: f32,
    high_m: f32,
}

/// The ground of a mesh or a cloud.
pub(crate) struct GroundSurface {
    /// All near-horizontal surfaces, ordered by cell and height.
    surfaces: Vec<CellSurface>,
    /// First surface of each cell and the number of its surfaces.
    cells: HashMap<(i32, i32), (u32, u32)>,
    is_ground: Vec<bool>,
}

impl GroundSurface {
    /// Detects the ground of a mesh.
    pub fn of_mesh(mesh: &TriangleMesh) -> Self {
        let mut samples = Vec::new();
        for triangle in 0..mesh.triangles.len() {
            if is_level(mesh.scaled_normal(triangle)) {
                let corners = mesh.corners(triangle);
                let mut add = |(column, row): (i64, i64), height_m: f64| {
                    samples.push((column as i32, row as i32, height_m as f32));
                };
                rasterize(corners.map(|corner| corner.as_dvec3()), CELL_M, &mut add);
                let center = centroid(corners);
                let (column, row) = cell_of(center);
                samples.push((column, row, center.z));
            }
        }
        Self::of_samples(samples)
    }

    /// Detects the ground of points with normals.
    pub fn of_points(points: &[Vec3], normals: &[Vec3]) -> Self {
        let level = points
            .iter()
            .zip(normals)
            .filter(|(_, normal)| is_level(**normal));
        let sample = |(point, _): (&Vec3, _)| {
            let (column, row) = cell_of(*point);
            (column, row, point.z)
        };
        Self::of_samples(level.map(sample).collect())
    }

    /// Whether a triangle of the mesh is ground.
    pub fn has_triangle(&self, mesh: &TriangleMesh, triangle: usize) -> bool {
        is_level(mesh.scaled_normal(triangle)) && self.contains(centroid(mesh.corners(triangle)))
    }

    /// Whether a point with its normal is ground.
    pub fn has_point(&self, point: Vec3, normal: Vec3) -> bool {
        is_level(normal) && self.contains(point)
    }

    /// Area of the ground seen from above [m²].
    pub fn area_m2(&self) -> f64 {
        let cells = self
            .is_ground
            .iter()
            .filter(|&&is_ground| is_ground)
            .count();
        cells as f64 * CELL_M * CELL_M
    }

    /// Whether a position is on a surface of the ground.
    fn contains(&self, position: Vec3) -> bool {
        let (column, row) = cell_of(position);
        self.in_cell(column, row).any(|index| {
            let surface = &self.surfaces[index];
            self.is_ground[index] && (surface.low_m..=surface.high_m).contains(&position.z)
        })
    }

    fn of_samples(samples: Vec<(i32, i32, f32)>) -> Self {
        let surfaces = surfaces_of(samples);
        let mut cells = HashMap::with_capacity(surfaces.len());
        for (index, surface) in surfaces.iter().enumerate() {
            cells
                .entry((surface.column, surface.row))
                .or_insert((index as u32, 0))
                .1 += 1;
        }
        let mut ground = Self {
            is_ground: vec![false; surfaces.len()],
            surfaces,
            cells,
        };
        let components = ground.components();
        ground.is_ground = ground.lowest(&components);
        ground
    }

    /// Surfaces of a cell.
    fn in_cell(&self, column: i32, row: i32) -> impl Iterator<Item = usize> + use<> {
        let (first, count) = self.cells.get(&(column, row)).copied().unwrap_or_default();
        first as usize..(first + count) as usize
    }

    /// Component of each surface, as one of its surfaces.
    fn components(&self) -> Vec<u32> {
        let mut parents: Vec<u32> = (0..self.surfaces.len() as u32).collect();
        for (index, surface) in self.surfaces.iter().enumerate() {
            for (columns, rows) in cells_within(LINK_CELLS).filter(|&offset| offset > (0, 0)) {
                let distance_m = CELL_M as f32 * ((columns * columns + rows * rows) as f32).sqrt();
                let step_m = STEP_M + STEP_PER_M * distance_m;
                for other in self.in_cell(surface.column + columns, surface.row + rows) {
                    let neighbour = &self.surfaces[other];
                    let apart_m =
                        (surface.low_m - neighbour.high_m).max(neighbour.low_m - surface.high_m);
                    if apart_m < step_m {
                        let (a, b) = (
                            root(&mut parents, index as u32),
                            root(&mut parents, other as u32),
                        );
                        parents[a.max(b) as usize] = a.min(b);
                    }
                }
            }
        }
        (0..self.surfaces.len() as u32)
            .map(|index| root(&mut parents, index))
            .collect()
    }

    /// Whether the component of each surface is large enough and does not stand above others.
    fn lowest(&self, components: &[u32]) -> Vec<bool> {
        let mut cells = vec![0_usize; components.len()];
        let (mut rim, mut above) = (cells.clone(), cells.clone());
        for &component in components {
            cells[component as usize] += 1;
        }
        for (index, surface) in self.surfaces.iter().enumerate() {
            let own = components[index];
            let is_own = |other: usize| components[other] == own;
            let has_own = |(columns, rows): (i32, i32)| {
                let mut others = self.in_cell(surface.column + columns, surface.row + rows);
                others.any(is_own)
            };
            if [(1, 0), (-1, 0), (0, 1), (0, -1)].into_iter().all(has_own) {
                continue;
            }
            let has_below = |(columns, rows): (i32, i32)| {
                let mut others = self.in_cell(surface.column + columns, surface.row + rows);
                others.any(|other| {
                    !is_own(other)
                        && cells[components[other] as usize] >= MIN_CELLS
                        && self.surfaces[other].high_m < surface.low_m - BELOW_M
                })
            };
            rim[own as usize] += 1;
            above[own as usize] += usize::from(cells_within(RIM_CELLS).any(has_below));
        }
        let is_ground = |&component: &u32| {
            let component = component as usize;
            cells[component] >= MIN_CELLS && 2 * above[component] < rim[component].max(1)
        };
        components.iter().map(is_ground).collect()
    }
}

/// Clusters samples (column, row, height) of each cell.
fn surfaces_of(mut samples: Vec<(i32, i32, f32)>) -> Vec<CellSurface> {
    samples.sort_unstable_by(|a, b| (a.0, a.1).cmp(&(b.0, b.1)).then(a.2.total_cmp(&b.2)));
    let mut surfaces: Vec<CellSurface> = Vec::new();
    for (column, row, height_m) in samples {
        match surfaces.last_mut() {
            Some(last)
                if (last.column, last.row) == (column, row) && height_m - last.high_m < GAP_M =>
            {
                last.high_m = height_m;
            }
            _ => surfaces.push(CellSurface {
                column,
                row,
                low_m: height_m,
                high_m: height_m,
            }),
        }
    }
    surfaces
}

/// Offsets of the cells within a radius, that of the cell itself included.
fn cells_within(radius: i32) -> impl Iterator<Item = (i32, i32)> {
    let all = (-radius..=radius).flat_map(move |x| (-radius..=radius).map(move |y| (x, y)));
    all.filter(move |(x, y)| x * x + y * y <= radius * radius)
}

/// Root of a tree of the union-find, whose paths are halved.
pub(crate) fn root(parents: &mut [u32], mut index: u32) -> u32 {
    while parents[index as usize] != index {
        parents[index as usize] = parents[parents[index as usize] as usize];
        index = parents[index as usize];
    }
    index
}

fn cell_of(position: Vec3) -> (i32, i32) {
    let [x, y, _] = position.to_array().map(f64::from);
    let (column, row) = heights::cell_of(Point2::new(x, y), CELL_M);
    (column as i32, row as i32)
}

fn is_level(normal: Vec3) -> bool {
    normal.z.abs() > LEVEL_COSINE * normal.length()
}

fn centroid([a, b, c]: [Vec3; 3]) -> Vec3 {
    (a + b + c) / 3.0
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two triangles of either winding over a rectangle at heights that rise along x.
    fn sheet(mesh: &mut TriangleMesh, x: [f32; 2], y: [f32; 2], z: [f32; 2]) {
        let steps = 8;
        for i in 0..steps {
            let at = |i: i32| (i as f32) / steps as f32;
            let [x0, x1] = [i, i + 1].map(|i| x[0] + at(i) * (x[1] - x[0]));
            let [z0, z1] = [i, i + 1].map(|i| z[0] + at(i) * (z[1] - z[0]));
            let first = mesh.vertices.len() as u32;
            mesh.vertices.extend([
                Vec3::new(x0, y[0], z0),
                Vec3::new(x1, y[0], z1),
                Vec3::new(x1, y[1], z1),
                Vec3::new(x0, y[1], z0),
            ]);
            mesh.triangles
                .extend([[0, 1, 2], [0, 3, 2]].map(|t| t.map(|v| first + v)));
        }
    }

    /// Shares of the triangles of each sheet that are ground.
    fn ground_of(sheets: &[([f32; 2], [f32; 2], [f32; 2])]) -> Vec<bool> {
        let mut mesh = TriangleMesh::default();
        for &(x, y, z) in sheets {
            sheet(&mut mesh, x, y, z);
        }
        let ground = GroundSurface::of_mesh(&mesh);
        let shares = (0..sheets.len()).map(|sheet| {
            let triangles = 16 * sheet..16 * (sheet + 1);
            let count = triangles.filter(|&t| ground.has_triangle(&mesh, t)).count();
            assert!(count == 0 || count == 16, "{count} of sheet {sheet}");
            count == 16
        });
        shares.collect()
    }

    #[test]
    fn a_road_with_ramp_and_lawn_is_ground_and_roofs_and_ceilings_are_not() {
        let road = ([0.0, 40.0], [-5.0, 5.0], [0.0, 0.0]);
        let ramp = ([40.0, 80.0], [-5.0, 5.0], [0.0, 6.0]);
        let lawn = ([0.0, 40.0], [5.0, 30.0], [0.15, 0.15]);
        let car = ([10.0, 13.0], [-1.0, 1.0], [1.5, 1.5]);
        let house = ([5.0, 30.0], [8.0, 20.0], [7.0, 7.0]);
        let ceiling = ([0.0, 20.0], [-5.0, 5.0], [3.0, 3.0]);
        let found = ground_of(&[road, ramp, lawn, car, house, ceiling]);
        assert_eq!(found, [true, true, true, false, false, false]);
    }

    #[test]
    fn both_levels_of_a_bridge_with_ramps_are_ground() {
        let below = ([-5.0, 5.0], [-40.0, 40.0], [0.0, 0.0]);
        let up = ([-70.0, -10.0], [-4.0, 4.0], [0.0, 6.0]);
        let deck = ([-10.0, 10.0], [-4.0, 4.0], [6.0, 6.0]);
        let down = ([10.0, 70.0], [-4.0, 4.0], [6.0, 0.0]);
        let cross = ([-70.0, 70.0], [4.0, 40.0], [0.0, 0.0]);
        assert_eq!(ground_of(&[below, up, deck, down, cross]), [true; 5]);
    }

    #[test]
    fn walls_and_small_pieces_have_no_ground() {
        let wall = ([0.0, 2.0], [0.0, 30.0], [0.0, 20.0]);
        let piece = ([0.0, 1.0], [0.0, 1.0], [0.0, 0.0]);
        assert_eq!(ground_of(&[wall, piece]), [false, false]);
        assert!(GroundSurface::of_points(&[], &[]).area_m2() == 0.0);
    }
}
