//! Bias of the elevations of a sensor's beams, found from the surfaces that the scans of a drive have in common.
//!
//! A point at elevation ε and distance d moves by `d δ (−sin ε cos φ, −sin ε sin φ, cos ε)` if the elevations are δ too
//! low: a surface seen from far and from near does not fit itself. δ is the solution of the equations of the adjustment
//! with one more unknown, from which planes and poses are eliminated:
//!
//! ```text
//! (h − c' G⁻¹ c − sᵀ S⁻¹ s) δ = b − sᵀ S⁻¹ x        S: system of the poses,  s: derivatives by a pose and δ
//! ```
//!
//! The HDL-64E of KITTI has about 0.2 degrees: Deschaud, *IMLS-SLAM* (ICRA 2018), section IV.

use glam::DVec3;
use nalgebra::{Vector3, Vector6};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::block_system::BlockSystem;
use super::planes::{LidarFrame, Plane, ScanPoints};

/// Angle to add to the elevations of all beams, so that surfaces fit themselves best.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct ElevationBias {
    /// The angle [deg].
    pub deg: f64,
    /// Its standard deviation [deg].
    pub sigma_deg: f64,
}

/// Finds the bias at poses for which the system of equations was set up, with the information `scale` of a residual
/// [1/m²]; `None` if it does not follow from the scans.
pub fn elevation_bias(
    rows: &[ScanPoints],
    planes: &[Plane],
    system: &BlockSystem,
    scale: f64,
) -> Option<ElevationBias> {
    let of_planes = couplings_of_planes(rows, planes);
    let sums: Vec<Sums> = (rows.par_iter().enumerate())
        .map(|(number, row)| Sums::new(number, row, planes, &of_planes))
        .collect();
    let eliminated = (planes.iter().zip(&of_planes)).map(|(plane, coupling)| {
        let by_plane = plane.inverse * coupling;
        (by_plane.dot(coupling), by_plane.dot(&plane.gradient))
    });
    let (mut information, mut right_side) = (0.0, 0.0);
    for (own, gradient) in eliminated {
        information -= own;
        right_side += gradient;
    }
    for row in &sums {
        information += row.information;
        right_side += row.right_side;
    }
    let couplings: Vec<Vector6<f64>> = sums.iter().map(|row| row.coupling * scale).collect();
    let absorbed = system.solve_for(&couplings)?;
    let moved = system.solve()?;
    let times = |solution: &[Vector6<f64>]| -> f64 {
        (couplings.iter().zip(solution))
            .map(|(coupling, step)| coupling.dot(step))
            .sum()
    };
    let information = information * scale - times(&absorbed);
    let bias_rad = (right_side * scale - times(&moved)) / information;
    (information > 0.0 && bias_rad.is_finite()).then(|| ElevationBias {
        deg: bias_rad.to_degrees(),
        sigma_deg: information.sqrt().recip().to_degrees(),
    })
}

/// Σ w g ∂r/∂δ of each plane.
fn couplings_of_planes(rows: &[ScanPoints], planes: &[Plane]) -> Vec<Vector3<f64>> {
    let mut couplings = vec![Vector3::zeros(); planes.len()];
    for row in rows {
        let lidar = LidarFrame::new(&row.pose);
        for (position, number, plane) in row.on_planes(planes) {
            let at = plane.residual(position, row.kernel_m);
            couplings[number] +=
                at.weight * lidar.by_elevation(position, plane.normal) * at.by_plane;
        }
    }
    couplings
}

/// Sums over the points of a scan.
struct Sums {
    /// Σ w (∂r/∂δ)²
    information: f64,
    /// −Σ w r ∂r/∂δ
    right_side: f64,
    /// Σ w ∂r/∂ξ ∂r/∂δ, with the planes eliminated.
    coupling: Vector6<f64>,
}

impl Sums {
    fn new(number: usize, row: &ScanPoints, planes: &[Plane], of_planes: &[Vector3<f64>]) -> Self {
        let lidar = LidarFrame::new(&row.pose);
        let mut sums = Self {
            information: 0.0,
            right_side: 0.0,
            coupling: Vector6::zeros(),
        };
        for (position, _, plane) in row.on_planes(planes) {
            let at = plane.residual(position, row.kernel_m);
            let by_elevation = lidar.by_elevation(position, plane.normal);
            sums.information += at.weight * by_elevation * by_elevation;
            sums.right_side -= at.weight * at.distance_m * by_elevation;
            let by_pose = lidar.jacobian(position, plane.normal);
            sums.coupling += at.weight * by_elevation * by_pose;
        }
        for plane in row.planes_once() {
            let coupling = of_planes[plane as usize];
            let plane = &planes[plane as usize];
            let own = plane
                .couplings
                .binary_search_by_key(&number, |entry| entry.0);
            if let Ok(own) = own {
                sums.coupling -= plane.couplings[own].1 * (plane.inverse * coupling);
            }
        }
        sums
    }
}

impl LidarFrame {
    /// Derivative of the distance of a point along a normal, both in the map frame, by the elevation of its beam
    /// [m/rad].
    fn by_elevation(&self, position: DVec3, normal: DVec3) -> f64 {
        let p = self.in_lidar(position);
        let horizontal_m = p.truncate().length().max(1e-3);
        let lifted = DVec3::new(
            -p.x * p.z / horizontal_m,
            -p.y * p.z / horizontal_m,
            horizontal_m,
        );
        self.direction(normal).dot(lifted)
    }
}
