//! Loops: places where a drive comes back to, and the transforms between its visits.
//!
//! Candidates are the submaps that are nearest by the poses known so far, within their uncertainty, and those that
//! look most similar ([`ScanContext`]). A candidate is registered to the surfaces around the earlier visit and has to
//! share them: not the ground, which looks the same everywhere. It counts if a second loop of other local
//! maps confirms it: the drive from one visit to the other closes by both.

use nalgebra::{Matrix6, UnitQuaternion, Vector3, Vector6};
use rayon::prelude::*;

use super::alignment::Problem;
use super::config::LoopConfig;
use super::drive::{Drive, Submap};
use super::pose_graph::Edge;
use super::residuals::{LEVEL, Observation};
use super::sampling::TimedPoint;
use super::scan_context::ScanContext;
use super::search::search;
use super::voxel_map::{Shape, VoxelMap};
use crate::geometry::Pose3;
use crate::geometry::pose::logarithm;
use crate::lidar::Sweep;

/// A place that was visited twice.
#[derive(Clone, Debug, PartialEq)]
pub struct Loop {
    /// Row of the scan of the earlier visit.
    pub first: usize,
    /// Row of the scan of the later visit.
    pub second: usize,
    /// `p_first = first_from_second * p_second`.
    pub first_from_second: Pose3,
    /// Share of the surfaces in common, without the ground (unitless).
    pub common_share: f64,
    /// What became of it.
    pub verdict: LoopVerdict,
}

/// What became of a loop.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LoopVerdict {
    /// The poses follow it.
    Accepted,
    /// No second loop of other scans confirms it.
    Unconfirmed,
    /// It contradicts other loops and the odometry.
    Contradicted,
}

/// A loop between submaps.
#[derive(Clone, Debug)]
pub struct FoundLoop {
    /// Indices of the submaps, the earlier first.
    pub maps: [usize; 2],
    /// `p_first = first_from_second * p_second` between their centers.
    pub first_from_second: Pose3,
    /// Covariance of the registration (x, y, z, roll, pitch, yaw) in the second frame [m, rad].
    pub covariance: Matrix6<f64>,
    /// Share of the surfaces in common, without the ground (unitless).
    pub common_share: f64,
}

/// Uncertainty of the motion along a path.
#[derive(Clone, Copy, Debug)]
pub struct Drift {
    /// Position, as a share of the path (unitless).
    pub share: f64,
    /// Position, at least [m].
    pub least_m: f64,
}

impl Drift {
    /// Standard deviation after a path [m].
    pub fn after_m(&self, path_m: f64) -> f64 {
        self.least_m + self.share * path_m
    }
}

/// Finds loops between submaps.
pub fn find(drive: &Drive, maps: &[Submap], drift: Drift, config: &LoopConfig) -> Vec<FoundLoop> {
    let context_radius_m = config.context_radius_share * drive.range_m;
    let spacing_m = 2.0 * drive.voxel_m;
    let points: Vec<Vec<TimedPoint>> = (maps.par_iter())
        .map(|map| drive.submap_points(map, spacing_m))
        .collect();
    let contexts: Vec<ScanContext> = (points.par_iter())
        .map(|points| ScanContext::new(points, context_radius_m))
        .collect();
    let search = LoopSearch {
        drive,
        maps,
        points: &points,
        contexts: &contexts,
        drift,
        config,
    };
    (0..maps.len())
        .into_par_iter()
        .filter_map(|second| search.loop_to(second))
        .collect()
}

struct LoopSearch<'a> {
    drive: &'a Drive,
    maps: &'a [Submap],
    points: &'a [Vec<TimedPoint>],
    contexts: &'a [ScanContext],
    drift: Drift,
    config: &'a LoopConfig,
}

