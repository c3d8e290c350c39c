//! Smoothing of a trajectory: least squares over the measured poses of all frames and the odometry
//! between neighbors.
//!
//! ```text
//! min  Σ ρ(‖xᵢ ⊖ pᵢ‖²_Rᵢ) + Σ ‖zᵢ⁻¹ (xᵢ⁻¹ xᵢ₊₁)‖²_Qᵢ        ρ(s) = c² ln(1 + s/c²)
//! ```
//!
//! pᵢ, Rᵢ: measured pose of a frame; zᵢ, Qᵢ: odometry between neighbors. Rᵢ is without the error that a frame has in common with
//! its neighbors: they see the same surfaces, whose errors are most of theirs, and these do not contradict the odometry.
//!
//! The normal equations are block tridiagonal: a step costs one forward and one backward pass, and so do the
//! diagonal blocks of their inverse, the marginal covariances (Rauch, Tung and Striebel, 1965).
//! Grisetti et al., *A Tutorial on Graph-Based SLAM* (2010), with the robust kernel of Cauchy.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::geometry::Pose2;
use crate::localization::OdometryNoise;
use crate::localization::motion::TurnDriveTurn;
use crate::localization::particles::deviation;
use crate::statistics::median;
use crate::validation::{InvalidValue, Validate, in_range, positive};

/// Least noise of the odometry and robustness against wrong frames.
///
/// Defaults: an odometry of KITTI's quality: 2 cm and 0.06 degrees per frame. Where the measured poses of neighbours
/// show that it is worse, it is taken as worse. `docs/method.md`, Thresholds, has what half and twice of them change on four
/// sensors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct SmoothingConfig {
    /// Least standard deviation of the odometry along the car, per frame [m].
    #[default(0.02)]
    pub odometry_ahead_m: f64,
    /// Least standard deviation across the car, per frame [m].
    #[default(0.01)]
    pub odometry_aside_m: f64,
    /// Least standard deviation of the heading, per frame [rad].
    #[default(0.001)]
    pub odometry_turn_rad: f64,
    /// Scale c of the robust kernel (standard deviations): a pose that is c off has half of the weight. Of errors of x, y and
    /// heading that are normal, 2.9 % are beyond 3.
    #[default(3.0)]
    pub robust_sigmas: f64,
    /// Largest number of iterations.
    #[default(20)]
    pub iterations: usize,
}

impl SmoothingConfig {
    /// The configuration whose deviations of the odometry are at least those of a noise on steps straight ahead of a length,
    /// whose first turn moves their end aside.
    #[must_use]
    pub fn with_noise(&self, noise: &OdometryNoise, step_m: f64) -> Self {
        let step = TurnDriveTurn::decompose(&Pose2::translation(step_m, 0.0));
        let sigmas = noise.covariance(&step).diagonal().map(f64::sqrt);
        Self {
            odometry_ahead_m: self.odometry_ahead_m.max(sigmas.x),
            odometry_aside_m: self.odometry_aside_m.max(sigmas.y),
            odometry_turn_rad: self.odometry_turn_rad.max(sigmas.z),
            ..self.clone()
        }
    }
}

impl Validate for SmoothingConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        positive("odometry_ahead_m", self.odometry_ahead_m)?;
        positive("odometry_aside_m", self.odometry_aside_m)?;
        positive("odometry_turn_rad", self.odometry_turn_rad)?;
        positive("robust_sigmas", self.robust_sigmas)?;
        in_range("iterations", self.iterations, 1..=1000)
    }
}

