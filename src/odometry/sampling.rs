//! Points of a scan for the odometry: valid ones, thinned to one per voxel.

use std::collections::HashSet;

use glam::Vec3;

use super::voxel_map::{CellHasher, pack};
use crate::lidar::Scan;

/// A measured point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedPoint {
    /// Position in the lidar frame at the time of measurement [m].
    pub position: Vec3,
    /// Time of measurement after the moment of the scan's pose [s].
    pub time_s: f32,
}

/// Range that 98 % of the valid points do not exceed [m]; `None` with few points.
pub fn sensor_range(scan: &Scan) -> Option<f64> {
    /// Number of points that are looked at.
    const SAMPLE: usize = 5000;
    const QUANTILE: f64 = 0.98;
    /// Fewer points do not determine a pose.
    const MIN_POINTS: usize = 100;
    let step = scan.len().div_ceil(SAMPLE).max(1);
    let mut ranges: Vec<f32> = (scan.points.iter().step_by(step))
        .map(|point| point.length())
        .filter(|range| *range > 0.0 && range.is_finite())
        .collect();
    if ranges.len() < MIN_POINTS {
        return None;
    }
    let rank = (QUANTILE * (ranges.len() - 1) as f64) as usize;
    Some((*ranges.select_nth_unstable_by(rank, f32::total_cmp).1).into())
}

/// Points with valid ranges and times: the first in each voxel of edge `voxel_m`.
pub fn sample(scan: &Scan, min_range_m: f32, max_range_m: f32, voxel_m: f32) -> Vec<TimedPoint> {
    /// Longer after or before the moment of the pose, a time is an error [s].
    const MAX_TIME_S: f32 = 1.0;
    let time_of = |index: usize| scan.times_s.get(index).copied().unwrap_or(0.0);
    let points = (scan.points.iter().enumerate())
        .map(|(index, &position)| TimedPoint {
            position,
            time_s: time_of(index),
        })
        .filter(|point| {
            let range_sq = point.position.length_squared();
            range_sq >= min_range_m * min_range_m
                && range_sq <= max_range_m * max_range_m
                && point.time_s.abs() <= MAX_TIME_S
        });
    first_per_voxel(points, voxel_m)
}

/// The first point in each voxel of edge `voxel_m`, in order.
pub fn first_per_voxel(points: impl Iterator<Item = TimedPoint>, voxel_m: f32) -> Vec<TimedPoint> {
    let mut occupied = HashSet::<u64, CellHasher>::default();
    points
        .filter(|point| occupied.insert(pack((point.position / voxel_m).floor().as_ivec3())))
        .collect()
}
