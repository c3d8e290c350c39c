//! Linearized residuals of a scan at a pose, and their sums.
//!
//! ```text
//! rᵢ = nᵢ · (odom_from_lidar qᵢ − sᵢ),   qᵢ = exp(fᵢ log(previous_from_current)) pᵢ,   fᵢ = tᵢ / T
//! ∂rᵢ / ∂(translation, rotation) = (1 + fᵢ) (nᵢ, qᵢ × nᵢ)                 n in the lidar frame
//! wᵢ = (1 + rᵢ²/c²)⁻²                                                     Geman-McClure kernel
//! ```
//!
//! A change of the pose also changes the motion, hence the factor 1 + f; where a gyroscope has measured the rotation within the
//! sweep, it does not change that, and the rotation has none. Where the neighbours of a point form no plane,
//! it has a residual to their mean, with the information σ² (Σ + σ²)⁻¹ of their covariance Σ and the noise σ: all of it
//! across a thin pole, little along it, little in a bush.
//!
//! How well a pose fits is judged without level surfaces: the ground looks the same wherever the sensor is.

use glam::{DMat3, DQuat, DVec3, IVec3};
use nalgebra::{Matrix6, UnitQuaternion, Vector6};
use rayon::prelude::*;

use super::sampling::TimedPoint;
use super::voxel_map::{Shape, Surface, VoxelMap};
use crate::geometry::{Pose3, Rigid3f, RobustKernel, azimuth_sector};
use crate::lidar::{Motion, Sweep};

/// Azimuth sectors, the clusters of correlated residuals in the covariance.
const SECTORS: usize = 24;
/// Least vertical component of the normal of a level surface: up to 37 degrees of slope.
pub const LEVEL: f64 = 0.8;
/// Distance from a plane below which a point lies on it, in standard deviations of a measured point.
const ON_PLANE: f64 = 2.5;
/// Fewer points do not tell how well a pose fits.
const MIN_UPRIGHT: usize = 30;

/// A scan and the local map.
#[derive(Clone, Copy)]
pub struct Observation<'a> {
    /// The local map.
    pub map: &'a VoxelMap,
    /// Points of the scan.
    pub points: &'a [TimedPoint],
    /// Their times.
    pub sweep: Sweep,
    /// For each interval of the sweep, the measured rotation to the moment of the scan, where there is one.
    pub turns: Option<&'a [UnitQuaternion<f64>]>,
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
    /// Sums of the robust costs of all points and of those that are not on level surfaces, 0 to 1 each, with their numbers;
    /// points without a match cost 1.
    costs: [(f64, usize); 2],
    /// Number of points near planes that are not level, and of those on them.
    near_planes: [usize; 2],
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
            compensation: self.sweep.transforms(&motion, self.turns),
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
            equations.add_cost(1.0, false);
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
        let is_level = matches!(surface.shape, Shape::Plane(normal) if normal.z.abs() > LEVEL);
        if !is_level && matches!(surface.shape, Shape::Plane(_)) {
            let is_on = distance_m.abs() < ON_PLANE * self.noise_m;
            equations.near_planes[0] += 1;
            equations.near_planes[1] += usize::from(is_on);
        }
        if distance_m.abs() > GATE * at.kernel.scale_m {
            equations.add_cost(1.0, is_level);
            return;
        }
        let weight = at.kernel.weight(distance_m);
        equations.add_cost(at.kernel.cost(distance_m), is_level);
        let moved = 1.0 + f64::from(point.time_s) / self.duration_s;
        let turned = if self.turns.is_some() { 1.0 } else { moved };
        let factors = Factors { moved, turned };
        if let Shape::Plane(normal) = surface.shape {
            equations.distances_m.push(distance_m.abs() as f32);
            let jacobian = factors.jacobian(at.lidar_from_odom * normal, in_lidar);
            equations.planar.add(&jacobian, distance_m, weight);
            equations.planar.count(distance_m, weight);
            let sector = azimuth_sector(point.position, SECTORS);
            equations.gradients[sector] += weight * distance_m * jacobian;
        } else {
            let information = at.lidar_from_odom * information * at.rotation;
            let pull = information * (at.lidar_from_odom * offset);
            let sums = &mut equations.other;
            sums.add_in_space(&factors, in_lidar, information, pull, weight);
            sums.count(distance_m, weight);
        }
    }
}

