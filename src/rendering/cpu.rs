//! Rendering on the CPU, by casting rays at the tiles of the map on all threads of the current pool.
//!
//! Rays are sorted once such that neighbours in the list are neighbours in space, and cut into
//! pieces that do not depend on the number of threads; sums are made piece by piece in that order.
//! So the result is the same, byte for byte, on every machine.
//!
//! Beams that are close to each other, as those of an image, traverse the scene in packets; if
//! poses are closer to each other than beams, as those of converged particles, each beam traverses
//! it in bundles, from eight poses at once; otherwise rays are single. All hit the same bits,
//! unless a ray passes an edge within rounding: then it may hit either of the triangles there,
//! whose ranges differ by about a millimetre at grazing angles. Otherwise what a pose sees never
//! depends on the other poses.

use std::sync::Arc;

use glam::{DVec3, Mat3};
use rayon::prelude::*;

use super::order::{
    bundle_width_m, coherent_order, packet_width_m, pixel_order, pose_order, poses_by_square,
};

use super::{RangeDifference, RangeRenderer, RenderError, SurfaceHit, facing, is_near_end};
use crate::geometry::{Pose3, Rigid3f, TriangleMesh, Vec3};
use crate::lidar::{Beam, LidarModel, RangeImage};
use crate::raycasting::{Hit, RAYS, Reach, Scene, SceneSource, TileError};

/// Beams that one thread casts at a time.
const RAYS_PER_PIECE: usize = 64;
/// A beam that ends lower than this below the sensor has the ground near its end from almost any
/// pose, so that it does not pay to look there first [m].
const HIGHEST_GROUND_M: f32 = -1.0;
/// Packets that are wider than this at their ends are slower than single rays: measured with
/// `benches/rendering.rs` [m].
const MAX_PACKET_WIDTH_M: f64 = 0.8;
/// Bundles that are wider than this at their ends are slower than single rays: measured likewise
/// [m].
const MAX_BUNDLE_WIDTH_M: f64 = 0.6;
/// Width of a bundle relative to that of a packet of the same speed, because the rays of a bundle
/// do not share their origin: measured likewise, unitless.
const BUNDLE_PER_PACKET: f64 = 0.5;
/// Rounding of sums and differences of ranges.
const ROUNDING: f32 = 1e-6;

/// Number of poses rendered at once, which bounds the memory of their images.
pub(super) const POSES_AT_ONCE: usize = 1024;

/// Casts rays at the tiles of a map.
#[derive(Clone, Debug)]
pub struct CpuRenderer {
    scenes: Arc<dyn SceneSource>,
    /// Maximum number of poses rendered at once.
    pub max_poses: usize,
}

impl CpuRenderer {
    /// Prepares the tiles of a map, in the map frame; a triangle is in one of them.
    pub fn new(tiles: &[TriangleMesh]) -> Self {
        Self::over(Arc::new(Scene::of_tiles(tiles)))
    }

    /// Renders what a source supplies.
    pub fn over(scenes: Arc<dyn SceneSource>) -> Self {
        Self {
            scenes,
            max_poses: POSES_AT_ONCE,
        }
    }

    /// Casts the beams of every pose piece by piece, and returns, per pose, what `summarize` makes
    /// of the indices of the beams of each piece and their ranges.
    fn map_pieces<T: Send>(
        &self,
        map_from_lidar: &[Pose3],
        beams: &CastBeams,
        summarize: impl Fn(&[u32], &[f32]) -> T + Sync,
    ) -> Result<Vec<Vec<T>>, RenderError> {
        let mut pieces: Vec<Vec<T>> = map_from_lidar.iter().map(|_| Vec::new()).collect();
        for square in poses_by_square(map_from_lidar) {
            for numbers in square.chunks(self.max_poses.max(1)) {
                let poses: Vec<Pose3> = (numbers.iter())
                    .map(|&number| map_from_lidar[number])
                    .collect();
                let of_poses = self.map_batch(&poses, beams, &summarize)?;
                for (&number, of_pose) in numbers.iter().zip(of_poses) {
                    pieces[number] = of_pose;
                }
            }
        }
        Ok(pieces)
    }

