//! Rendering by casting rays at the tiles of the map, on all threads of the current pool.
//!
//! Rays are put in an order once in which neighbours in the list are neighbours in space, and cut
//! into pieces that do not depend on the number of threads; sums are made piece by piece in that
//! order. So the result is the same, byte for byte, on every machine.
//!
//! Beams that are close to each other, as those of an image, go through the scene in packets; where
//! poses are closer to each other than beams, as those of particles that agree, each beam goes
//! through it in bundles, from eight poses at once; others go one by one. All meet the same bits,
//! unless a ray passes an edge within rounding: then it may meet either of the triangles there,
//! whose ranges differ by about a millimetre where they are seen at a flat angle. Otherwise what a
//! pose sees never depends on the other poses.

mod order;

use glam::{DVec3, Mat3};
use rayon::prelude::*;

use order::{coherent_order, order_of_poses, pixel_order, width_of_bundles_m, width_of_packets_m};

use super::{RangeDifference, RangeRenderer, RenderError, SurfaceHit};
use crate::geometry::{Pose3, Rigid3f, TriangleMesh, Vec3};
use crate::lidar::{Beam, LidarModel};
use crate::raycasting::{Hit, RAYS, Reach, Scene};

/// Beams that are cast without asking for another thread.
const RAYS_PER_PIECE: usize = 64;
/// What ends lower than this below the sensor has the ground about its end from almost any pose:
/// it does not pay to look there first [m].
const HIGHEST_GROUND_M: f32 = -1.0;
/// Packets that are wider than this where they end go slower than their rays one by one: measured
/// with `benches/rendering.rs` [m].
const WIDEST_PACKET_M: f64 = 0.8;
/// Bundles that are wider than this where they end go slower than their rays one by one: measured
/// likewise [m].
const WIDEST_BUNDLE_M: f64 = 0.6;
/// A bundle is slower than a packet that is wider by this, because its rays do not share their
/// origin: measured likewise, unitless.
const BUNDLE_PER_PACKET: f64 = 0.5;
/// Rounding of sums and differences of ranges.
const ROUNDING: f32 = 1e-6;

/// Casts rays at the tiles of a map.
#[derive(Clone, Debug)]
pub struct CpuRenderer {
    scene: Scene,
}

impl CpuRenderer {
    /// Prepares the tiles of a map, in the map frame; a triangle is in one of them.
    pub fn new(tiles: &[TriangleMesh]) -> Self {
        Self {
            scene: Scene::of_tiles(tiles),
        }
    }

    /// Casts the beams of every pose piece by piece, and keeps, per pose, what `summarize` makes
    /// of the numbers of the beams of each piece and the ranges that they met.
    fn each_piece<T: Send>(
        &self,
        map_from_lidar: &[Pose3],
        beams: &Beams,
        summarize: impl Fn(&[u32], &[f32]) -> T + Sync,
    ) -> Vec<Vec<T>> {
        let order = order_of_poses(map_from_lidar);
        let poses: Vec<Pose3> = order
            .iter()
            .map(|&pose| map_from_lidar[pose as usize])
            .collect();
        let way = Way::of(&poses, beams);
        let groups: Vec<&[Pose3]> = poses.chunks(way.poses_at_once()).collect();
        let pieces: Vec<&[u32]> = beams.order.chunks(RAYS_PER_PIECE).collect();
        // Pose by pose for a few beams: what these pass through stays in the cache.
        let summaries: Vec<Vec<T>> = (0..groups.len() * pieces.len())
            .into_par_iter()
            .map(|number| {
                let rays = pieces[number / groups.len()];
                let group = groups[number % groups.len()];
                let ranges = match way {
                    Way::Packets => vec![self.cast_packets(&group[0], rays, beams)],
                    Way::Bundles => self.cast_bundles(group, rays, beams),
                    Way::Alone => vec![self.cast_lone(&group[0], rays, beams)],
                };
                ranges
                    .iter()
                    .map(|ranges| summarize(rays, ranges))
                    .collect()
            })
            .collect();
        let mut per_pose: Vec<Vec<T>> = map_from_lidar.iter().map(|_| Vec::new()).collect();
        for (number, summaries) in summaries.into_iter().enumerate() {
            let first = number % groups.len() * way.poses_at_once();
            for (&pose, summary) in order[first..].iter().zip(summaries) {
                per_pose[pose as usize].push(summary);
            }
        }
        per_pose
    }

