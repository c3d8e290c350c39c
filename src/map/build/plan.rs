//! Division of a drive into local maps, and of the plane into the regions that they own.
//!
//! A scan is a key scan if the car has moved since the previous key scan. Every `local_map_size` key
//! scans, and at the end of the recording, a local map is complete. It is meshed from its own scans
//! and those a few metres before and after. Of its mesh it keeps what is closer to its own scans than
//! to those of any other local map of its storey, clipped exactly at the border (see `seam`): neighbours
//! meet without overlap, also where the drive crosses itself. Where it leads over itself, as on the ramp of a
//! car park or a bridge, each storey has its own local maps.

use std::ops::Range;

use glam::{DVec3, Vec3};
use nalgebra::{Point2, Point3};

use crate::geometry::{Aabb, Grid2, Pose3};
use crate::map::LEVEL_GAP_M;
use crate::memory::{MemoryBudget, MemoryError};

/// Edge of the cells in which ownership is decided [m].
const OWNER_CELL_M: f64 = 0.5;

/// Origins of local maps are multiples of it [m]: their coordinates and the edges of cells are exact in `f32`.
const ORIGIN_STEP_M: f64 = 4096.0;

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

/// Horizontal distance within which scans may be on different storeys of a building [m]: between two aisles.
const STOREY_WIDTH_M: f64 = 20.0;

/// A drive between scans of different storeys is at least this many times as long as the distance between them; a
/// street on a hill leads straight from one to the other.
const DETOUR: f64 = 3.0;

/// Owners of each cell of the plane: the local map of the nearest key scan, and those of the nearest ones on other storeys.
///
/// Cells begin at multiples of their edge. Nothing is kept per cell of the plane: each local map asks for the region
/// around itself.
#[derive(Clone, Debug)]
pub struct Ownership {
    scans: Vec<KeyScan>,
}

/// A key scan that owns what is around it.
#[derive(Clone, Copy, Debug)]
struct KeyScan {
    /// Position in the map frame [m].
    position: Point3<f64>,
    /// Length of the drive up to it [m].
    driven_m: f64,
    /// Number of its local map.
    owner: u32,
}

impl KeyScan {
    /// Horizontal distance from a position [m].
    fn distance_m(&self, position: Point2<f64>) -> f64 {
        (self.position.xy() - position).norm()
    }

    fn is_on_another_storey(&self, other: &Self) -> bool {
        let apart_m = self.position - other.position;
        apart_m.z.abs() > LEVEL_GAP_M
            && apart_m.xy().norm() < STOREY_WIDTH_M
            && (self.driven_m - other.driven_m).abs() > DETOUR * apart_m.norm()
    }
}

/// A local map in the plane.
#[derive(Clone, Copy, Debug)]
pub struct Domain<'a> {
    /// Number of the local map.
    pub number: usize,
    /// Origin of its coordinates in the map frame [m].
    pub origin: DVec3,
    /// Owners of the plane.
    pub ownership: &'a Ownership,
}

/// The cells that a local map owns in a rectangle of the plane.
#[derive(Clone, Debug)]
pub struct Region {
    /// The cells of the rectangle, map frame.
    pub grid: Grid2,
    is_own: Vec<bool>,
}

impl Ownership {
    /// Assigns the plane to the local maps of key scans; `poses` are their `map_from_lidar`.
    pub fn new(poses: &[Pose3], plans: &[LocalMapPlan]) -> Self {
        let mut owners = vec![0; poses.len()];
        for plan in plans {
            owners[plan.own.clone()].fill(plan.number as u32);
        }
        let mut driven_m = 0.0;
        let scans = (poses.iter().zip(owners).enumerate()).map(|(index, (pose, owner))| {
            if index > 0 {
                driven_m += distance_m(&poses[index - 1], pose);
            }
            KeyScan {
                position: pose.translation.vector.into(),
                driven_m,
                owner,
            }
        });
        Self {
            scans: scans.collect(),
        }
    }

    /// Requires the memory of the plane within `reach_m` of the scans of any local map.
    pub fn require_memory(
        poses: &[Pose3],
        plans: &[LocalMapPlan],
        reach_m: f64,
        budget: MemoryBudget,
    ) -> Result<(), MemoryError> {
        const CELL_BYTES: f64 = 10.0;
        let area_m2 = |plan: &LocalMapPlan| {
            let extent_m = |axis: usize| {
                let scans = &poses[plan.used.clone()];
                let along = scans.iter().map(|pose| pose.translation.vector[axis]);
                let max = along.clone().fold(f64::NEG_INFINITY, f64::max);
                max - along.fold(f64::INFINITY, f64::min) + 2.0 * reach_m
            };
            extent_m(0) * extent_m(1)
        };
        let largest_m2 = plans.iter().map(area_m2).fold(0.0, f64::max);
        budget.require(
            "the plane around a local map",
            largest_m2 / OWNER_CELL_M.powi(2) * CELL_BYTES,
            "lower local_map_size, local_map.crop_x_m or local_map.crop_y_m, or check the poses",
        )
    }

