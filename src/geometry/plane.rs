//! Least-squares planes by principal component analysis.
//!
//! ```text
//! C = Σ (pᵢ − p̄)(pᵢ − p̄)ᵀ / n        λ₀ ≤ λ₁ ≤ λ₂
//! ```
//!
//! The normal is the eigenvector of the smallest eigenvalue, found in closed form (Smith,
//! *Eigenvalues of a symmetric 3 × 3 matrix*, CACM 1961).

use glam::{DMat3, DVec3, Vec3};

/// First and second moments of points, relative to an anchor near the points for numerical
/// accuracy far from the origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlaneSums {
    anchor: DVec3,
    count: f64,
    first: DVec3,
    second: DMat3,
}

/// A fitted plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlaneFit {
    /// Mean of the points [m].
    pub center: Vec3,
    /// Unit normal of arbitrary sign.
    pub normal: Vec3,
    /// Variances along the principal axes, ascending [m²].
    pub variances: [f64; 3],
}

impl PlaneSums {
    /// Empty sums relative to `anchor`, any position near the points.
    pub fn about(anchor: Vec3) -> Self {
        Self {
            anchor: anchor.as_dvec3(),
            count: 0.0,
            first: DVec3::ZERO,
            second: DMat3::ZERO,
        }
    }

    /// Sums of `count` points p: `first` Σ (p − anchor) and `second` Σ (p − anchor)(p − anchor)ᵀ.
    pub fn from_moments(anchor: Vec3, count: f64, first: DVec3, second: DMat3) -> Self {
        Self {
            anchor: anchor.as_dvec3(),
            count,
            first,
            second,
        }
    }

    /// Adds a point.
    #[inline]
    pub fn add(&mut self, point: Vec3) {
        let p = point.as_dvec3() - self.anchor;
        self.count += 1.0;
        self.first += p;
        self.second += DMat3::from_cols(p * p.x, p * p.y, p * p.z);
    }

    /// The least-squares plane; `None` without points or if they are collinear.
    pub fn fit(&self) -> Option<PlaneFit> {
        if self.count == 0.0 {
            return None;
        }
        let mean = self.first / self.count;
        let column = |axis| self.second.col(axis) / self.count - mean * mean[axis];
        let covariance = DMat3::from_cols(column(0), column(1), column(2));
        let variances = eigenvalues(&covariance);
        let normal = eigenvector(&covariance, variances)?;
        Some(PlaneFit {
            center: (self.anchor + mean).as_vec3(),
            normal: normal.as_vec3(),
            variances: variances.map(|variance| variance.max(0.0)),
        })
    }
}

/// Eigenvalues of a symmetric matrix, ascending.
fn eigenvalues(matrix: &DMat3) -> [f64; 3] {
    let [a, b, c] = [matrix.x_axis, matrix.y_axis, matrix.z_axis];
    let mean = (a.x + b.y + c.z) / 3.0;
    let off_diagonal = a.y * a.y + a.z * a.z + b.z * b.z;
    let spread = (a.x - mean).powi(2) + (b.y - mean).powi(2) + (c.z - mean).powi(2);
    let radius = ((spread + 2.0 * off_diagonal) / 6.0).sqrt();
    if radius <= f64::MIN_POSITIVE {
        return [mean; 3];
    }
    let scaled = (*matrix - DMat3::from_diagonal(DVec3::splat(mean))) * (1.0 / radius);
    let angle = (scaled.determinant() / 2.0).clamp(-1.0, 1.0).acos() / 3.0;
    let largest = mean + 2.0 * radius * angle.cos();
    let smallest = mean + 2.0 * radius * (angle + std::f64::consts::TAU / 3.0).cos();
    [smallest, 3.0 * mean - largest - smallest, largest]
}

/// The unit eigenvector of the smallest eigenvalue; `None` if the two smallest eigenvalues are equal
/// to the accuracy of the closed form.
fn eigenvector(matrix: &DMat3, [smallest, middle, largest]: [f64; 3]) -> Option<DVec3> {
    if middle - smallest <= 1e-6 * largest {
        return None;
    }
    let rows = *matrix - DMat3::from_diagonal(DVec3::splat(smallest));
    let candidates = [
        rows.x_axis.cross(rows.y_axis),
        rows.y_axis.cross(rows.z_axis),
        rows.z_axis.cross(rows.x_axis),
    ];
    let mut best = candidates[0];
    for candidate in &candidates[1..] {
        if candidate.length_squared() > best.length_squared() {
            best = *candidate;
        }
    }
    best.try_normalize()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fit(points: &[Vec3]) -> Option<PlaneFit> {
        let mut sums = PlaneSums::about(points[0]);
        for &point in points {
            sums.add(point);
        }
        sums.fit()
    }

    #[test]
    fn the_normal_of_a_plane_is_recovered_at_any_offset() {
        for offset in [Vec3::ZERO, Vec3::new(1000.0, -2000.0, 30.0)] {
            let normal = Vec3::new(0.2, -0.3, 1.0).normalize();
            let (u, v) = normal.any_orthonormal_pair();
            let points: Vec<Vec3> = (0..20)
                .map(|i| offset + u * (i % 5) as f32 * 0.1 + v * (i / 5) as f32 * 0.3)
                .collect();
            let plane = fit(&points).unwrap();
            assert!(plane.normal.dot(normal).abs() > 0.999_99, "{offset}");
            assert!(plane.variances[0] < 1e-8);
        }
    }

    #[test]
    fn the_variances_are_those_along_the_principal_axes() {
        let points: Vec<Vec3> = [-1.0, 1.0]
            .iter()
            .flat_map(|&x| [-2.0, 2.0].map(|y| [-0.5, 0.5].map(|z| Vec3::new(x, y, z))))
            .flatten()
            .collect();
        let [a, b, c] = fit(&points).unwrap().variances;
        assert!((a - 0.25).abs() < 1e-12 && (b - 1.0).abs() < 1e-12 && (c - 4.0).abs() < 1e-12);
    }

    #[test]
    fn collinear_points_have_no_plane() {
        let line: Vec<Vec3> = (0..5).map(|i| Vec3::new(i as f32, 0.0, 1.0)).collect();
        assert_eq!(fit(&line), None);
        assert_eq!(fit(&line[..1]), None);
        assert_eq!(PlaneSums::about(Vec3::ZERO).fit(), None);
    }
}
