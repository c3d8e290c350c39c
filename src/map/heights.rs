//! Heights on a regular grid over the whole x-y plane, kept only where there are any.
//!
//! ```text
//! cell (i, j) covers [i c, (i + 1) c) × [j c, (j + 1) c)      c = edge of a cell
//! ```
//!
//! Cells lie in square blocks that are made when the first height falls into them: the memory
//! goes with the mapped area, not with the rectangle around it, which one stray vertex could make
//! as large as the Earth.
//!
//! A cell may have several levels, as where a bridge crosses a road: heights that lie farther apart
//! than a car is high are of different levels (single linkage), each of which is their mean.

use std::collections::HashMap;

use nalgebra::{Point2, Vector3};

use crate::geometry::Vec3;

/// Cells along the edge of a block.
const BLOCK_CELLS: i64 = 64;

/// A longer edge than this is no edge of a road's surface, but a damaged map's [m].
const LONGEST_EDGE_M: f64 = 500.0;

/// Nothing drives where there is less room than this above the road: heights that are nearer to each
/// other belong to one level [m].
pub(super) const LEVEL_GAP_M: f64 = 2.0;

/// Column and row of a cell.
type Cell = (i64, i64);

/// Values of cells, in blocks.
#[derive(Clone, Debug, PartialEq)]
struct Blocks<T> {
    of: HashMap<Cell, Box<[T]>>,
}

impl<T: Clone> Blocks<T> {
    fn address((column, row): Cell) -> (Cell, usize) {
        let block = (column.div_euclid(BLOCK_CELLS), row.div_euclid(BLOCK_CELLS));
        let within = row.rem_euclid(BLOCK_CELLS) * BLOCK_CELLS + column.rem_euclid(BLOCK_CELLS);
        (block, within as usize)
    }

    fn entry(&mut self, cell: Cell, empty: T) -> &mut T {
        let (block, within) = Self::address(cell);
        let fresh = || vec![empty; (BLOCK_CELLS * BLOCK_CELLS) as usize].into_boxed_slice();
        &mut self.of.entry(block).or_insert_with(fresh)[within]
    }
}

/// The heights of a block of cells: the lowest of each cell, those above it, and so on; not a number
/// where a cell has no such level [m].
type Levels = Vec<Box<[f32]>>;

/// Heights of cells; many cells have none, a few have several.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Heights {
    /// Edge of a cell [m].
    pub cell_m: f64,
    blocks: HashMap<Cell, Levels>,
}

/// Heights of a cell that belong together.
#[derive(Clone, Debug)]
struct Level {
    low_m: f64,
    high_m: f64,
    sum_m: f64,
    count: f64,
}

impl Level {
    /// Adds a height to the levels of a cell: to the one that it is near to, or as a new one. Levels
    /// that a height brings together become one.
    fn add(levels: &mut Vec<Self>, height_m: f64) {
        let mut added = Self {
            low_m: height_m,
            high_m: height_m,
            sum_m: height_m,
            count: 1.0,
        };
        levels.retain(|level| {
            let is_near =
                level.low_m - LEVEL_GAP_M < height_m && height_m < level.high_m + LEVEL_GAP_M;
            if is_near {
                added.low_m = added.low_m.min(level.low_m);
                added.high_m = added.high_m.max(level.high_m);
                added.sum_m += level.sum_m;
                added.count += level.count;
            }
            !is_near
        });
        let place = levels.partition_point(|level| level.high_m < added.low_m);
        levels.insert(place, added);
    }
}

