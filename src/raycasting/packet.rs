//! Packets: sixteen rays that traverse the hierarchy together.
//!
//! The rays of a packet are neighbouring beams from one origin, or the same beam from the origins
//! of poses that are close to each other (a *bundle*): neighbouring beams diverge with range, those
//! of a bundle do not. Their directions have the same signs.
//!
//! The intervals of their origins and directions are tested against the boxes of all children of a
//! node at once, the rays themselves only against those boxes that are left. Wald, Slusallek,
//! Benthin and Wagner, *Interactive Rendering with Coherent Ray Tracing*, Eurographics 2001, for
//! packets; Boulos, Wald and Shirley, *Geometric and Arithmetic Culling Methods for Entire Ray
//! Packets*, 2006, for intervals.

use glam::DVec3;

use super::place::{Leaf, Place};
use super::traversal::{FAR_TOLERANCE, Slope, Traverse, enter, entry_and_exit, limited_inverse};
use super::triangle::{TRIANGLES, TriangleBlock, Triangles, Vectors, splat_lane};
use super::wide::{BoxGrid, CHILDREN, WideNode};
use super::{NEAREST_M, RAYS, Reach};
use crate::geometry::Vec3;
use crate::geometry::mesh::STEP_M;
use crate::simd::{Lanes, Simd};

/// Sixteen rays and their nearest hits so far.
pub(super) struct Packet<'a, S: Simd, O> {
    origin: &'a O,
    direction: Vectors<S::F32x16>,
    /// Inverses of the coordinates of the directions [m per step].
    inverse: Vectors<S::F32x16>,
    /// The inverses of least and of largest magnitude per axis.
    least_and_largest: [[f32; 3]; 2],
    /// Per axis, the bounds through which the rays enter and leave a box.
    sides: [[usize; 2]; 3],
    /// Farther hits are of no interest [m].
    until_m: [f32; RAYS],
    /// The largest of them.
    farthest_m: f32,
    /// See [`Reach::enough_m`].
    enough_m: [f32; RAYS],
    /// Range of the nearest hit [m].
    pub range_m: [f32; RAYS],
    /// Where it is.
    pub place: [Place; RAYS],
}

impl<'a, S: Simd, O: Origin<S>> Packet<'a, S, O> {
    /// `None` if the directions differ in a sign.
    #[inline(always)]
    pub fn new(
        simd: S,
        origin: &'a O,
        directions: &[Vec3; RAYS],
        reaches: &[Reach; RAYS],
    ) -> Option<Self> {
        let direction = per_axis(directions);
        let mut inverse = direction;
        for coordinate in inverse.as_flattened_mut() {
            *coordinate = STEP_M * limited_inverse(*coordinate);
        }
        let mut sides = [[0; 2]; 3];
        let mut least_and_largest = [[0.0; 3]; 2];
        for axis in 0..3 {
            let (mut min, mut max) = (inverse[axis][0], inverse[axis][0]);
            for &inverse in &inverse[axis][1..] {
                min = if inverse < min { inverse } else { min };
                max = if inverse > max { inverse } else { max };
            }
            if min < 0.0 && max >= 0.0 {
                return None;
            }
            let is_backwards = max < 0.0;
            sides[axis] = entry_and_exit(axis, is_backwards);
            let (least, largest) = if is_backwards { (max, min) } else { (min, max) };
            least_and_largest[0][axis] = least;
            least_and_largest[1][axis] = largest;
        }
        let until_m = reaches.map(|reach| reach.until_m);
        Some(Self {
            origin,
            direction: load(simd, direction),
            inverse: load(simd, inverse),
            least_and_largest,
            sides,
            until_m,
            farthest_m: largest(&until_m),
            enough_m: reaches.map(|reach| reach.enough_m),
            range_m: [f32::INFINITY; RAYS],
            place: [Place::NONE; RAYS],
        })
    }

