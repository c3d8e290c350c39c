//! Division of a drive into local maps, and of the plane into the regions that they own.
//!
//! A scan is a key scan if the car has moved since the previous key scan. Every `local_map_size` key
//! scans, and at the end of the recording, a local map is complete. It is meshed from its own scans
//! and those a few metres before and after. Of its mesh it keeps what is closer to its own scans than
//! to those of any other local map, clipped exactly at the border (see `seam`): neighbours
//! meet without overlap, also where the drive crosses itself.

use std::ops::Range;

use nalgebra::Point2;

use crate::geometry::{Grid2, Pose3};
use crate::memory::{self, MemoryError};

/// Edge of the cells in which ownership is decided [m].
const OWNER_CELL_M: f64 = 0.5;

/// The scans of one local map.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LocalMapPlan {
    /// Number of the local map, from 0 in the order of the drive.
    pub number: usize,
    /// Its own key scans; no two local maps share one.
    pub own: Range<usize>,
    /// The key scans from which it is meshed: its own and some of its neighbours.
    pub used: Range<usize>,
}

/// Returns the indices of the key scans: the first, and each that is `displacement_m` or more away
/// from the previous key scan.
pub fn key_scans(map_from_lidar: &[Pose3], displacement_m: f64) -> Vec<usize> {
    let mut keys: Vec<usize> = Vec::with_capacity(map_from_lidar.len());
    for (index, pose) in map_from_lidar.iter().enumerate() {
        let previous = keys.last().map(|&key| &map_from_lidar[key]);
        if is_key_scan(previous, pose, displacement_m) {
            keys.push(index);
        }
    }
    keys
}

/// Whether a scan is a key scan, given the previous one.
pub fn is_key_scan(previous: Option<&Pose3>, pose: &Pose3, displacement_m: f64) -> bool {
    previous.is_none_or(|previous| distance_m(previous, pose) >= displacement_m)
}

/// Cuts key scans into local maps of `local_map_size` scans, the last with the remainder, each
/// meshed with the scans within `overlap_m` before and after.
pub fn local_maps(poses: &[Pose3], local_map_size: usize, overlap_m: f64) -> Vec<LocalMapPlan> {
    (0..poses.len())
        .step_by(local_map_size)
        .enumerate()
        .map(|(number, start)| {
            let own = start..(start + local_map_size).min(poses.len());
            let near = |a: usize, b: usize| distance_m(&poses[a], &poses[b]) <= overlap_m;
            let mut used = own.clone();
            while used.start > 0 && near(used.start - 1, own.start) {
                used.start -= 1;
            }
            while used.end < poses.len() && near(used.end, own.end - 1) {
                used.end += 1;
            }
            LocalMapPlan { number, own, used }
        })
        .collect()
}

fn distance_m(a: &Pose3, b: &Pose3) -> f64 {
    (a.translation.vector - b.translation.vector).norm()
}

/// Owner of each cell of the plane: the local map of the nearest key scan.
#[derive(Clone, Debug)]
pub struct Ownership {
    grid: Grid2,
    owners: Vec<u32>,
}

impl Ownership {
    /// Requires the memory of the plane within `reach_m` of the poses, of about 48 MB per square
    /// kilometre.
    pub fn require_memory(poses: &[Pose3], reach_m: f64) -> Result<(), MemoryError> {
        const CELL_BYTES: f64 = 12.0;
        let extent_m = |axis: usize| {
            let along = poses.iter().map(|pose| pose.translation.vector[axis]);
            let max = along.clone().fold(f64::NEG_INFINITY, f64::max);
            max - along.fold(f64::INFINITY, f64::min) + 2.0 * reach_m
        };
        memory::require(
            "the plane around the drive",
            extent_m(0) * extent_m(1) / OWNER_CELL_M.powi(2) * CELL_BYTES,
            "map a shorter drive (start_idx, n_scans), lower crop_x and crop_y, or check the poses",
        )
    }

    /// Assigns the plane within `reach_m` of a key scan; `poses` are `map_from_lidar` of the key scans.
    pub fn new(poses: &[Pose3], plans: &[LocalMapPlan], reach_m: f64) -> Self {
        let positions: Vec<Point2<f64>> = poses
            .iter()
            .map(|pose| pose.translation.vector.xy().into())
            .collect();
        let corner = |pick: fn(f64, f64) -> f64, start: f64, margin_m: f64| {
            let along =
                |axis: usize| positions.iter().map(|p| p[axis]).fold(start, pick) + margin_m;
            Point2::new(along(0), along(1))
        };
        let grid = Grid2::covering(
            corner(f64::min, f64::INFINITY, -reach_m),
            corner(f64::max, f64::NEG_INFINITY, reach_m),
            OWNER_CELL_M,
        );
        let mut owner_of_scan = vec![0; poses.len()];
        for plan in plans {
            owner_of_scan[plan.own.clone()].fill(plan.number as u32);
        }
        let owners = nearest_positions(&grid, &positions)
            .into_iter()
            .map(|scan| owner_of_scan[scan])
            .collect();
        Self { grid, owners }
    }

