//! Gauss-Newton of a scan to the local map, from coarse to fine.
//!
//! ```text
//! (α H + (1 − α) H' + P⁻¹) δ = α b + (1 − α) b' − P⁻¹ log(predicted⁻¹ · odom_from_lidar)
//! ```
//!
//! H, b are the sums of the points on planes, H', b' those of the others, α is the share of the points on planes (GenZ-ICP,
//! eq. 11), P the covariance of the prediction, scaled to the variance of the residuals. The scale of the kernel falls to that of the
//! residuals. The covariance is cluster-robust over sectors of the azimuth (White 1980; Liang and Zeger 1986).

use nalgebra::{Matrix6, Vector6};

use super::residuals::{Equations, Match, Observation};
use crate::geometry::pose::{exponential, logarithm};
use crate::geometry::{Degeneracy, Pose3};

/// Neighbouring residuals are correlated: so many count as one against the prediction.
const CORRELATED: f64 = 10.0;

/// A scan to be registered.
#[derive(Clone, Copy)]
pub struct Problem<'a> {
    /// The scan and the local map.
    pub observation: Observation<'a>,
    /// Predicted pose.
    pub predicted: Pose3,
    /// Pose without a translation since the previous scan, turned as was measured, where it was.
    pub unmoved: Pose3,
    /// Whether the rotation since the previous scan was measured by a gyroscope.
    pub is_turn_measured: bool,
    /// Variances of the prediction, (x, y, z, roll, pitch, yaw) in the lidar frame [m², rad²].
    pub prior: Vector6<f64>,
    /// Smallest scale of the robust kernel [m].
    pub min_kernel_m: f64,
    /// Maximum number of iterations.
    pub iterations: usize,
}

/// A registered pose.
#[derive(Clone, Debug)]
pub struct Alignment {
    /// `p_odom = odom_from_lidar * p_lidar`.
    pub odom_from_lidar: Pose3,
    /// Covariance of (x, y, z, roll, pitch, yaw) in the lidar frame [m, rad].
    pub covariance: Matrix6<f64>,
    /// Motions that the scan does not determine; see [`Degeneracy`].
    pub degenerate_directions: Vec<Vector6<f64>>,
    /// Robust root mean square of the distances to planes [m].
    pub residual_m: f64,
    /// Share of the points within the gate.
    pub matched_share: f64,
    /// Mean robust cost of the points that are not on level surfaces, 0 to 1, plus that of the deviation from the prediction.
    pub cost: f64,
    /// Share of the points near planes that lie on them, without level ones; `None` where there are too few.
    pub common_share: Option<f64>,
}

