//! Maps, rays and ground.

use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use anyhow::ensure;
use fpmcl::geometry::{Pose3, TriangleMesh};
use fpmcl::ground::GroundConfig;
use fpmcl::lidar::Motion;
use fpmcl::map::{self, BuildError, MapBuilder, MapCache, MapConfig, MapOptions};
use fpmcl::mapping::{MappingError, map_recording};
use fpmcl::rendering::Backend;
use numpy::ndarray::Array2;
use numpy::{
    IntoPyArray as _, PyArray1, PyArray2, PyArray3, PyArrayDyn, PyUntypedArrayMethods as _,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{self, Numbers, Numbers2};
use crate::errors::{of_scan, raised, released};
use crate::recording::{Scans, Sensor};
use crate::settings;

/// A triangle mesh with its ground and the path of its mapping drive; immutable.
#[pyclass(frozen, module = "fpmcl")]
pub struct Map {
    pub map: map::Map,
    /// Read on first use, for the views.
    mesh: OnceLock<Arc<TriangleMesh>>,
}

impl From<map::Map> for Map {
    fn from(map: map::Map) -> Self {
        Self {
            map,
            mesh: OnceLock::new(),
        }
    }
}

impl Map {
    fn mesh(&self) -> PyResult<&TriangleMesh> {
        if let Some(mesh) = self.mesh.get() {
            return Ok(mesh);
        }
        let mesh = self.map.mesh().map_err(raised)?;
        Ok(self.mesh.get_or_init(|| mesh))
    }
}

#[pymethods]
impl Map {
    /// Reads a map, or a mesh from elsewhere (PLY, OBJ, STL).
    ///
    /// ``backend``: what renders it, ``"auto"``, ``"cpu"`` or ``"gpu"``. ``cache``: where its tiles are kept between
    /// runs, of which only those around the car are then in memory: ``True`` for a folder next to the map, or a folder;
    /// by default nothing is written.
    #[staticmethod]
    #[pyo3(signature = (path, *, backend="auto", cache=None))]
    fn load(py: Python<'_>, path: PathBuf, backend: &str, cache: Option<Cache>) -> PyResult<Self> {
        let options = MapOptions {
            cache: match cache {
                None | Some(Cache::NextToMap(false)) => MapCache::None,
                Some(Cache::NextToMap(true)) => MapCache::NextToMap,
                Some(Cache::Folder(folder)) => MapCache::Folder(folder),
            },
            ..options(backend)?
        };
        let map = released(py, || map::Map::load(&path, &options))?;
        Ok(Self::from(map))
    }

    /// Writes the map as a PLY file, which is complete by itself; an existing file is replaced.
    fn save(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        released(py, || self.map.save(&path))
    }

    /// Builds a map.
    ///
    /// ``scans``: a Recording, or an iterable of Scans and of arrays (N, 3) [m], which are taken as deskewed.
    /// ``poses``: (N, 4, 4), one per scan, into the frame of the map; by default those of the recording, which are checked,
    /// and without these found from the scans. Scans with times are deskewed by them. ``sensor``: by default inferred from
    /// the scans. ``onto``: a map of the same place to which the scans are added: they are found in it, what their beams pass
    /// through is removed, and what it does not have is added. Settings: fields of ``map`` in ``fpmcl config build-map
    /// --full``, such as ``local_map_size``, ``depth``.
    ///
    /// Raises Error if poses and scans, or scans and sensor, do not fit each other, or if the scans are not found in ``onto``.
    #[staticmethod]
    #[pyo3(signature = (scans, poses=None, *, onto=None, sensor=None, backend="auto", **settings))]
    fn build(
        py: Python<'_>,
        scans: &Bound<'_, PyAny>,
        poses: Option<Numbers<'_, f64>>,
        onto: Option<&Bound<'_, PyAny>>,
        sensor: Option<Sensor>,
        backend: &str,
        settings: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Self> {
        let config = settings::apply(MapConfig::default(), settings)?;
        let scans = Scans::of(scans)?;
        let poses = poses.map(|poses| arrays::poses("poses", &poses));
        let poses = poses.transpose()?;
        let onto = onto.map(map_of).transpose()?;
        if onto.is_some() && poses.is_some() {
            return Err(PyValueError::new_err(
                "poses and onto are given; leave out poses: the scans are found in the map",
            ));
        }
        let older = onto.as_ref().map(|map| &map.get().map);
        let sensor = scans.sensor(py, sensor)?;
        let raised_signal = Arc::new(Mutex::new(None));
        let signal = raised_signal.clone();
        let builder = MapBuilder {
            options: options(backend)?,
            on_event: Box::new(
                move |_event| match Python::attach(|py| py.check_signals()) {
                    Ok(()) => ControlFlow::Continue(()),
                    Err(interrupt) => {
                        *signal.lock().unwrap_or_else(PoisonError::into_inner) = Some(interrupt);
                        ControlFlow::Break(())
                    }
                },
            ),
            sensor: Some(sensor.0),
            ..MapBuilder::new(config)
        };
        let built = released(py, || match &poses {
            Some(poses) => build_of_poses(&scans, poses, &builder),
            None => build_of_recording(&scans, older, builder),
        });
        let signal = raised_signal
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take();
        match signal {
            Some(interrupt) => Err(interrupt),
            None => built.map(Self::from),
        }
    }

    /// Vertices, (V, 3) float32 [m]; read-only, not a copy.
    #[getter]
    fn vertices<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        arrays::view_of_vectors(&slf.get().mesh()?.vertices, slf.as_any())
    }

    /// Indices of the vertices of each triangle, (T, 3) uint32; read-only, not a copy.
    #[getter]
    fn triangles<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArrayDyn<u32>>> {
        let triangles = &slf.get().mesh()?.triangles;
        arrays::view(
            triangles.as_flattened(),
            &[triangles.len(), 3],
            slf.as_any(),
        )
    }

    /// Colours of the vertices, red, green, blue, (V, 3) uint8; red is ground. Read-only, not a copy.
    #[getter]
    fn colors<'py>(slf: &Bound<'py, Self>) -> PyResult<Bound<'py, PyArrayDyn<u8>>> {
        let colors = &slf.get().mesh()?.colors;
        arrays::view(colors.as_flattened(), &[colors.len(), 3], slf.as_any())
    }

    /// Poses of the mapping drive, (K, 4, 4).
    #[getter]
    fn path<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray3<f64>> {
        arrays::of_poses(py, &self.map.path.map_from_lidar)
    }

    /// Pose of the map in the world of the poses that it was built with, (4, 4).
    #[getter]
    fn world_from_map<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        arrays::of_pose(py, &self.map.path.world_from_map)
    }

    /// Place of the map on the Earth: latitude, longitude, height of its origin, rotation, zone of UTM and standard
    /// deviations, with the names and units of its comment in the file; None where it is not known.
    #[getter]
    fn georeference<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyDict>>> {
        let Some(place) = &self.map.path.georeference else {
            return Ok(None);
        };
        let dict = PyDict::new(py);
        for (name, value) in [
            ("latitude_deg", place.latitude_deg),
            ("longitude_deg", place.longitude_deg),
            ("height_m", place.height_m),
            ("roll_deg", place.roll_deg),
            ("pitch_deg", place.pitch_deg),
            ("yaw_deg", place.yaw_deg),
            ("horizontal_m", place.horizontal_m),
            ("vertical_m", place.vertical_m),
            ("heading_deg", place.heading_deg),
        ] {
            dict.set_item(name, value)?;
        }
        dict.set_item("epsg", place.utm.epsg())?;
        Ok(Some(dict))
    }

    /// Latitude, longitude [deg] and height [m] of points of the map, (N, 3) both.
    ///
    /// Raises Error where the place of the map on the Earth is not known.
    fn geodetic<'py>(
        &self,
        py: Python<'py>,
        points: Numbers2<'py, f64>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let place = self.map.path.georeference.as_ref();
        let place = place.ok_or_else(|| {
            raised(anyhow::anyhow!(
                "the place of the map on the Earth is not known; build it with fpmcl build-map --gnss"
            ))
        })?;
        if points.shape()[1] != 3 {
            return Err(PyValueError::new_err("points must have the shape (N, 3)"));
        }
        let earth = place.on_earth().map_err(raised)?;
        let mut rows = Vec::with_capacity(points.shape()[0]);
        for point in points.as_array().rows() {
            let at = earth.geodetic(&[point[0], point[1], point[2]].into());
            let at = at.map_err(raised)?;
            rows.push([at.latitude_deg, at.longitude_deg, at.height_m]);
        }
        Ok(Array2::from(rows).into_pyarray(py))
    }

    /// What renders the map.
    #[getter]
    fn renderer(&self) -> String {
        self.map.renderer.name()
    }

    fn __repr__(&self) -> String {
        format!("<fpmcl.Map: {} triangles>", self.map.triangle_count())
    }
}

