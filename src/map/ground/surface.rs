//! Ground of a mesh or cloud without marks: the near-horizontal surfaces that do not stand above others.
//!
//! ```text
//! near horizontal    |n_z| > cos 30°, on either side
//! surfaces           per cell of c = 0.5 m, heights less than 0.3 m apart
//! connected          heights of surfaces within 1 m differ by less than 0.15 m + 0.25 · distance
//! ground             4 m² or more, and less than half of the rim has another surface below it
//! ```
//!
//! The roof of a car or house, a table or a ceiling has another surface around or below its rim; a
//! road, a bridge with its ramps, or the storeys of a car park are connected and end at walls.
//!
//! A few triangles can cover more cells than memory holds, such as those of a map in millimetres. Where they cover more
//! than [`MOST_CELLS`], c is doubled until they do not, and all of the lengths above with it. Triangles longer than
//! 500 m are clipped to the bounds of the others; those around them are compared with each other, in a second grid.

use std::ops::Range;

use foldhash::{HashMap, HashMapExt as _};
use glam::{DVec3, Vec3};
use nalgebra::Point2;

use super::heights::{self, EVERYWHERE, Window, is_artefact, is_large, rasterize};
use crate::geometry::{Aabb, TriangleMesh};
use crate::memory::{MemoryBudget, MemoryError};

/// Smallest edge of a cell [m], of which the other lengths are multiples.
const CELL_M: f64 = 0.5;

/// Largest number of cells that the near-horizontal triangles cover: 1 km² of the smallest.
const MOST_CELLS: f64 = (1_u64 << 22) as f64;

/// Largest number of rows of cells of all triangles, which are looked at one by one.
const MOST_ROWS: f64 = (1_u64 << 28) as f64;

/// Memory per cell and surface: samples, surfaces, hash table, components [bytes].
const CELL_BYTES: f64 = 100.0;

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
const MIN_CELLS: u32 = 16;

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

impl CellSurface {
    fn cell(&self) -> (i32, i32) {
        (self.column, self.row)
    }
}

/// The ground of a mesh or a cloud.
pub(crate) struct GroundSurface {
    /// Edge of a cell [m].
    cell_m: f64,
    /// The ground of large triangles outside the bounds of the others.
    outside: Option<Box<Self>>,
    /// All near-horizontal surfaces, ordered by cell and height.
    surfaces: Vec<CellSurface>,
    /// First surface of each cell and the number of its surfaces.
    cells: HashMap<(i32, i32), (u32, u32)>,
    is_ground: Vec<bool>,
}

impl GroundSurface {
    /// Detects the ground of a mesh.
    ///
    /// # Errors
    /// The cells would take more memory than the budget.
    pub fn of_mesh(mesh: &TriangleMesh, budget: MemoryBudget) -> Result<Self, MemoryError> {
        let triangles = 0..mesh.triangles.len();
        let small = (triangles.clone())
            .filter(|&triangle| !is_large(mesh.corners(triangle).map(Vec3::as_dvec3)));
        let bounds = Aabb::from_points(small.flat_map(|triangle| mesh.corners(triangle)));
        let is_outside = |triangle| {
            let corners = mesh.corners(triangle);
            is_large(corners.map(Vec3::as_dvec3)) && !is_within(&bounds, centroid(corners))
        };
        let level: Vec<usize> = triangles
            .filter(|&triangle| is_level(mesh.scaled_normal(triangle)))
            .collect();
        let mut ground = Self::of_triangles(mesh, &level, bounds, budget)?;
        if !bounds.is_empty() {
            let outside: Vec<usize> = level.into_iter().filter(|&it| is_outside(it)).collect();
            if !outside.is_empty() {
                let outside = Self::of_triangles(mesh, &outside, Aabb::EMPTY, budget)?;
                ground.outside = Some(Box::new(outside));
            }
        }
        Ok(ground)
    }

