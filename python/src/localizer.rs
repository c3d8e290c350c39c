//! Localization, scan by scan.

use fpmcl::geometry::Pose3;
use fpmcl::lidar;
use fpmcl::localization::{
    self, Odometry, Start, StartSpread, Tracker, TrackerConfig, TrackerError,
};
use numpy::ndarray::Array2;
use numpy::{IntoPyArray as _, PyArray1, PyArray2, PyUntypedArrayMethods as _};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{self, Numbers, Numbers1, Numbers2};
use crate::errors::{raised, released};
use crate::map::{Map, map_of};
use crate::recording::{Scan, Sensor};
use crate::settings;

/// Estimates the pose of a car in a map from its scans. The same seed gives the same estimates.
///
/// ``start``: ``"anywhere"`` (the default in maps of up to 1 km²), ``"road"`` (anywhere along the mapping drive), or a pose nearby: (3,), x, y
/// [m] and heading [rad], or (4, 4). ``sensor``: by default inferred from the first scan,
/// own car and times of points from the first that show motion; better that of a Recording. ``real_time``: no scan waits until
/// these are inferred, which takes seconds; from which scan on they are used depends on the machine. Settings: fields of
/// ``tracker`` in ``fpmcl config localize --full``, such as ``seed``, ``num_particles``, and ``odometry=None`` for
/// constant velocity where no motion is given.
#[pyclass(module = "fpmcl")]
pub struct Localizer {
    tracker: Tracker,
}

