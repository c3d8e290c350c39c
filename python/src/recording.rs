//! Recordings, scans and sensors.

use std::borrow::Cow;
use std::ops::ControlFlow;
use std::path::PathBuf;

use anyhow::anyhow;
use fpmcl::geometry::{Pose3, pose_from_degrees};
use fpmcl::lidar;
use fpmcl::mapping::calibrated;
use fpmcl::memory::MemoryBudget;
use fpmcl::odometry::OdometryConfig;
use fpmcl::recording::{self, Layout, Selection};
use fpmcl::sensor::{self, MotionCompensation, SensorConfig};
use fpmcl::validation::Validate as _;
use numpy::{PyArray1, PyArray2, PyArray3, PyArrayDyn};
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;

use crate::arrays::{self, Numbers1, Numbers2};
use crate::errors::{raised, released};
use crate::map::{Map, map_of};

/// Number of scans from which a sensor is inferred.
const SENSOR_SCANS: usize = 10;

/// Points of one sweep in the frame of the lidar; immutable.
///
/// ``points``: (N, 3), copied once [m].
/// ``times``: (N,), when each point was measured, after the moment of the pose [s]; by them a scan is deskewed.
/// ``time``: the moment of the pose, from any origin [s].
/// ``intensities``: (N,), 0 to 1. ``rings``: (N,), number of the beam of each point.
#[pyclass(frozen, module = "fpmcl")]
pub struct Scan {
    pub scan: lidar::Scan,
    number: Option<usize>,
    pose: Option<Pose3>,
}

#[pymethods]
impl Scan {
    #[new]
    #[pyo3(signature = (points, times=None, *, time=None, intensities=None, rings=None))]
    pub fn new(
        points: Numbers2<'_, f32>,
        times: Option<Numbers1<'_, f32>>,
        time: Option<f64>,
        intensities: Option<Numbers1<'_, f32>>,
        rings: Option<Numbers1<'_, u16>>,
    ) -> PyResult<Self> {
        let points = arrays::vectors("points", &points)?.into_owned();
        let count = points.len();
        let scan = lidar::Scan {
            points,
            intensities: column("intensities", intensities, count)?,
            times_s: column("times", times, count)?,
            rings: column("rings", rings, count)?,
            time_s: time,
            gyroscope: None,
        };
        Ok(Self {
            scan,
            number: None,
            pose: None,
        })
    }

    /// Points in the frame of the lidar, (N, 3) float32 [m]; read-only, not a copy.
    #[getter]
    fn points<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        arrays::view_of_vectors(&slf.get().scan.points, slf.as_any())
    }

    /// Reflectance of each point, (N,) float32, 0 to 1; None if unknown.
    #[getter]
    fn intensities<'py>(slf: &Bound<'py, Self>) -> PyResult<Option<Bound<'py, PyArrayDyn<f32>>>> {
        column_view(&slf.get().scan.intensities, slf)
    }

    /// When each point was measured, after the moment of the pose, (N,) float32 [s]; None if unknown.
    #[getter]
    fn times<'py>(slf: &Bound<'py, Self>) -> PyResult<Option<Bound<'py, PyArrayDyn<f32>>>> {
        column_view(&slf.get().scan.times_s, slf)
    }

    /// Number of the beam of each point, (N,) uint16; None if unknown.
    #[getter]
    fn rings<'py>(slf: &Bound<'py, Self>) -> PyResult<Option<Bound<'py, PyArrayDyn<u16>>>> {
        column_view(&slf.get().scan.rings, slf)
    }

    /// The moment of the pose [s]; None if unknown.
    #[getter]
    fn time(&self) -> Option<f64> {
        self.scan.time_s
    }

    /// Number of the scan in its recording; None if it is not from one.
    #[getter]
    fn number(&self) -> Option<usize> {
        self.number
    }

    /// Given pose in the frame of the recording, (4, 4); None if there is none.
    #[getter]
    fn pose<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray2<f64>>> {
        self.pose.map(|pose| arrays::of_pose(py, &pose))
    }

    fn __len__(&self) -> usize {
        self.scan.len()
    }

    fn __repr__(&self) -> String {
        let number = self.number.map_or(String::new(), |it| format!(" {it}"));
        let time = self
            .scan
            .time_s
            .map_or(String::new(), |it| format!(" at {it:.3} s"));
        format!("<fpmcl.Scan{number}: {} points{time}>", self.scan.len())
    }
}