    /// Detects the ground of near-horizontal triangles within bounds, everywhere if these are empty.
    fn of_triangles(
        mesh: &TriangleMesh,
        triangles: &[usize],
        bounds: Aabb,
        budget: MemoryBudget,
    ) -> Result<Self, MemoryError> {
        let corners = |triangle: usize| mesh.corners(triangle).map(Vec3::as_dvec3);
        let sizes = (triangles.iter()).map(|&triangle| size_within(corners(triangle), &bounds));
        let (area_m2, length_m) = sizes.fold((0.0, 0.0), |sum, it| (sum.0 + it.0, sum.1 + it.1));
        let mut cell_m = CELL_M;
        while area_m2 > MOST_CELLS * cell_m * cell_m || length_m > MOST_ROWS * cell_m {
            cell_m *= 2.0;
        }
        budget.require(
            "the ground of the map",
            CELL_BYTES * area_m2 / (cell_m * cell_m),
            "cut the map into parts",
        )?;
        let window = window_of(&bounds, cell_m);
        let mut samples = Vec::new();
        for &triangle in triangles {
            let mut add = |(column, row): (i64, i64), height_m: f64| {
                samples.push((column as i32, row as i32, height_m as f32));
            };
            rasterize(corners(triangle), cell_m, window, &mut add);
            let center = centroid(mesh.corners(triangle));
            if !is_large(corners(triangle)) || bounds.is_empty() || is_within(&bounds, center) {
                let (column, row) = cell_of(center, cell_m);
                samples.push((column, row, center.z));
            }
        }
        Ok(Self::of_samples(samples, cell_m))
    }

    /// Detects the ground of points with normals.
    pub fn of_points(points: &[Vec3], normals: &[Vec3]) -> Self {
        let level = points
            .iter()
            .zip(normals)
            .filter(|(_, normal)| is_level(**normal));
        let sample = |(point, _): (&Vec3, _)| {
            let (column, row) = cell_of(*point, CELL_M);
            (column, row, point.z)
        };
        Self::of_samples(level.map(sample).collect(), CELL_M)
    }

    /// Whether a triangle of the mesh is ground.
    pub fn has_triangle(&self, mesh: &TriangleMesh, triangle: usize) -> bool {
        let center = centroid(mesh.corners(triangle));
        let is_in = |ground: &Self| ground.contains(center);
        is_level(mesh.scaled_normal(triangle))
            && (is_in(self) || self.outside.as_deref().is_some_and(is_in))
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
        let outside_m2 = self.outside.as_ref().map_or(0.0, |it| it.area_m2());
        outside_m2.max(cells as f64 * self.cell_m * self.cell_m)
    }

    /// Area of the smallest ground that is found [m²].
    pub fn smallest_m2(&self) -> f64 {
        f64::from(MIN_CELLS) * self.cell_m * self.cell_m
    }

    /// Whether a position is on a surface of the ground.
    fn contains(&self, position: Vec3) -> bool {
        self.in_cell(cell_of(position, self.cell_m)).any(|index| {
            let surface = &self.surfaces[index];
            self.is_ground[index] && (surface.low_m..=surface.high_m).contains(&position.z)
        })
    }

    fn of_samples(samples: Vec<(i32, i32, f32)>, cell_m: f64) -> Self {
        let surfaces = surfaces_of(samples, scale_of(cell_m) * GAP_M);
        let mut cells = HashMap::with_capacity(surfaces.len());
        for (index, surface) in surfaces.iter().enumerate() {
            cells
                .entry((surface.column, surface.row))
                .or_insert((index as u32, 0))
                .1 += 1;
        }
        let mut ground = Self {
            cell_m,
            outside: None,
            is_ground: vec![false; surfaces.len()],
            surfaces,
            cells,
        };
        let components = ground.components();
        ground.is_ground = ground.lowest(&components);
        ground
    }

    /// Surfaces of a cell, from the lowest.
    fn in_cell(&self, cell: (i32, i32)) -> Range<usize> {
        let (first, count) = self.cells.get(&cell).copied().unwrap_or_default();
        first as usize..(first + count) as usize
    }

