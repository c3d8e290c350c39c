//! From scans with poses to a map.
//!
//! ```text
//! key scans  ->  local maps  ->  per local map: ground, static points, Poisson surface, trimming,
//!                                free space, clipping, simplified ground  ->  one mesh
//! ```
//!
//! [`MapBuilder::build`] does all of it on scans in memory. For drives too long for
//! that, and to resume builds, use [`MapPlan`]: give the poses of all key scans, then build the local
//! maps one by one, with scans that are read on demand.

use std::error::Error;
use std::ops::ControlFlow;
use std::sync::atomic::{AtomicUsize, Ordering};

use glam::{DVec3, Vec3};
use nalgebra::{Translation3, Vector3};
use rayon::prelude::*;

use super::changes;
use super::config::{MapConfig, MapOptions};
use super::local_map::{self, LocalMap};
use super::path_check::{self, ImplausiblePath};
use super::plan::{self, Domain, LocalMapPlan, Ownership, origin_near};
use super::scan_agreement;
use super::scan_cloud::{ScanCloud, ScanPreparation};
use crate::geometry::{Pose3, TriangleMesh};
use crate::ground::GroundClassifier;
use crate::lidar::{LidarModel, Scan};
use crate::map::files::mapping_path::MappingPath;
use crate::map::mesh_view::MeshView;
use crate::map::model::{Map, MapError};
use crate::memory::{MemoryBudget, MemoryError};
use crate::meshing::MeshingError;
use crate::sensor::{SENSOR_SCANS, Sensor, SensorError};
use crate::validation::{InvalidValue, Validate as _};

/// An error of the source of the scans.
pub type ScanError = Box<dyn Error + Send + Sync>;

/// Reads a key scan by its index, from any thread.
pub type ReadScan<'a> = dyn Fn(usize) -> Result<Scan, ScanError> + Sync + 'a;

/// Progress of a build.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BuildEvent {
    /// A stage of a local map begins.
    Stage(&'static str),
    /// A scan was read, and prepared or registered.
    ScanPrepared,
}