impl LoopSearch<'_> {
    /// The best loop from a submap to an earlier one.
    fn loop_to(&self, second: usize) -> Option<FoundLoop> {
        (self.candidates(second).into_iter())
            .filter_map(|(first, guess)| self.register(first, second, &guess))
            .find(|found| found.common_share > self.config.min_common_share)
    }

    /// Earlier submaps and the pose of the later one in them: the nearest, then those that look most similar.
    fn candidates(&self, second: usize) -> Vec<(usize, Pose3)> {
        let (drive, maps, config) = (self.drive, self.maps, self.config);
        let poses = |map: usize| &drive.poses[maps[map].center];
        let path_m = |first: usize| maps[second].travelled_m - maps[first].travelled_m;
        let earlier =
            (0..second).filter(|&first| path_m(first) > config.min_path_share * drive.range_m);
        let by_poses = |first: usize| poses(first).inverse() * poses(second);
        let reachable: Vec<(usize, f64)> = earlier
            .map(|first| (first, by_poses(first).translation.vector.norm()))
            .filter(|&(first, distance_m)| {
                distance_m
                    < config.max_distance_share * drive.range_m + self.drift.after_m(path_m(first))
            })
            .collect();
        let nearest = (reachable.iter().min_by(|a, b| a.1.total_cmp(&b.1)))
            .map(|&(first, _)| (first, by_poses(first)));
        let mut similar: Vec<(f64, usize, f64)> = (reachable.iter())
            .map(|&(first, _)| {
                let (similarity, heading) = self.contexts[first].similarity(&self.contexts[second]);
                (similarity, first, heading)
            })
            .filter(|candidate| candidate.0 > config.min_similarity)
            .collect();
        similar.sort_by(|a, b| b.0.total_cmp(&a.0));
        let turned = |heading: f64| {
            let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading);
            Pose3::from_parts(nalgebra::Translation3::identity(), turn)
        };
        let similar = (similar.into_iter().take(config.similar_candidates))
            .map(|(_, first, heading)| (first, turned(heading)));
        nearest.into_iter().chain(similar).collect()
    }

    /// Registers the later submap to the surfaces around the earlier one.
    fn register(&self, first: usize, second: usize, guess: &Pose3) -> Option<FoundLoop> {
        /// Submaps on each side of the earlier one.
        const AROUND: usize = 2;
        /// Step of the search, in voxels.
        const STEP: f64 = 4.0;
        /// Standard deviation of the guessed turn.
        const TURN_RAD: f64 = 0.3;
        const ITERATIONS: usize = 30;
        let (drive, maps) = (self.drive, self.maps);
        let around = first.saturating_sub(AROUND)..=(first + AROUND).min(second - 1);
        let surfaces = drive.surfaces(maps[first].center, maps[around].iter());
        let min_kernel_m = 0.1 * drive.voxel_m;
        let reach_m = self.config.search_radius_share * drive.range_m;
        let (shift, turn) = (reach_m * reach_m, TURN_RAD * TURN_RAD);
        let problem = Problem {
            observation: Observation {
                map: &surfaces,
                points: &self.points[second],
                sweep: Sweep::spanning(std::iter::empty()),
                turns: None,
                odom_from_previous: *guess,
                duration_s: 1.0,
                noise_m: min_kernel_m,
            },
            predicted: *guess,
            unmoved: *guess,
            is_turn_measured: false,
            prior: Vector6::new(shift, shift, shift, turn, turn, turn),
            min_kernel_m,
            iterations: ITERATIONS,
        };
        let found = search(&problem, STEP * drive.voxel_m, reach_m)?;
        if !found.degenerate_directions.is_empty() {
            return None;
        }
        let first_from_second = found.odom_from_lidar;
        Some(FoundLoop {
            maps: [first, second],
            first_from_second,
            covariance: found.covariance,
            common_share: common_share(
                &surfaces,
                &self.points[second],
                &first_from_second,
                drive,
                self.config,
            ),
        })
    }
}

