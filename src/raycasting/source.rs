//! Where the scene of a map comes from: memory, or files of tiles.

use std::fmt::Debug;
use std::path::PathBuf;
use std::sync::Arc;

use glam::DVec3;

use super::Scene;
use crate::geometry::Aabb;

/// Supplies the scene of a map.
pub trait SceneSource: Debug + Send + Sync {
    /// The scene for rays from some origins [m]. What they hit does not depend on the source: tiles that are not in
    /// memory are read when a ray enters them, and may be dropped when rays start elsewhere.
    fn scene(&self, origins: &[DVec3]) -> Scene;

    /// Fails if a tile could not be read since the last check, so that rays went through it.
    fn check(&self) -> Result<(), Arc<TileError>>;
}

impl SceneSource for Scene {
    fn scene(&self, _: &[DVec3]) -> Scene {
        self.clone()
    }

    fn check(&self) -> Result<(), Arc<TileError>> {
        Ok(())
    }
}

/// Supplies the triangles of the tiles of a map, for what casts rays by itself.
pub trait TriangleSource: Debug + Send + Sync {
    /// Box around the triangles of each tile in the frame of the map [m], empty where it has none, and their number.
    fn tiles(&self) -> Vec<(Aabb, u64)>;

    /// Corners of the triangles of a tile in the frame of the map [m].
    ///
    /// # Errors
    /// [`TileError`] if the tile cannot be read.
    fn triangles(&self, tile: usize) -> Result<Vec<[DVec3; 3]>, Arc<TileError>>;
}

/// A tile of a map cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("the tile {}: {problem}; delete its folder: it is made again from the map", file.display())]
pub struct TileError {
    /// File of the tile.
    pub file: PathBuf,
    /// What is wrong with it.
    pub problem: TileProblem,
}

/// What is wrong with a tile.
#[derive(Debug, thiserror::Error)]
pub enum TileProblem {
    #[error("{0}")]
    Read(#[from] std::io::Error),
    #[error("it is not a tile of this version of fpmcl, or it is incomplete")]
    Format,
    #[error("its checksum is wrong")]
    Checksum,
}
