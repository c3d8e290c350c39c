//! Tiles of triangles under one hierarchy, and the ways to cast rays at them.

mod alone;
mod bundled;
mod through;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::Hit;
use super::block::{Block, TRIANGLES};
use super::bvh::{Bvh, Item};
use super::packet::{NO_SLOT, Packet, RAYS, Walk};
use super::wide::WideBvh;
use crate::geometry::{Aabb, TriangleMesh};

/// A triangle is degenerate where its height is less than this part of its longest edge.
const THINNEST: f64 = 1e-7;
/// By this part of the extent of the scene boxes are larger than what is in them: more than
/// rounding moves an edge.
const PADDING: f32 = 16.0 * f32::EPSILON;

/// How far a ray looks.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reach {
    /// Surfaces at this range or farther are not met [m].
    pub until_m: f32,
    /// Of surfaces nearer than this any may be reported, not only the nearest [m].
    pub enough_m: f32,
    /// Whether it does not matter if there is a surface nearer than `enough_m` where there is none
    /// from there to `until_m`: then it need not be reported.
    pub is_window: bool,
}

impl Reach {
    /// The nearest surface, however far.
    pub const UNLIMITED: Self = Self::until(f32::INFINITY);

    /// The nearest surface that is nearer than a range [m].
    pub const fn until(until_m: f32) -> Self {
        Self {
            until_m,
            enough_m: 0.0,
            is_window: false,
        }
    }
}

/// Triangles that rays can be cast at, from both sides.
///
/// Triangles that are degenerate or not finite are never met.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The origin of the boxes of the tiles, in the frame of the scene [m].
    middle: DVec3,
    /// Its leaves are the tiles.
    top: Bvh,
    wide_top: WideBvh,
    tiles: Vec<Tile>,
    /// One per leaf of each tile.
    blocks: Vec<Block>,
    /// Where each triangle is: its block times [`TRIANGLES`] plus its place there.
    slots: Vec<u32>,
}