    /// Ranges of some beams of one pose.
    fn cast_packets(&self, map_from_lidar: &Pose3, rays: &[u32], beams: &Beams) -> Vec<f32> {
        let mut directions = [Vec3::ZERO; RAYS_PER_PIECE];
        let mut reaches = [Reach::UNLIMITED; RAYS_PER_PIECE];
        let mut hits = [Hit::MISS; RAYS_PER_PIECE];
        let rotation = rotation_of(map_from_lidar);
        for (place, &ray) in rays.iter().enumerate() {
            directions[place] = rotation * beams.directions[ray as usize];
            reaches[place] = beams.reaches[ray as usize];
        }
        self.scene.cast_packets(
            origin_of(map_from_lidar),
            &directions[..rays.len()],
            &reaches[..rays.len()],
            &mut hits[..rays.len()],
        );
        hits[..rays.len()].iter().map(|hit| hit.range_m).collect()
    }

    /// Ranges of some beams of one pose.
    fn cast_lone(&self, map_from_lidar: &Pose3, rays: &[u32], beams: &Beams) -> Vec<f32> {
        let rotation = rotation_of(map_from_lidar);
        let (directions, reaches): (Vec<Vec3>, Vec<Reach>) = rays
            .iter()
            .map(|&ray| ray as usize)
            .map(|ray| (rotation * beams.directions[ray], beams.reaches[ray]))
            .unzip();
        let mut ranges = vec![f32::INFINITY; rays.len()];
        let origin = origin_of(map_from_lidar);
        self.scene
            .cast_single(origin, &directions, &reaches, &mut ranges);
        ranges
    }

    /// Ranges of some beams of up to [`RAYS`] poses, pose by pose.
    fn cast_bundles(&self, map_from_lidar: &[Pose3], rays: &[u32], beams: &Beams) -> Vec<Vec<f32>> {
        // The last pose fills the empty places.
        let last = map_from_lidar.len() - 1;
        let poses: [&Pose3; RAYS] = std::array::from_fn(|place| &map_from_lidar[place.min(last)]);
        let rotations = poses.map(rotation_of);
        let (directions, reaches): (Vec<[Vec3; RAYS]>, Vec<Reach>) = rays
            .iter()
            .map(|&ray| ray as usize)
            .map(|ray| {
                let direction = beams.directions[ray];
                (rotations.map(|r| r * direction), beams.reaches[ray])
            })
            .unzip();
        let mut ranges = vec![[f32::INFINITY; RAYS]; rays.len()];
        let origins = poses.map(origin_of);
        self.scene
            .cast_bundles(&origins, &directions, &reaches, &mut ranges);
        (0..map_from_lidar.len())
            .map(|place| ranges.iter().map(|ranges| ranges[place]).collect())
            .collect()
    }

    /// Ranges of every pose, ray by ray in the order of their numbers.
    fn ranges(&self, map_from_lidar: &[Pose3], beams: &Beams) -> Vec<Vec<f32>> {
        self.each_piece(map_from_lidar, beams, |_, ranges| ranges.to_vec())
            .into_par_iter()
            .map(|pieces| {
                let mut ranges = vec![f32::INFINITY; beams.order.len()];
                for (&ray, range_m) in beams.order.iter().zip(pieces.into_iter().flatten()) {
                    ranges[ray as usize] = range_m;
                }
                ranges
            })
            .collect()
    }
}

/// Which rays go through the scene together.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Way {
    /// Neighbouring beams of one pose.
    Packets,
    /// One beam of neighbouring poses.
    Bundles,
    /// None.
    Alone,
}

impl Way {
    /// The way for poses and beams, in their order.
    fn of(poses: &[Pose3], beams: &Beams) -> Self {
        let packet_m = width_of_packets_m(&beams.directions, &beams.order);
        let bundle_m = width_of_bundles_m(poses);
        if bundle_m < WIDEST_BUNDLE_M.min(BUNDLE_PER_PACKET * packet_m) {
            Self::Bundles
        } else if packet_m < WIDEST_PACKET_M {
            Self::Packets
        } else {
            Self::Alone
        }
    }

