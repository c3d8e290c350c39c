//! Multi-level surface map: heights on a regular grid over the whole x-y plane, sparse.
//!
//! ```text
//! cell (i, j) covers [i c, (i + 1) c) × [j c, (j + 1) c)      c = edge of a cell
//! ```
//!
//! Cells are stored in square chunks. Those of tiles are made with the tiles; those of a map in memory are made of its
//! triangles when they are requested ([`GroundTriangles`]): a triangle may cover a square kilometre.
//!
//! A cell may have several levels, as where a bridge crosses a road (Triebel, Pfaff and Burgard,
//! *Multi-Level Surface Maps for Outdoor Terrain Mapping and Loop Closing*, IROS 2006): the heights of
//! a cell are clustered by single linkage, and each level is the mean of a cluster.

use std::collections::BTreeMap;
use std::fmt::Debug;
use std::sync::{Arc, PoisonError, RwLock};

use foldhash::HashMap;
use glam::DVec3;
use nalgebra::{Point2, Vector2, Vector3};

use crate::raycasting::TileError;
use crate::shared_bytes::SharedBytes;

/// Cells along the edge of a chunk.
const CHUNK_CELLS: i64 = 64;

/// Triangles with longer edges are large [m].
const LARGE_EDGE_M: f64 = 500.0;

/// A large triangle that is narrower than this share of its longest edge has a lost vertex, unless it may be one of a
/// straight road (unitless).
const NARROW: f64 = 0.01;

/// Smallest width of a triangle of a road: no lane is narrower [m].
const LANE_M: f64 = 2.0;

/// Longest edge of a triangle of a road [m].
const STRAIGHT_M: f64 = 2000.0;

/// Largest size of the chunks that a map in memory keeps, of about 16 kB per level each [bytes].
const KEPT_BYTES: usize = 1 << 26;

/// Largest number of levels of a cell, of which further ones are left out: those of a car park are fewer.
const MOST_LEVELS: usize = 32;

/// Smallest distance of two levels, less than the clearance that any vehicle needs [m].
pub(crate) const LEVEL_GAP_M: f64 = 2.0;

/// Edge of a cell of the ground of a map [m].
pub(crate) const GROUND_CELL_M: f64 = 0.5;

/// Cells of a chunk.
const CELLS: usize = (CHUNK_CELLS * CHUNK_CELLS) as usize;

/// Column and row of a cell, or of a chunk.
pub(crate) type Cell = (i64, i64);

/// Heights of the levels of all cells. Clones share them.
#[derive(Clone, Debug)]
pub(crate) struct Heights {
    /// Edge of a cell [m].
    pub cell_m: f64,
    chunks: Arc<dyn ChunkSource>,
}

/// Supplies chunks: level by level the heights of their cells [m], the lowest level of each cell first; NaN where a
/// cell has no such level.
pub(crate) trait ChunkSource: Debug + Send + Sync {
    /// The numbers of a chunk, `f32`; `None` where there is no ground.
    ///
    /// # Errors
    /// That of the tile of the chunk, each time it is requested.
    fn chunk(&self, chunk: Cell) -> Result<Option<SharedBytes>, TileError>;
}

/// Chunks by their columns and rows.
pub(crate) type Chunks = BTreeMap<Cell, SharedBytes>;

/// The first and the last cell of a rectangle.
pub(crate) type Window = [Cell; 2];

/// The window of all cells.
pub(crate) const EVERYWHERE: Window = [(i64::MIN, i64::MIN), (i64::MAX, i64::MAX)];

/// Triangles in memory, whose chunks are made when they are requested: the memory is proportional to the number of
/// triangles, not to the area that they cover.
#[derive(Debug)]
pub(crate) struct GroundTriangles {
    corners: Vec<[DVec3; 3]>,
    cell_m: f64,
    /// Triangles by the squares of `2^level` chunks along the edge that they reach; the level of a triangle is the
    /// lowest at which it reaches at most two by two.
    squares: BTreeMap<u32, HashMap<Cell, Vec<u32>>>,
    made: RwLock<MadeChunks>,
}

/// Chunks that were made, and their size [bytes].
#[derive(Debug, Default)]
struct MadeChunks {
    chunks: HashMap<Cell, Option<SharedBytes>>,
    bytes: usize,
}