    /// Whether any ray enters a box before its nearest hit.
    #[inline(always)]
    fn enters(&self, simd: S, origin: O::Relative, bounds: &[f32; 6]) -> bool {
        let mut near = simd.splat_wide(0.0);
        let mut far = simd.load_wide(self.until_m);
        for axis in 0..3 {
            let [entry, exit] = self.sides[axis];
            let entry = O::offset(simd, origin, axis, bounds[entry]);
            let exit = O::offset(simd, origin, axis, bounds[exit]);
            near = near.max(entry * self.inverse[axis]);
            far = far.min(exit * self.inverse[axis]);
        }
        near.le(far * FAR_TOLERANCE) != 0
    }

    /// Intersects one triangle, relative to the origins of the rays.
    #[inline(always)]
    fn intersect_triangle(&mut self, simd: S, triangle: &Triangles<S::F32x16>, place: Place) {
        let Some((inside, steps)) = triangle.intersect(self.direction) else {
            return;
        };
        let range_m = steps * STEP_M;
        let mut hits = inside
            & range_m.lt(simd.load_wide(self.until_m))
            & simd.splat_wide(NEAREST_M).lt(range_m);
        if hits == 0 {
            return;
        }
        let range_m = range_m.to_array();
        while hits != 0 {
            let ray = hits.trailing_zeros() as usize % RAYS;
            hits &= hits - 1;
            let is_enough = range_m[ray] < self.enough_m[ray];
            self.until_m[ray] = if is_enough { 0.0 } else { range_m[ray] };
            self.range_m[ray] = range_m[ray];
            self.place[ray] = place;
        }
        self.farthest_m = largest(&self.until_m);
    }
}

#[inline(always)]
fn largest(ranges_m: &[f32; RAYS]) -> f32 {
    let mut largest_m = ranges_m[0];
    for &range_m in &ranges_m[1..] {
        largest_m = if range_m > largest_m {
            range_m
        } else {
            largest_m
        };
    }
    largest_m
}

/// The rays of a packet in the frame of a hierarchy.
pub(super) struct RelativePacket<L, R> {
    origin: R,
    grid: BoxGrid,
    /// Slopes of the ray that enters a box first, whichever it is, and of the one that leaves it last.
    slopes: [Slope<L>; 2],
}

impl<S: Simd, O: Origin<S>> Traverse<S> for Packet<'_, S, O> {
    type Relative = RelativePacket<S::F32x8, O::Relative>;

    #[inline(always)]
    fn relative_to(&self, simd: S, middle: DVec3, grid: &BoxGrid) -> Self::Relative {
        let origin = self.origin.relative_to(simd, middle);
        let [low, high] = O::interval(origin);
        let [mut nearest, mut farthest] = [high, low];
        for axis in 0..3 {
            // A box is entered soonest from the origin that is nearest to it.
            if self.sides[axis][0] > axis {
                std::mem::swap(&mut nearest[axis], &mut farthest[axis]);
            }
        }
        let [least, largest] = &self.least_and_largest;
        RelativePacket {
            origin,
            grid: *grid,
            slopes: [
                Slope::new(simd, grid, nearest, least),
                Slope::new(simd, grid, farthest, largest),
            ],
        }
    }

    #[inline(always)]
    fn enter(&self, simd: S, rays: &Self::Relative, node: &WideNode) -> (u32, [f32; CHILDREN]) {
        let [entry, exit] = &rays.slopes;
        let range_m = [0.0, self.farthest_m];
        let (mut left, near_m) = enter(simd, node, &self.sides, [entry, exit], range_m);
        let mut entered = left;
        while left != 0 {
            let place = left.trailing_zeros() as usize % CHILDREN;
            left &= left - 1;
            if !self.enters(simd, rays.origin, &rays.grid.bounds_of(node, place)) {
                entered &= !(1 << place);
            }
        }
        (entered, near_m)
    }

    #[inline(always)]
    fn until_m(&self) -> f32 {
        self.farthest_m
    }

    #[inline(always)]
    fn intersect(&mut self, simd: S, rays: &Self::Relative, block: &TriangleBlock, leaf: Leaf) {
        O::intersect(self, simd, rays.origin, block, leaf);
    }
}

/// One origin for all rays of a packet, or one for each.
pub(super) trait Origin<S: Simd> {
    /// In the frame of a hierarchy [steps].
    type Relative: Copy;

    /// The origin of a ray.
    fn of_ray(&self, ray: usize) -> DVec3;