/// A column of a scan, with a value per point; empty if it is not given.
fn column<T: numpy::Element + Copy>(
    name: &str,
    values: Option<Numbers1<'_, T>>,
    count: usize,
) -> PyResult<Vec<T>> {
    let values: Vec<T> = match values {
        Some(values) => values.as_array().iter().copied().collect(),
        None => return Ok(Vec::new()),
    };
    if values.len() == count {
        Ok(values)
    } else {
        Err(PyValueError::new_err(format!(
            "{name} has {} values for {count} points; give one per point",
            values.len()
        )))
    }
}

fn column_view<'py, T: numpy::Element>(
    values: &[T],
    owner: &Bound<'py, Scan>,
) -> PyResult<Option<Bound<'py, PyArrayDyn<T>>>> {
    match values {
        [] => Ok(None),
        _ => arrays::view(values, &[values.len()], owner.as_any()).map(Some),
    }
}

/// What a sensor is: its beams, limits of range, own car and height, inferred from scans.
#[pyclass(frozen, from_py_object, module = "fpmcl")]
#[derive(Clone)]
pub struct Sensor(pub sensor::Sensor);

#[pymethods]
impl Sensor {
    /// Number of beams; None of a sensor without rows.
    #[getter]
    fn beams(&self) -> Option<usize> {
        self.0.beams
    }

    /// Height above the ground [m]; None where too little ground is visible.
    #[getter]
    fn height(&self) -> Option<f64> {
        Some(self.0.mounting.as_ref()?.height_m)
    }

    /// Rectangle with returns of the own car: x_min, x_max, y_min, y_max, frame of the lidar [m]; None if there are none.
    #[getter]
    fn own_car(&self) -> Option<[f32; 4]> {
        (self.0.own_car_m != [0.0; 4]).then_some(self.0.own_car_m)
    }

    fn __repr__(&self) -> String {
        format!("<fpmcl.Sensor: {}>", self.0)
    }
}

/// A sequence of scans, each of which is read when it is indexed.
#[pyclass(frozen, module = "fpmcl")]
pub struct Recording {
    pub recording: recording::Recording,
    sensor: Sensor,
}

#[pymethods]
impl Recording {
    fn __len__(&self) -> usize {
        self.recording.frames.len()
    }

    fn __getitem__(&self, py: Python<'_>, index: isize) -> PyResult<Scan> {
        let frames = &self.recording.frames;
        let from_end = isize::try_from(frames.len()).map_or(index, |count| index + count);
        let row = if index < 0 { from_end } else { index };
        let frame = usize::try_from(row).ok().and_then(|row| frames.get(row));
        let Some(frame) = frame else {
            let count = frames.len();
            return Err(PyIndexError::new_err(format!(
                "there is no scan {index} among {count}"
            )));
        };
        Ok(Scan {
            scan: released(py, || frame.read())?,
            number: Some(frame.number),
            pose: frame.map_from_lidar,
        })
    }

    /// The sensor, inferred from ten of the scans.
    #[getter]
    fn sensor(&self) -> Sensor {
        self.sensor.clone()
    }

    /// Number of each scan in the recording, (N,) int64.
    #[getter]
    fn numbers<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<i64>> {
        let frames = self.recording.frames.iter();
        PyArray1::from_iter(py, frames.map(|frame| frame.number as i64))
    }

    /// Time of each scan, since the start of the recording or since 1970, (N,) [s].
    #[getter]
    fn times<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_iter(py, self.recording.frames.iter().map(|frame| frame.time_s))
    }

    /// Given poses of the lidar, in the frame of the first one, (N, 4, 4); None if there are none.
    #[getter]
    fn poses<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray3<f64>>> {
        Some(arrays::of_poses(py, &self.given()?))
    }

    /// Returns the given poses in the frame of a map that was built in the same world, (N, 4, 4).
    ///
    /// Raises Error if there are no poses.
    fn poses_in<'py>(
        &self,
        py: Python<'py>,
        #[pyo3(from_py_with = map_of)] map: Bound<'py, Map>,
    ) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let given = self.given().ok_or_else(without_poses)?;
        let world_from_map = map.get().map.path.world_from_map;
        let map_from_recording = world_from_map.inverse() * self.recording.world().0;
        let poses: Vec<Pose3> = given.iter().map(|pose| map_from_recording * pose).collect();
        Ok(arrays::of_poses(py, &poses))
    }

    fn __repr__(&self) -> String {
        let path = self.recording.path.display();
        format!("<fpmcl.Recording: {} scans of {path}>", self.__len__())
    }
}