    /// The cells that a local map owns in a rectangle [m], map frame.
    pub fn region(&self, number: usize, min: Point2<f64>, max: Point2<f64>) -> Region {
        let grid = Grid2::covering(lower_corner(min), max, OWNER_CELL_M);
        let is_own = self.is_owned(&grid, number as u32);
        Region { grid, is_own }
    }

    /// Whether a local map owns the cell of a position [m], map frame.
    pub fn is_owner_at(&self, number: usize, x: f64, y: f64) -> bool {
        let corner = lower_corner(Point2::new(x, y));
        let center = corner.map(|along| along + 0.5 * OWNER_CELL_M);
        nearest_per_storey(self.scans.iter(), center).any(|scan| scan.owner as usize == number)
    }

    /// Returns for each cell of a grid whether a local map owns it.
    ///
    /// Only scans that are nearest to some point of the grid, and of a square of its cells, or that may be on another storey
    /// there, are compared: by the triangle inequality they lie within the least distance from the center of the square plus
    /// its diameter and the width of a storey.
    fn is_owned(&self, grid: &Grid2, number: u32) -> Vec<bool> {
        const SQUARE_CELLS: usize = 16;
        let all: Vec<&KeyScan> = self.scans.iter().collect();
        let near_grid = near_square(&all, grid, (0, 0), grid.columns.max(grid.rows));
        let mut is_owned = vec![false; grid.len()];
        for first_row in (0..grid.rows).step_by(SQUARE_CELLS) {
            for first_column in (0..grid.columns).step_by(SQUARE_CELLS) {
                let first = (first_column, first_row);
                let candidates = near_square(&near_grid, grid, first, SQUARE_CELLS);
                for row in first_row..grid.rows.min(first_row + SQUARE_CELLS) {
                    for column in first_column..grid.columns.min(first_column + SQUARE_CELLS) {
                        let center = grid.center(column, row);
                        is_owned[row * grid.columns + column] =
                            nearest_per_storey(candidates.iter().copied(), center)
                                .any(|scan| scan.owner == number);
                    }
                }
            }
        }
        is_owned
    }
}

/// Those of some scans that are nearest to a position [m], one per storey: the nearest one, the first among equals, and
/// repeatedly the nearest of those that are on another storey than all before.
fn nearest_per_storey<'a>(
    scans: impl Iterator<Item = &'a KeyScan> + Clone,
    position: Point2<f64>,
) -> impl Iterator<Item = &'a KeyScan> {
    let mut found: Vec<&KeyScan> = Vec::with_capacity(1);
    std::iter::from_fn(move || {
        let is_other = |scan: &&KeyScan| found.iter().all(|it| it.is_on_another_storey(scan));
        let others = scans.clone().filter(is_other);
        let distance_m = |scan: &&KeyScan| scan.distance_m(position);
        let nearest = others.min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)))?;
        found.push(nearest);
        Some(nearest)
    })
}

/// Those of some scans that may be the nearest of a storey to a point of a square of cells.
fn near_square<'a>(
    scans: &[&'a KeyScan],
    grid: &Grid2,
    (column, row): (usize, usize),
    cells: usize,
) -> Vec<&'a KeyScan> {
    // Diameter of the circle around the square, rounded up.
    let diameter_m = 1.5 * cells as f64 * grid.cell_m;
    let corner = grid.center(column, row);
    let center = corner.map(|m| m + 0.5 * (cells - 1) as f64 * grid.cell_m);
    let distances_m = scans.iter().map(|scan| scan.distance_m(center));
    let least_m = distances_m.fold(f64::INFINITY, f64::min);
    let most_m = least_m + diameter_m + STOREY_WIDTH_M;
    let is_near = |scan: &&KeyScan| scan.distance_m(center) <= most_m;
    scans.iter().copied().filter(is_near).collect()
}

/// The origin of the coordinates of what is around a position [m], map frame: that of the map where it is nearer than 2 km.
pub fn origin_near(position: DVec3) -> DVec3 {
    (position / ORIGIN_STEP_M).round() * ORIGIN_STEP_M
}

impl Domain<'_> {
    /// The cells that it owns within and next to a box in its coordinates.
    pub fn region(&self, bounds: &Aabb) -> Region {
        let bounds = if bounds.is_empty() {
            Aabb::from_points([Vec3::ZERO])
        } else {
            *bounds
        };
        let corner = |corner: Vec3, margin_m: f64| {
            let corner = self.origin + corner.as_dvec3() + margin_m;
            Point2::new(corner.x, corner.y)
        };
        let (min, max) = (
            corner(bounds.min, -OWNER_CELL_M),
            corner(bounds.max, OWNER_CELL_M),
        );
        self.ownership.region(self.number, min, max)
    }
}

impl Region {
    /// Whether a cell of the grid is owned; none outside it is.
    pub fn contains(&self, column: usize, row: usize) -> bool {
        let is_inside = column < self.grid.columns && row < self.grid.rows;
        is_inside && self.is_own[row * self.grid.columns + column]
    }
}

