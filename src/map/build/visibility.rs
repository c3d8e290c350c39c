//! Free-space (visibility) voting: removes moving points and false surfaces.
//!
//! A point that the beams of other scans pass through was on a moving object and is not meshed. A
//! triangle that more beams pass through than end on is an artefact of the reconstruction and is
//! removed. Every beam votes on all triangles that it intersects before its end, not only on the
//! first: a false surface does not shield those behind it, and one pass is enough.
//!
//! ```text
//! d = measured range − range of the triangle      p = |d| · |cos(incidence)|
//! passed:     d > triangle_margin_m + triangle_margin_per_range · range   and  p > crossing_m
//! supported:  |d| < support_range_m                                       and  p < support_m
//! ```
//!
//! At grazing incidence on the road, millimetres of height are decimetres of range, hence the
//! distances p to the plane of the triangle.
//!
//! In the spirit of Pomerleau et al., *Long-term 3D map maintenance in dynamic environments*,
//! ICRA 2014, and Kim and Kim, *Remove, then Revert*, IROS 2020.

use std::sync::atomic::{AtomicU32, Ordering};

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::scan_cloud::ScanCloud;
use crate::geometry::{TriangleMesh, fast_atan2};
use crate::lidar::{LidarModel, Projection};
use crate::raycasting::Scene;
use crate::simd::{Simd, SimdTask, WIDE, dispatch};
use crate::validation::{InvalidValue, Validate, at_least_one, in_range, not_negative};

/// Parameters of free-space voting.
///
/// Defaults: values of this project; `docs/method.md`, Thresholds, has what half and twice of them change on four sensors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct VisibilityConfig {
    /// If false, all points are meshed and no triangle is removed.
    #[default(true)]
    pub enabled: bool,
    /// Largest number of scans that vote on points, spread over the local map.
    #[default(24)]
    pub point_voters: usize,
    /// A beam passes through a point if it ends this far behind it [m].
    #[default(0.5)]
    pub point_margin_m: f32,
    /// Increase of this margin with range (unitless): half of a row of 0.44 degrees, 64 in 28 degrees, on a surface that the beam
    /// meets at 11 degrees.
    #[default(0.02)]
    pub point_margin_per_range: f32,
    /// A point is dynamic if at least this many beams pass through it, and more than half as many as
    /// end on it.
    #[default(2)]
    pub point_votes: u32,
    /// A beam passes through a triangle if it ends this far behind it [m].
    #[default(0.3)]
    pub triangle_margin_m: f32,
    /// Increase of this margin with range (unitless): half of a beam of 2 mrad, as of an HDL-64E, on a surface that it meets at 6
    /// degrees.
    #[default(0.01)]
    pub triangle_margin_per_range: f32,
    /// and at least this far from the plane of the triangle, half a cell of the surface [m].
    #[default(0.05)]
    pub crossing_m: f32,
    /// A beam supports a triangle if it ends this near to its plane, a cell of the surface [m]
    #[default(0.1)]
    pub support_m: f32,
    /// and at least this near along the beam [m].
    #[default(1.0)]
    pub support_range_m: f32,
    /// A triangle is removed if at least this many beams pass through it, and more than support it.
    #[default(2)]
    pub triangle_votes: u32,
    /// Largest number of beams of a local map that vote on its triangles; of more, every n-th votes.
    #[default(5_000_000)]
    pub max_beams: usize,
}

impl Validate for VisibilityConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("point_voters", self.point_voters, 1..=1000)?;
        not_negative("point_margin_m", self.point_margin_m)?;
        not_negative("point_margin_per_range", self.point_margin_per_range)?;
        at_least_one("point_votes", self.point_votes as usize)?;
        not_negative("triangle_margin_m", self.triangle_margin_m)?;
        not_negative("triangle_margin_per_range", self.triangle_margin_per_range)?;
        not_negative("crossing_m", self.crossing_m)?;
        not_negative("support_m", self.support_m)?;
        not_negative("support_range_m", self.support_range_m)?;
        at_least_one("triangle_votes", self.triangle_votes as usize)?;
        in_range("max_beams", self.max_beams, 1..=1_000_000_000)
    }
}