impl Recording {
    /// The given poses; `None` if there are none.
    pub fn given(&self) -> Option<Vec<Pose3>> {
        let frames = self.recording.frames.iter();
        frames.map(|frame| frame.map_from_lidar).collect()
    }
}

/// The error of poses that are needed and not given.
pub fn without_poses() -> PyErr {
    raised(anyhow!(
        "there are no poses; give them, such as those of odometry(scans).poses"
    ))
}

/// Opens a recording: a folder of scans (.bin, .pcd, .ply, .npy), a data set such as KITTI, MulRan or nuScenes, or a bag (MCAP, rosbag2,
/// ROS 1).
///
/// ``poses``: file of its poses (KITTI, TUM, a folder ``oxts``) or topic of its bag; by default those that the
/// recording contains, if there are any. ``calib_file``: calibration of the camera whose poses these are.
/// ``body_from_lidar``: x, y, z [m], roll, pitch, yaw [deg] of the lidar on the body whose poses these are. ``layout``: name
/// of the layout, such as ``"mulran"``; by default as the files show. ``topic``: of the point clouds in a bag with several, or name of a
/// lidar or scene in a folder with several. ``start_idx``, ``n_scans`` (-1: all), ``frame_step``: the frames that are used.
/// ``motion_compensation``: ``"auto"``, ``"order"``, a rotation such as ``"clockwise"``, or None for compensated scans.
/// ``elevation_bias_deg``: angle to add to the elevations of all points [deg]. ``imu``: inertial measurements, a table, a folder
/// ``oxts`` or a topic of the bag, by whose rates scans are compensated and rotations predicted; ``lidar_from_imu``: roll, pitch,
/// yaw [deg] of its axes, if they are known.
///
/// Raises Error if something cannot be read, with the file, and what to do.
#[pyfunction]
#[expect(clippy::too_many_arguments, reason = "they have names in Python")]
#[pyo3(signature = (
    path, poses=None, *, layout=None, topic=None, calib_file=None, body_from_lidar=None, start_idx=0, n_scans=-1, frame_step=1,
    motion_compensation=Some("auto".to_owned()), elevation_bias_deg=0.0, imu=None, lidar_from_imu=None
))]
pub fn read_recording(
    py: Python<'_>,
    path: PathBuf,
    poses: Option<PathBuf>,
    layout: Option<String>,
    topic: Option<String>,
    calib_file: Option<PathBuf>,
    body_from_lidar: Option<[f64; 6]>,
    start_idx: usize,
    n_scans: i64,
    frame_step: usize,
    motion_compensation: Option<String>,
    elevation_bias_deg: f64,
    imu: Option<PathBuf>,
    lidar_from_imu: Option<[f64; 3]>,
) -> PyResult<Recording> {
    let selection = Selection {
        start_idx,
        n_scans,
        frame_step,
    };
    selection.validate().map_err(raised)?;
    let layout = layout.map(|name| name.parse::<Layout>()).transpose();
    let layout = layout.map_err(|error| PyValueError::new_err(error.to_string()))?;
    let motion_compensation = motion_compensation.map(MotionCompensation::try_from);
    let known = SensorConfig {
        motion_compensation: motion_compensation
            .transpose()
            .map_err(PyValueError::new_err)?,
        ..SensorConfig::default()
    };
    let (recording, sensor) = released(py, || {
        let budget = MemoryBudget::default();
        let mut recording =
            recording::Recording::open_with(&path, layout, topic.as_deref(), &selection, budget)?;
        recording.body_from_lidar = body_from_lidar.map(pose_from_degrees);
        let recording = recording.with_elevation_bias(elevation_bias_deg.to_radians());
        let track = match &poses {
            Some(path) => Some(recording.read_track(path, calib_file.as_deref())?),
            None if recording.files.poses.is_some() => Some(recording.own_track()?),
            None => recording.own_track().ok(),
        };
        let recording = match track {
            Some(track) => recording.with_poses(track)?,
            None => recording,
        };
        let sensor = sensor::Sensor::infer_recording(&recording, &known)?;
        let mut recording = sensor.applied_to(recording);
        if let Some(path) = &imu {
            let axes = lidar_from_imu.map(|[roll, pitch, yaw]| {
                pose_from_degrees([0.0, 0.0, 0.0, roll, pitch, yaw]).rotation
            });
            let imu = recording.read_imu(path, axes)?;
            let odometry = OdometryConfig::default();
            let on_event = |_| ControlFlow::Continue(());
            recording = calibrated(recording.with_imu(imu), &odometry, &on_event)?;
        }
        anyhow::Ok((recording, Sensor(sensor)))
    })?;
    Ok(Recording { recording, sensor })
}

