//! Rays that go through the scene in bundles, each ray from an origin of its own.

use glam::{DVec3, Vec3};

use super::{Reach, Scene};
use crate::raycasting::bundle::{Bundle, per_axis};
use crate::raycasting::lanes::{Lanes, Plain};
use crate::raycasting::packet::{RAYS, Rays, Walk};
use crate::raycasting::triangle::Vectors;

impl Scene {
    /// Casts bundles of rays from the same origins, which is faster than [`Scene::cast_lone`] where
    /// the rays of a bundle stay close to each other, and writes the range of what each meets first:
    /// the same, bit by bit, with the exceptions that are named there. All rays of a bundle have one
    /// reach. Runs on the calling thread alone.
    ///
    /// # Panics
    /// Where there are not as many reaches or ranges as bundles.
    pub fn cast_bundles(
        &self,
        origins: &[DVec3; RAYS],
        directions: &[[Vec3; RAYS]],
        reach: &[Reach],
        ranges_m: &mut [Rays],
    ) {
        assert_eq!(directions.len(), ranges_m.len(), "ranges for each bundle");
        assert_eq!(directions.len(), reach.len(), "one reach per bundle");
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") {
            #[expect(unsafe_code, reason = "the line above has found the instructions")]
            unsafe {
                self.cast_bundles_avx2(origins, directions, reach, ranges_m);
            }
            return;
        }
        self.cast_bundles_portable(origins, directions, reach, ranges_m);
    }

    /// [`Scene::cast_bundles_portable`] in the registers of AVX2.
    #[cfg(target_arch = "x86_64")]
    #[target_feature(enable = "avx2")]
    fn cast_bundles_avx2(
        &self,
        origins: &[DVec3; RAYS],
        directions: &[[Vec3; RAYS]],
        reach: &[Reach],
        ranges_m: &mut [Rays],
    ) {
        use std::arch::x86_64::__m256;
        self.cast_bundles_in::<__m256>(origins, directions, reach, ranges_m);
    }

    pub(in crate::raycasting) fn cast_bundles_portable(
        &self,
        origins: &[DVec3; RAYS],
        directions: &[[Vec3; RAYS]],
        reach: &[Reach],
        ranges_m: &mut [Rays],
    ) {
        self.cast_bundles_in::<Plain<RAYS>>(origins, directions, reach, ranges_m);
    }

    #[inline(always)]
    fn cast_bundles_in<L: Lanes<RAYS>>(
        &self,
        origins: &[DVec3; RAYS],
        directions: &[[Vec3; RAYS]],
        reach: &[Reach],
        ranges_m: &mut [Rays],
    ) {
        for ((directions, &reach), ranges_m) in directions.iter().zip(reach).zip(ranges_m) {
            let mut bundle = Bundle::<L>::new(directions, reach);
            if bundle.is_coherent {
                self.cast_bundle::<L, true>(origins, &mut bundle);
            } else {
                self.cast_bundle::<L, false>(origins, &mut bundle);
            }
            *ranges_m = bundle.range_m;
        }
    }

    #[inline(always)]
    fn cast_bundle<L: Lanes<RAYS>, const COHERENT: bool>(
        &self,
        origins: &[DVec3; RAYS],
        bundle: &mut Bundle<L>,
    ) {
        let mut tiles = Walk::<_, COHERENT>::new(&self.top, from(self.middle, origins));
        while let Some(tile) = tiles.next_leaf(bundle) {
            let tile = &self.tiles[tile];
            let origin = from(tile.middle, origins);
            let mut leaves = Walk::<_, COHERENT>::new(&tile.bvh, origin);
            while let Some(leaf) = leaves.next_leaf(bundle) {
                bundle.meet(origin, &self.blocks[tile.first_block + leaf]);
            }
        }
    }
}

/// The origins in the frame of a hierarchy.
#[inline(always)]
fn from<L: Lanes<RAYS>>(middle: DVec3, origins: &[DVec3; RAYS]) -> Vectors<L> {
    per_axis(&origins.map(|origin| (origin - middle).as_vec3())).map(|axis| L::load(&axis))
}
