//! Packets: eight rays that traverse the hierarchy together.
//!
//! The rays of a packet are neighbouring beams from one origin, or the same beam from the origins
//! of poses that are close to each other (a *bundle*): neighbouring beams diverge with range, those
//! of a bundle do not.
//!
//! Wald, Slusallek, Benthin and Wagner, *Interactive Rendering with Coherent Ray Tracing*,
//! Eurographics 2001.

use glam::DVec3;

use super::simd::{Lanes, Simd};
use super::traversal::{FAR_TOLERANCE, Traverse, entry_and_exit, limited_inverse};
use super::triangle::{TRIANGLES, TriangleBlock, Triangles, Vectors, splat_lane};
use super::{NEAREST_M, NO_SLOT, RAYS, Reach};
use crate::geometry::Vec3;

/// Eight rays and their nearest hits so far.
pub(super) struct Packet<'a, S: Simd, O> {
    simd: S,
    origin: &'a O,
    direction: Vectors<S::F32x8>,
    inverse: Vectors<S::F32x8>,
    /// Farther hits are of no interest [m].
    until_m: [f32; RAYS],
    /// See [`Reach::enough_m`].
    enough_m: [f32; RAYS],
    /// Range of the nearest hit [m].
    pub range_m: [f32; RAYS],
    /// Slot of the triangle that was hit, or [`NO_SLOT`].
    pub slot: [u32; RAYS],
    /// Per axis, whether the first ray runs towards lower coordinates.
    backwards: [bool; 3],
    /// Whether all rays have the signs of the first one.
    pub is_coherent: bool,
}

impl<'a, S: Simd, O: Origin<S>> Packet<'a, S, O> {
    #[inline(always)]
    pub fn new(simd: S, origin: &'a O, directions: &[Vec3; RAYS], reaches: &[Reach; RAYS]) -> Self {
        let direction = per_axis(directions);
        let mut inverse = direction;
        for coordinate in inverse.as_flattened_mut() {
            *coordinate = limited_inverse(*coordinate);
        }
        let backwards = inverse.map(|axis| axis[0] < 0.0);
        let mut is_coherent = true;
        for axis in 0..3 {
            for inverse in inverse[axis] {
                is_coherent &= (inverse < 0.0) == backwards[axis];
            }
        }
        Self {
            simd,
            origin,
            direction: load(simd, direction),
            inverse: load(simd, inverse),
            until_m: reaches.map(|reach| reach.until_m),
            enough_m: reaches.map(|reach| reach.enough_m),
            range_m: [f32::INFINITY; RAYS],
            slot: [NO_SLOT; RAYS],
            backwards,
            is_coherent,
        }
    }

    /// Intersects one triangle, relative to the origins of the rays.
    #[inline(always)]
    fn intersect_triangle(&mut self, triangle: &Triangles<S::F32x8>, slot: u32) {
        let Some((inside, range_m)) = triangle.intersect(self.direction) else {
            return;
        };
        let mut hits = inside
            & range_m.lt(self.simd.load(self.until_m))
            & self.simd.splat(NEAREST_M).lt(range_m);
        let range_m = range_m.to_array();
        while hits != 0 {
            let ray = hits.trailing_zeros() as usize % RAYS;
            hits &= hits - 1;
            let is_enough = range_m[ray] < self.enough_m[ray];
            self.until_m[ray] = if is_enough { 0.0 } else { range_m[ray] };
            self.range_m[ray] = range_m[ray];
            self.slot[ray] = slot;
        }
    }
}