impl GroundTriangles {
    pub fn new(corners: Vec<[DVec3; 3]>, cell_m: f64) -> Self {
        let mut squares: BTreeMap<u32, HashMap<Cell, Vec<u32>>> = BTreeMap::new();
        for (corners, triangle) in corners.iter().zip(0..) {
            let Some([first, last]) = chunks_around(*corners, cell_m) else {
                continue;
            };
            let at = |(column, row): Cell, level: u32| (column >> level, row >> level);
            let is_near = |level: &u32| {
                let (first, last) = (at(first, *level), at(last, *level));
                last.0.abs_diff(first.0).max(last.1.abs_diff(first.1)) <= 1
            };
            let level = (0..i64::BITS).find(is_near).unwrap_or(i64::BITS - 1);
            let (first, last) = (at(first, level), at(last, level));
            let squares = squares.entry(level).or_default();
            for row in first.1..=last.1 {
                for column in first.0..=last.0 {
                    squares.entry((column, row)).or_default().push(triangle);
                }
            }
        }
        Self {
            corners,
            cell_m,
            squares,
            made: RwLock::default(),
        }
    }

    fn make(&self, chunk: Cell) -> Option<SharedBytes> {
        let reaching = self.squares.iter().filter_map(|(level, squares)| {
            let square = (chunk.0 >> level, chunk.1 >> level);
            squares.get(&square)
        });
        let mut triangles: Vec<u32> = reaching.flatten().copied().collect();
        // The order of the heights of a cell decides their rounded mean.
        triangles.sort_unstable();
        let corners = (triangles.into_iter()).map(|triangle| self.corners[triangle as usize]);
        chunks_of_triangles(corners, self.cell_m, window_of(chunk, chunk)).remove(&chunk)
    }
}

impl ChunkSource for GroundTriangles {
    fn chunk(&self, chunk: Cell) -> Result<Option<SharedBytes>, TileError> {
        /// Size of an entry without ground [bytes].
        const ENTRY_BYTES: usize = 64;
        let made = self.made.read().unwrap_or_else(PoisonError::into_inner);
        if let Some(made) = made.chunks.get(&chunk) {
            return Ok(made.clone());
        }
        drop(made);
        let made = self.make(chunk);
        let mut all = self.made.write().unwrap_or_else(PoisonError::into_inner);
        if all.bytes >= KEPT_BYTES {
            *all = MadeChunks::default();
        }
        all.bytes += ENTRY_BYTES + made.as_deref().map_or(0, <[u8]>::len);
        all.chunks.insert(chunk, made.clone());
        Ok(made)
    }
}

impl Heights {
    /// Heights that a source supplies.
    pub fn over(chunks: Arc<dyn ChunkSource>, cell_m: f64) -> Self {
        Self { cell_m, chunks }
    }

    /// Returns the cell of a position; `None` if a coordinate is not finite.
    pub fn cell_at(&self, x: f64, y: f64) -> Option<Cell> {
        (x.is_finite() && y.is_finite()).then(|| cell_of(Point2::new(x, y), self.cell_m))
    }

    /// Returns the centre of a cell.
    pub fn center(&self, cell: Cell) -> Point2<f64> {
        center_of(cell, self.cell_m)
    }

    /// Returns a reader that is fast for neighbouring cells.
    pub fn reader(&self) -> HeightReader<'_> {
        HeightReader {
            heights: self,
            last: None,
        }
    }
}

/// The chunks of triangles, in any order, with heights in a window.
pub(crate) fn chunks_of_triangles(
    corners: impl Iterator<Item = [DVec3; 3]>,
    cell_m: f64,
    window: Window,
) -> Chunks {
    let mut samples = HeightSamples::default();
    for corners in corners {
        rasterize(corners, cell_m, window, &mut |cell, height_m| {
            samples.add(cell, height_m)
        });
    }
    samples.into_chunks()
}

/// Reads heights and keeps the last chunk: neighbouring cells mostly share one.
pub(crate) struct HeightReader<'a> {
    heights: &'a Heights,
    last: Option<(Cell, Option<SharedBytes>)>,
}

