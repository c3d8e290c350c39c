//! Rays that go through the scene one by one.

use glam::{DVec3, Vec3};

use super::{Reach, Scene};
use crate::raycasting::block::TRIANGLES;
use crate::raycasting::lanes::{Lanes, Plain};
use crate::raycasting::lone::{LoneRay, LoneWalk, WaitingRoom};
use crate::raycasting::wide::CHILDREN;

impl Scene {
    /// Casts rays from one origin one by one, which is faster than [`Scene::cast_within`] where
    /// they are far from each other, and writes the range of what each meets first: the same, bit by
    /// bit, with two exceptions: of surfaces nearer than [`Reach::enough_m`] it may be another, and
    /// so it may be of the triangles at an edge that the ray passes within rounding. Runs on the
    /// calling thread alone.
    ///
    /// # Panics
    /// Where there are not as many reaches or ranges as directions.
    pub fn cast_lone(
        &self,
        origin: DVec3,
        directions: &[Vec3],
        reach: &[Reach],
        ranges_m: &mut [f32],
    ) {
        assert_eq!(directions.len(), ranges_m.len(), "one range per direction");
        assert_eq!(directions.len(), reach.len(), "one reach per direction");
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            #[expect(unsafe_code, reason = "the line above has found the instructions")]
            unsafe {
                self.cast_lone_avx2(origin, directions, reach, ranges_m);
            }
            return;
        }
        self.cast_lone_portable(origin, directions, reach, ranges_m);
    }

    /// [`Scene::cast_lone_portable`] in the registers of AVX2.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn cast_lone_avx2(
        &self,
        origin: DVec3,
        directions: &[Vec3],
        reach: &[Reach],
        ranges_m: &mut [f32],
    ) {
        use std::arch::x86_64::{__m128, __m256};
        self.cast_lone_in::<__m256, __m128>(origin, directions, reach, ranges_m);
    }

    pub(in crate::raycasting) fn cast_lone_portable(
        &self,
        origin: DVec3,
        directions: &[Vec3],
        reach: &[Reach],
        ranges_m: &mut [f32],
    ) {
        self.cast_lone_in::<Plain<CHILDREN>, Plain<TRIANGLES>>(origin, directions, reach, ranges_m);
    }

    #[inline(always)]
    fn cast_lone_in<N: Lanes<CHILDREN>, B: Lanes<TRIANGLES>>(
        &self,
        origin: DVec3,
        directions: &[Vec3],
        reach: &[Reach],
        ranges_m: &mut [f32],
    ) {
        let mut rooms = [WaitingRoom::new(), WaitingRoom::new()];
        for ((&direction, &reach), range_m) in directions.iter().zip(reach).zip(ranges_m) {
            let whole = LoneRay::new(direction, reach);
            let mut ray = if reach.is_window {
                whole.between(reach.enough_m, reach.until_m)
            } else {
                whole
            };
            let mut is_done = !reach.is_window;
            loop {
                self.cast_ray_in::<N, B>(origin, &mut ray, &mut rooms);
                if is_done || ray.range_m == f32::INFINITY {
                    break;
                }
                // There is something in the window: is it hidden?
                ray = ray.between(0.0, reach.enough_m);
                is_done = true;
            }
            *range_m = ray.range_m;
        }
    }

    #[inline(always)]
    fn cast_ray_in<N: Lanes<CHILDREN>, B: Lanes<TRIANGLES>>(
        &self,
        origin: DVec3,
        ray: &mut LoneRay,
        [over_tiles, in_tile]: &mut [WaitingRoom; 2],
    ) {
        let from_middle = (origin - self.middle).as_vec3();
        let mut tiles = LoneWalk::<N>::new(ray, &self.wide_top, from_middle, over_tiles);
        while let Some(tile) = tiles.next_leaf(ray) {
            let tile = &self.tiles[tile];
            let origin = (origin - tile.middle).as_vec3();
            let mut leaves = LoneWalk::<N>::new(ray, &tile.wide_bvh, origin, in_tile);
            while let Some(leaf) = leaves.next_leaf(ray) {
                ray.meet::<B>(origin, &self.blocks[tile.first_block + leaf]);
            }
        }
    }
}
