//! Point cloud maps for the map loader of Autoware: square tiles as binary PCD files, and their metadata.
//!
//! ```text
//! pointcloud_map.pcd/pointcloud_map_X_Y.pcd   points with X ≤ x < X + side, Y ≤ y < Y + side
//! pointcloud_map_metadata.yaml                side of the tiles, and X, Y of each: whole numbers [m]
//! ```
//!
//! Formats: README of [`autoware_map_loader`], whose default names these are, and the Point Cloud Library's [PCD 0.7].
//!
//! [`autoware_map_loader`]: https://autowarefoundation.github.io/autoware_core/main/map/autoware_map_loader/
//! [PCD 0.7]: https://pointclouds.org/documentation/tutorials/pcd_file_format.html

use std::fmt::Write as _;
use std::io::{self, Write};

use crate::geometry::Vec3;

/// Folder of the tiles.
pub const TILES_FOLDER: &str = "pointcloud_map.pcd";
/// File of the metadata.
pub const METADATA_FILE: &str = "pointcloud_map_metadata.yaml";

/// Start and end of the name of a tile.
const PREFIX: &str = "pointcloud_map_";
const ENDING: &str = ".pcd";

/// The points of a square of the plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tile<'a> {
    /// Lowest x and y [m].
    pub corner_m: [i32; 2],
    /// Points in the map frame [m].
    pub points: &'a [Vec3],
}

/// Sorts points into the tiles that hold any, in the order of their corners. Within a tile, the points keep their order.
pub fn split(points: &mut [Vec3], side_m: u16) -> Vec<Tile<'_>> {
    let corner_m = |point: &Vec3| corner_m(*point, side_m);
    points.sort_by_key(corner_m);
    points
        .chunk_by(|a, b| corner_m(a) == corner_m(b))
        .map(|points| Tile {
            corner_m: corner_m(&points[0]),
            points,
        })
        .collect()
}

/// Lowest x and y of the tile that a point is in [m].
fn corner_m(point: Vec3, side_m: u16) -> [i32; 2] {
    let side_m = f64::from(side_m);
    [point.x, point.y].map(|x| ((f64::from(x) / side_m).floor() * side_m) as i32)
}

impl Tile<'_> {
    /// Name of the file.
    pub fn file_name(&self) -> String {
        let [x, y] = self.corner_m;
        format!("{PREFIX}{x}_{y}{ENDING}")
    }

    /// Writes the file: x, y and z of each point as little-endian floats.
    pub fn write(&self, mut writer: impl Write) -> io::Result<()> {
        let count = self.points.len();
        write!(
            writer,
            "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n\
             WIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
        )?;
        let mut numbers = self.points.iter().flat_map(Vec3::to_array);
        numbers.try_for_each(|number| writer.write_all(&number.to_le_bytes()))
    }
}

/// Whether a name is one of a tile.
pub fn is_tile(name: &str) -> bool {
    let corner = name
        .strip_prefix(PREFIX)
        .and_then(|rest| rest.strip_suffix(ENDING))
        .and_then(|corner| corner.split_once('_'));
    corner.is_some_and(|(x, y)| [x, y].iter().all(|number| number.parse::<i32>().is_ok()))
}

/// Text of the metadata file; comments are lines about the map.
pub fn metadata(tiles: &[Tile], side_m: u16, comments: &[String]) -> String {
    let mut text: String = (comments.iter())
        .map(|comment| format!("# {comment}\n"))
        .collect();
    text += &format!("x_resolution: {side_m}.0\ny_resolution: {side_m}.0\n");
    for tile in tiles {
        let [x, y] = tile.corner_m;
        // Writing to a string does not fail.
        let _ = writeln!(text, "{}: [{x}, {y}]", tile.file_name());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points() -> Vec<Vec3> {
        let at = |x, y| Vec3::new(x, y, 1.5);
        let below = f32::from_bits(20.0_f32.to_bits() - 1);
        vec![
            at(20.0, 0.0),
            at(-0.001, -20.0),
            at(below, 0.0),
            at(-20.0, -0.5),
            at(0.0, -0.0),
            at(-20.001, 8000.0),
        ]
    }

    #[test]
    fn every_point_is_in_one_tile_which_contains_it() {
        for side_m in [20, 1, 7, 100] {
            let mut points = points();
            let tiles = split(&mut points, side_m);
            assert_eq!(tiles.iter().map(|tile| tile.points.len()).sum::<usize>(), 6);
            for tile in &tiles {
                for point in tile.points {
                    for (low_m, x) in tile.corner_m.into_iter().zip([point.x, point.y]) {
                        assert_eq!(low_m.rem_euclid(i32::from(side_m)), 0);
                        let from_corner_m = f64::from(x) - f64::from(low_m);
                        assert!(
                            (0.0..f64::from(side_m)).contains(&from_corner_m),
                            "{tile:?}"
                        );
                    }
                }
            }
            assert!(tiles.is_sorted_by(|a, b| a.corner_m < b.corner_m));
        }
    }

    #[test]
    fn metadata_have_the_corner_of_each_tile_under_the_name_of_its_file() {
        let mut points = points();
        let text = metadata(&split(&mut points, 20), 20, &["of a street".to_owned()]);
        let expected = "\
# of a street
x_resolution: 20.0
y_resolution: 20.0
pointcloud_map_-40_8000.pcd: [-40, 8000]
pointcloud_map_-20_-20.pcd: [-20, -20]
pointcloud_map_0_0.pcd: [0, 0]
pointcloud_map_20_0.pcd: [20, 0]
";
        assert_eq!(text, expected);
    }

    #[test]
    fn only_names_of_tiles_are_recognized() {
        let mut points = points();
        assert!(
            split(&mut points, 20)
                .iter()
                .all(|tile| is_tile(&tile.file_name()))
        );
        for other in [
            "pointcloud_map_0.pcd",
            "pointcloud_map_a_0.pcd",
            "0_0.pcd",
            "pointcloud_map_0_0.ply",
        ] {
            assert!(!is_tile(other), "{other}");
        }
    }

    #[test]
    fn a_file_has_a_header_and_twelve_bytes_per_point() {
        let mut points = points();
        let mut file = Vec::new();
        split(&mut points, 100)[0].write(&mut file).unwrap();
        let header =
            "COUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\nDATA binary\n";
        let start = file.len() - 2 * 12;
        assert!(String::from_utf8_lossy(&file[..start]).ends_with(header));
        assert_eq!(file[start..start + 4], (-0.001_f32).to_le_bytes());
    }
}
