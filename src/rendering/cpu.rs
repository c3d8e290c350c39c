//! Rendering by casting rays at the tiles of the map, on all threads of the current pool.
//!
//! Rays are put in an order once in which neighbours in the list are neighbours in space, and cut
//! into pieces that do not depend on the number of threads; sums are made piece by piece in that
//! order. So the result is the same, byte for byte, on every machine.

use glam::DVec3;
use rayon::prelude::*;

use super::{RangeDifference, RangeRenderer, RenderError};
use crate::geometry::{Pose3, Rigid3f, TriangleMesh, Vec3};
use crate::lidar::{Beam, LidarModel, Pixel};
use crate::raycasting::{Hit, Reach, Scene};

/// Rays that are cast without asking for another thread.
const RAYS_PER_PIECE: usize = 512;
/// Rounding of sums and differences of ranges.
const ROUNDING: f32 = 1e-6;

/// A surface of the map that a ray met.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceHit {
    /// Distance along the unit direction [m].
    pub range_m: f32,
    /// Unit normal of the triangle, map frame, on the side that the ray comes from.
    pub normal_in_map: Vec3,
}

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

    /// What rays along unit directions of the lidar frame meet first, and how it is turned.
    pub fn surfaces(&self, map_from_lidar: &Pose3, directions: &[Vec3]) -> Vec<Option<SurfaceHit>> {
        let order = coherent_order(directions);
        let pose = std::slice::from_ref(map_from_lidar);
        let pieces = self.cast_pieces(pose, &order, |ray| directions[ray], |_| Reach::UNLIMITED);
        let mut surfaces = vec![None; directions.len()];
        let rotation = Rigid3f::from(map_from_lidar).rotation;
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
        surfaces
    }

    /// Casts the rays of every pose piece by piece; the pieces of a pose follow each other.
    fn cast_pieces(
        &self,
        map_from_lidar: &[Pose3],
        order: &[u32],
        direction: impl Fn(usize) -> Vec3 + Sync,
        reach: impl Fn(usize) -> Reach + Sync,
    ) -> Vec<Vec<Hit>> {
        self.each_piece(map_from_lidar, order, direction, reach, |_, hits| {
            hits.to_vec()
        })
    }

    /// Casts the rays of every pose piece by piece, and keeps what `summarize` makes of the
    /// numbers of the rays of each piece and what they met.
    fn each_piece<T: Send>(
        &self,
        map_from_lidar: &[Pose3],
        order: &[u32],
        direction: impl Fn(usize) -> Vec3 + Sync,
        reach: impl Fn(usize) -> Reach + Sync,
        summarize: impl Fn(&[u32], &[Hit]) -> T + Sync,
    ) -> Vec<T> {
        let pieces_per_pose = order.len().div_ceil(RAYS_PER_PIECE);
        (0..map_from_lidar.len() * pieces_per_pose)
            .into_par_iter()
            .map(|number| {
                let pose = &map_from_lidar[number / pieces_per_pose];
                let first = number % pieces_per_pose * RAYS_PER_PIECE;
                let rays = &order[first..order.len().min(first + RAYS_PER_PIECE)];
                let mut directions = [Vec3::ZERO; RAYS_PER_PIECE];
                let mut reaches = [Reach::UNLIMITED; RAYS_PER_PIECE];
                let mut hits = [Hit::MISS; RAYS_PER_PIECE];
                let rotation = Rigid3f::from(pose).rotation;
                for (place, &ray) in rays.iter().enumerate() {
                    directions[place] = rotation * direction(ray as usize);
                    reaches[place] = reach(ray as usize);
                }
                let t = pose.translation.vector;
                let (origin, hits) = (DVec3::new(t.x, t.y, t.z), &mut hits[..rays.len()]);
                self.scene.cast_within(
                    origin,
                    &directions[..rays.len()],
                    &reaches[..rays.len()],
                    hits,
                );
                summarize(rays, hits)
            })
            .collect()
    }

    /// Ranges of every pose, ray by ray in the order of their numbers.
    fn ranges(
        &self,
        map_from_lidar: &[Pose3],
        order: &[u32],
        direction: impl Fn(usize) -> Vec3 + Sync,
        reach: Reach,
    ) -> Vec<Vec<f32>> {
        if order.is_empty() {
            return vec![Vec::new(); map_from_lidar.len()];
        }
        let pieces = self.cast_pieces(map_from_lidar, order, direction, |_| reach);
        pieces
            .par_chunks(order.len().div_ceil(RAYS_PER_PIECE))
            .map(|pieces| {
                let mut ranges = vec![f32::INFINITY; order.len()];
                for (&ray, hit) in order.iter().zip(pieces.iter().flatten()) {
                    ranges[ray as usize] = hit.range_m;
                }
                ranges
            })
            .collect()
    }
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
        let directions = model.directions();
        let reach = Reach::until(model.max_range);
        let order = pixel_order(model);
        let mut images = self.ranges(map_from_lidar, &order, |ray| directions[ray], reach);
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
        let order = coherent_order(directions);
        let direction = |ray: usize| directions[ray];
        Ok(self.ranges(map_from_lidar, &order, direction, Reach::UNLIMITED))
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
        let order = coherent_order(&directions);
        let reaches: Vec<Reach> = beams
            .iter()
            .map(|beam| deciding_reach(beam.range_m, difference))
            .collect();
        let sums = self.each_piece(
            map_from_lidar,
            &order,
            |ray| directions[ray],
            |ray| reaches[ray],
            |rays, hits| {
                let costs = rays.iter().zip(hits).map(|(&ray, hit)| {
                    f64::from(difference.cost(beams[ray as usize].range_m, hit.range_m))
                });
                costs.sum::<f64>()
            },
        );
        let mean = |sums: &[f64]| (sums.iter().sum::<f64>() / beams.len() as f64) as f32;
        let pieces_per_pose = order.len().div_ceil(RAYS_PER_PIECE);
        Ok(sums.chunks(pieces_per_pose).map(mean).collect())
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
