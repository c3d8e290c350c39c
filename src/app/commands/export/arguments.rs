//! Arguments of `export`.

use std::path::Path;

use clap::Args;

use crate::app::report::export::MOST_POINTS;
use crate::app::run::{MachineArgs, gibibytes};
use crate::file_path::FilePath;

/// Arguments of `export`.
#[derive(Clone, Debug, Args)]
#[command(group = clap::ArgGroup::new("format").required(true).multiple(true))]
pub struct ExportArgs {
    /// Result of `localize` or `refine` (.npz), or a map (.ply, .obj, .stl).
    pub input: FilePath,

    /// Log to write: poses with covariances, states, particles, scans in the map frame, the map (.mcap).
    #[arg(long, value_name = "FILE", group = "format")]
    pub mcap: Option<FilePath>,

    /// Model to write: the map, and the path of a result colored by its error (.glb).
    #[arg(long, value_name = "FILE", group = "format")]
    pub glb: Option<FilePath>,

    /// Folder to write the map to as point cloud tiles, for Autoware: `pointcloud_map.pcd/` and
    /// `pointcloud_map_metadata.yaml`.
    #[arg(long, value_name = "FOLDER", group = "format")]
    pub pcd: Option<FilePath>,

    /// Path on the Earth to write, that of a result or of the mapping drive, where the place of the map is known (.geojson).
    #[arg(long, value_name = "FILE", group = "format")]
    pub geojson: Option<FilePath>,

    /// Spacing of the points of tiles: one point per square of the surface [m].
    #[arg(long, value_name = "M", requires = "pcd", value_parser = spacing, default_value_t = Self::SPACING_M)]
    pub spacing: f64,

    /// Side of tiles [m].
    #[arg(long, value_name = "M", requires = "pcd", value_parser = clap::value_parser!(u16).range(1..=1000), default_value_t = Self::TILE_SIZE_M)]
    pub tile_size: u16,

    /// Recording of the result; by default that of its localization.
    #[arg(long, value_name = "RECORDING")]
    pub recording: Option<FilePath>,

    /// Map of the result; by default that of its localization.
    #[arg(long, value_name = "MAP")]
    pub map: Option<FilePath>,

    /// Largest number of points per scan in a log; 0 for a log without scans.
    #[arg(long, value_name = "N", default_value_t = MOST_POINTS)]
    pub points: usize,

    /// Largest memory that a stage may plan for; by default half of the machine's.
    #[arg(long, value_name = "GIB", value_parser = gibibytes)]
    pub memory: Option<f64>,

    /// Replace existing files.
    #[arg(long)]
    pub force: bool,
}

impl ExportArgs {
    /// Default of `spacing` [m].
    const SPACING_M: f64 = 0.2;
    /// Default of `tile_size` [m]: that of Autoware.
    const TILE_SIZE_M: u16 = 20;

    /// The memory that may be planned for.
    pub fn machine(&self) -> MachineArgs {
        MachineArgs {
            memory: self.memory,
            ..MachineArgs::default()
        }
    }

    /// A log of a result in a map.
    pub fn log_of(result: &Path, map: &Path, log: &Path, force: bool) -> Self {
        Self {
            input: result.into(),
            mcap: Some(log.into()),
            glb: None,
            pcd: None,
            geojson: None,
            spacing: Self::SPACING_M,
            tile_size: Self::TILE_SIZE_M,
            recording: None,
            map: Some(map.into()),
            points: MOST_POINTS,
            memory: None,
            force,
        }
    }
}

/// Parses a spacing of points [m].
fn spacing(text: &str) -> Result<f64, &'static str> {
    match text.parse::<f64>() {
        Ok(number) if (0.001..=100.0).contains(&number) => Ok(number),
        _ => Err("give a number from 0.001 to 100, such as 0.2"),
    }
}