impl HeightReader<'_> {
    /// Returns the levels of a cell, the lowest first [m].
    pub fn levels_m(&mut self, cell: Cell) -> Result<impl Iterator<Item = f64>, TileError> {
        let (chunk, offset) = chunk_of(cell);
        if !matches!(&self.last, Some((last, _)) if *last == chunk) {
            self.last = Some((chunk, self.heights.chunks.chunk(chunk)?));
        }
        let bytes = self.last.as_ref().and_then(|(_, bytes)| bytes.as_deref());
        let heights_m: &[f32] = bytes.map_or(&[], bytemuck::cast_slice);
        Ok(heights_m
            .chunks_exact(CELLS)
            .map(move |cells| f64::from(cells[offset]))
            .take_while(|height_m| !height_m.is_nan()))
    }

    /// Returns the level of a cell nearest to a height [m]; `None` in a cell without ground.
    pub fn nearest_m(&mut self, cell: Cell, height_m: f64) -> Result<Option<f64>, TileError> {
        let levels_m = self.levels_m(cell)?;
        Ok(levels_m.min_by(|a, b| (a - height_m).abs().total_cmp(&(b - height_m).abs())))
    }
}

/// Clusters of heights per cell, in chunks.
#[derive(Default)]
struct HeightSamples {
    chunks: HashMap<Cell, Box<[Vec<HeightCluster>]>>,
}

/// A cluster of the heights of a cell.
#[derive(Clone)]
struct HeightCluster {
    low_m: f64,
    high_m: f64,
    sum_m: f64,
    count: f64,
}

impl HeightSamples {
    /// Adds a height to the cell's cluster within [`LEVEL_GAP_M`], or as a new cluster. Clusters that
    /// it connects are merged.
    fn add(&mut self, cell: Cell, height_m: f64) {
        let (chunk, offset) = chunk_of(cell);
        let empty = || vec![Vec::new(); CELLS].into();
        let clusters = &mut self.chunks.entry(chunk).or_insert_with(empty)[offset];
        let mut added = HeightCluster {
            low_m: height_m,
            high_m: height_m,
            sum_m: height_m,
            count: 1.0,
        };
        clusters.retain(|cluster| {
            let is_near =
                cluster.low_m - LEVEL_GAP_M < height_m && height_m < cluster.high_m + LEVEL_GAP_M;
            if is_near {
                added.low_m = added.low_m.min(cluster.low_m);
                added.high_m = added.high_m.max(cluster.high_m);
                added.sum_m += cluster.sum_m;
                added.count += cluster.count;
            }
            !is_near
        });
        if clusters.len() < MOST_LEVELS {
            let index = clusters.partition_point(|cluster| cluster.high_m < added.low_m);
            clusters.insert(index, added);
        }
    }

    fn into_chunks(self) -> Chunks {
        let mean_m = |cluster: &HeightCluster| (cluster.sum_m / cluster.count) as f32;
        let levels = |cells: &[Vec<HeightCluster>]| {
            let most = cells.iter().map(Vec::len).max().unwrap_or(0);
            let level_m = |clusters: &Vec<_>, level| clusters.get(level).map_or(f32::NAN, mean_m);
            let heights_m: Vec<f32> = (0..most)
                .flat_map(|level| cells.iter().map(move |cell| level_m(cell, level)))
                .collect();
            SharedBytes::from(bytemuck::cast_slice(&heights_m))
        };
        (self.chunks.into_iter())
            .map(|(chunk, cells)| (chunk, levels(&cells)))
            .collect()
    }
}

/// Returns the chunk of a cell and the cell's index in it.
fn chunk_of((column, row): Cell) -> (Cell, usize) {
    let chunk = (column.div_euclid(CHUNK_CELLS), row.div_euclid(CHUNK_CELLS));
    let offset = row.rem_euclid(CHUNK_CELLS) * CHUNK_CELLS + column.rem_euclid(CHUNK_CELLS);
    (chunk, offset as usize)
}

/// The chunks that a triangle may have heights in; none for an artefact.
pub(crate) fn chunks_reached(corners: [DVec3; 3], cell_m: f64) -> impl Iterator<Item = Cell> {
    let around = chunks_around(corners, cell_m).into_iter();
    around.flat_map(|[first, last]| {
        let columns = move |row| (first.0..=last.0).map(move |column| (column, row));
        (first.1..=last.1).flat_map(columns)
    })
}

