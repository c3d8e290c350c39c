//! What a build tells of itself.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::map::local_map::LocalMapCounts;
use crate::map::quality::MapQuality;
use crate::map::truth::TruthAgreement;

/// What a build did, as it stands in the report.
#[derive(Debug, Serialize)]
pub struct BuildReport {
    /// Frames that were looked at.
    pub frames: usize,
    /// Frames in which the car had moved, and which are not held back.
    pub mapped_frames: usize,
    /// Frames held back for judging the map.
    pub held_out_frames: usize,
    /// Path of the mapped frames [m].
    pub path_m: f64,
    /// Triangles of the map.
    pub triangles: usize,
    /// Size of the map's file [MB].
    pub map_mb: f64,
    /// Triangles per 100 m of path.
    pub triangles_per_100m: f64,
    /// Megabytes per 100 m of path.
    pub mb_per_100m: f64,
    /// Wall time of the whole build [s].
    pub seconds: f64,
    /// Wall time per stage, summed over the local maps made in this run [s].
    pub stage_seconds: BTreeMap<String, f64>,
    /// The map along the beams of the frames held back.
    pub quality: Option<MapQuality>,
    /// The map against the true surface, where that is known.
    pub truth: Option<TruthAgreement>,
    /// What happened to points and triangles, per local map.
    pub local_maps: Vec<LocalMapCounts>,
}

impl BuildReport {
    /// The table on standard output.
    pub fn table(&self) -> String {
        let mut rows = vec![
            (
                "scans",
                format!("{} of {}", self.mapped_frames, self.frames),
            ),
            ("path", format!("{:.1} m", self.path_m)),
            ("time", format!("{:.1} s", self.seconds)),
            (
                "rate",
                format!("{:.1} scans/s", self.mapped_frames as f64 / self.seconds),
            ),
            ("triangles", self.triangles.to_string()),
            ("size", format!("{:.1} MB", self.map_mb)),
            (
                "per 100 m",
                format!(
                    "{:.0} k, {:.1} MB",
                    self.triangles_per_100m / 1e3,
                    self.mb_per_100m
                ),
            ),
        ];
        let percent = |share: f64| format!("{:.1} %", 100.0 * share);
        let centimetres = |metres: f64| format!("{:.1} cm", 100.0 * metres);
        if let Some(quality) = &self.quality {
            rows.extend([
                ("beams judged", quality.beams.to_string()),
                ("early", percent(quality.early)),
                ("late", percent(quality.late)),
                ("miss", percent(quality.miss)),
                (
                    "beam-plane median",
                    centimetres(quality.beam_plane_median_m),
                ),
                (
                    "beam-plane within 10 cm",
                    percent(quality.beam_plane_within_10cm),
                ),
                ("points within 10 cm", percent(quality.point_within_10cm)),
                ("ray residual median", centimetres(quality.ray_median_m)),
            ]);
        }
        if let Some(truth) = &self.truth {
            rows.extend([
                ("accuracy at 10 cm", percent(truth.accuracy)),
                ("completeness at 10 cm", percent(truth.completeness)),
                ("F-score at 10 cm", percent(truth.f_score)),
                ("median to the truth", centimetres(truth.median_m)),
            ]);
        }
        rows.iter()
            .map(|(name, value)| format!("{name:<24} {value:>14}\n"))
            .collect()
    }
}