    fn relative_to(&self, simd: S, middle: DVec3) -> Self::Relative;

    /// The least and the largest coordinates of the origins.
    fn interval(origin: Self::Relative) -> [Vec3; 2];

    /// `coordinate − origin` along an axis, per ray.
    fn offset(simd: S, origin: Self::Relative, axis: usize, coordinate: f32) -> S::F32x16;

    /// See [`Traverse::intersect`].
    fn intersect(
        packet: &mut Packet<S, Self>,
        simd: S,
        origin: Self::Relative,
        block: &TriangleBlock,
        leaf: Leaf,
    ) where
        Self: Sized;
}

impl<S: Simd> Origin<S> for DVec3 {
    type Relative = Vec3;

    #[inline(always)]
    fn of_ray(&self, _: usize) -> DVec3 {
        *self
    }

    #[inline(always)]
    fn relative_to(&self, _: S, middle: DVec3) -> Vec3 {
        (*self - middle).as_vec3() / STEP_M
    }

    #[inline(always)]
    fn interval(origin: Vec3) -> [Vec3; 2] {
        [origin, origin]
    }

    #[inline(always)]
    fn offset(simd: S, origin: Vec3, axis: usize, coordinate: f32) -> S::F32x16 {
        simd.splat_wide(coordinate - origin[axis])
    }

    #[inline(always)]
    fn intersect(
        packet: &mut Packet<S, Self>,
        simd: S,
        origin: Vec3,
        block: &TriangleBlock,
        leaf: Leaf,
    ) {
        let triangles = block.relative_to(origin);
        for lane in 0..block.count.min(TRIANGLES) {
            let triangle = triangles.splat(simd, lane);
            packet.intersect_triangle(simd, &triangle, Place::new(leaf, lane));
        }
    }
}

/// Origins of the rays of a bundle in the frame of a hierarchy [steps].
#[derive(Clone, Copy)]
pub(super) struct Origins<L> {
    of_rays: Vectors<L>,
    interval: [Vec3; 2],
}

impl<S: Simd> Origin<S> for [DVec3; RAYS] {
    type Relative = Origins<S::F32x16>;

    #[inline(always)]
    fn of_ray(&self, ray: usize) -> DVec3 {
        self[ray]
    }

    #[inline(always)]
    fn relative_to(&self, simd: S, middle: DVec3) -> Self::Relative {
        let relative: [Vec3; RAYS] =
            std::array::from_fn(|ray| (self[ray] - middle).as_vec3() / STEP_M);
        let (mut low, mut high) = (relative[0], relative[0]);
        for origin in &relative[1..] {
            low = low.min(*origin);
            high = high.max(*origin);
        }
        Origins {
            of_rays: load(simd, per_axis(&relative)),
            interval: [low, high],
        }
    }

    #[inline(always)]
    fn interval(origin: Self::Relative) -> [Vec3; 2] {
        origin.interval
    }

    #[inline(always)]
    fn offset(simd: S, origin: Self::Relative, axis: usize, coordinate: f32) -> S::F32x16 {
        simd.splat_wide(coordinate) - origin.of_rays[axis]
    }

    #[inline(always)]
    fn intersect(
        packet: &mut Packet<S, Self>,
        simd: S,
        origin: Self::Relative,
        block: &TriangleBlock,
        leaf: Leaf,
    ) {
        for lane in 0..block.count.min(TRIANGLES) {
            let corners = splat_lane(simd, block.corners, lane);
            let triangle = Triangles::new(corners, origin.of_rays);
            packet.intersect_triangle(simd, &triangle, Place::new(leaf, lane));
        }
    }
}

/// Coordinates of vectors, axis by axis.
#[inline(always)]
fn per_axis(vectors: &[Vec3; RAYS]) -> [[f32; RAYS]; 3] {
    std::array::from_fn(|axis| std::array::from_fn(|ray| vectors[ray][axis]))
}

#[inline(always)]
fn load<S: Simd>(simd: S, [x, y, z]: [[f32; RAYS]; 3]) -> Vectors<S::F32x16> {
    [simd.load_wide(x), simd.load_wide(y), simd.load_wide(z)]
}
