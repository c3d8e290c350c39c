//! Trajectories of whole drives: odometry and refinement.

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::PathBuf;

use anyhow::{Context as _, anyhow};
use fpmcl::evaluation::{SpatialMetrics, Summary};
use fpmcl::geometry::{Pose2, Pose3, StampedPose};
use fpmcl::odometry::{OdometryEstimate, TrajectoryBuilder, TrajectoryConfig};
use fpmcl::recording::write_tum;
use fpmcl::refinement::{InitialEstimate, RefinerConfig, TrajectoryRefiner};
use numpy::{PyArray2, PyArray3, PyUntypedArrayMethods as _};
use pyo3::prelude::*;
use pyo3::types::{IntoPyDict as _, PyDict};

use crate::arrays::{self, Numbers, Numbers1};
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

#[pymethods]
impl Trajectory {
    fn __repr__(&self, py: Python<'_>) -> String {
        format!(
            "<fpmcl.Trajectory: {} poses>",
            self.poses.bind(py).shape()[0]
        )
    }
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
        if let Scans::Recorded(recording, _) = &scans
            && let Some(imu) = &recording.imu
        {
            builder = builder.with_imu(imu.clone());
        }
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

#[pymethods]
impl RefinedTrajectory {
    fn __repr__(&self) -> String {
        let tracking = self.states.iter().filter(|&&state| state == "tracking");
        let (tracking, count) = (tracking.count(), self.states.len());
        format!("<fpmcl.RefinedTrajectory: {count} poses, {tracking} tracking>")
    }
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

/// Writes poses as rows ``time x y z qx qy qz qw`` [s, m] (TUM), which evo and ``fpmcl evaluate`` read.
///
/// ``poses``: (N, 4, 4). ``times``: (N,) [s]. An existing file is replaced.
///
/// Raises Error if the file cannot be written, or there is not one time per pose.
#[pyfunction]
pub fn write_trajectory(
    py: Python<'_>,
    path: PathBuf,
    poses: Numbers<'_, f64>,
    times: Numbers1<'_, f64>,
) -> PyResult<()> {
    let poses = arrays::poses("poses", &poses)?;
    let times_s: Vec<f64> = times.as_array().iter().copied().collect();
    released(py, || {
        let (count, times) = (poses.len(), times_s.len());
        anyhow::ensure!(
            count == times,
            "there are {times} times for {count} poses; give one per pose"
        );
        let rows = poses.iter().zip(&times_s).enumerate();
        let rows: Vec<StampedPose> = rows
            .map(|(frame, (&map_from_lidar, &time_s))| StampedPose {
                frame,
                time_s,
                map_from_lidar,
            })
            .collect();
        let write = || {
            let mut file = BufWriter::new(File::create(&path)?);
            write_tum(&mut file, &rows)?;
            file.flush()
        };
        write().with_context(|| format!("cannot write {}", path.display()))
    })
}

/// Errors of estimates against true poses: a dict of dicts with ``rmse``, ``mean``, ``median``, ``p95`` and ``max``.
///
/// ``estimates``, ``truth``: (N, 4, 4) in the same frame. ``skip``: number of first poses that are left out.
/// ``position_m``: distance to the true position. ``height_m``: magnitude of the height error. ``rotation_rad``: angle of the
/// rotation. ``aligned_position_m``, ``aligned_rotation_rad``: the same after rigid alignment; missing on a straight line.
///
/// Raises Error if there are not as many estimates as true poses, or none is left.
#[pyfunction]
#[pyo3(signature = (estimates, truth, *, skip=0))]
pub fn evaluate<'py>(
    py: Python<'py>,
    estimates: Numbers<'py, f64>,
    truth: Numbers<'py, f64>,
    skip: usize,
) -> PyResult<Bound<'py, PyDict>> {
    let estimates = arrays::poses("estimates", &estimates)?;
    let truth = arrays::poses("truth", &truth)?;
    let errors = released(py, || {
        SpatialMetrics::new(&estimates, &truth, skip).ok_or_else(|| {
            anyhow!(
                "there are {} estimates and {} true poses, of which {skip} are left out; give one true pose per estimate, and more than these",
                estimates.len(),
                truth.len()
            )
        })
    })?;
    let found = PyDict::new(py);
    for (name, summary) in [
        ("position_m", Some(errors.position_m)),
        ("height_m", Some(errors.height_m)),
        ("rotation_rad", Some(errors.rotation_rad)),
        ("aligned_position_m", errors.aligned_position_m),
        ("aligned_rotation_rad", errors.aligned_rotation_rad),
    ] {
        if let Some(Summary {
            rmse,
            mean,
            median,
            p95,
            max,
        }) = summary
        {
            let numbers = [
                ("rmse", rmse),
                ("mean", mean),
                ("median", median),
                ("p95", p95),
                ("max", max),
            ];
            found.set_item(name, numbers.into_py_dict(py)?)?;
        }
    }
    Ok(found)
}
