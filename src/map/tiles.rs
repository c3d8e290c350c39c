//! Tile grid: division of the map into square tiles, and which of them the mapping drive visited.
//!
//! ```text
//! tile (i, j) covers [(i − ½) S, (i + ½) S) × [(j − ½) S, (j + ½) S)      S = side of a tile
//! ```
//!
//! Tile centres are multiples of the side, one at the origin. The tiles reach a margin beyond
//! the mapping poses; a tile is valid where more than one mapping pose is near its centre, as in
//! range-mcl (Chen et al., ICRA 2021, section III-D).

use nalgebra::Point2;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::geometry::{Aabb, Pose2, Pose3, TriangleMesh, Vec3};

/// Division of the map into tiles.
///
/// Defaults: the values of range-mcl.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct TileConfig {
    /// Side of a tile [m].
    #[default(100.0)]
    pub side_m: f64,
    /// Extent of the map beyond the mapping poses [m].
    #[default(50.0)]
    pub margin_m: f64,
}

/// Number of a tile in its grid, row-major with x fastest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TileIndex(pub usize);

/// Square tiles around the path of the mapping drive.
#[derive(Clone, Debug, PartialEq)]
pub struct TileGrid {
    /// Side of a tile [m].
    pub side_m: f64,
    /// Number of tiles along x.
    pub columns: usize,
    /// Number of tiles along y.
    pub rows: usize,
    /// Centre of tile 0 in sides; the centres of all tiles are whole numbers of sides.
    first: (i64, i64),
    valid: Vec<bool>,
}

impl TileGrid {
    /// Covers mapping poses (`map_from_lidar`) and a margin around them. Without poses, one invalid tile
    /// around the origin.
    pub fn around<'a>(poses: impl IntoIterator<Item = &'a Pose3>, config: &TileConfig) -> Self {
        let positions: Vec<Point2<f64>> = poses
            .into_iter()
            .map(|pose| Point2::from(pose.translation.vector.xy()))
            .collect();
        let [(first_x, columns), (first_y, rows)] =
            [0, 1].map(|axis| range(positions.iter().map(|p| p.coords[axis]), config));
        let mut grid = Self {
            side_m: config.side_m,
            columns,
            rows,
            first: (first_x, first_y),
            valid: Vec::new(),
        };
        // Radius around the centre of a tile in which mapping poses are counted.
        let reach_m = config.margin_m + 0.25 * config.side_m;
        grid.valid = grid
            .indices()
            .map(|tile| {
                let center = grid.center(tile);
                let near = |position: &&Point2<f64>| (**position - center).norm() < reach_m;
                positions.iter().filter(near).count() > 1
            })
            .collect();
        grid
    }

    /// Covers a mesh without a mapping drive; the tiles with triangles are valid.
    pub fn of_mesh(mesh: &TriangleMesh, config: &TileConfig) -> Self {
        let bounds = mesh.bounds();
        let [(first_x, columns), (first_y, rows)] = ranges(&bounds, config);
        let mut grid = Self {
            side_m: config.side_m,
            columns,
            rows,
            first: (first_x, first_y),
            valid: vec![false; columns * rows],
        };
        for triangle in 0..mesh.triangles.len() {
            for corner in mesh.corners(triangle) {
                let tile = grid.nearest_tile(corner);
                grid.valid[tile.0] = true;
            }
        }
        grid
    }

    /// Number of tiles of [`of_mesh`](Self::of_mesh) for a mesh of a bounding box.
    pub fn count_of_mesh(bounds: &Aabb, config: &TileConfig) -> f64 {
        ranges(bounds, config)
            .iter()
            .map(|(_, count)| *count as f64)
            .product()
    }

    /// Number of tiles of [`around`](Self::around).
    pub fn count(poses: &[Pose3], config: &TileConfig) -> f64 {
        let positions = || poses.iter().map(|pose| pose.translation.vector);
        let along = |axis: usize| range(positions().map(|p| p[axis]), config).1 as f64;
        along(0) * along(1)
    }

    /// Number of tiles.
    pub fn len(&self) -> usize {
        self.columns * self.rows
    }

    /// Whether there are no tiles.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns all tiles in order.
    pub fn indices(&self) -> impl Iterator<Item = TileIndex> + use<> {
        (0..self.len()).map(TileIndex)
    }

    /// Returns the tile of a position; `None` outside the grid.
    pub fn tile_at(&self, x: f64, y: f64) -> Option<TileIndex> {
        let column = (x / self.side_m + 0.5).floor() - self.first.0 as f64;
        let row = (y / self.side_m + 0.5).floor() - self.first.1 as f64;
        let inside =
            column >= 0.0 && row >= 0.0 && column < self.columns as f64 && row < self.rows as f64;
        inside.then(|| TileIndex(row as usize * self.columns + column as usize))
    }

    /// Returns the valid tile of a pose; `None` outside the grid and in tiles that the mapping drive did
    /// not visit.
    pub fn valid_tile_of(&self, pose: &Pose2) -> Option<TileIndex> {
        let position = pose.translation.vector;
        self.tile_at(position.x, position.y)
            .filter(|tile| self.is_valid(*tile))
    }

    /// Whether the mapping drive visited a tile.
    pub fn is_valid(&self, tile: TileIndex) -> bool {
        self.valid[tile.0]
    }

    /// Returns the centre of a tile [m].
    pub fn center(&self, tile: TileIndex) -> Point2<f64> {
        let (column, row) = (tile.0 % self.columns, tile.0 / self.columns);
        Point2::new(
            (self.first.0 + column as i64) as f64 * self.side_m,
            (self.first.1 + row as i64) as f64 * self.side_m,
        )
    }

    /// Returns the lower and upper corner of the rectangle that all tiles cover [m].
    pub fn extent(&self) -> (Point2<f64>, Point2<f64>) {
        let half = nalgebra::Vector2::repeat(0.5 * self.side_m);
        (
            self.center(TileIndex(0)) - half,
            self.center(TileIndex(self.len() - 1)) + half,
        )
    }

    /// Returns the tile of a position, outside the grid the nearest one.
    fn nearest_tile(&self, point: Vec3) -> TileIndex {
        let cell = |coordinate: f32, first: i64, cells: usize| {
            let cell = (f64::from(coordinate) / self.side_m + 0.5).floor() - first as f64;
            cell.clamp(0.0, (cells - 1) as f64) as usize
        };
        let column = cell(point.x, self.first.0, self.columns);
        let row = cell(point.y, self.first.1, self.rows);
        TileIndex(row * self.columns + column)
    }
}