/// Why a map cannot be built.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum BuildError {
    #[error("interrupted")]
    Interrupted,
    #[error(transparent)]
    Scan(ScanError),
    #[error("there are no scans to build a map from; select at least one frame")]
    NoScans,
    #[error(transparent)]
    Path(#[from] ImplausiblePath),
    #[error(
        "the poses of scans {first} to {last} do not fit: only {percent:.0} % of a scan's points are on the surfaces of the next one; check that they are poses of the lidar, and of these scans"
    )]
    PosesDoNotFit {
        first: usize,
        last: usize,
        percent: f32,
    },
    #[error("local map {number} (key scans {first} to {last}): {source}")]
    LocalMap {
        number: usize,
        first: usize,
        last: usize,
        source: MeshingError,
    },
    #[error(transparent)]
    Meshing(#[from] MeshingError),
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    #[error(
        "the map has no triangles: none of the {scans} key scans has points left to mesh; check the ranges of the sensor, and local_map.crop_x_m, crop_y_m and crop_z_m"
    )]
    Empty { scans: usize },
    #[error(
        "the cloud has no ground: none of its {points} points with normals are on a near-horizontal surface of 4 m² or more below others; its z axis must point up, and its unit must be the metre"
    )]
    CloudWithoutGround { points: usize },
    #[error(
        "the cloud has a point at {position}: single precision does not resolve centimetres there; subtract an offset before exporting it"
    )]
    CloudTooFar { position: Vec3 },
    #[error(
        "the cloud has {points} points, more than the 4 billion that can be numbered; divide it"
    )]
    CloudTooLarge { points: usize },
    #[error(transparent)]
    Sensor(#[from] SensorError),
    #[error(transparent)]
    Memory(#[from] MemoryError),
    #[error(transparent)]
    Map(#[from] MapError),
}

impl BuildError {
    /// The error with numbers of frames instead of those of key scans.
    #[must_use]
    pub(crate) fn with_frames(self, number_of: impl Fn(usize) -> usize) -> Self {
        match self {
            Self::PosesDoNotFit {
                first,
                last,
                percent,
            } => Self::PosesDoNotFit {
                first: number_of(first),
                last: number_of(last),
                percent,
            },
            other => other,
        }
    }
}

/// Builds maps of deskewed scans with poses.
pub struct MapBuilder {
    /// Configuration of the build.
    pub config: MapConfig,
    /// Sensor of the scans; `None`: what the configuration does not contain is inferred from them.
    pub sensor: Option<Sensor>,
    /// Preparation of the finished map for localization.
    pub options: MapOptions,
    /// Called for every event, from any thread; the build stops with [`BuildError::Interrupted`] soon
    /// after it returns `Break`.
    pub on_event: Box<dyn Fn(BuildEvent) -> ControlFlow<()> + Send + Sync>,
}

impl MapBuilder {
    /// Creates a builder without events and interruption.
    pub fn new(config: MapConfig) -> Self {
        Self {
            config,
            sensor: None,
            options: MapOptions::default(),
            on_event: Box::new(|_| ControlFlow::Continue(())),
        }
    }

    /// Builds a map from scans with their poses, `p_map = map_from_lidar * p_lidar`.
    ///
    /// Keeps the key scans in memory, about 1.5 MB for each scan of 120,000 points, and the map: in single precision,
    /// which resolves millimetres up to 8 km from its origin.
    ///
    /// # Errors
    /// The configuration is out of its range, a scan cannot be read or does not fit the sensor, the poses are implausible,
    /// memory does not suffice, or there is no surface.
    pub fn build<E: Into<ScanError>>(
        &self,
        scans: impl IntoIterator<Item = Result<(Scan, Pose3), E>>,
    ) -> Result<Map, BuildError> {
        let (keys, poses) = self.key_scans(scans)?;
        self.build_keys(poses, None, &|key| Ok(keys[key].clone()))
    }

    /// Builds a map of key scans by their poses, or adds them to an older map in whose frame their poses are: what their
    /// beams pass through is removed, and what that map does not have is added. `read_scan` returns a key scan by its
    /// index and is called from any thread.
    pub(crate) fn build_keys(
        &self,
        map_from_lidar: Vec<Pose3>,
        older: Option<&Map>,
        read_scan: &ReadScan,
    ) -> Result<Map, BuildError> {
        self.config.validate()?;
        let sensor = self.sensor_of(map_from_lidar.len(), read_scan)?;
        let mut plan = self.plan(&sensor, map_from_lidar)?;
        let Some(map) = older else {
            let (mesh, _) = plan.build_all(read_scan)?;
            return plan.finish(mesh);
        };
        let mesh = map.mesh()?;
        plan.older = Some(&*mesh);
        let (added, gone) = plan.build_all(read_scan)?;
        let path = map.path.extended_by(&plan.map_from_lidar);
        let mesh = changes::joined(&mesh, &gone, &added);
        Ok(Map::new(mesh, path, &self.options)?)
    }

    /// Adds a newer drive to a map, in whose frame its poses are: what its beams pass through is removed, and what
    /// the map does not have is added. See [`SecondDrive`](crate::localization::SecondDrive) for the poses.
    ///
    /// # Errors
    /// As [`build`](Self::build).
    pub fn extend<E: Into<ScanError>>(
        &self,
        map: &Map,
        scans: impl IntoIterator<Item = Result<(Scan, Pose3), E>>,
    ) -> Result<Map, BuildError> {
        let (keys, poses) = self.key_scans(scans)?;
        self.build_keys(poses, Some(map), &|key| Ok(keys[key].clone()))
    }

    /// The key scans and their poses.
    fn key_scans<E: Into<ScanError>>(
        &self,
        scans: impl IntoIterator<Item = Result<(Scan, Pose3), E>>,
    ) -> Result<(Vec<Scan>, Vec<Pose3>), BuildError> {
        self.config.validate()?;
        let (mut keys, mut poses): (Vec<Scan>, Vec<Pose3>) = Default::default();
        for item in scans {
            let (scan, pose) = item.map_err(|error| BuildError::Scan(error.into()))?;
            if plan::is_key_scan(poses.last(), &pose, self.config.displacement_threshold_m) {
                keys.push(scan);
                poses.push(pose);
            }
        }
        Ok((keys, poses))
    }

    /// The sensor of the key scans: given, else inferred from ten of them.
    fn sensor_of(&self, count: usize, read_scan: &ReadScan) -> Result<Sensor, BuildError> {
        let known = &self.config.sensor;
        if let Some(sensor) = &self.sensor {
            return Ok(sensor.clone().with_known(known));
        }
        if let Some(sensor) = Sensor::configured(known) {
            return Ok(sensor);
        }
        let step = count.div_ceil(SENSOR_SCANS).max(1);
        let scans: Result<Vec<Scan>, ScanError> = (0..count).step_by(step).map(read_scan).collect();
        Ok(Sensor::infer(&scans.map_err(BuildError::Scan)?, known)?)
    }

    /// Plans the local maps along the poses of the key scans of a sensor.
    ///
    /// # Errors
    /// The configuration is out of its range, there are no poses, or memory does not suffice.
    pub fn plan(
        &self,
        sensor: &Sensor,
        map_from_lidar: Vec<Pose3>,
    ) -> Result<MapPlan<'_>, BuildError> {
        let config = &self.config;
        config.validate()?;
        if map_from_lidar.is_empty() {
            return Err(BuildError::NoScans);
        }
        path_check::check(map_from_lidar.iter().enumerate(), config.max_step_m)?;
        let local_maps = plan::local_maps(&map_from_lidar, config.local_map_size, config.overlap_m);
        let reach_m = f64::from(config.local_map.crop_m(&sensor.range_image).length());
        let budget = self.options.memory_budget;
        Ownership::require_memory(&map_from_lidar, &local_maps, reach_m, budget)?;
        require_memory_of_images(&sensor.range_image, budget)?;
        Ok(MapPlan {
            builder: self,
            scan: config.local_map.scan_preparation(sensor),
            classifier: config.ground.classifier(sensor.height_m())?,
            older: None,
            ownership: Ownership::new(&map_from_lidar, &local_maps),
            local_maps,
            map_from_lidar,
        })
    }
}

/// Requires the memory of one range image per thread, with normals, free space and ground features.
fn require_memory_of_images(model: &LidarModel, budget: MemoryBudget) -> Result<(), MemoryError> {
    const PIXEL_BYTES: usize = 128;
    budget.require(
        "the range images of the scans",
        (model.len() * rayon::current_num_threads() * PIXEL_BYTES) as f64,
        "lower the height or width of the sensor's range_image, or the number of threads",
    )
}

/// The local maps of a drive.
pub struct MapPlan<'a> {
    /// Key scans of each local map.
    pub local_maps: Vec<LocalMapPlan>,
    /// Poses of the key scans.
    pub map_from_lidar: Vec<Pose3>,
    /// Ground classifier; by default that of the configuration.
    pub classifier: Box<dyn GroundClassifier>,
    /// A map that the drive is added to, in the same frame.
    pub(crate) older: Option<&'a dyn MeshView>,
    builder: &'a MapBuilder,
    scan: ScanPreparation,
    ownership: Ownership,
}

