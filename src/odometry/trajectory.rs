//! The trajectory of a whole drive: odometry, loops, and the adjustment of all poses to common surfaces.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::adjustment::{Adjusted, AdjustmentConfig, Held, adjust};
use super::alignment::median;
use super::anchors::{self, NotInMap, Placed, PlacementError};
use super::config::{LoopConfig, OdometryConfig};
use super::drive::{Drive, POINT_BYTES, SHORTER, Submap};
use super::gnss::{self, GnssConstraints};
use super::imu_calibrator::measured_turn;
use super::level::{Levelled, level};
use super::loops::{self, Drift, FoundLoop, Loop, LoopVerdict};
use super::odometer::{Odometer, OdometryError, OdometryEstimate, StepState};
use super::path_graph::{SUBMAP_LENGTH, keep_level, move_along, odometry_edges};
use super::pose_graph::{Edge, optimize_with};
use super::sampling::{Sample, sensor_range};
use crate::geometry::{Pose3, TriangleMesh};
use crate::inertial::{Imu, ImuCalibration, ImuRejection, MeasuredTurn};
use crate::lidar::{PERIOD_S, Scan, interval_s};
use crate::memory::{MemoryBudget, MemoryError};
use crate::validation::{InvalidValue, Validate, in_range, nested};

/// Settings of the trajectory of a drive.
///
/// Defaults: our own values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
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
    /// Which loops count. A map of a recording without poses is made with the defaults.
    pub loop_closure: LoopConfig,
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
        nested("loop_closure", &self.loop_closure)?;
        nested("adjustment", &self.adjustment)
    }
}

/// Poses of a drive, in the lidar frame of its first scan, turned so that z points up where an inertial sensor shows it,
/// that of the given poses, or that of the map in which it was found.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    /// `p_map = map_from_lidar * p_lidar` of each scan.
    pub poses: Vec<Pose3>,
    /// Poses of the odometry alone; in a map, moved as a whole to where most of them agree with it.
    pub odometry: Vec<OdometryEstimate>,
    /// Loops that were found.
    pub loops: Vec<Loop>,
    /// What the adjustment of all poses has found; `None` without one.
    pub adjusted: Option<Adjusted>,
    /// What was found about the inertial sensor by which the poses are level; `None` without one, or where it was left out.
    pub inertial: Option<InertialEstimate>,
}

/// What was found about an inertial sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InertialEstimate {
    /// Its axes, clock and rate bias.
    pub calibration: ImuCalibration,
    /// Mean bias of its forces, along its axes [m/s²].
    pub force_bias_m_s2: Vector3<f64>,
    /// Standard deviation of the tilt of the drive as a whole [rad].
    pub tilt_sigma_rad: f64,
}

/// Finds the trajectory of a drive, scan by scan.
#[derive(Clone, Debug)]
pub struct TrajectoryBuilder {
    config: TrajectoryConfig,
    odometer: Odometer,
    estimates: Vec<OdometryEstimate>,
    samples: Vec<Sample>,
    ranges_m: Vec<f32>,
    given: Vec<Pose3>,
    /// Times of the scans, where they have one [s].
    scan_times_s: Vec<Option<f64>>,
    gnss: Option<GnssConstraints>,
    imu: Option<Imu>,
    /// Number of points of all samples.
    points: usize,
    memory_budget: MemoryBudget,
}

impl TrajectoryBuilder {
    /// A trajectory without scans.
    ///
    /// # Errors
    /// A field of the configuration is out of its range.
    pub fn new(config: TrajectoryConfig) -> Result<Self, InvalidValue> {
        config.validate()?;
        Ok(Self {
            odometer: Odometer::new(config.odometry.clone())?,
            config,
            estimates: vec![],
            samples: vec![],
            ranges_m: vec![],
            given: vec![],
            scan_times_s: vec![],
            gnss: None,
            imu: None,
            points: 0,
            memory_budget: MemoryBudget::default(),
        })
    }

    /// Bounds the memory of the samples and of the adjustment.
    #[must_use]
    pub fn with_memory_budget(self, memory_budget: MemoryBudget) -> Self {
        Self {
            memory_budget,
            ..self
        }
    }

    /// Makes the poses level by an inertial sensor, whose times are of the same clock as those of the scans, but for an
    /// offset. One that does not fit the scans is left out with a warning; given poses are not changed by it.
    #[must_use]
    pub fn with_imu(self, imu: Imu) -> Self {
        Self {
            imu: Some(imu),
            ..self
        }
    }

    /// Bends the path by fixes of a GNSS receiver, unless its poses are given; scans need times.
    #[must_use]
    pub fn with_gnss(self, gnss: Option<GnssConstraints>) -> Self {
        Self { gnss, ..self }
    }