impl SmoothingConfig {
    /// With the noise that the odometry has against the measured poses, where that is more: the median of the
    /// differences, as a standard deviation, less what the covariances of the two poses and chance explain.
    fn observed(&self, priors: &[Option<FramePrior>], increments: &[Pose2]) -> Self {
        /// Fewer pairs of neighbours do not show a noise.
        const MIN_PAIRS: usize = 10;
        /// Standard deviations per median of the magnitudes of a normal distribution.
        const SIGMA_PER_MEDIAN: f64 = 1.4826;
        let (differences, explained): (Vec<Vector3<f64>>, Vec<Vector3<f64>>) = (priors.windows(2))
            .zip(increments.get(1..).unwrap_or_default())
            .filter_map(|(pair, increment)| {
                let (a, b) = (pair[0].as_ref()?, pair[1].as_ref()?);
                let off = increment.inverse() * (a.pose.inverse() * b.pose);
                let car_from_map = rotation(-b.pose.rotation.angle());
                let sum = car_from_map * (a.covariance + b.covariance) * car_from_map.transpose();
                let [x, y] = off.translation.vector.into();
                Some((
                    Vector3::new(x, y, off.rotation.angle()).abs(),
                    sum.diagonal(),
                ))
            })
            .unzip();
        if differences.len() < MIN_PAIRS {
            return self.clone();
        }
        let median_of = |values: &[Vector3<f64>], axis: usize| {
            median(values.iter().map(|value| value[axis])).unwrap_or(0.0)
        };
        // A variance by the median of n differences has a relative standard deviation of 2.3 / sqrt(n).
        let certain = 6.0 / (differences.len() as f64).sqrt();
        let noise = |axis: usize, least: f64| {
            let difference = SIGMA_PER_MEDIAN * median_of(&differences, axis);
            let explained = (1.0 + certain) * median_of(&explained, axis);
            let variance = difference.powi(2) - explained;
            variance.max(least * least).sqrt()
        };
        Self {
            odometry_ahead_m: noise(0, self.odometry_ahead_m),
            odometry_aside_m: noise(1, self.odometry_aside_m),
            odometry_turn_rad: noise(2, self.odometry_turn_rad),
            ..self.clone()
        }
    }
}

/// Measured pose of a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FramePrior {
    /// `map_from_lidar`.
    pub pose: Pose2,
    /// Covariance of (x, y, heading) in the axes of the map [m², m·rad, rad²].
    pub covariance: Matrix3<f64>,
}

/// Returns the trajectory that agrees best with the measured poses and the odometry.
///
/// `start` are initial poses, `priors[i]` the measured pose of frame i (`None` where it has none),
/// `increments[i]` the odometry `previous_from_current` into frame i (that of frame 0 is not read).
/// All have the same length. The result never fits worse than the start.
pub fn smooth(
    start: &[Pose2],
    priors: &[Option<FramePrior>],
    increments: &[Pose2],
    config: &SmoothingConfig,
) -> Vec<Pose2> {
    debug_assert!(start.len() == priors.len() && start.len() == increments.len());
    let problem = Problem::new(priors, increments, config);
    let mut poses = start.to_vec();
    let mut cost = problem.cost(&poses);
    let mut damping = 1e-6;
    for _ in 0..config.iterations {
        let Some(steps) = problem.linearize(&poses, damping).solve() else {
            return poses;
        };
        let moved: Vec<Pose2> = poses
            .iter()
            .zip(&steps)
            .map(|(pose, step)| pose * Pose2::new(step.xy(), step.z))
            .collect();
        let moved_cost = problem.cost(&moved);
        if moved_cost <= cost {
            let gain = cost - moved_cost;
            (poses, cost) = (moved, moved_cost);
            damping = (0.1 * damping).max(1e-12);
            if gain < 1e-10 * (1.0 + cost) {
                break;
            }
        } else {
            damping = (10.0 * damping).max(1e-6);
        }
    }
    poses
}

/// Returns the marginal covariances of (x, y, heading) in the axes of the map [m², m·rad, rad²] of a
/// smoothed trajectory; `None` where no frame has a measured pose. The arguments are those of
/// [`smooth`], of which `smoothed` is the result.
pub fn covariances(
    smoothed: &[Pose2],
    priors: &[Option<FramePrior>],
    increments: &[Pose2],
    config: &SmoothingConfig,
) -> Option<Vec<Matrix3<f64>>> {
    let problem = Problem::new(priors, increments, config);
    let in_cars = problem.linearize(smoothed, 0.0).diagonal_of_inverse()?;
    let in_map = smoothed.iter().zip(&in_cars).map(|(pose, in_car)| {
        let map_from_car = rotation(pose.rotation.angle());
        map_from_car * in_car * map_from_car.transpose()
    });
    Some(in_map.collect())
}

/// The measurements with their information matrices.
struct Problem<'a> {
    priors: Vec<Option<(Pose2, Matrix3<f64>)>>,
    increments: &'a [Pose2],
    odometry_information: Matrix3<f64>,
    kernel: f64,
}