/// Share of the points near the sensor that lie on the surfaces of another visit, without those on the ground.
pub fn common_share(
    surfaces: &VoxelMap,
    points: &[TimedPoint],
    first_from_second: &Pose3,
    drive: &Drive,
    config: &LoopConfig,
) -> f64 {
    let radius_m = (config.compared_radius_share * drive.range_m) as f32;
    let (mut common, mut compared) = (0_usize, 0_usize);
    for point in points
        .iter()
        .filter(|point| point.position.length() < radius_m)
    {
        let position = nalgebra::Point3::from(point.position.as_dvec3());
        let position = glam::DVec3::from((first_from_second * position).coords);
        let surface = surfaces.surface(position);
        let distance_m = surface.map(|surface| match surface.shape {
            Shape::Plane(normal) => (
                normal.dot(position - surface.center).abs(),
                normal.z.abs() > LEVEL,
            ),
            Shape::Other(covariance) => {
                let offset = position - surface.center;
                let variance = covariance.x_axis.x + covariance.y_axis.y + covariance.z_axis.z;
                let beyond = offset.length_squared() > 3.0 * variance;
                (if beyond { f64::INFINITY } else { 0.0 }, false)
            }
        });
        let (distance_m, is_level) = distance_m.unwrap_or((f64::INFINITY, false));
        let is_common = distance_m < config.surface_tolerance * drive.voxel_m;
        if !is_level {
            compared += 1;
            common += usize::from(is_common);
        }
    }
    common as f64 / compared.max(1) as f64
}

/// Which loops another one confirms: its submaps are not the same nor next to them, and the ways from one loop to the other over the
/// first visit and over the second end at the same place.
pub fn confirmed(
    drive: &Drive,
    maps: &[Submap],
    loops: &[FoundLoop],
    drift: Drift,
    config: &LoopConfig,
) -> Vec<bool> {
    /// Angle per distance of the drift [rad/m], of points at the range.
    const LEVER: f64 = 0.5;
    let pose = |map: usize| &drive.poses[maps[map].center];
    let path_m = |a: usize, b: usize| (maps[a].travelled_m - maps[b].travelled_m).abs();
    let confirms = |one: &FoundLoop, other: &FoundLoop| {
        let ([a, b], [c, d]) = (one.maps, other.maps);
        let ways_m = path_m(a, c) + path_m(b, d);
        let is_independent = b.abs_diff(d) >= 2 || a.abs_diff(c) >= 2 && b != d;
        if !is_independent || ways_m > 2.0 * config.max_confirmation_share * drive.range_m {
            return false;
        }
        let over_first = pose(a).inverse() * pose(c) * other.first_from_second;
        let over_second = one.first_from_second * (pose(b).inverse() * pose(d));
        let difference = logarithm(&(over_first.inverse() * over_second));
        let shift_m = difference.fixed_rows::<3>(0).norm();
        let turn_m = LEVER * drive.range_m * difference.fixed_rows::<3>(3).norm();
        shift_m.max(turn_m) < drift.after_m(ways_m) + drive.voxel_m
    };
    (loops.iter())
        .map(|one| loops.iter().any(|other| confirms(one, other)))
        .collect()
}

