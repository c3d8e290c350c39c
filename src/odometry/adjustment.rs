//! Bundle adjustment over planes: all poses of a drive, so that their scans show the same surfaces.
//!
//! Points of all scans are collected in voxels. Where they form a plane, every point has a residual to it, and the
//! plane (its offset and two tilts, π) is adjusted together with the poses ξ:
//!
//! ```text
//! r = n · (map_from_lidar p − c),    ∂r/∂ξ = (n, p × n) in the lidar frame,    ∂r/∂π = −g,  g = (1, u · x, v · x)
//! (Σ w J Jᵀ − Σ over planes  C G⁻¹ Cᵀ) ξ = −Σ w J r + Σ over planes  C G⁻¹ Σ w g r,     C = Σ w J gᵀ,  G = Σ w g gᵀ
//! ```
//!
//! The Schur complement leaves the poses, coupled wherever they see the same plane. Motions between scans in
//! succession stay close to the initial ones. Given poses hold the drive, or the surfaces of an older map, whose points
//! are in G but move no pose; otherwise the first pose does.
//!
//! Liu and Zhang, *BALM: Bundle Adjustment for Lidar Mapping* (RA-L 2021); Zhou et al., *Efficient Planar
//! Bundle Adjustment* (ISMAR 2020), section 4, for the elimination.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, Matrix6, Matrix6x3, Vector3, Vector6};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::alignment::median;
use super::block_system::{BlockRow, BlockSystem};
use super::drive::{Drive, SHORTER};
use super::pose_graph::{Edge, information};
use super::voxel_map::pack;
use crate::geometry::pose::{exponential, logarithm};
use crate::geometry::{PlaneSums, Pose3};
use crate::memory::{self, MemoryError};
use crate::validation::{InvalidValue, Validate, in_range, positive};

/// Settings of the adjustment.
///
/// Defaults: our own values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct AdjustmentConfig {
    /// Edge of a voxel, in voxels of the odometry.
    #[default(1.0)]
    pub voxels: f64,
    /// Maximum number of iterations.
    #[default(10)]
    pub iterations: usize,
    /// Largest last step [m].
    #[default(0.003)]
    pub tolerance_m: f64,
    /// Standard deviation of the motion between scans in succession [m].
    #[default(0.1)]
    pub motion_m: f64,
    /// The same of the rotation [deg].
    #[default(1.0)]
    pub motion_deg: f64,
    /// Standard deviation of given poses [m].
    #[default(0.3)]
    pub given_m: f64,
    /// The same of their rotations [deg].
    #[default(1.0)]
    pub given_deg: f64,
}

impl Validate for AdjustmentConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("voxels", self.voxels, 0.1..=10.0)?;
        in_range("iterations", self.iterations, 1..=1000)?;
        positive("tolerance_m", self.tolerance_m)?;
        positive("motion_m", self.motion_m)?;
        positive("motion_deg", self.motion_deg)?;
        positive("given_m", self.given_m)?;
        positive("given_deg", self.given_deg)
    }
}

/// A plane through the points of several scans.
struct Plane {
    center: DVec3,
    normal: DVec3,
    /// Tangents, divided by the edge of the voxel.
    tangents: [DVec3; 2],
    /// G⁻¹
    inverse: Matrix3<f64>,
    /// Σ w g r
    gradient: Vector3<f64>,
    /// Its scans, and C of each.
    couplings: Vec<(usize, Matrix6x3<f64>)>,
}

