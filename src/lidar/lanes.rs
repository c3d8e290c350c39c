//! Vectors and least-squares planes of several points at once, in loops that the compiler vectorizes.
//!
//! The smallest eigenvalue of a covariance C is the smallest root of its characteristic polynomial
//!
//! ```text
//! p(λ) = λ³ − c₂ λ² + c₁ λ − c₀        c₂ = tr C,  c₁ = Σ principal minors,  c₀ = det C
//! ```
//!
//! which Newton's method from 0 approaches from below, since p is concave up to there.

use crate::simd::WIDE;

/// Points that are processed together.
pub(super) const LANES: usize = WIDE;
/// A number of each of them.
pub(super) type Lanes = [f32; LANES];

/// Numbers by lane.
#[inline(always)]
pub(super) fn lanes<T>(number: impl FnMut(usize) -> T) -> [T; LANES] {
    std::array::from_fn(number)
}

/// Scalar product of the vectors of a lane.
#[inline(always)]
pub(super) fn dot(a: &[Lanes; 3], b: &[Lanes; 3], lane: usize) -> f32 {
    a[0][lane] * b[0][lane] + a[1][lane] * b[1][lane] + a[2][lane] * b[2][lane]
}

/// Unit vectors along the vector products; NaN where these are zero.
#[inline(always)]
pub(super) fn unit_cross(a: &[Lanes; 3], b: &[Lanes; 3]) -> [Lanes; 3] {
    let mut cross = [[0.0; LANES]; 3];
    for lane in 0..LANES {
        let part = |i: usize, j: usize| a[i][lane] * b[j][lane] - a[j][lane] * b[i][lane];
        let [x, y, z] = [part(1, 2), part(2, 0), part(0, 1)];
        let length = (x * x + y * y + z * z).sqrt();
        cross[0][lane] = x / length;
        cross[1][lane] = y / length;
        cross[2][lane] = z / length;
    }
    cross
}

/// First and second moments of points near the origin, by lane.
pub(super) struct PlaneSumsOfLanes {
    /// Number of points.
    pub count: Lanes,
    first: [Lanes; 3],
    /// xx, yy, zz, xy, xz, yz.
    second: [Lanes; 6],
}

/// Least-squares planes, by lane.
pub(super) struct PlanesOfLanes {
    /// Unit normals of arbitrary sign; NaN where the points are collinear.
    pub normals: [Lanes; 3],
    /// Variance along the normal [m²].
    pub smallest: Lanes,
    /// Variance along the narrow side of the points [m²].
    pub middle: Lanes,
}

/// Axes of the entries of a symmetric matrix.
const ENTRIES: [[usize; 2]; 6] = [[0, 0], [1, 1], [2, 2], [0, 1], [0, 2], [1, 2]];

impl PlaneSumsOfLanes {
    /// Sums of one point, the origin.
    #[inline(always)]
    pub fn of_origin() -> Self {
        Self {
            count: [1.0; LANES],
            first: [[0.0; LANES]; 3],
            second: [[0.0; LANES]; 6],
        }
    }

    /// Adds a point per lane, which is the origin where its weight is 0, and whose weight is else 1.
    #[inline(always)]
    pub fn add(&mut self, weight: &Lanes, point: &[Lanes; 3]) {
        for (count, weight) in self.count.iter_mut().zip(weight) {
            *count += weight;
        }
        for (first, point) in self.first.iter_mut().zip(point) {
            for lane in 0..LANES {
                first[lane] += point[lane];
            }
        }
        for (second, [i, j]) in self.second.iter_mut().zip(ENTRIES) {
            for lane in 0..LANES {
                second[lane] += point[i][lane] * point[j][lane];
            }
        }
    }

    /// The least-squares planes.
    #[inline(always)]
    pub fn fit(&self) -> PlanesOfLanes {
        /// Share of the variances below which the two smaller ones are equal to the accuracy of the sums (unitless).
        const COLLINEAR: f64 = 1e-6;
        let mut covariance = [[0.0_f64; LANES]; 6];
        for ((covariance, second), [i, j]) in covariance.iter_mut().zip(&self.second).zip(ENTRIES) {
            for (lane, covariance) in covariance.iter_mut().enumerate() {
                let per_count = 1.0 / f64::from(self.count[lane]);
                let mean = |axis: usize| f64::from(self.first[axis][lane]) * per_count;
                *covariance = f64::from(second[lane]) * per_count - mean(i) * mean(j);
            }
        }
        let (smallest, middle) = smaller_eigenvalues(&covariance);
        let mut normals = eigenvectors(&covariance, &smallest);
        for lane in 0..LANES {
            let trace = covariance[0][lane] + covariance[1][lane] + covariance[2][lane];
            let is_plane = middle[lane] - smallest[lane] > COLLINEAR * trace;
            for axis in &mut normals {
                axis[lane] = if is_plane { axis[lane] } else { f32::NAN };
            }
        }
        PlanesOfLanes {
            normals,
            smallest: smallest.map(|variance| variance as f32),
            middle: middle.map(|variance| variance as f32),
        }
    }
}