impl FoundLoop {
    /// The edge of the pose graph.
    pub fn edge(&self, voxel_m: f64) -> Option<Edge> {
        /// Standard deviations that submaps have within themselves: voxels, and [rad].
        const FLOOR: f64 = 0.05;
        const FLOOR_RAD: f64 = 0.002;
        let [shift, turn] = [(FLOOR * voxel_m).powi(2), FLOOR_RAD.powi(2)];
        let floor = Vector6::new(shift, shift, shift, turn, turn, turn);
        let covariance = self.covariance + Matrix6::from_diagonal(&floor);
        Some(Edge {
            first: self.maps[0],
            second: self.maps[1],
            first_from_second: self.first_from_second,
            information: covariance.try_inverse()?,
            is_loop: true,
        })
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use glam::DVec3;

    use super::super::sampling::TimedPoint;
    use super::*;

    const DRIFT: Drift = Drift {
        share: 0.02,
        least_m: 0.5,
    };

    /// Two rounds of eight submaps each, 10 m apart, without drift; sensor with a range of 50 m.
    fn two_rounds() -> (Drive, Vec<Submap>) {
        let poses: Vec<Pose3> = (0..16)
            .map(|map| {
                let turn = UnitQuaternion::from_axis_angle(
                    &Vector3::z_axis(),
                    std::f64::consts::FRAC_PI_4 * f64::from(map),
                );
                Pose3::from_parts((turn * Vector3::new(0.0, -13.0, 0.0)).into(), turn)
            })
            .collect();
        let maps = (0..poses.len())
            .map(|map| Submap {
                rows: map..map + 1,
                center: map,
                travelled_m: 10.0 * map as f64,
            })
            .collect();
        let drive = Drive {
            samples: vec![],
            times_s: vec![],
            poses,
            range_m: 50.0,
            voxel_m: 0.5,
            levels: None,
        };
        (drive, maps)
    }

    /// A loop between submaps that is off by a distance to the side.
    fn found(drive: &Drive, maps: [usize; 2], off_m: f64) -> FoundLoop {
        let first_from_second = drive.poses[maps[0]].inverse() * drive.poses[maps[1]];
        FoundLoop {
            maps,
            first_from_second: first_from_second * Pose3::translation(0.0, off_m, 0.0),
            covariance: Matrix6::identity() * 1e-4,
            common_share: 0.8,
        }
    }

    #[test]
    fn a_loop_is_confirmed_by_one_of_other_submaps_by_which_the_drive_closes() {
        let (drive, maps) = two_rounds();
        let confirmed = |loops: &[([usize; 2], f64)], max_confirmation_share| {
            let loops: Vec<FoundLoop> = (loops.iter())
                .map(|&(maps, off_m)| found(&drive, maps, off_m))
                .collect();
            let config = LoopConfig {
                max_confirmation_share,
                ..LoopConfig::default()
            };
            super::confirmed(&drive, &maps, &loops, DRIFT, &config)
        };
        assert_eq!(confirmed(&[([0, 8], 0.0)], 3.0), [false]);
        assert_eq!(confirmed(&[([0, 8], 0.0), ([2, 10], 0.0)], 3.0), [true; 2]);
        // The next submap shares its surfaces.
        assert_eq!(confirmed(&[([0, 8], 0.0), ([1, 9], 0.0)], 3.0), [false; 2]);
        assert_eq!(confirmed(&[([0, 8], 0.0), ([2, 8], 0.0)], 3.0), [false; 2]);
        // Another place of one of both visits is enough.
        assert_eq!(confirmed(&[([0, 8], 0.0), ([0, 10], 0.0)], 3.0), [true; 2]);
        assert_eq!(confirmed(&[([0, 8], 0.0), ([2, 9], 0.0)], 3.0), [true; 2]);
        // The ways of 20 m drift by 0.5 m + 2 % of 40 m, and submaps are exact to a voxel of 0.5 m.
        assert_eq!(confirmed(&[([0, 8], 0.0), ([2, 10], 1.7)], 3.0), [true; 2]);
        assert_eq!(confirmed(&[([0, 8], 0.0), ([2, 10], 1.9)], 3.0), [false; 2]);
        // Two wrong loops do not confirm each other, and a right one does not confirm a wrong one.
        let three = [([0, 8], 0.0), ([2, 10], 0.0), ([4, 12], 5.0)];
        assert_eq!(confirmed(&three, 3.0), [true, true, false]);
        // Too far from each other: 40 m over both visits, and a limit of 2 · 0.3 · 50 m.
        assert_eq!(confirmed(&[([0, 8], 0.0), ([2, 10], 0.0)], 0.3), [false; 2]);
    }

    #[test]
    fn a_loop_of_another_heading_confirms_as_far_as_it_moves_points_at_half_of_the_range() {
        let (drive, maps) = two_rounds();
        let config = LoopConfig::default();
        let confirmed = |turn_rad: f64| {
            let mut loops = [[0, 8], [2, 10]].map(|maps| found(&drive, maps, 0.0));
            loops[1].first_from_second *= Pose3::rotation(Vector3::z() * turn_rad);
            super::confirmed(&drive, &maps, &loops, DRIFT, &config)
        };
        // 25 m away they move by up to 1.8 m: 0.5 m, 2 % of the ways of 40 m, and a voxel of 0.5 m.
        for (turn_rad, expected) in [(0.07, true), (-0.07, true), (0.074, false), (-0.074, false)] {
            assert_eq!(confirmed(turn_rad), [expected; 2], "{turn_rad}");
        }
    }

    /// A pole in each sector of 6 degrees of Scan Context, in rings of 1.5 m, on the ground.
    fn poles(ring_of: impl Fn(usize) -> usize) -> Vec<TimedPoint> {
        let pole = |sector: usize| {
            let azimuth = (6.0 * (sector as f64 + 0.5)).to_radians();
            let distance_m = 1.5 * (ring_of(sector) as f64 + 0.5);
            (0..10_u8).map(move |k| TimedPoint {
                position: DVec3::new(
                    distance_m * azimuth.cos(),
                    distance_m * azimuth.sin(),
                    0.5 * f64::from(k) - 1.7,
                )
                .as_vec3(),
                time_s: 0.0,
            })
        };
        (0..60).flat_map(pole).collect()
    }

    #[test]
    fn candidates_are_the_nearest_earlier_submap_and_those_that_look_alike() {
        let (drive, maps) = two_rounds();
        let random = |map: usize, sector: usize| {
            let sine = ((61 * map + sector) as f64 * 12.9898).sin().abs();
            (1e4 * sine) as usize % 20
        };
        // Submap 8 looks like submap 7, turned by 30 degrees, except for every other pole, and like submap 1, turned by 42
        // degrees.
        let of_second = |sector: usize| random(1, (sector + 7) % 60);
        let points: Vec<Vec<TimedPoint>> = (0..16)
            .map(|map| match map {
                7 => poles(|sector| match sector % 2 {
                    0 => of_second((sector + 55) % 60),
                    _ => random(7, sector),
                }),
                8 => poles(of_second),
                map => poles(|sector| random(map, sector)),
            })
            .collect();
        let contexts: Vec<ScanContext> = (points.iter())
            .map(|points| ScanContext::new(points, 30.0))
            .collect();
        let candidates = |min_path_share, max_distance_share, similar_candidates| {
            let config = LoopConfig {
                min_path_share,
                max_distance_share,
                min_similarity: 0.4,
                similar_candidates,
                ..LoopConfig::default()
            };
            let search = LoopSearch {
                drive: &drive,
                maps: &maps,
                points: &points,
                contexts: &contexts,
                drift: DRIFT,
                config: &config,
            };
            let found = search.candidates(8);
            let heading = |(map, pose): &(usize, Pose3)| {
                assert!(pose.translation.vector.norm() < 1e-9);
                (*map, pose.rotation.euler_angles().2.to_degrees().round())
            };
            found.iter().map(heading).collect::<Vec<_>>()
        };
        // Neighbours are 9.95 m apart: within 10 m and a drift of 0.5 m and 2 % of 80 m. More than 50 m of path lie between
        // visits.
        assert_eq!(candidates(1.0, 0.2, 2), [(0, 0.0), (1, 42.0)]);
        assert_eq!(candidates(1.0, 0.2, 0), [(0, 0.0)]);
        // With the drift of 1.9 m, 2 m and 7.5 m are too little, 8.25 m are enough.
        assert_eq!(candidates(1.0, 0.04, 2), [(0, 0.0)]);
        assert_eq!(candidates(1.0, 0.15, 2), [(0, 0.0)]);
        assert_eq!(candidates(1.0, 0.165, 2), [(0, 0.0), (1, 42.0)]);
        // With paths of 7.5 m, but not with those of 10.5 m.
        assert_eq!(candidates(0.15, 0.2, 3), [(0, 0.0), (1, 42.0), (7, 30.0)]);
        assert_eq!(candidates(0.21, 0.2, 3), [(0, 0.0), (1, 42.0)]);
        assert!(candidates(1.7, 0.2, 2).is_empty());
    }

    #[test]
    fn the_common_share_is_that_of_the_points_on_the_surfaces_of_the_other_visit_without_the_ground()
     {
        let (drive, _) = two_rounds();
        // A wall in the plane y = 4 and the ground, with points 10 cm apart.
        let mut surfaces = VoxelMap::new(drive.voxel_m, 1000.0);
        let grid = || {
            (0..100_u8)
                .flat_map(|a| (0..40_u8).map(move |b| (0.1 * f64::from(a), 0.1 * f64::from(b))))
        };
        let wall: Vec<DVec3> = grid().map(|(x, z)| DVec3::new(x, 4.0, z)).collect();
        let ground: Vec<DVec3> = grid().map(|(x, y)| DVec3::new(x, y - 6.0, -1.7)).collect();
        surfaces.insert(&wall);
        surfaces.insert(&ground);
        let config = LoopConfig::default();
        // Seen from 2 m farther ahead.
        let first_from_second = Pose3::translation(2.0, 0.0, 0.0);
        let share = |points: &[(f64, DVec3)]| {
            let points: Vec<TimedPoint> = (points.iter())
                .flat_map(|&(count, point)| std::iter::repeat_n(point, count as usize))
                .map(|point| TimedPoint {
                    position: (point - 2.0 * DVec3::X).as_vec3(),
                    time_s: 0.0,
                })
                .collect();
            common_share(&surfaces, &points, &first_from_second, &drive, &config)
        };
        let on_wall = DVec3::new(5.0, 4.0, 2.0);
        let off_wall = on_wall + 0.3 * DVec3::Y;
        let on_ground = DVec3::new(5.0, -4.0, -1.7);
        let nowhere = DVec3::new(5.0, 12.0, 2.0);
        let beyond_radius = DVec3::new(5.0, 30.0, 2.0);
        assert_eq!(share(&[(3.0, on_wall)]), 1.0);
        assert_eq!(share(&[(3.0, off_wall)]), 0.0);
        assert_eq!(share(&[(3.0, on_ground)]), 0.0);
        let mixed = [
            (3.0, on_wall),
            (2.0, off_wall),
            (9.0, on_ground),
            (1.0, nowhere),
            (7.0, beyond_radius),
        ];
        assert_relative_eq!(share(&mixed), 0.5);
    }

    #[test]
    fn points_are_in_a_common_bush_up_to_three_times_its_variance() {
        let (drive, _) = two_rounds();
        // The corners of a box around a corner of the voxels, with a variance of 0.0469 m².
        let center = DVec3::new(5.0, 8.0, 2.0);
        let sides = |corner: u8| {
            DVec3::new(
                f64::from(corner & 1),
                f64::from(corner >> 1 & 1),
                f64::from(corner >> 2),
            ) * 2.0
                - 1.0
        };
        let corners = (0..8).map(|corner| center + sides(corner) * DVec3::new(0.15, 0.12, 0.1));
        let mut bush = VoxelMap::new(drive.voxel_m, 1000.0);
        bush.insert(&corners.collect::<Vec<DVec3>>());
        let config = LoopConfig::default();
        let share = |offset: DVec3| {
            let point = TimedPoint {
                position: (center + offset).as_vec3(),
                time_s: 0.0,
            };
            common_share(&bush, &[point], &Pose3::identity(), &drive, &config)
        };
        for (offset, expected) in [
            (DVec3::ZERO, 1.0),
            (DVec3::splat(0.21), 1.0),
            (DVec3::splat(-0.21), 1.0),
            (DVec3::splat(0.22), 0.0),
            (DVec3::new(0.24, -0.24, -0.22), 0.0),
        ] {
            assert_eq!(share(offset), expected, "{offset}");
        }
    }
}
