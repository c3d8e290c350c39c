//! Where rays meet triangles, several pairs of them at once.
//!
//! With the corners A, B, C of a triangle relative to the origin of a ray, a direction d passes it
//! on one side of all three edges where
//!
//! ```text
//! d · ((P + Q) × (Q − P))      PQ ∈ {AB, BC, CA}
//! ```
//!
//! have one sign. The sums and products are those of [`super::packet`], and so are the bits of what
//! is met, unless the ray passes an edge within rounding.

use super::lanes::Lanes;

/// A vector per lane.
pub(super) type Vectors<L> = [L; 3];

/// One vector for all lanes.
#[inline(always)]
pub(super) fn spread<const N: usize, L: Lanes<N>>([x, y, z]: [f32; 3]) -> Vectors<L> {
    [L::splat(x), L::splat(y), L::splat(z)]
}

#[inline(always)]
pub(super) fn minus<const N: usize, L: Lanes<N>>(p: Vectors<L>, q: Vectors<L>) -> Vectors<L> {
    [p[0].minus(q[0]), p[1].minus(q[1]), p[2].minus(q[2])]
}

/// The lanes in which the ray meets the triangle, a bit each, and the ranges there [m]; `None`
/// where there are none. Corners are relative to the origin of the ray.
#[inline(always)]
pub(super) fn meet<const N: usize, L: Lanes<N>>(
    direction: Vectors<L>,
    [a, b, c]: [Vectors<L>; 3],
) -> Option<(u32, L)> {
    let w = dot(direction, edge(a, b));
    let u = dot(direction, edge(b, c));
    let v = dot(direction, edge(c, a));
    let rounding = rounding(a, b, c);
    let least = u.or_less(v).or_less(w);
    let most = u.or_more(v).or_more(w);
    let inside = L::splat(0.0).minus(rounding).at_most(least) | most.at_most(rounding);
    if inside == 0 {
        return None;
    }
    // Each side weighs the corner that lies opposite.
    let (a, b, c) = (dot(direction, a), dot(direction, b), dot(direction, c));
    let range_m = u.times(a).plus(v.times(b)).plus(w.times(c));
    let range_m = range_m.over(u.plus(v).plus(w));
    // Seen edge-on, the quotient may be anything.
    let range_m = a.or_less(b).or_less(c).or_more(range_m);
    Some((inside, a.or_more(b).or_more(c).or_less(range_m)))
}

/// As [`super::block::edge`].
#[inline(always)]
fn edge<const N: usize, L: Lanes<N>>(p: Vectors<L>, q: Vectors<L>) -> Vectors<L> {
    let sum = [p[0].plus(q[0]), p[1].plus(q[1]), p[2].plus(q[2])];
    cross(sum, minus(q, p))
}

#[inline(always)]
fn cross<const N: usize, L: Lanes<N>>(p: Vectors<L>, q: Vectors<L>) -> Vectors<L> {
    [
        p[1].times(q[2]).minus(p[2].times(q[1])),
        p[2].times(q[0]).minus(p[0].times(q[2])),
        p[0].times(q[1]).minus(p[1].times(q[0])),
    ]
}

#[inline(always)]
fn dot<const N: usize, L: Lanes<N>>(p: Vectors<L>, q: Vectors<L>) -> L {
    (p[0].times(q[0]).plus(p[1].times(q[1]))).plus(p[2].times(q[2]))
}

/// As [`super::block::rounding`].
#[inline(always)]
fn rounding<const N: usize, L: Lanes<N>>(a: Vectors<L>, b: Vectors<L>, c: Vectors<L>) -> L {
    let (to_b, to_c) = (minus(b, a), minus(c, a));
    let mut distance = L::splat(0.0);
    let mut length = L::splat(0.0);
    for axis in 0..3 {
        distance = distance.plus(a[axis].magnitude());
        length = length.plus(to_b[axis].magnitude().plus(to_c[axis].magnitude()));
    }
    let scale = L::splat(4.0 * f32::EPSILON);
    scale.times(length).times(distance.plus(length))
}