impl Problem<'_> {
    /// Registers the scan from an initial pose and with an initial scale of the kernel; `None` if the
    /// equations cannot be solved.
    pub fn align(&self, initial: &Pose3, kernel_m: f64) -> Option<Alignment> {
        /// Reduction of the kernel per iteration.
        const SHRINK: f64 = 0.5;
        /// Kernel in robust standard deviations of the residuals.
        const KERNEL_SIGMAS: f64 = 3.0;
        /// Largest final kernel, in smallest ones: the residuals of a wrong pose.
        const MAX_KERNEL: f64 = 10.0;
        /// Kernel by which results are compared, in smallest ones.
        const SCORE_KERNEL: f64 = 2.0;
        /// Last step, in smallest kernels.
        const TOLERANCE: f64 = 0.01;
        let lever_m = self.lever();
        let mut pose = *initial;
        let mut kernel_m = kernel_m.max(self.min_kernel_m);
        let mut matches = self.observation.unmatched();
        let mut result = None;
        for _ in 0..self.iterations {
            let mut equations = self.observation.linearize(&pose, kernel_m, &mut matches);
            let (step, alignment) = self.solve(&equations, &pose, lever_m)?;
            pose *= exponential(&step);
            result = Some(alignment);
            let sigma_m = 1.48 * median(&mut equations.distances_m)?;
            let target_m =
                (KERNEL_SIGMAS * sigma_m).clamp(self.min_kernel_m, MAX_KERNEL * self.min_kernel_m);
            let shift_m = step.fixed_rows::<3>(0).norm() + lever_m * step.fixed_rows::<3>(3).norm();
            if kernel_m <= 1.1 * target_m && shift_m < TOLERANCE * self.min_kernel_m {
                break;
            }
            kernel_m = (SHRINK * kernel_m).max(target_m).min(kernel_m);
        }
        let (cost, common_share) =
            self.judge(&pose, SCORE_KERNEL * self.min_kernel_m, &mut matches);
        Some(Alignment {
            odom_from_lidar: pose,
            cost,
            common_share,
            ..result?
        })
    }

    /// Mean robust cost of the points that are not on level surfaces at a pose, plus that of the deviation from the
    /// prediction; and the share of the points near planes that lie on them.
    pub fn judge(&self, pose: &Pose3, kernel_m: f64, matches: &mut [Match]) -> (f64, Option<f64>) {
        let deviation = logarithm(&(self.predicted.inverse() * pose));
        let squares = deviation
            .component_mul(&deviation)
            .component_div(&self.prior);
        let equations = self.observation.linearize(pose, kernel_m, matches);
        let (of_points, count) = equations.cost();
        let cost = (of_points + 0.5 * CORRELATED * squares.sum()) / count.max(1) as f64;
        (cost, equations.common_share())
    }

    /// Root mean square of the ranges: what a rotation moves a point by [m].
    fn lever(&self) -> f64 {
        let points = self.observation.points;
        let squares: f64 = (points.iter())
            .map(|point| f64::from(point.position.length_squared()))
            .sum();
        (squares / points.len().max(1) as f64).sqrt()
    }

    /// The Gauss-Newton step and the accuracy of the pose.
    fn solve(
        &self,
        equations: &Equations,
        pose: &Pose3,
        lever_m: f64,
    ) -> Option<(Vector6<f64>, Alignment)> {
        const MIN_MATCHES: usize = 30;
        /// Smallest standard deviation of the residuals, in smallest kernels.
        const MIN_SIGMA: f64 = 0.02;
        let (planar, other) = (&equations.planar, &equations.other);
        let count = planar.count + other.count;
        if count < MIN_MATCHES || planar.weight <= 0.0 {
            return None;
        }
        let share = planar.count as f64 / count as f64;
        let blend = |of_planar: f64, of_other: f64| share * of_planar + (1.0 - share) * of_other;
        let information = planar.information.zip_map(&other.information, blend);
        let mut right_side = planar.right_side.zip_map(&other.right_side, blend);
        let weight = blend(planar.weight, other.weight);
        let degeneracy = Degeneracy::new(&(information / weight), lever_m);
        let kept = degeneracy.projection;
        let information = kept * information * kept.transpose();
        right_side = kept * kept * right_side;
        let variance =
            (planar.squares / planar.weight).max((MIN_SIGMA * self.min_kernel_m).powi(2));
        let prior = Matrix6::from_diagonal(&self.prior.map(|prior| variance * CORRELATED / prior));
        right_side -= prior * logarithm(&(self.predicted.inverse() * pose));
        let total = (information + prior).cholesky()?;
        let step = total.solve(&right_side);
        let inverse = total.inverse();
        let scatter: Matrix6<f64> = (equations.gradients.iter())
            .map(|gradient| kept * gradient * share)
            .map(|gradient| gradient * gradient.transpose())
            .sum();
        let noise = (information + prior * CORRELATED) * variance + scatter;
        let alignment = Alignment {
            odom_from_lidar: *pose,
            covariance: inverse * noise * inverse,
            degenerate_directions: degeneracy.directions,
            residual_m: variance.sqrt(),
            matched_share: count as f64 / self.observation.points.len() as f64,
            cost: 1.0,
            common_share: None,
        };
        (step.iter().all(|value| value.is_finite())).then_some((step, alignment))
    }
}

/// The alignment with the least cost.
pub fn best(alignments: impl IntoIterator<Item = Alignment>) -> Option<Alignment> {
    (alignments.into_iter()).min_by(|a, b| a.cost.total_cmp(&b.cost))
}

/// The median, the upper one of an even number; `None` without values.
pub fn median(values: &mut [f32]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| (*values.select_nth_unstable_by(middle, f32::total_cmp).1).into())
}
