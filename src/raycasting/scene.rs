//! Tiles of triangles under one hierarchy.

mod cast;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::Hit;
use super::bvh::{Bvh, PrimRef};
use super::leaves::Leaves;
use super::triangle::{TRIANGLES, is_proper};
use super::wide::WideBvh;
use crate::geometry::mesh::STEP_M;
use crate::geometry::{Aabb, TriangleMesh};

/// Boxes are enlarged by this part of the extent of the scene: more than rounding moves an edge.
const PADDING: f32 = 16.0 * f32::EPSILON;

/// Triangles that rays can be cast at, from both sides.
///
/// Triangles that are degenerate or not finite are never hit.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Origin of the boxes of the tiles, in the frame of the scene [m].
    middle: DVec3,
    /// Hierarchy over the tiles.
    top: WideBvh,
    tiles: Vec<Tile>,
}

/// Triangles of a tile under a hierarchy.
#[derive(Clone, Debug)]
struct Tile {
    /// In the frame of the scene.
    bounds: Aabb,
    /// Origin of its coordinates in the frame of the scene [m].
    middle: DVec3,
    bvh: WideBvh,
    leaves: Leaves,
}

impl Scene {
    /// Builds the hierarchy over a mesh, on all threads of the current pool.
    pub fn new(mesh: &TriangleMesh) -> Self {
        Self::of_tiles(std::slice::from_ref(mesh))
    }

    /// Builds a hierarchy per mesh and one over all, on all threads of the current pool.
    /// [`Hit::triangle`](super::Hit::triangle) counts the triangles of all meshes one after the
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
        let tiles: Vec<Tile> = numbered
            .into_par_iter()
            .filter_map(|(mesh, first_triangle)| Tile::build(mesh, first_triangle))
            .collect();
        Self::join(tiles)
    }

    fn join(tiles: Vec<Tile>) -> Self {
        let whole = tiles
            .iter()
            .fold(Aabb::EMPTY, |whole, tile| whole.union(tile.bounds));
        let middle = if whole.is_empty() {
            Vec3::ZERO
        } else {
            middle_of(&whole)
        };
        let prims = tiles.iter().zip(0..).map(|(tile, index)| {
            let relative = Aabb {
                min: (tile.bounds.min - middle) / STEP_M,
                max: (tile.bounds.max - middle) / STEP_M,
            };
            padded_prim(relative, &whole, index)
        });
        let (top, of_leaves) = Bvh::build(prims.collect(), 1);
        let (top, leaves) = WideBvh::of(&top);
        let mut tiles: Vec<Option<Tile>> = tiles.into_iter().map(Some).collect();
        let tile_of = |leaf: usize| {
            let place = of_leaves.ranges[leaf].start as usize;
            tiles[of_leaves.order[place] as usize].take()
        };
        Self {
            middle: middle.as_dvec3(),
            top,
            tiles: leaves.into_iter().filter_map(tile_of).collect(),
        }
    }

    /// The unit normal of the triangle of a hit of this scene by the right-hand rule; `None` if there is none.
    pub fn normal(&self, hit: &Hit) -> Option<Vec3> {
        let leaf = hit.place.leaf;
        let tile = self.tiles.get(leaf.tile as usize)?;
        let block = tile.leaves.block(leaf.index as usize);
        Some(block.normal(hit.place.lane as usize))
    }

    /// Memory of the hierarchies and the triangles [bytes].
    pub fn bytes(&self) -> usize {
        let of_tile = |tile: &Tile| tile.bvh.bytes() + tile.leaves.bytes();
        self.top.bytes() + self.tiles.iter().map(of_tile).sum::<usize>()
    }
}

impl Tile {
    /// `None` if no triangle of the mesh can be hit.
    fn build(mesh: &TriangleMesh, first_triangle: u32) -> Option<Self> {
        let usable: Vec<u32> = (0..mesh.triangles.len())
            .into_par_iter()
            .filter(|&triangle| is_proper(mesh.corners(triangle)))
            .map(|triangle| triangle as u32)
            .collect();
        let corners = |triangle: u32| mesh.corners(triangle as usize);
        let bounds = Aabb::of(usable.iter().flat_map(|&triangle| corners(triangle)));
        if bounds.is_empty() {
            return None;
        }
        let middle = middle_of(&bounds);
        let local = |triangle: u32| corners(triangle).map(|corner| (corner - middle) / STEP_M);
        let prims = usable
            .into_par_iter()
            .map(|triangle| padded_prim(Aabb::of(local(triangle)), &bounds, triangle));
        let (bvh, of_leaves) = Bvh::build(prims.collect(), TRIANGLES);
        let (bvh, order) = WideBvh::of(&bvh);
        let mut leaves = Leaves::default();
        for leaf in order {
            let range = &of_leaves.ranges[leaf];
            let triangles = &of_leaves.order[range.start as usize..range.end as usize];
            let of_leaf: Vec<([Vec3; 3], u32)> = (triangles.iter())
                .map(|&triangle| (local(triangle), first_triangle + triangle))
                .collect();
            leaves.push(&of_leaf);
        }
        leaves.shrink_to_fit();
        Some(Self {
            bounds,
            middle: middle.as_dvec3(),
            bvh,
            leaves,
        })
    }
}

/// The middle of a box, on the lattice of maps.
fn middle_of(bounds: &Aabb) -> Vec3 {
    (bounds.min.midpoint(bounds.max) / STEP_M).round() * STEP_M
}

/// A primitive whose box [steps] is enlarged by the rounding errors in a scene of this size.
fn padded_prim(bounds: Aabb, whole: &Aabb, index: u32) -> PrimRef {
    let padding = Vec3::splat(PADDING * whole.size().max_element() / STEP_M);
    let padded = Aabb {
        min: bounds.min - padding,
        max: bounds.max + padding,
    };
    PrimRef::new(padded, index)
}
