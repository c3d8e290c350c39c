//! Eight rays from one origin go through the hierarchy together.
//!
//! With the corners A, B, C of a triangle relative to the origin of the rays, a direction d
//! passes it on one side of all three edges where
//!
//! ```text
//! d · ((P + Q) × (Q − P))      PQ ∈ {AB, BC, CA}
//! ```
//!
//! have one sign: three dot products per ray, and the vectors are the same for all rays of the
//! packet. Seen from the neighbour, an edge gives exactly the negative number, so that no ray
//! slips between two triangles; where rounding decides, both are met, so that none slips through
//! a corner either. After Davidovič, Engelhardt, Georgiev, Slusallek and
//! Dachsbacher, *3D Rasterization: A Bridge between Rasterization and Ray Casting*, GI 2012.
//!
//! Plain loops over arrays that the compiler turns into vector instructions. Products and sums
//! are rounded one by one, so that every instruction set gives the same bits.

use super::block::{Block, Corner, edge, rounding};
use super::bvh::{Bvh, Child, MAX_DEPTH};
use super::{NEAREST_M, Reach};
use crate::geometry::Vec3;

/// Rays per packet.
pub(super) const RAYS: usize = 8;
/// No triangle was met.
pub(super) const NO_SLOT: u32 = u32::MAX;
/// Rounding of the slab test, see Ize, *Robust BVH Ray Traversal*, JCGT 2013.
pub(super) const FARTHER: f32 = 1.0 + 8.0 * f32::EPSILON;
/// One over a coordinate of a direction is never more than this, so that 0 · ∞ does not occur.
const STEEPEST: f32 = 1e18;

/// One number per ray.
pub(super) type Rays = [f32; RAYS];

/// Directions of a packet and what its rays met so far.
pub(super) struct Packet {
    /// Per axis.
    direction: [Rays; 3],
    inverse: [Rays; 3],
    /// How far there is still something to find [m].
    until_m: Rays,
    /// See [`Reach::enough_m`].
    enough_m: Rays,
    /// The nearest hit so far [m].
    pub range_m: Rays,
    /// The place of the triangle: its block times the triangles of a block plus its place there.
    pub slot: [u32; RAYS],
    /// Per axis, whether the first ray runs downwards.
    backwards: [bool; 3],
    /// Whether all rays run like the first.
    pub is_coherent: bool,
}

impl Packet {
    /// Up to [`RAYS`] rays; the last one fills the empty places.
    #[inline(always)]
    pub fn new(directions: &[Vec3], reach: &[Reach]) -> Self {
        let last = directions.len() - 1;
        let rays: [Vec3; RAYS] = std::array::from_fn(|ray| directions[ray.min(last)]);
        let reach: [Reach; RAYS] = std::array::from_fn(|ray| reach[ray.min(last)]);
        let direction: [Rays; 3] =
            std::array::from_fn(|axis| std::array::from_fn(|ray| rays[ray][axis]));
        let inverse = direction.map(inverse_of);
        let backwards = inverse.map(|axis| axis[0] < 0.0);
        let mut is_coherent = true;
        for axis in 0..3 {
            for inverse in inverse[axis] {
                is_coherent &= (inverse < 0.0) == backwards[axis];
            }
        }
        Self {
            direction,
            inverse,
            until_m: reach.map(|reach| reach.until_m),
            enough_m: reach.map(|reach| reach.enough_m),
            range_m: [f32::INFINITY; RAYS],
            slot: [NO_SLOT; RAYS],
            backwards,
            is_coherent,
        }
    }

    /// Takes the hits of a block that are nearer than what was known; `first_slot` is the place
    /// of its first triangle.
    #[inline(always)]
    pub fn meet(&mut self, origin: Vec3, block: &Block, first_slot: u32) {
        let [a, b, c] = block.corners_from(origin);
        let (ab, bc, ca) = (edge(&a, &b), edge(&b, &c), edge(&c, &a));
        for (triangle, rounding) in rounding(&a, &b, &c).into_iter().enumerate() {
            if !block.has(triangle) {
                break;
            }
            let (w, u, v) = (
                self.dot(&ab, triangle),
                self.dot(&bc, triangle),
                self.dot(&ca, triangle),
            );
            let mut inside = [false; RAYS];
            let mut any = false;
            for ray in 0..RAYS {
                let least = min(min(u[ray], v[ray]), w[ray]);
                let most = max(max(u[ray], v[ray]), w[ray]);
                inside[ray] = (least >= -rounding) | (most <= rounding);
                any |= inside[ray];
            }
            if !any {
                continue;
            }
            // Each side weighs the corner that lies opposite.
            let (a, b, c) = (
                self.dot(&a, triangle),
                self.dot(&b, triangle),
                self.dot(&c, triangle),
            );
            let slot = first_slot + triangle as u32;
            for ray in 0..RAYS {
                let range_m = (u[ray] * a[ray] + v[ray] * b[ray] + w[ray] * c[ray])
                    / (u[ray] + v[ray] + w[ray]);
                // Seen edge-on, the quotient may be anything.
                let range_m = max(min(min(a[ray], b[ray]), c[ray]), range_m);
                let range_m = min(max(max(a[ray], b[ray]), c[ray]), range_m);
                let is_met = inside[ray] & (range_m < self.until_m[ray]) & (range_m > NEAREST_M);
                let is_enough = range_m < self.enough_m[ray];
                let until_m = if is_enough { 0.0 } else { range_m };
                self.until_m[ray] = if is_met { until_m } else { self.until_m[ray] };
                self.range_m[ray] = if is_met { range_m } else { self.range_m[ray] };
                self.slot[ray] = if is_met { slot } else { self.slot[ray] };
            }
        }
    }

