//! Trajectories of whole drives: odometry and refinement.

use anyhow::anyhow;
use fpmcl::geometry::{Pose2, Pose3};
use fpmcl::odometry::{OdometryEstimate, TrajectoryBuilder, TrajectoryConfig};
use fpmcl::refinement::{InitialEstimate, RefinerConfig, TrajectoryRefiner};
use numpy::{PyArray2, PyArray3};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{self, Numbers};
use crate::errors::{raised, released};
use crate::localizer::Estimate;
use crate::map::{Map, map_of};
use crate::recording::{Scans, Sensor};
use crate::settings;

/// Poses of a drive in the frame of its first scan.
#[pyclass(frozen, get_all, module = "fpmcl")]
pub struct Trajectory {
    /// Pose of each scan, with loops closed and all adjusted, (N, 4, 4).
    poses: Py<PyArray3<f64>>,
    /// Poses of the odometry alone, (N, 4, 4).
    odometry: Py<PyArray3<f64>>,
    /// Motion into each scan of the odometry alone, ``p_previous = motion @ p``, (N, 4, 4).
    motions: Py<PyArray3<f64>>,
}

/// Finds the poses of scans from the scans themselves.
///
/// ``scans``: a Recording, or an iterable of Scans and of arrays (N, 3) [m]. Settings: fields of ``trajectory`` in
/// ``fpmcl config odometry --full``, such as ``loops=False``.
#[pyfunction]
#[pyo3(signature = (scans, **settings))]
pub fn odometry(
    py: Python<'_>,
    scans: &Bound<'_, PyAny>,
    settings: Option<&Bound<'_, PyDict>>,
) -> PyResult<Trajectory> {
    let config = settings::apply(TrajectoryConfig::default(), settings)?;
    let scans = Scans::of(scans)?;
    let found = released(py, || {
        let mut builder = TrajectoryBuilder::new(config)?;
        for row in 0..scans.len() {
            builder.add(&*scans.read(row)?)?;
            Python::attach(|py| py.check_signals())?;
        }
        anyhow::Ok(builder.finish()?)
    })?;
    let poses_of = |pose: fn(&OdometryEstimate) -> Pose3| {
        let poses: Vec<Pose3> = found.odometry.iter().map(pose).collect();
        arrays::of_poses(py, &poses).unbind()
    };
    Ok(Trajectory {
        poses: arrays::of_poses(py, &found.poses).unbind(),
        odometry: poses_of(|step| step.odom_from_lidar),
        motions: poses_of(|step| step.previous_from_current),
    })
}

/// Refined poses of a drive in a map.
#[pyclass(frozen, get_all, module = "fpmcl")]
pub struct RefinedTrajectory {
    /// Poses seen from above: x, y [m], heading [rad], (N, 3).
    poses: Py<PyArray2<f64>>,
    /// Pose of each scan in space, ``p_map = map_from_lidar @ p_lidar``, (N, 4, 4).
    map_from_lidar: Py<PyArray3<f64>>,
    /// Covariances of x, y, heading in the axes of the map, (N, 3, 3) [m², m rad, rad²].
    covariances: Py<PyArray3<f64>>,
    /// State of each scan; ``"searching"`` where its place was not found.
    states: Vec<&'static str>,
}

/// Refines a trajectory in a map, scan by scan, and smooths it with the motions.
///
/// ``scans``: as of ``Map.build``. ``estimates``: those of a Localizer, or the poses of a rough trajectory, (N, 4, 4) or
/// (N, 3), with the standard deviations ``uncertainty=[m, deg]``. ``motions``: into each scan, (N, 4, 4) or (N, 3);
/// without, each scan by itself. Settings: fields of ``refiner`` in ``fpmcl config refine --full``.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "they have names in Python")]
#[pyo3(signature = (map, scans, estimates, motions=None, *, sensor=None, uncertainty=[1.0, 10.0], seed=0, **settings))]
pub fn refine(
    py: Python<'_>,
    #[pyo3(from_py_with = map_of)] map: Bound<'_, Map>,
    scans: &Bound<'_, PyAny>,
    estimates: &Bound<'_, PyAny>,
    motions: Option<Numbers<'_, f64>>,
    sensor: Option<Sensor>,
    uncertainty: [f64; 2],
    seed: u64,
    settings: Option<&Bound<'_, PyDict>>,
) -> PyResult<RefinedTrajectory> {
    let map = map.get();
    let config = settings::apply(RefinerConfig::default(), settings)?;
    let scans = Scans::of(scans)?;
    let sensor = scans.sensor(py, sensor)?;
    let increments = motions.map(|motions| arrays::all_planar("motions", &motions));
    let increments = increments.transpose()?;
    let starts = starts(estimates, increments.as_deref(), &scans, uncertainty)?;
    for (name, count) in [
        ("estimates", Some(starts.len())),
        ("motions", increments.as_ref().map(Vec::len)),
    ] {
        if let Some(count) = count.filter(|&count| count != scans.len()) {
            return Err(raised(anyhow!(
                "there are {count} {name} for {} scans; give one per scan",
                scans.len()
            )));
        }
    }
    let refined = released(py, || {
        let mut refiner = TrajectoryRefiner::new(&map.map, &sensor.0, config, seed)?;
        for (row, start) in starts.iter().enumerate() {
            refiner.add(&*scans.read(row)?, start)?;
            Python::attach(|py| py.check_signals())?;
        }
        if let Some(increments) = &increments {
            let increments: Vec<Option<Pose2>> = increments.iter().copied().map(Some).collect();
            refiner.place_backwards(&starts, &increments, |row| {
                Python::attach(|py| py.check_signals())?;
                anyhow::Ok(scans.read(row)?.into_owned())
            })?;
        }
        anyhow::Ok(refiner.finish(increments.as_deref())?)
    })?;
    Ok(RefinedTrajectory {
        poses: arrays::of_all_planar(py, &refined.poses).unbind(),
        map_from_lidar: arrays::of_poses(py, &refined.map_from_lidar).unbind(),
        covariances: arrays::of_matrices(py, &refined.covariances).unbind(),
        states: refined.states.iter().map(|state| state.word()).collect(),
    })
}

/// What is refined: estimates of a localizer, or the poses of a rough trajectory.
fn starts(
    estimates: &Bound<'_, PyAny>,
    increments: Option<&[Pose2]>,
    scans: &Scans,
    [position_m, heading_deg]: [f64; 2],
) -> PyResult<Vec<InitialEstimate>> {
    if let Ok(estimates) = estimates.extract::<Vec<PyRef<'_, Estimate>>>() {
        let of_filter = |estimate: &PyRef<'_, Estimate>| InitialEstimate::from(&estimate.estimate);
        return Ok(estimates.iter().map(of_filter).collect());
    }
    let poses: Numbers<'_, f64> = estimates.extract()?;
    let poses = arrays::all_planar("estimates", &poses)?;
    let increments = match increments {
        Some(increments) => increments.iter().copied().map(Some).collect(),
        None => vec![None; poses.len()],
    };
    let deviations = [position_m, heading_deg.to_radians()];
    let times_s = scans.times_s();
    Ok(InitialEstimate::from_rough(
        &poses,
        deviations,
        &increments,
        times_s.as_deref(),
    ))
}