/// A hierarchy and where its blocks are.
#[derive(Clone, Debug)]
struct Tile {
    /// The origin of its coordinates in the frame of the scene [m].
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
    /// [`Hit::triangle`] counts the triangles of all meshes one after the other.
    pub fn of_tiles(meshes: &[TriangleMesh]) -> Self {
        let mut first_triangle = 0;
        let numbered: Vec<(&TriangleMesh, u32)> = meshes
            .iter()
            .map(|mesh| {
                let first = first_triangle;
                first_triangle += mesh.triangles.len() as u32;
                (mesh, first)
            })
            .collect();
        let parts: Vec<Option<Part>> = numbered
            .into_par_iter()
            .map(|(mesh, first_triangle)| Part::build(mesh, first_triangle))
            .collect();
        Self::join(
            parts.into_iter().flatten().collect(),
            first_triangle as usize,
        )
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
        let items = parts.iter().enumerate().map(|(index, part)| {
            let relative = Aabb {
                min: part.bounds.min - middle,
                max: part.bounds.max - middle,
            };
            padded_item(relative, &whole, index as u32)
        });
        let (top, leaves) = Bvh::build(&items.collect::<Vec<_>>(), 1);
        let mut blocks = Vec::with_capacity(parts.iter().map(|part| part.blocks.len()).sum());
        let tiles = leaves
            .iter()
            .flatten()
            .map(|&index| {
                let part = &mut parts[index as usize];
                let first_block = blocks.len();
                blocks.append(&mut part.blocks);
                Tile {
                    middle: part.middle,
                    bvh: std::mem::take(&mut part.bvh),
                    wide_bvh: std::mem::take(&mut part.wide_bvh),
                    first_block,
                }
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

    /// The unit normal of a triangle by the right-hand rule; `None` where it is never met.
    pub fn normal(&self, triangle: u32) -> Option<Vec3> {
        let slot = *self.slots.get(triangle as usize)?;
        (slot != NO_SLOT).then(|| {
            let slot = slot as usize;
            self.blocks[slot / TRIANGLES].normal(slot % TRIANGLES)
        })
    }

    /// Casts rays from one origin along unit directions, all in the frame of the mesh, and writes
    /// what each meets first. Runs on the calling thread alone; directions that are neighbours in
    /// the list should be neighbours in space.
    ///
    /// # Panics
    /// Where there are not as many hits as directions.
    pub fn cast(&self, origin: Vec3, directions: &[Vec3], hits: &mut [Hit]) {
        self.cast_until(origin, directions, f32::INFINITY, hits);
    }

    /// Like [`Scene::cast`], but what is at `max_range_m` or farther is not met.
    pub fn cast_until(
        &self,
        origin: Vec3,
        directions: &[Vec3],
        max_range_m: f32,
        hits: &mut [Hit],
    ) {
        const AT_ONCE: usize = 32 * RAYS;
        assert_eq!(directions.len(), hits.len(), "one hit per direction");
        let reach = [Reach::until(max_range_m); AT_ONCE];
        let chunks = directions.chunks(AT_ONCE).zip(hits.chunks_mut(AT_ONCE));
        for (directions, hits) in chunks {
            let reach = &reach[..directions.len()];
            self.cast_within(origin.as_dvec3(), directions, reach, hits);
        }
    }

    /// Like [`Scene::cast`], but each ray has its own reach, and the origin keeps its precision
    /// far from the origin of the frame.
    ///
    /// # Panics
    /// Where there are not as many reaches or hits as directions.
    pub fn cast_within(
        &self,
        origin: DVec3,
        directions: &[Vec3],
        reach: &[Reach],
        hits: &mut [Hit],
    ) {
        assert_eq!(directions.len(), hits.len(), "one hit per direction");
        assert_eq!(directions.len(), reach.len(), "one reach per direction");
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            #[expect(unsafe_code, reason = "the line above has found the instructions")]
            unsafe {
                self.cast_avx2(origin, directions, reach, hits);
            }
            return;
        }
        self.cast_portable(origin, directions, reach, hits);
    }

    /// [`Scene::cast_portable`], compiled for eight numbers per instruction.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn cast_avx2(&self, origin: DVec3, directions: &[Vec3], reach: &[Reach], hits: &mut [Hit]) {
        self.cast_portable(origin, directions, reach, hits);
    }

    #[inline(always)]
    pub(super) fn cast_portable(
        &self,
        origin: DVec3,
        directions: &[Vec3],
        reach: &[Reach],
        hits: &mut [Hit],
    ) {
        let chunks = directions.chunks(RAYS).zip(reach.chunks(RAYS));
        for ((directions, reach), hits) in chunks.zip(hits.chunks_mut(RAYS)) {
            let mut packet = Packet::new(directions, reach);
            if packet.is_coherent {
                self.cast_packet::<true>(origin, &mut packet);
            } else {
                self.cast_packet::<false>(origin, &mut packet);
            }
            for (ray, hit) in hits.iter_mut().enumerate() {
                *hit = self.hit(packet.range_m[ray], packet.slot[ray]);
            }
        }
    }

    #[inline(always)]
    fn cast_packet<const COHERENT: bool>(&self, origin: DVec3, packet: &mut Packet) {
        let mut tiles = Walk::<_, COHERENT>::new(&self.top, (origin - self.middle).as_vec3());
        while let Some(tile) = tiles.next_leaf(packet) {
            let tile = &self.tiles[tile];
            let origin = (origin - tile.middle).as_vec3();
            let mut leaves = Walk::<_, COHERENT>::new(&tile.bvh, origin);
            while let Some(leaf) = leaves.next_leaf(packet) {
                let block = tile.first_block + leaf;
                packet.meet(origin, &self.blocks[block], (block * TRIANGLES) as u32);
            }
        }
    }

    #[inline(always)]
    fn hit(&self, range_m: f32, slot: u32) -> Hit {
        if slot == NO_SLOT {
            return Hit::MISS;
        }
        let slot = slot as usize;
        Hit {
            range_m,
            triangle: self.blocks[slot / TRIANGLES].index(slot % TRIANGLES),
        }
    }
}

/// The slot of each triangle, [`NO_SLOT`] for those that are never met.
fn slots_of(blocks: &[Block], triangles: usize) -> Vec<u32> {
    let mut slots = vec![NO_SLOT; triangles];
    for (number, block) in blocks.iter().enumerate() {
        for place in (0..TRIANGLES).filter(|&place| block.has(place)) {
            slots[block.index(place) as usize] = (number * TRIANGLES + place) as u32;
        }
    }
    slots
}

/// A tile while the scene is built.
struct Part {
    /// In the frame of the scene.
    bounds: Aabb,
    middle: DVec3,
    bvh: Bvh,
    wide_bvh: WideBvh,
    blocks: Vec<Block>,
}

impl Part {
    /// Nothing where there is nothing to meet.
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
        let items = usable
            .into_par_iter()
            .map(|index| padded_item(Aabb::of(local(index)), &bounds, index));
        let (bvh, leaves) = Bvh::build(&items.collect::<Vec<_>>(), TRIANGLES);
        let block = |leaf: &[u32]| Block::new(leaf.iter().map(|&t| (local(t), first_triangle + t)));
        let (blocks, wide_bvh) = rayon::join(
            || leaves.par_iter().map(block).collect(),
            || WideBvh::of(&bvh),
        );
        Some(Self {
            bounds,
            middle: middle.as_dvec3(),
            wide_bvh,
            bvh,
            blocks,
        })
    }
}

fn middle_of(bounds: &Aabb) -> Vec3 {
    bounds.min.midpoint(bounds.max)
}

/// An item whose box is larger by what rounding can do in a scene of this size.
fn padded_item(bounds: Aabb, whole: &Aabb, index: u32) -> Item {
    let padding = Vec3::splat(PADDING * whole.size().max_element());
    Item {
        bounds: Aabb {
            min: bounds.min - padding,
            max: bounds.max + padding,
        },
        index,
    }
}

/// Whether a triangle has finite corners and an area.
pub(crate) fn is_proper(corners: [Vec3; 3]) -> bool {
    let [a, b, c] = corners.map(|corner| corner.as_dvec3());
    let longest_squared = (b - a)
        .length_squared()
        .max((c - b).length_squared())
        .max((a - c).length_squared());
    let twice_area = (b - a).cross(c - a).length();
    twice_area.is_finite() && twice_area > THINNEST * longest_squared
}
