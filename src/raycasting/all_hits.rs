//! All surfaces along a ray, not only the nearest.
//!
//! The boxes have to be traversed to the end of the ray, so neighbouring rays have less to share:
//! the rays are single.

use glam::DVec3;

use super::place::{Leaf, Place};
use super::single::SingleRay;
use super::traversal::Traverse;
use super::triangle::TriangleBlock;
use super::wide::{BoxGrid, CHILDREN, WideNode};
use crate::simd::Simd;

/// A ray that visits all its hits: their ranges and places.
pub(super) struct AllHits<F> {
    pub ray: SingleRay,
    pub visit: F,
}

impl<S: Simd, F: FnMut(f32, Place)> Traverse<S> for AllHits<F> {
    type Relative = <SingleRay as Traverse<S>>::Relative;

    #[inline(always)]
    fn relative_to(&self, simd: S, middle: DVec3, grid: &BoxGrid) -> Self::Relative {
        self.ray.relative_to(simd, middle, grid)
    }

    #[inline(always)]
    fn enter(&self, simd: S, ray: &Self::Relative, node: &WideNode) -> (u32, [f32; CHILDREN]) {
        self.ray.enter(simd, ray, node)
    }

    #[inline(always)]
    fn until_m(&self) -> f32 {
        Traverse::<S>::until_m(&self.ray)
    }

    #[inline(always)]
    fn intersect(&mut self, _: S, ray: &Self::Relative, block: &TriangleBlock, leaf: Leaf) {
        let (hits, range_m) = self.ray.hits(ray.origin, block);
        for lane in (0..block.count).filter(|lane| hits >> lane & 1 == 1) {
            (self.visit)(range_m[lane], Place::new(leaf, lane));
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use crate::geometry::{TriangleMesh, Vec3};
    use crate::raycasting::{Hit, Scene};

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
    fn a_ray_hits_every_sheet_up_to_its_end_once() {
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
