//! Single rays, which traverse the hierarchy of wide nodes: eight boxes at once, then the triangles
//! of a leaf at once.
//!
//! A packet enters the boxes of all its rays; where neighbouring rays diverge, a single ray enters
//! fewer. Its hits are those of a packet, bit by bit, unless it passes an edge within rounding.

use glam::Vec4;

use super::bvh::{MAX_DEPTH, NodeRef};
use super::simd::{Lanes, Simd};
use super::traversal::{FAR_TOLERANCE, entry_and_exit, limited_inverse};
use super::triangle::{TRIANGLES, TriangleBlock, Vectors, splat};
use super::wide::{CHILDREN, WideBvh};
use super::{NEAREST_M, Reach};
use crate::geometry::Vec3;

/// Most nodes on the stack: all but one child of each node on the way down.
const MAX_STACK: usize = (CHILDREN - 1) * MAX_DEPTH + CHILDREN;

/// A ray and its nearest hit so far.
#[derive(Clone, Copy)]
pub(super) struct SingleRay {
    direction: [f32; 3],
    pub inverse: [f32; 3],
    /// Per axis, the bounds through which it enters and leaves a box.
    pub sides: [[usize; 2]; 3],
    /// Nearer hits are of no interest [m].
    from_m: f32,
    /// Farther hits are of no interest [m].
    pub until_m: f32,
    /// See [`Reach::enough_m`].
    enough_m: f32,
    /// Range of the nearest hit [m].
    pub range_m: f32,
}

impl SingleRay {
    #[inline(always)]
    pub fn new(direction: Vec3, reach: Reach) -> Self {
        let direction = direction.to_array();
        let inverse = direction.map(limited_inverse);
        Self {
            direction,
            inverse,
            sides: [0, 1, 2].map(|axis| entry_and_exit(axis, inverse[axis] < 0.0)),
            from_m: 0.0,
            until_m: reach.until_m,
            enough_m: reach.enough_m,
            range_m: f32::INFINITY,
        }
    }

    /// The same ray, limited to a range interval.
    #[inline(always)]
    pub fn between(self, from_m: f32, until_m: f32) -> Self {
        Self {
            from_m,
            until_m,
            ..self
        }
    }

    /// Bit mask of the triangles of a block that the ray hits, and their ranges [m].
    #[inline(always)]
    pub fn hits(&self, origin: Vec3, block: &TriangleBlock) -> (u32, [f32; TRIANGLES]) {
        let triangles = block.relative_to(origin);
        match triangles.intersect(splat(self.direction, Vec4::splat)) {
            Some((inside, range_m)) => {
                let hits = inside
                    & range_m.lt(Vec4::splat(self.until_m))
                    & Vec4::splat(NEAREST_M).lt(range_m)
                    & Vec4::splat(self.from_m).le(range_m);
                (hits, range_m.to_array())
            }
            None => (0, [0.0; TRIANGLES]),
        }
    }

    /// Keeps the nearest hit of a block if it is nearer than those before.
    #[inline(always)]
    pub fn intersect(&mut self, origin: Vec3, block: &TriangleBlock) {
        let (mut hits, range_m) = self.hits(origin, block);
        while hits != 0 {
            let range_m = range_m[hits.trailing_zeros() as usize % TRIANGLES];
            hits &= hits - 1;
            if range_m < self.until_m {
                let is_enough = range_m < self.enough_m;
                self.until_m = if is_enough { 0.0 } else { range_m };
                self.range_m = range_m;
            }
        }
    }
}

/// A node that the ray enters, to be visited later.
#[derive(Clone, Copy)]
struct Pending {
    node: NodeRef,
    /// Range at which the ray enters it [m].
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

    /// The next node that the ray enters before its nearest hit.
    #[inline(always)]
    fn pop(&mut self, ray: &SingleRay) -> Option<NodeRef> {
        while self.count > 0 {
            self.count -= 1;
            let next = self.pending[self.count];
            if next.near_m <= ray.until_m * FAR_TOLERANCE {
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

/// The leaves that a ray enters, near ones first.
pub(super) struct WideTraversal<'a, S: Simd> {
    simd: S,
    bvh: &'a WideBvh,
    /// In the frame of the hierarchy.
    origin: Vectors<S::F32x8>,
    inverse: Vectors<S::F32x8>,
    stack: &'a mut Stack,
}

impl<'a, S: Simd> WideTraversal<'a, S> {
    #[inline(always)]
    pub fn new(
        simd: S,
        ray: &SingleRay,
        bvh: &'a WideBvh,
        origin: Vec3,
        stack: &'a mut Stack,
    ) -> Self {
        stack.pending[0] = Stack::ROOT;
        stack.count = usize::from(!bvh.nodes.is_empty());
        Self {
            simd,
            bvh,
            origin: splat(origin.to_array(), |number| simd.splat(number)),
            inverse: splat(ray.inverse, |number| simd.splat(number)),
            stack,
        }
    }

    /// The next leaf that the ray enters before its nearest hit.
    #[inline(always)]
    pub fn next_leaf(&mut self, ray: &SingleRay) -> Option<usize> {
        while let Some(mut current) = self.stack.pop(ray) {
            loop {
                if current.is_leaf() {
                    return Some(current.index());
                }
                let Some(nearest) = self.open(ray, current.index()) else {
                    break;
                };
                current = nearest;
            }
        }
        None
    }

    /// The nearest child that the ray enters; the others go onto the stack.
    #[inline(always)]
    fn open(&mut self, ray: &SingleRay, index: usize) -> Option<NodeRef> {
        let node = &self.bvh.nodes[index];
        let mut near = self.simd.splat(ray.from_m);
        let mut far = self.simd.splat(ray.until_m);
        for axis in 0..3 {
            let [entry, exit] = ray.sides[axis];
            let entry = self.simd.load(node.bounds[entry]) - self.origin[axis];
            let exit = self.simd.load(node.bounds[exit]) - self.origin[axis];
            near = near.max(entry * self.inverse[axis]);
            far = far.min(exit * self.inverse[axis]);
        }
        let mut entered = near.le(far * FAR_TOLERANCE);
        if entered == 0 {
            return None;
        }
        let mut nearest = entered.trailing_zeros() as usize % CHILDREN;
        entered &= entered - 1;
        if entered == 0 {
            return Some(node.children[nearest]);
        }
        let near = near.to_array();
        let first = self.stack.count;
        while entered != 0 {
            let mut other = entered.trailing_zeros() as usize % CHILDREN;
            entered &= entered - 1;
            if near[other] < near[nearest] {
                std::mem::swap(&mut other, &mut nearest);
            }
            let other = Pending {
                node: node.children[other],
                near_m: near[other],
            };
            self.stack.insert(other, first);
        }
        Some(node.children[nearest])
    }
}
