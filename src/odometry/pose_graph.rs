//! Pose graph: poses that agree with measured transforms between them.
//!
//! ```text
//! e = log(Z⁻¹ · Tᵢ⁻¹ Tⱼ)        Z: measured first_from_second;   log: (translation, rotation vector)
//! Σ ρ(eᵀ Σ⁻¹ e) → min           ρ: Geman-McClure for loops, square for the odometry
//! ```
//!
//! by Gauss-Newton on SE(3). The kernel begins so wide that the problem is convex, and narrows in every iteration
//! (graduated non-convexity), so that a wrong loop loses its weight and a right one keeps it although the odometry
//! contradicts it at first.
//!
//! Grisetti et al., *A Tutorial on Graph-Based SLAM* (2010); Yang et al., *Graduated Non-Convexity for Robust
//! Spatial Perception* (RA-L 2020), eq. 12 and remark 5.

use nalgebra::{Matrix3, Matrix6, Vector6};

use super::block_system::BlockSystem;
use crate::geometry::Pose3;
use crate::geometry::pose::{exponential, logarithm};

/// A measured transform between two poses.
#[derive(Clone, Debug, PartialEq)]
pub struct Edge {
    /// Row of the first pose.
    pub first: usize,
    /// Row of the second pose.
    pub second: usize,
    /// `p_first = first_from_second * p_second`.
    pub first_from_second: Pose3,
    /// Inverse of its covariance: (x, y, z, roll, pitch, yaw) in the second frame [1/m², 1/rad²].
    pub information: Matrix6<f64>,
    /// Whether it may be wrong.
    pub is_loop: bool,
}

/// Information of independent errors of these standard deviations: of the position [m] and of the rotation [rad].
pub fn information(shift_m: f64, turn_rad: f64) -> Matrix6<f64> {
    let [shift, turn] = [shift_m.powi(-2), turn_rad.powi(-2)];
    Matrix6::from_diagonal(&Vector6::new(shift, shift, shift, turn, turn, turn))
}

/// Residual of an edge and its derivatives by the two poses.
pub struct LinearizedEdge {
    residual: Vector6<f64>,
    by_first: Matrix6<f64>,
    by_second: Matrix6<f64>,
}

impl Edge {
    /// Linearizes the residual around two poses, which change by a right factor.
    pub fn linearize(&self, poses: &[Pose3]) -> LinearizedEdge {
        let relative = poses[self.first].inverse() * poses[self.second];
        let error = self.first_from_second.inverse() * relative;
        let residual = logarithm(&error);
        let measured = *self
            .first_from_second
            .rotation
            .to_rotation_matrix()
            .matrix();
        let relative_rotation = *relative.rotation.to_rotation_matrix().matrix();
        let error_rotation = *error.rotation.to_rotation_matrix().matrix();
        // Inverse of the right Jacobian, to first order.
        let turn = residual.fixed_rows::<3>(3).into_owned();
        let right = Matrix3::identity() + 0.5 * turn.cross_matrix();
        let lever = relative.translation.vector.cross_matrix();
        let mut by_first = Matrix6::zeros();
        (by_first.fixed_view_mut::<3, 3>(0, 0)).copy_from(&-measured.transpose());
        (by_first.fixed_view_mut::<3, 3>(0, 3)).copy_from(&(measured.transpose() * lever));
        (by_first.fixed_view_mut::<3, 3>(3, 3))
            .copy_from(&(-right * relative_rotation.transpose()));
        let mut by_second = Matrix6::zeros();
        (by_second.fixed_view_mut::<3, 3>(0, 0)).copy_from(&error_rotation);
        (by_second.fixed_view_mut::<3, 3>(3, 3)).copy_from(&right);
        LinearizedEdge {
            residual,
            by_first,
            by_second,
        }
    }

    /// Squared residual over its covariance.
    pub fn normalized_square(&self, poses: &[Pose3]) -> f64 {
        let relative = poses[self.first].inverse() * poses[self.second];
        let residual = logarithm(&(self.first_from_second.inverse() * relative));
        (self.information * residual).dot(&residual)
    }

    /// Adds the edge to the normal equations.
    pub fn add_to(&self, system: &mut BlockSystem, poses: &[Pose3], weight: f64) {
        let at = self.linearize(poses);
        let information = self.information * weight;
        let first = at.by_first.transpose() * information;
        let second = at.by_second.transpose() * information;
        system.add(self.first, &(first * at.by_first), &-(first * at.residual));
        system.add(
            self.second,
            &(second * at.by_second),
            &-(second * at.residual),
        );
        system.add_off_diagonal(self.first, self.second, &(first * at.by_second));
    }
}

/// Poses that fit edges best, and the weight of each edge; the first pose stays. `None` if the edges do not
/// determine the poses.
pub fn optimize(initial: &[Pose3], edges: &[Edge]) -> Option<(Vec<Pose3>, Vec<f64>)> {
    optimize_with(initial, edges, |_, _| {})
}

