//! Tiles of triangles under one hierarchy.

mod cast;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::NO_SLOT;
use super::bvh::{Bvh, PrimRef};
use super::triangle::{TRIANGLES, TriangleBlock, is_proper};
use super::wide::WideBvh;
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
    top: Bvh,
    wide_top: WideBvh,
    tiles: Vec<TileBvh>,
    /// One per leaf of each tile.
    blocks: Vec<TriangleBlock>,
    /// Slot of each triangle: its block times [`TRIANGLES`] plus its lane; or [`NO_SLOT`].
    slots: Vec<u32>,
}

/// Hierarchy over the triangles of a tile.
#[derive(Clone, Debug, Default)]
struct TileBvh {
    /// Origin of its coordinates in the frame of the scene [m].
    middle: DVec3,
    bvh: Bvh,
    wide_bvh: WideBvh,
    first_block: usize,
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
        let parts: Vec<Part> = numbered
            .into_par_iter()
            .filter_map(|(mesh, first_triangle)| Part::build(mesh, first_triangle))
            .collect();
        Self::join(parts, triangles)
    }

    fn join(mut parts: Vec<Part>, triangles: usize) -> Self {
        let whole = parts
            .iter()
            .fold(Aabb::EMPTY, |whole, part| whole.union(part.bounds));
        let middle = if whole.is_empty() {
            Vec3::ZERO
        } else {
            middle_of(&whole)
        };
        let prims = parts.iter().zip(0..).map(|(part, index)| {
            let relative = Aabb {
                min: part.bounds.min - middle,
                max: part.bounds.max - middle,
            };
            padded_prim(relative, &whole, index)
        });
        let (top, leaves) = Bvh::build(prims.collect(), 1);
        let mut blocks = Vec::with_capacity(parts.iter().map(|part| part.blocks.len()).sum());
        let tiles = leaves
            .order
            .iter()
            .map(|&index| {
                let part = &mut parts[index as usize];
                part.tile.first_block = blocks.len();
                blocks.append(&mut part.blocks);
                std::mem::take(&mut part.tile)
            })
            .collect();
        Self {
            middle: middle.as_dvec3(),
            wide_top: WideBvh::of(&top),
            top,
            tiles,
            slots: slots_of(&blocks, triangles),
            blocks,
        }
    }

    /// The unit normal of a triangle by the right-hand rule; `None` if it is never hit.
    pub fn normal(&self, triangle: u32) -> Option<Vec3> {
        let slot = *self.slots.get(triangle as usize)?;
        (slot != NO_SLOT).then(|| {
            let slot = slot as usize;
            self.blocks[slot / TRIANGLES].normal(slot % TRIANGLES)
        })
    }
}

fn slots_of(blocks: &[TriangleBlock], triangles: usize) -> Vec<u32> {
    let mut slots = vec![NO_SLOT; triangles];
    for (number, block) in blocks.iter().enumerate() {
        for lane in (0..TRIANGLES).filter(|&lane| block.has(lane)) {
            slots[block.indices[lane] as usize] = (number * TRIANGLES + lane) as u32;
        }
    }
    slots
}

/// A tile while the scene is built.
struct Part {
    /// In the frame of the scene.
    bounds: Aabb,
    tile: TileBvh,
    blocks: Vec<TriangleBlock>,
}

impl Part {
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
        let local = |triangle: u32| corners(triangle).map(|corner| corner - middle);
        let prims = usable
            .into_par_iter()
            .map(|triangle| padded_prim(Aabb::of(local(triangle)), &bounds, triangle));
        let (bvh, leaves) = Bvh::build(prims.collect(), TRIANGLES);
        let block =
            |leaf: &[u32]| TriangleBlock::new(leaf.iter().map(|&t| (local(t), first_triangle + t)));
        let (blocks, wide_bvh) = rayon::join(
            || leaves.par_iter().map(block).collect(),
            || WideBvh::of(&bvh),
        );
        Some(Self {
            bounds,
            tile: TileBvh {
                middle: middle.as_dvec3(),
                bvh,
                wide_bvh,
                first_block: 0,
            },
            blocks,
        })
    }
}

fn middle_of(bounds: &Aabb) -> Vec3 {
    bounds.min.midpoint(bounds.max)
}

/// A primitive whose box is enlarged by the rounding errors in a scene of this size.
fn padded_prim(bounds: Aabb, whole: &Aabb, index: u32) -> PrimRef {
    let padding = Vec3::splat(PADDING * whole.size().max_element());
    let padded = Aabb {
        min: bounds.min - padding,
        max: bounds.max + padding,
    };
    PrimRef::new(padded, index)
}
