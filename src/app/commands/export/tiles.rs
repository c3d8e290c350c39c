//! `export --pcd`: a map as point cloud tiles for Autoware.
//!
//! The metadata file is removed first and written last: without it, the map loader loads no tiles.

use std::fs;
use std::iter;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use schemars::JsonSchema;
use serde::Serialize;

use super::arguments::ExportArgs;
use crate::app::report::export::tiles::{
    METADATA_FILE, TILES_FOLDER, Tile, is_tile, metadata, split,
};
use crate::app::run::memory;
use crate::app::run::{Claims, Context, output};
use crate::file_path::FilePath;
use crate::geometry::{TriangleMesh, Vec3, sample_surface, surface_area_m2, surface_samples};
use crate::map::MappingPath;
use crate::memory::MemoryError;

/// Written point cloud tiles.
#[derive(Debug, Serialize, JsonSchema)]
pub struct TilesReport {
    /// Folder of the tiles.
    folder: FilePath,
    /// Number of tiles.
    tiles: usize,
    /// Number of points.
    points: usize,
    /// Frame of the points, with the pose of the map in the world where it has one.
    frame: String,
}

impl TilesReport {
    /// Rows of the table on standard output.
    pub fn rows(&self) -> [(&'static str, String); 3] {
        let tiles = format!("{} in {}", self.tiles, self.folder.display());
        [
            ("tiles", tiles),
            ("points", self.points.to_string()),
            ("frame of the tiles", self.frame.clone()),
        ]
    }
}

/// Path of the metadata file, which is finished last.
pub fn metadata_file(folder: &Path) -> PathBuf {
    folder.join(METADATA_FILE)
}

/// Writes tiles and metadata of a map where they are requested.
pub fn write(
    args: &ExportArgs,
    mesh: &TriangleMesh,
    path: Option<&MappingPath>,
    context: &Context,
) -> Result<Option<TilesReport>> {
    let Some(folder) = &args.pcd else {
        return Ok(None);
    };
    let mut points = sample(mesh, args.spacing)?;
    let tiles = split(&mut points, args.tile_size);
    let frame = frame_of(path);
    let metadata_file = metadata_file(folder);
    Claims::read(folder)?.begin(&metadata_file)?;
    output::remove_if_exists(&metadata_file)?;
    let tiles_folder = folder.join(TILES_FOLDER);
    output::create_subfolder(&tiles_folder)?;
    remove_tiles(&tiles_folder)?;
    write_tiles(&tiles, &tiles_folder, context)?;
    let georeference = path.and_then(|path| path.georeference.as_ref());
    let georeference = georeference.map(serde_json::to_string).transpose()?;
    let comments: Vec<String> = iter::once(format!("frame: {frame}"))
        .chain(georeference.map(|json| format!("georeference: {json}")))
        .collect();
    let metadata = metadata(&tiles, args.tile_size, &comments);
    output::write_text(&metadata_file, &metadata)?;
    Ok(Some(TilesReport {
        tiles: tiles.len(),
        points: points.len(),
        folder: tiles_folder.into(),
        frame,
    }))
}

/// Samples the map within the budget of memory.
fn sample(mesh: &TriangleMesh, spacing_m: f64) -> Result<Vec<Vec3>> {
    let area_m2 = surface_area_m2(mesh);
    require_memory(mesh, area_m2 / (spacing_m * spacing_m))?;
    let points = sample_surface(mesh, spacing_m);
    ensure!(
        !points.is_empty(),
        "the map has an area of {area_m2:.2} m², too little for a point per square of {spacing_m} m; give a smaller --spacing"
    );
    Ok(points)
}

/// Requires the memory of the points, which are sorted, and of the order of the triangles.
fn require_memory(mesh: &TriangleMesh, points: f64) -> Result<(), MemoryError> {
    const POINT_BYTES: usize = 2 * size_of::<Vec3>();
    let triangles = mesh.triangles.len() * surface_samples::TRIANGLE_BYTES;
    memory::budget().require(
        "the points of the tiles",
        POINT_BYTES as f64 * points + triangles as f64,
        "give a larger --spacing",
    )
}

/// Words for the frame of the points, with the pose of the map in the world where it has one.
fn frame_of(path: Option<&MappingPath>) -> String {
    let comment = path.and_then(|path| path.to_comments().into_iter().next());
    let world_from_map = comment.as_deref().map(|it| it.trim_start_matches("fpmcl "));
    world_from_map.map_or_else(|| "map".to_owned(), |pose| format!("map; {pose}"))
}

/// Removes the tiles of an earlier export.
fn remove_tiles(folder: &Path) -> Result<()> {
    let entries = fs::read_dir(folder).and_then(Iterator::collect::<Result<Vec<_>, _>>);
    let entries = entries.with_context(|| format!("cannot read {}", folder.display()))?;
    (entries.iter())
        .filter(|entry| is_tile(&entry.file_name().to_string_lossy()))
        .try_for_each(|entry| output::remove_if_exists(&entry.path()))
}

fn write_tiles(tiles: &[Tile], folder: &Path, context: &Context) -> Result<()> {
    let task = context.progress.task("export", tiles.len());
    for (written, tile) in tiles.iter().enumerate() {
        context.interrupt.keeps(format!(
            "{written} of {} tiles are in {}; run again for all of them",
            tiles.len(),
            folder.display()
        ));
        context.interrupt.check()?;
        output::write_file(&folder.join(tile.file_name()), |file| tile.write(file))?;
        task.advance(1);
    }
    Ok(())
}