/// Infers what the sensor is from about ten of some scans, better spread over seconds than neighbours.
#[pyfunction]
pub fn infer_sensor(py: Python<'_>, scans: &Bound<'_, PyAny>) -> PyResult<Sensor> {
    Scans::of(scans)?.sensor(py, None)
}

/// Scans of an argument, which are read or converted when they are needed.
pub enum Scans {
    Recorded(Box<recording::Recording>, Sensor),
    Given(Vec<GivenScan>),
}

/// A scan of an iterable.
pub enum GivenScan {
    Scan(Py<Scan>),
    Points(Py<PyAny>),
}

impl Scans {
    /// The scans of a recording, or of an iterable of scans and arrays of points.
    pub fn of(scans: &Bound<'_, PyAny>) -> PyResult<Self> {
        if let Ok(recording) = scans.cast::<Recording>() {
            let recording = recording.get();
            let sensor = recording.sensor.clone();
            return Ok(Self::Recorded(
                Box::new(recording.recording.clone()),
                sensor,
            ));
        }
        let scans = scans.try_iter()?.map(|scan| {
            Ok(match scan?.cast_into::<Scan>() {
                Ok(scan) => GivenScan::Scan(scan.unbind()),
                Err(other) => GivenScan::Points(other.into_inner().unbind()),
            })
        });
        Ok(Self::Given(scans.collect::<PyResult<_>>()?))
    }

    pub fn len(&self) -> usize {
        match self {
            Self::Recorded(recording, _) => recording.frames.len(),
            Self::Given(scans) => scans.len(),
        }
    }

    /// Reads a scan, without the interpreter lock.
    pub fn read(&self, row: usize) -> anyhow::Result<Cow<'_, lidar::Scan>> {
        match self {
            Self::Recorded(recording, _) => Ok(Cow::Owned(recording.frames[row].read()?)),
            Self::Given(scans) => match &scans[row] {
                GivenScan::Scan(scan) => Ok(Cow::Borrowed(&scan.get().scan)),
                GivenScan::Points(points) => Python::attach(|py| {
                    let points: Numbers2<'_, f32> = points.extract(py)?;
                    Ok(Cow::Owned(lidar::Scan {
                        points: arrays::vectors("points", &points)?.into_owned(),
                        ..lidar::Scan::default()
                    }))
                }),
            },
        }
    }

    /// Times of the scans [s]; `None` if one is not known.
    pub fn times_s(&self) -> Option<Vec<f64>> {
        match self {
            Self::Recorded(recording, _) => {
                Some(recording.frames.iter().map(|frame| frame.time_s).collect())
            }
            Self::Given(scans) => (scans.iter())
                .map(|scan| match scan {
                    GivenScan::Scan(scan) => scan.get().scan.time_s,
                    GivenScan::Points(_) => None,
                })
                .collect(),
        }
    }

    /// The recording, which scans of an iterable make.
    pub fn recording(&self) -> anyhow::Result<recording::Recording> {
        if let Self::Recorded(recording, _) = self {
            return Ok((**recording).clone());
        }
        let scans = (0..self.len()).map(|row| Ok(self.read(row)?.into_owned()));
        let scans = scans.collect::<anyhow::Result<Vec<lidar::Scan>>>()?;
        Ok(recording::Recording::from_scans(scans))
    }

    /// The given sensor, else that of the recording, else the one that is inferred from some of the scans.
    pub fn sensor(&self, py: Python<'_>, given: Option<Sensor>) -> PyResult<Sensor> {
        match (given, self) {
            (Some(sensor), _) => Ok(sensor),
            (None, Self::Recorded(_, sensor)) => Ok(sensor.clone()),
            (None, Self::Given(_)) => released(py, || {
                let step = self.len().div_ceil(SENSOR_SCANS).max(1);
                let scans = (0..self.len()).step_by(step);
                let scans: Vec<lidar::Scan> = scans
                    .map(|row| Ok(self.read(row)?.into_owned()))
                    .collect::<anyhow::Result<_>>()?;
                let sensor = sensor::Sensor::infer(&scans, &SensorConfig::default())?;
                anyhow::Ok(Sensor(sensor))
            }),
        }
    }
}