/// The first and the last of the chunks around a triangle; `None` for an artefact.
fn chunks_around(corners: [DVec3; 3], cell_m: f64) -> Option<[Cell; 2]> {
    let [a, b, c] = corners;
    let bounds = [a.min(b).min(c), a.max(b).max(c)];
    (!is_artefact(corners)).then(|| bounds.map(|corner| chunk_at(corner, cell_m)))
}

/// The chunk of a position.
pub(crate) fn chunk_at(position: DVec3, cell_m: f64) -> Cell {
    chunk_of(cell_of(Point2::new(position.x, position.y), cell_m)).0
}

/// The cells from those of one chunk to those of another.
pub(crate) fn window_of(first: Cell, last: Cell) -> Window {
    let end = |chunk: i64| (chunk * CHUNK_CELLS).saturating_add(CHUNK_CELLS - 1);
    [
        (first.0 * CHUNK_CELLS, first.1 * CHUNK_CELLS),
        (end(last.0), end(last.1)),
    ]
}

/// Whether a triangle has an edge that few surfaces of roads have.
pub(crate) fn is_large([a, b, c]: [DVec3; 3]) -> bool {
    (b - a).truncate().length().max((c - a).truncate().length()) > LARGE_EDGE_M
}

/// Whether a triangle is large and narrow, seen from above.
pub(crate) fn is_artefact(corners: [DVec3; 3]) -> bool {
    let [a, b, c] = corners.map(DVec3::truncate);
    let longest_m = (b - a).length().max((c - a).length()).max((c - b).length());
    let width_m = (b - a).perp_dot(c - a).abs() / longest_m;
    let is_of_road = width_m >= LANE_M && longest_m <= STRAIGHT_M;
    is_large(corners) && width_m < NARROW * longest_m && !is_of_road
}

/// Middle of a chunk of cells of an edge.
pub(crate) fn middle_of_chunk((column, row): Cell, cell_m: f64) -> Point2<f64> {
    let edge_m = CHUNK_CELLS as f64 * cell_m;
    Point2::new((column as f64 + 0.5) * edge_m, (row as f64 + 0.5) * edge_m)
}

/// Cell of a position.
pub(crate) fn cell_of(position: Point2<f64>, cell_m: f64) -> Cell {
    let cell = |along: f64| (along / cell_m).floor() as i64;
    (cell(position.x), cell(position.y))
}

fn center_of((column, row): Cell, cell_m: f64) -> Point2<f64> {
    Point2::new((column as f64 + 0.5) * cell_m, (row as f64 + 0.5) * cell_m)
}

/// Adds the heights of a triangle at the centres of cells that it covers, and those of its corners, in a window. An
/// artefact has none.
pub(crate) fn rasterize(
    corners: [DVec3; 3],
    cell_m: f64,
    [low, high]: Window,
    add: &mut impl FnMut(Cell, f64),
) {
    if is_artefact(corners) {
        return;
    }
    let [a, b, c] = corners.map(|corner| Vector3::from(corner.to_array()));
    let (ab, ac) = (b - a, c - a);
    for corner in [a, b, c] {
        let (column, row) = cell_of(corner.xy().into(), cell_m);
        if (low.0..=high.0).contains(&column) && (low.1..=high.1).contains(&row) {
            add((column, row), corner.z);
        }
    }
    let area = ab.x * ac.y - ab.y * ac.x;
    if area.abs() <= 1e-12 {
        return;
    }
    let first = cell_of(a.inf(&b).inf(&c).xy().into(), cell_m);
    let last = cell_of(a.sup(&b).sup(&c).xy().into(), cell_m);
    let (first, last) = (
        (first.0.max(low.0), first.1.max(low.1)),
        (last.0.min(high.0), last.1.min(high.1)),
    );
    for row in first.1..=last.1 {
        let y = center_of((0, row), cell_m).y - a.y;
        let (from, to) = row_part([ab.xy(), ac.xy()], area, y);
        // Rounding moves an end by less than a cell.
        let column_at = |x: f64| ((a.x + x) / cell_m).floor() as i64;
        let (from, to) = (column_at(from - cell_m), column_at(to + cell_m));
        for column in first.0.max(from)..=last.0.min(to) {
            let x = center_of((column, row), cell_m).x - a.x;
            let u = (x * ac.y - y * ac.x) / area;
            let v = (ab.x * y - ab.y * x) / area;
            if u >= 0.0 && v >= 0.0 && u + v <= 1.0 {
                add((column, row), a.z + u * ab.z + v * ac.z);
            }
        }
    }
}