/// Constraint that fixes the frame of a drive.
#[derive(Clone, Copy, Debug)]
pub enum Held<'a> {
    /// Its first pose.
    First,
    /// Given poses.
    Given(&'a [Pose3]),
    /// Points on the surfaces of a map.
    Surfaces(&'a [DVec3]),
}

/// Points of a scan, or of the map as the last row: in the map frame, and the plane of each.
struct Row {
    pose: Pose3,
    /// Scale of the robust kernel: a scan that is far from its place has a wider one.
    kernel_m: f64,
    in_map: Vec<DVec3>,
    /// Indices of planes; `NONE` without one.
    planes: Vec<u32>,
}

const NONE: u32 = u32::MAX;

impl Row {
    /// The planes of the scan, each once.
    fn planes_once(&self) -> Vec<u32> {
        let mut seen: Vec<u32> = (self.planes.iter().copied())
            .filter(|&plane| plane != NONE)
            .collect();
        seen.sort_unstable();
        seen.dedup();
        seen
    }
}

/// A point in a voxel.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Entry {
    voxel: u64,
    row: u32,
    point: u32,
}

/// Adjusts the poses of a drive. Returns the root mean square of the residuals before and after [m]; `None` where no
/// surfaces are in common.
pub fn adjust(
    drive: &mut Drive,
    held: Held,
    config: &AdjustmentConfig,
) -> Result<Option<[f64; 2]>, MemoryError> {
    /// Factors of the first voxels of given poses, whose scans may be too far from each other for common planes.
    const COARSE: [f64; 4] = [4.0, 4.0, 2.0, 2.0];
    let along_path = motion_edges(&drive.poses, config);
    let coarse = match held {
        Held::First => &[],
        Held::Given(_) => &COARSE[..],
        Held::Surfaces(_) => &COARSE[2..],
    };
    let mut kernels_m = vec![drive.voxel_m; drive.poses.len()];
    let mut result: Option<[f64; 2]> = None;
    let first = drive.poses.first().copied().unwrap_or_default();
    for iteration in 0..coarse.len() + config.iterations {
        let factor = coarse.get(iteration).copied().unwrap_or(1.0);
        let edge_m = factor * config.voxels * drive.voxel_m;
        let (rows, planes) = associate(drive, held, edge_m, &kernels_m);
        let Some(residuals) = Residuals::of(&rows, &planes) else {
            break;
        };
        require_memory(&rows, &planes)?;
        result = Some([
            result.map_or(residuals.rms_m, |[first, _]| first),
            residuals.rms_m,
        ]);
        let mut system = system(&rows[..drive.poses.len()], &planes, residuals.sigma_m);
        for edge in &along_path {
            edge.add_to(&mut system, &drive.poses, 1.0);
        }
        hold(&mut system, &drive.poses, held, config);
        let least_m = 0.01 * drive.voxel_m;
        for (kernel_m, found_m) in kernels_m.iter_mut().zip(&residuals.kernels_m) {
            *kernel_m = found_m.max(least_m).min(*kernel_m);
        }
        let Some(steps) = system.solve() else {
            break;
        };
        let largest_m = (steps.iter())
            .map(|step| step.fixed_rows::<3>(0).norm() + 10.0 * step.fixed_rows::<3>(3).norm())
            .fold(0.0, f64::max);
        for (pose, step) in drive.poses.iter_mut().zip(&steps) {
            *pose *= exponential(step);
        }
        tracing::debug!(
            largest_m,
            rms_m = residuals.rms_m,
            planes = planes.len(),
            "adjustment"
        );
        if iteration >= coarse.len() && largest_m < config.tolerance_m {
            break;
        }
    }
    if let (Held::First, Some(moved)) = (held, drive.poses.first()) {
        // All move with the first: to move it alone against the others would take many steps.
        let as_before = first * moved.inverse();
        for pose in &mut drive.poses {
            *pose = as_before * *pose;
        }
    }
    Ok(result)
}