/// Returns per scan and point whether it is static: beams of other scans do not pass through it.
pub fn static_points(
    scans: &[ScanCloud],
    model: &LidarModel,
    config: &VisibilityConfig,
) -> Vec<Vec<bool>> {
    let voters = spread(scans.len(), config.point_voters);
    let projection = Projection::of(model);
    let is_static = |(own, scan): (usize, &ScanCloud)| {
        let points = &scan.cloud.positions;
        let mut votes = vec![PointVotes::default(); points.len()];
        for (number, &voter) in voters
            .iter()
            .enumerate()
            .filter(|&(_, &voter)| voter != own)
        {
            dispatch(PointTask {
                voter: Voter {
                    scan: &scans[voter],
                    projection: &projection,
                    model,
                    config,
                },
                left: (voters.len() - number) as u32,
                points,
                votes: &mut votes,
            });
        }
        votes
            .iter()
            .map(|votes| votes.is_static(0, config))
            .collect()
    };
    scans.par_iter().enumerate().map(is_static).collect()
}

/// Votes of scans on a point.
#[derive(Clone, Copy, Default)]
struct PointVotes {
    through: u32,
    seen: u32,
}

impl PointVotes {
    /// Whether the point is static whatever `left` more scans vote.
    #[inline(always)]
    fn is_static(&self, left: u32, config: &VisibilityConfig) -> bool {
        let most = self.through + left;
        most < config.point_votes || 2 * most <= self.seen
    }
}

/// The votes of a scan on the points of another one.
struct PointTask<'a> {
    voter: Voter<'a>,
    /// Number of scans that have not voted.
    left: u32,
    points: &'a [Vec3],
    votes: &'a mut [PointVotes],
}

impl SimdTask for PointTask<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let map_from_lidar = &self.voter.scan.map_from_lidar;
        let lidar_from_map = map_from_lidar.rotation.transpose();
        let groups = self.points.chunks(WIDE).zip(self.votes.chunks_mut(WIDE));
        for (points, votes) in groups {
            if votes
                .iter()
                .all(|votes| votes.is_static(self.left, self.voter.config))
            {
                continue;
            }
            let mut of_points = [Vec3::ZERO; WIDE];
            of_points[..points.len()].copy_from_slice(points);
            let (mut range_m, mut sine, mut azimuth_rad) = ([0.0; WIDE], [0.0; WIDE], [0.0; WIDE]);
            for lane in 0..WIDE {
                let point = lidar_from_map * (of_points[lane] - map_from_lidar.translation);
                range_m[lane] = point.length();
                sine[lane] = point.z / range_m[lane];
                azimuth_rad[lane] = fast_atan2(point.y, point.x);
            }
            for (lane, votes) in votes.iter_mut().enumerate() {
                match self
                    .voter
                    .vote(range_m[lane], sine[lane], azimuth_rad[lane])
                {
                    Vote::Through => votes.through += 1,
                    Vote::Seen => votes.seen += 1,
                    Vote::Unknown => {}
                }
            }
        }
    }
}

/// A scan that votes on points.
struct Voter<'a> {
    scan: &'a ScanCloud,
    projection: &'a Projection,
    model: &'a LidarModel,
    config: &'a VisibilityConfig,
}

impl Voter<'_> {
    /// Vote on a point by where it is in the frame of the lidar.
    #[inline(always)]
    fn vote(&self, range_m: f32, sine: f32, azimuth_rad: f32) -> Vote {
        /// Largest difference between a point and the end of a beam that saw it [m]. Half of a row of 0.44 degrees, 64 in 28
        /// degrees, is as much on a surface 20 m away that the beam meets at 14 degrees. It is less than the margin of a beam
        /// that passes: a beam that ends between the two limits casts no vote.
        const SEEN_WITHIN_M: f32 = 0.3;
        if !self.model.accepts_range(range_m) {
            return Vote::Unknown;
        }
        let Some(pixel) = self.projection.pixel_at(sine, azimuth_rad) else {
            return Vote::Unknown;
        };
        let free_m = self.scan.free_range_m[pixel];
        let margin_m = self.config.point_margin_m + self.config.point_margin_per_range * range_m;
        if free_m > range_m + margin_m {
            Vote::Through
        } else if (free_m - range_m).abs() < SEEN_WITHIN_M {
            Vote::Seen
        } else {
            Vote::Unknown
        }
    }
}

