//! Square cells of the plane in which place recognition searches.

use std::collections::BTreeSet;

use nalgebra::{Point2, Vector2};

use crate::geometry::Pose2;
use crate::map::tiles::grid::TileGrid;

/// Half the width of the road around the mapping poses [m], as in range-mcl.
pub const ROAD_HALF_WIDTH_M: f64 = 2.0;

/// Returns the centres [m] of the cells of `cell_m` that are within `reach_m` of a mapping pose,
/// ordered by y, then x.
pub fn along_road(poses: &[Pose2], reach_m: f64, cell_m: f64) -> Vec<Point2<f64>> {
    let reach = (reach_m / cell_m).ceil() as i64;
    let middle = |cell: i64| (cell as f64 + 0.5) * cell_m;
    let mut cells = BTreeSet::new();
    for pose in poses {
        let place = pose.translation.vector;
        let (column, row) = (
            (place.x / cell_m).floor() as i64,
            (place.y / cell_m).floor() as i64,
        );
        for row in row - reach..=row + reach {
            for column in column - reach..=column + reach {
                let center = Vector2::new(middle(column), middle(row));
                if (center - place).norm() <= reach_m {
                    cells.insert((row, column));
                }
            }
        }
    }
    let center = |(row, column)| Point2::new(middle(column), middle(row));
    cells.into_iter().map(center).collect()
}

/// Returns the centres [m] of all cells of `cell_m` in the extent of the tiles, ordered by y, then x.
pub fn over_map(tiles: &TileGrid, cell_m: f64) -> Vec<Point2<f64>> {
    let (min, max) = tiles.extent();
    let count = |extent_m: f64| (extent_m / cell_m).floor() as usize;
    let columns = count(max.x - min.x);
    let center = |row: usize, column: usize| {
        min + Vector2::new(column as f64 + 0.5, row as f64 + 0.5) * cell_m
    };
    (0..count(max.y - min.y))
        .flat_map(|row| (0..columns).map(move |column| center(row, column)))
        .collect()
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::geometry::Pose3;
    use crate::map::tiles::grid::TileConfig;

    fn road() -> Vec<Pose2> {
        (0..40)
            .map(|i| Pose2::translation(f64::from(i) - 7.3, 0.4))
            .collect()
    }

    #[test]
    fn road_cells_are_near_the_road_and_cover_it() {
        let cells = along_road(&road(), 2.0, 0.2);
        let distance = |place: &Point2<f64>| {
            road()
                .iter()
                .map(|pose| (place.coords - pose.translation.vector).norm())
                .fold(f64::INFINITY, f64::min)
        };
        assert!(cells.iter().all(|center| distance(center) <= 2.0));
        let area = cells.len() as f64 * 0.04;
        // 39 m of road, 4 m wide (a little less between the poses), and a half disc at either end.
        assert_relative_eq!(
            area,
            39.0 * 4.0 + std::f64::consts::PI * 4.0,
            max_relative = 0.06
        );
        let mut sorted = cells.clone();
        sorted.dedup();
        assert_eq!(sorted.len(), cells.len());
    }

    #[test]
    fn map_cells_cover_the_extent_of_the_tiles() {
        let poses: Vec<Pose3> = (0..100)
            .map(|i| Pose3::translation(f64::from(i), 0.0, 0.0))
            .collect();
        let tiles = TileGrid::around(&poses, &TileConfig::default());
        let (min, max) = tiles.extent();
        let area = over_map(&tiles, 1.0).len() as f64;
        assert_relative_eq!(area, (max.x - min.x) * (max.y - min.y), max_relative = 0.05);
    }

    #[test]
    fn a_finer_road_grid_covers_the_same_road() {
        let area = |cell_m: f64| along_road(&road(), 2.0, cell_m).len() as f64 * cell_m * cell_m;
        assert_relative_eq!(area(0.1), area(0.2), max_relative = 0.02);
    }
}