    fn map_batch<T: Send>(
        &self,
        map_from_lidar: &[Pose3],
        beams: &CastBeams,
        summarize: impl Fn(&[u32], &[f32]) -> T + Sync,
    ) -> Result<Vec<Vec<T>>, TileError> {
        let order = pose_order(map_from_lidar);
        let poses: Vec<Pose3> = order
            .iter()
            .map(|&pose| map_from_lidar[pose as usize])
            .collect();
        let grouping = Grouping::of(&poses, beams);
        let origins: Vec<DVec3> = poses.iter().map(origin_of).collect();
        let scene = &self.scenes.scene(&origins);
        let groups: Vec<&[Pose3]> = poses.chunks(grouping.poses_at_once()).collect();
        let pieces: Vec<&[u32]> = beams.order.chunks(RAYS_PER_PIECE).collect();
        // Pose by pose for a few beams: the nodes that these enter stay in the cache.
        let summaries: Vec<Vec<T>> = (0..groups.len() * pieces.len())
            .into_par_iter()
            .map(|number| {
                let rays = pieces[number / groups.len()];
                let group = groups[number % groups.len()];
                let ranges = match grouping {
                    Grouping::Bundles => cast_bundles(scene, group, rays, beams)?,
                    _ => {
                        let hits = hits(scene, &group[0], rays, beams, grouping)?;
                        vec![hits.iter().map(|hit| hit.range_m).collect()]
                    }
                };
                let summaries = ranges.iter().map(|ranges| summarize(rays, ranges));
                Ok(summaries.collect())
            })
            .collect::<Result<_, TileError>>()?;
        let mut per_pose: Vec<Vec<T>> = map_from_lidar.iter().map(|_| Vec::new()).collect();
        for (number, summaries) in summaries.into_iter().enumerate() {
            let first = number % groups.len() * grouping.poses_at_once();
            for (&pose, summary) in order[first..].iter().zip(summaries) {
                per_pose[pose as usize].push(summary);
            }
        }
        Ok(per_pose)
    }

    /// Mean over the beams of the cost of the range along each, one number per pose; 0 without beams.
    fn mean_costs(
        &self,
        map_from_lidar: &[Pose3],
        beams: &[Beam],
        reach: impl Fn(&Beam) -> Reach,
        cost: impl Fn(&Beam, f32) -> f32 + Sync,
    ) -> Result<Vec<f32>, RenderError> {
        if beams.is_empty() {
            return Ok(vec![0.0; map_from_lidar.len()]);
        }
        let to_cast = CastBeams::new(beams, reach);
        let sums = self.map_pieces(map_from_lidar, &to_cast, |rays, ranges| {
            let costs = rays
                .iter()
                .zip(ranges)
                .map(|(&ray, &range_m)| f64::from(cost(&beams[ray as usize], range_m)));
            costs.sum::<f64>()
        })?;
        let mean = |sums: Vec<f64>| (sums.iter().sum::<f64>() / beams.len() as f64) as f32;
        Ok(sums.into_iter().map(mean).collect())
    }

    /// What `of_hit` makes of the nearest hit of each beam of one pose, in the order of the beams.
    fn of_hits<T: Clone + Default + Send>(
        &self,
        map_from_lidar: &Pose3,
        beams: &CastBeams,
        of_hit: impl Fn(&Scene<TileError>, usize, &Hit) -> Result<T, TileError> + Sync,
    ) -> Result<Vec<T>, RenderError> {
        let grouping = Grouping::of(&[*map_from_lidar], beams);
        let scene = self.scenes.scene(&[origin_of(map_from_lidar)]);
        let pieces: Vec<Vec<T>> = (beams.order)
            .par_chunks(RAYS_PER_PIECE)
            .map(|rays| {
                let hits = hits(&scene, map_from_lidar, rays, beams, grouping)?;
                let of_ray = |(&ray, hit): (&u32, &Hit)| of_hit(&scene, ray as usize, hit);
                rays.iter().zip(&hits).map(of_ray).collect()
            })
            .collect::<Result<_, TileError>>()?;
        let mut results = vec![T::default(); beams.order.len()];
        for (&ray, found) in beams.order.iter().zip(pieces.into_iter().flatten()) {
            results[ray as usize] = found;
        }
        Ok(results)
    }

    /// Ranges of every pose, in the order of the beams.
    fn ranges(
        &self,
        map_from_lidar: &[Pose3],
        beams: &CastBeams,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let pieces = self.map_pieces(map_from_lidar, beams, |_, ranges| ranges.to_vec())?;
        Ok(pieces
            .into_par_iter()
            .map(|pieces| {
                let mut ranges = vec![f32::INFINITY; beams.order.len()];
                for (&ray, range_m) in beams.order.iter().zip(pieces.into_iter().flatten()) {
                    ranges[ray as usize] = range_m;
                }
                ranges
            })
            .collect())
    }
}

