//! Where rays intersect triangles, in several lanes at once.
//!
//! With the corners A, B, C of a triangle relative to the origin of a ray, a direction d passes
//! all three edges on the same side where the edge functions
//!
//! ```text
//! d · ((P + Q) × (Q − P))      PQ ∈ {AB, BC, CA}
//! ```
//!
//! have one sign. Seen from the neighbouring triangle, an edge gives exactly the negative number,
//! so that no ray slips between two triangles; where rounding decides, both are hit, so that none
//! slips through a corner either. After Davidovič, Engelhardt, Georgiev, Slusallek and Dachsbacher,
//! *3D Rasterization: A Bridge between Rasterization and Ray Casting*, GI 2012.

use glam::Vec4;

use crate::geometry::Vec3;
use crate::simd::{Lanes, Simd};

/// Triangles per block.
pub(super) const TRIANGLES: usize = 4;

/// A triangle is degenerate if its height is less than this part of its longest edge.
const THINNEST: f64 = 1e-7;

/// A vector per lane, axis by axis.
pub(super) type Vectors<L> = [L; 3];

/// Whether a triangle has finite corners and an area.
pub(crate) fn is_proper(corners: [Vec3; 3]) -> bool {
    let [a, b, c] = corners.map(|corner| corner.as_dvec3());
    let longest_squared = (b - a)
        .length_squared()
        .max((c - b).length_squared())
        .max((a - c).length_squared());
    let twice_area = (b - a).cross(c - a).length();
    twice_area.is_finite() && twice_area > THINNEST * longest_squared
}

/// The triangles of a leaf in lanes.
#[derive(Clone, Copy, Debug)]
pub(super) struct TriangleBlock {
    /// Corners A, B, C; those of the last triangle in empty lanes.
    pub corners: [Vectors<Vec4>; 3],
    /// Number of triangles.
    pub count: usize,
}

impl TriangleBlock {
    /// The unit normal of a triangle by the right-hand rule.
    pub fn normal(&self, lane: usize) -> Vec3 {
        let [a, b, c] = self
            .corners
            .map(|corner| Vec3::from_array(corner.map(|axis| axis[lane])).as_dvec3());
        (b - a).cross(c - a).normalize().as_vec3()
    }

    /// The triangles relative to an origin.
    #[inline(always)]
    pub fn relative_to(&self, origin: Vec3) -> Triangles<Vec4> {
        let origin = [origin.x, origin.y, origin.z];
        Triangles::new(self.corners, splat(origin, Vec4::splat))
    }
}

/// A triangle per lane, prepared for intersection with rays from the origin.
pub(super) struct Triangles<L> {
    corners: [Vectors<L>; 3],
    /// (P + Q) × (Q − P) of the edges AB, BC, CA.
    edges: [Vectors<L>; 3],
    /// Bound of the rounding error of an edge function.
    tolerance: L,
}

impl<L: Lanes> Triangles<L> {
    /// Prepares triangles for intersection with rays from an origin per lane.
    #[inline(always)]
    pub fn new([a, b, c]: [Vectors<L>; 3], origin: Vectors<L>) -> Self {
        let (a, b, c) = (
            subtract(a, origin),
            subtract(b, origin),
            subtract(c, origin),
        );
        Self {
            corners: [a, b, c],
            edges: [edge(a, b), edge(b, c), edge(c, a)],
            tolerance: tolerance(a, b, c),
        }
    }

    /// Bit mask of the lanes in which the ray passes inside all edges, and the ranges of the
    /// triangle planes there [m]; `None` if the mask is empty.
    #[inline(always)]
    pub fn intersect(&self, direction: Vectors<L>) -> Option<(u32, L)> {
        let w = dot(direction, self.edges[0]);
        let u = dot(direction, self.edges[1]);
        let v = dot(direction, self.edges[2]);
        let inside =
            (self.tolerance * -1.0).le(u.min(v).min(w)) | u.max(v).max(w).le(self.tolerance);
        if inside == 0 {
            return None;
        }
        // Each edge function weights the opposite corner.
        let [a, b, c] = self.corners;
        let (a, b, c) = (dot(direction, a), dot(direction, b), dot(direction, c));
        let range_m = (u * a + v * b + w * c) / (u + v + w);
        // Seen edge-on, the quotient may be anything.
        let range_m = a.min(b).min(c).max(range_m);
        Some((inside, a.max(b).max(c).min(range_m)))
    }
}

impl Triangles<Vec4> {
    /// The triangle of one lane in all lanes.
    #[inline(always)]
    pub fn splat<S: Simd>(&self, simd: S, lane: usize) -> Triangles<S::F32x16> {
        Triangles {
            corners: splat_lane(simd, self.corners, lane),
            edges: splat_lane(simd, self.edges, lane),
            tolerance: simd.splat_wide(self.tolerance[lane]),
        }
    }
}

// Not `map`: the compiler does not inline that of arrays of registers.

/// A vector in all lanes.
#[inline(always)]
pub(super) fn splat<L>([x, y, z]: [f32; 3], splat: impl Fn(f32) -> L) -> Vectors<L> {
    [splat(x), splat(y), splat(z)]
}

/// Three vectors of one lane in all lanes.
#[inline(always)]
pub(super) fn splat_lane<S: Simd>(
    simd: S,
    [a, b, c]: [Vectors<Vec4>; 3],
    lane: usize,
) -> [Vectors<S::F32x16>; 3] {
    let of_lane = |v: Vectors<Vec4>| [v[0][lane], v[1][lane], v[2][lane]];
    let splat_one = |v: Vectors<Vec4>| splat(of_lane(v), |number| simd.splat_wide(number));
    [splat_one(a), splat_one(b), splat_one(c)]
}

#[inline(always)]
fn subtract<L: Lanes>(p: Vectors<L>, q: Vectors<L>) -> Vectors<L> {
    [p[0] - q[0], p[1] - q[1], p[2] - q[2]]
}

#[inline(always)]
fn dot<L: Lanes>(p: Vectors<L>, q: Vectors<L>) -> L {
    p[0] * q[0] + p[1] * q[1] + p[2] * q[2]
}

#[inline(always)]
fn edge<L: Lanes>(p: Vectors<L>, q: Vectors<L>) -> Vectors<L> {
    let sum = [p[0] + q[0], p[1] + q[1], p[2] + q[2]];
    let difference = subtract(q, p);
    [
        sum[1] * difference[2] - sum[2] * difference[1],
        sum[2] * difference[0] - sum[0] * difference[2],
        sum[0] * difference[1] - sum[1] * difference[0],
    ]
}

#[inline(always)]
fn tolerance<L: Lanes>(a: Vectors<L>, b: Vectors<L>, c: Vectors<L>) -> L {
    let distance = a[0].abs() + a[1].abs() + a[2].abs();
    let (to_b, to_c) = (subtract(b, a), subtract(c, a));
    let both = |axis: usize| to_b[axis].abs() + to_c[axis].abs();
    let length = both(0) + both(1) + both(2);
    length * (4.0 * f32::EPSILON) * (distance + length)
}
