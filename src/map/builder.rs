//! From scans with poses to a map.
//!
//! ```text
//! key scans  ->  local maps  ->  per local map: ground, static points, Poisson surface, trimming,
//!                                free space, border, simplified ground  ->  one mesh
//! ```
//!
//! [`MapBuilder::build`] does all of it on scans in memory. A drive that is too long for that, or a
//! build that resumes, goes through [`MapPlan`]: the poses of all scans first, then one local map after
//! the other, with scans that are read when they are needed.

use std::error::Error;
use std::ops::ControlFlow;

use rayon::prelude::*;

use super::config::{MapConfig, MapOptions};
use super::local_map::{self, LocalMap};
use super::mapping_path::MappingPath;
use super::model::{Map, MapError};
use super::plan::{self, LocalMapPlan, Ownership};
use super::scan_cloud::ScanCloud;
use crate::geometry::{Pose3, TriangleMesh};
use crate::ground::GroundClassifier;
use crate::lidar::Scan;
use crate::meshing::MeshingError;
use crate::validation::{InvalidValue, Validate as _};

/// The error of whoever gives the scans.
pub type ScanError = Box<dyn Error + Send + Sync>;

/// Progress of a build.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BuildEvent {
    /// A stage of a local map begins.
    Stage(&'static str),
    /// A scan was read and prepared.
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
        "the map has no triangles: none of the {scans} key scans has points left to mesh; check range_image, crop_x, crop_y and crop_z"
    )]
    Empty { scans: usize },
    #[error(transparent)]
    Map(#[from] MapError),
}

/// Builds maps.
pub struct MapBuilder {
    /// Configuration of the build.
    pub config: MapConfig,
    /// How the finished map is prepared.
    pub options: MapOptions,
    /// Called for every event, from any thread; the build stops with [`BuildError::Interrupted`] soon
    /// after it returns `Break`.
    pub on_event: Box<dyn Fn(BuildEvent) -> ControlFlow<()> + Send + Sync>,
}

impl MapBuilder {
    /// A builder that reports nothing and cannot be interrupted.
    pub fn new(config: MapConfig) -> Self {
        Self {
            config,
            options: MapOptions::default(),
            on_event: Box::new(|_| ControlFlow::Continue(())),
        }
    }

    /// Builds a map from scans with their poses, `p_map = map_from_lidar * p_lidar`.
    ///
    /// Keeps the key scans in memory, about 1.5 MB for each scan of 120,000 points.
    pub fn build<E: Into<ScanError>>(
        &self,
        scans: impl IntoIterator<Item = Result<(Scan, Pose3), E>>,
    ) -> Result<Map, BuildError> {
        let (mut keys, mut poses): (Vec<Scan>, Vec<Pose3>) = Default::default();
        for item in scans {
            let (scan, pose) = item.map_err(|error| BuildError::Scan(error.into()))?;
            if plan::is_key_scan(poses.last(), &pose, self.config.displacement_threshold_m) {
                keys.push(scan);
                poses.push(pose);
            }
        }
        let plan = self.plan(poses)?;
        let mut mesh = TriangleMesh::default();
        for local_map in &plan.local_maps {
            let built = plan.build_local_map(local_map, &|key| Ok(keys[key].clone()))?;
            mesh.append(&built.mesh);
        }
        plan.finish(mesh)
    }

    /// Plans the local maps along the poses of the key scans.
    pub fn plan(&self, map_from_lidar: Vec<Pose3>) -> Result<MapPlan<'_>, BuildError> {
        let config = &self.config;
        config.validate()?;
        let local_maps = plan::local_maps(&map_from_lidar, config.local_map_size, config.overlap_m);
        let reach_m = f64::from(config.local_map.scan.crop_m.length());
        Ok(MapPlan {
            builder: self,
            classifier: config.ground.classifier()?,
            ownership: Ownership::new(&map_from_lidar, &local_maps, reach_m),
            local_maps,
            map_from_lidar,
        })
    }
}

/// The local maps of a drive.
pub struct MapPlan<'a> {
    /// Which scans make which local map.
    pub local_maps: Vec<LocalMapPlan>,
    /// Poses of the key scans.
    pub map_from_lidar: Vec<Pose3>,
    /// Ground classifier, that of the configuration unless it is replaced.
    pub classifier: Box<dyn GroundClassifier>,
    builder: &'a MapBuilder,
    ownership: Ownership,
}

impl MapPlan<'_> {
    /// Builds a local map. `read_scan` gives a key scan by its index, from any thread.
    pub fn build_local_map(
        &self,
        plan: &LocalMapPlan,
        read_scan: &(dyn Fn(usize) -> Result<Scan, ScanError> + Sync),
    ) -> Result<LocalMap, BuildError> {
        let config = &self.builder.config.local_map;
        let notify = |event| match (self.builder.on_event)(event) {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(BuildError::Interrupted),
        };
        notify(BuildEvent::Stage("scans"))?;
        let prepare = |index: usize| {
            let scan = read_scan(index).map_err(BuildError::Scan)?;
            let pose = &self.map_from_lidar[index];
            let prepared = ScanCloud::prepare(scan, pose, &config.scan, &*self.classifier);
            notify(BuildEvent::ScanPrepared)?;
            Ok(prepared)
        };
        let scans: Vec<ScanCloud> = (plan.used.clone().into_par_iter())
            .map(prepare)
            .collect::<Result<_, BuildError>>()?;
        let begin_stage = |name| notify(BuildEvent::Stage(name));
        local_map::build(scans, plan.number, &self.ownership, config, begin_stage).map_err(
            |error| match error {
                BuildError::Meshing(source) => BuildError::LocalMap {
                    number: plan.number,
                    first: plan.own.start,
                    last: plan.own.end - 1,
                    source,
                },
                other => other,
            },
        )
    }

    /// Prepares the joined mesh of all local maps as a map; its world is its own frame.
    pub fn finish(self, mesh: TriangleMesh) -> Result<Map, BuildError> {
        if mesh.triangles.is_empty() {
            let scans = self.map_from_lidar.len();
            return Err(BuildError::Empty { scans });
        }
        let path = MappingPath {
            world_from_map: Pose3::identity(),
            map_from_lidar: self.map_from_lidar,
        };
        Ok(Map::new(mesh, path, &self.builder.options)?)
    }
}