/// Requires the memory of the equations: all scans of a car that stands see the same planes.
fn require_memory(rows: &[Row], planes: &[Plane]) -> Result<(), MemoryError> {
    /// Memory of the blocks of two scans that see a plane in common [bytes].
    const PAIR_BYTES: f64 = 2400.0;
    let later_scans = |(number, row): (usize, &Row)| {
        let mut is_seen = vec![false; rows.len() - number];
        for plane in row.planes_once() {
            let couplings = &planes[plane as usize].couplings;
            let later = couplings.partition_point(|(other, _)| *other <= number);
            for (other, _) in &couplings[later..] {
                is_seen[other - number] = true;
            }
        }
        is_seen.into_iter().filter(|&is_seen| is_seen).count()
    };
    let pairs: usize = rows.par_iter().enumerate().map(later_scans).sum();
    memory::require(
        "the adjustment of scans that see the same surfaces",
        pairs as f64 * PAIR_BYTES,
        SHORTER,
    )
}

/// The motion between scans in succession stays about the initial one.
fn motion_edges(poses: &[Pose3], config: &AdjustmentConfig) -> Vec<Edge> {
    let information = information(config.motion_m, config.motion_deg.to_radians());
    (poses.windows(2).enumerate())
        .map(|(first, pair)| Edge {
            first,
            second: first + 1,
            first_from_second: pair[0].inverse() * pair[1],
            information,
            is_loop: false,
        })
        .collect()
}

/// Keeps the poses near given ones, or damps the first one, because otherwise all could move together; in a map its
/// planes fix them.
fn hold(system: &mut BlockSystem, poses: &[Pose3], held: Held, config: &AdjustmentConfig) {
    /// Information of the damping [1/m², 1/rad²].
    const DAMPING: f64 = 1.0;
    let given = match held {
        Held::First => {
            system.add(0, &(Matrix6::identity() * DAMPING), &Vector6::zeros());
            return;
        }
        Held::Surfaces(_) => return,
        Held::Given(given) => given,
    };
    let information = information(config.given_m, config.given_deg.to_radians());
    for (row, (pose, given)) in poses.iter().zip(given).enumerate() {
        let deviation = logarithm(&(given.inverse() * pose));
        system.add(row, &information, &-(information * deviation));
    }
}

/// Finds the planes, and the plane of each point.
fn associate(drive: &Drive, held: Held, edge_m: f64, kernels_m: &[f64]) -> (Vec<Row>, Vec<Plane>) {
    let mut rows: Vec<Row> = (0..drive.poses.len())
        .into_par_iter()
        .map(|row| Row {
            pose: drive.poses[row],
            kernel_m: kernels_m[row],
            in_map: drive.points(row),
            planes: vec![],
        })
        .collect();
    if let Held::Surfaces(points) = held {
        rows.push(Row {
            pose: Pose3::identity(),
            kernel_m: drive.voxel_m,
            in_map: points.to_vec(),
            planes: vec![],
        });
    }
    rows.iter_mut()
        .for_each(|row| row.planes = vec![NONE; row.in_map.len()]);
    let scans = drive.poses.len();
    let mut entries: Vec<Entry> = (rows.par_iter().enumerate())
        .flat_map_iter(|(number, row)| {
            row.in_map
                .iter()
                .enumerate()
                .map(move |(point, position)| Entry {
                    voxel: pack((*position / edge_m).floor().as_ivec3()),
                    row: number as u32,
                    point: point as u32,
                })
        })
        .collect();
    entries.par_sort_unstable();
    let voxels: Vec<&[Entry]> = entries.chunk_by(|a, b| a.voxel == b.voxel).collect();
    let found: Vec<(Plane, &[Entry])> = (voxels.into_par_iter())
        .filter_map(|voxel| Some((plane(&rows, scans, voxel, edge_m)?, voxel)))
        .collect();
    let mut planes = Vec::with_capacity(found.len());
    for (plane, voxel) in found {
        for entry in voxel {
            rows[entry.row as usize].planes[entry.point as usize] = planes.len() as u32;
        }
        planes.push(plane);
    }
    (rows, planes)
}

