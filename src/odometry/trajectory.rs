//! The trajectory of a whole drive: odometry, loops, and the adjustment of all poses to common surfaces.

use nalgebra::{Matrix6, Vector6};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::adjustment::{AdjustmentConfig, adjust};
use super::config::OdometryConfig;
use super::drive::{Drive, LocalMap};
use super::loops::{self, Drift, FoundLoop, Loop, LoopVerdict};
use super::odometer::{Odometer, OdometryError, OdometryEstimate, StepState};
use super::pose_graph::{Edge, optimize};
use super::sampling::{Sample, sensor_range};
use crate::geometry::Pose3;
use crate::lidar::{Scan, interpolate_motion, interval_s};
use crate::validation::{InvalidValue, Validate, in_range, nested};

/// Settings of the trajectory of a drive.
///
/// Defaults: our own values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct TrajectoryConfig {
    /// The odometry.
    pub odometry: OdometryConfig,
    /// Distance between the points that are kept of a scan, in voxels of the odometry.
    #[default(2.0)]
    pub sample_spacing: f64,
    /// Close loops.
    #[default(true)]
    pub loops: bool,
    /// Adjust all poses to common surfaces.
    #[default(true)]
    pub adjust: bool,
    /// The adjustment.
    pub adjustment: AdjustmentConfig,
}

impl Validate for TrajectoryConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("sample_spacing", self.sample_spacing, 0.1..=20.0)?;
        nested("odometry", &self.odometry)?;
        nested("adjustment", &self.adjustment)
    }
}

/// Poses of a drive, in the lidar frame of its first scan or that of the given poses.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// `p_map = map_from_lidar * p_lidar` of each scan.
    pub poses: Vec<Pose3>,
    /// Poses of the odometry alone.
    pub odometry: Vec<OdometryEstimate>,
    /// Loops that were found.
    pub loops: Vec<Loop>,
    /// Root mean square of the distances between points and common planes, before and after the adjustment [m].
    pub residuals_m: Option<[f64; 2]>,
}

/// Finds the trajectory of a drive, scan by scan.
#[derive(Clone, Debug)]
pub struct TrajectoryBuilder {
    config: TrajectoryConfig,
    odometer: Odometer,
    estimates: Vec<OdometryEstimate>,
    samples: Vec<Sample>,
    ranges_m: Vec<f64>,
    given: Vec<Pose3>,
    time_s: Option<f64>,
}

impl TrajectoryBuilder {
    /// A trajectory without scans.
    pub fn new(config: TrajectoryConfig) -> Result<Self, InvalidValue> {
        config.validate()?;
        Ok(Self {
            odometer: Odometer::new(config.odometry.clone())?,
            config,
            estimates: vec![],
            samples: vec![],
            ranges_m: vec![],
            given: vec![],
            time_s: None,
        })
    }

    /// Registers the next scan, and keeps a sample of its points.
    pub fn add(&mut self, scan: &Scan) -> Result<&OdometryEstimate, OdometryError> {
        let estimate = self.odometer.step(scan)?;
        self.keep(scan);
        self.estimates.push(estimate);
        let last = self.estimates.len() - 1;
        Ok(&self.estimates[last])
    }

    /// Keeps a sample of the next scan, whose pose is given; all or none of the poses of a drive are.
    pub fn add_given(&mut self, scan: &Scan, map_from_lidar: Pose3) {
        let last = self.given.last().unwrap_or(&map_from_lidar);
        let times_s = self.time_s.zip(scan.time_s);
        self.estimates.push(OdometryEstimate {
            odom_from_lidar: map_from_lidar,
            previous_from_current: last.inverse() * map_from_lidar,
            ..OdometryEstimate::first(match times_s {
                Some((before_s, time_s)) if time_s > before_s => interval_s(before_s, time_s),
                _ => self.config.odometry.period_s,
            })
        });
        self.given.push(map_from_lidar);
        self.keep(scan);
    }

    fn keep(&mut self, scan: &Scan) {
        let config = &self.config.odometry;
        let range_m = sensor_range(scan);
        let sample = range_m.map_or_else(Sample::empty, |range_m| {
            let spacing_m = self.config.sample_spacing * config.voxel_share * range_m;
            let sample = Sample::of(scan, range_m, config);
            Sample {
                points: sample.thinned(spacing_m),
                ..sample
            }
        });
        self.samples.push(sample);
        self.ranges_m.extend(range_m);
        self.time_s = scan.time_s;
    }

    /// Closes loops, unless the poses are given, and adjusts the poses.
    pub fn finish(mut self) -> Trajectory {
        let mut trajectory = Trajectory {
            poses: (self.estimates.iter())
                .map(|estimate| estimate.odom_from_lidar)
                .collect(),
            odometry: self.estimates,
            loops: vec![],
            residuals_m: None,
        };
        let middle = self.ranges_m.len() / 2;
        if self.ranges_m.is_empty() {
            return trajectory;
        }
        let range_m = *(self.ranges_m.select_nth_unstable_by(middle, f64::total_cmp)).1;
        let mut drive = Drive {
            samples: self.samples,
            times_s: times_s(&trajectory.odometry),
            poses: trajectory.poses.clone(),
            range_m,
            voxel_m: self.config.odometry.voxel_share * range_m,
        };
        let given = (!self.given.is_empty()).then_some(self.given);
        if self.config.loops && given.is_none() {
            trajectory.loops = close_loops(&mut drive, &trajectory.odometry);
        }
        if self.config.adjust {
            trajectory.residuals_m = adjust(&mut drive, given.as_deref(), &self.config.adjustment);
        }
        trajectory.poses = drive.poses;
        trajectory
    }
}

