//! Normal equations of linearized residuals, their step, and the covariance after it.

use nalgebra::{Matrix6, Vector6};

use super::config::RegistrationConfig;
use super::information::{Horizontal, Residual};

/// Normal equations of the residuals at a pose, with their solution.
pub(super) struct Equations {
    information: Matrix6<f64>,
    /// Parts of the sectors of the information and of the gradient.
    sectors: Vec<(Matrix6<f64>, Vector6<f64>)>,
    /// Variance of the residuals [m²].
    variance: f64,
    pub horizontal: Horizontal,
    pub step: Vector6<f64>,
}

impl Equations {
    /// The equations whose step has the least robust cost of the linearized residuals, by iteratively reweighted least squares: they
    /// have the weights of the residuals after the step, or nearly. Weights cost far less than rays.
    pub fn minimal(residuals: &[Residual], config: &RegistrationConfig) -> Option<Self> {
        /// Most rounds.
        const ROUNDS: usize = 5;
        /// Change of the step that ends them, in tolerances: they need no rays.
        const TOLERANCE: f64 = 0.1;
        let mut before = Vector6::zeros();
        let mut equations = Self::new(residuals, &before, config)?;
        for _ in 0..ROUNDS {
            let step = equations.determined_step();
            if length_m(&(step - before)) < TOLERANCE * config.tolerance_m {
                break;
            }
            before = step;
            let Some(reweighted) = Self::new(residuals, &step, config) else {
                break;
            };
            equations = reweighted;
        }
        Some(equations)
    }

    /// Equations with the weights of the linearized residuals after a step. `None` for too few residuals, or if the information
    /// matrix is singular.
    pub fn new(
        residuals: &[Residual],
        weighted_after: &Vector6<f64>,
        config: &RegistrationConfig,
    ) -> Option<Self> {
        /// Fewer residuals determine no pose.
        const MIN_RESIDUALS: usize = 30;
        if residuals.len() < MIN_RESIDUALS {
            return None;
        }
        let mut sectors = vec![(Matrix6::zeros(), Vector6::zeros()); config.sectors];
        let (mut squares, mut weights) = (0.0, 0.0);
        let kernel = config.kernel();
        for residual in residuals {
            let jacobian = residual.jacobian;
            let after_m = residual.value_m + jacobian.dot(weighted_after);
            let weight = kernel.weight(after_m);
            let (of_sector, gradient) = &mut sectors[residual.sector];
            for column in 0..6 {
                let factor = weight * jacobian[column];
                for row in column..6 {
                    of_sector[(row, column)] += factor * jacobian[row];
                }
            }
            gradient.axpy(weight * residual.value_m, &jacobian, 1.0);
            squares += weight * after_m.powi(2);
            weights += weight;
        }
        for (of_sector, _) in &mut sectors {
            of_sector.fill_upper_triangle_with_lower_triangle();
        }
        let information: Matrix6<f64> = sectors.iter().map(|(of_sector, _)| of_sector).sum();
        let gradient: Vector6<f64> = sectors.iter().map(|(_, gradient)| gradient).sum();
        let step = -information.cholesky()?.solve(&gradient);
        let horizontal = Horizontal::new(&information, weights * config.normal_rad.powi(2))?;
        let is_finite = step.iter().all(|value| value.is_finite());
        is_finite.then_some(Self {
            information,
            sectors,
            variance: squares / weights,
            horizontal,
            step,
        })
    }

    /// The step without directions of which only noise is known.
    pub fn determined_step(&self) -> Vector6<f64> {
        self.horizontal.determined(self.step)
    }

    /// Covariance of the pose after the step; `None` if the information is singular.
    pub fn covariance(&self) -> Option<Matrix6<f64>> {
        /// Part of a sector that is left out: without all of it, what it alone determines would be unknown.
        const PART: f64 = 0.95;
        let corrected = self.horizontal.corrected(&self.information);
        let inverse = corrected.try_inverse()?;
        let to_shift = inverse * self.information;
        // How far the pose moves without a sector, to first order.
        let shift = |(of_sector, gradient): &(Matrix6<f64>, Vector6<f64>)| {
            let rest = (self.information - PART * of_sector).cholesky()?;
            let after_step = gradient + of_sector * self.step;
            Some(to_shift * rest.solve(&after_step))
        };
        let seen = (self.sectors.iter()).filter(|(of_sector, _)| of_sector.trace() > 0.0);
        let shifts: Vec<Vector6<f64>> = seen.map(shift).collect::<Option<_>>()?;
        let count = shifts.len() as f64;
        let outer_products: Matrix6<f64> = shifts.iter().map(|it| it * it.transpose()).sum();
        Some(inverse * self.variance + outer_products * ((count - 1.0) / count))
    }
}

/// Length of a step; rotations have a lever of ten metres.
pub(super) fn length_m(step: &Vector6<f64>) -> f64 {
    const LEVER_M: f64 = 10.0;
    step.fixed_rows::<3>(0).norm() + LEVER_M * step.fixed_rows::<3>(3).norm()
}