impl<S: Simd, O: Origin<S>> Traverse for Packet<'_, S, O> {
    type Origin = O::Relative;

    #[inline(always)]
    fn relative_to(&self, middle: DVec3) -> O::Relative {
        self.origin.relative_to(self.simd, middle)
    }

    #[inline(always)]
    fn enters<const COHERENT: bool>(&self, origin: O::Relative, bounds: &[f32; 6]) -> bool {
        let mut near = self.simd.splat(0.0);
        let mut far = self.simd.load(self.until_m);
        for axis in 0..3 {
            let [entry, exit] = entry_and_exit(axis, COHERENT && self.backwards[axis]);
            let a = O::offset(self.simd, origin, axis, bounds[entry]) * self.inverse[axis];
            let b = O::offset(self.simd, origin, axis, bounds[exit]) * self.inverse[axis];
            let (a, b) = if COHERENT {
                (a, b)
            } else {
                (a.min(b), a.max(b))
            };
            near = near.max(a);
            far = far.min(b);
        }
        near.le(far * FAR_TOLERANCE) != 0
    }

    #[inline(always)]
    fn is_backwards(&self, axis: usize) -> bool {
        self.backwards[axis]
    }

    #[inline(always)]
    fn intersect(&mut self, origin: O::Relative, block: &TriangleBlock, first_slot: u32) {
        O::intersect(self, origin, block, first_slot);
    }
}

/// One origin for all rays of a packet, or one for each.
pub(super) trait Origin<S: Simd> {
    /// In the frame of a hierarchy.
    type Relative: Copy;

    fn relative_to(&self, simd: S, middle: DVec3) -> Self::Relative;

    /// `coordinate − origin` along an axis, per ray.
    fn offset(simd: S, origin: Self::Relative, axis: usize, coordinate: f32) -> S::F32x8;

    /// See [`Traverse::intersect`].
    fn intersect(
        packet: &mut Packet<S, Self>,
        origin: Self::Relative,
        block: &TriangleBlock,
        first_slot: u32,
    ) where
        Self: Sized;
}

impl<S: Simd> Origin<S> for DVec3 {
    type Relative = Vec3;

    #[inline(always)]
    fn relative_to(&self, _: S, middle: DVec3) -> Vec3 {
        (*self - middle).as_vec3()
    }

    #[inline(always)]
    fn offset(simd: S, origin: Vec3, axis: usize, coordinate: f32) -> S::F32x8 {
        simd.splat(coordinate - origin[axis])
    }

    #[inline(always)]
    fn intersect(
        packet: &mut Packet<S, Self>,
        origin: Vec3,
        block: &TriangleBlock,
        first_slot: u32,
    ) {
        let triangles = block.relative_to(origin);
        for lane in (0..TRIANGLES).take_while(|&lane| block.has(lane)) {
            let triangle = triangles.splat(packet.simd, lane);
            packet.intersect_triangle(&triangle, first_slot + lane as u32);
        }
    }
}

impl<S: Simd> Origin<S> for [DVec3; RAYS] {
    type Relative = Vectors<S::F32x8>;

    #[inline(always)]
    fn relative_to(&self, simd: S, middle: DVec3) -> Self::Relative {
        let relative = std::array::from_fn(|ray| (self[ray] - middle).as_vec3());
        load(simd, per_axis(&relative))
    }

    #[inline(always)]
    fn offset(simd: S, origin: Self::Relative, axis: usize, coordinate: f32) -> S::F32x8 {
        simd.splat(coordinate) - origin[axis]
    }

    #[inline(always)]
    fn intersect(
        packet: &mut Packet<S, Self>,
        origin: Self::Relative,
        block: &TriangleBlock,
        first_slot: u32,
    ) {
        for lane in (0..TRIANGLES).take_while(|&lane| block.has(lane)) {
            let corners = splat_lane(packet.simd, block.corners, lane);
            let triangle = Triangles::new(corners, origin);
            packet.intersect_triangle(&triangle, first_slot + lane as u32);
        }
    }
}

/// Coordinates of vectors, axis by axis.
#[inline(always)]
fn per_axis(vectors: &[Vec3; RAYS]) -> [[f32; RAYS]; 3] {
    std::array::from_fn(|axis| std::array::from_fn(|ray| vectors[ray][axis]))
}

#[inline(always)]
fn load<S: Simd>(simd: S, [x, y, z]: [[f32; RAYS]; 3]) -> Vectors<S::F32x8> {
    [simd.load(x), simd.load(y), simd.load(z)]
}
