//! Bundle adjustment over planes: all poses of a drive, so that their scans show the same surfaces.
//!
//! The planes, each an offset and two tilts, are adjusted together with the poses ξ, with r, ξ, π and g of
//! [`planes`](super::planes) and J = ∂r/∂ξ:
//!
//! ```text
//! (Σ w J Jᵀ − Σ over planes  C G⁻¹ Cᵀ) ξ = −Σ w J r + Σ over planes  C G⁻¹ Σ w g r,     C = Σ w J gᵀ,  G = Σ w g gᵀ
//! ```
//!
//! The Schur complement leaves the poses, coupled wherever they see the same plane. Motions between scans in
//! succession stay close to the initial ones. Given poses hold the drive, or the surfaces of an older map, whose points
//! are in G but move no pose; otherwise the first pose does.
//!
//! Liu and Zhang, *BALM: Bundle Adjustment for Lidar Mapping* (RA-L 2021); Zhou et al., *Efficient Planar
//! Bundle Adjustment* (ISMAR 2020), section 4, for the elimination.

use glam::DVec3;
use nalgebra::{Matrix6, Vector6};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::alignment::median;
use super::block_system::{BlockRow, BlockSystem};
use super::drive::{Drive, SHORTER};
use super::elevation_bias::{ElevationBias, elevation_bias};
use super::loops::Drift;
use super::planes::{LidarFrame, Plane, ScanPoints, associate};
use super::pose_graph::{Edge, information};
use crate::geometry::pose::{exponential, logarithm};
use crate::geometry::{Pose3, distances_m, pose2_from_pose3, pose3_from_pose2};
use crate::memory::{MemoryBudget, MemoryError};
use crate::validation::{InvalidValue, Validate, in_range, positive};

/// Settings of the adjustment.
///
/// Defaults: our own values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
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

/// What an adjustment has found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Adjusted {
    /// Root mean square of the distances between points and common planes, before and after [m].
    pub residuals_m: [f64; 2],
    /// Bias of the elevations of the beams, which is left in the poses; `None` if it does not follow from the scans.
    pub elevation_bias: Option<ElevationBias>,
}

/// Adjusts the poses of a drive; `None` where no surfaces are in common, or where those that seem to be move the poses
/// farther than the odometry can drift.
pub fn adjust(
    drive: &mut Drive,
    held: Held,
    config: &AdjustmentConfig,
    budget: MemoryBudget,
) -> Result<Option<Adjusted>, MemoryError> {
    let before = drive.poses.clone();
    let adjusted = adjust_unchecked(drive, held, config, budget)?;
    let least_m = match held {
        Held::First => drive.voxel_m,
        Held::Given(_) => drive.voxel_m.max(SIGMAS * config.given_m),
        Held::Surfaces(_) => return Ok(adjusted),
    };
    let Some((row, change_m)) = impossible_change(&before, &drive.poses, least_m) else {
        return Ok(adjusted);
    };
    tracing::warn!(
        "the poses are not adjusted to common surfaces: scan {row} would move by {change_m:.1} m, which is more than odometry drifts"
    );
    drive.poses = before;
    Ok(None)
}

/// Standard deviations beyond which a change is impossible.
const SIGMAS: f64 = 3.0;

/// The first row whose position an adjustment changes by more than `least_m` and what odometry drifts until there; with the
/// change [m].
fn impossible_change(before: &[Pose3], after: &[Pose3], least_m: f64) -> Option<(usize, f64)> {
    /// Drift of odometry, as a share of the path: the default of `LoopConfig::drift_share`.
    const DRIFT: f64 = 0.02;
    let drift = Drift {
        share: SIGMAS * DRIFT,
        least_m,
    };
    let changes_m = (before.iter().zip(after))
        .map(|(old, new)| (new.translation.vector - old.translation.vector).norm());
    (changes_m.zip(distances_m(before)).enumerate())
        .find(|(_, (change_m, path_m))| *change_m > drift.after_m(*path_m))
        .map(|(row, (change_m, _))| (row, change_m))
}

