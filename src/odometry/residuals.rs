//! Linearized residuals of a scan at a pose, and their sums.
//!
//! ```text
//! rᵢ = nᵢ · (odom_from_lidar qᵢ − sᵢ),   qᵢ = exp(fᵢ log(previous_from_current)) pᵢ,   fᵢ = tᵢ / T
//! ∂rᵢ / ∂(translation, rotation) = (1 + fᵢ) (nᵢ, qᵢ × nᵢ)                 n in the lidar frame
//! wᵢ = (1 + rᵢ²/c²)⁻²                                                     Geman-McClure kernel
//! ```
//!
//! A change of the pose also changes the motion, hence the factor 1 + f. Where the neighbours of a point form no plane,
//! it has a residual to their mean, with the information σ² (Σ + σ²)⁻¹ of their covariance Σ and the noise σ: all of it
//! across a thin pole, little along it, little in a bush.

use glam::{DMat3, DQuat, DVec3, IVec3};
use nalgebra::{Matrix6, Vector6};
use rayon::prelude::*;

use super::sampling::TimedPoint;
use super::voxel_map::{Shape, Surface, VoxelMap};
use crate::geometry::{Pose3, Rigid3f, RobustKernel, azimuth_sector};
use crate::lidar::{Motion, Sweep};

/// Azimuth sectors, the clusters of correlated residuals in the covariance.
const SECTORS: usize = 24;

/// A scan and the local map.
#[derive(Clone, Copy)]
pub struct Observation<'a> {
    /// The local map.
    pub map: &'a VoxelMap,
    /// Points of the scan.
    pub points: &'a [TimedPoint],
    /// Their times.
    pub sweep: Sweep,
    /// Pose of the previous scan.
    pub odom_from_previous: Pose3,
    /// Time since then [s].
    pub duration_s: f64,
    /// Standard deviation of a measured point [m].
    pub noise_m: f64,
}

/// The match of a point; it holds while the point stays in its block of voxels.
#[derive(Clone, Copy, Default)]
pub struct Match {
    block: Option<IVec3>,
    surface: Option<Surface>,
}

/// Sums of the normal equations.
#[derive(Clone, Default)]
pub struct Sums {
    /// Σ w Jᵀ J
    pub information: Matrix6<f64>,
    /// −Σ w Jᵀ r
    pub right_side: Vector6<f64>,
    /// Σ w
    pub weight: f64,
    /// Σ w r² [m²]
    pub squares: f64,
    /// Number of points.
    pub count: usize,
}

/// Residuals of all points.
#[derive(Clone)]
pub struct Equations {
    /// Sums of points on planes.
    pub planar: Sums,
    /// Sums of other points.
    pub other: Sums,
    /// Σ w Jᵀ r of points on planes, per sector of the azimuth.
    pub gradients: [Vector6<f64>; SECTORS],
    /// Sum of the robust costs, 0 to 1 each; points without a match cost 1.
    pub cost: f64,
    /// Distances to planes [m].
    pub distances_m: Vec<f32>,
}

/// The pose at which residuals are linearized.
struct Linearization {
    rotation: DMat3,
    lidar_from_odom: DMat3,
    translation: DVec3,
    /// Motion compensation per interval of the sweep.
    compensation: Vec<Rigid3f>,
    kernel: RobustKernel,
}

