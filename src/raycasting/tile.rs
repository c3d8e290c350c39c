//! The triangles of a tile under a hierarchy: bytes that are the same in memory and in a file.
//!
//! ```text
//! header     128 bytes
//! nodes      128 bytes each: the hierarchy, its root first
//! leaves     100 bytes each, on the lattice of maps
//! leaves     160 bytes each, elsewhere
//! ```
//!
//! Each part begins at a multiple of 64 bytes; numbers are little-endian.

use std::ops::Range;

use bytemuck::{Pod, Zeroable};
use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::bvh::{Bvh, PrimRef};
use super::leaves::{ExactLeaf, LatticeLeaf, LeafList, Leaves};
use super::triangle::{TRIANGLES, is_proper};
use super::wide::{BoxGrid, WideBvh, WideNode};
use crate::geometry::mesh::STEP_M;
use crate::geometry::{Aabb, TriangleMesh};
use crate::shared_bytes::{SharedBytes, join, ranges_of};

/// Boxes are enlarged by this part of the extent of the scene: more than rounding moves an edge.
const PADDING: f32 = 16.0 * f32::EPSILON;

/// Triangles of a tile under a hierarchy. Clones share them.
#[derive(Clone, Debug)]
pub struct Tile {
    header: Header,
    bytes: SharedBytes,
    /// Where header, nodes, and leaves on the lattice and elsewhere are.
    ranges: [Range<usize>; 4],
}

/// What the bytes of a tile begin with.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
struct Header {
    /// Origin of the coordinates of the tile in the frame of the scene [m].
    middle: [f64; 3],
    /// Lower and upper corner in the frame of the scene [m].
    bounds: [f32; 6],
    grid: BoxGrid,
    nodes: u32,
    leaves: u32,
    exact_leaves: u32,
    unused: [u8; 44],
}

/// The parts of a tile that rays visit.
pub(super) struct Parts<'a> {
    pub nodes: &'a [WideNode],
    pub leaves: Leaves<'a>,
}

impl Tile {
    /// Builds the hierarchy over the triangles of a mesh, on all threads of the current pool; `None` if none of them
    /// can be hit.
    pub fn of_mesh(mesh: &TriangleMesh) -> Option<Self> {
        Self::at(DVec3::ZERO, mesh)
    }

    /// Like [`of_mesh`](Self::of_mesh), of a mesh whose coordinates are relative to `origin` [m].
    pub fn at(origin: DVec3, mesh: &TriangleMesh) -> Option<Self> {
        let usable: Vec<u32> = (0..mesh.triangles.len())
            .into_par_iter()
            .filter(|&triangle| is_proper(mesh.corners(triangle)))
            .map(|triangle| triangle as u32)
            .collect();
        let corners = |triangle: u32| mesh.corners(triangle as usize);
        let bounds = Aabb::from_points(usable.iter().flat_map(|&triangle| corners(triangle)));
        if bounds.is_empty() {
            return None;
        }
        let middle = middle_of(&bounds);
        let local = |triangle: u32| corners(triangle).map(|corner| (corner - middle) / STEP_M);
        let prims = usable
            .into_par_iter()
            .map(|triangle| padded_prim(Aabb::from_points(local(triangle)), &bounds, triangle));
        let (bvh, of_leaves) = Bvh::build(prims.collect(), TRIANGLES);
        let (bvh, order) = WideBvh::of(&bvh);
        let mut leaves = LeafList::default();
        for leaf in order {
            let range = &of_leaves.ranges[leaf];
            let triangles = &of_leaves.order[range.start as usize..range.end as usize];
            let of_leaf: Vec<([Vec3; 3], u32)> = (triangles.iter())
                .map(|&triangle| (local(triangle), triangle))
                .collect();
            leaves.push(&of_leaf);
        }
        Some(Self::assemble(origin, middle, &bounds, &bvh, &leaves))
    }

    fn assemble(
        origin: DVec3,
        middle: Vec3,
        bounds: &Aabb,
        bvh: &WideBvh,
        leaves: &LeafList,
    ) -> Self {
        // Rounded where the origin is far away, by less than the boxes of tiles are enlarged.
        let [min, max] = [bounds.min, bounds.max]
            .map(|corner| (origin + corner.as_dvec3()).as_vec3().to_array());
        let header = Header {
            middle: (origin + middle.as_dvec3()).to_array(),
            bounds: [min[0], min[1], min[2], max[0], max[1], max[2]],
            grid: bvh.grid,
            nodes: bvh.nodes.len() as u32,
            leaves: leaves.on_lattice.len() as u32,
            exact_leaves: leaves.exact.len() as u32,
            unused: [0; 44],
        };
        let bytes = join(&[
            bytemuck::bytes_of(&header),
            bytemuck::cast_slice(&bvh.nodes),
            bytemuck::cast_slice(&leaves.on_lattice),
            bytemuck::cast_slice(&leaves.exact),
        ]);
        Self {
            ranges: ranges_of(header.sizes()).unwrap_or_default(),
            header,
            bytes: SharedBytes::from(&*bytes),
        }
    }

    /// Reads what [`as_bytes`](Self::as_bytes) returned; `None` where the parts are not complete.
    pub fn from_bytes(bytes: SharedBytes) -> Option<Self> {
        let header: Header = bytemuck::pod_read_unaligned(bytes.get(..size_of::<Header>())?);
        let ranges = ranges_of(header.sizes())?;
        (ranges[3].end <= bytes.len()).then_some(Self {
            header,
            bytes,
            ranges,
        })
    }

