//! Tile grid: division of the map into square tiles, and which of them the mapping drive visited.
//!
//! ```text
//! tile (i, j) covers [(i − ½) S, (i + ½) S) × [(j − ½) S, (j + ½) S)      S = side of a tile
//! ```
//!
//! Tile centres are multiples of the side, one at the origin. The tiles reach a margin beyond
//! the mapping poses; a tile is valid where more than one mapping pose is near its centre, as in
//! range-mcl (Chen et al., ICRA 2021, section III-D).

use std::collections::{BTreeMap, HashMap, HashSet};

use glam::DVec3;
use nalgebra::Point2;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::geometry::{Aabb, Pose2, Pose3, TriangleMesh};
use crate::map::mesh_view::{MeshView, part_on_lattice};

/// Division of the map into tiles.
///
/// Defaults: the values of range-mcl.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct TileConfig {
    /// Side of a tile [m].
    #[default(100.0)]
    pub side_m: f64,
    /// Extent of the map beyond the mapping poses [m].
    #[default(50.0)]
    pub margin_m: f64,
}

/// A tile: its centre in sides.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct TileIndex {
    /// Along x.
    pub column: i64,
    /// Along y.
    pub row: i64,
}

impl TileIndex {
    /// The tile of a position, for tiles of a side.
    pub(crate) fn of(x: f64, y: f64, side_m: f64) -> Self {
        let [column, row] = [x, y].map(|along| (along / side_m + 0.5).floor() as i64);
        Self { column, row }
    }

    /// All tiles from one to another.
    pub(crate) fn range(first: Self, last: Self) -> impl Iterator<Item = Self> {
        let columns =
            move |row| (first.column..=last.column).map(move |column| Self { column, row });
        (first.row..=last.row).flat_map(columns)
    }

    fn min(self, other: Self) -> Self {
        Self {
            column: self.column.min(other.column),
            row: self.row.min(other.row),
        }
    }

    fn max(self, other: Self) -> Self {
        Self {
            column: self.column.max(other.column),
            row: self.row.max(other.row),
        }
    }
}

/// Square tiles around the path of the mapping drive.
#[derive(Clone, Debug, PartialEq)]
pub struct TileGrid {
    /// Side of a tile [m].
    pub side_m: f64,
    /// The first and the last tile along both axes.
    range: [TileIndex; 2],
    valid: HashSet<TileIndex>,
}

