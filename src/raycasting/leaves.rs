//! The triangles of the leaves of a tile, in as little memory as their corners allow.
//!
//! The vertices of maps lie on a lattice of [`STEP_M`]. The corners of a leaf are then whole
//! numbers of steps from one of them, which fit into 16 bits up to 32 m: 100 bytes for four
//! triangles. Leaves with other corners take 160 bytes more. Both give the same corners, bit by bit.

use bytemuck::{Pod, Zeroable};
use glam::Vec4;

use super::Hit;
use super::triangle::{TRIANGLES, TriangleBlock};
use crate::geometry::Vec3;
#[cfg(doc)]
use crate::geometry::mesh::STEP_M;

/// Corners in steps, relative to an origin, and indices.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct LatticeLeaf {
    /// Relative to the middle of the tile [steps].
    origin: [f32; 3],
    /// Corners A, B, C, axis by axis, relative to the origin [steps].
    corners: [[[u16; TRIANGLES]; 3]; 3],
    indices: [u32; TRIANGLES],
}

/// Corners in numbers of steps that are not whole, and indices.
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
#[repr(C)]
pub(super) struct ExactLeaf {
    /// Corners A, B, C, axis by axis, relative to the middle of the tile [steps].
    corners: [[[f32; TRIANGLES]; 3]; 3],
    indices: [u32; TRIANGLES],
}

/// Triangles of the leaves of a tile.
#[derive(Clone, Copy)]
pub(super) struct Leaves<'a> {
    pub on_lattice: &'a [LatticeLeaf],
    /// The leaves of which not all corners lie on the lattice.
    pub exact: &'a [ExactLeaf],
}

/// Leaves to which others can be added.
#[derive(Default)]
pub(super) struct LeafList {
    pub on_lattice: Vec<LatticeLeaf>,
    pub exact: Vec<ExactLeaf>,
}

/// Origin of a leaf whose corners are elsewhere: at the place in `exact` that the first two of its corners give.
const ELSEWHERE: f32 = f32::INFINITY;

impl LeafList {
    /// Adds a leaf of at least one triangle: corners relative to the middle of the tile [steps], and indices in the
    /// mesh.
    pub fn push(&mut self, triangles: &[([Vec3; 3], u32)]) {
        let mut corners = [[[0.0; TRIANGLES]; 3]; 3];
        let mut indices = [Hit::NO_TRIANGLE; TRIANGLES];
        for lane in 0..TRIANGLES {
            let (of_triangle, index) = triangles[lane.min(triangles.len() - 1)];
            for (corner, position) in of_triangle.into_iter().enumerate() {
                for axis in 0..3 {
                    corners[corner][axis][lane] = position[axis];
                }
            }
            if lane < triangles.len() {
                indices[lane] = index;
            }
        }
        let leaf = LatticeLeaf::of(&corners, indices).unwrap_or_else(|| {
            self.exact.push(ExactLeaf { corners, indices });
            LatticeLeaf::elsewhere(self.exact.len() - 1)
        });
        self.on_lattice.push(leaf);
    }

    #[cfg(test)]
    fn leaves(&self) -> Leaves<'_> {
        Leaves {
            on_lattice: &self.on_lattice,
            exact: &self.exact,
        }
    }
}

impl Leaves<'_> {
    /// The triangles of a leaf.
    #[inline(always)]
    pub fn block(&self, leaf: usize) -> TriangleBlock {
        let leaf = &self.on_lattice[leaf];
        match leaf.place() {
            Some(place) => self.exact[place].block(),
            None => leaf.block(),
        }
    }

    /// The index of a triangle in the mesh.
    #[inline(always)]
    pub fn index(&self, leaf: usize, lane: usize) -> u32 {
        let leaf = &self.on_lattice[leaf];
        match leaf.place() {
            Some(place) => self.exact[place].indices[lane],
            None => leaf.indices[lane],
        }
    }
}