/// What a change of the pose is multiplied by at the time of a point.
struct Factors {
    /// Of its translation.
    moved: f64,
    /// Of its rotation.
    turned: f64,
}

impl Factors {
    /// Derivative of the distance along a normal by translation and rotation of the sensor.
    fn jacobian(&self, normal: DVec3, point: DVec3) -> Vector6<f64> {
        let (normal, turn) = (self.moved * normal, self.turned * point.cross(normal));
        Vector6::new(normal.x, normal.y, normal.z, turn.x, turn.y, turn.z)
    }
}

impl Sums {
    fn add(&mut self, jacobian: &Vector6<f64>, residual_m: f64, weight: f64) {
        for column in 0..6 {
            let factor = weight * jacobian[column];
            for row in 0..6 {
                self.information[(row, column)] += factor * jacobian[row];
            }
        }
        self.right_side -= weight * residual_m * jacobian;
    }

    /// Adds a residual r in space with its information matrix Ω and `pull` = Ω r: Jᵀ Ω J and −Jᵀ Ω r, where J = (m I, t B) and
    /// row k of B is q × eₖ.
    fn add_in_space(
        &mut self,
        factors: &Factors,
        point: DVec3,
        information: DMat3,
        pull: DVec3,
        weight: f64,
    ) {
        let b_transposed = DMat3::from_cols(
            point.cross(DVec3::X),
            point.cross(DVec3::Y),
            point.cross(DVec3::Z),
        );
        let Factors { moved, turned } = *factors;
        let information_b = information * b_transposed.transpose();
        let shift_block = information * (weight * moved * moved);
        let mixed_block = information_b * (weight * moved * turned);
        let turn_block = b_transposed * information_b * (weight * turned * turned);
        let sum = &mut self.information;
        for column in 0..3 {
            for row in 0..3 {
                sum[(row, column)] += shift_block.col(column)[row];
                sum[(row, column + 3)] += mixed_block.col(column)[row];
                sum[(column + 3, row)] += mixed_block.col(column)[row];
                sum[(row + 3, column + 3)] += turn_block.col(column)[row];
            }
        }
        let (shift, turn) = (
            weight * moved * pull,
            weight * turned * (b_transposed * pull),
        );
        self.right_side -= Vector6::new(shift.x, shift.y, shift.z, turn.x, turn.y, turn.z);
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
    /// Sum of the robust costs, and the number of points that have them: those that are not on level surfaces, or all of
    /// them where there is hardly anything else.
    pub fn cost(&self) -> (f64, usize) {
        let [all, upright] = self.costs;
        if upright.1 < MIN_UPRIGHT {
            all
        } else {
            upright
        }
    }

    /// Share of the points near planes that lie on them, without level ones; `None` where there are too few.
    pub fn common_share(&self) -> Option<f64> {
        let [near, on] = self.near_planes;
        (near >= MIN_UPRIGHT).then(|| on as f64 / near as f64)
    }

    fn add_cost(&mut self, cost: f64, is_level: bool) {
        for (sum, count) in &mut self.costs[..if is_level { 1 } else { 2 }] {
            *sum += cost;
            *count += 1;
        }
    }

    fn new() -> Self {
        Self {
            planar: Sums::default(),
            other: Sums::default(),
            gradients: [Vector6::zeros(); SECTORS],
            costs: [(0.0, 0); 2],
            near_planes: [0; 2],
            distances_m: Vec::new(),
        }
    }

    fn merge(&mut self, other: &Self) {
        self.planar.merge(&other.planar);
        self.other.merge(&other.other);
        for (gradient, of_other) in self.gradients.iter_mut().zip(&other.gradients) {
            *gradient += of_other;
        }
        for ((sum, count), of_other) in self.costs.iter_mut().zip(other.costs) {
            *sum += of_other.0;
            *count += of_other.1;
        }
        for (count, of_other) in self.near_planes.iter_mut().zip(other.near_planes) {
            *count += of_other;
        }
        self.distances_m.extend_from_slice(&other.distances_m);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ground at z = −2 and, with a wall, also the plane y = 5; points 0.2 m apart.
    fn street(with_wall: bool) -> Vec<DVec3> {
        let squares =
            (-40..40).flat_map(|a| (0..25).map(move |b| (0.2 * f64::from(a), 0.2 * f64::from(b))));
        squares
            .flat_map(|(a, b)| {
                let ground = DVec3::new(a, b, -2.0);
                let wall = DVec3::new(a, 5.0, b - 1.9);
                [Some(ground), with_wall.then_some(wall)]
            })
            .flatten()
            .collect()
    }

    /// The mean cost and the common share of the street at a distance from where it was mapped.
    fn judged(with_wall: bool, aside_m: f64) -> (f64, Option<f64>) {
        let mut map = VoxelMap::new(0.5, 50.0);
        map.insert(&street(with_wall));
        let points: Vec<TimedPoint> = (street(with_wall).iter().step_by(3))
            .map(|point| TimedPoint {
                position: point.as_vec3(),
                time_s: 0.0,
            })
            .collect();
        let observation = Observation {
            map: &map,
            points: &points,
            sweep: Sweep::spanning(std::iter::empty()),
            turns: None,
            odom_from_previous: Pose3::identity(),
            duration_s: 0.1,
            noise_m: 0.05,
        };
        let pose = Pose3::translation(0.0, aside_m, 0.0);
        let equations = observation.linearize(&pose, 0.1, &mut observation.unmatched());
        let (cost, count) = equations.cost();
        (cost / count as f64, equations.common_share())
    }

    #[test]
    fn a_residual_in_space_is_the_sum_of_those_along_its_principal_axes() {
        let factors = Factors {
            moved: 1.3,
            turned: 0.8,
        };
        let (point, offset) = (DVec3::new(7.0, -4.0, 1.5), DVec3::new(0.02, 0.05, -0.03));
        let axes = DMat3::from_quat(DQuat::from_rotation_z(0.6) * DQuat::from_rotation_x(-0.9));
        let eigenvalues = DVec3::new(0.9, 0.3, 0.01);
        let information = axes * DMat3::from_diagonal(eigenvalues) * axes.transpose();
        let (mut in_space, mut along_axes) = (Sums::default(), Sums::default());
        in_space.add_in_space(&factors, point, information, information * offset, 0.7);
        for axis in 0..3 {
            let normal = axes.col(axis);
            let jacobian = factors.jacobian(normal, point);
            along_axes.add(&jacobian, normal.dot(offset), 0.7 * eigenvalues[axis]);
        }
        let within = |a: f64, b: f64| (a - b).abs() < 1e-9;
        assert!(
            (in_space.information.iter().zip(&along_axes.information)).all(|(a, b)| within(*a, *b))
        );
        assert!(
            (in_space.right_side.iter().zip(&along_axes.right_side)).all(|(a, b)| within(*a, *b))
        );
    }

    #[test]
    fn a_pose_beside_the_right_one_does_not_fit_though_the_ground_does() {
        let (cost, share) = judged(true, 0.0);
        assert!(cost < 0.1 && share > Some(0.9), "{cost} {share:?}");
        let (cost, share) = judged(true, 0.4);
        assert!(cost > 0.9 && share < Some(0.1), "{cost} {share:?}");
        // Where there is nothing but ground, it counts, and nothing is said of what is common.
        let (cost, share) = judged(false, 0.4);
        assert!(cost < 0.3 && share.is_none(), "{cost} {share:?}");
    }
}