/// Nearest hits of some beams of one pose, in packets or singly.
fn hits(
    scene: &Scene<TileError>,
    map_from_lidar: &Pose3,
    rays: &[u32],
    beams: &CastBeams,
    grouping: Grouping,
) -> Result<Vec<Hit>, TileError> {
    let (directions, reaches) = beams.in_map(map_from_lidar, rays);
    let mut hits = vec![Hit::MISS; rays.len()];
    let origin = origin_of(map_from_lidar);
    match grouping {
        Grouping::Single => scene.cast_single(origin, &directions, &reaches, &mut hits)?,
        _ => scene.cast_packets(origin, &directions, &reaches, &mut hits)?,
    }
    Ok(hits)
}

/// Ranges of some beams of up to [`RAYS`] poses, pose by pose.
fn cast_bundles(
    scene: &Scene<TileError>,
    map_from_lidar: &[Pose3],
    rays: &[u32],
    beams: &CastBeams,
) -> Result<Vec<Vec<f32>>, TileError> {
    // The last pose fills the empty places.
    let last = map_from_lidar.len() - 1;
    let poses: [&Pose3; RAYS] = std::array::from_fn(|place| &map_from_lidar[place.min(last)]);
    let rotations = poses.map(rotation_of);
    let (directions, reaches): (Vec<[Vec3; RAYS]>, Vec<Reach>) =
        beams.rotated(rays, |direction| rotations.map(|r| r * direction));
    let mut ranges = vec![[f32::INFINITY; RAYS]; rays.len()];
    let origins = poses.map(origin_of);
    scene.cast_bundles(&origins, &directions, &reaches, &mut ranges)?;
    Ok((0..map_from_lidar.len())
        .map(|place| ranges.iter().map(|ranges| ranges[place]).collect())
        .collect())
}

/// Which rays traverse the scene together.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Grouping {
    /// Neighbouring beams of one pose.
    Packets,
    /// One beam of neighbouring poses.
    Bundles,
    /// None.
    Single,
}

impl Grouping {
    /// The fastest grouping for poses and beams, both in their order.
    fn of(poses: &[Pose3], beams: &CastBeams) -> Self {
        let packet_m = packet_width_m(&beams.directions, &beams.order);
        if bundle_width_m(poses) < MAX_BUNDLE_WIDTH_M.min(BUNDLE_PER_PACKET * packet_m) {
            Self::Bundles
        } else if packet_m < MAX_PACKET_WIDTH_M {
            Self::Packets
        } else {
            Self::Single
        }
    }

    fn poses_at_once(self) -> usize {
        match self {
            Self::Bundles => RAYS,
            Self::Packets | Self::Single => 1,
        }
    }
}

/// Beams to be cast from every pose.
struct CastBeams {
    /// Unit, lidar frame.
    directions: Vec<Vec3>,
    reaches: Vec<Reach>,
    /// Indices of the beams such that neighbours in the list are neighbours in space.
    order: Vec<u32>,
}

impl CastBeams {
    /// Measured beams, each with its reach.
    fn new(beams: &[Beam], reach: impl Fn(&Beam) -> Reach) -> Self {
        let directions: Vec<Vec3> = beams.iter().map(|beam| beam.direction).collect();
        Self {
            order: coherent_order(&directions),
            reaches: beams.iter().map(reach).collect(),
            directions,
        }
    }

    /// Beams that look for the nearest surface that is nearer than a range [m].
    fn until(directions: &[Vec3], until_m: f32) -> Self {
        Self {
            directions: directions.to_vec(),
            reaches: vec![Reach::until(until_m); directions.len()],
            order: coherent_order(directions),
        }
    }

    /// Directions of some beams in the map frame, and their reaches.
    fn in_map(&self, map_from_lidar: &Pose3, rays: &[u32]) -> (Vec<Vec3>, Vec<Reach>) {
        let rotation = rotation_of(map_from_lidar);
        self.rotated(rays, |direction| rotation * direction)
    }

    fn rotated<T>(&self, rays: &[u32], rotate: impl Fn(Vec3) -> T) -> (Vec<T>, Vec<Reach>) {
        rays.iter()
            .map(|&ray| ray as usize)
            .map(|ray| (rotate(self.directions[ray]), self.reaches[ray]))
            .unzip()
    }
}

fn rotation_of(map_from_lidar: &Pose3) -> Mat3 {
    Rigid3f::from(map_from_lidar).rotation
}

fn origin_of(map_from_lidar: &Pose3) -> DVec3 {
    let place = map_from_lidar.translation.vector;
    DVec3::new(place.x, place.y, place.z)
}

impl RangeRenderer for CpuRenderer {
    fn name(&self) -> String {
        format!("cpu, {} threads", rayon::current_num_threads())
    }