/// Ends of the part of the line of a `y` that is in a triangle, from its first corner.
fn row_part([ab, ac]: [Vector2<f64>; 2], area: f64, y: f64) -> (f64, f64) {
    let (u, v) = ((ac.y, -y * ac.x), (-ab.y, ab.x * y));
    let w = (-u.0 - v.0, area - u.1 - v.1);
    let mut part = (f64::NEG_INFINITY, f64::INFINITY);
    // Barycentric coordinates, times the area: slope · x + offset.
    for (slope, offset) in [u, v, w] {
        let zero = -offset / slope;
        if slope != 0.0 && (slope > 0.0) == (area > 0.0) {
            part.0 = part.0.max(zero);
        } else if slope != 0.0 {
            part.1 = part.1.min(zero);
        }
    }
    part
}

#[cfg(test)]
mod tests {
    use super::*;

    impl ChunkSource for Chunks {
        fn chunk(&self, chunk: Cell) -> Result<Option<SharedBytes>, TileError> {
            Ok(self.get(&chunk).cloned())
        }
    }

    impl Heights {
        /// Averages the heights of triangles per cell and level: one sample in each cell whose centre a
        /// triangle covers, and one at each of its corners.
        pub fn of_triangles(corners: impl Iterator<Item = [DVec3; 3]>, cell_m: f64) -> Self {
            Self::over(
                Arc::new(GroundTriangles::new(corners.collect(), cell_m)),
                cell_m,
            )
        }

        /// One height for every cell of a rectangle.
        pub fn flat(min: Point2<f64>, max: Point2<f64>, height_m: f64, cell_m: f64) -> Self {
            let mut samples = HeightSamples::default();
            let (first, last) = (cell_of(min, cell_m), cell_of(max, cell_m));
            for row in first.1..=last.1 {
                for column in first.0..=last.0 {
                    samples.add((column, row), height_m);
                }
            }
            Self::over(Arc::new(samples.into_chunks()), cell_m)
        }
    }

    #[test]
    fn the_center_of_a_cell_is_in_the_cell_on_both_sides_of_the_origin() {
        let heights = Heights::flat(Point2::origin(), Point2::origin(), 0.0, 0.5);
        for cell in [(0, 0), (-1, 63), (64, -64), (-65, 1_000_000)] {
            let center = heights.center(cell);
            assert_eq!(heights.cell_at(center.x, center.y), Some(cell));
        }
    }

    #[test]
    fn an_outlier_triangle_allocates_only_its_own_chunks() {
        let near = [DVec3::ZERO, DVec3::X, DVec3::Y];
        let far = near.map(|corner| corner + DVec3::new(1.0e9, -1.0e9, 0.0));
        let degenerate = [DVec3::ZERO, DVec3::X, DVec3::new(0.0, 1.0e30, 0.0)];
        let heights = Heights::of_triangles([near, far, degenerate].into_iter(), 0.25);
        let triangles = [near, far, degenerate].into_iter();
        let chunks = chunks_of_triangles(triangles, 0.25, EVERYWHERE);
        assert_eq!(chunks.len(), 2);
        assert_eq!(heights.reader().nearest_m((1, 1), 5.0).unwrap(), Some(0.0));
        assert_eq!(heights.reader().nearest_m((1000, 1), 0.0).unwrap(), None);
    }

    #[test]
    fn heights_farther_apart_than_the_gap_are_levels_and_a_height_between_merges_them() {
        let slab = |height: f64| {
            [DVec3::ZERO, DVec3::X, DVec3::Y].map(|corner| corner + DVec3::Z * height)
        };
        let levels = |heights_m: &[f64]| {
            let heights = Heights::of_triangles(heights_m.iter().map(|&height| slab(height)), 0.25);
            heights
                .reader()
                .levels_m((0, 0))
                .unwrap()
                .collect::<Vec<_>>()
        };
        assert_eq!(levels(&[6.0, 0.0, 6.5, 0.5]), [0.25, 6.25]);
        assert_eq!(levels(&[12.0, 6.0, 0.0]), [0.0, 6.0, 12.0]);
        assert_eq!(levels(&[0.0, 3.0, 1.5]), [1.5]);
        assert_eq!(levels(&[1.5, 3.0, 0.0]), [1.5]);
    }