impl LatticeLeaf {
    /// `None` if a corner is not on the lattice or too far from the others.
    fn of(corners: &[[[f32; TRIANGLES]; 3]; 3], indices: [u32; TRIANGLES]) -> Option<Self> {
        /// From here on numbers of steps are not exact in `f32`.
        const MOST_STEPS: f32 = (1 << 24) as f32;
        let mut leaf = Self {
            origin: [0.0; 3],
            corners: [[[0; TRIANGLES]; 3]; 3],
            indices,
        };
        for axis in 0..3 {
            let along = corners.iter().flat_map(|corner| corner[axis]);
            let min = along.fold(f32::INFINITY, f32::min);
            leaf.origin[axis] = min;
            for (steps, corner) in leaf.corners.iter_mut().zip(corners) {
                for (steps, at) in steps[axis].iter_mut().zip(corner[axis]) {
                    let from_min = at - min;
                    let is_exact = at.fract() == 0.0
                        && at.abs() < MOST_STEPS
                        && from_min <= f32::from(u16::MAX);
                    if !is_exact {
                        return None;
                    }
                    *steps = from_min as u16;
                }
            }
        }
        Some(leaf)
    }

    fn elsewhere(place: usize) -> Self {
        let mut leaf = Self {
            origin: [ELSEWHERE; 3],
            corners: [[[0; TRIANGLES]; 3]; 3],
            indices: [Hit::NO_TRIANGLE; TRIANGLES],
        };
        leaf.indices[0] = place as u32;
        leaf
    }

    /// Place in the list of exact leaves.
    #[inline(always)]
    fn place(&self) -> Option<usize> {
        (self.origin[0] == ELSEWHERE).then_some(self.indices[0] as usize)
    }

    #[inline(always)]
    fn block(&self) -> TriangleBlock {
        let axis = |corner: usize, axis: usize| {
            let [a, b, c, d] = self.corners[corner][axis];
            let steps = Vec4::new(f32::from(a), f32::from(b), f32::from(c), f32::from(d));
            steps + Vec4::splat(self.origin[axis])
        };
        let corner = |corner: usize| [axis(corner, 0), axis(corner, 1), axis(corner, 2)];
        TriangleBlock {
            corners: [corner(0), corner(1), corner(2)],
            count: count(&self.indices),
        }
    }
}

impl ExactLeaf {
    #[inline(always)]
    fn block(&self) -> TriangleBlock {
        let axis = |corner: usize, axis: usize| Vec4::from_array(self.corners[corner][axis]);
        let corner = |corner: usize| [axis(corner, 0), axis(corner, 1), axis(corner, 2)];
        TriangleBlock {
            corners: [corner(0), corner(1), corner(2)],
            count: count(&self.indices),
        }
    }
}

/// Number of triangles; they fill the first lanes.
#[inline(always)]
fn count(indices: &[u32; TRIANGLES]) -> usize {
    let mut count = 0;
    for &index in indices {
        count += usize::from(index != Hit::NO_TRIANGLE);
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;

    fn corners(block: &TriangleBlock, lane: usize) -> [Vec3; 3] {
        (block.corners).map(|corner| Vec3::from_array(corner.map(|axis| axis[lane])))
    }

    #[test]
    fn corners_come_back_bit_by_bit_on_the_lattice_and_elsewhere() {
        let at = |x: f32| {
            [
                Vec3::new(x, -7.0, 9.0),
                Vec3::new(x + 65_535.0, 0.0, 1.0),
                Vec3::Z,
            ]
        };
        let far = |x: f32| at(x).map(|corner| corner + Vec3::splat(1_000_000.0));
        let triangles = [
            vec![(at(0.0), 5), (at(0.0).map(|corner| corner + Vec3::Y), 6)],
            vec![(far(0.0), 7)],
            // Not whole, wider than 16 bits, and beyond the whole numbers of `f32`.
            vec![(at(0.25), 8), (at(0.0), 9), (at(-0.5), 10), (at(0.0), 11)],
            vec![([Vec3::ZERO, 65_536.0 * Vec3::X, Vec3::Y], 12)],
            vec![(at(0.0).map(|corner| 1024.0 * corner), 13)],
        ];
        let mut list = LeafList::default();
        triangles.iter().for_each(|leaf| list.push(leaf));
        assert_eq!(list.exact.len(), 3);
        let leaves = list.leaves();
        for (number, leaf) in triangles.iter().enumerate() {
            let block = leaves.block(number);
            assert_eq!(block.count, leaf.len());
            for (lane, &(expected, index)) in leaf.iter().enumerate() {
                assert_eq!(corners(&block, lane), expected);
                assert_eq!(leaves.index(number, lane), index);
            }
        }
    }
}