/// Block tridiagonal normal equations: `diagonal[i]`, `upper[i]` between i and i + 1.
struct NormalEquations {
    diagonal: Vec<Matrix3<f64>>,
    upper: Vec<Matrix3<f64>>,
    right_side: Vec<Vector3<f64>>,
}

impl<'a> Problem<'a> {
    fn new(
        priors: &[Option<FramePrior>],
        increments: &'a [Pose2],
        config: &SmoothingConfig,
    ) -> Self {
        let config = config.observed(priors, increments);
        let sigmas = Vector3::new(
            config.odometry_ahead_m,
            config.odometry_aside_m,
            config.odometry_turn_rad,
        );
        Self {
            priors: priors
                .iter()
                .map(|prior| {
                    let prior = (*prior)?;
                    // A singular covariance gives no information.
                    Some((prior.pose, prior.covariance.try_inverse()?))
                })
                .collect(),
            increments,
            odometry_information: Matrix3::from_diagonal(&sigmas.map(|sigma| sigma.powi(-2))),
            kernel: config.robust_sigmas.powi(2),
        }
    }

    fn cost(&self, poses: &[Pose2]) -> f64 {
        let frames = poses.iter().zip(&self.priors).filter_map(|(pose, prior)| {
            let (expected, information) = prior.as_ref()?;
            let residual = deviation(pose, expected);
            Some(self.kernel * (residual.dot(&(information * residual)) / self.kernel).ln_1p())
        });
        let odometry = poses
            .windows(2)
            .zip(&self.increments[1.min(self.increments.len())..])
            .map(|(pair, increment)| {
                let residual = relative(pair, increment);
                residual.dot(&(self.odometry_information * residual))
            });
        frames.sum::<f64>() + odometry.sum::<f64>()
    }

    /// Normal equations for steps in the frames of the poses.
    fn linearize(&self, poses: &[Pose2], damping: f64) -> NormalEquations {
        let count = poses.len();
        let mut equations = NormalEquations {
            diagonal: vec![Matrix3::zeros(); count],
            upper: vec![Matrix3::zeros(); count.saturating_sub(1)],
            right_side: vec![Vector3::zeros(); count],
        };
        for (frame, (pose, prior)) in poses.iter().zip(&self.priors).enumerate() {
            let Some((expected, information)) = prior else {
                continue;
            };
            let residual = deviation(pose, expected);
            let weight = 1.0 / (1.0 + residual.dot(&(information * residual)) / self.kernel);
            let jacobian = rotation(pose.rotation.angle());
            let weighted = weight * jacobian.transpose() * information;
            equations.diagonal[frame] += weighted * jacobian;
            equations.right_side[frame] -= weighted * residual;
        }
        for frame in 1..count {
            let pair = &poses[frame - 1..=frame];
            let increment = &self.increments[frame];
            let residual = relative(pair, increment);
            let (before, after) = relative_jacobians(pair, increment);
            let information = &self.odometry_information;
            equations.diagonal[frame - 1] += before.transpose() * information * before;
            equations.diagonal[frame] += after.transpose() * information * after;
            equations.upper[frame - 1] += before.transpose() * information * after;
            equations.right_side[frame - 1] -= before.transpose() * information * residual;
            equations.right_side[frame] -= after.transpose() * information * residual;
        }
        for block in &mut equations.diagonal {
            // Marquardt damping, and a small constant for frames without any measurement.
            *block += Matrix3::from_diagonal(&(block.diagonal() * damping).add_scalar(1e-12));
        }
        equations
    }
}

impl NormalEquations {
    /// Block Cholesky, forward and backward pass. `None` where a pivot is not positive definite.
    fn solve(mut self) -> Option<Vec<Vector3<f64>>> {
        let count = self.diagonal.len();
        let mut gains = Vec::with_capacity(count);
        for frame in 0..count {
            let pivot = self.diagonal[frame].cholesky()?;
            if frame + 1 < count {
                let gain = pivot.solve(&self.upper[frame]);
                let upper = self.upper[frame].transpose();
                self.diagonal[frame + 1] -= upper * gain;
                let carried = upper * pivot.solve(&self.right_side[frame]);
                self.right_side[frame + 1] -= carried;
                gains.push(gain);
            }
            self.right_side[frame] = pivot.solve(&self.right_side[frame]);
        }
        for frame in (0..count.saturating_sub(1)).rev() {
            let next = self.right_side[frame + 1];
            self.right_side[frame] -= gains[frame] * next;
        }
        Some(self.right_side)
    }

