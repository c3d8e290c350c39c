//! What `build-map` leaves behind next to a map: its report and pictures.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Instant;

use anyhow::Result;
use schemars::JsonSchema;
use serde::Serialize;

use super::georeference::GeoreferenceReport;
use super::odometry;
use super::plotting::{MapPlot, SURFACES, VertexNumbers, muted};
use super::run_output::MOST_TRIANGLES;
use crate::app::run::Printed;
use crate::evaluation::map_quality::ResidualSums;
use crate::evaluation::{MapQuality, TruthAgreement};
use crate::file_path::FilePath;
use crate::geometry::{Pose2, Pose3, distances_m, pose2_from_pose3};
use crate::map::LocalMapCounts;
use crate::map::mesh_view::{MeshView, Without, reduced};
use crate::mapping::TrajectorySummary;
use crate::sensor::Sensor;

/// Report of a map build.
#[derive(Debug, Default, Serialize, JsonSchema)]
pub struct BuildReport {
    /// Selected frames.
    pub frames: usize,
    /// Key scans that the map was built from.
    pub mapped_frames: usize,
    /// Key scans held out to evaluate the map.
    pub held_out_frames: usize,
    /// The sensor.
    pub sensor: Option<Sensor>,
    /// What poses that were found in this run show about themselves.
    pub trajectory: Option<TrajectorySummary>,
    /// The place of the map on the Earth, where fixes of a receiver were given.
    pub georeference: Option<GeoreferenceReport>,
    /// What changed in the older map, where there is one.
    pub changes: Option<ChangesReport>,
    /// Length of the path of the mapped scans of this drive [m].
    pub path_m: f64,
    /// Length of the path in the older map, where there is one [m].
    pub older_path_m: Option<f64>,
    /// Triangles of the map.
    pub triangles: usize,
    /// Size of the map's file [MB].
    pub map_mb: f64,
    /// Triangles per 100 m of path, that of the older map included.
    pub triangles_per_100m: f64,
    /// Megabytes per 100 m of path, that of the older map included.
    pub mb_per_100m: f64,
    /// Edge of the finest octree cells, the largest of the local maps [m].
    pub octree_cell_m: f32,
    /// Wall time of the whole build [s].
    pub seconds: f64,
    /// Wall time per stage, summed over the local maps made in this run [s].
    pub stage_seconds: BTreeMap<String, f64>,
    /// Quality along the beams of the held-out scans.
    pub quality: Option<MapQuality>,
    /// Agreement with the true surface, where it is known.
    pub truth: Option<TruthAgreement>,
    /// Numbers of points and triangles per local map.
    pub local_maps: Vec<LocalMapCounts>,
}

impl BuildReport {
    /// The report of a written map: its size, per length of the paths of this drive and of an older map, and the time since
    /// the build started.
    pub fn new(
        meshes: &[&dyn MeshView],
        local_maps: Vec<LocalMapCounts>,
        (path, older_path): (&[Pose3], Option<&[Pose3]>),
        mesh_file: &Path,
        started: Instant,
    ) -> Self {
        let length_m = |path: &[Pose3]| distances_m(path).last().copied().unwrap_or_default();
        let (path_m, older_path_m) = (length_m(path), older_path.map(length_m));
        let all_m = path_m + older_path_m.unwrap_or_default();
        let map_mb = std::fs::metadata(mesh_file).map_or(0.0, |file| file.len() as f64 / 1e6);
        let per_100m = |amount: f64| 100.0 * amount / f64::max(all_m, 1.0);
        let triangles = meshes.iter().map(|mesh| mesh.triangles()).sum();
        Self {
            path_m,
            older_path_m,
            triangles,
            octree_cell_m: (local_maps.iter()).fold(0.0, |largest, it| it.cell_m.max(largest)),
            local_maps,
            map_mb,
            triangles_per_100m: per_100m(triangles as f64),
            mb_per_100m: per_100m(map_mb),
            seconds: started.elapsed().as_secs_f64(),
            ..Self::default()
        }
    }

    /// The table on standard output, most important rows first.
    pub fn printed(&self) -> Result<Printed> {
        Printed::rows(&self.rows(), self)
    }

    fn rows(&self) -> Vec<(&'static str, String)> {
        let mut rows = vec![
            ("time", format!("{:.1} s", self.seconds)),
            ("triangles", self.triangles.to_string()),
            ("size", format!("{:.1} MB", self.map_mb)),
        ];
        if self.mapped_frames > 0 {
            let scans = format!("{} of {}", self.mapped_frames, self.frames);
            let rate = self.mapped_frames as f64 / self.seconds;
            rows.splice(
                0..0,
                [("scans", scans), ("path", format!("{:.1} m", self.path_m))],
            );
            rows.insert(3, ("rate", format!("{rate:.1} scans/s")));
            let older = self.older_path_m.map(|path_m| format!("{path_m:.1} m"));
            rows.splice(2..2, older.map(|older| ("older path", older)));
        }
        rows.extend(self.changes.iter().flat_map(ChangesReport::rows));
        rows.extend(self.georeference.iter().flat_map(GeoreferenceReport::rows));
        rows.extend(self.quality_rows());
        if let Some(summary) = &self.trajectory {
            let found = odometry::rows(summary).into_iter();
            rows.extend(found.filter(|(name, _)| !matches!(*name, "scans" | "path")));
        }
        let [thousands, megabytes] = [self.triangles_per_100m / 1e3, self.mb_per_100m];
        if self.mapped_frames > 0 {
            rows.push(("per 100 m", format!("{thousands:.0} k, {megabytes:.1} MB")));
        }
        rows.push(("octree cell", format!("{:.2} m", self.octree_cell_m)));
        rows
    }