/// Where the tiles of a map are kept.
#[derive(FromPyObject)]
enum Cache {
    NextToMap(bool),
    Folder(PathBuf),
}

fn options(backend: &str) -> PyResult<MapOptions> {
    let backend = match backend {
        "auto" => Backend::Auto,
        "cpu" => Backend::Cpu,
        "gpu" => Backend::Gpu,
        _ => {
            return Err(PyValueError::new_err(format!(
                "backend is {backend:?}; it must be \"auto\", \"cpu\" or \"gpu\""
            )));
        }
    };
    Ok(MapOptions {
        backend,
        ..MapOptions::default()
    })
}

/// A map of scans with one pose each, by which they are deskewed.
fn build_of_poses(
    scans: &Scans,
    map_from_lidar: &[Pose3],
    builder: &MapBuilder,
) -> anyhow::Result<map::Map> {
    ensure!(
        map_from_lidar.len() == scans.len(),
        "there are {} poses for {} scans; give one per scan",
        map_from_lidar.len(),
        scans.len()
    );
    let times_s = scans.times_s();
    let posed = (0..scans.len()).map(|row| {
        let mut scan = scans.read(row)?.into_owned();
        if let Some(times_s) = &times_s
            && let Some(motion) = Motion::along(map_from_lidar, times_s, row)
        {
            motion.deskew(&mut scan);
        }
        anyhow::Ok((scan, map_from_lidar[row]))
    });
    builder.build(posed).map_err(of_build)
}