    fn render(
        &self,
        map_from_lidar: &[Pose3],
        model: &LidarModel,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let beams = CastBeams {
            directions: model.directions(),
            reaches: vec![Reach::until(model.max_range); model.len()],
            order: pixel_order(model),
        };
        let mut images = self.ranges(map_from_lidar, &beams)?;
        for range_m in images.iter_mut().flatten() {
            if !model.accepts_range(*range_m) {
                *range_m = f32::INFINITY;
            }
        }
        Ok(images)
    }

    fn cast(
        &self,
        map_from_lidar: &[Pose3],
        directions: &[Vec3],
        until_m: f32,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let beams = CastBeams::until(directions, until_m);
        self.ranges(map_from_lidar, &beams)
    }

    fn cast_signed(
        &self,
        map_from_lidar: &Pose3,
        directions: &[Vec3],
        until_m: f32,
    ) -> Result<Vec<f32>, RenderError> {
        let beams = CastBeams::until(directions, until_m);
        let has_fronts = self.scenes.has_fronts();
        let rotation = rotation_of(map_from_lidar);
        let range_m = |scene: &Scene<TileError>, ray: usize, hit: &Hit| {
            let is_behind = |normal: Vec3| normal.dot(rotation * directions[ray]) > 0.0;
            let is_behind =
                has_fronts && hit.range_m.is_finite() && scene.normal(hit)?.is_some_and(is_behind);
            Ok(if is_behind { -hit.range_m } else { hit.range_m })
        };
        self.of_hits(map_from_lidar, &beams, range_m)
    }

    /// The normals are those of the triangles themselves.
    fn surfaces(
        &self,
        map_from_lidar: &Pose3,
        beams: &[Beam],
        within_m: f32,
    ) -> Result<Vec<Option<SurfaceHit>>, RenderError> {
        let to_cast = CastBeams::new(beams, |beam| reach_near_end(beam, within_m));
        let rotation = rotation_of(map_from_lidar);
        let surface = |scene: &Scene<TileError>, ray: usize, hit: &Hit| {
            let beam = &beams[ray];
            if !is_near_end(beam, hit.range_m, within_m) {
                return Ok(None);
            }
            let found = scene.normal(hit)?.map(|normal| SurfaceHit {
                range_m: hit.range_m,
                normal_in_map: facing(normal, rotation * beam.direction),
            });
            Ok(found)
        };
        self.of_hits(map_from_lidar, &to_cast, surface)
    }

    fn compare(
        &self,
        map_from_lidar: &[Pose3],
        beams: &[Beam],
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        let reach = |beam: &Beam| deciding_reach(beam, difference);
        let cost = |beam: &Beam, range_m| difference.cost(beam.range_m, range_m);
        self.mean_costs(map_from_lidar, beams, reach, cost)
    }

    fn compare_images(
        &self,
        map_from_lidar: &[Pose3],
        measured: &RangeImage,
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        let (model, beams) = (&measured.model, measured.center_beams().collect::<Vec<_>>());
        let reach = |_: &Beam| Reach::until(model.max_range);
        let cost = |beam: &Beam, range_m| {
            let is_seen = model.accepts_range(range_m);
            let rendered_m = if is_seen { range_m } else { f32::INFINITY };
            difference.cost(beam.range_m, rendered_m)
        };
        self.mean_costs(map_from_lidar, &beams, reach, cost)
    }
}

/// Whether a beam has the ground near its end from almost any pose.
fn ends_on_ground(beam: &Beam) -> bool {
    beam.direction.z * beam.range_m < HIGHEST_GROUND_M
}

/// Range interval of the surfaces that are not farther than `within_m` from the end of a beam.
fn reach_near_end(beam: &Beam, within_m: f32) -> Reach {
    Reach {
        until_m: (beam.range_m + within_m) * (1.0 + ROUNDING),
        enough_m: (beam.range_m - within_m) * (1.0 - ROUNDING),
        is_window: !ends_on_ground(beam),
    }
}

/// Range interval that decides the exact cost of a beam: surfaces at whose range the cost has
/// reached its limit do not matter. If all limits are equal, a ray without a surface near its
/// measured range costs that limit, whatever is nearer.
fn deciding_reach(beam: &Beam, difference: &RangeDifference) -> Reach {
    let measured_m = beam.range_m;
    let no_surface_costs_as_far = measured_m.min(difference.no_surface_m) == difference.short_m;
    Reach {
        until_m: if no_surface_costs_as_far {
            (measured_m + difference.short_m) * (1.0 + ROUNDING)
        } else {
            f32::INFINITY
        },
        enough_m: (measured_m - difference.long_m) * (1.0 - ROUNDING),
        is_window: no_surface_costs_as_far
            && difference.long_m == difference.short_m
            && !ends_on_ground(beam),
    }
}

#[cfg(test)]
mod tests;
