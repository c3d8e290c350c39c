//! Figures of a benchmark.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::published::Published;
use crate::app::report::Report;
use crate::app::report::results::length;
use crate::file_path::FilePath;

/// The file to send back: all figures, what they were measured with, and on what.
#[derive(Debug, Serialize, JsonSchema)]
pub struct BenchmarkReport {
    /// Layout of the recordings.
    pub layout: String,
    /// The sequence.
    pub recording: FilePath,
    /// The session that was localized; `null`: every other scan of the sequence.
    pub second: Option<FilePath>,
    /// Name, version and hash of the program.
    pub program: String,
    /// The machine: processor, threads, memory, system and renderer.
    pub machine: BTreeMap<String, String>,
    /// Wall time of each stage [s].
    pub stage_seconds: BTreeMap<String, f64>,
    /// The odometry.
    pub odometry: OdometryFigures,
    /// The map.
    pub map: MapFigures,
    /// The localization.
    pub localization: Report,
    /// Its errors after a rigid alignment of the path with the true poses, for truths of the two sessions that are not in one
    /// frame; `null` without a second session, without its true poses, and where these determine no alignment.
    pub localization_aligned: Option<Report>,
    /// Figures that others have published, for orientation.
    pub published: Vec<Published>,
}

/// Figures of the odometry.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct OdometryFigures {
    /// Number of scans.
    pub scans: usize,
    /// Scans whose pose was predicted, because they did not fit.
    pub predicted: usize,
    /// Length of the path [m].
    pub path_m: f64,
    /// Median and 95 % quantile of the time per scan [s].
    pub seconds_per_scan: Option<[f64; 2]>,
    /// Errors of the odometry, scan by scan, without loops and adjustment; `null` without a truth.
    pub scan_by_scan: Option<Box<Report>>,
    /// Errors after loops were closed and all poses adjusted.
    pub adjusted: Option<Box<Report>>,
}

/// Figures of the map.
#[derive(Clone, Debug, Serialize, Deserialize, JsonSchema)]
pub struct MapFigures {
    /// Key scans that the map was built from.
    pub mapped_frames: usize,
    /// Length of their path [m].
    pub path_m: f64,
    /// Number of triangles.
    pub triangles: usize,
    /// Size of the file [MB].
    pub map_mb: f64,
    /// Wall time of the build [s].
    pub seconds: f64,
}

impl BenchmarkReport {
    /// Names and values, most important first.
    pub fn rows(&self) -> Vec<(&'static str, String)> {
        let mut rows = Vec::new();
        let of_odometry = [
            ("odometry", &self.odometry.scan_by_scan),
            ("odometry, adjusted", &self.odometry.adjusted),
        ];
        for (name, report) in of_odometry {
            let metrics = report
                .as_ref()
                .and_then(|report| report.trajectory.as_ref());
            let segments = metrics.and_then(|it| it.kitti_segments);
            rows.extend(segments.map(|it| {
                let (percent, turn) = (it.translation_percent, it.rotation_deg_per_100_m());
                (name, format!("{percent:.2} %, {turn:.2} deg/100 m"))
            }));
        }
        let aligned = self.localization_aligned.as_ref();
        for (name, report) in [
            ("localization", self.localization.mcl.as_ref()),
            ("refined", self.localization.refined.as_ref()),
            (
                "localization, aligned",
                aligned.and_then(|it| it.mcl.as_ref()),
            ),
            (
                "refined, aligned",
                aligned.and_then(|it| it.refined.as_ref()),
            ),
        ] {
            rows.extend(report.map(|report| {
                let position = length(report.metrics.position_m.rmse);
                let heading_deg = report.metrics.heading_rad.rmse.to_degrees();
                (name, format!("{position}, {heading_deg:.3} deg"))
            }));
        }
        if self.localization.mcl.is_none() {
            rows.push(("localization", self.localization.verdict()));
        }
        rows.extend([
            ("map", format!("{:.1} MB", self.map.map_mb)),
            ("path", format!("{:.0} m", self.map.path_m)),
        ]);
        rows
    }
}
