//! Eight rays of one course go through the hierarchy together, each from an origin of its own: the
//! same beam as it is cast from poses that are close to each other.
//!
//! Where a packet opens the boxes of neighbouring beams, which part with range, a bundle opens those
//! of one beam. The sums and products are those of a lone ray.

use super::block::{Block, TRIANGLES};
use super::lanes::Lanes;
use super::packet::{FARTHER, RAYS, Rays, Together, inverse_of};
use super::triangle::{Vectors, meet, minus, spread};
use super::{NEAREST_M, Reach};
use crate::geometry::Vec3;

/// Directions of a bundle and what its rays met so far.
pub(super) struct Bundle<L> {
    direction: Vectors<L>,
    inverse: Vectors<L>,
    /// How far there is still something to find [m].
    until_m: Rays,
    /// See [`Reach::enough_m`].
    enough_m: f32,
    /// The nearest hit so far [m].
    pub range_m: Rays,
    /// Per axis, whether the first ray runs downwards.
    backwards: [bool; 3],
    /// Whether all rays run like the first.
    pub is_coherent: bool,
}

impl<L: Lanes<RAYS>> Bundle<L> {
    #[inline(always)]
    pub fn new(directions: &[Vec3; RAYS], reach: Reach) -> Self {
        let direction: [Rays; 3] = per_axis(directions);
        let inverse = direction.map(inverse_of);
        let backwards = inverse.map(|axis| axis[0] < 0.0);
        let mut is_coherent = true;
        for axis in 0..3 {
            for inverse in inverse[axis] {
                is_coherent &= (inverse < 0.0) == backwards[axis];
            }
        }
        Self {
            direction: direction.map(|axis| L::load(&axis)),
            inverse: inverse.map(|axis| L::load(&axis)),
            until_m: [reach.until_m; RAYS],
            enough_m: reach.enough_m,
            range_m: [f32::INFINITY; RAYS],
            backwards,
            is_coherent,
        }
    }

    /// Takes the hits of a block that are nearer than what was known.
    #[inline(always)]
    pub fn meet(&mut self, origin: Vectors<L>, block: &Block) {
        for triangle in 0..TRIANGLES {
            if !block.has(triangle) {
                break;
            }
            let corners = block
                .corners()
                .map(|corner| minus(spread(corner.map(|axis| axis[triangle])), origin));
            let Some((mut inside, range_m)) = meet(self.direction, corners) else {
                continue;
            };
            let range_m = range_m.to_array();
            while inside != 0 {
                let ray = inside.trailing_zeros() as usize % RAYS;
                inside &= inside - 1;
                let range_m = range_m[ray];
                if range_m < self.until_m[ray] && range_m > NEAREST_M {
                    self.range_m[ray] = range_m;
                    self.until_m[ray] = if range_m < self.enough_m {
                        0.0
                    } else {
                        range_m
                    };
                }
            }
        }
    }
}

impl<L: Lanes<RAYS>> Together for Bundle<L> {
    type Origin = Vectors<L>;

    #[inline(always)]
    fn enters<const COHERENT: bool>(&self, origin: Vectors<L>, bounds: &[f32; 6]) -> bool {
        let mut near = L::splat(0.0);
        let mut far = L::load(&self.until_m);
        for (axis, (&origin, &inverse)) in origin.iter().zip(&self.inverse).enumerate() {
            // Where all rays run alike, the side that they come in through is known.
            let is_swapped = COHERENT && self.backwards[axis];
            let (first, second) = if is_swapped {
                (axis + 3, axis)
            } else {
                (axis, axis + 3)
            };
            let a = L::splat(bounds[first]).minus(origin).times(inverse);
            let b = L::splat(bounds[second]).minus(origin).times(inverse);
            let (a, b) = if COHERENT {
                (a, b)
            } else {
                (a.or_less(b), a.or_more(b))
            };
            near = near.or_more(a);
            far = far.or_less(b);
        }
        near.at_most(far.times(L::splat(FARTHER))) != 0
    }

    #[inline(always)]
    fn is_backwards(&self, axis: u32) -> bool {
        self.backwards[axis as usize]
    }
}

/// Coordinates of vectors, axis by axis.
#[inline(always)]
pub(super) fn per_axis(vectors: &[Vec3; RAYS]) -> [Rays; 3] {
    std::array::from_fn(|axis| std::array::from_fn(|ray| vectors[ray][axis]))
}