impl Heights {
    /// The mean height of the surface of triangles in each cell whose centre they cover, and of
    /// their corners in the cells of those; of every level of its own.
    pub fn of_triangles(corners: impl Iterator<Item = [Vec3; 3]>, cell_m: f64) -> Self {
        let mut levels = Blocks { of: HashMap::new() };
        for corners in corners {
            rasterize(corners, cell_m, |cell, height_m| {
                Level::add(levels.entry(cell, Vec::new()), height_m);
            });
        }
        let means = |(block, cells): (Cell, Box<[Vec<Level>]>)| {
            let most = cells.iter().map(Vec::len).max().unwrap_or(0);
            let mean = |level: &Level| (level.sum_m / level.count) as f32;
            let of_level = |number: usize| {
                let heights = cells
                    .iter()
                    .map(|levels| levels.get(number).map_or(f32::NAN, mean));
                heights.collect()
            };
            (block, (0..most).map(of_level).collect())
        };
        Self {
            cell_m,
            blocks: levels.of.into_iter().map(means).collect(),
        }
    }

    /// One height for every cell of a rectangle.
    pub fn flat(min: Point2<f64>, max: Point2<f64>, height_m: f64, cell_m: f64) -> Self {
        let mut blocks = Blocks { of: HashMap::new() };
        let (first, last) = (cell_of(min, cell_m), cell_of(max, cell_m));
        for row in first.1..=last.1 {
            for column in first.0..=last.0 {
                *blocks.entry((column, row), f32::NAN) = height_m as f32;
            }
        }
        Self {
            cell_m,
            blocks: (blocks.of.into_iter())
                .map(|(block, heights)| (block, vec![heights]))
                .collect(),
        }
    }

    /// The cell that a place falls into; `None` where there is no such place.
    pub fn cell_at(&self, x: f64, y: f64) -> Option<Cell> {
        (x.is_finite() && y.is_finite()).then(|| cell_of(Point2::new(x, y), self.cell_m))
    }

    /// The middle of a cell.
    pub fn center(&self, (column, row): Cell) -> Point2<f64> {
        center_of((column, row), self.cell_m)
    }

    /// Reads heights of cells near each other.
    pub fn reader(&self) -> Reader<'_> {
        Reader {
            heights: self,
            block: None,
        }
    }
}

/// Remembers the block that it read last: neighbours mostly lie in the same one.
pub(super) struct Reader<'a> {
    heights: &'a Heights,
    block: Option<(Cell, &'a [Box<[f32]>])>,
}

impl Reader<'_> {
    /// The heights of a cell, from the lowest level up [m].
    pub fn levels_m(&mut self, cell: Cell) -> impl Iterator<Item = f64> {
        let (block, within) = Blocks::<f32>::address(cell);
        let levels = match self.block {
            Some((last, levels)) if last == block => levels,
            _ => {
                let levels = self
                    .heights
                    .blocks
                    .get(&block)
                    .map_or(&[][..], Vec::as_slice);
                self.block = Some((block, levels));
                levels
            }
        };
        levels
            .iter()
            .map(move |cells| f64::from(cells[within]))
            .take_while(|height_m| !height_m.is_nan())
    }

    /// The level of a cell that is nearest to a height [m]; `None` where no height is known.
    pub fn nearest_m(&mut self, cell: Cell, height_m: f64) -> Option<f64> {
        self.levels_m(cell)
            .min_by(|a, b| (a - height_m).abs().total_cmp(&(b - height_m).abs()))
    }
}

fn cell_of(place: Point2<f64>, cell_m: f64) -> Cell {
    let cell = |along: f64| (along / cell_m).floor() as i64;
    (cell(place.x), cell(place.y))
}

fn center_of((column, row): Cell, cell_m: f64) -> Point2<f64> {
    Point2::new((column as f64 + 0.5) * cell_m, (row as f64 + 0.5) * cell_m)
}