#[pymethods]
impl Localizer {
    #[new]
    #[pyo3(signature = (map, start=None, *, sensor=None, real_time=false, **settings))]
    fn new(
        #[pyo3(from_py_with = map_of)] map: Bound<'_, Map>,
        start: Option<&Bound<'_, PyAny>>,
        sensor: Option<Sensor>,
        real_time: bool,
        settings: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Self> {
        let map = map.get();
        let config = settings::apply(TrackerConfig::default(), settings)?;
        let tracker = Tracker::new(&map.map, config).map_err(raised)?;
        let tracker = tracker.with_start(start_of(start, &map.map)?);
        Ok(Self {
            tracker: match sensor {
                Some(sensor) => tracker.with_sensor(sensor.0),
                None if real_time => tracker.in_real_time(),
                None => tracker,
            },
        })
    }

    /// Estimates the pose of the next scan.
    ///
    /// ``points``: a Scan, or (N, 3) in the frame of the lidar [m]. ``motion``: since the previous scan,
    /// ``p_previous = motion @ p``, (4, 4), or (3,), x, y [m] and heading [rad]; by default from the scans themselves, until
    /// one is given. ``times``: (N,), when each point was measured, after ``time`` [s]; without, points are taken as deskewed.
    /// ``time``: the moment of the pose [s].
    ///
    /// Raises Error if the start is not in the map, or if the motion is impossible.
    #[pyo3(signature = (points, motion=None, times=None, *, time=None))]
    fn step(
        &mut self,
        py: Python<'_>,
        points: &Bound<'_, PyAny>,
        motion: Option<Numbers<'_, f64>>,
        times: Option<Numbers1<'_, f32>>,
        time: Option<f64>,
    ) -> PyResult<Estimate> {
        let motion = motion.map(|motion| Given::of(&motion)).transpose()?;
        if let Ok(scan) = points.cast::<Scan>() {
            if times.is_some() || time.is_some() {
                return Err(PyValueError::new_err(
                    "times are given twice: a Scan contains them; give points as an array instead",
                ));
            }
            let scan = &scan.get().scan;
            let (estimate, motion) = released(py, || self.advance(scan, motion))?;
            return Ok(Estimate::new(py, estimate, motion));
        }
        let points: Numbers2<'_, f32> = points.extract()?;
        let scan = Scan::new(points, times, time, None, None)?.scan;
        let (estimate, motion) = released(py, || self.advance(&scan, motion))?;
        Ok(Estimate::new(py, estimate, motion))
    }
}

impl Localizer {
    /// Localizes the next scan; returns also the motion that was used.
    fn advance(
        &mut self,
        scan: &lidar::Scan,
        given: Option<Given>,
    ) -> Result<(localization::Estimate, Option<Pose3>), TrackerError> {
        let odometry = match given {
            Some(given) => given.0,
            None => self.tracker.measure(scan)?,
        };
        let motion = match odometry {
            Odometry::Increment(increment) => Some(arrays::in_space(&increment)),
            _ => odometry.in_space(),
        };
        Ok((self.tracker.step_with_motion(scan, odometry)?, motion))
    }
}

/// A motion that is given.
struct Given(Odometry);

impl Given {
    fn of(motion: &Numbers<'_, f64>) -> PyResult<Self> {
        Ok(Self(match motion.ndim() {
            2 => Odometry::Motion(arrays::pose("motion", motion)?),
            _ => Odometry::Increment(arrays::planar("motion", motion)?),
        }))
    }
}

/// Where the car starts: `"anywhere"`, `"road"`, or near a pose; `None` if that is unknown.
fn start_of(start: Option<&Bound<'_, PyAny>>, map: &fpmcl::map::Map) -> PyResult<Start> {
    let Some(start) = start else {
        return Ok(Start::unknown(map));
    };
    if let Ok(word) = start.extract::<String>() {
        return match word.as_str() {
            "anywhere" => Ok(Start::Anywhere),
            "road" => Ok(Start::Road),
            _ => Err(PyValueError::new_err(format!(
                "start is {word:?}; it must be \"anywhere\", \"road\" or a pose"
            ))),
        };
    }
    let pose: Numbers<'_, f64> = start.extract()?;
    let spread = StartSpread::default();
    Ok(match pose.ndim() {
        2 => Start::near(&arrays::pose("start", &pose)?, spread),
        _ => Start::Pose {
            map_from_lidar: arrays::planar("start", &pose)?,
            height_m: None,
            spread,
        },
    })
}

/// Pose of a scan with its uncertainty.
#[pyclass(frozen, module = "fpmcl")]
pub struct Estimate {
    pub estimate: localization::Estimate,
    /// Pose seen from above: x, y [m], heading [rad], (3,).
    #[pyo3(get)]
    pose: Py<PyArray1<f64>>,
    /// Pose in space, ``p_map = map_from_lidar @ p_lidar``, (4, 4).
    #[pyo3(get)]
    map_from_lidar: Py<PyArray2<f64>>,
    /// Covariance of x, y, heading in the axes of the map, (3, 3) [m², m rad, rad²].
    #[pyo3(get)]
    covariance: Py<PyArray2<f64>>,
    /// Standard deviations of x, y [m], heading [rad], (3,).
    #[pyo3(get)]
    standard_deviations: Py<PyArray1<f64>>,
    /// ``"searching"``, ``"tracking"``, or ``"lost"``: then the pose must not be used.
    #[pyo3(get)]
    state: &'static str,
    /// Share of beams above the road that agree with the map; None where unknown.
    #[pyo3(get)]
    agreement: Option<f64>,
    /// Number of places where the car may be: 1 while the search does not compare several.
    #[pyo3(get)]
    places: usize,
    /// Mean cost of the particles [m]; None where the scan was not used.
    #[pyo3(get)]
    mean_cost_m: Option<f64>,
    /// Effective number of particles after the update, before resampling.
    #[pyo3(get)]
    effective_sample_size: f64,
    /// What is wrong with the points of all scans, where they fit the map only without it; else None.
    #[pyo3(get)]
    distortion: Option<String>,
    /// Whether the scan was used; it is not while the car moved too little.
    #[pyo3(get)]
    updated: bool,
    /// Whether there is mapped ground under the estimate.
    #[pyo3(get)]
    on_mapped_ground: bool,
    /// The motion since the previous scan that was used, ``p_previous = previous_from_current @ p``, (4, 4); None if it
    /// is not known.
    #[pyo3(get)]
    previous_from_current: Option<Py<PyArray2<f64>>>,
}

impl Estimate {
    fn new(py: Python<'_>, estimate: localization::Estimate, motion: Option<Pose3>) -> Self {
        let deviations = estimate.standard_deviations();
        Self {
            pose: arrays::of_planar(py, &estimate.pose).unbind(),
            map_from_lidar: arrays::of_pose(py, &estimate.map_from_lidar).unbind(),
            covariance: arrays::of_matrix(py, &estimate.covariance).unbind(),
            standard_deviations: PyArray1::from_slice(py, &deviations).unbind(),
            state: estimate.state.word(),
            agreement: estimate.agreement,
            places: estimate.places,
            mean_cost_m: estimate.mean_cost_m,
            effective_sample_size: estimate.effective_sample_size,
            distortion: (estimate.distortion).map(|distortion| distortion.to_string()),
            updated: estimate.updated,
            on_mapped_ground: estimate.on_mapped_ground,
            previous_from_current: motion.map(|motion| arrays::of_pose(py, &motion).unbind()),
            estimate,
        }
    }
}

#[pymethods]
impl Estimate {
    /// Particles: x, y [m], heading [rad], weight, (M, 4).
    #[getter]
    fn particles<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        let particles = self.estimate.particles.particles().iter();
        let rows = particles.map(|particle| {
            let pose = particle.map_from_lidar;
            let t = pose.translation;
            [t.x, t.y, pose.rotation.angle(), particle.weight]
        });
        Array2::from(rows.collect::<Vec<_>>()).into_pyarray(py)
    }

    fn __repr__(&self) -> String {
        let (t, state) = (self.estimate.pose.translation, self.state);
        let [x_m, y_m, _heading_rad] = self.estimate.standard_deviations();
        format!(
            "<fpmcl.Estimate: {state}, x {:.3} ± {x_m:.3} m, y {:.3} ± {y_m:.3} m>",
            t.x, t.y
        )
    }
}
