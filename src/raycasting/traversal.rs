//! Depth-first traversal of a binary hierarchy by rays that stay together.

use glam::DVec3;

use super::bvh::{Bvh, MAX_DEPTH, NodeRef};
use super::triangle::TriangleBlock;

/// Rounding of the slab test, see Ize, *Robust BVH Ray Traversal*, JCGT 2013.
pub(super) const FAR_TOLERANCE: f32 = 1.0 + 8.0 * f32::EPSILON;
/// Largest inverse of a coordinate of a direction, so that 0 · ∞ does not occur.
const MAX_INVERSE: f32 = 1e18;

/// One or more rays that traverse a hierarchy together.
pub(super) trait Traverse {
    /// Origin of the rays in the frame of a hierarchy.
    type Origin: Copy;

    /// The origin relative to that of a hierarchy.
    fn relative_to(&self, middle: DVec3) -> Self::Origin;

    /// Whether any ray enters a box before its nearest hit. `COHERENT` promises that all rays
    /// have the signs of the first one.
    fn enters<const COHERENT: bool>(&self, origin: Self::Origin, bounds: &[f32; 6]) -> bool;

    /// Whether the second child of a node that is split along an axis comes first.
    fn is_backwards(&self, axis: usize) -> bool;

    /// Intersects the triangles of a leaf; `first_slot` is the slot of its first triangle.
    fn intersect(&mut self, origin: Self::Origin, block: &TriangleBlock, first_slot: u32);
}

/// The leaves that rays enter, near ones first.
pub(super) struct Traversal<'a, R: Traverse, const COHERENT: bool> {
    bvh: &'a Bvh,
    origin: R::Origin,
    stack: [NodeRef; MAX_DEPTH],
    count: usize,
}

impl<'a, R: Traverse, const COHERENT: bool> Traversal<'a, R, COHERENT> {
    /// Starts at the root; `origin` is relative to that of the hierarchy.
    #[inline(always)]
    pub fn new(bvh: &'a Bvh, origin: R::Origin) -> Self {
        Self {
            bvh,
            origin,
            stack: [bvh.root.unwrap_or(NodeRef::leaf(0)); MAX_DEPTH],
            count: usize::from(bvh.root.is_some()),
        }
    }

    /// The next leaf that any of the rays enters before its nearest hit.
    #[inline(always)]
    pub fn next_leaf(&mut self, rays: &R) -> Option<usize> {
        while self.count > 0 {
            self.count -= 1;
            let mut current = self.stack[self.count];
            loop {
                if current.is_leaf() {
                    return Some(current.index());
                }
                let node = &self.bvh.nodes[current.index()];
                let near = usize::from(rays.is_backwards(node.axis as usize));
                let enters_near = rays.enters::<COHERENT>(self.origin, &node.bounds[near]);
                let enters_far = rays.enters::<COHERENT>(self.origin, &node.bounds[1 - near]);
                if enters_near & enters_far {
                    self.stack[self.count] = node.children[1 - near];
                    self.count += 1;
                }
                if enters_near | enters_far {
                    current = node.children[if enters_near { near } else { 1 - near }];
                } else {
                    break;
                }
            }
        }
        None
    }
}

/// Indices of the bounds along an axis, the one through which a ray enters first.
#[inline(always)]
pub(super) fn entry_and_exit(axis: usize, is_backwards: bool) -> [usize; 2] {
    if is_backwards {
        [axis + 3, axis]
    } else {
        [axis, axis + 3]
    }
}

/// The inverse of a coordinate of a direction, limited in magnitude.
#[inline(always)]
pub(super) fn limited_inverse(coordinate: f32) -> f32 {
    let inverse = 1.0 / coordinate;
    if inverse.abs() < MAX_INVERSE {
        inverse
    } else {
        MAX_INVERSE.copysign(coordinate)
    }
}