    /// Quality along held-out beams, and agreement with the true surface, where they are known.
    fn quality_rows(&self) -> Vec<(&'static str, String)> {
        let mut rows = Vec::new();
        let percent = |share: f64| format!("{:.1} %", 100.0 * share);
        let centimetres = |metres: f64| format!("{:.1} cm", 100.0 * metres);
        if let Some(quality) = &self.quality {
            rows.extend([
                ("points within 10 cm", percent(quality.point_within_10cm)),
                (
                    "beam-plane within 10 cm",
                    percent(quality.beam_plane_within_10cm),
                ),
                (
                    "beam-plane median",
                    centimetres(quality.beam_plane_median_m),
                ),
                ("early", percent(quality.early)),
                ("miss", percent(quality.miss)),
                ("late", percent(quality.late)),
                ("ray residual median", centimetres(quality.ray_median_m)),
                ("beams evaluated", quality.beams.to_string()),
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
        rows
    }
}

/// What a drive changed in an older map.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct ChangesReport {
    /// The older map.
    pub onto: FilePath,
    /// Triangles of the older map that are gone.
    pub gone_triangles: usize,
    /// Their area [m²].
    pub gone_m2: f64,
    /// Triangles that were added.
    pub added_triangles: usize,
    /// Their area [m²].
    pub added_m2: f64,
}

impl ChangesReport {
    /// The triangles that are gone from a map, and meshes that were added.
    pub fn new(onto: &Path, older: &dyn MeshView, gone: &[u32], added: &[&dyn MeshView]) -> Self {
        let of_mesh = |mesh: &dyn MeshView| -> f64 {
            let triangles = 0..mesh.triangles();
            triangles.map(|triangle| mesh.area_m2(triangle)).sum()
        };
        let gone_m2: f64 = gone.iter().map(|&it| older.area_m2(it as usize)).sum();
        let added_m2: f64 = added.iter().map(|mesh| of_mesh(*mesh)).sum();
        // An empty sum is -0.
        Self {
            onto: onto.into(),
            gone_triangles: gone.len(),
            gone_m2: 0.0 + gone_m2,
            added_triangles: added.iter().map(|mesh| mesh.triangles()).sum(),
            added_m2: 0.0 + added_m2,
        }
    }

    /// Rows of the table on standard output.
    pub fn rows(&self) -> Vec<(&'static str, String)> {
        let area = |m2: f64, triangles: usize| format!("{m2:.0} m², {triangles} triangles");
        vec![
            ("gone", area(self.gone_m2, self.gone_triangles)),
            ("added", area(self.added_m2, self.added_triangles)),
        ]
    }
}

/// Draws the map of some meshes with the path of the mapping drive, and its residuals where scans were held out.
pub fn draw_map(
    mesh_file: &Path,
    meshes: &[&dyn MeshView],
    path: &[Pose3],
    residuals: &ResidualSums,
) -> Result<()> {
    /// Residual at the end of the colour bar [m].
    const LIMIT_M: f64 = 0.2;
    let in_own_colors: Vec<_> = meshes.iter().map(|mesh| (*mesh, None)).collect();
    let mesh = &reduced(&in_own_colors, MOST_TRIANGLES);
    let driven: Vec<Pose2> = path.iter().map(pose2_from_pose3).collect();
    let map = MapPlot {
        title: "Map from above",
        mesh: &muted(mesh),
        path: Some(("mapping trajectory", &driven)),
        keys: &SURFACES,
        numbers: None,
    };
    save(&map, &mesh_file.with_extension("png"))?;
    if residuals.quality().is_none() {
        return Ok(());
    }
    let map = MapPlot {
        title: "Distance of held-out beams to the surface that they hit",
        mesh,
        keys: &[],
        numbers: Some(VertexNumbers {
            values: &residuals.at_vertices(mesh),
            name: "mean beam-plane distance [m]",
            limit: LIMIT_M,
        }),
        ..map
    };
    save(&map, &mesh_file.with_extension("residuals.png"))
}

/// Draws what is left of an older map, with what is gone and what was added, and the path of its drive.
pub fn draw_changes(
    mesh_file: &Path,
    (older, kept): (&dyn MeshView, &dyn MeshView),
    gone: &[u32],
    added: &[&dyn MeshView],
    path: &[Pose3],
) -> Result<()> {
    const KEPT: [u8; 3] = [200, 200, 200];
    const GONE: [u8; 3] = [214, 39, 40];
    const ADDED: [u8; 3] = [44, 160, 44];
    let is_kept = |triangle: &u32| gone.binary_search(triangle).is_err();
    let others: Vec<u32> = (0..older.triangles() as u32).filter(is_kept).collect();
    let lost = Without::new(older, &others);
    let mut parts: Vec<(&dyn MeshView, _)> = vec![(kept, Some(KEPT))];
    parts.extend(added.iter().map(|mesh| (*mesh, Some(ADDED))));
    parts.push((&lost, Some(GONE)));
    let path: Vec<Pose2> = path.iter().map(pose2_from_pose3).collect();
    let changes = MapPlot {
        title: "Changes of the map",
        mesh: &reduced(&parts, MOST_TRIANGLES),
        path: Some(("older mapping trajectory", &path)),
        keys: &[("kept", KEPT), ("gone", GONE), ("added", ADDED)],
        numbers: None,
    };
    save(&changes, &mesh_file.with_extension("changes.png"))
}

fn save(plot: &MapPlot, picture: &Path) -> Result<()> {
    plot.save(picture)?;
    tracing::info!("drew {}", picture.display());
    Ok(())
}
