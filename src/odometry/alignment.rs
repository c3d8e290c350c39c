//! Gauss-Newton of a scan to the local map, with the motion within the sweep.
//!
//! ```text
//! rᵢ = nᵢ · (odom_from_lidar qᵢ − sᵢ),   qᵢ = exp(fᵢ log(previous_from_current)) pᵢ,   fᵢ = tᵢ / T
//! ∂rᵢ / ∂(translation, rotation) = (1 + fᵢ) (nᵢ, qᵢ × nᵢ)                 n in the lidar frame
//! ```
//!
//! A change of the pose also changes the motion, hence the factor 1 + f. Other points than planar ones have
//! residuals along three axes; both kinds are weighted by the share of the planar ones (GenZ-ICP, eq. 11).

use glam::{DVec3, IVec3};
use nalgebra::{Matrix6, Point3, UnitQuaternion, Vector3, Vector6};
use rayon::prelude::*;

use super::sampling::TimedPoint;
use super::voxel_map::{Surface, VoxelMap};
use crate::geometry::Pose3;
use crate::lidar::Motion;

/// Azimuth sectors, the clusters of correlated residuals in the covariance.
const SECTORS: usize = 24;

/// Neighbouring residuals are correlated: so many count as one against the prediction.
const CORRELATED: f64 = 10.0;

/// A scan to be registered.
#[derive(Clone, Copy)]
pub struct Problem<'a> {
    /// The local map.
    pub map: &'a VoxelMap,
    /// Points of the scan.
    pub points: &'a [TimedPoint],
    /// Pose of the previous scan.
    pub odom_from_previous: Pose3,
    /// Time since then [s].
    pub duration_s: f64,
    /// Predicted pose.
    pub predicted: Pose3,
    /// Inverse covariance of the prediction, (x, y, z, roll, pitch, yaw) in the lidar frame.
    pub prior_information: Matrix6<f64>,
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
    /// Information of the residuals per unit of weight, without the prediction.
    pub information: Matrix6<f64>,
    /// Robust root mean square of the distances to planes [m].
    pub residual_m: f64,
    /// Share of the points within the gate.
    pub matched_share: f64,
    /// Mean robust cost of all points, 0 to 1.
    pub cost: f64,
}

/// The match of a point; it holds while the point stays in its block of voxels.
#[derive(Clone, Copy, Default)]
struct Match {
    block: Option<IVec3>,
    surface: Option<Surface>,
}

/// Sums of the normal equations.
#[derive(Clone)]
struct Sums {
    information: Matrix6<f64>,
    right_side: Vector6<f64>,
    weight: f64,
    squares: f64,
    count: usize,
}

impl Default for Sums {
    fn default() -> Self {
        Self {
            information: Matrix6::zeros(),
            right_side: Vector6::zeros(),
            weight: 0.0,
            squares: 0.0,
            count: 0,
        }
    }
}

impl Sums {
    fn add(&mut self, jacobian: &Vector6<f64>, residual_m: f64, weight: f64) {
        self.information.ger(weight, jacobian, jacobian, 1.0);
        self.right_side -= weight * residual_m * jacobian;
    }

    fn merge(&mut self, other: &Self) {
        self.information += other.information;
        self.right_side += other.right_side;
        self.weight += other.weight;
        self.squares += other.squares;
        self.count += other.count;
    }
}

/// Sums of planar and of other points.
#[derive(Clone, Default)]
struct Equations {
    planar: Sums,
    other: Sums,
    gradients: Vec<Vector6<f64>>,
    cost: f64,
    distances: Vec<f32>,
}

