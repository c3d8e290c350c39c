//! Factor of the ranges of a scan: a seventh unknown with those of the pose, which are eliminated from the normal equations.
//!
//! ```text
//! rᵢ(δ, ε) = rᵢ + Jᵢ δ + sᵢ ε        sᵢ = nᵢ · qᵢ: how far the return moves across its surface per unit of the factor [m]
//! ε = − (Σ wᵢ sᵢ rᵢ − hᵀ H⁻¹ g) / (Σ wᵢ sᵢ² − hᵀ H⁻¹ h)        H = Σ wᵢ Jᵢ Jᵢᵀ,   g = Σ wᵢ rᵢ Jᵢ,   h = Σ wᵢ sᵢ Jᵢ
//! ```

use nalgebra::{Matrix6, Vector6};

use super::information::Residual;
use crate::geometry::RobustKernel;
use crate::lidar::Beam;

/// The factor by which the ranges of beams have to be multiplied to fit the map best, to first order, by their residuals at a pose near the
/// right one. `None` if they do not determine it to a thousandth, as if their errors were independent, or if it is far from one.
pub(super) fn range_factor(
    residuals: &[Residual],
    beams: &[Beam],
    kernel: RobustKernel,
) -> Option<f64> {
    /// Largest standard deviation.
    const SIGMA: f64 = 1e-3;
    /// Fewer residuals determine nothing.
    const LEAST: usize = 30;
    /// A larger change of the ranges is none to first order.
    const FARTHEST: f64 = 0.3;
    if residuals.len() < LEAST {
        return None;
    }
    let mut pose_information = Matrix6::<f64>::zeros();
    let [mut coupling, mut pose_gradient] = [Vector6::<f64>::zeros(); 2];
    let [
        mut factor_information,
        mut factor_gradient,
        mut squares,
        mut weights,
    ] = [0.0_f64; 4];
    for residual in residuals {
        let (jacobian, value_m) = (residual.jacobian, residual.value_m);
        let point = beams[residual.beam].point().as_dvec3();
        let per_factor_m = jacobian[0] * point.x + jacobian[1] * point.y + jacobian[2] * point.z;
        let weight = kernel.weight(value_m);
        pose_information.syger(weight, &jacobian, &jacobian, 1.0);
        coupling.axpy(weight * per_factor_m, &jacobian, 1.0);
        pose_gradient.axpy(weight * value_m, &jacobian, 1.0);
        factor_information += weight * per_factor_m.powi(2);
        factor_gradient += weight * per_factor_m * value_m;
        squares += weight * value_m.powi(2);
        weights += weight;
    }
    pose_information.fill_upper_triangle_with_lower_triangle();
    let cholesky = pose_information.cholesky()?;
    let information = factor_information - coupling.dot(&cholesky.solve(&coupling));
    let excess = -(factor_gradient - coupling.dot(&cholesky.solve(&pose_gradient))) / information;
    let sigma = (squares / weights / information).sqrt();
    let is_known = sigma <= SIGMA && excess.abs() <= FARTHEST;
    is_known.then_some(1.0 + excess)
}
