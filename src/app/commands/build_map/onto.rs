//! The older map to which a build adds a newer drive.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::Result;

use crate::app::report::plotting::MapPlot;
use crate::app::report::run_output::MOST_TRIANGLES;
use crate::app::run::artefact::hash::hash_of_file;
use crate::app::run::{Context, input};
use crate::app::settings::{BuildMapConfig, MapInputConfig};
use crate::geometry::pose2_from_pose3;
use crate::map::mesh_view::{MeshView, Without, reduced};
use crate::map::{Map, MapOptions, MappingPath, surface_of};

/// A map that is extended.
pub struct OlderMap {
    /// Its file.
    pub file: PathBuf,
    /// Hash of the file.
    pub hash: String,
    /// Its surface.
    pub mesh: Arc<dyn MeshView>,
    /// Its frame and path.
    pub path: Arc<MappingPath>,
}

impl OlderMap {
    /// Reads the map of the key `onto`; `None` without one.
    pub fn open(config: &BuildMapConfig, context: &Context) -> Result<Option<(Self, Map)>> {
        let Some(file) = &config.onto else {
            return Ok(None);
        };
        input::require_file("onto", file)?;
        let input = MapInputConfig {
            map_file: file.clone(),
            ..MapInputConfig::default()
        };
        let map = input.load(MapOptions::default(), context)?;
        let older = Self {
            file: file.clone(),
            hash: hash_of_file(file)?,
            mesh: surface_of(file)?,
            path: map.path.clone(),
        };
        Ok(Some((older, map)))
    }
}

/// Draws what is left of the older map, with what is gone and what was added.
pub fn draw(
    older: &OlderMap,
    kept: &dyn MeshView,
    gone: &[u32],
    added: &[&dyn MeshView],
    picture: &Path,
) -> Result<()> {
    const KEPT: [u8; 3] = [200, 200, 200];
    const GONE: [u8; 3] = [214, 39, 40];
    const ADDED: [u8; 3] = [44, 160, 44];
    let is_kept = |triangle: &u32| gone.binary_search(triangle).is_err();
    let others: Vec<u32> = (0..older.mesh.triangles() as u32).filter(is_kept).collect();
    let lost = Without::new(&*older.mesh, &others);
    let mut parts: Vec<(&dyn MeshView, _)> = vec![(kept, Some(KEPT))];
    parts.extend(added.iter().map(|mesh| (*mesh, Some(ADDED))));
    parts.push((&lost, Some(GONE)));
    let mesh = reduced(&parts, MOST_TRIANGLES);
    let path: Vec<_> = (older.path.map_from_lidar.iter())
        .map(pose2_from_pose3)
        .collect();
    MapPlot {
        title: "Changes of the map",
        mesh: &mesh,
        path: Some(("older mapping trajectory", &path)),
        keys: &[("kept", KEPT), ("gone", GONE), ("added", ADDED)],
        numbers: None,
    }
    .save(picture)?;
    tracing::info!("drew {}", picture.display());
    Ok(())
}
