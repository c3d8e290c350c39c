//! Directions of motion that the residuals of a scan do not determine, such as that of a corridor.
//!
//! ```text
//! S H S / Σ w = V Λ Vᵀ        S = diag(1, 1, 1, 1/ρ, 1/ρ, 1/ρ),   ρ: root mean square of the ranges
//! ```
//!
//! An eigenvalue is the mean square of the cosine between residuals and the displacement of the points. Where it is
//! negligible, the residuals have no influence. Zhang, Kaess and Singh, *On Degeneracy of Optimization-based State
//! Estimation Problems* (ICRA 2016).

use nalgebra::{Matrix6, Vector6};

/// Directions without information.
pub struct Degeneracy {
    /// Motions (translation [m], rotation [rad]) that move points by about a metre.
    pub directions: Vec<Vector6<f64>>,
    /// Removes these directions from gradients; from the left and, transposed, the right from information.
    pub projection: Matrix6<f64>,
}

impl Degeneracy {
    /// The degenerate directions of an information matrix per unit of weight.
    pub fn new(information: &Matrix6<f64>, lever_m: f64) -> Self {
        /// Largest eigenvalue that noise of the surfaces explains (unitless).
        const NOISE: f64 = 0.004;
        let turn = 1.0 / lever_m.max(f64::MIN_POSITIVE);
        let scale = Vector6::new(1.0, 1.0, 1.0, turn, turn, turn);
        let scaled = information.component_mul(&(scale * scale.transpose()));
        let eigen = scaled.symmetric_eigen();
        let mut kept = Matrix6::identity();
        let mut directions = Vec::new();
        for (&value, direction) in eigen
            .eigenvalues
            .iter()
            .zip(eigen.eigenvectors.column_iter())
        {
            // The square root, since the projection is applied from both sides of the information.
            let weight = (1.0 - NOISE / value.max(NOISE)).sqrt();
            kept -= (1.0 - weight) * direction * direction.transpose();
            if weight == 0.0 {
                directions.push(direction.component_mul(&scale));
            }
        }
        let unscale = scale.map(|value| 1.0 / value);
        Self {
            directions,
            projection: kept.component_mul(&(unscale * scale.transpose())),
        }
    }
}