/// Lower corner of the cell of a position [m].
fn lower_corner(position: Point2<f64>) -> Point2<f64> {
    position.map(|along| (along / OWNER_CELL_M).floor() * OWNER_CELL_M)
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
        let ownership = Ownership::new(&poses, &local_maps(&poses, 10, 2.0));
        for (x, y, owner) in [
            (3.0, 20.0, 0),
            (9.1, -20.0, 0),
            (9.9, -20.0, 1),
            (4e6, 0.0, 1),
        ] {
            for number in 0..2 {
                assert_eq!(ownership.is_owner_at(number, x, y), number == owner);
                let region = ownership.region(number, [x, y].into(), [x + 0.3, y + 0.3].into());
                assert_eq!(region.contains(0, 0), number == owner, "{x} {y}");
            }
        }
    }

    #[test]
    fn regions_agree_with_comparing_all_scans_and_do_not_depend_on_their_rectangle() {
        let poses: Vec<Pose3> = (0..60)
            .map(|i| Pose3::translation(f64::from(i).sin() * 40.0, f64::from(i) * 0.9, 0.0))
            .collect();
        let ownership = Ownership::new(&poses, &local_maps(&poses, 7, 2.0));
        for (min, max) in [([-50.1, -10.2], [49.0, 70.0]), ([3.3, 4.4], [20.0, 9.0])] {
            for number in 0..9 {
                let region = ownership.region(number, min.into(), max.into());
                for row in 0..region.grid.rows {
                    for column in 0..region.grid.columns {
                        let center = region.grid.center(column, row);
                        let is_own = ownership.is_owner_at(number, center.x, center.y);
                        assert_eq!(region.contains(column, row), is_own);
                    }
                }
            }
        }
    }

    /// Numbers of the local maps that own a cell.
    fn owners(poses: &[Pose3], [x, y]: [f64; 2]) -> Vec<usize> {
        let plans = local_maps(poses, 50, 2.0);
        let ownership = Ownership::new(poses, &plans);
        let owners = (0..plans.len()).filter(|&number| {
            let region = ownership.region(number, [x, y].into(), [x + 0.3, y + 0.3].into());
            let is_owner = ownership.is_owner_at(number, x, y);
            assert_eq!(region.contains(0, 0), is_owner);
            is_owner
        });
        owners.collect()
    }

    #[test]
    fn each_storey_of_a_ramp_owns_what_is_around_it() {
        // A helix of three turns with a radius of 8 m, 50 scans and 3 m of height each.
        let helix: Vec<Pose3> = (0..150)
            .map(|i| {
                let turn = std::f64::consts::TAU * f64::from(i) / 50.0;
                Pose3::translation(8.0 * turn.cos(), 8.0 * turn.sin(), 0.06 * f64::from(i))
            })
            .collect();
        for place in [[8.0, 3.0], [-8.0, 0.3], [0.4, 20.0]] {
            assert_eq!(owners(&helix, place), [0, 1, 2], "{place:?}");
        }
    }

    #[test]
    fn a_bridge_and_the_road_below_it_are_owned_by_both_and_a_crossing_by_one() {
        // 100 m straight on, a loop to the left, and back across the middle of it at some height.
        let drive = |height_m: f64| -> Vec<Pose3> {
            let along = (0..50).map(|i| Pose3::translation(2.0 * f64::from(i), 0.0, 0.0));
            let aside = (0..50).map(|i| {
                let rise = f64::from(i) / 49.0;
                Pose3::translation(100.0 - rise * 50.0, 60.0, rise * height_m)
            });
            let across =
                (0..50).map(|i| Pose3::translation(50.0, 60.0 - 2.0 * f64::from(i), height_m));
            along.chain(aside).chain(across).collect()
        };
        assert_eq!(owners(&drive(5.0), [50.0, 0.4]), [0, 2]);
        assert_eq!(owners(&drive(1.0), [50.2, 4.0]), [2]);
        assert_eq!(owners(&drive(5.0), [0.0, 0.4]), [0]);
    }

    #[test]
    fn a_steep_street_and_streets_on_a_slope_have_one_owner_at_each_place() {
        let steep: Vec<Pose3> = (0..150)
            .map(|i| Pose3::translation(f64::from(i), 0.0, 0.3 * f64::from(i)))
            .collect();
        assert_eq!(owners(&steep, [60.2, 3.0]), [1]);
        assert_eq!(owners(&steep, [110.2, -30.0]), [2]);
        // Back 40 m up the slope.
        let slope: Vec<Pose3> = (0..100)
            .map(|i| match f64::from(i) {
                x if x < 50.0 => Pose3::translation(x, 0.0, 0.0),
                x => Pose3::translation(99.0 - x, 40.0, 6.0),
            })
            .collect();
        assert_eq!(owners(&slope, [20.2, 15.0]), [0]);
        assert_eq!(owners(&slope, [20.2, 25.0]), [1]);
    }
}