    fn poses_at_once(self) -> usize {
        match self {
            Self::Bundles => RAYS,
            Self::Packets | Self::Alone => 1,
        }
    }
}

/// What is cast from every pose.
struct Beams {
    /// Unit, lidar frame.
    directions: Vec<Vec3>,
    reaches: Vec<Reach>,
    /// Numbers of the beams such that neighbours in the list are neighbours in space.
    order: Vec<u32>,
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
        let beams = Beams {
            directions: model.directions(),
            reaches: vec![Reach::until(model.max_range); model.len()],
            order: pixel_order(model),
        };
        let mut images = self.ranges(map_from_lidar, &beams);
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
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let beams = Beams {
            directions: directions.to_vec(),
            reaches: vec![Reach::UNLIMITED; directions.len()],
            order: coherent_order(directions),
        };
        Ok(self.ranges(map_from_lidar, &beams))
    }

    /// The normals are those of the triangles themselves.
    fn surfaces(
        &self,
        map_from_lidar: &Pose3,
        directions: &[Vec3],
    ) -> Result<Vec<Option<SurfaceHit>>, RenderError> {
        let order = coherent_order(directions);
        let (rotation, origin) = (rotation_of(map_from_lidar), origin_of(map_from_lidar));
        let pieces: Vec<Vec<Hit>> = order
            .par_chunks(RAYS_PER_PIECE)
            .map(|rays| {
                let turned: Vec<Vec3> = rays
                    .iter()
                    .map(|&ray| rotation * directions[ray as usize])
                    .collect();
                let mut hits = vec![Hit::MISS; rays.len()];
                let reaches = vec![Reach::UNLIMITED; rays.len()];
                self.scene
                    .cast_packets(origin, &turned, &reaches, &mut hits);
                hits
            })
            .collect();
        let mut surfaces = vec![None; directions.len()];
        for (&ray, hit) in order.iter().zip(pieces.into_iter().flatten()) {
            surfaces[ray as usize] = self.scene.normal(hit.triangle).map(|normal| {
                let against = rotation * directions[ray as usize];
                SurfaceHit {
                    range_m: hit.range_m,
                    normal_in_map: if normal.dot(against) > 0.0 {
                        -normal
                    } else {
                        normal
                    },
                }
            });
        }
        Ok(surfaces)
    }

    fn compare(
        &self,
        map_from_lidar: &[Pose3],
        beams: &[Beam],
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        if beams.is_empty() {
            return Ok(vec![0.0; map_from_lidar.len()]);
        }
        let directions: Vec<Vec3> = beams.iter().map(|beam| beam.direction).collect();
        let reaches = beams
            .iter()
            .map(|beam| deciding_reach(beam, difference))
            .collect();
        let to_cast = Beams {
            order: coherent_order(&directions),
            directions,
            reaches,
        };
        let sums = self.each_piece(map_from_lidar, &to_cast, |rays, ranges| {
            let costs = rays.iter().zip(ranges).map(|(&ray, &range_m)| {
                f64::from(difference.cost(beams[ray as usize].range_m, range_m))
            });
            costs.sum::<f64>()
        });
        let mean = |sums: Vec<f64>| (sums.iter().sum::<f64>() / beams.len() as f64) as f32;
        Ok(sums.into_iter().map(mean).collect())
    }
}

/// Where a ray must look for its exact cost: no surface matters at whose range the cost has reached
/// its limit. Where all limits are one, a ray that meets nothing about its measured range costs
/// that limit, whatever stands before.
fn deciding_reach(beam: &Beam, difference: &RangeDifference) -> Reach {
    let measured_m = beam.range_m;
    let nothing_costs_as_far = measured_m.min(difference.no_surface_m) == difference.short_m;
    let is_of_the_ground = beam.direction.z * measured_m < HIGHEST_GROUND_M;
    Reach {
        until_m: if nothing_costs_as_far {
            (measured_m + difference.short_m) * (1.0 + ROUNDING)
        } else {
            f32::INFINITY
        },
        enough_m: (measured_m - difference.long_m) * (1.0 - ROUNDING),
        is_window: nothing_costs_as_far
            && difference.long_m == difference.short_m
            && !is_of_the_ground,
    }
}

#[cfg(test)]
mod tests;