/// The first tile and the number of tiles along x and y that cover a box.
fn ranges(bounds: &Aabb, config: &TileConfig) -> [(i64, usize); 2] {
    [0, 1].map(|axis| {
        span(
            f64::from(bounds.min[axis]),
            f64::from(bounds.max[axis]),
            config.side_m,
        )
    })
}

/// The first tile along an axis and the number of tiles that cover positions and a margin around them.
fn range(positions_m: impl Iterator<Item = f64>, config: &TileConfig) -> (i64, usize) {
    let (min, max) = positions_m.fold((0.0, 0.0), |(min, max), at| {
        (f64::min(min, at), f64::max(max, at))
    });
    span(min - config.margin_m, max + config.margin_m, config.side_m)
}

/// The first tile along an axis and the number of tiles that cover an interval.
fn span(min_m: f64, max_m: f64, side_m: f64) -> (i64, usize) {
    let first = (min_m / side_m + 0.5).floor() as i64;
    let last = (max_m / side_m - 0.5).ceil() as i64;
    (first, (last - first + 1).max(1) as usize)
}

/// Divides a mesh into one mesh per tile, in the order of the tiles; some may be empty.
///
/// Each triangle is assigned to the tile of its centroid, outside the grid to the nearest tile. The
/// order of triangles and vertices is preserved.
pub fn cut(mesh: &TriangleMesh, grid: &TileGrid) -> Vec<TriangleMesh> {
    let mut triangles_of: Vec<Vec<usize>> = vec![Vec::new(); grid.len()];
    for triangle in 0..mesh.triangles.len() {
        let [a, b, c] = mesh.corners(triangle);
        let tile = grid.nearest_tile((a + b + c) / 3.0);
        triangles_of[tile.0].push(triangle);
    }
    let mut local_index = vec![u32::MAX; mesh.vertices.len()];
    triangles_of
        .iter()
        .map(|triangles| extract(mesh, triangles, &mut local_index))
        .collect()
}

/// Extracts the mesh of some triangles. `local_index` is scratch space: one entry per vertex of `mesh`, all
/// `u32::MAX` before and after.
fn extract(mesh: &TriangleMesh, triangles: &[usize], local_index: &mut [u32]) -> TriangleMesh {
    let mut used: Vec<u32> = triangles
        .iter()
        .flat_map(|&triangle| mesh.triangles[triangle])
        .collect();
    used.sort_unstable();
    used.dedup();
    for (local, &vertex) in used.iter().enumerate() {
        local_index[vertex as usize] = local as u32;
    }
    let part = TriangleMesh {
        vertices: pick(&mesh.vertices, &used),
        normals: pick(&mesh.normals, &used),
        colors: pick(&mesh.colors, &used),
        triangles: triangles
            .iter()
            .map(|&triangle| mesh.triangles[triangle].map(|v| local_index[v as usize]))
            .collect(),
    };
    for &vertex in &used {
        local_index[vertex as usize] = u32::MAX;
    }
    part
}

