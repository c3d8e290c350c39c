//! Tiles of triangles under one hierarchy.

mod cast;

#[cfg(test)]
pub(super) use cast::Single;

use std::convert::Infallible;
use std::fmt::Debug;
use std::sync::Arc;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::Hit;
use super::bvh::Bvh;
use super::tile::{Tile, middle_of, padded_prim};
use super::wide::WideBvh;
use crate::geometry::mesh::STEP_M;
use crate::geometry::{Aabb, TriangleMesh};

/// Triangles that rays can be cast at, from both sides. Clones share them.
///
/// Triangles that are degenerate or not finite are never hit. `E` is the error of a tile that cannot be read; all tiles
/// of a [`Scene`] without it are in memory.
#[derive(Clone, Debug)]
pub struct Scene<E = Infallible> {
    top: Arc<Top>,
    tiles: Arc<dyn TileSource<E>>,
    /// Whether its triangles have [fronts](super::SceneSource::has_fronts).
    pub has_fronts: bool,
}

/// Supplies the tiles of a scene when rays enter their boxes.
pub trait TileSource<E>: Debug + Send + Sync {
    /// A tile by its number; `None` if it has no triangles.
    ///
    /// # Errors
    /// Why the tile cannot be read, each time it is requested.
    fn tile(&self, number: usize) -> Result<Option<&Tile>, &E>;
}

impl<E> TileSource<E> for Vec<Tile> {
    fn tile(&self, number: usize) -> Result<Option<&Tile>, &E> {
        Ok(self.get(number))
    }
}

/// Hierarchy over the boxes of the tiles.
#[derive(Debug)]
struct Top {
    /// Origin of the boxes in the frame of the scene [m].
    middle: DVec3,
    bvh: WideBvh,
    /// Number of the tile in each leaf.
    numbers: Vec<u32>,
    /// Number of the triangles in the meshes before each tile.
    first_triangles: Vec<u32>,
}

impl Scene {
    /// Builds the hierarchy over a mesh, on all threads of the current pool.
    pub fn new(mesh: &TriangleMesh) -> Self {
        Self::of_tiles(std::slice::from_ref(mesh))
    }

    /// Memory of the hierarchies and the triangles [bytes].
    #[cfg(test)]
    pub fn bytes(&self) -> usize {
        let tiles = self.all_tiles().map(|tile| tile.as_bytes().len());
        size_of_val(&*self.top.bvh.nodes) + tiles.sum::<usize>()
    }
}

impl<E> Scene<E> {
    /// Builds a hierarchy per mesh and one over all, on all threads of the current pool.
    /// `Hit::triangle` counts the triangles of all meshes one after the
    /// other.
    pub fn of_tiles(meshes: &[TriangleMesh]) -> Self {
        let mut triangles = 0;
        let numbered: Vec<(&TriangleMesh, u32)> = meshes
            .iter()
            .map(|mesh| {
                let first = triangles;
                triangles += mesh.triangles.len();
                (mesh, first as u32)
            })
            .collect();
        let (tiles, first_triangles): (Vec<Tile>, Vec<u32>) = numbered
            .into_par_iter()
            .filter_map(|(mesh, first)| Some((Tile::of_mesh(mesh)?, first)))
            .unzip();
        let bounds: Vec<Aabb> = tiles.iter().map(Tile::bounds).collect();
        Self::over(&bounds, first_triangles, Arc::new(tiles))
    }

    /// Builds a hierarchy over tiles, of which only the boxes are known yet. `first_triangles` is added to the indices
    /// of the triangles of each.
    pub fn over(bounds: &[Aabb], first_triangles: Vec<u32>, tiles: Arc<dyn TileSource<E>>) -> Self {
        let whole = bounds
            .iter()
            .fold(Aabb::EMPTY, |whole, bounds| whole.union(*bounds));
        let middle = if whole.is_empty() {
            Vec3::ZERO
        } else {
            middle_of(&whole)
        };
        let boxes = bounds
            .iter()
            .zip(0..)
            .filter(|(bounds, _)| !bounds.is_empty());
        let prims = boxes.map(|(bounds, index)| {
            let relative = Aabb {
                min: (bounds.min - middle) / STEP_M,
                max: (bounds.max - middle) / STEP_M,
            };
            padded_prim(relative, &whole, index)
        });
        let (top, of_leaves) = Bvh::build(prims.collect(), 1);
        let (bvh, leaves) = WideBvh::of(&top);
        let number_of = |leaf: usize| of_leaves.order[of_leaves.ranges[leaf].start as usize];
        let top = Top {
            middle: middle.as_dvec3(),
            bvh,
            numbers: leaves.into_iter().map(number_of).collect(),
            first_triangles,
        };
        Self {
            top: top.into(),
            tiles,
            has_fronts: false,
        }
    }

    /// The same scene with tiles from another source.
    #[must_use]
    pub fn with_tiles(&self, tiles: Arc<dyn TileSource<E>>) -> Self {
        Self {
            top: self.top.clone(),
            tiles,
            has_fronts: self.has_fronts,
        }
    }

    /// Tiles that are in memory and have triangles.
    pub(super) fn all_tiles(&self) -> impl Iterator<Item = &Tile> {
        let numbers = 0..self.top.first_triangles.len();
        numbers.filter_map(|number| self.tiles.tile(number).ok().flatten())
    }

    /// The unit normal of the triangle of a hit of this scene by the right-hand rule; `None` if there is none.
    ///
    /// # Errors
    /// That of the tile of the hit.
    pub fn normal(&self, hit: &Hit) -> Result<Option<Vec3>, E>
    where
        E: Clone,
    {
        let leaf = hit.place.leaf;
        let tile = self.tiles.tile(leaf.tile as usize).map_err(E::clone)?;
        Ok(tile.map(|tile| {
            let block = tile.parts().leaves.block(leaf.index as usize);
            block.normal(hit.place.lane as usize)
        }))
    }
}
