//! Quality of a finished map, a part of it at a time.

use anyhow::Result;
use glam::DVec3;
use nalgebra::{Point2, Translation3, Vector3};

use crate::app::settings::BuildMapConfig;
use crate::evaluation::TruthAgreement;
use crate::evaluation::map_quality::{self, ResidualSums};
use crate::geometry::Pose3;
use crate::map::build::plan::origin_near;
use crate::map::files::ply;
use crate::map::{Map, MappingPath};
use crate::mapping::poses_of;
use crate::recording::Frame;
use crate::sensor::Sensor;

/// Residuals of the map along the beams of the held-out scans.
pub fn residuals(
    config: &BuildMapConfig,
    sensor: &Sensor,
    map: Option<&Map>,
    held_out: &[Frame],
) -> Result<ResidualSums> {
    /// Scans that are compared with the same part of the map.
    const SCANS: usize = 8;
    let crop_m = config.map.local_map.crop_m();
    let mut sums = ResidualSums::default();
    let Some(map) = map else {
        return Ok(sums);
    };
    for frames in held_out.chunks(SCANS) {
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
pub fn agreement(
    config: &BuildMapConfig,
    sensor: &Sensor,
    path: &MappingPath,
) -> Result<Option<TruthAgreement>> {
    let Some(truth) = &config.truth_mesh else {
        return Ok(None);
    };
    let (mesh, surface) = (ply::read(&config.mesh_file)?, ply::read(truth)?);
    Ok(TruthAgreement::new(
        &mesh,
        &surface,
        &path.map_from_lidar,
        sensor,
        config.map.local_map.crop_m(),
    ))
}
