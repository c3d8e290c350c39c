//! Pictures of a map.

use anyhow::Result;

use crate::app::report::plotting::{MapPlot, SURFACES, VertexNumbers, muted};
use crate::app::report::run_output::MOST_TRIANGLES;
use crate::app::settings::BuildMapConfig;
use crate::evaluation::map_quality::ResidualSums;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::map::mesh_view::{MeshView, reduced};

/// Residual at the end of the colour bar [m].
const PICTURE_LIMIT_M: f64 = 0.2;

/// Draws the map of some meshes with the path of the mapping drive, and its residuals where scans were held out.
pub fn draw(
    config: &BuildMapConfig,
    meshes: &[&dyn MeshView],
    path: &[Pose3],
    residuals: &ResidualSums,
) -> Result<()> {
    let in_own_colors: Vec<_> = meshes.iter().map(|mesh| (*mesh, None)).collect();
    let mesh = &reduced(&in_own_colors, MOST_TRIANGLES);
    let driven: Vec<Pose2> = path.iter().map(pose2_from_pose3).collect();
    let picture = config.mesh_file.with_extension("png");
    MapPlot {
        title: "Map from above",
        mesh: &muted(mesh),
        path: Some(("mapping trajectory", &driven)),
        keys: &SURFACES,
        numbers: None,
    }
    .save(&picture)?;
    tracing::info!("drew {}", picture.display());
    if residuals.quality().is_none() {
        return Ok(());
    }
    let picture = config.mesh_file.with_extension("residuals.png");
    MapPlot {
        title: "Distance of held-out beams to the surface that they hit",
        mesh,
        path: Some(("mapping trajectory", &driven)),
        keys: &[],
        numbers: Some(VertexNumbers {
            values: &residuals.at_vertices(mesh),
            name: "mean beam-plane distance [m]",
            limit: PICTURE_LIMIT_M,
        }),
    }
    .save(&picture)?;
    tracing::info!("drew {}", picture.display());
    Ok(())
}