/// Times of scans since the first [s].
fn times_s(estimates: &[OdometryEstimate]) -> Vec<f64> {
    let mut time_s = 0.0;
    let later = estimates.iter().skip(1).map(|estimate| {
        time_s += estimate.duration_s;
        time_s
    });
    std::iter::once(0.0)
        .chain(later)
        .take(estimates.len())
        .collect()
}

/// Closes loops, twice: with better poses more are found.
fn close_loops(drive: &mut Drive, odometry: &[OdometryEstimate]) -> Vec<Loop> {
    /// Path of a local map, in ranges.
    const LOCAL_MAP: f64 = 0.12;
    /// Drift of the odometry, as a share of the path, and what is left of it after the first round.
    const DRIFT: [f64; 2] = [0.02, 0.005];
    let maps = drive.local_maps(LOCAL_MAP * drive.range_m);
    let along_path = odometry_edges(drive, &maps, odometry);
    let odometry = drive.poses.clone();
    let mut result = vec![];
    for share in DRIFT {
        let drift = Drift {
            share,
            least_m: drive.voxel_m,
        };
        let found = loops::find(drive, &maps, drift);
        let drift = Drift {
            share: DRIFT[0],
            ..drift
        };
        drive.poses.clone_from(&odometry);
        result = close(drive, &maps, &along_path, &found, drift);
        if !result
            .iter()
            .any(|found| found.verdict == LoopVerdict::Accepted)
        {
            break;
        }
    }
    result
}

/// Moves the poses by the loops that are confirmed.
fn close(
    drive: &mut Drive,
    maps: &[LocalMap],
    along_path: &[Edge],
    found: &[FoundLoop],
    drift: Drift,
) -> Vec<Loop> {
    /// Least weight of a loop in the pose graph.
    const MIN_WEIGHT: f64 = 0.1;
    let confirmed = loops::confirmed(drive, maps, found, drift);
    let used: Vec<Option<Edge>> = (found.iter().zip(&confirmed))
        .map(|(found, &is_confirmed)| found.edge(drive.voxel_m).filter(|_| is_confirmed))
        .collect();
    let edges: Vec<Edge> = (along_path.iter().cloned())
        .chain(used.iter().flatten().cloned())
        .collect();
    let centers: Vec<Pose3> = maps.iter().map(|map| drive.poses[map.center]).collect();
    let optimized = (used.iter().any(Option::is_some))
        .then(|| optimize(&centers, &edges))
        .flatten();
    let mut weights = optimized
        .iter()
        .flat_map(|(_, weights)| &weights[along_path.len()..]);
    let mut verdict = |edge: &Option<Edge>| match edge.as_ref().and_then(|_| weights.next()) {
        None => LoopVerdict::Unconfirmed,
        Some(&weight) if weight > MIN_WEIGHT => LoopVerdict::Accepted,
        Some(_) => LoopVerdict::Contradicted,
    };
    let result = (found.iter().zip(&used))
        .map(|(found, edge)| Loop {
            first: maps[found.maps[0]].center,
            second: maps[found.maps[1]].center,
            first_from_second: found.first_from_second,
            common_share: found.common_share,
            verdict: verdict(edge),
        })
        .collect();
    if let Some((optimized, _)) = optimized {
        move_along(&mut drive.poses, maps, &centers, &optimized);
    }
    result
}

/// Edges of the pose graph between local maps in succession.
fn odometry_edges(drive: &Drive, maps: &[LocalMap], odometry: &[OdometryEstimate]) -> Vec<Edge> {
    /// Standard deviation of the motion: share of the path, and at least in voxels.
    const SHARE: f64 = 0.003;
    const FLOOR: f64 = 0.01;
    /// Of the rotation [rad/m], and at least [rad].
    const TURN_RAD_PER_M: f64 = 2e-4;
    const TURN_FLOOR_RAD: f64 = 2e-4;
    /// Factor where scans could not be registered.
    const PREDICTED: f64 = 30.0;
    (maps.windows(2).enumerate())
        .map(|(first, pair)| {
            let [a, b] = [pair[0].center, pair[1].center];
            let first_from_second = drive.poses[a].inverse() * drive.poses[b];
            let path_m = pair[1].travelled_m - pair[0].travelled_m;
            let is_predicted =
                (odometry[a + 1..=b].iter()).any(|step| step.state == StepState::Predicted);
            let factor = if is_predicted { PREDICTED } else { 1.0 };
            let shift = (factor * (SHARE * path_m + FLOOR * drive.voxel_m)).powi(-2);
            let turn = (factor * (TURN_RAD_PER_M * path_m + TURN_FLOOR_RAD)).powi(-2);
            Edge {
                first,
                second: first + 1,
                first_from_second,
                information: Matrix6::from_diagonal(&Vector6::new(
                    shift, shift, shift, turn, turn, turn,
                )),
                is_loop: false,
            }
        })
        .collect()
}

/// Moves all poses with the centers of their local maps; the correction changes evenly from one to the next.
fn move_along(poses: &mut [Pose3], maps: &[LocalMap], before: &[Pose3], after: &[Pose3]) {
    let correction = |map: usize| after[map] * before[map].inverse();
    for (row, pose) in poses.iter_mut().enumerate() {
        let next = maps.partition_point(|map| map.center <= row);
        let last = next.saturating_sub(1);
        let next = next.min(maps.len() - 1);
        let span = maps[next].center - maps[last].center;
        let share = match span {
            0 => 0.0,
            span => (row - maps[last].center) as f64 / span as f64,
        };
        // As motions of the pose itself, whose turns do not move it.
        let moved = correction(last) * *pose;
        let further = moved.inverse() * correction(next) * *pose;
        *pose = moved * interpolate_motion(&further, share);
    }
}

#[cfg(test)]
#[path = "trajectory_tests.rs"]
mod tests;
