//! Depth-first traversal of a wide hierarchy by one or more rays, near children first.

use glam::DVec3;

use super::bvh::{MAX_DEPTH, NodeRef};
use super::place::Leaf;
use super::triangle::{TriangleBlock, Vectors};
use super::wide::{BoxGrid, CHILDREN, WideNode};
use crate::geometry::Vec3;
use crate::simd::{Lanes, Simd};

/// Rounding of the slab test, see Ize, *Robust BVH Ray Traversal*, JCGT 2013.
pub(super) const FAR_TOLERANCE: f32 = 1.0 + 8.0 * f32::EPSILON;
/// Largest inverse of a coordinate of a direction, so that 0 · ∞ does not occur.
const MAX_INVERSE: f32 = 1e18;

/// Most nodes on the stack: all but one child of each node on the way down.
const MAX_STACK: usize = (CHILDREN - 1) * MAX_DEPTH + CHILDREN;

/// One or more rays that traverse a hierarchy together.
pub(super) trait Traverse<S: Simd> {
    /// The rays in the frame of a hierarchy.
    type Relative;

    /// The rays in the frame of a hierarchy with its middle and its grid.
    fn relative_to(&self, simd: S, middle: DVec3, grid: &BoxGrid) -> Self::Relative;

    /// The children of a node that the rays may enter before their nearest hits: a bit mask, and the ranges at
    /// which they enter them, or lower [m].
    fn enter(&self, simd: S, rays: &Self::Relative, node: &WideNode) -> (u32, [f32; CHILDREN]);

    /// Nodes that are entered farther away are of no interest [m].
    fn until_m(&self) -> f32;

    /// Intersects the triangles of a leaf of a tile.
    fn intersect(&mut self, simd: S, rays: &Self::Relative, block: &TriangleBlock, leaf: Leaf);
}

/// Ranges at which rays enter or leave boxes, from the bounds of the boxes in cells: per axis, a factor and a
/// summand [m].
#[derive(Clone, Copy)]
pub(super) struct Slope<L> {
    factor: Vectors<L>,
    summand: Vectors<L>,
}

impl<L: Lanes> Slope<L> {
    /// The slope of an origin [steps of the lattice] and the inverses of the coordinates of a direction [m per step].
    #[inline(always)]
    pub fn new<S: Simd<F32x8 = L>>(
        simd: S,
        grid: &BoxGrid,
        origin: Vec3,
        inverse: &[f32; 3],
    ) -> Self {
        let factor = |axis: usize| simd.splat(grid.cell[axis] * inverse[axis]);
        let summand = |axis: usize| simd.splat((grid.origin[axis] - origin[axis]) * inverse[axis]);
        Self {
            factor: [factor(0), factor(1), factor(2)],
            summand: [summand(0), summand(1), summand(2)],
        }
    }
}

/// The children of a node between whose entry and exit there is a range from `from_m` to `until_m`: a bit mask, and
/// the ranges of entry [m].
#[inline(always)]
pub(super) fn enter<S: Simd>(
    simd: S,
    node: &WideNode,
    sides: &[[usize; 2]; 3],
    [entry, exit]: [&Slope<S::F32x8>; 2],
    [from_m, until_m]: [f32; 2],
) -> (u32, [f32; CHILDREN]) {
    let (mut near, mut far) = (simd.splat(from_m), simd.splat(until_m));
    for (axis, [first, last]) in sides.iter().enumerate() {
        let at = |slope: &Slope<S::F32x8>, side: usize| {
            simd.whole(node.bounds[side]) * slope.factor[axis] + slope.summand[axis]
        };
        near = near.max(at(entry, *first));
        far = far.min(at(exit, *last));
    }
    let entered = near.le(far * FAR_TOLERANCE) & node.mask();
    (entered, near.to_array())
}

/// A node that rays enter, to be visited later.
#[derive(Clone, Copy)]
struct Pending {
    node: NodeRef,
    /// Range at which they enter it [m].
    near_m: f32,
}

/// Memory of a traversal, to be used again.
pub(super) struct Stack {
    pending: [Pending; MAX_STACK],
    count: usize,
}

impl Stack {
    const ROOT: Pending = Pending {
        node: NodeRef::inner(0),
        near_m: 0.0,
    };

    pub fn new() -> Self {
        Self {
            pending: [Self::ROOT; MAX_STACK],
            count: 0,
        }
    }

    /// The next node that is entered before a range.
    #[inline(always)]
    fn pop(&mut self, until_m: f32) -> Option<NodeRef> {
        while self.count > 0 {
            self.count -= 1;
            let next = self.pending[self.count];
            if next.near_m <= until_m * FAR_TOLERANCE {
                return Some(next.node);
            }
        }
        None
    }

    /// Inserts a node below the nearer ones of those from `first` on.
    #[inline(always)]
    fn insert(&mut self, new: Pending, first: usize) {
        let mut place = self.count;
        self.pending[place] = new;
        self.count += 1;
        while place > first && self.pending[place - 1].near_m < new.near_m {
            self.pending[place] = self.pending[place - 1];
            place -= 1;
        }
        self.pending[place] = new;
    }
}

/// The leaves that rays enter, near ones first.
pub(super) struct Traversal<'a, S: Simd, R: Traverse<S>> {
    simd: S,
    nodes: &'a [WideNode],
    relative: &'a R::Relative,
    stack: &'a mut Stack,
}

impl<'a, S: Simd, R: Traverse<S>> Traversal<'a, S, R> {
    /// Starts at the root, with the rays in the frame of the hierarchy.
    #[inline(always)]
    pub fn new(
        simd: S,
        nodes: &'a [WideNode],
        relative: &'a R::Relative,
        stack: &'a mut Stack,
    ) -> Self {
        stack.pending[0] = Stack::ROOT;
        stack.count = usize::from(!nodes.is_empty());
        Self {
            simd,
            nodes,
            relative,
            stack,
        }
    }

    /// The next leaf that any of the rays enters before its nearest hit.
    #[inline(always)]
    pub fn next_leaf(&mut self, rays: &R) -> Option<usize> {
        while let Some(mut current) = self.stack.pop(rays.until_m()) {
            loop {
                if current.is_leaf() {
                    return Some(current.index());
                }
                let Some(nearest) = self.open(rays, current.index()) else {
                    break;
                };
                current = nearest;
            }
        }
        None
    }

    /// The nearest child that the rays enter; the others go onto the stack.
    #[inline(always)]
    fn open(&mut self, rays: &R, index: usize) -> Option<NodeRef> {
        let node = &self.nodes[index];
        let (mut entered, near_m) = rays.enter(self.simd, self.relative, node);
        if entered == 0 {
            return None;
        }
        let mut nearest = entered.trailing_zeros() as usize % CHILDREN;
        entered &= entered - 1;
        if entered == 0 {
            return Some(node.child(nearest));
        }
        let first = self.stack.count;
        while entered != 0 {
            let mut other = entered.trailing_zeros() as usize % CHILDREN;
            entered &= entered - 1;
            if near_m[other] < near_m[nearest] {
                std::mem::swap(&mut other, &mut nearest);
            }
            let other = Pending {
                node: node.child(other),
                near_m: near_m[other],
            };
            self.stack.insert(other, first);
        }
        Some(node.child(nearest))
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
