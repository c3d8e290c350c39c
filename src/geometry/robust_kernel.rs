//! Robust kernel: outliers keep a small weight and cost at most one.
//!
//! ```text
//! u = r² / c²        weight = (1 + u)⁻²        cost = u / (1 + u)
//! ```
//!
//! Geman and McClure, *Bayesian Image Analysis: An Application to Single Photon Emission Tomography* (1985).

/// Geman-McClure kernel of point-to-surface distances.
#[derive(Clone, Copy, Debug)]
pub struct RobustKernel {
    /// Scale c: a residual of it has a weight of one quarter and a cost of one half [m].
    pub scale_m: f64,
}

impl RobustKernel {
    /// Weight of a residual in least squares, 1 to 0 (unitless).
    #[inline]
    pub fn weight(self, residual_m: f64) -> f64 {
        (1.0 + self.ratio(residual_m)).powi(-2)
    }

    /// Cost of a residual, 0 to 1 (unitless).
    #[inline]
    pub fn cost(self, residual_m: f64) -> f64 {
        let ratio = self.ratio(residual_m);
        ratio / (1.0 + ratio)
    }

    fn ratio(self, residual_m: f64) -> f64 {
        (residual_m / self.scale_m).powi(2)
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn the_weight_is_the_slope_of_the_cost_over_the_squared_residual() {
        let kernel = RobustKernel { scale_m: 0.3 };
        for residual_m in [0.01, 0.1, 0.3, 1.0, 4.0_f64] {
            let cost_at = |square: f64| kernel.cost(square.sqrt());
            let (square, step) = (residual_m.powi(2), 1e-6);
            let slope = (cost_at(square + step) - cost_at(square - step)) / (2.0 * step);
            let weight = kernel.weight(residual_m) / kernel.scale_m.powi(2);
            assert_relative_eq!(slope, weight, max_relative = 1e-4);
        }
        assert_eq!((kernel.weight(0.3), kernel.cost(0.3)), (0.25, 0.5));
    }
}
