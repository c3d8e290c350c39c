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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{PointCloud, Pose3, Rigid3f};
    use crate::lidar::RangeImage;
    use crate::map::scan_cloud::PointCounts;

    fn model() -> LidarModel {
        LidarModel {
            height: 32,
            width: 360,
            fov_up: 20.0,
            fov_down: -20.0,
            ..LidarModel::default()
        }
    }

    /// A rectangle in the plane x = `x`, of patches of half a metre.
    fn panel(x: f32, y: [f32; 2], z: [f32; 2]) -> TriangleMesh {
        const PATCH_M: f32 = 0.5;
        let mut mesh = TriangleMesh::default();
        let count = |[from, to]: [f32; 2]| ((to - from) / PATCH_M).round() as usize;
        for row in 0..count(z) {
            for column in 0..count(y) {
                let (y, z) = (y[0] + PATCH_M * column as f32, z[0] + PATCH_M * row as f32);
                let first = mesh.vertices.len() as u32;
                for (dy, dz) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
                    mesh.vertices
                        .push(Vec3::new(x, y + dy * PATCH_M, z + dz * PATCH_M));
                }
                mesh.triangles.push([first, first + 1, first + 2]);
                mesh.triangles.push([first, first + 2, first + 3]);
            }
        }
        mesh
    }

    /// A scan of a mesh from a place, level and looking along x.
    fn scan(world: &TriangleMesh, place: Vec3) -> ScanCloud {
        let model = model();
        let directions = model.directions();
        let mut hits = vec![Hit::MISS; directions.len()];
        Scene::new(world).cast(place, &directions, &mut hits);
        let ranges = hits.iter().map(|hit| hit.range_m).collect();
        let image = RangeImage::from_ranges(ranges, &model);
        let mut cloud = PointCloud::default();
        let beams: Vec<_> = image.beams().collect();
        for beam in &beams {
            cloud.push(place + beam.point(), Vec3::NEG_X, 0.0);
        }
        let mut map_from_lidar = Rigid3f::from(&Pose3::identity());
        map_from_lidar.translation = place;
        ScanCloud {
            map_from_lidar,
            cloud,
            beams,
            free_range_m: crate::map::scan_cloud::free_ranges(&image),
            counts: PointCounts::default(),
        }
    }

    fn wall() -> TriangleMesh {
        panel(20.0, [-10.0, 10.0], [-3.0, 3.0])
    }

    fn three_scans(world: &TriangleMesh) -> Vec<ScanCloud> {
        [-2.0, 0.0, 2.0]
            .map(|y| scan(world, Vec3::new(0.0, y, 0.0)))
            .into()
    }

    #[test]
    fn an_invented_surface_goes_and_what_beams_end_on_stays() {
        let scans = three_scans(&wall());
        let mut mesh = wall();
        let true_triangles = mesh.triangles.len();
        mesh.append(&panel(10.0, [-2.0, 2.0], [-1.0, 1.0]));
        // Another ghost in the shadow of the first.
        mesh.append(&panel(12.0, [-1.0, 1.0], [-0.5, 0.5]));
        let removed = remove_crossed_triangles(&mut mesh, &scans, &VisibilityConfig::default());
        assert!(removed.len() > 1, "one ghost hides the other: {removed:?}");
        assert!(mesh.vertices.iter().all(|vertex| vertex.x > 19.0));
        assert_eq!(mesh.triangles.len(), true_triangles);
    }

    #[test]
    fn a_true_mesh_loses_nothing() {
        let mut mesh = wall();
        // A pole of a third of a metre before the wall.
        mesh.append(&panel(10.0, [0.0, 0.5], [-3.0, 3.0]));
        let scans = three_scans(&mesh);
        let before = mesh.clone();
        let removed = remove_crossed_triangles(&mut mesh, &scans, &VisibilityConfig::default());
        assert!(removed.is_empty(), "{removed:?}");
        assert_eq!(mesh, before);
    }

    #[test]
    fn points_of_what_has_moved_on_are_dynamic_and_walls_are_not() {
        let mut with_van = wall();
        with_van.append(&panel(10.0, [-2.0, 2.0], [-1.0, 1.0]));
        let mut scans = three_scans(&wall());
        scans.push(scan(&with_van, Vec3::new(0.0, 1.0, 0.0)));
        let is_static = static_points(&scans, &model(), &VisibilityConfig::default());
        for (scan, is_static) in scans.iter().zip(&is_static) {
            for (position, &is_static) in scan.cloud.positions.iter().zip(is_static) {
                // The rim of the van is seen past by pixels that see the wall beside it.
                let on_rim = position.y.abs() > 1.7 || position.z.abs() > 0.7;
                if position.x > 19.0 {
                    assert!(is_static, "a wall stands: {position}");
                } else if !on_rim {
                    assert!(!is_static, "the van has gone: {position}");
                }
            }
        }
    }

    #[test]
    fn voters_are_spread_over_all_scans() {
        assert_eq!(spread(100, 4), [12, 37, 62, 87]);
        assert_eq!(spread(3, 24), [0, 1, 2]);
        assert!(spread(0, 4).is_empty());
    }
}