    /// The diagonal blocks of the inverse. `None` where a pivot is not positive definite.
    ///
    /// ```text
    /// Dᵢ = Aᵢ − Uᵢ₋₁ᵀ Dᵢ₋₁⁻¹ Uᵢ₋₁        Gᵢ = Dᵢ⁻¹ Uᵢ        Σᵢ = Dᵢ⁻¹ + Gᵢ Σᵢ₊₁ Gᵢᵀ
    /// ```
    fn diagonal_of_inverse(mut self) -> Option<Vec<Matrix3<f64>>> {
        let count = self.diagonal.len();
        let mut inverses: Vec<Matrix3<f64>> = Vec::with_capacity(count);
        for frame in 0..count {
            let pivot = self.diagonal[frame].cholesky()?;
            inverses.push(pivot.inverse());
            if let Some(upper) = self.upper.get(frame) {
                self.diagonal[frame + 1] -= upper.transpose() * pivot.solve(upper);
            }
        }
        for frame in (0..count.saturating_sub(1)).rev() {
            let gain = inverses[frame] * self.upper[frame];
            let carried = gain * inverses[frame + 1] * gain.transpose();
            inverses[frame] += carried;
        }
        Some(inverses)
    }
}

/// Residual of the odometry between two poses: zᵢ⁻¹ (xᵢ⁻¹ xᵢ₊₁).
fn relative(pair: &[Pose2], increment: &Pose2) -> Vector3<f64> {
    let residual = increment.inverse() * (pair[0].inverse() * pair[1]);
    residual.translation.vector.push(residual.rotation.angle())
}

/// Jacobians of [`relative`] by steps in the frames of the first and of the second pose.
fn relative_jacobians(pair: &[Pose2], increment: &Pose2) -> (Matrix3<f64>, Matrix3<f64>) {
    let between = pair[0].inverse() * pair[1];
    let back = Matrix2::from(increment.rotation.inverse().to_rotation_matrix());
    let t = between.translation.vector;
    // A turn of the first frame moves the second one in the opposite direction.
    let lever = back * Vector2::new(t.y, -t.x);
    let mut before = Matrix3::zeros();
    before.fixed_view_mut::<2, 2>(0, 0).copy_from(&-back);
    before.fixed_view_mut::<2, 1>(0, 2).copy_from(&lever);
    before[(2, 2)] = -1.0;
    let after = rotation((increment.rotation.inverse() * between.rotation).angle());
    (before, after)
}

