//! Returns of the own car: what stays in the lidar frame while the surroundings move.
//!
//! The space around the sensor is divided into cells. A cell is constant if most scans have a return in it. The
//! sensor moves if few returns in the surroundings are in constant cells. Then the own car is what is constant
//! near the sensor, stands out above the ground and ends below the sensor and within reach: the ground, walls of a
//! corridor and guard rails are constant as well.

use std::collections::BTreeMap;

use glam::{IVec2, IVec3, Vec3};

use super::mounting::Surroundings;

/// Edge of a cell [m].
const CELL_M: f32 = 0.2;
/// Share of the scans that have a return in a constant cell (unitless).
const CONSTANT_SHARE: f64 = 0.8;
/// Greatest horizontal distance of the own car from the sensor [m].
const REACH_M: f32 = 5.0;
/// Horizontal distances of the surroundings [m].
const SURROUNDINGS_M: std::ops::Range<f32> = 6.0..25.0;
/// Share of the returns of the surroundings in constant cells, at most, if the sensor moves (unitless).
const MAX_CONSTANT: f64 = 0.6;
/// Fewest scans that show motion.
const MIN_SCANS: usize = 5;
/// Least height above the ground [m].
const CLEARANCE_M: f32 = 0.25;

/// The own car in the lidar frame.
pub struct OwnCar {
    /// x_min, x_max, y_min, y_max [m]; all 0 if it has no returns, or if the scans do not show motion.
    pub rectangle_m: [f32; 4],
    /// Rectangle of the returns that do not count for the limits of range; without motion, of what stands out close
    /// below the sensor.
    pub near_m: [f32; 4],
    /// Whether the scans show that the sensor moves.
    pub is_moving: bool,
}

/// Finds the own car. Where the scans do not show that the sensor moves, all that they show may be surroundings, and
/// none is found.
pub fn find(surroundings: &Surroundings) -> OwnCar {
    let returns: Vec<Vec<Vec3>> = surroundings.scans.iter().map(above_ground).collect();
    let around = counts(&returns, |p| {
        SURROUNDINGS_M.contains(&p.truncate().length())
    });
    let needed = (CONSTANT_SHARE * returns.len() as f64).ceil() as usize;
    let share = |is_counted: &dyn Fn(usize) -> bool| {
        let cells = around.values().filter(|&&scans| is_counted(scans));
        cells.copied().sum::<usize>() as f64
    };
    let is_moving = returns.len() >= MIN_SCANS
        && share(&|scans| scans >= needed) < MAX_CONSTANT * share(&|_| true);

    /// Distance within which returns do not count for the limits of range without motion [m].
    const STANDING_REACH_M: f32 = 1.5;
    let reach_m = if is_moving { REACH_M } else { STANDING_REACH_M };
    let near = counts(&returns, |p| p.truncate().length() < reach_m);
    let constant = near.iter().filter(|(_, scans)| **scans >= needed);
    let near_m = rectangle(constant.map(|(&cell, _)| cell).collect(), reach_m);
    OwnCar {
        rectangle_m: if is_moving { near_m } else { [0.0; 4] },
        near_m,
        is_moving,
    }
}

fn above_ground((points, plane): &(&[Vec3], Option<crate::ground::RoadPlane>)) -> Vec<Vec3> {
    let height_m = |point: &Vec3| match plane {
        Some(plane) => plane.up.dot(*point) + plane.height_m as f32,
        None => f32::INFINITY,
    };
    let near = |point: &&Vec3| point.length_squared() < SURROUNDINGS_M.end.powi(2);
    let points = points.iter().filter(near);
    points
        .filter(|point| height_m(point) > CLEARANCE_M)
        .copied()
        .collect()
}

/// Number of scans with a return in each cell.
fn counts(scans: &[Vec<Vec3>], is_counted: impl Fn(&Vec3) -> bool) -> BTreeMap<[i32; 3], usize> {
    let mut counts = BTreeMap::new();
    for points in scans {
        let mut cells: Vec<[i32; 3]> = (points.iter().filter(|point| is_counted(point)))
            .map(|&point| (point / CELL_M).floor().as_ivec3().to_array())
            .collect();
        cells.sort_unstable();
        cells.dedup();
        cells
            .into_iter()
            .for_each(|cell| *counts.entry(cell).or_default() += 1);
    }
    counts
}

/// Bounds of the groups of cells that end below the sensor and within reach.
fn rectangle(cells: Vec<[i32; 3]>, reach_m: f32) -> [f32; 4] {
    /// Cells at most this far apart are of one group.
    const CONNECTED: i32 = 2;
    /// Cells at the edge of the reach are of something that continues.
    const EDGE_M: f32 = 3.0 * CELL_M;
    /// Greatest height of the own car above the sensor [m].
    const ABOVE_M: f32 = 0.2;
    let mut rest: Vec<IVec3> = cells.into_iter().map(IVec3::from_array).collect();
    let (mut least, mut greatest) = (IVec2::MAX, IVec2::MIN);
    while let Some(first) = rest.pop() {
        let mut group = vec![first];
        let mut next = 0;
        while next < group.len() {
            let cell = group[next];
            let is_near = |other: &mut IVec3| (*other - cell).abs().max_element() <= CONNECTED;
            group.extend(rest.extract_if(.., is_near));
            next += 1;
        }
        let center = |cell: &IVec3| (cell.as_vec3() + 0.5) * CELL_M;
        let ends = |cell: &IVec3| {
            let center = center(cell);
            center.z < ABOVE_M && center.truncate().length() < reach_m - EDGE_M
        };
        if group.iter().all(ends) {
            for cell in group {
                // One cell more, for the returns that come and go at the edges.
                least = least.min(cell.truncate() - 1);
                greatest = greatest.max(cell.truncate() + 2);
            }
        }
    }
    if least.x > greatest.x {
        return [0.0; 4];
    }
    let [x_min, y_min] = (least.as_vec2() * CELL_M).to_array();
    let [x_max, y_max] = (greatest.as_vec2() * CELL_M).to_array();
    [x_min, x_max, y_min, y_max]
}
