//! A drive in an older map: poses of scans that were found in it hold the drive.
//!
//! The drive is first moved as a whole, by the scan whose pose in the map agrees with the positions of the most others, and
//! then bent: a pose graph over its submaps, the motions between them, its loops and the map, with a robust kernel for
//! loops and for poses in the map. A pose in the map counts if the map has the surfaces around it, as those of a loop.

use foldhash::HashSet;
use glam::{DVec3, IVec3};

use super::config::LoopConfig;
use super::drive::{Drive, POINT_BYTES, SHORTER, Submap};
use super::loops::{Drift, Loop, common_share};
use super::odometer::OdometryEstimate;
use super::path_graph::{SUBMAP_LENGTH, loop_edges, move_along, odometry_edges};
use super::pose_graph::{Edge, information, optimize};
use super::voxel_map::{VoxelMap, cell_of, pack};
use crate::geometry::{Pose3, TriangleMesh, distances_m};
use crate::memory::{MemoryBudget, MemoryError};

/// The drive was not found in the map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the recording was not found in the map, or its scans were found at places that contradict its motion: it may be of another road"
)]
pub struct NotInMap;

/// Why a drive cannot be moved into a map.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum PlacementError {
    /// It was not found there.
    #[error(transparent)]
    NotInMap(#[from] NotInMap),
    /// The map lacks the surfaces around the poses at which the scans were found.
    #[error(
        "scans of the recording were found in the map, but at most {:.1} % of the surfaces around one of them are in it, and more than {:.1} % are required (loop_closure.min_common_share): the map may be of another road, or its cells too coarse",
        1e2 * share,
        1e2 * least
    )]
    FewCommonSurfaces {
        /// Largest share of the surfaces in common of all submaps, without the ground (unitless).
        share: f64,
        /// Required share, `min_common_share` (unitless).
        least: f64,
    },
    /// Its scans do not fit the budget of memory.
    #[error(transparent)]
    Memory(#[from] MemoryError),
}

/// A drive that was moved into a map.
pub struct Placed {
    /// Transform of the frame of the odometry.
    pub map_from_odom: Pose3,
    /// Points on the surfaces of the map around the drive, evenly spread.
    pub surfaces: Vec<DVec3>,
}

/// Moves the poses of a drive into a map in which some of its scans were found.
pub fn place(
    drive: &mut Drive,
    mesh: &TriangleMesh,
    map_from_lidar: &[Option<Pose3>],
    odometry: &[OdometryEstimate],
    loops: &[Loop],
    config: &LoopConfig,
    budget: MemoryBudget,
) -> Result<Placed, PlacementError> {
    /// Distance between points on the surfaces, in voxels.
    const SPACING: f64 = 0.25;
    let rows = map_from_lidar.iter().take(drive.poses.len());
    let found: Vec<(usize, Pose3)> = (rows.enumerate())
        .filter_map(|(row, pose)| Some((row, (*pose)?)))
        .collect();
    let map_from_odom = common_transform(drive, &found, config.drift_share).ok_or(NotInMap)?;
    for pose in &mut drive.poses {
        *pose = map_from_odom * *pose;
    }
    let maps = drive.submaps(SUBMAP_LENGTH * drive.range_m);
    let surfaces = surface_points(mesh, drive, SPACING * drive.voxel_m, budget)?;
    let mut voxels = VoxelMap::new(drive.voxel_m, f32::MAX);
    voxels.insert(&surfaces);
    let least = config.min_common_share;
    let (mut in_map, mut share): (Vec<Edge>, f64) = (vec![], 0.0);
    for edge in map_edges(drive, &maps, &found) {
        let points = drive.submap_points(&maps[edge.second - 1], 2.0 * drive.voxel_m);
        let common = common_share(&voxels, &points, &edge.first_from_second, drive, config);
        share = share.max(common);
        if common > least {
            in_map.push(edge);
        }
    }
    if in_map.is_empty() {
        return Err(PlacementError::FewCommonSurfaces { share, least });
    }
    // The map is the first pose of the graph.
    let mut edges = odometry_edges(drive, &maps, odometry);
    edges.extend(loop_edges(drive, &maps, loops));
    for edge in &mut edges {
        edge.first += 1;
        edge.second += 1;
    }
    edges.extend(in_map);
    let centers: Vec<Pose3> = maps.iter().map(|map| drive.poses[map.center]).collect();
    let mut poses = vec![Pose3::identity()];
    poses.extend(&centers);
    if let Some((optimized, _)) = optimize(&poses, &edges) {
        move_along(&mut drive.poses, &maps, &centers, &optimized[1..]);
    }
    Ok(Placed {
        map_from_odom,
        surfaces,
    })
}