/// The plane through the points of a voxel, if several scans see one; the rows after those of the scans do not move.
fn plane(rows: &[Row], scans: usize, voxel: &[Entry], edge_m: f64) -> Option<Plane> {
    const MIN_POINTS: usize = 8;
    /// Largest share of the smallest variance in the second one, and smallest one of the second in the largest.
    const FLAT: f64 = 0.05;
    const WIDE: f64 = 0.05;
    /// Smallest eigenvalue of G, relative to the number of points.
    const RIDGE: f64 = 1e-6;
    if voxel.len() < MIN_POINTS || voxel[0].row == voxel[voxel.len() - 1].row {
        return None;
    }
    let position = |entry: &Entry| rows[entry.row as usize].in_map[entry.point as usize];
    let origin = position(&voxel[0]);
    let (mut first, mut second) = (DVec3::ZERO, DMat3::ZERO);
    for entry in voxel {
        let p = position(entry) - origin;
        first += p;
        second += DMat3::from_cols(p * p.x, p * p.y, p * p.z);
    }
    let count = voxel.len() as f64;
    let fit = PlaneSums::from_moments(glam::Vec3::ZERO, count, first, second).fit()?;
    let [smallest, middle, largest] = fit.variances;
    if smallest > FLAT * middle || middle < WIDE * largest {
        return None;
    }
    let normal = fit.normal.as_dvec3().normalize();
    let u = normal.any_orthonormal_vector();
    let mut plane = Plane {
        center: origin + first / count,
        normal,
        tangents: [u / edge_m, normal.cross(u) / edge_m],
        inverse: Matrix3::zeros(),
        gradient: Vector3::zeros(),
        couplings: vec![],
    };
    let mut sums = Matrix3::identity() * (RIDGE * count);
    for of_row in voxel.chunk_by(|a, b| a.row == b.row) {
        let row = &rows[of_row[0].row as usize];
        let lidar = LidarFrame::of(&row.pose);
        let mut coupling = Matrix6x3::zeros();
        for entry in of_row {
            let at = plane.residual(position(entry), row.kernel_m);
            sums += at.weight * at.by_plane * at.by_plane.transpose();
            plane.gradient += at.weight * at.distance_m * at.by_plane;
            let jacobian = lidar.jacobian(position(entry), plane.normal);
            coupling += at.weight * jacobian * at.by_plane.transpose();
        }
        let number = of_row[0].row as usize;
        if number < scans {
            plane.couplings.push((number, coupling));
        }
    }
    plane.inverse = sums.try_inverse()?;
    Some(plane)
}

/// The residual of a point.
struct Residual {
    distance_m: f64,
    weight: f64,
    /// g
    by_plane: Vector3<f64>,
}

impl Plane {
    fn residual(&self, position: DVec3, kernel_m: f64) -> Residual {
        let offset = position - self.center;
        let distance_m = self.normal.dot(offset);
        let ratio = (distance_m / kernel_m).powi(2);
        Residual {
            distance_m,
            weight: (1.0 + ratio).powi(-2),
            by_plane: Vector3::new(
                1.0,
                self.tangents[0].dot(offset),
                self.tangents[1].dot(offset),
            ),
        }
    }
}

/// The frame of a scan.
struct LidarFrame {
    lidar_from_map: DMat3,
    origin: DVec3,
}

impl LidarFrame {
    fn of(map_from_lidar: &Pose3) -> Self {
        let rotation = DMat3::from_quat(DQuat::from(map_from_lidar.rotation));
        Self {
            lidar_from_map: rotation.transpose(),
            origin: map_from_lidar.translation.vector.into(),
        }
    }

    /// Derivative of the distance of a point along a normal, both in the map frame, by the pose.
    fn jacobian(&self, position: DVec3, normal: DVec3) -> Vector6<f64> {
        let normal = self.lidar_from_map * normal;
        let turn = (self.lidar_from_map * (position - self.origin)).cross(normal);
        Vector6::new(normal.x, normal.y, normal.z, turn.x, turn.y, turn.z)
    }
}

/// Statistics of the residuals.
struct Residuals {
    rms_m: f64,
    sigma_m: f64,
    /// Scale of the robust kernel of each scan, from its residuals and from those of all.
    kernels_m: Vec<f64>,
}

