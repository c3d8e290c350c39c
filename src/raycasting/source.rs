//! Where the scene of a map comes from: memory, or files of tiles.

use std::fmt::Debug;

use glam::DVec3;

use super::error::TileError;
use super::{Scene, Tile};
use crate::geometry::Aabb;

/// Supplies the scene of a map, and the triangles of its tiles for what casts rays by itself.
pub trait SceneSource: Debug + Send + Sync {
    /// The scene for rays from some origins [m]. What they hit does not depend on the source: tiles that are not in
    /// memory are read when a ray enters them, and may be dropped when rays start elsewhere.
    fn scene(&self, origins: &[DVec3]) -> Scene<TileError>;

    /// Box around the triangles of each tile in the frame of the map [m], empty where it has none, and their number.
    fn tiles(&self) -> Vec<(Aabb, u64)>;

    /// Corners of the triangles of a tile in the frame of the map [m].
    ///
    /// # Errors
    /// [`TileError`] if the tile cannot be read.
    fn triangles(&self, tile: usize) -> Result<Vec<[DVec3; 3]>, TileError>;

    /// Whether a triangle is the surface only of what it faces, by the right-hand rule, and says nothing about what is behind it.
    fn has_fronts(&self) -> bool;
}

impl SceneSource for Scene<TileError> {
    fn scene(&self, _: &[DVec3]) -> Self {
        self.clone()
    }

    fn tiles(&self) -> Vec<(Aabb, u64)> {
        let of_tile = |tile: &Tile| (tile.bounds(), tile.corners().len() as u64);
        self.all_tiles().map(of_tile).collect()
    }

    fn triangles(&self, tile: usize) -> Result<Vec<[DVec3; 3]>, TileError> {
        Ok(self
            .all_tiles()
            .nth(tile)
            .map_or_else(Vec::new, Tile::corners))
    }

    fn has_fronts(&self) -> bool {
        self.has_fronts
    }
}