/// Returns at most `most` of `count` indices, evenly spread.
fn spread(count: usize, most: usize) -> Vec<usize> {
    let taken = count.min(most);
    (0..taken)
        .map(|i| (2 * i + 1) * count / (2 * taken))
        .collect()
}

/// Vote of a beam on a point or triangle.
enum Vote {
    Through,
    Seen,
    Unknown,
}

/// Removes the triangles that beams pass through; returns their number.
pub fn remove_crossed_triangles(
    mesh: &mut TriangleMesh,
    scans: &[ScanCloud],
    config: &VisibilityConfig,
) -> usize {
    let crossed = crossed_triangles(mesh, scans, config);
    mesh.retain_triangles(|index, _| !crossed[index])
}

/// Returns which triangles more beams pass through than end on.
pub(crate) fn crossed_triangles(
    mesh: &TriangleMesh,
    scans: &[ScanCloud],
    config: &VisibilityConfig,
) -> Vec<bool> {
    let scene = Scene::new(mesh);
    let normals: Vec<Vec3> = (0..mesh.triangles.len())
        .into_par_iter()
        .map(|triangle| mesh.scaled_normal(triangle).normalize_or_zero())
        .collect();
    // Sums of integers do not depend on the order of the threads.
    let counters = || -> Vec<AtomicU32> {
        std::iter::repeat_with(AtomicU32::default)
            .take(mesh.triangles.len())
            .collect()
    };
    let (passed, supported) = (counters(), counters());
    let beams: usize = scans.iter().map(|scan| scan.returns.len()).sum();
    let step = beams.div_ceil(config.max_beams).max(1);
    scans.par_iter().for_each(|scan| {
        let origin = scan.map_from_lidar.translation;
        for &end in scan.returns.iter().step_by(step) {
            let range_m = end.length();
            let direction = scan.map_from_lidar.rotate(end / range_m);
            scene.for_each_hit(origin, direction, range_m + config.support_range_m, |hit| {
                let triangle = hit.triangle as usize;
                let cosine = normals[triangle].dot(direction).abs();
                match triangle_vote(range_m, hit.range_m, cosine, config) {
                    Vote::Through => passed[triangle].fetch_add(1, Ordering::Relaxed),
                    Vote::Seen => supported[triangle].fetch_add(1, Ordering::Relaxed),
                    Vote::Unknown => 0,
                };
            });
        }
    });
    passed
        .into_iter()
        .zip(supported)
        .map(|(passed, supported)| (passed.into_inner(), supported.into_inner()))
        .map(|(passed, supported)| passed >= config.triangle_votes && passed > supported)
        .collect()
}

