//! Evaluation of a trajectory without a map: rows of TUM or KITTI, or a result without particles.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context as _, Result};
use nalgebra::Vector3;

use crate::app::report::{LocalizationResults, Report, RunSummary};
use crate::evaluation::{SpatialMetrics, aligned};
use crate::geometry::{Pose3, distances_m};
use crate::recording::PoseTrack;

/// Share of the distance above which the axes of estimate and truth are suspected to differ [%].
const OTHER_AXES_PERCENT: f64 = 20.0;

/// Reads a trajectory: its poses in the world of the file.
pub fn read(path: &Path, calib_file: Option<&Path>) -> Result<LocalizationResults> {
    let track = PoseTrack::read(path, calib_file)?;
    Ok(LocalizationResults {
        frames: (0..track.map_from_lidar.len()).collect(),
        estimates_in_space: Some(in_world(&track).into()),
        times_s: track.times_s.map(Into::into),
        ..LocalizationResults::default()
    })
}

/// The poses of a track in the world of its file; that of a camera, whose axes are those of a first pose, is turned
/// like the poses: `inv(Tr) * P * Tr`.
pub fn in_world(track: &PoseTrack) -> Vec<Pose3> {
    let camera_from_lidar = track.calibration.cam0_from_lidar;
    let is_camera = (camera_from_lidar * Vector3::x()).z > 0.7;
    let world_from_map = if is_camera {
        camera_from_lidar.inverse() * track.world_from_map
    } else {
        track.world_from_map
    };
    aligned(&world_from_map, &track.map_from_lidar)
}

/// Errors of a trajectory with its true poses.
pub fn evaluate(results: &LocalizationResults, about: BTreeMap<String, String>) -> Result<Report> {
    let estimates = results.estimates_in_space.as_deref().unwrap_or_default();
    let truth = results.ground_truth_in_space.as_deref().unwrap_or_default();
    let metrics = SpatialMetrics::new(estimates, truth, 0)
        .context("there are no poses with true poses to evaluate")?;
    let error = metrics.short_segments.map(|it| it.translation_percent);
    if let Some(percent) = error.filter(|&percent| percent > OTHER_AXES_PERCENT) {
        tracing::warn!(
            "the relative error is {percent:.0} % of the distance; check that both files are of one drive and have the same axes: poses of a camera need calib_file (the truth) or result_calib_file"
        );
    }
    Ok(Report {
        about,
        localized: None,
        live: None,
        refinement: None,
        summary: RunSummary {
            frames: results.len(),
            path_m: distances_m(estimates).last().copied().unwrap_or_default(),
            ..RunSummary::default()
        },
        has_true_poses: true,
        mcl: None,
        refined: None,
        trajectory: Some(metrics),
    })
}