/// The same with what `constrain` adds to the equations about single poses.
pub fn optimize_with(
    initial: &[Pose3],
    edges: &[Edge],
    constrain: impl Fn(&mut BlockSystem, &[Pose3]),
) -> Option<(Vec<Pose3>, Vec<f64>)> {
    /// Normalized square at which a loop has a quarter of its weight: 99.9 % of six degrees of freedom.
    const SCALE: f64 = 22.5;
    /// The kernel narrows by this factor per iteration.
    const NARROWING: f64 = 1.6;
    const MAX_ITERATIONS: usize = 100;
    /// Largest last step [m, rad].
    const TOLERANCE: f64 = 1e-6;
    /// Information that holds the first pose.
    const HOLD: f64 = 1e12;
    let mut poses = initial.to_vec();
    let mut weights = vec![1.0; edges.len()];
    let loops = || edges.iter().filter(|edge| edge.is_loop);
    let worst = (loops().map(|edge| edge.normalized_square(&poses))).fold(0.0, f64::max);
    let mut widening = (2.0 * worst / SCALE).max(1.0);
    for _ in 0..MAX_ITERATIONS {
        let mut system = BlockSystem::new(poses.len());
        system.add(0, &(Matrix6::identity() * HOLD), &Vector6::zeros());
        for (edge, weight) in edges.iter().zip(&mut weights) {
            if edge.is_loop {
                let scale = widening * SCALE;
                *weight = (scale / (scale + edge.normalized_square(&poses))).powi(2);
            }
            edge.add_to(&mut system, &poses, *weight);
        }
        constrain(&mut system, &poses);
        let steps = system.solve()?;
        let largest = steps.iter().map(|step| step.amax()).fold(0.0, f64::max);
        for (pose, step) in poses.iter_mut().zip(&steps) {
            *pose *= exponential(step);
        }
        if widening <= 1.0 && largest < TOLERANCE {
            break;
        }
        widening = (widening / NARROWING).max(1.0);
    }
    Some((poses, weights))
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;

    /// A circle of poses, driven twice, with some climb.
    fn circle(count: usize) -> Vec<Pose3> {
        let turn = 4.0 * std::f64::consts::PI / count as f64;
        let step = Pose3::new(
            Vector3::new(5.0, 0.1, 0.05),
            Vector3::new(0.01, 0.005, turn),
        );
        let mut pose = Pose3::identity();
        let mut poses = vec![];
        for _ in 0..count {
            poses.push(pose);
            pose *= step;
        }
        poses
    }

    fn edge(poses: &[Pose3], first: usize, second: usize, is_loop: bool) -> Edge {
        let sigma = if is_loop { 0.05 } else { 0.1 };
        Edge {
            first,
            second,
            first_from_second: poses[first].inverse() * poses[second],
            information: Matrix6::identity() / (sigma * sigma),
            is_loop,
        }
    }

    fn largest_error(found: &[Pose3], truth: &[Pose3]) -> f64 {
        let errors = found
            .iter()
            .zip(truth)
            .map(|(found, truth)| (found.translation.vector - truth.translation.vector).norm());
        errors.fold(0.0, f64::max)
    }

    /// Odometry with a constant error, true loops, and wrong ones.
    fn graph(wrong: usize) -> (Vec<Pose3>, Vec<Pose3>, Vec<Edge>) {
        let truth = circle(60);
        let drift = Pose3::new(
            Vector3::new(0.03, -0.01, 0.02),
            Vector3::new(0.001, 0.0, 0.004),
        );
        let mut edges: Vec<Edge> = (1..60)
            .map(|row| edge(&truth, row - 1, row, false))
            .collect();
        let mut odometry = vec![Pose3::identity()];
        for edge in &mut edges {
            edge.first_from_second *= drift;
            odometry.push(odometry[edge.first] * edge.first_from_second);
        }
        edges.extend((0..6).map(|number| edge(&truth, 4 * number, 4 * number + 30, true)));
        edges.extend((0..wrong).map(|number| {
            let mut edge = edge(&truth, 3 * number, 3 * number + 20, true);
            edge.first_from_second *= Pose3::new(Vector3::new(8.0, -15.0, 0.0), Vector3::z());
            edge
        }));
        (truth, odometry, edges)
    }

    #[test]
    fn derivatives_are_those_of_the_residual() {
        let poses = circle(20);
        let mut edge = edge(&poses, 2, 9, true);
        edge.first_from_second *=
            Pose3::new(Vector3::new(0.1, 0.2, -0.1), Vector3::new(0.02, 0.0, 0.03));
        let at = edge.linearize(&poses);
        for axis in 0..6 {
            for (row, expected) in [(2, at.by_first), (9, at.by_second)] {
                let residual = |length: f64| {
                    let mut step = Vector6::zeros();
                    step[axis] = length;
                    let mut moved = poses.clone();
                    moved[row] *= exponential(&step);
                    edge.linearize(&moved).residual
                };
                let found = (residual(1e-6) - residual(-1e-6)) / 2e-6;
                assert!(
                    (found - expected.column(axis)).amax() < 2e-3,
                    "{axis} {row}"
                );
            }
        }
    }

    #[test]
    fn loops_take_the_drift_away() {
        let (truth, odometry, edges) = graph(0);
        let before = largest_error(&odometry, &truth);
        let (found, weights) = optimize(&odometry, &edges).unwrap();
        let after = largest_error(&found, &truth);
        assert!(before > 5.0 && after < 0.5 * before, "{before} {after}");
        assert!(weights.iter().all(|&weight| weight > 0.5), "{weights:?}");
    }

    #[test]
    fn wrong_loops_change_nothing() {
        let (_, odometry, edges) = graph(3);
        let (with, weights) = optimize(&odometry, &edges).unwrap();
        let (without, _) = optimize(&odometry, &edges[..edges.len() - 3]).unwrap();
        assert!(largest_error(&with, &without) < 0.02);
        assert!(
            weights[weights.len() - 3..]
                .iter()
                .all(|&weight| weight < 0.01)
        );
    }
}