/// Vote of a beam with a measured range on a triangle that it intersects at another range.
fn triangle_vote(measured_m: f32, triangle_m: f32, cosine: f32, config: &VisibilityConfig) -> Vote {
    let in_front_m = measured_m - triangle_m;
    let plane_m = in_front_m.abs() * cosine;
    let margin_m = config.triangle_margin_m + config.triangle_margin_per_range * measured_m;
    if in_front_m > margin_m && plane_m > config.crossing_m {
        Vote::Through
    } else if in_front_m.abs() < config.support_range_m && plane_m < config.support_m {
        Vote::Seen
    } else {
        Vote::Unknown
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{PointCloud, Pose3, Rigid3f};
    use crate::lidar::RangeImage;
    use crate::map::build::scan_cloud::PointCounts;
    use crate::raycasting::Hit;

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

    /// A scan of a mesh from a position, level and heading along x.
    fn scan(world: &TriangleMesh, position: Vec3) -> ScanCloud {
        let model = model();
        let directions = model.directions();
        let mut hits = vec![Hit::MISS; directions.len()];
        Scene::new(world).cast(position, &directions, &mut hits);
        let ranges = hits.iter().map(|hit| hit.range_m).collect();
        let image = RangeImage::from_ranges(ranges, &model);
        let mut cloud = PointCloud::default();
        let returns: Vec<_> = image.beams().map(|beam| beam.point()).collect();
        for &point in &returns {
            cloud.push(position + point, Vec3::NEG_X, 0.0);
        }
        let mut map_from_lidar = Rigid3f::from(&Pose3::identity());
        map_from_lidar.translation = position;
        ScanCloud {
            map_from_lidar,
            cloud,
            returns,
            free_range_m: crate::map::build::scan_cloud::free_ranges(&image),
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
    fn a_point_is_static_if_no_further_votes_make_a_majority_of_enough_beams_pass_through_it() {
        let config = VisibilityConfig {
            point_votes: 3,
            ..VisibilityConfig::default()
        };
        for (through, seen, left, expected) in [
            (2, 0, 0, true),
            (3, 5, 0, false),
            (3, 6, 0, true),
            (5, 9, 0, false),
            (5, 10, 0, true),
            (1, 0, 1, true),
            (1, 0, 2, false),
            (3, 10, 2, true),
            (3, 10, 3, false),
        ] {
            let votes = PointVotes { through, seen };
            let found = votes.is_static(left, &config);
            assert_eq!(found, expected, "{through} {seen} {left}");
        }
    }

    #[test]
    fn false_surfaces_are_removed_and_those_that_beams_end_on_are_kept() {
        let scans = three_scans(&wall());
        let mut mesh = wall();
        let true_triangles = mesh.triangles.len();
        mesh.append(&panel(10.0, [-2.0, 2.0], [-1.0, 1.0]));
        // Another false surface behind the first.
        mesh.append(&panel(12.0, [-1.0, 1.0], [-0.5, 0.5]));
        let removed = remove_crossed_triangles(&mut mesh, &scans, &VisibilityConfig::default());
        assert_eq!(removed, 2 * (8 * 4 + 4 * 2));
        assert!(mesh.vertices.iter().all(|vertex| vertex.x > 19.0));
        assert_eq!(mesh.triangles.len(), true_triangles);
    }

    #[test]
    fn a_correct_mesh_is_unchanged() {
        let mut mesh = wall();
        // A pole in front of the wall.
        mesh.append(&panel(10.0, [0.0, 0.5], [-3.0, 3.0]));
        let scans = three_scans(&mesh);
        let before = mesh.clone();
        let removed = remove_crossed_triangles(&mut mesh, &scans, &VisibilityConfig::default());
        assert_eq!(removed, 0);
        assert_eq!(mesh, before);
    }

    #[test]
    fn beams_at_grazing_incidence_do_not_pass_through_the_road() {
        let config = VisibilityConfig::default();
        // 30 m away, 1.7 m below: the range is half a metre and more longer, the height 4 cm less.
        let cosine = 1.7 / 30.0;
        assert!(matches!(
            triangle_vote(30.0, 29.3, cosine, &config),
            Vote::Seen
        ));
        assert!(matches!(
            triangle_vote(30.0, 27.0, cosine, &config),
            Vote::Through
        ));
        // At normal incidence it is neither on the surface nor far enough behind it.
        assert!(matches!(
            triangle_vote(30.0, 29.8, 1.0, &config),
            Vote::Unknown
        ));
        // Farther away it is another surface.
        assert!(matches!(
            triangle_vote(30.0, 29.3, 1.0, &config),
            Vote::Through
        ));
    }

    #[test]
    fn points_on_a_moving_object_are_dynamic_and_walls_are_static() {
        let mut with_van = wall();
        with_van.append(&panel(10.0, [-2.0, 2.0], [-1.0, 1.0]));
        let mut scans = three_scans(&wall());
        scans.push(scan(&with_van, Vec3::new(0.0, 1.0, 0.0)));
        let is_static = static_points(&scans, &model(), &VisibilityConfig::default());
        for (scan, is_static) in scans.iter().zip(&is_static) {
            for (position, &is_static) in scan.cloud.positions.iter().zip(is_static) {
                // Pixels at the edges of the van see the wall next to it.
                let on_edge = position.y.abs() > 1.7 || position.z.abs() > 0.7;
                if position.x > 19.0 {
                    assert!(is_static, "wall: {position}");
                } else if !on_edge {
                    assert!(!is_static, "van: {position}");
                }
            }
        }
    }

    /// Scans at one place of a panel in front of the wall, and scans after it was removed.
    fn with_and_without_panel(with: usize, without: usize) -> Vec<ScanCloud> {
        let mut world = wall();
        world.append(&panel(10.0, [-2.0, 2.0], [-1.0, 1.0]));
        let [with_panel, without_panel] = [&world, &wall()].map(|world| scan(world, Vec3::ZERO));
        let with = std::iter::repeat_n(with_panel, with);
        with.chain(std::iter::repeat_n(without_panel, without))
            .collect()
    }

    #[test]
    fn points_are_dynamic_by_the_majority_of_the_other_scans() {
        // Two scans pass through the panel; of those that see it, the one that votes is not counted.
        for (with, is_expected_static) in [(4, false), (5, true)] {
            let scans = with_and_without_panel(with, 2);
            let is_static = static_points(&scans, &model(), &VisibilityConfig::default());
            let positions = &scans[0].cloud.positions;
            let on_panel: Vec<bool> = (positions.iter().zip(&is_static[0]))
                .filter(|(at, _)| at.x < 11.0 && at.y.abs() < 1.7 && at.z.abs() < 0.7)
                .map(|(_, &is_static)| is_static)
                .collect();
            assert!(on_panel.len() > 50);
            assert!(
                on_panel
                    .iter()
                    .all(|&is_static| is_static == is_expected_static)
            );
        }
    }

    #[test]
    fn triangles_are_removed_by_the_majority_of_the_beams() {
        for (with, removed) in [(1, 64), (2, 0), (3, 0)] {
            let mut mesh = panel(10.0, [-2.0, 2.0], [-1.0, 1.0]);
            let scans = with_and_without_panel(with, 2);
            let config = VisibilityConfig::default();
            assert_eq!(
                remove_crossed_triangles(&mut mesh, &scans, &config),
                removed
            );
        }
    }

    #[test]
    fn a_wall_is_static_however_far_from_it_the_other_scans_are() {
        let at = |x: f32| scan(&wall(), Vec3::new(x, 1.5, 0.5));
        let scans = [4.0, 0.0, -5.0, -9.0].map(at);
        let is_static = static_points(&scans, &model(), &VisibilityConfig::default());
        let positions = &scans[0].cloud.positions;
        let inside: Vec<bool> = (positions.iter().zip(&is_static[0]))
            .filter(|(at, _)| at.y.abs() < 8.0 && at.z.abs() < 2.0)
            .map(|(_, &is_static)| is_static)
            .collect();
        assert!(inside.len() > 50 && inside.iter().all(|&is_static| is_static));
    }

    #[test]
    fn a_beam_votes_on_a_point_by_how_far_behind_it_it_ends() {
        let model = model();
        let projection = Projection::of(&model);
        let mut scan = scan(&wall(), Vec3::ZERO);
        // Through: more than 0.5 m and 2 % of the range of the point behind it. Seen: less than 0.3 m from it.
        for (range_m, free_m, expected) in [
            (10.0, 10.65, "unknown"),
            (10.0, 10.75, "through"),
            (30.0, 31.05, "unknown"),
            (30.0, 31.15, "through"),
            (30.0, 30.25, "seen"),
            (30.0, 29.75, "seen"),
            (30.0, 30.35, "unknown"),
            (30.0, 29.65, "unknown"),
            (30.0, 20.0, "unknown"),
            (30.0, f32::INFINITY, "through"),
            (model.max_range + 1.0, f32::INFINITY, "unknown"),
        ] {
            scan.free_range_m.fill(free_m);
            let voter = Voter {
                scan: &scan,
                projection: &projection,
                model: &model,
                config: &VisibilityConfig::default(),
            };
            let vote = |sine: f32| match voter.vote(range_m, sine, 0.3) {
                Vote::Through => "through",
                Vote::Seen => "seen",
                Vote::Unknown => "unknown",
            };
            assert_eq!(vote(0.1), expected, "{range_m} {free_m}");
            // Above the field of view.
            assert_eq!(vote(0.9), "unknown");
        }
    }

    #[test]
    fn voting_scans_are_spread_over_all_scans() {
        assert_eq!(spread(100, 4), [12, 37, 62, 87]);
        assert_eq!(spread(3, 24), [0, 1, 2]);
        assert!(spread(0, 4).is_empty());
    }
}