    /// Registers the next scan, and keeps a sample of its points.
    ///
    /// # Errors
    /// Times of scans do not ascend, or memory does not suffice.
    pub fn add(&mut self, scan: &Scan) -> Result<&OdometryEstimate, OdometryError> {
        let estimate = self.odometer.step(scan)?;
        self.estimates.push(estimate);
        self.keep(scan)?;
        let last = self.estimates.len() - 1;
        Ok(&self.estimates[last])
    }

    /// Keeps a sample of the next scan, whose pose is given; all or none of the poses of a drive are.
    ///
    /// # Errors
    /// Memory does not suffice.
    pub fn add_given(&mut self, scan: &Scan, map_from_lidar: Pose3) -> Result<(), MemoryError> {
        let last = self.given.last().unwrap_or(&map_from_lidar);
        let times_s = self.scan_times_s.last().copied().flatten().zip(scan.time_s);
        self.estimates.push(OdometryEstimate {
            odom_from_lidar: map_from_lidar,
            previous_from_current: last.inverse() * map_from_lidar,
            state: StepState::Given,
            ..OdometryEstimate::first(match times_s {
                Some((before_s, time_s)) if time_s > before_s => interval_s(before_s, time_s),
                _ => PERIOD_S,
            })
        });
        self.given.push(map_from_lidar);
        self.keep(scan)
    }

    fn keep(&mut self, scan: &Scan) -> Result<(), MemoryError> {
        let config = &self.config.odometry;
        let range_m = sensor_range(scan);
        let sample = range_m.map_or_else(Sample::empty, |range_m| {
            let spacing_m = self.config.sample_spacing * config.voxel_share * range_m;
            let sample = Sample::new(scan, scan.measured_rotation(), range_m, config);
            Sample {
                points: sample.thinned(spacing_m),
                ..sample
            }
        });
        self.points += sample.points.len();
        self.samples.push(sample);
        self.ranges_m.extend(range_m.map(|range_m| range_m as f32));
        self.scan_times_s.push(scan.time_s);
        self.memory_budget.require(
            "the points of all scans",
            self.points as f64 * POINT_BYTES,
            SHORTER,
        )
    }

    /// Closes loops and follows fixes, unless the poses are given, and adjusts the poses.
    ///
    /// # Errors
    /// Memory does not suffice.
    pub fn finish(mut self) -> Result<Trajectory, MemoryError> {
        let given = self.given.clone();
        let times_s: Option<Vec<f64>> = self.scan_times_s.iter().copied().collect();
        let gnss = self.gnss.take().zip(times_s);
        let is_given = !given.is_empty();
        let budget = self.memory_budget;
        let imu = self.imu.take().filter(|_| !is_given);
        let first_s = self.scan_times_s.first().copied().flatten();
        let (config, mut trajectory, drive) = self.into_drive();
        let Some(mut drive) = drive else {
            return Ok(trajectory);
        };
        if let Some(imu) = imu {
            match make_level(&mut drive, &mut trajectory.odometry, first_s, &imu) {
                Ok(found) => trajectory.inertial = Some(found),
                Err(rejection) => tracing::warn!("the inertial sensor is left out: {rejection}"),
            }
        }
        if config.loops && !is_given {
            trajectory.loops = close_loops(&mut drive, &trajectory.odometry, &config.loop_closure);
        }
        if let Some((gnss, times_s)) = gnss.filter(|_| !is_given) {
            let (odometry, loops) = (&trajectory.odometry, &trajectory.loops);
            if let Err(error) = gnss::bend(&mut drive, &times_s, odometry, loops, &gnss) {
                tracing::warn!("the path does not follow the fixes of the receiver: {error}");
            }
        }
        if config.adjust {
            let held = if is_given {
                Held::Given(&given)
            } else {
                Held::First
            };
            trajectory.adjusted = adjust(&mut drive, held, &config.adjustment, budget)?;
        }
        trajectory.poses = drive.poses;
        Ok(trajectory)
    }

    /// Closes loops, moves the drive into a map in which some of its scans were found, and adjusts all poses to its
    /// surfaces. `map_from_lidar` has the poses of the scans that were found.
    pub(crate) fn finish_in_map(
        self,
        mesh: &TriangleMesh,
        map_from_lidar: &[Option<Pose3>],
    ) -> Result<Trajectory, PlacementError> {
        let budget = self.memory_budget;
        let (config, mut trajectory, drive) = self.into_drive();
        let mut drive = drive.ok_or(NotInMap)?;
        if config.loops {
            trajectory.loops = close_loops(&mut drive, &trajectory.odometry, &config.loop_closure);
        }
        let (odometry, loops) = (&trajectory.odometry, &trajectory.loops);
        let Placed {
            map_from_odom,
            surfaces,
        } = anchors::place(
            &mut drive,
            mesh,
            map_from_lidar,
            odometry,
            loops,
            &config.loop_closure,
            budget,
        )?;
        for estimate in &mut trajectory.odometry {
            estimate.odom_from_lidar = map_from_odom * estimate.odom_from_lidar;
        }
        if config.adjust {
            let held = Held::Surfaces(&surfaces);
            trajectory.adjusted = adjust(&mut drive, held, &config.adjustment, budget)?;
        }
        trajectory.poses = drive.poses;
        Ok(trajectory)
    }

