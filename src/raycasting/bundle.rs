//! Eight rays with origins of their own that are nearly one go through the hierarchy as one.
//!
//! A bundle is the same beam seen from eight poses that are close to each other. A box is entered
//! where
//!
//! ```text
//! max over axes of the first (box − o) / d  ≤  min over axes of the last
//! ```
//!
//! and with o and 1 / d known to lie in intervals, both sides have bounds that hold for all rays:
//! eight boxes are tested at once against these. What is left in the leaves is tested ray by ray,
//! with the very sums and products of [`super::packet`]. The bounds are made from the same
//! rounded operations on the ends of the intervals, which are monotone, so they never exclude what
//! a ray alone would enter. So a ray meets the same range, bit by bit, in a bundle and in a packet,
//! unless it passes an edge within rounding: a triangle that is met there from just outside its
//! box is tested or not, depending on what is found before.

use glam::DVec3;

use super::block::{Block, TRIANGLES};
use super::bvh::Child;
use super::packet::{FARTHER, RAYS, Rays, inverse_of, max, min};
use super::wide::{CHILDREN, WideBvh, WideNode};
use super::{NEAREST_M, Reach};
use crate::geometry::Vec3;

/// Where the rays of a bundle start, in some frame.
pub(super) struct Origins {
    /// Per axis.
    each: [Rays; 3],
    least: [f32; 3],
    most: [f32; 3],
}

impl Origins {
    /// Origins relative to a place, all in the frame of the scene.
    #[inline(always)]
    pub fn from(middle: DVec3, origins: &[[f64; RAYS]; 3]) -> Self {
        let middle = middle.to_array();
        let each: [Rays; 3] =
            std::array::from_fn(|axis| origins[axis].map(|origin| (origin - middle[axis]) as f32));
        Self {
            least: each.map(least),
            most: each.map(most),
            each,
        }
    }
}

/// What the inverse directions of all rays have in common along one axis.
#[derive(Clone, Copy)]
struct Slope {
    least: f32,
    most: f32,
    is_mixed: bool,
}

impl Slope {
    #[inline(always)]
    fn of(inverse: Rays) -> Self {
        let (least, most) = (least(inverse), most(inverse));
        Self {
            least,
            most,
            is_mixed: (least < 0.0) & (most > 0.0),
        }
    }
}

/// Directions of a bundle and what its rays met so far.
pub(super) struct Bundle {
    /// Per axis.
    direction: [Rays; 3],
    inverse: [Rays; 3],
    slopes: [Slope; 3],
    /// Of the axes along which some rays run up and others down, the least |1 / d|.
    mixed_inverse: [f32; 3],
    until_m: Rays,
    enough_m: f32,
    /// The nearest hit so far [m].
    pub range_m: Rays,
    /// How far there is still something to find for any ray [m].
    farthest_m: f32,
}

impl Bundle {
    /// Rays that share their reach.
    #[inline(always)]
    pub fn new(directions: &[Vec3; RAYS], reach: Reach) -> Self {
        let direction: [Rays; 3] =
            std::array::from_fn(|axis| std::array::from_fn(|ray| directions[ray][axis]));
        let inverse = direction.map(inverse_of);
        Self {
            direction,
            inverse,
            slopes: inverse.map(Slope::of),
            mixed_inverse: inverse.map(|axis| least(axis.map(f32::abs))),
            until_m: [reach.until_m; RAYS],
            enough_m: reach.enough_m,
            range_m: [f32::INFINITY; RAYS],
            farthest_m: reach.until_m,
        }
    }

    /// From where on each child may be entered by any ray, and 1 in the byte of each that may be.
    #[inline(always)]
    fn enters_children(&self, origins: &Origins, node: &WideNode) -> ([f32; CHILDREN], u64) {
        let mut near = [0.0; CHILDREN];
        let mut far = [self.farthest_m; CHILDREN];
        for axis in 0..3 {
            let (lower, upper) = (&node.bounds[axis], &node.bounds[axis + 3]);
            let slope = self.slopes[axis];
            let (low, high) = (origins.least[axis], origins.most[axis]);
            if slope.is_mixed {
                let inverse = self.mixed_inverse[axis];
                for child in 0..CHILDREN {
                    let above = (lower[child] - high) * inverse;
                    let below = (low - upper[child]) * inverse;
                    near[child] = max(near[child], max(above, below));
                }
                continue;
            }
            let is_upwards = slope.least >= 0.0;
            let (first, last) = if is_upwards {
                (lower, upper)
            } else {
                (upper, lower)
            };
            let (from_first, from_last) = if is_upwards { (high, low) } else { (low, high) };
            for child in 0..CHILDREN {
                let a = first[child] - from_first;
                let b = last[child] - from_last;
                near[child] = max(near[child], min(a * slope.least, a * slope.most));
                far[child] = min(far[child], max(b * slope.least, b * slope.most));
            }
        }
        let mut is_entered = [0_u8; CHILDREN];
        for child in 0..CHILDREN {
            is_entered[child] = u8::from(near[child] <= far[child] * FARTHER);
        }
        (near, u64::from_le_bytes(is_entered))
    }