impl Residuals {
    fn of(rows: &[Row], planes: &[Plane]) -> Option<Self> {
        /// Kernel in robust standard deviations.
        const KERNEL_SIGMAS: f64 = 3.0;
        let mut of_rows: Vec<Vec<f32>> = (rows.par_iter())
            .map(|row| {
                let points = row.in_map.iter().zip(&row.planes);
                let distance_m = |(position, &plane): (&DVec3, &u32)| {
                    let plane = planes.get(plane as usize)?;
                    Some(plane.normal.dot(*position - plane.center).abs() as f32)
                };
                points.filter_map(distance_m).collect()
            })
            .collect();
        let mut all_m = of_rows.concat();
        let squares = all_m
            .iter()
            .map(|&distance_m| f64::from(distance_m).powi(2));
        let rms_m = (squares.sum::<f64>() / all_m.len() as f64).sqrt();
        let sigma_m = robust_sigma_m(&mut all_m)?;
        let sigmas_m = of_rows.iter_mut().map(|of_row| robust_sigma_m(of_row));
        Some(Self {
            kernels_m: sigmas_m
                .map(|of_row| KERNEL_SIGMAS * of_row.map_or(sigma_m, |m| m.max(sigma_m)))
                .collect(),
            rms_m,
            sigma_m,
        })
    }
}

/// Standard deviation of normal residuals with the same median [m].
fn robust_sigma_m(distances_m: &mut [f32]) -> Option<f64> {
    median(distances_m).map(|median_m| (1.48 * median_m).max(1e-4))
}

/// The equations of all poses.
fn system(rows: &[Row], planes: &[Plane], sigma_m: f64) -> BlockSystem {
    /// Points in succession are not independent: this number counts as one.
    const CORRELATED: f64 = 10.0;
    let scale = 1.0 / (CORRELATED * sigma_m * sigma_m);
    let sums: Vec<BlockRow> = (rows.par_iter().enumerate())
        .map(|(number, row)| block_row(number, row, planes, scale))
        .collect();
    let mut system = BlockSystem::new(rows.len());
    system.add_rows(sums);
    system
}

fn block_row(number: usize, row: &Row, planes: &[Plane], scale: f64) -> BlockRow {
    let lidar = LidarFrame::of(&row.pose);
    let mut sums = BlockRow::default();
    for (&position, &plane) in row.in_map.iter().zip(&row.planes) {
        let Some(plane) = planes.get(plane as usize) else {
            continue;
        };
        let at = plane.residual(position, row.kernel_m);
        let jacobian = lidar.jacobian(position, plane.normal);
        sums.diagonal += at.weight * jacobian * jacobian.transpose();
        sums.right_side -= at.weight * at.distance_m * jacobian;
    }
    let mut beside: Vec<Option<Matrix6<f64>>> = vec![];
    for plane in row.planes_once() {
        let plane = &planes[plane as usize];
        let Ok(own) = plane
            .couplings
            .binary_search_by_key(&number, |entry| entry.0)
        else {
            continue;
        };
        let eliminated = plane.couplings[own].1 * plane.inverse;
        sums.right_side += eliminated * plane.gradient;
        sums.diagonal -= eliminated * plane.couplings[own].1.transpose();
        // The other half of the matrix is its mirror image.
        for (other, coupling) in &plane.couplings[own + 1..] {
            let index = *other - number;
            if beside.len() <= index {
                beside.resize(index + 1, None);
            }
            let block = beside[index].get_or_insert_with(Matrix6::zeros);
            block.gemm(-1.0, &eliminated, &coupling.transpose(), 1.0);
        }
    }
    let blocks = beside.into_iter().enumerate();
    BlockRow {
        diagonal: sums.diagonal * scale,
        right_side: sums.right_side * scale,
        beside: blocks
            .filter_map(|(index, block)| Some((number + index, block? * scale)))
            .collect(),
    }
}