    /// The odometry, and the drive for loops and adjustment; `None` if no scan has enough points.
    fn into_drive(mut self) -> (TrajectoryConfig, Trajectory, Option<Drive>) {
        let poses: Vec<Pose3> = (self.estimates.iter())
            .map(|estimate| estimate.odom_from_lidar)
            .collect();
        let drive = median(&mut self.ranges_m).map(|range_m| Drive {
            samples: self.samples,
            times_s: times_s(&self.estimates),
            poses: poses.clone(),
            range_m,
            voxel_m: self.config.odometry.voxel_share * range_m,
            levels: None,
        });
        let trajectory = Trajectory {
            poses,
            odometry: self.estimates,
            loops: vec![],
            adjusted: None,
            inertial: None,
        };
        (self.config, trajectory, drive)
    }
}

/// Turns the poses of a drive so that z points up along all of it, and those of its odometry as a whole.
fn make_level(
    drive: &mut Drive,
    odometry: &mut [OdometryEstimate],
    first_s: Option<f64>,
    imu: &Imu,
) -> Result<InertialEstimate, ImuRejection> {
    let first_s = first_s.ok_or(ImuRejection::NoTimes)?;
    let times_s: Vec<f64> = drive
        .times_s
        .iter()
        .map(|time_s| first_s + time_s)
        .collect();
    let turns: Vec<MeasuredTurn> = (1..times_s.len())
        .filter_map(|row| measured_turn(&odometry[row], (times_s[row - 1], times_s[row])))
        .collect();
    let calibration = ImuCalibration::estimate(imu, &turns)?;
    let Levelled {
        poses,
        levels,
        force_bias_m_s2,
        sigma_rad,
    } = level(&drive.poses, &times_s, &imu.samples, &calibration)?;
    let as_a_whole = poses[0] * drive.poses[0].inverse();
    for estimate in odometry {
        estimate.odom_from_lidar = as_a_whole * estimate.odom_from_lidar;
    }
    drive.poses = poses;
    drive.levels = Some(levels);
    Ok(InertialEstimate {
        calibration,
        force_bias_m_s2,
        tilt_sigma_rad: sigma_rad,
    })
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
fn close_loops(drive: &mut Drive, odometry: &[OdometryEstimate], config: &LoopConfig) -> Vec<Loop> {
    let maps = drive.submaps(SUBMAP_LENGTH * drive.range_m);
    let along_path = odometry_edges(drive, &maps, odometry);
    let odometry = drive.poses.clone();
    let mut result = vec![];
    for share in [config.drift_share, config.remaining_drift_share] {
        let drift = Drift {
            share,
            least_m: drive.voxel_m,
        };
        let found = loops::find(drive, &maps, drift, config);
        let drift = Drift {
            share: config.drift_share,
            ..drift
        };
        drive.poses.clone_from(&odometry);
        result = close(drive, &maps, &along_path, &found, drift, config);
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
    maps: &[Submap],
    along_path: &[Edge],
    found: &[FoundLoop],
    drift: Drift,
    config: &LoopConfig,
) -> Vec<Loop> {
    let confirmed = loops::confirmed(drive, maps, found, drift, config);
    let used: Vec<Option<Edge>> = (found.iter().zip(&confirmed))
        .map(|(found, &is_confirmed)| found.edge(drive.voxel_m).filter(|_| is_confirmed))
        .collect();
    let edges: Vec<Edge> = (along_path.iter().cloned())
        .chain(used.iter().flatten().cloned())
        .collect();
    let centers: Vec<Pose3> = maps.iter().map(|map| drive.poses[map.center]).collect();
    let optimized = (used.iter().any(Option::is_some))
        .then(|| {
            optimize_with(&centers, &edges, |system, poses| {
                keep_level(drive, maps, 0, system, poses)
            })
        })
        .flatten();
    let mut weights = optimized
        .iter()
        .flat_map(|(_, weights)| &weights[along_path.len()..]);
    let mut verdict = |edge: &Option<Edge>| match edge.as_ref().and_then(|_| weights.next()) {
        None => LoopVerdict::Unconfirmed,
        Some(&weight) if weight > config.min_weight => LoopVerdict::Accepted,
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

#[cfg(test)]
#[path = "trajectory_tests.rs"]
mod tests;
