//! The map that local maps make together, with what is left of an older one.

use super::older::OlderMap;
use super::opened::Opened;
use super::parts::Joined;
use crate::app::report::map::ChangesReport;
use crate::geometry::Pose3;
use crate::map::MappingPath;
use crate::map::mesh_view::{MeshView, Without};
use crate::mapping::poses_of;

/// The map that local maps make together.
pub struct JoinedMap<'a> {
    /// The older map, and what is left of it.
    pub older: Option<(&'a OlderMap, Without<'a>)>,
    /// Triangles of the older map that are gone, ascending.
    pub gone: &'a [u32],
    /// The meshes of the local maps.
    pub added: Vec<&'a dyn MeshView>,
    /// The path of the scans, after that of the older map.
    pub path: MappingPath,
}

impl<'a> JoinedMap<'a> {
    /// The map of the finished local maps of a recording.
    pub fn new(opened: &'a Opened, joined: &'a Joined) -> Self {
        let older = opened.older.as_ref();
        let poses = poses_of(&opened.mapped);
        let new = || MappingPath {
            world_from_map: opened.sequence.world().0,
            map_from_lidar: poses.clone(),
            sensor: Some(opened.sensor.clone()),
            georeference: None,
        };
        let mut path = older.map_or_else(new, |older| older.path.extended_by(&poses));
        if let Some(found) = &opened.georeferenced {
            path.georeference = Some(found.georeference.clone());
        }
        Self {
            older: older.map(|it| (it, Without::new(&*it.mesh, &joined.gone))),
            gone: &joined.gone,
            added: joined.meshes.iter().map(|mesh| mesh as _).collect(),
            path,
        }
    }

    /// The poses of the scans, and those of the older map, where there is one.
    pub fn drives(&self) -> (&[Pose3], Option<&[Pose3]>) {
        let older = self.older.as_ref().map(|(it, _)| &it.path.map_from_lidar);
        let (before, scans) = (self.path.map_from_lidar).split_at(older.map_or(0, Vec::len));
        (scans, older.map(|_| before))
    }

    /// All meshes of the map.
    pub fn meshes(&self) -> Vec<&dyn MeshView> {
        let kept = self.older.iter().map(|(_, kept)| kept as &dyn MeshView);
        kept.chain(self.added.iter().map(|mesh| *mesh as _))
            .collect()
    }

    /// What has changed in the older map, where there is one.
    pub fn changes(&self) -> Option<ChangesReport> {
        let (older, _) = self.older.as_ref()?;
        let (file, mesh) = (&older.file, &*older.mesh);
        Some(ChangesReport::new(file, mesh, self.gone, &self.added))
    }
}
