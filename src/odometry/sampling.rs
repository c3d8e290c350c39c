//! Points of a scan for the odometry: valid ones, thinned to one per voxel.

use foldhash::HashSet;
use glam::{DMat3, DQuat, DVec3, Vec3};
use nalgebra::UnitQuaternion;

use super::config::OdometryConfig;
use super::voxel_map::{cell_of, pack};
use crate::geometry::Pose3;
use crate::inertial::MeasuredRotation;
use crate::lidar::{Motion, Scan, Sweep};

/// A measured point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TimedPoint {
    /// Position in the lidar frame at the time of measurement [m].
    pub position: Vec3,
    /// Time of measurement after the moment of the scan's pose [s].
    pub time_s: f32,
}

/// Valid points of a scan, at most one per voxel.
#[derive(Clone, Debug)]
pub struct Sample {
    /// The points, in the order of the scan.
    pub points: Vec<TimedPoint>,
    /// Their times.
    pub sweep: Sweep,
    /// The measured rotation around the moment of the scan; `None` without a gyroscope.
    pub rotation: Option<MeasuredRotation>,
}

impl Sample {
    /// The sample of a scan without enough points.
    pub fn empty() -> Self {
        Self {
            points: vec![],
            sweep: Sweep::spanning(std::iter::empty()),
            rotation: None,
        }
    }

    /// Samples a scan for a sensor of range `range_m`, whose rotation around its moment may be measured.
    pub fn new(
        scan: &Scan,
        rotation: Option<MeasuredRotation>,
        range_m: f64,
        config: &OdometryConfig,
    ) -> Self {
        /// Larger times before or after the moment of the pose are errors [s].
        const MAX_TIME_S: f32 = 1.0;
        /// Largest range of a point, in ranges of the sensor.
        const MAX_RANGE: f64 = 2.0;
        let min_range_m = (config.min_range_share * range_m) as f32;
        let max_range_m = (MAX_RANGE * range_m) as f32;
        let valid = (scan.points.iter().enumerate())
            .map(|(index, &position)| TimedPoint {
                position,
                time_s: scan.times_s.get(index).copied().unwrap_or(0.0),
            })
            .filter(|point| {
                let square = point.position.length_squared();
                square >= min_range_m * min_range_m
                    && square <= max_range_m * max_range_m
                    && point.time_s.abs() <= MAX_TIME_S
            });
        let points = first_per_voxel(valid, config.map_spacing * config.voxel_share * range_m);
        let sweep = Sweep::spanning(points.iter().map(|point| point.time_s));
        Self {
            points,
            sweep,
            rotation,
        }
    }

    /// Points in the frame of a pose, compensated by the motion.
    pub fn mapped(&self, odom_from_lidar: &Pose3, motion: Option<&Motion>) -> Vec<DVec3> {
        let rotation = DMat3::from_quat(DQuat::from(odom_from_lidar.rotation));
        let translation = DVec3::from(odom_from_lidar.translation.vector);
        let still = Motion {
            previous_from_current: Pose3::identity(),
            duration_s: 1.0,
        };
        let motion = motion.unwrap_or(&still);
        let compensation = self.sweep.transforms(motion, self.turns().as_deref());
        (self.points.iter())
            .map(|point| {
                let in_lidar =
                    compensation[self.sweep.interval(point.time_s)].apply(point.position);
                rotation * in_lidar.as_dvec3() + translation
            })
            .collect()
    }

    /// For each interval of the sweep, the measured rotation of points to the moment of the scan.
    pub fn turns(&self) -> Option<Vec<UnitQuaternion<f64>>> {
        self.sweep.turns(self.rotation.as_ref())
    }

    /// Points at a larger distance from each other.
    pub fn thinned(&self, voxel_m: f64) -> Vec<TimedPoint> {
        first_per_voxel(self.points.iter().copied(), voxel_m)
    }
}

/// The first point in each voxel.
pub fn first_per_voxel(points: impl Iterator<Item = TimedPoint>, voxel_m: f64) -> Vec<TimedPoint> {
    let per_m = (1.0 / voxel_m) as f32;
    let mut occupied = HashSet::<u64>::default();
    let mut last = None;
    points
        .filter(|point| {
            let voxel = pack(cell_of((point.position * per_m).as_dvec3()));
            // Successive points are often in one voxel, which needs no search.
            last.replace(voxel) != Some(voxel) && occupied.insert(voxel)
        })
        .collect()
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