impl TileGrid {
    /// Covers mapping poses (`map_from_lidar`) and a margin around them. Without poses, one invalid tile
    /// around the origin.
    pub(crate) fn around<'a>(
        poses: impl IntoIterator<Item = &'a Pose3>,
        config: &TileConfig,
    ) -> Self {
        let side_m = config.side_m;
        // Radius around the centre of a tile in which mapping poses are counted.
        let reach_m = config.margin_m + 0.25 * side_m;
        let mut corners = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
        let mut counts: HashMap<TileIndex, usize> = HashMap::new();
        for pose in poses {
            let position = Point2::from(pose.translation.vector.xy());
            let at =
                |offset_m: f64| TileIndex::of(position.x + offset_m, position.y + offset_m, side_m);
            for tile in TileIndex::range(at(-reach_m), at(reach_m)) {
                if (position - center(tile, side_m)).norm() < reach_m {
                    *counts.entry(tile).or_default() += 1;
                }
            }
            for axis in 0..2 {
                corners[0][axis] = corners[0][axis].min(position[axis]);
                corners[1][axis] = corners[1][axis].max(position[axis]);
            }
        }
        let [min, max] = if counts.is_empty() {
            [[0.0; 2]; 2]
        } else {
            corners
        };
        let first = |axis: usize| ((min[axis] - config.margin_m) / side_m + 0.5).floor() as i64;
        let last = |axis: usize| ((max[axis] + config.margin_m) / side_m - 0.5).ceil() as i64;
        let first = TileIndex {
            column: first(0),
            row: first(1),
        };
        let last = TileIndex {
            column: last(0),
            row: last(1),
        };
        let visited = counts.into_iter().filter(|(_, count)| *count > 1);
        Self {
            side_m,
            range: [first, first.max(last)],
            valid: visited.map(|(tile, _)| tile).collect(),
        }
    }

    /// Covers a mesh without a mapping drive, given by the boxes of the triangles of its tiles; the tiles that
    /// these reach are valid. Where they reach very many, as in a map in millimetres, the tiles of the grid are larger.
    pub(crate) fn of_boxes(
        boxes: impl IntoIterator<Item = (TileIndex, Aabb)>,
        side_m: f64,
    ) -> Self {
        /// A triangle that reaches farther is an artefact [tiles].
        const REACH: f64 = 50.0;
        const MOST_TILES: f64 = (1 << 22) as f64;
        let clipped = |(tile, bounds): (TileIndex, Aabb)| {
            let (middle, reach_m) = (center(tile, side_m), REACH * side_m);
            [bounds.min, bounds.max].map(|corner| {
                let clip = |along: f32, middle: f64| {
                    f64::from(along).clamp(middle - reach_m, middle + reach_m)
                };
                [clip(corner.x, middle.x), clip(corner.y, middle.y)]
            })
        };
        let boxes: Vec<_> = boxes.into_iter().map(clipped).collect();
        let reached = |side_m: f64| {
            let ends = boxes.iter().copied();
            ends.map(move |ends| ends.map(|[x, y]| TileIndex::of(x, y, side_m)))
        };
        let count = |[first, last]: [TileIndex; 2]| {
            (last.column - first.column + 1) as f64 * (last.row - first.row + 1) as f64
        };
        let mut side_m = side_m;
        while reached(side_m).map(count).sum::<f64>() > MOST_TILES.max(4.0 * boxes.len() as f64) {
            side_m *= 2.0;
        }
        let mut valid = HashSet::new();
        let mut range: Option<[TileIndex; 2]> = None;
        for [first, last] in reached(side_m) {
            valid.extend(TileIndex::range(first, last));
            let [least, most] = range.unwrap_or([first, last]);
            range = Some([least.min(first), most.max(last)]);
        }
        Self {
            side_m,
            range: range.unwrap_or([TileIndex::of(0.0, 0.0, side_m); 2]),
            valid,
        }
    }

    /// Number of valid tiles.
    pub fn len(&self) -> usize {
        self.valid.len()
    }

    /// Whether there are no valid tiles.
    pub fn is_empty(&self) -> bool {
        self.valid.is_empty()
    }

    /// Returns the tile of a position; `None` outside the grid.
    pub(crate) fn tile_at(&self, x: f64, y: f64) -> Option<TileIndex> {
        let tile = TileIndex::of(x, y, self.side_m);
        let [first, last] = self.range;
        let is_inside = (first.column..=last.column).contains(&tile.column)
            && (first.row..=last.row).contains(&tile.row);
        (is_inside && x.is_finite() && y.is_finite()).then_some(tile)
    }

    /// Returns the valid tile of a pose; `None` outside the grid and in tiles that the mapping drive did
    /// not visit.
    pub(crate) fn valid_tile_of(&self, pose: &Pose2) -> Option<TileIndex> {
        let position = pose.translation.vector;
        self.tile_at(position.x, position.y)
            .filter(|tile| self.is_valid(*tile))
    }

    /// Whether the mapping drive visited a tile.
    pub(crate) fn is_valid(&self, tile: TileIndex) -> bool {
        self.valid.contains(&tile)
    }

    /// Returns the centre of a tile [m].
    pub(crate) fn center(&self, tile: TileIndex) -> Point2<f64> {
        center(tile, self.side_m)
    }

    /// Returns the lower and upper corner of the rectangle that all tiles cover [m].
    pub fn extent(&self) -> (Point2<f64>, Point2<f64>) {
        let half = nalgebra::Vector2::repeat(0.5 * self.side_m);
        let [first, last] = self.range;
        (self.center(first) - half, self.center(last) + half)
    }
}

fn center(tile: TileIndex, side_m: f64) -> Point2<f64> {
    Point2::new(tile.column as f64 * side_m, tile.row as f64 * side_m)
}

/// Divides a mesh into one mesh per tile that holds triangles, in the order of the tiles.
///
/// Each triangle is assigned to the tile of its centroid. The order of triangles and vertices is preserved.
pub fn cut(mesh: &TriangleMesh, side_m: f64) -> Vec<(TileIndex, TriangleMesh)> {
    triangles_of_tiles(mesh, side_m)
        .into_iter()
        .map(|(tile, triangles)| (tile, part_on_lattice(mesh, &triangles, DVec3::ZERO)))
        .collect()
}

