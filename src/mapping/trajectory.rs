//! Poses of scans, found from the scans themselves.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::error::MappingError;
use super::events::{OnEvent, notify};
use super::inertial::calibrate_imu;
use crate::inertial::Imu;
use crate::lidar::Scan;
use crate::map::BuildEvent;
use crate::memory::MemoryBudget;
use crate::odometry::{
    ElevationBias, GnssConstraints, InertialEstimate, LoopVerdict, StepState, Trajectory,
    TrajectoryBuilder, TrajectoryConfig,
};
use crate::recording::Frame;

/// The stage after the last scan.
pub const ADJUSTMENT: &str = "loops and adjustment";

/// Finds the poses of frames from their scans and fixes, where there are some, or polishes those that are given. An inertial
/// sensor, where there is one, is calibrated by the first scans; its rates then predict rotations, and its forces make the
/// poses level. If all scans contradict it, the poses are found without it.
///
/// Its events are the stage [`CALIBRATION`](super::CALIBRATION) where there is a sensor, and the stage `"odometry"` or `"polish"`, every scan, and
/// the stage [`ADJUSTMENT`].
pub fn find_poses(
    frames: &[Frame],
    are_given: bool,
    imu: Option<&Imu>,
    config: &TrajectoryConfig,
    gnss: Option<&GnssConstraints>,
    memory_budget: MemoryBudget,
    on_event: OnEvent,
) -> Result<Trajectory, MappingError> {
    let find = |frames: &[Frame], imu: Option<&Imu>| {
        let builder = TrajectoryBuilder::new(config.clone())?;
        let builder = builder.with_memory_budget(memory_budget);
        let mut builder = builder.with_gnss(gnss.cloned());
        if let Some(imu) = imu {
            builder = builder.with_imu(imu.clone());
        }
        let name = if are_given { "polish" } else { "odometry" };
        each_scan(name, frames, on_event, |frame, scan| {
            match frame.map_from_lidar {
                Some(pose) if are_given => builder.add_given(scan, pose)?,
                _ => drop(builder.add(scan)?),
            }
            Ok(())
        })?;
        Ok(builder.finish()?)
    };
    let Some(imu) = imu else {
        return find(frames, None);
    };
    let gyroscope = match calibrate_imu(frames, imu, &config.odometry, on_event)? {
        Ok(gyroscope) => Arc::new(gyroscope),
        // Whether its forces are of use is judged by all scans.
        Err(rejection) => {
            tracing::debug!("rotations are not predicted by the inertial sensor: {rejection}");
            return find(frames, Some(imu));
        }
    };
    let mut measured = frames.to_vec();
    for frame in &mut measured {
        frame.gyroscope = Some(gyroscope.clone());
    }
    let found = find(&measured, Some(imu))?;
    if found.inertial.is_some() {
        Ok(found)
    } else {
        find(frames, None)
    }
}

/// Reads the scans in order and passes each to `step`, until an event is answered with `Break`.
pub(super) fn each_scan(
    name: &'static str,
    frames: &[Frame],
    on_event: OnEvent,
    mut step: impl FnMut(&Frame, &Scan) -> Result<(), MappingError>,
) -> Result<(), MappingError> {
    notify(on_event, BuildEvent::Stage(name))?;
    for frame in frames {
        step(frame, &frame.read()?)?;
        notify(on_event, BuildEvent::ScanPrepared)?;
    }
    notify(on_event, BuildEvent::Stage(ADJUSTMENT))
}

/// What a trajectory shows about itself.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct TrajectorySummary {
    /// Number of scans.
    pub scans: usize,
    /// Scans whose pose was predicted, because they did not fit.
    pub predicted: usize,
    /// Scans that fit only after an unexpected motion.
    pub doubtful: usize,
    /// Scans that do not determine all of their motion.
    pub degenerate: usize,
    /// Length of the path [m].
    pub path_m: f64,
    /// Mean speed [m/s]; `None` where the times are assumed.
    pub speed_m_per_s: Option<f64>,
    /// Median and 95 % quantile of the time per scan, without loops and adjustment [s].
    pub seconds_per_scan: Option<[f64; 2]>,
    /// Loops that were found and accepted, are not confirmed, and contradict others.
    pub loops: LoopCounts,
    /// Root mean square of the distances between points and common planes, before and after the adjustment [m].
    pub residuals_m: Option<[f64; 2]>,
    /// Angle to add to the elevations of all points so that surfaces fit themselves best.
    pub elevation_bias: Option<ElevationBias>,
    /// Largest change of a position by loops and adjustment [m].
    pub largest_change_m: f64,
    /// The inertial sensor by which the poses are level; absent without one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub inertial: Option<InertialSummary>,
}

