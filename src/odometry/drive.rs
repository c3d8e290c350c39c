//! A drive as it is kept for loops and adjustment: a sample of the points of every scan, and submaps of them.

use std::ops::Range;

use glam::DVec3;

use super::level::Levels;
use super::sampling::{Sample, TimedPoint, first_per_voxel};
use super::voxel_map::VoxelMap;
use crate::geometry::{Pose3, distances_m};
use crate::lidar::Motion;

/// Remedy for a drive that exceeds the budget of memory.
pub const SHORTER: &str = "select fewer scans with start_idx and n_scans";

/// Memory of a point for loops and adjustment [bytes].
pub const POINT_BYTES: f64 = 120.0;

/// Samples of the scans of a drive, and their poses.
#[derive(Clone, Debug)]
pub struct Drive {
    /// A sample of each scan.
    pub samples: Vec<Sample>,
    /// Times of the scans, ascending [s].
    pub times_s: Vec<f64>,
    /// `p_map = map_from_lidar * p_lidar` of each scan.
    pub poses: Vec<Pose3>,
    /// Range of the sensor [m].
    pub range_m: f64,
    /// Edge of the voxels of the odometry [m].
    pub voxel_m: f64,
    /// Directions up that an accelerometer has shown; the map is level then.
    pub levels: Option<Levels>,
}

/// Scans in succession, whose poses relative to each other are taken as known.
#[derive(Clone, Debug, PartialEq)]
pub struct Submap {
    /// Rows of the scans.
    pub rows: Range<usize>,
    /// The row whose lidar frame is that of the submap.
    pub center: usize,
    /// Length of the path up to the center [m].
    pub travelled_m: f64,
}

impl Drive {
    /// Points of a scan in the map frame, compensated by the motion around it.
    pub fn points(&self, row: usize) -> Vec<DVec3> {
        self.points_at(row, &self.poses[row])
    }

    /// The same points in the frame of another pose of the scan.
    fn points_at(&self, row: usize, frame_from_lidar: &Pose3) -> Vec<DVec3> {
        let motion = Motion::along(&self.poses, &self.times_s, row);
        self.samples[row].mapped(frame_from_lidar, motion.as_ref())
    }

    /// Submaps of about `length_m` of the path each.
    pub fn submaps(&self, length_m: f64) -> Vec<Submap> {
        let travelled_m = distances_m(&self.poses);
        let mut maps = vec![];
        let mut first = 0;
        while first < travelled_m.len() {
            let end_m = travelled_m[first] + length_m;
            let end = travelled_m.partition_point(|&path_m| path_m < end_m);
            let end = end.max(first + 1);
            let middle_m = 0.5 * (travelled_m[first] + travelled_m[end - 1]);
            let center = travelled_m.partition_point(|&path_m| path_m < middle_m);
            let center = center.clamp(first, end - 1);
            maps.push(Submap {
                rows: first..end,
                center,
                travelled_m: travelled_m[center],
            });
            first = end;
        }
        maps
    }

    /// Points of a submap in the frame of its center, at least about `spacing_m` from each other.
    pub fn submap_points(&self, map: &Submap, spacing_m: f64) -> Vec<TimedPoint> {
        let lidar_from_map = self.poses[map.center].inverse();
        let points = evenly_spaced(&map.rows)
            .flat_map(|row| self.points_at(row, &(lidar_from_map * self.poses[row])));
        let still = points.map(|point| TimedPoint {
            position: point.as_vec3(),
            time_s: 0.0,
        });
        first_per_voxel(still, spacing_m)
    }

    /// The surfaces of some submaps in the frame of a center.
    pub fn surfaces<'a>(&self, center: usize, maps: impl Iterator<Item = &'a Submap>) -> VoxelMap {
        const VOXEL_POINTS: f32 = 1000.0;
        let lidar_from_map = self.poses[center].inverse();
        let mut surfaces = VoxelMap::new(self.voxel_m, VOXEL_POINTS);
        for row in maps.flat_map(|map| evenly_spaced(&map.rows)) {
            surfaces.insert(&self.points_at(row, &(lidar_from_map * self.poses[row])));
        }
        surfaces
    }
}

/// At most ten rows: scans of a car that stands, or drives slowly, show the same.
fn evenly_spaced(rows: &Range<usize>) -> impl Iterator<Item = usize> + use<> {
    const MAX: usize = 10;
    rows.clone().step_by(rows.len().div_ceil(MAX).max(1))
}