    #[test]
    fn of_a_thousand_stacked_squares_a_cell_has_the_lowest_levels_and_chunks_in_memory_are_bounded()
    {
        let square = |height_m: f64, at: DVec3, side: f64| {
            let corners = [DVec3::ZERO, side * DVec3::X, side * DVec3::Y];
            corners.map(|corner| at + corner + DVec3::Z * height_m)
        };
        let stack = (0..1000).map(|k| square(4.0 * f64::from(k), DVec3::ZERO, 1.0));
        let heights = Heights::of_triangles(stack, 0.25);
        let levels: Vec<f64> = heights.reader().levels_m((0, 0)).unwrap().collect();
        let lowest: Vec<f64> = (0..MOST_LEVELS).map(|k| 4.0 * k as f64).collect();
        assert_eq!(levels, lowest);
        // Each chunk of 32 levels has half a megabyte.
        let wide = (0..32).map(|k| square(4.0 * f64::from(k), DVec3::ZERO, 2e4));
        let triangles = GroundTriangles::new(wide.collect(), 0.5);
        for chunk in 0..200 {
            assert!(triangles.chunk((chunk, 0)).unwrap().is_some());
            let bytes = triangles.made.read().unwrap().bytes;
            assert!(bytes < KEPT_BYTES + (1 << 20), "{bytes}");
        }
    }

    #[test]
    fn the_chunks_of_triangles_are_the_same_one_by_one_and_a_large_one_has_heights_everywhere() {
        let mut corners = Vec::new();
        for i in 0..300 {
            let at = |k: i32| {
                let [x, y] = [37, 101].map(|step| f64::from((i * step * (k + 3) + 17 * k) % 100));
                DVec3::new(x - 50.0, y - 50.0, 0.1 * f64::from((i + k) % 7))
            };
            let size = match i % 30 {
                0 => 10.0,
                other => [1.0, 0.08][other as usize % 2],
            };
            let middle = at(0);
            corners.push([1, 2, 3].map(|k| middle + size * (at(k) - middle)));
        }
        let all = chunks_of_triangles(corners.iter().copied(), 0.5, EVERYWHERE);
        let one_by_one = GroundTriangles::new(corners, 0.5);
        let chunks = (-35..35).flat_map(|column| (-35..35).map(move |row| (column, row)));
        for chunk in chunks {
            let made = one_by_one.chunk(chunk).unwrap();
            assert_eq!(made.as_deref(), all.get(&chunk).map(|bytes| &**bytes));
        }
        let plane = [(0.0, 0.0), (1e7, 0.0), (0.0, 1e7)].map(|(x, y)| DVec3::new(x, y, 0.01 * x));
        let heights = Heights::of_triangles([plane].into_iter(), 0.5);
        let mut reader = heights.reader();
        for x in [100.25, 1e6 + 0.25, 4e6 + 0.25] {
            let cell = heights.cell_at(x, x).unwrap();
            let height_m = reader.nearest_m(cell, 0.0).unwrap().unwrap();
            assert!((height_m - 0.01 * x).abs() < 0.01, "{height_m}");
        }
        assert_eq!(reader.nearest_m((-1, -1), 0.0).unwrap(), None);
    }

    #[test]
    fn a_reader_returns_the_same_heights_in_any_order() {
        let climbing = [
            DVec3::new(-40.0, -40.0, -4.0),
            DVec3::new(40.0, -40.0, 4.0),
            DVec3::new(-40.0, 40.0, -4.0),
        ];
        let heights = Heights::of_triangles([climbing].into_iter(), 0.5);
        let mut reader = heights.reader();
        for cell in [(-1, -1), (63, -70), (-70, 63), (-1, -1), (900, 900)] {
            let fresh = heights.reader().nearest_m(cell, 0.0).unwrap();
            assert_eq!(reader.nearest_m(cell, 0.0).unwrap(), fresh);
        }
        let expected_m = 0.1 * heights.center((63, -70)).x;
        assert!((reader.nearest_m((63, -70), 0.0).unwrap().unwrap() - expected_m).abs() < 1e-6);
    }
}
