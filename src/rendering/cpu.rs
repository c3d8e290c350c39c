//! Rendering by casting rays at the tiles of the map, on all threads of the current pool.
//!
//! Rays are put in an order once in which neighbours in the list are neighbours in space, and cut
//! into pieces that do not depend on the number of threads; sums are made piece by piece in that
//! order. So the result is the same, byte for byte, on every machine.
//!
//! Poses that are close to each other are cast together (`groups`). A ray meets the same bits as
//! alone, unless it passes an edge within rounding: then it may meet either of the triangles there,
//! whose ranges differ by about a millimetre where they are seen at a flat angle: some rays in ten
//! million on the street of the bench.

mod groups;

use glam::{DVec3, Mat3};
use rayon::prelude::*;

use groups::groups_of;

use super::{RangeDifference, RangeRenderer, RenderError, SurfaceHit};
use crate::geometry::{Pose3, Rigid3f, TriangleMesh, Vec3};
use crate::lidar::{Beam, LidarModel, Pixel};
use crate::raycasting::{Hit, RAYS, Reach, Scene};

/// Rays that are cast without asking for another thread.
const RAYS_PER_PIECE: usize = 512;
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
        let groups = groups_of(map_from_lidar, &beams.directions, &beams.order);
        let pieces: Vec<&[u32]> = beams.order.chunks(RAYS_PER_PIECE).collect();
        let summaries: Vec<Vec<T>> = (0..groups.len() * pieces.len())
            .into_par_iter()
            .map(|number| {
                let group = &groups[number / pieces.len()];
                let rays = pieces[number % pieces.len()];
                let poses = group
                    .poses
                    .iter()
                    .map(|&pose| &map_from_lidar[pose as usize]);
                let ranges = if group.is_bundled {
                    self.cast_bundles(&poses.collect::<Vec<_>>(), rays, beams)
                } else {
                    poses
                        .map(|pose| self.cast_packets(pose, rays, beams))
                        .collect()
                };
                ranges
                    .iter()
                    .map(|ranges| summarize(rays, ranges))
                    .collect()
            })
            .collect();
        let mut per_pose: Vec<Vec<T>> = map_from_lidar
            .iter()
            .map(|_| Vec::with_capacity(pieces.len()))
            .collect();
        for (number, summaries) in summaries.into_iter().enumerate() {
            let poses = &groups[number / pieces.len()].poses;
            for (&pose, summary) in poses.iter().zip(summaries) {
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
        self.scene.cast_within(
            origin_of(map_from_lidar),
            &directions[..rays.len()],
            &reaches[..rays.len()],
            &mut hits[..rays.len()],
        );
        hits[..rays.len()].iter().map(|hit| hit.range_m).collect()
    }

    /// Ranges of some beams of up to eight poses, a row per pose.
    fn cast_bundles(&self, poses: &[&Pose3], rays: &[u32], beams: &Beams) -> Vec<Vec<f32>> {
        // The last pose fills the empty places.
        let pose_of = |place: usize| poses[place.min(poses.len() - 1)];
        let origins = std::array::from_fn(|place| origin_of(pose_of(place)));
        let rotations: [_; RAYS] = std::array::from_fn(|place| rotation_of(pose_of(place)));
        let mut directions = [[Vec3::ZERO; RAYS]; RAYS_PER_PIECE];
        let mut reaches = [Reach::UNLIMITED; RAYS_PER_PIECE];
        let mut ranges_m = [[f32::INFINITY; RAYS]; RAYS_PER_PIECE];
        for (place, &ray) in rays.iter().enumerate() {
            directions[place] = rotations.map(|rotation| rotation * beams.directions[ray as usize]);
            reaches[place] = beams.reaches[ray as usize];
        }
        let ranges_m = &mut ranges_m[..rays.len()];
        self.scene.cast_bundles(
            &origins,
            &directions[..rays.len()],
            &reaches[..rays.len()],
            ranges_m,
        );
        (0..poses.len())
            .map(|place| ranges_m.iter().map(|ranges_m| ranges_m[place]).collect())
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
                self.scene.cast_within(origin, &turned, &reaches, &mut hits);
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
            .map(|beam| deciding_reach(beam.range_m, difference))
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

/// How far a ray must look for its exact cost: no surface matters at whose range the cost has
/// reached its limit.
fn deciding_reach(measured_m: f32, difference: &RangeDifference) -> Reach {
    let nothing_costs_as_far = measured_m.min(difference.no_surface_m) == difference.short_m;
    Reach {
        until_m: if nothing_costs_as_far {
            (measured_m + difference.short_m) * (1.0 + ROUNDING)
        } else {
            f32::INFINITY
        },
        enough_m: (measured_m - difference.long_m) * (1.0 - ROUNDING),
    }
}

/// Pixels in blocks of four columns and two rows, the blocks column by column: what lies in one
/// direction stays in the cache.
fn pixel_order(model: &LidarModel) -> Vec<u32> {
    let mut order: Vec<u32> = Vec::with_capacity(model.len());
    for left in (0..model.width).step_by(4) {
        for top in (0..model.height).step_by(2) {
            for row in top..model.height.min(top + 2) {
                for column in left..model.width.min(left + 4) {
                    order.push(model.index_of(Pixel { row, column }) as u32);
                }
            }
        }
    }
    order
}

/// Directions along a Z-shaped curve over azimuth and elevation (Morton 1966).
fn coherent_order(directions: &[Vec3]) -> Vec<u32> {
    let mut keyed: Vec<(u32, u32)> = directions
        .iter()
        .enumerate()
        .map(|(ray, direction)| {
            // Grows with the azimuth, from -2 to 2.
            let along = direction.x / (direction.x.abs() + direction.y.abs());
            let turn = if direction.y < 0.0 {
                along - 1.0
            } else {
                1.0 - along
            };
            // As fine in elevation as in azimuth: half a turn is a half of both.
            let key = spread(((turn + 2.0) * 4096.0) as u32)
                | spread(((direction.z + 1.0) * 4096.0) as u32) << 1;
            (key, ray as u32)
        })
        .collect();
    keyed.sort_unstable();
    keyed.into_iter().map(|(_, ray)| ray).collect()
}

/// Puts a zero before each of the lower 16 bits.
fn spread(bits: u32) -> u32 {
    let bits = bits & 0xffff;
    let bits = (bits | bits << 8) & 0x00ff_00ff;
    let bits = (bits | bits << 4) & 0x0f0f_0f0f;
    let bits = (bits | bits << 2) & 0x3333_3333;
    (bits | bits << 1) & 0x5555_5555
}

#[cfg(test)]
mod tests;