    /// Surfaces of a cell that reach above one height and begin below another one [m].
    fn between(&self, cell: (i32, i32), low_m: f32, high_m: f32) -> Range<usize> {
        let all = self.in_cell(cell);
        let surfaces = &self.surfaces[all.clone()];
        let first = surfaces.partition_point(|surface| surface.high_m <= low_m);
        let end = surfaces.partition_point(|surface| surface.low_m < high_m);
        all.start + first..all.start + end.max(first)
    }

    /// Component of each surface, as one of its surfaces.
    fn components(&self) -> Vec<u32> {
        let mut parents: Vec<u32> = (0..self.surfaces.len() as u32).collect();
        for (index, surface) in self.surfaces.iter().enumerate() {
            for (columns, rows) in cells_within(LINK_CELLS).filter(|&offset| offset > (0, 0)) {
                let distance_m =
                    self.cell_m as f32 * ((columns * columns + rows * rows) as f32).sqrt();
                let step_m = scale_of(self.cell_m) * STEP_M + STEP_PER_M * distance_m;
                let cell = (surface.column + columns, surface.row + rows);
                let [low_m, high_m] = [surface.low_m - step_m, surface.high_m + step_m];
                for other in self.between(cell, low_m, high_m) {
                    let (a, b) = (
                        root(&mut parents, index as u32),
                        root(&mut parents, other as u32),
                    );
                    parents[a.max(b) as usize] = a.min(b);
                }
            }
        }
        (0..self.surfaces.len() as u32)
            .map(|index| root(&mut parents, index))
            .collect()
    }

    /// Whether the component of each surface is large enough and does not stand above others.
    fn lowest(&self, components: &[u32]) -> Vec<bool> {
        let below_m = scale_of(self.cell_m) * BELOW_M;
        let mut cells = vec![0_u32; components.len()];
        let (mut rim, mut above) = (cells.clone(), cells.clone());
        for &component in components {
            cells[component as usize] += 1;
        }
        // A cell may have as many surfaces as the mesh has triangles: they are sorted and searched by bisection.
        let mut sorted = components.to_vec();
        // The lowest surface of a large component, and the lowest of another one, of each cell at its first surface.
        let mut lowest_large: Vec<[Option<u32>; 2]> = vec![[None; 2]; components.len()];
        for of_cell in self.surfaces.chunk_by(|a, b| a.cell() == b.cell()) {
            let all = self.in_cell(of_cell[0].cell());
            let lowest = &mut lowest_large[all.start];
            sorted[all.clone()].sort_unstable();
            for index in all {
                let component = components[index];
                if cells[component as usize] < MIN_CELLS {
                    continue;
                }
                match lowest {
                    [None, _] => lowest[0] = Some(index as u32),
                    [Some(first), _] if components[*first as usize] == component => {}
                    _ => {
                        lowest[1] = Some(index as u32);
                        break;
                    }
                }
            }
        }
        for (index, surface) in self.surfaces.iter().enumerate() {
            let own = components[index];
            let neighbour = |(columns, rows)| (surface.column + columns, surface.row + rows);
            let has_own = |offset| {
                let others = &sorted[self.in_cell(neighbour(offset))];
                others.binary_search(&own).is_ok()
            };
            if [(1, 0), (-1, 0), (0, 1), (0, -1)].into_iter().all(has_own) {
                continue;
            }
            let is_below = |&other: &u32| {
                components[other as usize] != own
                    && self.surfaces[other as usize].high_m < surface.low_m - below_m
            };
            let has_below = |offset| {
                let cell = self.in_cell(neighbour(offset));
                !cell.is_empty() && lowest_large[cell.start].iter().flatten().any(is_below)
            };
            rim[own as usize] += 1;
            above[own as usize] += u32::from(cells_within(RIM_CELLS).any(has_below));
        }
        let is_ground = |&component: &u32| {
            let component = component as usize;
            cells[component] >= MIN_CELLS && 2 * above[component] < rim[component].max(1)
        };
        components.iter().map(is_ground).collect()
    }
}