/// The triangles of each tile that holds any: those whose centroids are in it.
pub(crate) fn triangles_of_tiles(
    mesh: &dyn MeshView,
    side_m: f64,
) -> BTreeMap<TileIndex, Vec<u32>> {
    let mut triangles_of: BTreeMap<TileIndex, Vec<u32>> = BTreeMap::new();
    for triangle in 0..mesh.triangles() {
        let [a, b, c] = mesh.corners(triangle);
        let middle = (a + b + c) / 3.0;
        let tile = TileIndex::of(middle.x, middle.y, side_m);
        triangles_of.entry(tile).or_default().push(triangle as u32);
    }
    triangles_of
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Vec3;

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
                }
                mesh.triangles.push([first, first + 1, first + 2]);
            }
        }
        mesh
    }

    #[test]
    fn one_tile_is_centred_at_the_origin_and_every_tile_contains_its_centre() {
        let grid = grid(&[(0.0, 0.0), (230.0, -130.0)]);
        let origin = grid.tile_at(0.0, 0.0).unwrap();
        assert_eq!(grid.center(origin), Point2::origin());
        for tile in TileIndex::range(grid.range[0], grid.range[1]) {
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
        assert_eq!(
            (min, max),
            (Point2::new(-50.0, -150.0), Point2::new(250.0, 50.0))
        );
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
    fn every_triangle_is_in_exactly_one_tile() {
        let mesh = sheet();
        let parts = cut(&mesh, 100.0);
        assert_eq!(parts.len(), 15);
        let mut found: Vec<_> = parts
            .iter()
            .flat_map(|(_, part)| {
                (0..part.triangles.len())
                    .map(|triangle| part.corners(triangle).map(|c| c.to_array()))
            })
            .collect();
        let mut expected: Vec<_> = (0..mesh.triangles.len())
            .map(|triangle| mesh.corners(triangle).map(|c| c.to_array()))
            .collect();
        found.sort_by(|a, b| a.partial_cmp(b).unwrap());
        expected.sort_by(|a, b| a.partial_cmp(b).unwrap());
        assert_eq!(found, expected);
        assert!(
            parts
                .iter()
                .all(|(_, part)| part.vertices.len() == 3 * part.triangles.len())
        );
    }

    #[test]
    fn a_triangle_is_in_the_tile_of_its_centroid() {
        let mesh = sheet();
        let grid = grid(&[(-150.0, -20.0), (150.0, 60.0)]);
        for (tile, part) in cut(&mesh, 100.0) {
            for triangle in 0..part.triangles.len() {
                let [a, b, c] = part.corners(triangle);
                let centroid = ((a + b + c) / 3.0).as_dvec3();
                assert_eq!(grid.tile_at(centroid.x, centroid.y), Some(tile));
            }
        }
    }

    #[test]
    fn tiles_that_a_triangle_reaches_are_valid() {
        let tile = TileIndex::of(0.0, 0.0, 100.0);
        let wide = Aabb {
            min: Vec3::new(-140.0, 0.0, 0.0),
            max: Vec3::new(1e7, 60.0, 0.0),
        };
        let grid = TileGrid::of_boxes([(tile, wide)], 100.0);
        let is_valid = |x: f64, y: f64| grid.valid_tile_of(&Pose2::translation(x, y)).is_some();
        assert!(is_valid(-130.0, 10.0) && is_valid(4900.0, 70.0));
        assert!(!is_valid(-160.0, 10.0) && !is_valid(0.0, -60.0) && !is_valid(1e6, 0.0));
    }

    #[test]
    fn boxes_that_reach_very_many_tiles_have_larger_ones() {
        let boxes = (0..2000).map(|i| {
            let min = Vec3::new(10_000.0 * i as f32, 0.0, 0.0);
            let max = min + Vec3::new(9_000.0, 9_000.0, 0.0);
            let middle = 0.5 * (min + max);
            let tile = TileIndex::of(middle.x.into(), middle.y.into(), 100.0);
            (tile, Aabb { min, max })
        });
        let grid = TileGrid::of_boxes(boxes, 100.0);
        assert!(
            grid.side_m > 100.0 && grid.len() <= 1 << 22,
            "{}",
            grid.side_m
        );
        let is_valid = |x: f64, y: f64| grid.valid_tile_of(&Pose2::translation(x, y)).is_some();
        assert!(is_valid(19_995_000.0, 8_000.0) && !is_valid(0.0, 20_000.0));
    }
}
