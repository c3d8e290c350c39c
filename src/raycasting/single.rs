//! Single rays: eight boxes at once, then the triangles of a leaf at once.
//!
//! A packet enters the boxes of all its rays; where neighbouring rays diverge, a single ray enters
//! fewer. Its hits are those of a packet, bit by bit, unless it passes an edge within rounding.

use glam::{DVec3, Vec4};

use super::place::{Leaf, Place};
use super::traversal::{Slope, Traverse, enter, entry_and_exit, limited_inverse};
use super::triangle::{TRIANGLES, TriangleBlock, splat};
use super::wide::{BoxGrid, CHILDREN, WideNode};
use super::{NEAREST_M, Reach};
use crate::geometry::Vec3;
use crate::geometry::mesh::STEP_M;
use crate::simd::{Lanes, Simd};

/// A ray and its nearest hit so far.
#[derive(Clone, Copy)]
pub(super) struct SingleRay {
    origin: DVec3,
    direction: [f32; 3],
    /// Inverses of the coordinates of the direction [m per step].
    inverse: [f32; 3],
    /// Per axis, the bounds through which it enters and leaves a box.
    sides: [[usize; 2]; 3],
    /// Nearer hits are of no interest [m].
    from_m: f32,
    /// Farther hits are of no interest [m].
    until_m: f32,
    /// See [`Reach::enough_m`].
    enough_m: f32,
    /// Range of the nearest hit [m].
    pub range_m: f32,
    /// Where it is.
    pub place: Place,
}

impl SingleRay {
    #[inline(always)]
    pub fn new(origin: DVec3, direction: Vec3, reach: Reach) -> Self {
        let direction = direction.to_array();
        let inverse = direction.map(|coordinate| STEP_M * limited_inverse(coordinate));
        Self {
            origin,
            direction,
            inverse,
            sides: [0, 1, 2].map(|axis| entry_and_exit(axis, inverse[axis] < 0.0)),
            from_m: 0.0,
            until_m: reach.until_m,
            enough_m: reach.enough_m,
            range_m: f32::INFINITY,
            place: Place::NONE,
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
            Some((inside, steps)) => {
                let range_m = steps * STEP_M;
                let hits = inside
                    & range_m.lt(Vec4::splat(self.until_m))
                    & Vec4::splat(NEAREST_M).lt(range_m)
                    & Vec4::splat(self.from_m).le(range_m);
                (hits, range_m.to_array())
            }
            None => (0, [0.0; TRIANGLES]),
        }
    }
}

/// A single ray in the frame of a hierarchy.
pub(super) struct RelativeRay<L> {
    /// [steps]
    pub origin: Vec3,
    slope: Slope<L>,
}

impl<S: Simd> Traverse<S> for SingleRay {
    type Relative = RelativeRay<S::F32x8>;

    #[inline(always)]
    fn relative_to(&self, simd: S, middle: DVec3, grid: &BoxGrid) -> Self::Relative {
        let origin = (self.origin - middle).as_vec3() / STEP_M;
        let slope = Slope::new(simd, grid, origin, &self.inverse);
        RelativeRay { origin, slope }
    }

    #[inline(always)]
    fn enter(&self, simd: S, ray: &Self::Relative, node: &WideNode) -> (u32, [f32; CHILDREN]) {
        let range_m = [self.from_m, self.until_m];
        enter(simd, node, &self.sides, [&ray.slope, &ray.slope], range_m)
    }

    #[inline(always)]
    fn until_m(&self) -> f32 {
        self.until_m
    }

    /// Keeps the nearest hit if it is nearer than those before.
    #[inline(always)]
    fn intersect(&mut self, _: S, ray: &Self::Relative, block: &TriangleBlock, leaf: Leaf) {
        let (mut hits, range_m) = self.hits(ray.origin, block);
        while hits != 0 {
            let lane = hits.trailing_zeros() as usize % TRIANGLES;
            hits &= hits - 1;
            if range_m[lane] < self.until_m {
                let is_enough = range_m[lane] < self.enough_m;
                self.until_m = if is_enough { 0.0 } else { range_m[lane] };
                self.range_m = range_m[lane];
                self.place = Place::new(leaf, lane);
            }
        }
    }
}