    /// Which rays enter the box of a child before their nearest hit; `None` where none does.
    #[inline(always)]
    fn enters(&self, origins: &Origins, node: &WideNode, child: usize) -> Option<[bool; RAYS]> {
        let mut near = [0.0; RAYS];
        let mut far = self.until_m;
        for axis in 0..3 {
            let (lower, upper) = (node.bounds[axis][child], node.bounds[axis + 3][child]);
            for ray in 0..RAYS {
                let a = (lower - origins.each[axis][ray]) * self.inverse[axis][ray];
                let b = (upper - origins.each[axis][ray]) * self.inverse[axis][ray];
                near[ray] = max(near[ray], min(a, b));
                far[ray] = min(far[ray], max(a, b));
            }
        }
        let mut is_entering = [false; RAYS];
        let mut any = false;
        for ray in 0..RAYS {
            is_entering[ray] = near[ray] <= far[ray] * FARTHER;
            any |= is_entering[ray];
        }
        any.then_some(is_entering)
    }

    /// Takes the hits of a block that are nearer than what was known, as
    /// [`super::packet::Packet::meet`] does, for the rays that enter its box: others would see
    /// triangles from their edge that they pass.
    #[inline(always)]
    pub fn meet(&mut self, origins: &Origins, block: &Block, is_entering: [bool; RAYS]) {
        for triangle in 0..TRIANGLES {
            if !block.has(triangle) {
                break;
            }
            let [a, b, c] = block.corners_from_each(origins, triangle);
            let (w, u, v) = (self.side(&a, &b), self.side(&b, &c), self.side(&c, &a));
            let rounding = rounding(&a, &b, &c);
            let mut inside = [false; RAYS];
            let mut any = false;
            for ray in 0..RAYS {
                let least = min(min(u[ray], v[ray]), w[ray]);
                let most = max(max(u[ray], v[ray]), w[ray]);
                inside[ray] =
                    is_entering[ray] & ((least >= -rounding[ray]) | (most <= rounding[ray]));
                any |= inside[ray];
            }
            if !any {
                continue;
            }
            let (a, b, c) = (self.dot(&a), self.dot(&b), self.dot(&c));
            for ray in 0..RAYS {
                let range_m = (u[ray] * a[ray] + v[ray] * b[ray] + w[ray] * c[ray])
                    / (u[ray] + v[ray] + w[ray]);
                // Seen edge-on, the quotient may be anything.
                let range_m = max(min(min(a[ray], b[ray]), c[ray]), range_m);
                let range_m = min(max(max(a[ray], b[ray]), c[ray]), range_m);
                let is_met = inside[ray] & (range_m < self.until_m[ray]) & (range_m > NEAREST_M);
                let until_m = if range_m < self.enough_m {
                    0.0
                } else {
                    range_m
                };
                self.until_m[ray] = if is_met { until_m } else { self.until_m[ray] };
                self.range_m[ray] = if is_met { range_m } else { self.range_m[ray] };
            }
            self.farthest_m = most(self.until_m);
        }
    }

    /// d · ((P + Q) × (Q − P)) of each ray.
    #[inline(always)]
    fn side(&self, p: &[Rays; 3], q: &[Rays; 3]) -> Rays {
        let mut edge = [[0.0; RAYS]; 3];
        for (axis, edge) in edge.iter_mut().enumerate() {
            let (j, k) = ((axis + 1) % 3, (axis + 2) % 3);
            for ray in 0..RAYS {
                edge[ray] = (p[j][ray] + q[j][ray]) * (q[k][ray] - p[k][ray])
                    - (p[k][ray] + q[k][ray]) * (q[j][ray] - p[j][ray]);
            }
        }
        self.dot(&edge)
    }

