//! Planes that the scans of a drive have in common: points of all scans in voxels, where they form a plane.
//!
//! The residual of a point to its plane and its derivatives by the pose ξ of its scan and by the plane π, its offset
//! and two tilts:
//!
//! ```text
//! r = n · (map_from_lidar p − c),    ∂r/∂ξ = (n, p × n) in the lidar frame,    ∂r/∂π = −g,  g = (1, u · x, v · x)
//! ```

use glam::{DMat3, DQuat, DVec3};
use nalgebra::{Matrix3, Matrix6x3, Vector3, Vector6};
use rayon::prelude::*;

use super::drive::Drive;
use super::voxel_map::{cell_of, pack};
use crate::geometry::{PlaneSums, Pose3, RobustKernel};

/// A plane through the points of several scans.
pub struct Plane {
    pub center: DVec3,
    pub normal: DVec3,
    /// Tangents, divided by the edge of the voxel.
    tangents: [DVec3; 2],
    /// G⁻¹
    pub inverse: Matrix3<f64>,
    /// Σ w g r
    pub gradient: Vector3<f64>,
    /// Its scans, and C of each.
    pub couplings: Vec<(usize, Matrix6x3<f64>)>,
}

/// Points of a scan, or of the map as the last row: in the map frame, and the plane of each.
pub struct ScanPoints {
    pub pose: Pose3,
    /// Scale of the robust kernel: a scan that is far from its place has a wider one.
    pub kernel_m: f64,
    pub in_map: Vec<DVec3>,
    /// Indices of planes; `NONE` without one.
    pub planes: Vec<u32>,
}

const NONE: u32 = u32::MAX;

impl ScanPoints {
    /// The points that lie on planes, with the numbers of these.
    pub fn on_planes<'a>(
        &'a self,
        planes: &'a [Plane],
    ) -> impl Iterator<Item = (DVec3, usize, &'a Plane)> {
        let points = self.in_map.iter().zip(&self.planes);
        points.filter_map(|(&position, &number)| {
            let number = number as usize;
            Some((position, number, planes.get(number)?))
        })
    }

    /// The planes of the scan, each once.
    pub fn planes_once(&self) -> Vec<u32> {
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

/// Finds the planes in voxels, and the plane of each point of the scans and of the surfaces of a map.
pub fn associate(
    drive: &Drive,
    surfaces: &[DVec3],
    edge_m: f64,
    kernels_m: &[f64],
) -> (Vec<ScanPoints>, Vec<Plane>) {
    let mut rows: Vec<ScanPoints> = (0..drive.poses.len())
        .into_par_iter()
        .map(|row| ScanPoints {
            pose: drive.poses[row],
            kernel_m: kernels_m[row],
            in_map: drive.points(row),
            planes: vec![],
        })
        .collect();
    if !surfaces.is_empty() {
        rows.push(ScanPoints {
            pose: Pose3::identity(),
            kernel_m: drive.voxel_m,
            in_map: surfaces.to_vec(),
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
                    voxel: pack(cell_of(*position / edge_m)),
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
fn plane(rows: &[ScanPoints], scans: usize, voxel: &[Entry], edge_m: f64) -> Option<Plane> {
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
        let lidar = LidarFrame::new(&row.pose);
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
pub struct Residual {
    pub distance_m: f64,
    pub weight: f64,
    /// g
    pub by_plane: Vector3<f64>,
}

impl Plane {
    /// The residual of a point of the map frame; its weight is that of a robust kernel.
    pub fn residual(&self, position: DVec3, kernel_m: f64) -> Residual {
        let offset = position - self.center;
        let distance_m = self.normal.dot(offset);
        Residual {
            distance_m,
            weight: RobustKernel { scale_m: kernel_m }.weight(distance_m),
            by_plane: Vector3::new(
                1.0,
                self.tangents[0].dot(offset),
                self.tangents[1].dot(offset),
            ),
        }
    }
}

/// The frame of a scan.
pub struct LidarFrame {
    lidar_from_map: DMat3,
    origin: DVec3,
}

impl LidarFrame {
    /// The frame at a pose.
    pub fn new(map_from_lidar: &Pose3) -> Self {
        let rotation = DMat3::from_quat(DQuat::from(map_from_lidar.rotation));
        Self {
            lidar_from_map: rotation.transpose(),
            origin: map_from_lidar.translation.vector.into(),
        }
    }

    /// Derivative of the distance of a point along a normal, both in the map frame, by the pose.
    pub fn jacobian(&self, position: DVec3, normal: DVec3) -> Vector6<f64> {
        let normal = self.direction(normal);
        let turn = self.in_lidar(position).cross(normal);
        Vector6::new(normal.x, normal.y, normal.z, turn.x, turn.y, turn.z)
    }

    /// A position of the map frame in the lidar frame.
    pub fn in_lidar(&self, position: DVec3) -> DVec3 {
        self.lidar_from_map * (position - self.origin)
    }

    /// A direction of the map frame in the lidar frame.
    pub fn direction(&self, direction: DVec3) -> DVec3 {
        self.lidar_from_map * direction
    }
}
