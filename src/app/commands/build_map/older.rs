//! The older map to which a build adds a newer drive.

use std::sync::Arc;

use anyhow::Result;

use crate::app::run::Context;
use crate::app::run::artefact::hash::hash_of_file;
use crate::app::settings::{BuildMapConfig, MapInputConfig};
use crate::file_path::FilePath;
use crate::map::mesh_view::MeshView;
use crate::map::{Map, MapOptions, MappingPath, surface_of};

/// A map that is extended.
pub struct OlderMap {
    /// Its file.
    pub file: FilePath,
    /// Hash of the file.
    pub hash: String,
    /// Its surface.
    pub mesh: Arc<dyn MeshView>,
    /// Its frame and path.
    pub path: Arc<MappingPath>,
}

/// Reads the map of the key `onto`; `None` without one.
pub fn open(config: &BuildMapConfig, context: &Context) -> Result<Option<(OlderMap, Map)>> {
    let Some(file) = &config.onto else {
        return Ok(None);
    };
    let input = MapInputConfig {
        map_file: file.clone(),
        ..MapInputConfig::default()
    };
    let map = input.load(MapOptions::default(), context)?;
    let older = OlderMap {
        file: file.clone(),
        hash: hash_of_file(file)?,
        mesh: surface_of(file)?,
        path: map.path.clone(),
    };
    Ok(Some((older, map)))
}