/// What was found about an inertial sensor.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct InertialSummary {
    /// Roll, pitch and yaw of its axes in the lidar frame [deg].
    pub lidar_from_imu_deg: [f64; 3],
    /// Standard deviation of this rotation about its least certain axis, 0 where it is given [deg].
    pub axes_sigma_deg: f64,
    /// Time of its clock at the moment 0 of that of the scans [s].
    pub time_offset_s: f64,
    /// Bias of the angular rates [deg/s].
    pub rate_bias_deg_per_s: [f64; 3],
    /// Bias of the forces [m/s²].
    pub force_bias_m_per_s2: [f64; 3],
    /// Root mean square of the difference between its rates and those of the scans [deg/s].
    pub residual_deg_per_s: f64,
    /// Standard deviation of the tilt of the drive as a whole [deg].
    pub tilt_sigma_deg: f64,
}

impl From<&InertialEstimate> for InertialSummary {
    fn from(found: &InertialEstimate) -> Self {
        let calibration = &found.calibration;
        let (roll, pitch, yaw) = calibration.lidar_from_imu.euler_angles();
        Self {
            lidar_from_imu_deg: [roll, pitch, yaw].map(f64::to_degrees),
            axes_sigma_deg: calibration.axes_sigma_rad.to_degrees(),
            time_offset_s: calibration.offset_s,
            rate_bias_deg_per_s: calibration.rate_bias_rad_s.map(f64::to_degrees).into(),
            force_bias_m_per_s2: found.force_bias_m_s2.into(),
            residual_deg_per_s: calibration.residual_rad_s.to_degrees(),
            tilt_sigma_deg: found.tilt_sigma_rad.to_degrees(),
        }
    }
}

/// Numbers of loops.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct LoopCounts {
    /// The poses follow them.
    pub accepted: usize,
    /// No second loop confirms them.
    pub unconfirmed: usize,
    /// They contradict others.
    pub contradicted: usize,
}

impl TrajectorySummary {
    /// The same for every run.
    pub(crate) fn without_times(&self) -> Self {
        Self {
            seconds_per_scan: None,
            ..self.clone()
        }
    }

    /// The summary of a trajectory, whose speed is known where its scans have times.
    pub(crate) fn new(trajectory: &Trajectory, has_times: bool) -> Self {
        let steps = &trajectory.odometry;
        let positions = || trajectory.poses.iter().map(|pose| pose.translation.vector);
        let path_m: f64 = (positions().zip(positions().skip(1)))
            .map(|(a, b)| (b - a).norm())
            .sum();
        let duration_s: f64 = steps.iter().skip(1).map(|step| step.duration_s).sum();
        let mut times_s: Vec<f64> = (steps.iter())
            .map(|step| step.elapsed.as_secs_f64())
            .filter(|&time_s| time_s > 0.0)
            .collect();
        times_s.sort_by(f64::total_cmp);
        let quantile = |share: f64| Some(*times_s.get((share * times_s.len() as f64) as usize)?);
        let counted = |verdict| {
            let loops = trajectory.loops.iter();
            loops.filter(|found| found.verdict == verdict).count()
        };
        Self {
            scans: steps.len(),
            predicted: (steps.iter())
                .filter(|step| step.state.is_predicted())
                .count(),
            doubtful: (steps.iter())
                .filter(|step| step.state == StepState::Doubtful)
                .count(),
            degenerate: (steps.iter())
                .filter(|step| !step.degenerate_directions.is_empty())
                .count(),
            path_m,
            speed_m_per_s: (has_times && duration_s > 0.0).then(|| path_m / duration_s),
            seconds_per_scan: quantile(0.5).zip(quantile(0.95)).map(|(a, b)| [a, b]),
            loops: LoopCounts {
                accepted: counted(LoopVerdict::Accepted),
                unconfirmed: counted(LoopVerdict::Unconfirmed),
                contradicted: counted(LoopVerdict::Contradicted),
            },
            residuals_m: trajectory.adjusted.map(|adjusted| adjusted.residuals_m),
            elevation_bias: (trajectory.adjusted).and_then(|adjusted| adjusted.elevation_bias),
            largest_change_m: (positions().zip(steps))
                .map(|(found, step)| (found - step.odom_from_lidar.translation.vector).norm())
                .fold(0.0, f64::max),
            inertial: trajectory.inertial.as_ref().map(InertialSummary::from),
        }
    }
}