    /// Returns the grid in whose cells ownership is decided.
    pub fn grid(&self) -> &Grid2 {
        &self.grid
    }

    /// Returns the number of the local map that owns a cell; `None` outside the grid.
    pub fn owner_of(&self, column: usize, row: usize) -> Option<usize> {
        let is_inside = column < self.grid.columns && row < self.grid.rows;
        is_inside.then(|| self.owners[row * self.grid.columns + column] as usize)
    }
}

/// Returns for each cell of a grid the index of the position nearest to its center, the first among
/// equals; there must be at least one position.
///
/// Only positions that are nearest to some point of a square of cells are compared: by the triangle
/// inequality they lie within the least distance from the center of the square plus its diameter.
fn nearest_positions(grid: &Grid2, positions: &[Point2<f64>]) -> Vec<usize> {
    const SQUARE_CELLS: usize = 16;
    // Diameter of the circle around a square, rounded up.
    let diameter_m = 1.5 * SQUARE_CELLS as f64 * grid.cell_m;
    let mut nearest = vec![0; grid.len()];
    for first_row in (0..grid.rows).step_by(SQUARE_CELLS) {
        for first_column in (0..grid.columns).step_by(SQUARE_CELLS) {
            let corner = grid.center(first_column, first_row);
            let center = corner.map(|m| m + 0.5 * (SQUARE_CELLS - 1) as f64 * grid.cell_m);
            let distances_m: Vec<f64> = positions.iter().map(|p| (p - center).norm()).collect();
            let reach_m = distances_m.iter().copied().fold(f64::INFINITY, f64::min) + diameter_m;
            let candidates: Vec<usize> = (0..positions.len())
                .filter(|&i| distances_m[i] <= reach_m)
                .collect();
            for row in first_row..grid.rows.min(first_row + SQUARE_CELLS) {
                for column in first_column..grid.columns.min(first_column + SQUARE_CELLS) {
                    let cell = grid.center(column, row);
                    let squared = |i: usize| (positions[i] - cell).norm_squared();
                    nearest[row * grid.columns + column] = candidates
                        .iter()
                        .copied()
                        .min_by(|&a, &b| squared(a).total_cmp(&squared(b)))
                        .unwrap_or(0);
                }
            }
        }
    }
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive(positions_m: impl IntoIterator<Item = f64>) -> Vec<Pose3> {
        (positions_m.into_iter())
            .map(|x| Pose3::translation(x, 0.0, 0.0))
            .collect()
    }

    #[test]
    fn a_car_without_motion_has_one_key_scan_and_a_slow_one_a_key_scan_per_displacement() {
        let parked = drive([0.0; 50]);
        assert_eq!(key_scans(&parked, 0.2).len(), 1);
        let creeping = drive((0..50).map(|i| 0.05 * f64::from(i)));
        assert_eq!(key_scans(&creeping, 0.199).len(), 13);
    }

    #[test]
    fn every_key_scan_is_in_exactly_one_local_map() {
        let poses = drive((0..23).map(f64::from));
        let plans = local_maps(&poses, 10, 2.0);
        let owned: Vec<usize> = plans.iter().flat_map(|plan| plan.own.clone()).collect();
        assert_eq!(owned, (0..23).collect::<Vec<_>>());
        assert_eq!(plans[1].used, 8..22);
        assert_eq!(plans[2].used, 18..23);
    }

    #[test]
    fn a_cell_is_owned_by_the_local_map_of_the_nearest_scan() {
        let poses = drive((0..20).map(f64::from));
        let plans = local_maps(&poses, 10, 2.0);
        let ownership = Ownership::new(&poses, &plans, 30.0);
        let owner_at = |x: f64, y: f64| {
            let (column, row) = ownership.grid().cell_at(x, y)?;
            ownership.owner_of(column, row)
        };
        assert_eq!(owner_at(3.0, 20.0), Some(0));
        assert_eq!(owner_at(9.1, -20.0), Some(0));
        assert_eq!(owner_at(9.9, -20.0), Some(1));
        assert_eq!(owner_at(40.0, 0.0), Some(1));
        assert_eq!(owner_at(60.0, 0.0), None);
    }

    #[test]
    fn nearest_positions_agree_with_comparing_all() {
        let positions: Vec<Point2<f64>> = (0..60)
            .map(|i| Point2::new(f64::from(i).sin() * 40.0, f64::from(i) * 0.9))
            .collect();
        let grid = Grid2::covering(Point2::new(-50.0, -10.0), Point2::new(49.0, 70.0), 0.7);
        let nearest = nearest_positions(&grid, &positions);
        for (index, &found) in nearest.iter().enumerate() {
            let center = grid.center(index % grid.columns, index / grid.columns);
            let squared = |p: &Point2<f64>| (p - center).norm_squared();
            assert!(
                positions
                    .iter()
                    .all(|p| squared(p) >= squared(&positions[found]))
            );
        }
    }
}