/// Clusters samples (column, row, height) of each cell.
fn surfaces_of(mut samples: Vec<(i32, i32, f32)>, gap_m: f32) -> Vec<CellSurface> {
    samples.sort_unstable_by(|a, b| (a.0, a.1).cmp(&(b.0, b.1)).then(a.2.total_cmp(&b.2)));
    let mut surfaces: Vec<CellSurface> = Vec::new();
    for (column, row, height_m) in samples {
        match surfaces.last_mut() {
            Some(last)
                if (last.column, last.row) == (column, row) && height_m - last.high_m < gap_m =>
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

fn cell_of(position: Vec3, cell_m: f64) -> (i32, i32) {
    let [x, y, _] = position.to_array().map(f64::from);
    let (column, row) = heights::cell_of(Point2::new(x, y), cell_m);
    (column as i32, row as i32)
}

/// The cells of bounds; all if these are empty.
fn window_of(bounds: &Aabb, cell_m: f64) -> Window {
    if bounds.is_empty() {
        return EVERYWHERE;
    }
    [bounds.min, bounds.max].map(|corner| {
        let [x, y, _] = corner.to_array().map(f64::from);
        heights::cell_of(Point2::new(x, y), cell_m)
    })
}

/// Upper bound of the area of a triangle within bounds seen from above [m²], and its extent along y there [m].
fn size_within(corners: [DVec3; 3], bounds: &Aabb) -> (f64, f64) {
    if is_artefact(corners) {
        return (0.0, 0.0);
    }
    let [a, b, c] = corners;
    let (mut min, mut max) = (a.min(b).min(c), a.max(b).max(c));
    if !bounds.is_empty() {
        min = min.max(bounds.min.as_dvec3());
        max = max.min(bounds.max.as_dvec3());
    }
    let size = (max - min).truncate().max(glam::DVec2::ZERO);
    let area_m2 = 0.5 * (b - a).truncate().perp_dot((c - a).truncate()).abs();
    (area_m2.min(size.x * size.y), size.y)
}

/// Whether a position is within bounds, seen from above.
fn is_within(bounds: &Aabb, position: Vec3) -> bool {
    let is_inside = position.cmpge(bounds.min) & position.cmple(bounds.max);
    is_inside.x && is_inside.y
}

/// The edge of cells as a multiple of the smallest.
fn scale_of(cell_m: f64) -> f32 {
    (cell_m / CELL_M) as f32
}

fn is_level(normal: Vec3) -> bool {
    normal.z.abs() > LEVEL_COSINE * normal.length()
}

fn centroid([a, b, c]: [Vec3; 3]) -> Vec3 {
    (a + b + c) / 3.0
}

#[cfg(test)]
mod tests {
    use rand::rngs::StdRng;
    use rand::{RngExt as _, SeedableRng as _};

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
        let ground = GroundSurface::of_mesh(&mesh, MemoryBudget::default()).unwrap();
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

    /// Whether each triangle of rectangles of two triangles, and boxes on z = 0, is ground.
    fn ground_of_rectangles(rectangles: &[([f32; 4], f32)]) -> (Vec<bool>, GroundSurface) {
        let mut mesh = TriangleMesh::default();
        for &([x0, y0, x1, y1], z) in rectangles {
            let first = mesh.vertices.len() as u32;
            let corners = [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
            (mesh.vertices).extend(corners.map(|[x, y]| Vec3::new(x, y, z)));
            (mesh.triangles).extend([[0, 1, 2], [0, 2, 3]].map(|t| t.map(|v| first + v)));
        }
        let ground = GroundSurface::of_mesh(&mesh, MemoryBudget::default()).unwrap();
        let triangles = 0..mesh.triangles.len();
        let is_ground = triangles.map(|triangle| ground.has_triangle(&mesh, triangle));
        (is_ground.collect(), ground)
    }

    #[test]
    fn a_floor_of_two_large_triangles_is_ground_and_roofs_on_it_are_not() {
        let roof = ([200.0, 200.0, 220.0, 210.0], 6.0);
        for side in [600.0, 3e3, 1e5] {
            let floor = ([-side, -side, side, side], 0.0);
            let (alone, ground) = ground_of_rectangles(&[floor]);
            assert_eq!(alone, [true; 2], "{side}");
            let expected_m2 = 4.0 * f64::from(side).powi(2);
            assert!((ground.area_m2() / expected_m2 - 1.0).abs() < 0.05);
            let (found, ground) = ground_of_rectangles(&[floor, roof]);
            assert_eq!(found, [true, true, false, false], "{side}");
            assert_eq!(ground.cell_m, CELL_M);
        }
    }

    /// Which surfaces are ground, by comparing all pairs of them.
    fn by_all_pairs(surfaces: &[CellSurface]) -> Vec<bool> {
        let offset = |a: &CellSurface, b: &CellSurface| (b.column - a.column, b.row - a.row);
        let square = |(x, y): (i32, i32)| x * x + y * y;
        let mut parents: Vec<u32> = (0..surfaces.len() as u32).collect();
        for (i, a) in surfaces.iter().enumerate() {
            for (j, b) in surfaces.iter().enumerate() {
                let square = square(offset(a, b));
                let step_m = STEP_M + STEP_PER_M * CELL_M as f32 * (square as f32).sqrt();
                let apart_m = (a.low_m - b.high_m).max(b.low_m - a.high_m);
                if (1..=LINK_CELLS * LINK_CELLS).contains(&square) && apart_m < step_m {
                    let [i, j] = [i, j].map(|index| root(&mut parents, index as u32));
                    parents[i.max(j) as usize] = i.min(j);
                }
            }
        }
        let component: Vec<u32> = (0..surfaces.len() as u32)
            .map(|index| root(&mut parents, index))
            .collect();
        let size = |own: u32| component.iter().filter(|&&it| it == own).count();
        let others = || surfaces.iter().zip(&component);
        let is_ground = |&own: &u32| {
            let of_own = others().filter(|(_, it)| **it == own).map(|(a, _)| a);
            let is_rim = |a: &&CellSurface| {
                let has_own = |at| others().any(|(b, it)| *it == own && offset(a, b) == at);
                ![(1, 0), (-1, 0), (0, 1), (0, -1)].into_iter().all(has_own)
            };
            let is_above = |a: &&CellSurface| {
                others().any(|(b, it)| {
                    *it != own
                        && square(offset(a, b)) <= RIM_CELLS * RIM_CELLS
                        && size(*it) >= MIN_CELLS as usize
                        && b.high_m < a.low_m - BELOW_M
                })
            };
            let rim: Vec<&CellSurface> = of_own.filter(is_rim).collect();
            let above = rim.iter().filter(|a| is_above(a)).count();
            size(own) >= MIN_CELLS as usize && 2 * above < rim.len().max(1)
        };
        component.iter().map(is_ground).collect()
    }

    #[test]
    fn ground_is_what_comparing_all_pairs_of_surfaces_finds() {
        let mut rng = StdRng::seed_from_u64(1);
        let (mut found, mut others) = (0, 0);
        for _ in 0..20 {
            // A few sheets that slope and have holes.
            let mut samples = Vec::new();
            for _ in 0..5 {
                let [along, across] = [0, 0].map(|_| rng.random_range(-0.2..0.2_f32));
                let height_m = rng.random_range(0.0..3.0_f32);
                let [width, length] = [0, 0].map(|_| rng.random_range(2..9));
                for (column, row) in (0..width).flat_map(|x| (0..length).map(move |y| (x, y))) {
                    let z = height_m + along * column as f32 + across * row as f32;
                    if rng.random_bool(0.8) {
                        samples.push((column, row, z));
                    }
                }
            }
            let ground = GroundSurface::of_samples(samples, CELL_M);
            assert_eq!(ground.is_ground, by_all_pairs(&ground.surfaces));
            found += ground.is_ground.iter().filter(|&&it| it).count();
            others += ground.is_ground.iter().filter(|&&it| !it).count();
        }
        assert!(found > 100 && others > 100, "{found} {others}");
    }

    #[test]
    fn a_stack_of_very_many_sheets_is_looked_at_once() {
        // Each surface with each other one would be 10^10 pairs.
        let sheets = (0..100_000_u32).map(|level| ([0.0, 0.0, 1.2, 1.2], 0.5 * level as f32));
        let floor = ([-20.0, -20.0, 20.0, 20.0], -3.0);
        let rectangles: Vec<_> = std::iter::once(floor).chain(sheets).collect();
        let (found, _) = ground_of_rectangles(&rectangles);
        assert_eq!(found.iter().filter(|&&is_ground| is_ground).count(), 2);
    }

    #[test]
    fn a_floor_of_long_strips_is_ground() {
        let strip = |row: i8| {
            let y = 5.0 * f32::from(row);
            ([-500.0, y, 500.0, y + 5.0], 0.0)
        };
        let strips: Vec<_> = (-10..10).map(strip).collect();
        let roof = ([20.0, 20.0, 40.0, 30.0], 6.0);
        for rectangles in [strips.clone(), [strips, vec![roof]].concat()] {
            let (found, ground) = ground_of_rectangles(&rectangles);
            assert_eq!(found[..40], [true; 40]);
            assert!(found[40..].iter().all(|is_ground| !is_ground));
            assert!((ground.area_m2() / 1e5 - 1.0).abs() < 0.1);
        }
    }

    #[test]
    fn an_outlier_neither_is_ground_nor_makes_the_cells_of_the_others_larger() {
        let mut mesh = TriangleMesh::default();
        sheet(&mut mesh, [0.0, 40.0], [-5.0, 5.0], [0.0, 0.0]);
        let (road, first) = (mesh.triangles.len(), mesh.vertices.len() as u32);
        (mesh.vertices).extend([Vec3::ZERO, Vec3::X, Vec3::new(1e7, -1e7, 3.0)]);
        mesh.triangles.push([first, first + 1, first + 2]);
        let ground = GroundSurface::of_mesh(&mesh, MemoryBudget::default()).unwrap();
        assert_eq!(ground.cell_m, CELL_M);
        assert!((0..road).all(|triangle| ground.has_triangle(&mesh, triangle)));
        assert!((ground.area_m2() - 400.0).abs() < 20.0);
    }

    #[test]
    fn a_street_in_millimetres_has_the_ground_of_one_in_metres_within_a_budget() {
        let sheets = [
            ([0.0, 116.0], [-10.0, 10.0], [0.0, 0.0]),
            ([10.0, 30.0], [-8.0, 8.0], [7.0, 7.0]),
        ];
        let scaled = |scale: f32| {
            let mut mesh = TriangleMesh::default();
            for (x, y, z) in sheets {
                let [x, y, z] = [x, y, z].map(|ends| ends.map(|end| scale * end));
                sheet(&mut mesh, x, y, z);
            }
            mesh
        };
        let budget = MemoryBudget { bytes: 500 << 20 };
        for scale in [1.0, 1000.0] {
            let mesh = scaled(scale);
            let ground = GroundSurface::of_mesh(&mesh, budget).unwrap();
            let triangles = 0..mesh.triangles.len();
            let found: Vec<bool> = triangles.map(|it| ground.has_triangle(&mesh, it)).collect();
            assert_eq!(found, [[true; 16], [false; 16]].concat(), "{scale}");
            assert!(ground.surfaces.len() as f64 <= MOST_CELLS);
        }
        let error = GroundSurface::of_mesh(&scaled(1000.0), MemoryBudget { bytes: 10 << 20 });
        let error = error.err().unwrap().to_string();
        assert!(
            error.starts_with("the ground of the map would need"),
            "{error}"
        );
    }

    #[test]
    fn walls_and_small_pieces_have_no_ground() {
        let wall = ([0.0, 2.0], [0.0, 30.0], [0.0, 20.0]);
        let piece = ([0.0, 1.0], [0.0, 1.0], [0.0, 0.0]);
        assert_eq!(ground_of(&[wall, piece]), [false, false]);
        assert!(GroundSurface::of_points(&[], &[]).area_m2() == 0.0);
    }
}
