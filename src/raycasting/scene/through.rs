//! All surfaces that a ray goes through, not only the first.
//!
//! One ray at a time against the four triangles of a block, with the edge test of
//! [`super::super::packet`]: the boxes have to be walked through to the end of the ray, so there
//! is less that neighbouring rays could share.

use super::{Hit, Scene, Tile};
use crate::geometry::Vec3;
use crate::raycasting::NEAREST_M;
use crate::raycasting::block::{Block, Corner, TRIANGLES, edge, rounding};
use crate::raycasting::bvh::{Bvh, Child, MAX_DEPTH};
use crate::raycasting::packet::{FARTHER, max, min};

/// One over a coordinate of a direction is never more than this, so that 0 · ∞ does not occur.
const STEEPEST: f32 = 1e18;

/// A ray in the frame of a hierarchy.
#[derive(Clone, Copy)]
struct Ray {
    origin: Vec3,
    direction: Vec3,
    inverse: Vec3,
    until_m: f32,
}

impl Scene {
    /// Visits every triangle that a ray meets nearer than `until_m`, in no particular order but
    /// always the same. Where the ray passes an edge within rounding, both triangles are visited.
    ///
    /// `origin` and the unit `direction` are in the frame of the mesh.
    pub fn for_each_hit(
        &self,
        origin: Vec3,
        direction: Vec3,
        until_m: f32,
        mut visit: impl FnMut(Hit),
    ) {
        let inverse = |d: f32| (1.0 / d).clamp(-STEEPEST, STEEPEST);
        let from = |middle: glam::DVec3| Ray {
            origin: (origin.as_dvec3() - middle).as_vec3(),
            direction,
            inverse: Vec3::new(
                inverse(direction.x),
                inverse(direction.y),
                inverse(direction.z),
            ),
            until_m,
        };
        for_each_leaf(&self.top, &from(self.middle), |tile| {
            let tile = &self.tiles[tile];
            self.for_each_hit_in(tile, &from(tile.middle), &mut visit);
        });
    }

    fn for_each_hit_in(&self, tile: &Tile, ray: &Ray, visit: &mut impl FnMut(Hit)) {
        for_each_leaf(&tile.bvh, ray, |leaf| {
            let block = &self.blocks[tile.first_block + leaf];
            for (place, range_m) in ray.meet(block).into_iter().enumerate() {
                if range_m > NEAREST_M && range_m < ray.until_m {
                    visit(Hit {
                        range_m,
                        triangle: block.index(place),
                    });
                }
            }
        });
    }
}

fn for_each_leaf(bvh: &Bvh, ray: &Ray, mut visit: impl FnMut(usize)) {
    let mut waiting = [Child::leaf(0); MAX_DEPTH];
    let mut next = bvh.root;
    let mut count = 0;
    while let Some(current) = next {
        next = None;
        if current.is_leaf() {
            visit(current.index());
        } else {
            let node = &bvh.nodes[current.index()];
            let (first, second) = (ray.enters(&node.bounds[0]), ray.enters(&node.bounds[1]));
            if first & second {
                waiting[count] = node.children[1];
                count += 1;
            }
            if first | second {
                next = Some(node.children[usize::from(!first)]);
            }
        }
        if next.is_none() && count > 0 {
            count -= 1;
            next = Some(waiting[count]);
        }
    }
}

impl Ray {
    #[inline(always)]
    fn enters(&self, bounds: &[f32; 6]) -> bool {
        let (mut near, mut far) = (0.0, self.until_m);
        for axis in 0..3 {
            let a = (bounds[axis] - self.origin[axis]) * self.inverse[axis];
            let b = (bounds[axis + 3] - self.origin[axis]) * self.inverse[axis];
            near = max(near, min(a, b));
            far = min(far, max(a, b));
        }
        near <= far * FARTHER
    }

    /// The range at which the triangles of a block are met; infinite where they are not.
    #[inline(always)]
    fn meet(&self, block: &Block) -> [f32; TRIANGLES] {
        let [a, b, c] = block.corners_from(self.origin);
        let rounding = rounding(&a, &b, &c);
        let w = self.dot(&edge(&a, &b));
        let u = self.dot(&edge(&b, &c));
        let v = self.dot(&edge(&c, &a));
        let (a, b, c) = (self.dot(&a), self.dot(&b), self.dot(&c));
        std::array::from_fn(|i| {
            let least = min(min(u[i], v[i]), w[i]);
            let most = max(max(u[i], v[i]), w[i]);
            if !block.has(i) || (least < -rounding[i] && most > rounding[i]) {
                return f32::INFINITY;
            }
            // Seen edge-on, the quotient may be anything.
            let range_m = (u[i] * a[i] + v[i] * b[i] + w[i] * c[i]) / (u[i] + v[i] + w[i]);
            let range_m = max(min(min(a[i], b[i]), c[i]), range_m);
            min(max(max(a[i], b[i]), c[i]), range_m)
        })
    }

    /// The direction times a vector of each triangle.
    #[inline(always)]
    fn dot(&self, vectors: &Corner) -> [f32; TRIANGLES] {
        std::array::from_fn(|i| {
            self.direction.x * vectors[0][i]
                + self.direction.y * vectors[1][i]
                + self.direction.z * vectors[2][i]
        })
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::geometry::TriangleMesh;

    /// Squares across the x axis, one per metre from 1 m on.
    fn sheets(count: usize) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        for sheet in 0..count as u32 {
            let x = 1.0 + sheet as f32;
            for (y, z) in [(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)] {
                mesh.vertices.push(Vec3::new(x, y, z));
            }
            mesh.triangles
                .extend([[0, 1, 2], [0, 2, 3]].map(|t| t.map(|corner| 4 * sheet + corner)));
        }
        mesh
    }

    fn ranges(scene: &Scene, direction: Vec3, until_m: f32) -> Vec<f32> {
        let mut ranges = Vec::new();
        scene.for_each_hit(Vec3::ZERO, direction, until_m, |hit| {
            ranges.push(hit.range_m);
        });
        ranges.sort_by(f32::total_cmp);
        ranges
    }

    #[test]
    fn a_ray_meets_every_sheet_up_to_its_end_once() {
        let scene = Scene::new(&sheets(50));
        let direction = Vec3::new(1.0, 0.01, -0.03).normalize();
        let found = ranges(&scene, direction, 30.5);
        let expected: Vec<f32> = (1..=30).map(|x| x as f32 / direction.x).collect();
        assert_eq!(found.len(), expected.len());
        for (found, expected) in found.iter().zip(expected) {
            assert!((found - expected).abs() < 1e-4);
        }
        assert!(ranges(&scene, -direction, 30.5).is_empty());
    }

    #[test]
    fn the_nearest_of_all_hits_is_the_first_hit() {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut mesh = TriangleMesh::default();
        let mut draw = |size: f32| {
            let mut coordinate = || rng.random_range(-size..size);
            Vec3::new(coordinate(), coordinate(), coordinate())
        };
        for triangle in 0..3000 {
            let middle = draw(20.0);
            mesh.vertices.extend([0; 3].map(|_| middle + draw(1.5)));
            mesh.triangles.push([0, 1, 2].map(|k| 3 * triangle + k));
        }
        let scene = Scene::new(&mesh);
        let mut hits = [Hit::MISS];
        for _ in 0..2000 {
            let direction = draw(1.0).normalize();
            scene.cast(Vec3::ZERO, &[direction], &mut hits);
            let all = ranges(&scene, direction, f32::INFINITY);
            let nearest = all.first().copied().unwrap_or(f32::INFINITY);
            assert_eq!(nearest, hits[0].range_m);
        }
    }
}