    /// Directions times the vector of one triangle.
    #[inline(always)]
    #[expect(
        clippy::needless_range_loop,
        reason = "such loops become vector instructions"
    )]
    fn dot(&self, vectors: &Corner, triangle: usize) -> Rays {
        let (x, y, z) = (
            vectors[0][triangle],
            vectors[1][triangle],
            vectors[2][triangle],
        );
        let mut dot = [0.0; RAYS];
        for ray in 0..RAYS {
            dot[ray] = self.direction[0][ray] * x
                + self.direction[1][ray] * y
                + self.direction[2][ray] * z;
        }
        dot
    }
}

impl Together for Packet {
    type Origin = Vec3;

    #[inline(always)]
    fn enters<const COHERENT: bool>(&self, origin: Vec3, bounds: &[f32; 6]) -> bool {
        let mut near = [0.0; RAYS];
        let mut far = self.until_m;
        for axis in 0..3 {
            // Where all rays run alike, the side that they come in through is known.
            let is_swapped = COHERENT && self.backwards[axis];
            let (first, second) = if is_swapped {
                (axis + 3, axis)
            } else {
                (axis, axis + 3)
            };
            let first = bounds[first] - origin[axis];
            let second = bounds[second] - origin[axis];
            for ray in 0..RAYS {
                let a = first * self.inverse[axis][ray];
                let b = second * self.inverse[axis][ray];
                let (a, b) = if COHERENT {
                    (a, b)
                } else {
                    (min(a, b), max(a, b))
                };
                near[ray] = max(near[ray], a);
                far[ray] = min(far[ray], b);
            }
        }
        let mut any = false;
        for ray in 0..RAYS {
            any |= near[ray] <= far[ray] * FARTHER;
        }
        any
    }

    #[inline(always)]
    fn is_backwards(&self, axis: u32) -> bool {
        self.backwards[axis as usize]
    }
}

/// Rays that go through a hierarchy together.
pub(super) trait Together {
    /// Where they start, in the frame of the hierarchy.
    type Origin: Copy;

    /// Whether any ray enters a box before its nearest hit.
    fn enters<const COHERENT: bool>(&self, origin: Self::Origin, bounds: &[f32; 6]) -> bool;

    /// Whether the first ray runs downwards along an axis.
    fn is_backwards(&self, axis: u32) -> bool;
}

/// The way of rays through a hierarchy, from leaf to leaf, near ones first.
///
/// `COHERENT` says that all run alike: then the side that the rays enter a box through is known.
pub(super) struct Walk<'a, O, const COHERENT: bool> {
    bvh: &'a Bvh,
    /// In the frame of the hierarchy.
    origin: O,
    waiting: [Child; MAX_DEPTH],
    count: usize,
}

impl<'a, O: Copy, const COHERENT: bool> Walk<'a, O, COHERENT> {
    #[inline(always)]
    pub fn new(bvh: &'a Bvh, origin: O) -> Self {
        Self {
            bvh,
            origin,
            waiting: [bvh.root.unwrap_or(Child::leaf(0)); MAX_DEPTH],
            count: usize::from(bvh.root.is_some()),
        }
    }

    /// The next leaf that one of the rays may find something in.
    #[inline(always)]
    pub fn next_leaf(&mut self, rays: &impl Together<Origin = O>) -> Option<usize> {
        while self.count > 0 {
            self.count -= 1;
            let mut current = self.waiting[self.count];
            loop {
                if current.is_leaf() {
                    return Some(current.index());
                }
                let node = &self.bvh.nodes[current.index()];
                let near = usize::from(rays.is_backwards(node.axis));
                let into_near = rays.enters::<COHERENT>(self.origin, &node.bounds[near]);
                let into_far = rays.enters::<COHERENT>(self.origin, &node.bounds[1 - near]);
                if into_near & into_far {
                    self.waiting[self.count] = node.children[1 - near];
                    self.count += 1;
                }
                if into_near | into_far {
                    current = node.children[if into_near { near } else { 1 - near }];
                } else {
                    break;
                }
            }
        }
        None
    }
}

/// One over each coordinate, and never too much.
#[inline(always)]
pub(super) fn inverse_of(direction: Rays) -> Rays {
    direction.map(inverse_of_one)
}

/// One over a coordinate, and never too much.
#[inline(always)]
pub(super) fn inverse_of_one(d: f32) -> f32 {
    let inverse = 1.0 / d;
    let is_small = inverse.abs() < STEEPEST;
    if is_small {
        inverse
    } else {
        STEEPEST.copysign(d)
    }
}

/// As the instruction does it: without the care of [`f32::min`] for what is no number.
#[inline(always)]
pub(super) fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// As the instruction does it: without the care of [`f32::max`] for what is no number.
#[inline(always)]
pub(super) fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}