    /// The whole tile.
    pub fn as_bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Box around the triangles in the frame of the scene [m].
    pub fn bounds(&self) -> Aabb {
        let [a, b, c, d, e, f] = self.header.bounds;
        Aabb {
            min: Vec3::new(a, b, c),
            max: Vec3::new(d, e, f),
        }
    }

    /// Visits the corners of every triangle in the frame of the scene [m], with its index in the mesh.
    pub fn for_each_triangle(&self, mut visit: impl FnMut([DVec3; 3], u32)) {
        let leaves = self.parts().leaves;
        for leaf in 0..leaves.on_lattice.len() {
            let block = leaves.block(leaf);
            for lane in 0..block.count {
                let corners = block.corners.map(|axes| {
                    let steps = DVec3::from_array(axes.map(|axis| f64::from(axis[lane])));
                    self.middle() + steps * f64::from(STEP_M)
                });
                visit(corners, leaves.index(leaf, lane));
            }
        }
    }

    /// Corners of all triangles in the frame of the scene [m].
    pub fn corners(&self) -> Vec<[DVec3; 3]> {
        let mut triangles = Vec::new();
        self.for_each_triangle(|corners, _| triangles.push(corners));
        triangles
    }

    /// Origin of the coordinates of the tile in the frame of the scene [m].
    #[inline(always)]
    pub(super) fn middle(&self) -> DVec3 {
        DVec3::from_array(self.header.middle)
    }

    #[inline(always)]
    pub(super) fn grid(&self) -> &BoxGrid {
        &self.header.grid
    }

    #[inline(always)]
    pub(super) fn parts(&self) -> Parts<'_> {
        let [_, nodes, on_lattice, exact] = &self.ranges;
        let bytes = &*self.bytes;
        Parts {
            nodes: bytemuck::cast_slice(&bytes[nodes.clone()]),
            leaves: Leaves {
                on_lattice: bytemuck::cast_slice(&bytes[on_lattice.clone()]),
                exact: bytemuck::cast_slice(&bytes[exact.clone()]),
            },
        }
    }
}

impl Header {
    /// Sizes of header, nodes, and leaves on the lattice and elsewhere [bytes].
    fn sizes(&self) -> [u64; 4] {
        let of = |count: u32, size: usize| u64::from(count) * size as u64;
        [
            size_of::<Self>() as u64,
            of(self.nodes, size_of::<WideNode>()),
            of(self.leaves, size_of::<LatticeLeaf>()),
            of(self.exact_leaves, size_of::<ExactLeaf>()),
        ]
    }
}

/// The middle of a box, on the lattice of maps.
pub(super) fn middle_of(bounds: &Aabb) -> Vec3 {
    (bounds.min.midpoint(bounds.max) / STEP_M).round() * STEP_M
}

/// A primitive whose box [steps] is enlarged by the rounding errors in a scene of this size.
pub(super) fn padded_prim(bounds: Aabb, whole: &Aabb, index: u32) -> PrimRef {
    let padding = Vec3::splat(PADDING * whole.size().max_element() / STEP_M);
    let padded = Aabb {
        min: bounds.min - padding,
        max: bounds.max + padding,
    };
    PrimRef::new(padded, index)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Triangles that stand in a row, every third of them off the lattice.
    fn fence() -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        for number in 0..1000_u16 {
            let at = Vec3::new(f32::from(number), 0.0, 0.0);
            let off = if number.is_multiple_of(3) { 1e-4 } else { 0.0 };
            let first = 3 * u32::from(number);
            mesh.vertices
                .extend([at, at + Vec3::X, at + Vec3::new(off, 0.0, 2.0)]);
            mesh.triangles.push([first, first + 1, first + 2]);
        }
        mesh
    }

    #[test]
    fn bytes_are_read_as_the_tile_that_they_were_and_every_triangle_is_in_it_once() {
        let mesh = fence();
        let tile = Tile::of_mesh(&mesh).unwrap();
        let again = Tile::from_bytes(SharedBytes::from(tile.as_bytes())).unwrap();
        assert_eq!(again.bounds(), tile.bounds());
        let mut found = vec![0; mesh.triangles.len()];
        again.for_each_triangle(|corners, index| {
            found[index as usize] += 1;
            let expected = mesh.corners(index as usize).map(|corner| corner.as_dvec3());
            assert!((0..3).all(|corner| corners[corner].distance(expected[corner]) < 1e-4));
        });
        assert!(found.iter().all(|&count| count == 1));
    }

    #[test]
    fn bytes_that_are_cut_off_are_not_a_tile() {
        let tile = Tile::of_mesh(&fence()).unwrap();
        for length in [0, 100, 200, tile.as_bytes().len() - 64] {
            let cut = SharedBytes::from(&tile.as_bytes()[..length]);
            assert!(Tile::from_bytes(cut).is_none(), "{length}");
        }
    }

    #[test]
    fn a_mesh_without_an_area_has_no_tile() {
        let flat = TriangleMesh {
            vertices: vec![Vec3::ZERO, Vec3::X],
            triangles: vec![[0, 1, 1]],
            ..TriangleMesh::default()
        };
        assert!(Tile::of_mesh(&flat).is_none());
    }
}
