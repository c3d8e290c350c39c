//! Fixes of a GNSS receiver as soft constraints of the pose graph.
//!
//! The path is first aligned with the fixes as a whole ([`align`]), which gives these in its frame. Then it is bent: a pose
//! graph over its submaps, the motions between them, its loops, and for each submap the weighted mean of its fixes. Fixes
//! are weighted by the residuals of the path, again after each bend, so that those that the others contradict lose
//! their weight.

use std::iter::zip;

use nalgebra::{Matrix6, Vector3, Vector6};

use super::drive::{Drive, Submap};
use super::loops::Loop;
use super::odometer::OdometryEstimate;
use super::path_graph::{SUBMAP_LENGTH, keep_level, loop_edges, move_along, odometry_edges};
use super::pose_graph::{Edge, optimize_with};
use crate::geometry::Pose3;
use crate::georeference::{
    AlignmentError, FixTarget, GeodeticFixes, GnssConfig, PathOverTime, align, robust_weights,
};

/// Fixes and their errors.
#[derive(Clone, Debug, PartialEq)]
pub struct GnssConstraints {
    /// The fixes.
    pub fixes: GeodeticFixes,
    /// Their errors, and the place of the antenna.
    pub config: GnssConfig,
}

/// Bends a drive by fixes; its first pose stays. `times_s` are the times of its scans by the clock of the fixes.
pub fn bend(
    drive: &mut Drive,
    times_s: &[f64],
    odometry: &[OdometryEstimate],
    loops: &[Loop],
    gnss: &GnssConstraints,
) -> Result<(), AlignmentError> {
    /// Number of times that fixes are weighted.
    const ROUNDS: usize = 6;
    let path = PathOverTime {
        times_s,
        map_from_lidar: &drive.poses,
    };
    let mut targets = align(path, &gnss.fixes, &gnss.config)?.targets;
    let first = drive.poses.first().copied().unwrap_or_default();
    let maps = drive.submaps(SUBMAP_LENGTH * drive.range_m);
    let mut fixed_edges = odometry_edges(drive, &maps, odometry);
    fixed_edges.extend(loop_edges(drive, &maps, loops));
    // The Earth is the first pose of the graph.
    for edge in &mut fixed_edges {
        edge.first += 1;
        edge.second += 1;
    }
    let centers: Vec<Pose3> = maps.iter().map(|map| drive.poses[map.center]).collect();
    fixed_edges.push(attitude_edge(&centers));
    for _ in 0..ROUNDS {
        let centers: Vec<Pose3> = maps.iter().map(|map| drive.poses[map.center]).collect();
        let mut edges = fixed_edges.clone();
        edges.extend(fix_edges(&maps, &centers, &targets));
        let mut poses = vec![Pose3::identity()];
        poses.extend(&centers);
        let optimized = optimize_with(&poses, &edges, |system, poses| {
            keep_level(drive, &maps, 1, system, poses);
        });
        let Some((optimized, _)) = optimized else {
            tracing::warn!(
                "the fixes of the receiver do not determine the path, which is not bent"
            );
            break;
        };
        let before = drive.poses.clone();
        move_along(&mut drive.poses, &maps, &centers, &optimized[1..]);
        for target in &mut targets {
            let moved = drive.poses[target.row] * before[target.row].inverse();
            target.antenna_in_map = moved.transform_point(&target.antenna_in_map.into()).coords;
        }
    }
    // All move with the first: the frame is that of the first scan.
    if let Some(moved) = drive.poses.first() {
        let as_before = first * moved.inverse();
        for pose in &mut drive.poses {
            *pose = as_before * *pose;
        }
    }
    Ok(())
}

/// Holds the attitude of the first submap, which fixes on a straight line do not determine.
fn attitude_edge(centers: &[Pose3]) -> Edge {
    /// Standard deviation [rad].
    const TURN_RAD: f64 = 0.05;
    let turn = TURN_RAD.powi(-2);
    Edge {
        first: 0,
        second: 1,
        first_from_second: centers.first().copied().unwrap_or_default(),
        information: Matrix6::from_diagonal(&Vector6::new(0.0, 0.0, 0.0, turn, turn, turn)),
        is_loop: false,
    }
}

/// For each submap with fixes, their weighted mean.
fn fix_edges(maps: &[Submap], centers: &[Pose3], targets: &[FixTarget]) -> Vec<Edge> {
    let deviations: Vec<[f64; 2]> = targets.iter().map(FixTarget::deviations).collect();
    let weights = robust_weights(&deviations, 0.0);
    let mut sums = vec![(Vector3::zeros(), Vector3::zeros()); maps.len()];
    for (target, weights) in zip(targets, weights) {
        let map = maps.partition_point(|map| map.rows.end <= target.row);
        let Some((information, weighted)) = sums.get_mut(map) else {
            continue;
        };
        let [horizontal, vertical] = [0, 1].map(|axis| {
            let sigma_m: f64 = target.sigmas_m[axis];
            target.share * weights[axis] / (sigma_m * sigma_m)
        });
        let of_fix = Vector3::new(horizontal, horizontal, vertical);
        *information += of_fix;
        *weighted += of_fix.component_mul(&(target.fix_in_map - target.antenna_in_map));
    }
    let edge = |(map, (information, weighted)): (usize, &(Vector3<f64>, Vector3<f64>))| {
        let is_known = information.min() > 0.0;
        let shift = weighted.component_div(information);
        let position = centers[map].translation.vector + shift;
        let [x, y, z] = (*information).into();
        is_known.then(|| Edge {
            first: 0,
            second: map + 1,
            first_from_second: Pose3::translation(position.x, position.y, position.z),
            information: Matrix6::from_diagonal(&Vector6::new(x, y, z, 0.0, 0.0, 0.0)),
            is_loop: false,
        })
    };
    sums.iter().enumerate().filter_map(edge).collect()
}

#[cfg(test)]
#[path = "gnss_tests.rs"]
mod tests;