impl MapPlan<'_> {
    /// Builds all local maps; returns what they add, and the triangles of the older map that are gone, ascending.
    fn build_all(&self, read_scan: &ReadScan) -> Result<(TriangleMesh, Vec<u32>), BuildError> {
        let (mut mesh, mut gone) = (TriangleMesh::default(), vec![]);
        for local_map in &self.local_maps {
            let built = self.build_local_map(local_map, read_scan)?;
            mesh.append(&built.in_map());
            gone.extend(built.gone);
        }
        gone.sort_unstable();
        gone.dedup();
        Ok((mesh, gone))
    }

    /// Builds a local map. `read_scan` returns a key scan by its index and is called from any thread.
    ///
    /// # Errors
    /// A scan cannot be read, the poses do not fit the scans, there is no surface, or memory does not suffice.
    pub fn build_local_map(
        &self,
        plan: &LocalMapPlan,
        read_scan: &ReadScan,
    ) -> Result<LocalMap, BuildError> {
        let config = &self.builder.config.local_map;
        let notify = |event| match (self.builder.on_event)(event) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(BuildError::Interrupted),
        };
        notify(BuildEvent::Stage("scans"))?;
        let middle = &self.map_from_lidar[plan.own.start.midpoint(plan.own.end)];
        let origin = origin_near(DVec3::from_slice(middle.translation.vector.as_slice()));
        let offset = Vector3::from(origin.to_array());
        let held_bytes = AtomicUsize::new(0);
        let prepare = |index: usize| {
            let scan = read_scan(index).map_err(BuildError::Scan)?;
            if index == plan.used.start {
                self.scan.sensor.require_fit(&scan)?;
            }
            let pose = Translation3::from(-offset) * self.map_from_lidar[index];
            let prepared = ScanCloud::prepare(scan, &pose, &self.scan, &*self.classifier);
            let bytes = held_bytes.fetch_add(prepared.bytes(), Ordering::Relaxed);
            self.builder.options.memory_budget.require(
                "the scans of a local map",
                bytes as f64,
                "lower local_map_size or overlap_m, or raise local_map.voxel_size_m",
            )?;
            notify(BuildEvent::ScanPrepared)?;
            Ok(prepared)
        };
        let scans: Vec<ScanCloud> = (plan.used.clone().into_par_iter())
            .map(prepare)
            .collect::<Result<_, BuildError>>()?;
        let agreements = scan_agreement::of_neighbours(&scans);
        let agreement = scan_agreement::median(&agreements);
        if let Some(agreement) = agreement
            && agreement < scan_agreement::WRONG
        {
            return Err(BuildError::PosesDoNotFit {
                first: plan.used.start,
                last: plan.used.end - 1,
                percent: 100.0 * agreement,
            });
        }
        let begin_stage = |name| notify(BuildEvent::Stage(name));
        let domain = Domain {
            number: plan.number,
            origin,
            ownership: &self.ownership,
        };
        let built = local_map::build(
            scans,
            domain,
            self.older,
            &self.scan.sensor.range_image,
            config,
            self.builder.options.memory_budget,
            begin_stage,
        );
        let mut local_map = built.map_err(|error| match error {
            BuildError::Meshing(source) => BuildError::LocalMap {
                number: plan.number,
                first: plan.own.start,
                last: plan.own.end - 1,
                source,
            },
            other => other,
        })?;
        local_map.agreement = agreement;
        local_map.doubtful_scans = (scan_agreement::doubtful_scans(&agreements).iter())
            .map(|scan| plan.used.start + scan)
            .collect();
        Ok(local_map)
    }

    /// Prepares the joined mesh of all local maps as a map; `world_from_map` is the identity.
    ///
    /// # Errors
    /// The mesh has no triangles; else as [`Map::new`].
    pub fn finish(self, mesh: TriangleMesh) -> Result<Map, BuildError> {
        if mesh.triangles.is_empty() {
            let scans = self.map_from_lidar.len();
            return Err(BuildError::Empty { scans });
        }
        let path = MappingPath {
            world_from_map: Pose3::identity(),
            map_from_lidar: self.map_from_lidar,
            georeference: None,
            sensor: Some(self.scan.sensor),
        };
        Ok(Map::new(mesh, path, &self.builder.options)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lidar::LidarModel;
    use crate::rendering::Backend;

    fn model() -> LidarModel {
        LidarModel {
            height: 32,
            width: 240,
            ..LidarModel::default()
        }
    }

    /// A builder of coarse local maps of three scans.
    fn builder() -> MapBuilder {
        let mut config = MapConfig {
            local_map_size: 3,
            overlap_m: 1.5,
            ..MapConfig::default()
        };
        config.local_map.poisson.depth = Some(5);
        config.local_map.max_distance_m = 1.0;
        (config.local_map.crop_x_m, config.local_map.crop_y_m) = (Some(10.0), Some(10.0));
        MapBuilder {
            sensor: Some(Sensor::new(model())),
            options: MapOptions {
                backend: Backend::Cpu,
                ..MapOptions::default()
            },
            ..MapBuilder::new(config)
        }
    }

    /// A scan of a road between two walls along x, the same from everywhere on its centre line.
    fn scan() -> Scan {
        let returned = |direction: &Vec3| {
            let road_m = if direction.z < 0.0 {
                -1.73 / direction.z
            } else {
                f32::INFINITY
            };
            let range_m = road_m.min(6.0 / direction.y.abs());
            (range_m < 20.0).then(|| range_m * *direction)
        };
        let points: Vec<Vec3> = model().directions().iter().filter_map(returned).collect();
        Scan {
            intensities: vec![0.5; points.len()],
            points,
            ..Scan::default()
        }
    }

    /// The same scan at a place along x, with a panel across the road at 7 m.
    fn scan_before_panel(x_m: f64) -> Scan {
        let mut scan = scan();
        for point in &mut scan.points {
            let share = (7.0 - x_m as f32) / point.x;
            let at_panel = *point * share;
            if (0.0..1.0).contains(&share) && at_panel.y.abs() < 2.0 && at_panel.z < 0.5 {
                *point = at_panel;
            }
        }
        scan
    }

    /// A drive along x, whose scans show the panel or not.
    fn drive_towards_panel(is_there: bool) -> Vec<Result<(Scan, Pose3), ScanError>> {
        let at = |x_m: f64| {
            let scan = if is_there {
                scan_before_panel(x_m)
            } else {
                scan()
            };
            Ok((scan, Pose3::translation(x_m, 0.0, 0.0)))
        };
        [0.0, 0.4, 0.8, 1.2, 1.6].map(at).into()
    }

    /// Area of the triangles of the panel [m²].
    fn panel_m2(mesh: &TriangleMesh) -> f32 {
        (0..mesh.triangles.len())
            .filter(|&triangle| {
                let center = mesh.corners(triangle).into_iter().sum::<Vec3>() / 3.0;
                let normal = mesh.scaled_normal(triangle).normalize_or_zero();
                (center.x - 7.0).abs() < 0.3 && center.y.abs() < 1.9 && normal.x.abs() > 0.8
            })
            .map(|triangle| 0.5 * mesh.scaled_normal(triangle).length())
            .sum()
    }

    #[test]
    fn a_newer_drive_adds_what_is_new_removes_what_is_gone_and_keeps_the_rest() {
        let mut builder = builder();
        builder.config.local_map.poisson.depth = Some(7);
        builder.config.local_map.max_distance_m = 0.3;
        let map_of = |is_there| builder.build(drive_towards_panel(is_there)).unwrap();
        let (empty, blocked) = (map_of(false), map_of(true));
        let extended = |map: &Map, is_there| {
            let map = builder.extend(map, drive_towards_panel(is_there)).unwrap();
            assert_eq!(map.path.map_from_lidar.len(), 10);
            panel_m2(&map.mesh().unwrap())
        };
        let (without, with) = (
            panel_m2(&empty.mesh().unwrap()),
            panel_m2(&blocked.mesh().unwrap()),
        );
        assert!(without < 0.2 && with > 3.0, "{without} {with}");
        let same = extended(&blocked, true);
        assert!((same - with).abs() < 0.2 * with, "{same} {with}");
        let added = extended(&empty, true);
        assert!(added > 0.8 * with, "{added} {with}");
        let gone = extended(&blocked, false);
        assert!(gone < 0.2 * with, "{gone} {with}");
    }

    /// Scans along x.
    fn drive(positions_m: &[f64]) -> Vec<Result<(Scan, Pose3), ScanError>> {
        let at = |&x: &f64| Ok((scan(), Pose3::translation(x, 0.0, 0.0)));
        positions_m.iter().map(at).collect()
    }

    fn error_of(builder: &MapBuilder, positions_m: &[f64]) -> BuildError {
        builder.build(drive(positions_m)).err().unwrap()
    }

    #[test]
    fn a_map_built_at_once_is_that_of_its_local_maps_built_one_by_one() {
        let builder = builder();
        let positions_m = [0.0, 1.0, 2.0, 3.0, 4.0];
        let map = builder.build(drive(&positions_m)).unwrap();

        let poses = positions_m.map(|x| Pose3::translation(x, 0.0, 0.0));
        let plan = builder.plan(&Sensor::new(model()), poses.to_vec()).unwrap();
        assert_eq!(plan.local_maps.len(), 2);
        let mut mesh = TriangleMesh::default();
        for local_map in &plan.local_maps {
            let built = plan.build_local_map(local_map, &|_| Ok(scan())).unwrap();
            assert!(built.counts.triangles > 100, "{:?}", built.counts);
            mesh.append(&built.in_map());
        }
        assert!(*map.mesh().unwrap() == mesh);
        assert_eq!(map.path.map_from_lidar, poses);
        let joined = plan.finish(mesh).unwrap();
        assert!(joined.mesh().unwrap() == map.mesh().unwrap() && joined.path == map.path);
    }

    #[test]
    fn a_saved_map_loads_with_the_same_mesh_and_path() {
        let builder = builder();
        let mut map = builder.build(drive(&[0.0])).unwrap();
        let world_from_map = Pose3::new([1e6 / 3.0, -0.1, 7.0].into(), [0.1, 0.2, -0.3].into());
        map.path = MappingPath {
            world_from_map,
            map_from_lidar: vec![world_from_map.inverse(); 3],
            ..MappingPath::default()
        }
        .into();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        map.save(&path).unwrap();
        let loaded = Map::load(&path, &builder.options).unwrap();
        assert!(loaded.mesh().unwrap() == map.mesh().unwrap());
        assert_eq!(loaded.path, map.path);
    }

    #[test]
    fn a_drive_without_motion_has_one_key_scan() {
        let map = builder().build(drive(&[1.0; 4])).unwrap();
        assert_eq!(map.path.map_from_lidar.len(), 1);
    }

    #[test]
    fn a_build_stops_when_an_event_is_answered_with_break() {
        let builder = MapBuilder {
            on_event: Box::new(|event| match event {
                BuildEvent::ScanPrepared => ControlFlow::Break(()),
                BuildEvent::Stage(_) => ControlFlow::Continue(()),
            }),
            ..builder()
        };
        let error = error_of(&builder, &[0.0, 1.0]);
        assert!(matches!(error, BuildError::Interrupted), "{error}");
    }

    #[test]
    fn without_scans_or_without_points_the_build_is_an_error() {
        let error = error_of(&builder(), &[]);
        assert!(matches!(error, BuildError::NoScans), "{error}");
        let empty = [Ok::<_, ScanError>((Scan::default(), Pose3::identity()))];
        let error = builder().build(empty).err().unwrap();
        assert!(matches!(error, BuildError::Empty { scans: 1 }), "{error}");
    }

    #[test]
    fn an_error_of_the_source_of_the_scans_is_passed_on() {
        let damaged = [Err::<(Scan, Pose3), _>("the disk is on fire")];
        let error = builder().build(damaged).err().unwrap();
        assert_eq!(error.to_string(), "the disk is on fire");
    }

    #[test]
    fn an_invalid_configuration_is_an_error_with_its_key_before_a_scan_is_read() {
        let mut builder = builder();
        builder.config.displacement_threshold_m = f64::NAN;
        let unread = std::iter::from_fn(|| -> Option<Result<(Scan, Pose3), ScanError>> {
            unreachable!("a scan was read")
        });
        let message = builder.build(unread).err().unwrap().to_string();
        assert!(message.contains("displacement_threshold_m"), "{message}");
    }
}