/// Returns the entries of a column at some rows; an empty column stays empty.
fn pick<T: Copy>(column: &[T], rows: &[u32]) -> Vec<T> {
    if column.is_empty() {
        return Vec::new();
    }
    rows.iter().map(|&row| column[row as usize]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive(positions: &[(f64, f64)]) -> Vec<Pose3> {
        positions
            .iter()
            .map(|&(x, y)| Pose3::translation(x, y, 0.0))
            .collect()
    }

    fn grid(positions: &[(f64, f64)]) -> TileGrid {
        TileGrid::around(&drive(positions), &TileConfig::default())
    }

    /// Triangles of 7 m over [-180, 180] in x and [-60, 60] in y.
    fn sheet() -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        for row in 0..18 {
            for column in 0..52 {
                let corner = Vec3::new(-180.0 + 7.0 * column as f32, -60.0 + 7.0 * row as f32, 0.0);
                let first = mesh.vertices.len() as u32;
                for offset in [Vec3::ZERO, Vec3::X, Vec3::Y] {
                    mesh.vertices.push(corner + 7.0 * offset);
                    mesh.colors.push([row as u8, column as u8, 0]);
                }
                mesh.triangles.push([first, first + 1, first + 2]);
            }
        }
        mesh
    }

    #[test]
    fn one_tile_is_centred_at_the_origin_and_every_tile_contains_its_centre() {
        let grid = grid(&[(0.0, 0.0), (230.0, -130.0)]);
        assert!(grid.indices().any(|t| grid.center(t) == Point2::origin()));
        for tile in grid.indices() {
            let center = grid.center(tile);
            assert_eq!(grid.tile_at(center.x, center.y), Some(tile));
        }
    }

    #[test]
    fn the_tiles_cover_the_poses_with_their_margin() {
        let grid = grid(&[(0.0, 0.0), (130.0, -20.0)]);
        let (min, max) = grid.extent();
        assert!(min.x <= -50.0 && min.y <= -70.0 && max.x >= 180.0 && max.y >= 50.0);
        // -50 .. 180 and -70 .. 50: tiles 0, 1, 2 and -1, 0.
        assert_eq!((grid.columns, grid.rows), (3, 2));
    }

    #[test]
    fn a_position_outside_has_no_tile() {
        let grid = grid(&[(0.0, 0.0), (0.0, 0.0)]);
        for (x, y) in [(-50.1, 0.0), (50.1, 0.0), (0.0, 60.0), (f64::NAN, 0.0)] {
            assert_eq!(grid.tile_at(x, y), None, "{x} {y}");
        }
    }

    #[test]
    fn a_tile_is_valid_where_more_than_one_mapping_pose_is_near() {
        let grid = grid(&[(0.0, 0.0), (1.0, 0.0), (160.0, 0.0)]);
        let valid = |x: f64| {
            let pose = Pose2::translation(x, 0.0);
            grid.valid_tile_of(&pose).is_some()
        };
        assert!(valid(0.0));
        // Within 75 m of the centre at 100 m there is one pose only, and of the one at 200 m too.
        assert!(!valid(100.0));
        assert!(!valid(200.0));
        assert!(grid.tile_at(200.0, 0.0).is_some());
    }

    #[test]
    fn every_triangle_is_in_exactly_one_tile_with_its_corners_and_colors() {
        let mesh = sheet();
        let grid = grid(&[(0.0, 0.0), (60.0, 0.0)]);
        let parts = cut(&mesh, &grid);
        assert_eq!(parts.len(), grid.len());
        let mut found: Vec<_> = parts
            .iter()
            .flat_map(|part| {
                (0..part.triangles.len()).map(|triangle| {
                    let color = part.colors[part.triangles[triangle][0] as usize];
                    (color, part.corners(triangle).map(|c| c.to_array()))
                })
            })
            .collect();
        let mut expected: Vec<_> = (0..mesh.triangles.len())
            .map(|triangle| {
                let color = mesh.colors[mesh.triangles[triangle][0] as usize];
                (color, mesh.corners(triangle).map(|c| c.to_array()))
            })
            .collect();
        found.sort_by(|a, b| a.partial_cmp(b).unwrap());
        expected.sort_by(|a, b| a.partial_cmp(b).unwrap());
        assert_eq!(found, expected);
        assert!(
            parts
                .iter()
                .all(|part| part.vertices.len() == 3 * part.triangles.len())
        );
    }

    #[test]
    fn a_triangle_inside_the_grid_is_in_the_tile_of_its_centroid() {
        let mesh = sheet();
        let grid = grid(&[(-150.0, -20.0), (150.0, 60.0)]);
        for (part, tile) in cut(&mesh, &grid).iter().zip(grid.indices()) {
            for triangle in 0..part.triangles.len() {
                let [a, b, c] = part.corners(triangle);
                let centroid = ((a + b + c) / 3.0).as_dvec3();
                assert_eq!(grid.tile_at(centroid.x, centroid.y), Some(tile));
            }
        }
    }
}