/// Adjusts the poses of a drive, however far they move.
fn adjust_unchecked(
    drive: &mut Drive,
    held: Held,
    config: &AdjustmentConfig,
    budget: MemoryBudget,
) -> Result<Option<Adjusted>, MemoryError> {
    /// Factors of the first voxels of given poses, whose scans may be too far from each other for common planes.
    const COARSE: [f64; 4] = [4.0, 4.0, 2.0, 2.0];
    let along_path = motion_edges(&drive.poses, config);
    let coarse = match held {
        Held::First => &[],
        Held::Given(_) => &COARSE[..],
        Held::Surfaces(_) => &COARSE[2..],
    };
    let mut kernels_m = vec![drive.voxel_m; drive.poses.len()];
    let mut result: Option<Adjusted> = None;
    let first = drive.poses.first().copied().unwrap_or_default();
    let surfaces = match held {
        Held::Surfaces(points) => points,
        Held::First | Held::Given(_) => &[],
    };
    let iterations = coarse.len() + config.iterations;
    for iteration in 0..iterations {
        let factor = coarse.get(iteration).copied().unwrap_or(1.0);
        let edge_m = factor * config.voxels * drive.voxel_m;
        let (rows, planes) = associate(drive, surfaces, edge_m, &kernels_m);
        let Some(residuals) = Residuals::new(&rows, &planes) else {
            break;
        };
        require_memory(&rows, &planes, budget)?;
        let before_m = result.map_or(residuals.rms_m, |result| result.residuals_m[0]);
        let result = result.insert(Adjusted {
            residuals_m: [before_m, residuals.rms_m],
            elevation_bias: None,
        });
        let scans = &rows[..drive.poses.len()];
        let scale = information_of_point(residuals.sigma_m);
        let mut system = system(scans, &planes, scale);
        for edge in &along_path {
            edge.add_to(&mut system, &drive.poses, 1.0);
        }
        hold(&mut system, &drive.poses, held, config);
        if let Some(levels) = &drive.levels {
            for (row, pose) in drive.poses.iter().enumerate() {
                levels.add_to(&mut system, (row, row), pose, 1.0);
            }
        }
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
        let is_last = iteration + 1 == iterations
            || iteration >= coarse.len() && largest_m < config.tolerance_m;
        if is_last {
            result.elevation_bias = elevation_bias(scans, &planes, &system, scale);
        }
        for (pose, step) in drive.poses.iter_mut().zip(&steps) {
            *pose *= exponential(step);
        }
        tracing::debug!(
            largest_m,
            rms_m = residuals.rms_m,
            planes = planes.len(),
            "adjustment"
        );
        if is_last {
            break;
        }
    }
    if let (Held::First, Some(moved)) = (held, drive.poses.first()) {
        // All move with the first: to move it alone against the others would take many steps.
        let as_before = match &drive.levels {
            None => first * moved.inverse(),
            Some(_) => upright(&first) * upright(moved).inverse(),
        };
        for pose in &mut drive.poses {
            *pose = as_before * *pose;
        }
    }
    Ok(result)
}

/// The position and the heading of a pose.
fn upright(pose: &Pose3) -> Pose3 {
    pose3_from_pose2(&pose2_from_pose3(pose), pose.translation.z)
}

/// Requires the memory of the equations: all scans of a car that stands see the same planes.
fn require_memory(
    rows: &[ScanPoints],
    planes: &[Plane],
    budget: MemoryBudget,
) -> Result<(), MemoryError> {
    /// Memory of the blocks of two scans that see a plane in common [bytes].
    const PAIR_BYTES: f64 = 2400.0;
    let later_scans = |(number, row): (usize, &ScanPoints)| {
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
    budget.require(
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

/// Statistics of the residuals.
struct Residuals {
    rms_m: f64,
    sigma_m: f64,
    /// Scale of the robust kernel of each scan, from its residuals and from those of all.
    kernels_m: Vec<f64>,
}

impl Residuals {
    fn new(rows: &[ScanPoints], planes: &[Plane]) -> Option<Self> {
        /// Kernel in robust standard deviations.
        const KERNEL_SIGMAS: f64 = 3.0;
        let mut of_rows: Vec<Vec<f32>> = (rows.par_iter())
            .map(|row| {
                let distance_m = |(position, _, plane): (DVec3, usize, &Plane)| {
                    plane.normal.dot(position - plane.center).abs() as f32
                };
                row.on_planes(planes).map(distance_m).collect()
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

/// Information of the residual of a point [1/m²].
fn information_of_point(sigma_m: f64) -> f64 {
    /// Points in succession are not independent: this number counts as one.
    const CORRELATED: f64 = 10.0;
    1.0 / (CORRELATED * sigma_m * sigma_m)
}

/// The equations of all poses.
fn system(rows: &[ScanPoints], planes: &[Plane], scale: f64) -> BlockSystem {
    let sums: Vec<BlockRow> = (rows.par_iter().enumerate())
        .map(|(number, row)| block_row(number, row, planes, scale))
        .collect();
    let mut system = BlockSystem::new(rows.len());
    system.add_rows(sums);
    system
}

fn block_row(number: usize, row: &ScanPoints, planes: &[Plane], scale: f64) -> BlockRow {
    let lidar = LidarFrame::new(&row.pose);
    let mut sums = BlockRow::default();
    for (position, _, plane) in row.on_planes(planes) {
        let at = plane.residual(position, row.kernel_m);
        let jacobian = lidar.jacobian(position, plane.normal);
        sums.diagonal += at.weight * jacobian * jacobian.transpose();
        sums.right_side -= at.weight * at.distance_m * jacobian;
    }
    let mut off_diagonal: Vec<Option<Matrix6<f64>>> = vec![];
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
            if off_diagonal.len() <= index {
                off_diagonal.resize(index + 1, None);
            }
            let block = off_diagonal[index].get_or_insert_with(Matrix6::zeros);
            block.gemm(-1.0, &eliminated, &coupling.transpose(), 1.0);
        }
    }
    let blocks = off_diagonal.into_iter().enumerate();
    BlockRow {
        diagonal: sums.diagonal * scale,
        right_side: sums.right_side * scale,
        off_diagonal: blocks
            .filter_map(|(index, block)| Some((number + index, block? * scale)))
            .collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_is_impossible_beyond_what_odometry_drifts_along_the_path() {
        let straight = |step_m: f64| -> Vec<Pose3> {
            (0..21)
                .map(|row| Pose3::translation(step_m * f64::from(row), 0.0, 0.0))
                .collect()
        };
        let change = |step_m| impossible_change(&straight(1.0), &straight(step_m), 0.25);
        assert_eq!(change(1.0), None);
        // 3 times 2 % of 20 m, and 0.25 m.
        assert_eq!(change(1.07), None);
        let (row, change_m) = change(0.9).unwrap();
        assert_eq!(row, 7);
        assert!((change_m - 0.7).abs() < 1e-9);
    }
}