/// Rotation of (x, y, heading), which leaves the heading.
fn rotation(angle_rad: f64) -> Matrix3<f64> {
    let (sin, cos) = angle_rad.sin_cos();
    Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use rand::{SeedableRng, rngs::StdRng};
    use rand_distr::{Distribution, StandardNormal};

    use super::*;

    /// A straight road with a corner of 90 degrees within five frames.
    fn corner() -> Vec<Pose2> {
        let mut pose = Pose2::new(Vector2::new(4.0, -2.0), 2.9);
        (0..60)
            .map(|frame| {
                let turn = if (28..33).contains(&frame) {
                    18.0_f64.to_radians()
                } else {
                    0.0
                };
                pose *= Pose2::new(Vector2::new(0.8, 0.0), turn);
                pose
            })
            .collect()
    }

    fn increments(poses: &[Pose2]) -> Vec<Pose2> {
        std::iter::once(Pose2::identity())
            .chain(poses.windows(2).map(|pair| pair[0].inverse() * pair[1]))
            .collect()
    }

    fn priors(poses: &[Pose2], sigma_m: f64, sigma_rad: f64) -> Vec<Option<FramePrior>> {
        let variances = Vector3::new(sigma_m, sigma_m, sigma_rad).map(|sigma| sigma * sigma);
        poses
            .iter()
            .map(|pose| {
                Some(FramePrior {
                    pose: *pose,
                    covariance: Matrix3::from_diagonal(&variances),
                })
            })
            .collect()
    }

    fn disturbed(poses: &[Pose2], sigma_m: f64, sigma_rad: f64, seed: u64) -> Vec<Pose2> {
        let mut rng = StdRng::seed_from_u64(seed);
        let mut draw = |sigma: f64| -> f64 {
            let deviate: f64 = StandardNormal.sample(&mut rng);
            sigma * deviate
        };
        poses
            .iter()
            .map(|pose| {
                let shift = Vector2::new(draw(sigma_m), draw(sigma_m));
                Pose2::new(
                    pose.translation.vector + shift,
                    pose.rotation.angle() + draw(sigma_rad),
                )
            })
            .collect()
    }

    fn rmse(a: &[Pose2], b: &[Pose2]) -> f64 {
        let squares = a
            .iter()
            .zip(b)
            .map(|(a, b)| (a.translation.vector - b.translation.vector).norm_squared());
        (squares.sum::<f64>() / a.len() as f64).sqrt()
    }

    #[test]
    fn consistent_measurements_give_the_truth_from_any_start() {
        let truth = corner();
        let start = disturbed(&truth, 0.3, 0.05, 1);
        let smooth = smooth(
            &start,
            &priors(&truth, 0.02, 0.002),
            &increments(&truth),
            &SmoothingConfig::default(),
        );
        for (smooth, truth) in smooth.iter().zip(&truth) {
            assert_relative_eq!(smooth, truth, epsilon = 1e-6);
        }
    }

    #[test]
    fn smoothing_reduces_noise_and_keeps_the_corner() {
        let truth = corner();
        for seed in 0..5 {
            let noisy = disturbed(&truth, 0.05, 0.005, seed);
            let odometry = disturbed(&increments(&truth), 0.005, 0.0005, seed + 100);
            let config = SmoothingConfig {
                odometry_ahead_m: 0.005,
                odometry_aside_m: 0.005,
                odometry_turn_rad: 0.0005,
                ..SmoothingConfig::default()
            };
            let smooth = smooth(&noisy, &priors(&noisy, 0.05, 0.005), &odometry, &config);
            assert!(rmse(&smooth, &truth) < 0.5 * rmse(&noisy, &truth));
            assert!(rmse(&smooth[27..34], &truth[27..34]) < 0.05);
        }
    }

    #[test]
    fn an_odometry_that_is_worse_than_assumed_does_not_bend_the_frames() {
        let truth = corner();
        for seed in 0..5 {
            let measured = disturbed(&truth, 0.01, 0.0005, seed);
            // Five per cent too long, and noisy.
            let long: Vec<Pose2> = (increments(&truth).iter())
                .map(|step| Pose2::new(1.05 * step.translation.vector, step.rotation.angle()))
                .collect();
            let odometry = disturbed(&long, 0.1, 0.01, seed + 100);
            let config = SmoothingConfig::default();
            let smooth = smooth(
                &measured,
                &priors(&measured, 0.01, 0.0005),
                &odometry,
                &config,
            );
            let (before, after) = (rmse(&measured, &truth), rmse(&smooth, &truth));
            assert!(after < 1.02 * before, "{before} {after}");
        }
    }

    #[test]
    fn an_odometry_does_not_bend_frames_whose_errors_are_those_of_the_map() {
        let truth = corner();
        let mut squares = [0.0; 3];
        for seed in 0..10 {
            // Surfaces are off by 4 mm, each along a stretch of 15 frames; a millimetre is of each scan.
            let surfaces = disturbed(&[Pose2::identity(); 4], 0.004, 1e-4, seed);
            let measured: Vec<Pose2> = disturbed(&truth, 0.001, 5e-5, seed + 50)
                .iter()
                .enumerate()
                .map(|(frame, pose)| pose * surfaces[frame / 15])
                .collect();
            let odometry = disturbed(&increments(&truth), 0.01, 3e-4, seed + 100);
            let smoothed = |sigma_m: f64, sigma_rad: f64| {
                let priors = priors(&measured, sigma_m, sigma_rad);
                smooth(&measured, &priors, &odometry, &SmoothingConfig::default())
            };
            let poses = [&measured, &smoothed(0.001, 5e-5), &smoothed(0.0041, 1.1e-4)];
            for (sum, poses) in squares.iter_mut().zip(poses) {
                *sum += rmse(poses, &truth).powi(2);
            }
        }
        let [before, of_scans, with_surfaces] = squares;
        assert!(of_scans < 1.02 * before, "{squares:?}");
        assert!(of_scans < with_surfaces, "{squares:?}");
    }

    #[test]
    fn an_outlier_has_little_influence() {
        let truth = corner();
        let mut wrong = truth.clone();
        wrong[20] = Pose2::translation(3.0, 3.0) * wrong[20];
        let smooth = smooth(
            &wrong,
            &priors(&wrong, 0.02, 0.002),
            &increments(&truth),
            &SmoothingConfig::default(),
        );
        assert!(rmse(&smooth, &truth) < 0.01, "{}", rmse(&smooth, &truth));
    }

    #[test]
    fn frames_without_a_measured_pose_follow_from_the_odometry() {
        let truth = corner();
        let mut some = priors(&truth, 0.02, 0.002);
        some[..10].fill(None);
        some[40..].fill(None);
        let start = disturbed(&truth, 0.2, 0.02, 3);
        let smooth = smooth(
            &start,
            &some,
            &increments(&truth),
            &SmoothingConfig::default(),
        );
        assert!(rmse(&smooth, &truth) < 1e-5);
    }

    #[test]
    fn smoothing_does_not_depend_on_the_map_frame() {
        let truth = corner();
        let noisy = disturbed(&truth, 0.05, 0.005, 9);
        let elsewhere = Pose2::new(Vector2::new(-300.0, 70.0), 1.2);
        let moved: Vec<Pose2> = noisy.iter().map(|pose| elsewhere * pose).collect();
        let config = SmoothingConfig::default();
        let odometry = increments(&truth);
        let here = smooth(&noisy, &priors(&noisy, 0.05, 0.005), &odometry, &config);
        let there = smooth(&moved, &priors(&moved, 0.05, 0.005), &odometry, &config);
        for (here, there) in here.iter().zip(&there) {
            assert_relative_eq!(elsewhere * here, *there, epsilon = 1e-5);
        }
    }

    #[test]
    fn an_empty_trajectory_and_a_singular_covariance_are_allowed() {
        let config = SmoothingConfig::default();
        assert_eq!(smooth(&[], &[], &[], &config), []);
        let pose = Pose2::translation(1.0, 2.0);
        let singular = Some(FramePrior {
            pose,
            covariance: Matrix3::zeros(),
        });
        assert_eq!(smooth(&[pose], &[singular], &[pose], &config), [pose]);
    }

    #[test]
    fn the_covariances_are_the_diagonal_blocks_of_the_inverse() {
        let truth: Vec<Pose2> = corner()[26..34].to_vec();
        let mut some = priors(&truth, 0.05, 0.004);
        some[2] = None;
        let config = SmoothingConfig::default();
        let (priors, increments) = (some, increments(&truth));
        let found = covariances(&truth, &priors, &increments, &config).unwrap();
        let equations = Problem::new(&priors, &increments, &config).linearize(&truth, 0.0);
        let size = 3 * truth.len();
        let mut dense = nalgebra::DMatrix::zeros(size, size);
        for (frame, block) in equations.diagonal.iter().enumerate() {
            dense
                .view_mut((3 * frame, 3 * frame), (3, 3))
                .copy_from(block);
        }
        for (frame, block) in equations.upper.iter().enumerate() {
            let (row, column) = (3 * frame, 3 * frame + 3);
            dense.view_mut((row, column), (3, 3)).copy_from(block);
            dense
                .view_mut((column, row), (3, 3))
                .copy_from(&block.transpose());
        }
        let inverse = dense.try_inverse().unwrap();
        for (frame, (found, pose)) in found.iter().zip(&truth).enumerate() {
            let turn = rotation(pose.rotation.angle());
            let block = inverse.fixed_view::<3, 3>(3 * frame, 3 * frame);
            let expected = turn * block * turn.transpose();
            assert_relative_eq!(*found, expected, max_relative = 1e-9, epsilon = 1e-12);
        }
    }

    #[test]
    fn errors_of_smoothed_poses_match_their_covariances() {
        let truth = corner();
        let config = SmoothingConfig {
            odometry_ahead_m: 0.01,
            odometry_aside_m: 0.01,
            odometry_turn_rad: 0.001,
            robust_sigmas: 1e3,
            ..SmoothingConfig::default()
        };
        let mut squares = Vec::new();
        for seed in 0..20 {
            let noisy = disturbed(&truth, 0.05, 0.005, seed);
            let odometry = disturbed(&increments(&truth), 0.01, 0.001, seed + 100);
            let priors = priors(&noisy, 0.05, 0.005);
            let smoothed = smooth(&noisy, &priors, &odometry, &config);
            let found = covariances(&smoothed, &priors, &odometry, &config).unwrap();
            for ((pose, truth), covariance) in smoothed.iter().zip(&truth).zip(found) {
                let error = deviation(pose, truth);
                squares.push(error.dot(&(covariance.try_inverse().unwrap() * error)));
            }
        }
        // Three degrees of freedom; errors of neighbors are correlated: 1200 poses count as about 100.
        let mean = squares.iter().sum::<f64>() / squares.len() as f64;
        assert_relative_eq!(mean, 3.0, epsilon = 4.0 * (6.0_f64 / 100.0).sqrt());
    }

    #[test]
    fn the_odometry_is_uncertain_ahead_and_aside_of_the_car_wherever_it_heads() {
        let config = SmoothingConfig {
            odometry_ahead_m: 0.3,
            odometry_aside_m: 0.1,
            odometry_turn_rad: 0.01,
            ..SmoothingConfig::default()
        };
        let step = Pose2::translation(2.0, 0.0);
        for heading in [0.0, 0.7, 2.5] {
            let first = Pose2::new(Vector2::new(5.0, -3.0), heading);
            let poses = [first, first * step, first * step * step];
            let measured = Some(FramePrior {
                pose: first,
                covariance: Matrix3::identity() * 1e-12,
            });
            let found = covariances(&poses, &[measured, None, None], &[step; 3], &config).unwrap();
            // Two steps add up in the axes of the car, and the turn of the first moves the second aside.
            let aside_of_turn = 2.0 * 1e-4;
            let in_car = Matrix3::new(
                2.0 * 0.09,
                0.0,
                0.0,
                0.0,
                2.0 * 0.01 + 2.0 * aside_of_turn,
                aside_of_turn,
                0.0,
                aside_of_turn,
                2e-4,
            );
            let turn = rotation(heading);
            let expected = turn * in_car * turn.transpose();
            assert_relative_eq!(found[2], expected, epsilon = 1e-8);
        }
    }

    #[test]
    fn the_noise_of_the_odometry_is_observed_ahead_and_aside_of_the_car() {
        let step = Pose2::translation(1.0, 0.0);
        let mut pose = Pose2::new(Vector2::zeros(), 1.1);
        let mut rng = StdRng::seed_from_u64(8);
        let count = 4000;
        let (mut priors, mut increments) = (Vec::new(), Vec::new());
        let turn = rotation(1.1);
        // Measured poses are uncertain aside of the car only, the odometry ahead only.
        let in_car = Matrix3::from_diagonal(&Vector3::new(1e-8, 0.04, 1e-8));
        let mut normal = |sigma: f64| -> f64 {
            let deviate: f64 = StandardNormal.sample(&mut rng);
            sigma * deviate
        };
        for _ in 0..count {
            pose *= step;
            priors.push(Some(FramePrior {
                pose: pose * Pose2::translation(0.0, normal(0.2)),
                covariance: turn * in_car * turn.transpose(),
            }));
            increments.push(Pose2::translation(1.0 + normal(0.3), 0.0));
        }
        let config = SmoothingConfig {
            odometry_ahead_m: 0.02,
            odometry_aside_m: 0.03,
            ..SmoothingConfig::default()
        };
        let found = config.observed(&priors, &increments);
        // A standard deviation by the median has a relative one of 1.17 / sqrt(n).
        let error = 4.0 * 1.17 / f64::from(count).sqrt();
        assert_relative_eq!(found.odometry_ahead_m, 0.3, max_relative = error);
        // What the covariances of the poses explain is no noise of the odometry.
        assert_eq!(found.odometry_aside_m, config.odometry_aside_m);
        assert_eq!(found.odometry_turn_rad, config.odometry_turn_rad);
    }

    #[test]
    fn a_noise_on_the_odometry_is_its_least_deviation_per_step() {
        let config = SmoothingConfig::default();
        // A turn of 0.04 rad moves the end of a step of 2 m by 0.08 m; there are two of them.
        let found = config.with_noise(&OdometryNoise::constant(0.04, 0.2, 0.06), 2.0);
        assert_relative_eq!(found.odometry_ahead_m, 0.2, epsilon = 1e-12);
        assert_relative_eq!(found.odometry_aside_m, 0.1, epsilon = 1e-12);
        let turn_rad = std::f64::consts::SQRT_2 * 0.04;
        assert_relative_eq!(found.odometry_turn_rad, turn_rad, epsilon = 1e-12);
        let small = OdometryNoise::constant(1e-4, 1e-3, 1e-3);
        assert_eq!(config.with_noise(&small, 1.0), config);
    }

    #[test]
    fn a_step_that_fits_worse_is_not_taken() {
        let truth = corner();
        let config = SmoothingConfig {
            iterations: 1,
            ..SmoothingConfig::default()
        };
        let mut is_refused = false;
        for seed in 0..10 {
            // So far off that a step of Gauss-Newton often leads farther away.
            let start = disturbed(&truth, 3.0, 2.0, seed);
            let (priors, increments) = (priors(&truth, 0.02, 0.002), increments(&truth));
            let problem = Problem::new(&priors, &increments, &config);
            let smooth = smooth(&start, &priors, &increments, &config);
            assert!(problem.cost(&smooth) <= problem.cost(&start), "{seed}");
            is_refused |= smooth == start;
        }
        assert!(is_refused);
    }

    #[test]
    fn a_smoothed_trajectory_is_where_its_cost_is_least() {
        let truth = corner();
        let noisy = disturbed(&truth, 0.05, 0.005, 1);
        let odometry = disturbed(&increments(&truth), 0.02, 0.001, 101);
        let (priors, config) = (priors(&noisy, 0.05, 0.005), SmoothingConfig::default());
        let smoothed = smooth(&noisy, &priors, &odometry, &config);
        let problem = Problem::new(&priors, &odometry, &config);
        for frame in 0..truth.len() {
            for (axis, step) in [1e-4, 1e-4, 1e-5].into_iter().enumerate() {
                let [before, here, after] = [-step, 0.0, step].map(|step| {
                    let step = Vector3::ith(axis, step);
                    let mut moved = smoothed.clone();
                    moved[frame] *= Pose2::new(step.xy(), step.z);
                    problem.cost(&moved)
                });
                // The minimum of the parabola through the three, in steps.
                let off = 0.5 * (before - after) / (before - 2.0 * here + after);
                assert!(off.abs() < 0.01, "{frame} {axis}: {off}");
            }
        }
    }

    #[test]
    fn after_a_step_that_is_refused_shorter_ones_lead_to_the_truth() {
        let truth = corner();
        let (priors, increments) = (priors(&truth, 0.02, 0.002), increments(&truth));
        let start: Vec<Pose2> = (truth.iter().enumerate())
            .map(|(frame, pose)| pose * Pose2::rotation(2.6 * (2.5 * frame as f64).sin()))
            .collect();
        let after = |iterations: usize| {
            let config = SmoothingConfig {
                iterations,
                ..SmoothingConfig::default()
            };
            smooth(&start, &priors, &increments, &config)
        };
        assert!(after(1) != start && after(2) == after(1));
        for (found, truth) in after(20).iter().zip(&truth) {
            assert_relative_eq!(found, truth, epsilon = 1e-6);
        }
    }

    #[test]
    fn without_measured_poses_the_covariance_is_undefined_or_large() {
        let truth = corner();
        let config = SmoothingConfig::default();
        let unmeasured = vec![None; truth.len()];
        let found = covariances(&truth, &unmeasured, &increments(&truth), &config);
        assert!(found.is_none_or(|all| all[0][(0, 0)] > 1e6));
    }

    #[test]
    fn the_jacobians_are_the_derivatives_of_the_residuals() {
        let pair = [
            Pose2::new(Vector2::new(1.0, 2.0), 0.7),
            Pose2::new(Vector2::new(1.9, 2.4), 0.9),
        ];
        let increment = Pose2::new(Vector2::new(0.9, -0.1), 0.25);
        let (before, after) = relative_jacobians(&pair, &increment);
        for axis in 0..3 {
            let step = Vector3::ith(axis, 1e-6);
            let step = Pose2::new(step.xy(), step.z);
            let derivative = |moved: [Pose2; 2]| {
                (relative(&moved, &increment) - relative(&pair, &increment)) / 1e-6
            };
            assert_relative_eq!(
                derivative([pair[0] * step, pair[1]]),
                before.column(axis).into_owned(),
                epsilon = 1e-5
            );
            assert_relative_eq!(
                derivative([pair[0], pair[1] * step]),
                after.column(axis).into_owned(),
                epsilon = 1e-5
            );
        }
    }
}
