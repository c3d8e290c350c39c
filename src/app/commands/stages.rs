//! Inputs of localize and refine: a map, and a recording with its poses in the frame of the map.

use std::path::Path;

use anyhow::{Context as _, Result};

use super::{Context, input};
use crate::map::{Map, MapOptions, MappingPath, mesh_file};
use crate::recording::poses::DrivePoses;
use crate::recording::{Selection, Sequence};

/// Paths of the inputs.
pub struct Inputs<'a> {
    pub map_file: &'a Path,
    /// Poses that the map was built with; for maps of range-mcl.
    pub map_pose_file: Option<&'a Path>,
    /// Calibration that the map was built with; for maps of range-mcl.
    pub map_calib_file: Option<&'a Path>,
    pub scan_folder: &'a Path,
    pub pose_file: &'a Path,
    pub calib_file: Option<&'a Path>,
    pub odometry_file: Option<&'a Path>,
}

impl Inputs<'_> {
    /// Checks that the files exist, before any work is done.
    pub fn require(&self) -> Result<()> {
        input::require_file("map_file", self.map_file)?;
        input::require_folder("scan_folder", self.scan_folder)?;
        input::require_file("pose_file", self.pose_file)?;
        input::require_optional_file("calib_file", self.calib_file)
    }

    /// The files and their keys.
    pub fn files(&self) -> Vec<(&'static str, &Path)> {
        let mut files = vec![("map_file", self.map_file), ("pose_file", self.pose_file)];
        files.extend(self.calib_file.map(|path| ("calib_file", path)));
        files.extend(self.map_pose_file.map(|path| ("map_pose_file", path)));
        files.extend(self.map_calib_file.map(|path| ("map_calib_file", path)));
        files.extend(self.odometry_file.map(|path| ("odometry_file", path)));
        files
    }

    /// Reads the map and prepares it for rendering at most `max_poses` poses at once.
    pub fn load_map(&self, max_poses: Option<usize>, context: &Context) -> Result<Map> {
        let (mesh, path) = mesh_file::read(self.map_file)?;
        let path = match self.given_path()? {
            Some(given) if path.is_none() => given,
            _ => path.unwrap_or_default(),
        };
        self.report_frame(&path);
        let options = MapOptions {
            backend: context.backend,
            max_poses,
            ..MapOptions::default()
        };
        let map = Map::new(mesh, path, &options)
            .with_context(|| format!("map_file is {}", self.map_file.display()))?;
        tracing::info!(
            "map {}: {} triangles in {} tiles, rendered by {}",
            self.map_file.display(),
            map.mesh.triangles.len(),
            map.tiles.len(),
            map.renderer.name()
        );
        Ok(map)
    }

    /// The path of the mapping drive from the files of the configuration.
    fn given_path(&self) -> Result<Option<MappingPath>> {
        let Some(poses) = self.map_pose_file else {
            return Ok(None);
        };
        input::require_file("map_pose_file", poses)?;
        input::require_optional_file("map_calib_file", self.map_calib_file)?;
        let drive = DrivePoses::read(poses, self.map_calib_file)?;
        Ok(Some(MappingPath {
            world_from_map: drive.world_from_map(),
            map_from_lidar: drive.map_from_lidar(),
        }))
    }

    /// Reports the frame of a map without a mapping drive.
    fn report_frame(&self, path: &MappingPath) {
        if !path.map_from_lidar.is_empty() {
            return;
        }
        let map = self.map_file.display();
        tracing::info!(
            "{map} has no mapping path: poses are in its own frame, and a start on the road is one anywhere; for a map of range-mcl, give map_pose_file and map_calib_file"
        );
        let origin = path.world_from_map.translation.vector;
        if origin.norm() > 0.0 {
            tracing::warn!(
                "the origin of {map} is moved by ({:.0}, {:.0}, {:.0}) m, because its coordinates are large: results are relative to it",
                origin.x,
                origin.y,
                origin.z
            );
        }
    }

    /// Opens the selected frames of the recording, with their poses in the frame of the map.
    pub fn open_recording(&self, selection: &Selection, map: &Map) -> Result<Sequence> {
        let (scans, poses, calib) = (self.scan_folder, self.pose_file, self.calib_file);
        let sequence = Sequence::open(scans, poses, calib, selection)?;
        Ok(sequence.in_map(&map.path.world_from_map))
    }
}