/// A map of scans whose poses are those of their recording, or are found, in an older map where there is one.
fn build_of_recording(
    scans: &Scans,
    older: Option<&map::Map>,
    builder: MapBuilder,
) -> anyhow::Result<map::Map> {
    let recording = scans.recording()?;
    match map_recording(&recording, older, builder) {
        Ok(mapped) => Ok(mapped.map),
        Err(MappingError::Build(error)) => Err(of_build(error)),
        Err(error) => Err(error.into()),
    }
}

fn of_build(error: BuildError) -> anyhow::Error {
    match error {
        BuildError::Scan(error) => of_scan(error),
        error => error.into(),
    }
}

/// The map that an argument is.
pub fn map_of<'py>(argument: &Bound<'py, PyAny>) -> PyResult<Bound<'py, Map>> {
    let map = argument.cast::<Map>().cloned();
    map.map_err(|_error| {
        let kind = argument.get_type();
        let message = format!("map is a {kind}, not a fpmcl.Map; fpmcl.Map.load(path) reads one");
        PyTypeError::new_err(message)
    })
}

/// Casts rays at a map: ranges along directions from the origin of the lidar, infinite without a hit [m].
///
/// ``poses``: (4, 4) or (P, 4, 4). ``directions``: (N, 3), unit vectors in the frame of the lidar; float32 without a copy
/// if contiguous. Returns (N,) float32, or (P, N).
#[pyfunction]
pub fn cast_rays<'py>(
    py: Python<'py>,
    #[pyo3(from_py_with = map_of)] map: Bound<'py, Map>,
    poses: Numbers<'py, f64>,
    directions: Numbers2<'py, f32>,
) -> PyResult<Bound<'py, PyAny>> {
    /// Largest deviation of the length of a direction (unitless).
    const TOLERANCE: f32 = 1e-3;
    let map = map.get();
    let map_from_lidar = arrays::poses("poses", &poses)?;
    let directions = arrays::vectors("directions", &directions)?;
    let is_unit = |direction: &glam::Vec3| (direction.length() - 1.0).abs() < TOLERANCE;
    if let Some(row) = directions.iter().position(|it| !is_unit(it)) {
        return Err(PyValueError::new_err(format!(
            "direction {row} is {}, which is no unit vector; divide directions by their lengths",
            directions[row]
        )));
    }
    let mut ranges = released(py, || {
        map.map
            .renderer
            .cast(&map_from_lidar, &directions, f32::INFINITY)
    })?;
    Ok(match (poses.ndim(), ranges.len()) {
        (2, 1) => ranges.swap_remove(0).into_pyarray(py).into_any(),
        (_, count) => Array2::from_shape_vec((count, directions.len()), ranges.concat())
            .map_err(raised)?
            .into_pyarray(py)
            .into_any(),
    })
}

/// Returns the confidence that each point of a scan is ground, (N,) float32, 0 to 1.
///
/// ``points``: (N, 3), one revolution in the frame of the lidar [m]; float32 without a copy if contiguous. Settings:
/// ``method`` (``"fuzzy"``, ``"pca"``, ``"ransac"``) and the other fields of ``ground`` in ``fpmcl config ground --full``.
#[pyfunction]
#[pyo3(signature = (points, **settings))]
pub fn classify_ground<'py>(
    py: Python<'py>,
    points: Numbers2<'py, f32>,
    settings: Option<&Bound<'_, PyDict>>,
) -> PyResult<Bound<'py, PyArray1<f32>>> {
    let config = settings::apply(GroundConfig::default(), settings)?;
    let points = arrays::vectors("points", &points)?;
    let confidence = released(py, || {
        let classifier = config.classifier(None)?;
        anyhow::Ok(classifier.ground_confidence(&points))
    })?;
    Ok(confidence.into_pyarray(py))
}
