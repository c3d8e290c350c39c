//! Input and output files of `build-map`.

use std::path::Path;

use anyhow::Result;

use crate::app::commands::stages::RecordingInputs;
use crate::app::report::map::BuildReport;
use crate::app::run::{Claims, Context, Outputs, PLY, input, output};
use crate::app::settings::BuildMapConfig;
use crate::file_path::text_of;
use crate::map::MappingPath;
use crate::map::files::ply;
use crate::map::mesh_view::MeshView;

/// Prepares the outputs.
pub fn prepare(config: &BuildMapConfig, context: &Context) -> Result<Claims> {
    let mut extensions = vec!["report.json", "effective.yml", "poses_tum.txt"];
    if config.output.plots {
        extensions.extend(["png", "residuals.png"]);
        extensions.extend(config.onto.is_some().then_some("changes.png"));
    }
    let name = |extension| {
        let path = config.mesh_file.with_extension(extension);
        path.file_name()
            .map(|name| text_of(Path::new(name)).into_owned())
    };
    let mut inputs = Vec::new();
    if config.cloud_file.is_none() {
        inputs.extend(RecordingInputs::new(&config.recording, &config.given_poses).files());
        inputs.extend(config.inertial.files(&config.recording));
        inputs.extend(config.gnss.file(&config.recording));
    }
    let optional = [
        ("cloud_file", &config.cloud_file),
        ("truth_mesh", &config.truth_mesh),
        ("onto", &config.onto),
    ];
    inputs.extend((optional.iter()).filter_map(|(key, path)| Some((*key, path.as_deref()?))));
    input::require(&inputs)?;
    inputs.extend(context.input());
    let outputs = Outputs {
        key: "mesh_file",
        main: &config.mesh_file,
        magic: Some(PLY),
        names: extensions.into_iter().filter_map(name).collect(),
        inputs,
        force: config.output.force,
    };
    outputs.prepare()
}

/// Writes meshes as the map.
pub fn write_map(
    config: &BuildMapConfig,
    meshes: &[&dyn MeshView],
    path: &MappingPath,
    claims: &mut Claims,
) -> Result<()> {
    anyhow::ensure!(
        meshes.iter().any(|mesh| mesh.triangles() > 0),
        "the map has no triangles: {} has no points left to mesh; check range_image, crop_x, crop_y and crop_z",
        config
            .cloud_file
            .as_ref()
            .unwrap_or(&config.recording.scan_folder)
            .display()
    );
    claims.begin(&config.mesh_file)?;
    Ok(ply::write_joined(&config.mesh_file, meshes, Some(path))?)
}

/// Writes the report and the effective configuration of a map, which is finished then.
pub fn finish(config: &BuildMapConfig, report: &BuildReport, claims: &mut Claims) -> Result<()> {
    output::write_json(&config.mesh_file.with_extension("report.json"), report)?;
    output::write_yaml(&config.mesh_file.with_extension("effective.yml"), config)?;
    claims.finish(&config.mesh_file)
}