/// The transform from the frame of the odometry that agrees with the most scans.
fn common_transform(drive: &Drive, found: &[(usize, Pose3)], drift_share: f64) -> Option<Pose3> {
    /// Number of transforms that are compared.
    const CANDIDATES: usize = 200;
    let drift = Drift {
        share: drift_share,
        least_m: drive.voxel_m,
    };
    let travelled_m = distances_m(&drive.poses);
    let agreeing = |&(row, map_from_odom): &(usize, Pose3)| {
        let agrees = |(other, pose): &&(usize, Pose3)| {
            let moved = map_from_odom * drive.poses[*other];
            let path_m = (travelled_m[*other] - travelled_m[row]).abs();
            let distance_m = (moved.translation.vector - pose.translation.vector).norm();
            distance_m < drift.after_m(path_m)
        };
        found.iter().filter(agrees).count()
    };
    let step = found.len().div_ceil(CANDIDATES).max(1);
    let candidates =
        (found.iter().step_by(step)).map(|(row, pose)| (*row, pose * drive.poses[*row].inverse()));
    let mut best: Option<(usize, Pose3)> = None;
    for candidate in candidates {
        let count = agreeing(&candidate);
        if best.is_none_or(|(most, _)| count > most) {
            best = Some((count, candidate.1));
        }
    }
    // Places that look alike do not agree with the odometry.
    best.filter(|(count, _)| 2 * count > found.len())
        .map(|(_, map_from_odom)| map_from_odom)
}

/// For each submap, the scan nearest to its center that was found in the map.
fn map_edges(drive: &Drive, maps: &[Submap], found: &[(usize, Pose3)]) -> Vec<Edge> {
    /// Standard deviations of a pose in the map [m], [rad]: the tilt is that of the ground.
    const SHIFT_M: f64 = 0.1;
    const TURN_RAD: f64 = 0.01;
    (maps.iter().enumerate())
        .filter_map(|(number, map)| {
            let within = found.partition_point(|(row, _)| *row < map.rows.start)
                ..found.partition_point(|(row, _)| *row < map.rows.end);
            let nearest = found[within]
                .iter()
                .min_by_key(|(row, _)| row.abs_diff(map.center));
            let (row, pose) = nearest?;
            let lidar_from_center = drive.poses[*row].inverse() * drive.poses[map.center];
            Some(Edge {
                first: 0,
                second: number + 1,
                first_from_second: pose * lidar_from_center,
                information: information(SHIFT_M, TURN_RAD),
                is_loop: true,
            })
        })
        .collect()
}

/// Points on the surfaces of a mesh within about the range of the sensor from a drive, one per voxel of the spacing.
fn surface_points(
    mesh: &TriangleMesh,
    drive: &Drive,
    spacing_m: f64,
    budget: MemoryBudget,
) -> Result<Vec<DVec3>, MemoryError> {
    let near_cell_of = |point: DVec3| cell_of(point / drive.range_m);
    let mut near = HashSet::<u64>::default();
    for pose in &drive.poses {
        let center = near_cell_of(pose.translation.vector.into());
        for index in 0..27 {
            near.insert(pack(
                center + IVec3::new(index % 3, index / 3 % 3, index / 9) - 1,
            ));
        }
    }
    // The box in which these cells lie.
    let positions = || (drive.poses.iter()).map(|pose| DVec3::from(pose.translation.vector));
    let low = positions().fold(DVec3::INFINITY, DVec3::min) - 2.0 * drive.range_m;
    let high = positions().fold(DVec3::NEG_INFINITY, DVec3::max) + 2.0 * drive.range_m;
    let mut occupied = HashSet::<u64>::default();
    let mut points = vec![];
    for triangle in 0..mesh.triangles.len() {
        let [a, b, c] = mesh.corners(triangle).map(glam::Vec3::as_dvec3);
        let is_apart = a.min(b).min(c).cmpgt(high).any() || a.max(b).max(c).cmplt(low).any();
        if is_apart {
            continue;
        }
        let (u, v) = (b - a, c - a);
        let longest_m = u.length().max(v.length()).max((c - b).length());
        let count = (longest_m / spacing_m).ceil().max(1.0);
        let grid = (0..count as usize).flat_map(|i| (0..count as usize - i).map(move |j| (i, j)));
        points.extend(
            grid.map(|(i, j)| {
                a + (i as f64 + 1.0 / 3.0) / count * u + (j as f64 + 1.0 / 3.0) / count * v
            })
            .filter(|point| near.contains(&pack(near_cell_of(*point))))
            .filter(|point| occupied.insert(pack(cell_of(point / spacing_m)))),
        );
        budget.require(
            "the surfaces of the older map",
            points.len() as f64 * POINT_BYTES,
            SHORTER,
        )?;
    }
    Ok(points)
}
