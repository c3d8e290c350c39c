//! What beams pass through is not there: free-space votes on points, then on triangles.
//!
//! A point that the beams of other scans pass through was a moving object when it was measured,
//! and is not meshed. A triangle that more beams pass through than end on was invented by the
//! reconstruction, and goes; this is repeated, since behind one false surface may stand
//! another, until nothing more goes.
//!
//! In the spirit of Pomerleau et al., *Long-term 3D map maintenance in dynamic environments*,
//! ICRA 2014, and Kim and Kim, *Remove, then Revert*, IROS 2020.

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::scan_cloud::ScanCloud;
use crate::geometry::TriangleMesh;
use crate::lidar::LidarModel;
use crate::raycasting::{Hit, Scene};

/// How free space votes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VisibilityConfig {
    /// Off: every point is meshed, and every triangle stays.
    pub enabled: bool,
    /// At most this many scans, spread over the local map, vote on points.
    pub point_voters: usize,
    /// A beam passes through a point if it ends this far behind it [m].
    pub point_margin_m: f32,
    /// The same, growing with range (unitless).
    pub point_margin_per_range: f32,
    /// So many beams at least must pass through a point, and more than half as many as end on it.
    pub point_votes: u32,
    /// A beam passes through a triangle if it ends this far behind it [m].
    pub triangle_margin_m: f32,
    /// The same, growing with range (unitless).
    pub triangle_margin_per_range: f32,
    /// A beam that ends this near to a triangle supports it [m].
    pub support_m: f32,
    /// So many beams at least must pass through a triangle, and more than support it.
    pub triangle_votes: u32,
    /// Every how manieth beam of a scan votes on triangles.
    pub beam_step: usize,
    /// At most this many rounds over the triangles.
    pub rounds: usize,
}

impl Default for VisibilityConfig {
    /// Measured on a real drive and a simulated one.
    fn default() -> Self {
        Self {
            enabled: true,
            point_voters: 24,
            point_margin_m: 0.5,
            point_margin_per_range: 0.02,
            point_votes: 2,
            triangle_margin_m: 0.3,
            triangle_margin_per_range: 0.01,
            support_m: 0.15,
            triangle_votes: 2,
            beam_step: 1,
            rounds: 6,
        }
    }
}

/// Per scan, whether each point of its cloud is static: not passed through by other scans' beams.
pub fn static_points(
    scans: &[ScanCloud],
    model: &LidarModel,
    config: &VisibilityConfig,
) -> Vec<Vec<bool>> {
    let voters = spread(scans.len(), config.point_voters);
    scans
        .par_iter()
        .enumerate()
        .map(|(own, scan)| {
            scan.cloud
                .positions
                .iter()
                .map(|&point| {
                    let (mut through, mut seen) = (0_u32, 0_u32);
                    for &voter in voters.iter().filter(|&&voter| voter != own) {
                        match vote(&scans[voter], point, model, config) {
                            Vote::Through => through += 1,
                            Vote::Seen => seen += 1,
                            Vote::Unknown => {}
                        }
                    }
                    through < config.point_votes || 2 * through <= seen
                })
                .collect()
        })
        .collect()
}

/// At most `most` of `count` indices, evenly spread.
fn spread(count: usize, most: usize) -> Vec<usize> {
    let taken = count.min(most);
    (0..taken)
        .map(|i| (2 * i + 1) * count / (2 * taken))
        .collect()
}

enum Vote {
    Through,
    Seen,
    Unknown,
}

fn vote(scan: &ScanCloud, point: Vec3, model: &LidarModel, config: &VisibilityConfig) -> Vote {
    const SEEN_WITHIN_M: f32 = 0.3;
    let point_in_lidar =
        scan.map_from_lidar.rotation.transpose() * (point - scan.map_from_lidar.translation);
    let range_m = point_in_lidar.length();
    if !model.accepts_range(range_m) {
        return Vote::Unknown;
    }
    let Some(pixel) = model.pixel_of(point_in_lidar) else {
        return Vote::Unknown;
    };
    let free_m = scan.free_range_m[model.index_of(pixel)];
    if free_m > range_m + config.point_margin_m + config.point_margin_per_range * range_m {
        Vote::Through
    } else if (free_m - range_m).abs() < SEEN_WITHIN_M {
        Vote::Seen
    } else {
        Vote::Unknown
    }
}

/// Removes the triangles that beams pass through; returns how many went in each round.
pub fn remove_crossed_triangles(
    mesh: &mut TriangleMesh,
    scans: &[ScanCloud],
    config: &VisibilityConfig,
) -> Vec<usize> {
    let mut removed = Vec::new();
    for _ in 0..config.rounds {
        let crossed = crossed_triangles(mesh, scans, config);
        let count = crossed.iter().filter(|&&crossed| crossed).count();
        if count == 0 {
            break;
        }
        mesh.retain_triangles(|triangle| !crossed[triangle]);
        removed.push(count);
    }
    removed
}

/// Whether each triangle is passed through more often than it is hit.
fn crossed_triangles(
    mesh: &TriangleMesh,
    scans: &[ScanCloud],
    config: &VisibilityConfig,
) -> Vec<bool> {
    let scene = Scene::new(mesh);
    let votes: Vec<Vec<(u32, bool)>> = scans
        .par_iter()
        .map(|scan| votes_of(scan, &scene, config))
        .collect();
    let mut passed = vec![0_u32; mesh.triangles.len()];
    let mut supported = vec![0_u32; mesh.triangles.len()];
    for (triangle, through) in votes.into_iter().flatten() {
        let counter = if through { &mut passed } else { &mut supported };
        counter[triangle as usize] += 1;
    }
    passed
        .iter()
        .zip(&supported)
        .map(|(&passed, &supported)| passed >= config.triangle_votes && passed > supported)
        .collect()
}

/// The triangles that the beams of a scan pass through (true) or end on (false).
fn votes_of(scan: &ScanCloud, scene: &Scene, config: &VisibilityConfig) -> Vec<(u32, bool)> {
    let beams: Vec<_> = scan.beams.iter().step_by(config.beam_step.max(1)).collect();
    let directions: Vec<Vec3> = beams
        .iter()
        .map(|beam| scan.map_from_lidar.rotate(beam.direction))
        .collect();
    let mut hits = vec![Hit::MISS; beams.len()];
    scene.cast(scan.map_from_lidar.translation, &directions, &mut hits);
    beams
        .iter()
        .zip(&hits)
        .filter_map(|(beam, hit)| {
            let margin_m =
                config.triangle_margin_m + config.triangle_margin_per_range * beam.range_m;
            let in_front_m = beam.range_m - hit.range_m;
            if in_front_m > margin_m {
                Some((hit.triangle, true))
            } else if in_front_m.abs() < config.support_m {
                Some((hit.triangle, false))
            } else {
                None
            }
        })
        .collect()
}