/// The two smaller eigenvalues of covariances.
#[inline(always)]
fn smaller_eigenvalues(covariance: &[[f64; LANES]; 6]) -> ([f64; LANES], [f64; LANES]) {
    /// They converge quadratically, unless the two smaller eigenvalues are nearly equal, where the points have no plane.
    const STEPS: usize = 8;
    let [xx, yy, zz, xy, xz, yz] = covariance;
    let (mut smallest, mut middle) = ([0.0; LANES], [0.0; LANES]);
    for lane in 0..LANES {
        let [xx, yy, zz] = [xx[lane], yy[lane], zz[lane]];
        let [xy, xz, yz] = [xy[lane], xz[lane], yz[lane]];
        let trace = xx + yy + zz;
        let minors = (xx * yy - xy * xy) + (xx * zz - xz * xz) + (yy * zz - yz * yz);
        let determinant =
            xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
        let mut root = 0.0;
        for _ in 0..STEPS {
            let value = ((root - trace) * root + minors) * root - determinant;
            let slope = (3.0 * root - 2.0 * trace) * root + minors;
            root -= value / slope;
        }
        // The others are the roots of λ² − sum λ + product.
        let (sum, product) = (trace - root, minors - root * (trace - root));
        let half_difference = (0.25 * sum * sum - product).max(0.0).sqrt();
        smallest[lane] = root;
        middle[lane] = product / (0.5 * sum + half_difference);
    }
    (smallest, middle)
}

/// Unit eigenvectors of eigenvalues; NaN where they are not unique.
#[inline(always)]
fn eigenvectors(covariance: &[[f64; LANES]; 6], values: &[f64; LANES]) -> [Lanes; 3] {
    let [xx, yy, zz, xy, xz, yz] = covariance;
    let mut vectors = [[0.0; LANES]; 3];
    for lane in 0..LANES {
        let value = values[lane];
        let [xx, yy, zz] = [xx[lane] - value, yy[lane] - value, zz[lane] - value];
        let [xy, xz, yz] = [xy[lane], xz[lane], yz[lane]];
        // Products of the rows of the matrix, which are all along the eigenvector; the longest is the most accurate.
        let first = [xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy];
        let second = [yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz];
        let third = [yz * xz - zz * xy, zz * xx - xz * xz, xz * xy - yz * xx];
        let squared = |v: &[f64; 3]| v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
        let longer = |a: [f64; 3], b: [f64; 3]| {
            let is_longer = squared(&b) > squared(&a);
            [0, 1, 2].map(|axis| if is_longer { b[axis] } else { a[axis] })
        };
        let longest = longer(longer(first, second), third);
        let per_length = 1.0 / squared(&longest).sqrt();
        for axis in 0..3 {
            vectors[axis][lane] = (longest[axis] * per_length) as f32;
        }
    }
    vectors
}

#[cfg(test)]
mod tests {
    use glam::Vec3;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::geometry::PlaneSums;

    #[test]
    fn planes_of_lanes_are_those_of_single_sums() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let mut sums = PlaneSumsOfLanes::of_origin();
        let mut single = [PlaneSums::about(Vec3::ZERO); LANES];
        single.iter_mut().for_each(|sums| sums.add(Vec3::ZERO));
        for _ in 0..24 {
            let mut draw = |scale: f32| lanes(|_| rng.random_range(-scale..scale));
            let [a, b, c] = [draw(1.0), draw(0.3), draw(0.02)];
            let weight = lanes(|lane| if a[lane] > 0.8 { 0.0 } else { 1.0 });
            // A plane that is inclined in every direction.
            let point = [
                lanes(|lane| weight[lane] * (a[lane] + 0.3 * c[lane])),
                lanes(|lane| weight[lane] * (b[lane] - 0.5 * a[lane])),
                lanes(|lane| weight[lane] * (c[lane] + 0.2 * b[lane] - 0.4 * a[lane])),
            ];
            sums.add(&weight, &point);
            for lane in (0..LANES).filter(|&lane| weight[lane] > 0.0) {
                single[lane].add(Vec3::from_array([0, 1, 2].map(|axis| point[axis][lane])));
            }
        }
        let planes = sums.fit();
        for (lane, single) in single.iter().enumerate() {
            let expected = single.fit().unwrap();
            let normal = Vec3::from_array([0, 1, 2].map(|axis| planes.normals[axis][lane]));
            assert!(normal.dot(expected.normal).abs() > 1.0 - 1e-6, "{normal}");
            let found = [planes.smallest[lane], planes.middle[lane]].map(f64::from);
            for (found, expected) in found.into_iter().zip(expected.variances) {
                assert!(
                    (found - expected).abs() < 1e-3 * expected,
                    "{found} {expected}"
                );
            }
        }
    }

    #[test]
    fn collinear_points_have_no_normal() {
        let mut sums = PlaneSumsOfLanes::of_origin();
        for number in 1..5 {
            let x = [number as f32; LANES];
            sums.add(&[1.0; LANES], &[x, [0.0; LANES], [0.0; LANES]]);
        }
        assert!(
            sums.fit()
                .normals
                .iter()
                .flatten()
                .all(|axis| axis.is_nan())
        );
    }
}
