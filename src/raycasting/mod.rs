//! What a ray meets first: triangles in a bounding volume hierarchy, cast at in packets of rays
//! that share their origin.

pub(crate) mod bvh;
mod packet;

use glam::{DVec3, Vec3};

use crate::geometry::{Aabb, TriangleMesh};
use bvh::{Bvh, Item};
use packet::{Block, Packet, RAYS, TRIANGLES};

/// Surfaces nearer to the origin of a ray are not met [m]: a ray does not meet the surface that
/// it starts on.
pub const NEAREST_M: f32 = 1e-4;

/// A triangle is degenerate where its height is less than this part of its longest edge.
const THINNEST: f64 = 1e-7;
/// By this part of the extent of the scene boxes are larger than what is in them: as much as
/// rounding can move an edge.
const PADDING: f32 = 4.0 * f32::EPSILON;

/// What a ray met first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance along the unit direction [m]; infinite where nothing was met.
    pub range_m: f32,
    /// Index of the triangle in the mesh, or [`Hit::NO_TRIANGLE`].
    pub triangle: u32,
}

impl Hit {
    /// The triangle of a ray that met nothing.
    pub const NO_TRIANGLE: u32 = u32::MAX;

    /// The ray met nothing.
    pub const MISS: Self = Self {
        range_m: f32::INFINITY,
        triangle: Self::NO_TRIANGLE,
    };
}

/// Triangles that rays can be cast at, from both sides.
///
/// Coordinates are kept relative to the middle of the mesh. Triangles that are degenerate or not
/// finite are never met.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The origin of the stored coordinates in the frame of the mesh [m].
    middle: DVec3,
    bvh: Bvh,
    /// One per leaf.
    blocks: Vec<Block>,
}

impl Scene {
    /// Builds the hierarchy over a mesh, on all threads of the current pool.
    pub fn new(mesh: &TriangleMesh) -> Self {
        let usable: Vec<u32> = (0..mesh.triangles.len())
            .filter(|&triangle| is_proper(mesh.corners(triangle)))
            .map(|triangle| triangle as u32)
            .collect();
        let corners = |triangle: u32| mesh.corners(triangle as usize);
        let bounds = Aabb::of(usable.iter().flat_map(|&triangle| corners(triangle)));
        let middle = if bounds.is_empty() {
            Vec3::ZERO
        } else {
            bounds.min.midpoint(bounds.max)
        };
        let local = |triangle: u32| corners(triangle).map(|corner| corner - middle);
        let padding = Vec3::splat(PADDING * bounds.size().max_element().max(0.0));
        let items = usable.iter().map(|&index| {
            let bounds = Aabb::of(local(index));
            Item {
                bounds: Aabb {
                    min: bounds.min - padding,
                    max: bounds.max + padding,
                },
                index,
            }
        });
        let bvh = Bvh::build(items.collect(), TRIANGLES);
        let blocks = bvh
            .leaves
            .iter()
            .map(|leaf| {
                let triangles = &bvh.order[leaf.start as usize..leaf.end as usize];
                Block::new(triangles.iter().map(|&index| (local(index), index)))
            })
            .collect();
        Self {
            middle: middle.as_dvec3(),
            bvh,
            blocks,
        }
    }

    /// Casts rays from one origin along unit directions, all in the frame of the mesh, and writes
    /// what each meets first. Runs on the calling thread alone; directions that are neighbours in
    /// the list should be neighbours in space.
    ///
    /// # Panics
    /// Where there are not as many hits as directions.
    pub fn cast(&self, origin: Vec3, directions: &[Vec3], hits: &mut [Hit]) {
        self.cast_until(origin, directions, f32::INFINITY, hits);
    }

    /// Like [`Scene::cast`], but what is at `max_range_m` or farther is not met.
    pub fn cast_until(
        &self,
        origin: Vec3,
        directions: &[Vec3],
        max_range_m: f32,
        hits: &mut [Hit],
    ) {
        assert_eq!(directions.len(), hits.len(), "one hit per direction");
        let origin = (origin.as_dvec3() - self.middle).as_vec3();
        for (directions, hits) in directions.chunks(RAYS).zip(hits.chunks_mut(RAYS)) {
            let mut packet = Packet::new(directions, &[max_range_m; RAYS][..directions.len()]);
            packet.cast(origin, &self.bvh, &self.blocks);
            for (ray, hit) in hits.iter_mut().enumerate() {
                *hit = packet.hit(ray);
            }
        }
    }
}

/// Whether a triangle has finite corners and an area.
pub(crate) fn is_proper(corners: [Vec3; 3]) -> bool {
    let [a, b, c] = corners.map(|corner| corner.as_dvec3());
    let longest_squared = (b - a)
        .length_squared()
        .max((c - b).length_squared())
        .max((a - c).length_squared());
    let twice_area = (b - a).cross(c - a).length();
    twice_area.is_finite() && twice_area > THINNEST * longest_squared
}

#[cfg(test)]
mod tests;