/// Tells the height of a triangle in the cells whose centre it covers, and of its corners in
/// theirs.
fn rasterize(corners: [Vec3; 3], cell_m: f64, mut add: impl FnMut(Cell, f64)) {
    let [a, b, c] = corners.map(|corner| Vector3::new(corner.x, corner.y, corner.z).cast::<f64>());
    let (ab, ac) = (b - a, c - a);
    if ab.xy().norm().max(ac.xy().norm()) > LONGEST_EDGE_M {
        return;
    }
    for corner in [a, b, c] {
        add(cell_of(corner.xy().into(), cell_m), corner.z);
    }
    let area = ab.x * ac.y - ab.y * ac.x;
    if area.abs() <= 1e-12 {
        return;
    }
    let first = cell_of(a.inf(&b).inf(&c).xy().into(), cell_m);
    let last = cell_of(a.sup(&b).sup(&c).xy().into(), cell_m);
    for row in first.1..=last.1 {
        for column in first.0..=last.0 {
            let center = center_of((column, row), cell_m);
            let (x, y) = (center.x - a.x, center.y - a.y);
            let u = (x * ac.y - y * ac.x) / area;
            let v = (ab.x * y - ab.y * x) / area;
            if u >= 0.0 && v >= 0.0 && u + v <= 1.0 {
                add((column, row), a.z + u * ab.z + v * ac.z);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_centre_falls_into_its_own_cell_on_either_side_of_the_origin() {
        let heights = Heights::flat(Point2::origin(), Point2::origin(), 0.0, 0.5);
        for cell in [(0, 0), (-1, 63), (64, -64), (-65, 1_000_000)] {
            let center = heights.center(cell);
            assert_eq!(heights.cell_at(center.x, center.y), Some(cell));
        }
    }

    #[test]
    fn a_stray_triangle_costs_no_more_than_its_own_blocks() {
        let near = [Vec3::ZERO, Vec3::X, Vec3::Y];
        let far = near.map(|corner| corner + Vec3::new(1.0e9, -1.0e9, 0.0));
        let endless = [Vec3::ZERO, Vec3::X, Vec3::new(0.0, 1.0e30, 0.0)];
        let heights = Heights::of_triangles([near, far, endless].into_iter(), 0.25);
        assert_eq!(heights.blocks.len(), 2);
        assert_eq!(heights.reader().nearest_m((1, 1), 5.0), Some(0.0));
        assert_eq!(heights.reader().nearest_m((1000, 1), 0.0), None);
    }

    #[test]
    fn heights_a_car_apart_are_levels_and_what_lies_between_brings_them_together() {
        let slab =
            |height: f32| [Vec3::ZERO, Vec3::X, Vec3::Y].map(|corner| corner + Vec3::Z * height);
        let levels = |heights_m: &[f32]| {
            let heights = Heights::of_triangles(heights_m.iter().map(|&height| slab(height)), 0.25);
            heights.reader().levels_m((0, 0)).collect::<Vec<_>>()
        };
        assert_eq!(levels(&[6.0, 0.0, 6.5, 0.5]), [0.25, 6.25]);
        assert_eq!(levels(&[12.0, 6.0, 0.0]), [0.0, 6.0, 12.0]);
        assert_eq!(levels(&[0.0, 3.0, 1.5]), [1.5]);
        assert_eq!(levels(&[1.5, 3.0, 0.0]), [1.5]);
    }

    #[test]
    fn a_reader_gives_the_same_heights_in_any_order() {
        let climbing = [
            Vec3::new(-40.0, -40.0, -4.0),
            Vec3::new(40.0, -40.0, 4.0),
            Vec3::new(-40.0, 40.0, -4.0),
        ];
        let heights = Heights::of_triangles([climbing].into_iter(), 0.5);
        let mut reader = heights.reader();
        for cell in [(-1, -1), (63, -70), (-70, 63), (-1, -1), (900, 900)] {
            let fresh = heights.reader().nearest_m(cell, 0.0);
            assert_eq!(reader.nearest_m(cell, 0.0), fresh);
        }
        let expected_m = 0.1 * heights.center((63, -70)).x;
        assert!((reader.nearest_m((63, -70), 0.0).unwrap() - expected_m).abs() < 1e-6);
    }
}