impl Problem<'_> {
    /// Registers the scan from an initial pose and with an initial scale of the kernel; `None` if the
    /// equations cannot be solved.
    pub fn align(&self, initial: &Pose3, kernel_m: f64) -> Option<Alignment> {
        const SHRINK: f64 = 0.5;
        /// Kernel in robust standard deviations of the residuals.
        const KERNEL_SIGMAS: f64 = 3.0;
        /// Lever of rotations, in kernels.
        const TOLERANCE: f64 = 0.01;
        const MAX_KERNEL: f64 = 10.0;
        const SCORE_KERNEL: f64 = 2.0;
        let lever_m = self.lever();
        let mut pose = *initial;
        let mut kernel_m = kernel_m.max(self.min_kernel_m);
        let mut matches = vec![Match::default(); self.points.len()];
        let mut result: Option<Alignment> = None;
        for _ in 0..self.iterations {
            let mut equations = self.linearize(&pose, kernel_m, &mut matches);
            let (step, alignment) = self.solve(&equations, &pose)?;
            pose *= exponential(&step);
            result = Some(alignment);
            let scale_m = 1.48 * median(&mut equations.distances)?;
            let target_m =
                (KERNEL_SIGMAS * scale_m).clamp(self.min_kernel_m, MAX_KERNEL * self.min_kernel_m);
            let shift_m = step.fixed_rows::<3>(0).norm() + lever_m * step.fixed_rows::<3>(3).norm();
            if kernel_m <= 1.1 * target_m && shift_m < TOLERANCE * self.min_kernel_m {
                break;
            }
            kernel_m = (SHRINK * kernel_m).max(target_m).min(kernel_m);
        }
        let cost = self.cost(&pose, SCORE_KERNEL * self.min_kernel_m, &mut matches);
        Some(Alignment {
            odom_from_lidar: pose,
            cost,
            ..result?
        })
    }

    /// Mean robust cost of all points, 0 to 1, and the share of the prediction in it.
    fn cost(&self, pose: &Pose3, kernel_m: f64, matches: &mut [Match]) -> f64 {
        let deviation = logarithm(&(self.predicted.inverse() * pose));
        let prior = 0.5 * deviation.dot(&(self.prior_information * deviation)) * CORRELATED;
        (self.linearize(pose, kernel_m, matches).cost + prior) / self.points.len().max(1) as f64
    }

    /// The mean robust cost at a pose.
    pub fn cost_at(&self, pose: &Pose3, kernel_m: f64) -> f64 {
        self.cost(
            pose,
            kernel_m,
            &mut vec![Match::default(); self.points.len()],
        )
    }

    /// Root mean square of the ranges: what a rotation moves a point by [m].
    pub fn lever(&self) -> f64 {
        let squares: f64 = self
            .points
            .iter()
            .map(|p| f64::from(p.position.length_squared()))
            .sum();
        (squares / self.points.len().max(1) as f64).sqrt()
    }

    /// Residuals of all points at a pose.
    fn linearize(&self, pose: &Pose3, kernel_m: f64, matches: &mut [Match]) -> Equations {
        /// Points that one task takes; sums do not depend on the number of threads.
        const CHUNK: usize = 512;
        let motion = Motion {
            previous_from_current: self.odom_from_previous.inverse() * pose,
            duration_s: self.duration_s,
        };
        let parts: Vec<Equations> = (self.points.par_chunks(CHUNK))
            .zip(matches.par_chunks_mut(CHUNK))
            .map(|(points, matches)| {
                let mut equations = Equations {
                    gradients: vec![Vector6::zeros(); SECTORS],
                    ..Equations::default()
                };
                for (point, matched) in points.iter().zip(matches) {
                    self.add(point, matched, pose, &motion, kernel_m, &mut equations);
                }
                equations
            })
            .collect();
        let mut sum = Equations {
            gradients: vec![Vector6::zeros(); SECTORS],
            ..Equations::default()
        };
        for part in &parts {
            sum.planar.merge(&part.planar);
            sum.other.merge(&part.other);
            sum.cost += part.cost;
            sum.distances.extend_from_slice(&part.distances);
            for (gradient, of_part) in sum.gradients.iter_mut().zip(&part.gradients) {
                *gradient += of_part;
            }
        }
        sum
    }

    /// Adds the residuals of a point.
    fn add(
        &self,
        point: &TimedPoint,
        matched: &mut Match,
        pose: &Pose3,
        motion: &Motion,
        kernel_m: f64,
        equations: &mut Equations,
    ) {
        const GATE: f64 = 3.0;
        let measured: Point3<f64> = Point3::new(
            point.position.x.into(),
            point.position.y.into(),
            point.position.z.into(),
        );
        let in_lidar = match point.time_s == 0.0 {
            true => measured,
            false => motion.after(point.time_s.into()) * measured,
        };
        let in_odom = pose * in_lidar;
        let in_odom = DVec3::new(in_odom.x, in_odom.y, in_odom.z);
        let block = self.map.block(in_odom);
        if matched.block != Some(block) {
            *matched = Match {
                block: Some(block),
                surface: self.map.surface(in_odom),
            };
        }
        let Some(surface) = &matched.surface else {
            equations.cost += 1.0;
            return;
        };
        let offset = in_odom - surface.center;
        let factor = 1.0 + f64::from(point.time_s) / self.duration_s;
        let lever = in_lidar.coords;
        let lidar_from_odom = pose.rotation.inverse();
        let turns = 0.5 + point.position.y.atan2(point.position.x) / std::f32::consts::TAU;
        let sector = ((turns * SECTORS as f32) as usize).min(SECTORS - 1);
        if surface.is_planar {
            let distance_m = surface.normal.dot(offset);
            if distance_m.abs() > GATE * kernel_m {
                equations.cost += 1.0;
                return;
            }
            equations.distances.push(distance_m.abs() as f32);
            let ratio = (distance_m / kernel_m).powi(2);
            let weight = (1.0 + ratio).powi(-2);
            equations.cost += ratio / (1.0 + ratio);
            let normal = lidar_from_odom
                * Vector3::new(surface.normal.x, surface.normal.y, surface.normal.z);
            let jacobian = factor * jacobian(&normal, &lever);
            let sums = &mut equations.planar;
            sums.add(&jacobian, distance_m, weight);
            sums.weight += weight;
            sums.squares += weight * distance_m * distance_m;
            sums.count += 1;
            equations.gradients[sector] += weight * distance_m * jacobian;
        } else {
            let distance_m = offset.length();
            if distance_m > GATE * kernel_m {
                equations.cost += 1.0;
                return;
            }
            let ratio = (distance_m / kernel_m).powi(2);
            let weight = (1.0 + ratio).powi(-2);
            equations.cost += ratio / (1.0 + ratio);
            let sums = &mut equations.other;
            let offset = lidar_from_odom * Vector3::new(offset.x, offset.y, offset.z);
            for axis in 0..3 {
                let mut direction = Vector3::zeros();
                direction[axis] = 1.0;
                let jacobian = factor * jacobian(&direction, &lever);
                sums.add(&jacobian, offset[axis], weight);
            }
            sums.weight += weight;
            sums.count += 1;
        }
    }

    /// The Gauss-Newton step and the accuracy of the pose.
    fn solve(&self, equations: &Equations, pose: &Pose3) -> Option<(Vector6<f64>, Alignment)> {
        const MIN_MATCHES: usize = 30;
        let (planar, other) = (&equations.planar, &equations.other);
        let count = planar.count + other.count;
        if count < MIN_MATCHES || planar.weight <= 0.0 {
            return None;
        }
        let share = planar.count as f64 / count as f64;
        let other_share = 1.0 - share;
        let variance = (planar.squares / planar.weight).max(1e-6);
        let information = share * planar.information + other_share * other.information;
        let prior = self.prior_information * (variance * CORRELATED);
        let total = (information + prior).cholesky()?;
        let right_side = share * planar.right_side + other_share * other.right_side
            - prior * logarithm(&(self.predicted.inverse() * pose));
        let step = total.solve(&right_side);
        let inverse = total.inverse();
        let scatter: Matrix6<f64> = (equations.gradients.iter())
            .map(|g| g * g.transpose())
            .sum::<Matrix6<f64>>()
            * (share * share);
        let noise = information * variance + scatter + prior * (variance * CORRELATED);
        let alignment = Alignment {
            odom_from_lidar: *pose,
            covariance: inverse * noise * inverse,
            information: information / (share * planar.weight + other_share * other.weight),
            residual_m: variance.sqrt(),
            matched_share: count as f64 / self.points.len() as f64,
            cost: 1.0,
        };
        (step.iter().all(|value| value.is_finite())).then_some((step, alignment))
    }
}

fn jacobian(normal: &Vector3<f64>, lever: &Vector3<f64>) -> Vector6<f64> {
    let turn = lever.cross(normal);
    Vector6::new(normal.x, normal.y, normal.z, turn.x, turn.y, turn.z)
}

/// The transform of (translation [m], rotation vector [rad]).
pub fn exponential(step: &Vector6<f64>) -> Pose3 {
    Pose3::from_parts(
        Vector3::new(step[0], step[1], step[2]).into(),
        UnitQuaternion::from_scaled_axis(Vector3::new(step[3], step[4], step[5])),
    )
}

/// The inverse of [`exponential`].
pub fn logarithm(pose: &Pose3) -> Vector6<f64> {
    let (t, r) = (pose.translation.vector, pose.rotation.scaled_axis());
    Vector6::new(t.x, t.y, t.z, r.x, r.y, r.z)
}

fn median(values: &mut [f32]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| (*values.select_nth_unstable_by(middle, f32::total_cmp).1).into())
}