impl Observation<'_> {
    /// A match per point, still unknown.
    pub fn unmatched(&self) -> Vec<Match> {
        vec![Match::default(); self.points.len()]
    }

    /// Residuals of all points at a pose, for a robust kernel of scale `kernel_m`.
    pub fn linearize(&self, pose: &Pose3, kernel_m: f64, matches: &mut [Match]) -> Equations {
        /// Points of one task; sums do not depend on the number of threads.
        const CHUNK: usize = 512;
        let motion = Motion {
            previous_from_current: self.odom_from_previous.inverse() * pose,
            duration_s: self.duration_s,
        };
        let rotation = DMat3::from_quat(DQuat::from(pose.rotation));
        let at = Linearization {
            rotation,
            lidar_from_odom: rotation.transpose(),
            translation: pose.translation.vector.into(),
            compensation: self.sweep.transforms(&motion),
            kernel: RobustKernel { scale_m: kernel_m },
        };
        let parts: Vec<Equations> = (self.points.par_chunks(CHUNK))
            .zip(matches.par_chunks_mut(CHUNK))
            .map(|(points, matches)| {
                let mut equations = Equations::new();
                for (point, matched) in points.iter().zip(matches) {
                    self.add(&mut equations, point, matched, &at);
                }
                equations
            })
            .collect();
        let mut sum = Equations::new();
        parts.iter().for_each(|part| sum.merge(part));
        sum
    }

    /// Adds the residuals of a point.
    fn add(
        &self,
        equations: &mut Equations,
        point: &TimedPoint,
        matched: &mut Match,
        at: &Linearization,
    ) {
        /// Residuals beyond have no influence, in kernels.
        const GATE: f64 = 3.0;
        let interval = self.sweep.interval(point.time_s);
        let in_lidar = at.compensation[interval].apply(point.position).as_dvec3();
        let in_odom = at.rotation * in_lidar + at.translation;
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
        let information = match surface.shape {
            Shape::Plane(_) => DMat3::IDENTITY,
            Shape::Other(covariance) => {
                (covariance * self.noise_m.powi(-2) + DMat3::IDENTITY).inverse()
            }
        };
        let distance_m = match surface.shape {
            Shape::Plane(normal) => normal.dot(offset),
            Shape::Other(_) => offset.dot(information * offset).sqrt(),
        };
        if distance_m.abs() > GATE * at.kernel.scale_m {
            equations.cost += 1.0;
            return;
        }
        let weight = at.kernel.weight(distance_m);
        equations.cost += at.kernel.cost(distance_m);
        let factor = 1.0 + f64::from(point.time_s) / self.duration_s;
        if let Shape::Plane(normal) = surface.shape {
            equations.distances_m.push(distance_m.abs() as f32);
            let jacobian = factor * jacobian(at.lidar_from_odom * normal, in_lidar);
            equations.planar.add(&jacobian, distance_m, weight);
            equations.planar.count(distance_m, weight);
            let sector = azimuth_sector(point.position, SECTORS);
            equations.gradients[sector] += weight * distance_m * jacobian;
        } else {
            let information = at.lidar_from_odom * information * at.rotation;
            let pull = information * (at.lidar_from_odom * offset);
            let jacobian = DVec3::AXES.map(|axis| factor * jacobian(axis, in_lidar));
            let sums = &mut equations.other;
            for row in 0..3 {
                sums.right_side -= weight * pull[row] * jacobian[row];
                for column in 0..3 {
                    let value = weight * information.col(column)[row];
                    (sums.information).ger(value, &jacobian[row], &jacobian[column], 1.0);
                }
            }
            sums.count(distance_m, weight);
        }
    }
}

/// Derivative of the distance along a normal by translation and rotation of the sensor.
fn jacobian(normal: DVec3, point: DVec3) -> Vector6<f64> {
    let turn = point.cross(normal);
    Vector6::new(normal.x, normal.y, normal.z, turn.x, turn.y, turn.z)
}

impl Sums {
    fn add(&mut self, jacobian: &Vector6<f64>, residual_m: f64, weight: f64) {
        self.information.ger(weight, jacobian, jacobian, 1.0);
        self.right_side -= weight * residual_m * jacobian;
    }

    fn count(&mut self, distance_m: f64, weight: f64) {
        self.weight += weight;
        self.squares += weight * distance_m * distance_m;
        self.count += 1;
    }

    fn merge(&mut self, other: &Self) {
        self.information += other.information;
        self.right_side += other.right_side;
        self.weight += other.weight;
        self.squares += other.squares;
        self.count += other.count;
    }
}

impl Equations {
    fn new() -> Self {
        Self {
            planar: Sums::default(),
            other: Sums::default(),
            gradients: [Vector6::zeros(); SECTORS],
            cost: 0.0,
            distances_m: Vec::new(),
        }
    }

    fn merge(&mut self, other: &Self) {
        self.planar.merge(&other.planar);
        self.other.merge(&other.other);
        for (gradient, of_other) in self.gradients.iter_mut().zip(&other.gradients) {
            *gradient += of_other;
        }
        self.cost += other.cost;
        self.distances_m.extend_from_slice(&other.distances_m);
    }
}
