//! Quality of a finished map, a part of it at a time, and its preparation for localization.

use anyhow::Result;
use glam::DVec3;
use nalgebra::{Point2, Translation3, Vector3};

use super::opened::Opened;
use crate::app::run::memory;
use crate::evaluation::TruthAgreement;
use crate::evaluation::map_quality::{self, ResidualSums};
use crate::geometry::Pose3;
use crate::localization::{Localizer, LocalizerConfig, Odometry, Start};
use crate::map::build::plan::origin_near;
use crate::map::files::ply;
use crate::map::{Map, MapCache, MapError, MapOptions, MappingPath};
use crate::mapping::poses_of;
use crate::rendering::Backend;

/// Opens the map that was written, which makes its tiles, and localizes one of its scans, which makes its panoramas.
/// `None` if no car can be localized in it, after a warning.
pub fn prepared_map(opened: &Opened) -> Result<Option<Map>> {
    let options = MapOptions {
        backend: Backend::Cpu,
        cache: MapCache::NextToMap,
        memory_budget: memory::budget(),
        ..MapOptions::default()
    };
    let config = &opened.config;
    let map = match Map::load(&config.mesh_file, &options) {
        Ok(map) => map,
        Err(error @ (MapError::NoGround { .. } | MapError::NoArea { .. })) => {
            tracing::warn!("no car can be localized in this map: {error}");
            return Ok(None);
        }
        Err(error) => return Err(error.into()),
    };
    if let Some(frame) = opened.mapped.first() {
        let scan = frame.read()?;
        let localizer = LocalizerConfig {
            ground: config.map.ground.clone(),
            ..LocalizerConfig::default()
        };
        let (start, seed) = (Start::unknown(&map), config.map.seed);
        let found = Localizer::new(&map, &opened.sensor, localizer, start, seed)
            .and_then(|mut localizer| localizer.step(&scan, Odometry::Unknown));
        if let Err(error) = found {
            tracing::warn!("a start anywhere in this map was not prepared: {error}");
        }
    }
    Ok(Some(map))
}

/// Residuals of the map along the beams of the held-out scans.
pub fn residuals(opened: &Opened, map: Option<&Map>) -> Result<ResidualSums> {
    /// Scans that are compared with the same part of the map.
    const SCANS: usize = 8;
    let sensor = &opened.sensor;
    let crop_m = (opened.config.map.local_map).crop_m(&sensor.range_image);
    let mut sums = ResidualSums::default();
    let Some(map) = map else {
        return Ok(sums);
    };
    for frames in opened.held_out.chunks(SCANS) {
        let poses: Vec<Pose3> = poses_of(frames);
        let positions = poses.iter().map(|pose| pose.translation.vector.xy().into());
        let positions: Vec<Point2<f64>> = positions.collect();
        let first = poses.first().map(|pose| pose.translation.vector);
        let origin = origin_near(first.map_or(DVec3::ZERO, |it| DVec3::new(it.x, it.y, it.z)));
        let reach_m = f64::from(sensor.range_image.max_range);
        let mesh = map.mesh_near(&positions, reach_m, origin, u64::MAX)?;
        let offset = Translation3::from(-Vector3::from(origin.to_array()));
        let read =
            |index: usize| -> Result<_> { Ok((frames[index].read()?, offset * poses[index])) };
        let residuals = map_quality::residuals(&mesh, frames.len(), read, sensor, crop_m)?;
        sums.add(&residuals, origin);
    }
    Ok(sums)
}

/// Agreement of the map with the true surface, where it is given.
pub fn agreement(opened: &Opened, path: &MappingPath) -> Result<Option<TruthAgreement>> {
    let (config, sensor) = (&opened.config, &opened.sensor);
    let Some(truth) = &config.truth_mesh else {
        return Ok(None);
    };
    let (mesh, surface) = (ply::read(&config.mesh_file)?, ply::read(truth)?);
    let crop_m = config.map.local_map.crop_m(&sensor.range_image);
    let path = &path.map_from_lidar;
    Ok(TruthAgreement::new(&mesh, &surface, path, sensor, crop_m))
}