    #[inline(always)]
    fn dot(&self, vectors: &[Rays; 3]) -> Rays {
        let mut dot = [0.0; RAYS];
        for ray in 0..RAYS {
            dot[ray] = self.direction[0][ray] * vectors[0][ray]
                + self.direction[1][ray] * vectors[1][ray]
                + self.direction[2][ray] * vectors[2][ray];
        }
        dot
    }
}

impl Block {
    /// The corners of one triangle relative to the origin of each ray.
    #[inline(always)]
    fn corners_from_each(&self, origins: &Origins, triangle: usize) -> [[Rays; 3]; 3] {
        let mut corners = [[[0.0; RAYS]; 3]; 3];
        for (number, corner) in corners.iter_mut().enumerate() {
            for (axis, coordinates) in corner.iter_mut().enumerate() {
                let coordinate = self.coordinate(number, axis, triangle);
                *coordinates = origins.each[axis].map(|origin| coordinate - origin);
            }
        }
        corners
    }
}

/// As [`super::block::rounding`], for each ray.
#[inline(always)]
fn rounding(a: &[Rays; 3], b: &[Rays; 3], c: &[Rays; 3]) -> Rays {
    let mut rounding = [0.0; RAYS];
    for (ray, rounding) in rounding.iter_mut().enumerate() {
        let mut distance = 0.0;
        let mut length = 0.0;
        for axis in 0..3 {
            let (a, b, c) = (a[axis][ray], b[axis][ray], c[axis][ray]);
            distance += a.abs();
            length += (b - a).abs() + (c - a).abs();
        }
        *rounding = 4.0 * f32::EPSILON * length * (distance + length);
    }
    rounding
}

/// A child that waits for its turn.
#[derive(Clone, Copy)]
pub(super) struct Waiting {
    child: Child,
    /// No ray enters it before [m].
    near_m: f32,
    /// Where its box is: its node times the children of a node plus its place there.
    place: u32,
}

/// The way of a bundle through a hierarchy, from leaf to leaf, near ones first.
pub(super) struct WideWalk<'a> {
    bvh: &'a WideBvh,
    /// In the frame of the hierarchy.
    origins: &'a Origins,
    waiting: &'a mut Vec<Waiting>,
}

impl<'a> WideWalk<'a> {
    /// `waiting` is memory to use.
    #[inline(always)]
    pub fn new(
        bundle: &Bundle,
        bvh: &'a WideBvh,
        origins: &'a Origins,
        waiting: &'a mut Vec<Waiting>,
    ) -> Self {
        waiting.clear();
        let mut walk = Self {
            bvh,
            origins,
            waiting,
        };
        if !bvh.nodes.is_empty() {
            walk.open(bundle, 0);
        }
        walk
    }

    /// The next leaf that a ray of the bundle may find something in, and which rays may.
    #[inline(always)]
    pub fn next_leaf(&mut self, bundle: &Bundle) -> Option<(usize, [bool; RAYS])> {
        while let Some(next) = self.waiting.pop() {
            if next.near_m > bundle.farthest_m * FARTHER {
                continue;
            }
            if !next.child.is_leaf() {
                self.open(bundle, next.child.index());
                continue;
            }
            let place = next.place as usize;
            let node = &self.bvh.nodes[place / CHILDREN];
            if let Some(is_entering) = bundle.enters(self.origins, node, place % CHILDREN) {
                return Some((next.child.index(), is_entering));
            }
        }
        None
    }

    /// Lets the children of a node wait, the nearest at the end.
    #[inline(always)]
    fn open(&mut self, bundle: &Bundle, index: usize) {
        let node = &self.bvh.nodes[index];
        let (near, mut entered) = bundle.enters_children(self.origins, node);
        let first = self.waiting.len();
        while entered != 0 {
            let child = entered.trailing_zeros() as usize / 8;
            entered &= entered - 1;
            let new = Waiting {
                child: node.children[child],
                near_m: near[child],
                place: (index * CHILDREN + child) as u32,
            };
            let mut place = self.waiting.len();
            self.waiting.push(new);
            while place > first && self.waiting[place - 1].near_m < new.near_m {
                self.waiting[place] = self.waiting[place - 1];
                place -= 1;
            }
            self.waiting[place] = new;
        }
    }
}

#[inline(always)]
fn least(numbers: Rays) -> f32 {
    numbers.into_iter().reduce(min).unwrap_or(f32::INFINITY)
}

#[inline(always)]
fn most(numbers: Rays) -> f32 {
    numbers.into_iter().reduce(max).unwrap_or(f32::NEG_INFINITY)
}
