//! The ways to cast rays at a scene: in packets, in bundles, singly, and through all surfaces.

use glam::{DVec3, Vec3};

use super::Scene;
use crate::raycasting::all_hits::AllHits;
use crate::raycasting::packet::{Origin, Packet};
use crate::raycasting::place::{Leaf, Place};
use crate::raycasting::single::SingleRay;
use crate::raycasting::traversal::{Stack, Traversal, Traverse};
use crate::raycasting::{Hit, RAYS, Reach};
use crate::simd::{Simd, SimdTask, dispatch};

impl Scene {
    /// Casts rays from one origin along unit directions, all in the frame of the mesh, and writes
    /// the nearest hit of each. Runs on the calling thread; directions that are neighbours in the
    /// list should be neighbours in space.
    ///
    /// # Panics
    /// If there are not as many hits as directions.
    pub fn cast(&self, origin: Vec3, directions: &[Vec3], hits: &mut [Hit]) {
        self.cast_until(origin, directions, f32::INFINITY, hits);
    }

    /// Like [`Scene::cast`], but surfaces at `max_range_m` or farther are not hit.
    pub fn cast_until(
        &self,
        origin: Vec3,
        directions: &[Vec3],
        max_range_m: f32,
        hits: &mut [Hit],
    ) {
        const AT_ONCE: usize = 32 * RAYS;
        assert_eq!(directions.len(), hits.len(), "one hit per direction");
        let reaches = [Reach::until(max_range_m); AT_ONCE];
        let chunks = directions.chunks(AT_ONCE).zip(hits.chunks_mut(AT_ONCE));
        for (directions, hits) in chunks {
            let reaches = &reaches[..directions.len()];
            let Ok(()) = self.cast_packets(origin.as_dvec3(), directions, reaches, hits);
        }
    }

    /// Visits every triangle that a ray hits nearer than `until_m`, in no particular order but
    /// always the same. If the ray passes an edge within rounding, both triangles are visited.
    ///
    /// `origin` and the unit `direction` are in the frame of the mesh.
    pub fn for_each_hit(
        &self,
        origin: Vec3,
        direction: Vec3,
        until_m: f32,
        mut visit: impl FnMut(Hit),
    ) {
        let ray = SingleRay::new(origin.as_dvec3(), direction, Reach::until(until_m));
        let visit = |range_m, place| {
            let Ok(hit) = self.hit(range_m, place);
            visit(hit);
        };
        let Ok(()) = dispatch(AllHitsTask {
            scene: self,
            hits: AllHits { ray, visit },
        });
    }
}

impl<E: Clone> Scene<E> {
    /// Like [`Scene::cast`], but each ray has its own reach, and the origin keeps its precision
    /// far from the origin of the frame.
    ///
    /// # Errors
    /// That of a tile that a ray enters; the hits are incomplete then.
    ///
    /// # Panics
    /// If there are not as many reaches or hits as directions.
    pub fn cast_packets(
        &self,
        origin: DVec3,
        directions: &[Vec3],
        reaches: &[Reach],
        hits: &mut [Hit],
    ) -> Result<(), E> {
        dispatch(self.task(origin, directions, reaches, hits))
    }

    /// Casts bundles of rays from the same origins, which is faster than [`Scene::cast_single`] if
    /// the rays of a bundle stay close to each other, and writes the ranges of their nearest hits:
    /// the same, bit by bit, with the exceptions that are named there. All rays of a bundle have
    /// one reach. Runs on the calling thread.
    ///
    /// # Errors
    /// That of a tile that a ray enters.
    ///
    /// # Panics
    /// If there are not as many reaches or ranges as bundles.
    pub fn cast_bundles(
        &self,
        origins: &[DVec3; RAYS],
        directions: &[[Vec3; RAYS]],
        reaches: &[Reach],
        ranges_m: &mut [[f32; RAYS]],
    ) -> Result<(), E> {
        dispatch(self.task(*origins, directions, reaches, ranges_m))
    }

    /// Casts single rays from one origin, which is faster than [`Scene::cast_packets`] if they
    /// diverge, and writes the nearest hit of each: the same, bit by bit, with two
    /// exceptions: of surfaces nearer than `Reach::enough_m` it may be another, and so it may be
    /// of the triangles at an edge that the ray passes within rounding. Runs on the calling thread.
    ///
    /// # Errors
    /// That of a tile that a ray enters; the hits are incomplete then.
    ///
    /// # Panics
    /// If there are not as many reaches or hits as directions.
    pub fn cast_single(
        &self,
        origin: DVec3,
        directions: &[Vec3],
        reaches: &[Reach],
        hits: &mut [Hit],
    ) -> Result<(), E> {
        dispatch(self.task(Single(origin), directions, reaches, hits))
    }

    pub(in crate::raycasting) fn task<'a, O, D, R>(
        &'a self,
        origin: O,
        directions: &'a [D],
        reaches: &'a [Reach],
        results: &'a mut [R],
    ) -> CastTask<'a, E, O, D, R> {
        assert_eq!(directions.len(), results.len(), "one result per direction");
        assert_eq!(directions.len(), reaches.len(), "one reach per direction");
        CastTask {
            scene: self,
            origin,
            directions,
            reaches,
            results,
        }
    }

    #[inline(always)]
    fn traverse<S: Simd, R: Traverse<S>>(
        &self,
        simd: S,
        rays: &mut R,
        [top_stack, tile_stack]: &mut [Stack; 2],
    ) -> Result<(), E> {
        let top = &*self.top;
        let relative = rays.relative_to(simd, top.middle, &top.bvh.grid);
        let mut tiles = Traversal::new(simd, &top.bvh.nodes, &relative, top_stack);
        while let Some(leaf) = tiles.next_leaf(rays) {
            let number = top.numbers[leaf];
            let Some(tile) = self.tiles.tile(number as usize).map_err(E::clone)? else {
                continue;
            };
            let parts = tile.parts();
            let relative = rays.relative_to(simd, tile.middle(), tile.grid());
            let mut leaves = Traversal::new(simd, parts.nodes, &relative, tile_stack);
            while let Some(index) = leaves.next_leaf(rays) {
                let leaf = Leaf {
                    tile: number,
                    index: index as u32,
                };
                rays.intersect(simd, &relative, &parts.leaves.block(index), leaf);
            }
        }
        Ok(())
    }

    /// Nearest hits of rays that are neighbours: together if their directions have the same signs.
    #[inline(always)]
    fn cast_packet<S: Simd, O: Origin<S>>(
        &self,
        simd: S,
        origin: &O,
        directions: &[Vec3; RAYS],
        reaches: &[Reach; RAYS],
        stacks: &mut [Stack; 2],
    ) -> Result<([f32; RAYS], [Place; RAYS]), E> {
        if let Some(mut packet) = Packet::new(simd, origin, directions, reaches) {
            self.traverse(simd, &mut packet, stacks)?;
            return Ok((packet.range_m, packet.place));
        }
        let (mut range_m, mut place) = ([f32::INFINITY; RAYS], [Place::NONE; RAYS]);
        for ray in 0..RAYS {
            let mut single = SingleRay::new(origin.of_ray(ray), directions[ray], reaches[ray]);
            self.traverse(simd, &mut single, stacks)?;
            (range_m[ray], place[ray]) = (single.range_m, single.place);
        }
        Ok((range_m, place))
    }

    #[inline(always)]
    fn hit(&self, range_m: f32, place: Place) -> Result<Hit, E> {
        let number = place.leaf.tile as usize;
        let Some(tile) = self.tiles.tile(number).map_err(E::clone)? else {
            return Ok(Hit::MISS);
        };
        let leaves = tile.parts().leaves;
        let index = leaves.index(place.leaf.index as usize, place.lane as usize);
        Ok(Hit {
            range_m,
            triangle: self.top.first_triangles[number] + index,
            place,
        })
    }
}

/// Memory of the traversals of the hierarchy over the tiles and of that of a tile.
fn stacks() -> [Stack; 2] {
    [Stack::new(), Stack::new()]
}

/// A ray whose hits are all visited.
struct AllHitsTask<'a, E, F> {
    scene: &'a Scene<E>,
    hits: AllHits<F>,
}

impl<E: Clone, F: FnMut(f32, Place)> SimdTask for AllHitsTask<'_, E, F> {
    type Output = Result<(), E>;

    #[inline(always)]
    fn run<S: Simd>(mut self, simd: S) -> Result<(), E> {
        self.scene.traverse(simd, &mut self.hits, &mut stacks())
    }
}

/// Rays to cast, and where their results go.
pub(in crate::raycasting) struct CastTask<'a, E, O, D, R> {
    scene: &'a Scene<E>,
    origin: O,
    directions: &'a [D],
    reaches: &'a [Reach],
    results: &'a mut [R],
}

/// Origin of rays that are not cast together.
pub(in crate::raycasting) struct Single(pub DVec3);

/// Packets of neighbouring directions.
impl<E: Clone> SimdTask for CastTask<'_, E, DVec3, Vec3, Hit> {
    type Output = Result<(), E>;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Result<(), E> {
        let mut stacks = stacks();
        let chunks = self.directions.chunks(RAYS).zip(self.reaches.chunks(RAYS));
        for ((directions, reaches), hits) in chunks.zip(self.results.chunks_mut(RAYS)) {
            // The last ray fills the empty places.
            let last = directions.len() - 1;
            let (range_m, place) = self.scene.cast_packet(
                simd,
                &self.origin,
                &std::array::from_fn(|ray| directions[ray.min(last)]),
                &std::array::from_fn(|ray| reaches[ray.min(last)]),
                &mut stacks,
            )?;
            for (ray, hit) in hits.iter_mut().enumerate() {
                *hit = self.scene.hit(range_m[ray], place[ray])?;
            }
        }
        Ok(())
    }
}

/// Bundles.
impl<E: Clone> SimdTask for CastTask<'_, E, [DVec3; RAYS], [Vec3; RAYS], [f32; RAYS]> {
    type Output = Result<(), E>;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Result<(), E> {
        let mut stacks = stacks();
        let bundles = self.directions.iter().zip(self.reaches);
        for ((directions, &reach), ranges_m) in bundles.zip(self.results) {
            let reaches = [reach; RAYS];
            (*ranges_m, _) =
                (self.scene).cast_packet(simd, &self.origin, directions, &reaches, &mut stacks)?;
        }
        Ok(())
    }
}

/// Single rays.
impl<E: Clone> SimdTask for CastTask<'_, E, Single, Vec3, Hit> {
    type Output = Result<(), E>;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Result<(), E> {
        let mut stacks = stacks();
        let rays = self.directions.iter().zip(self.reaches);
        for ((&direction, &reach), hit) in rays.zip(self.results) {
            let mut ray = SingleRay::new(self.origin.0, direction, reach);
            if reach.is_window {
                ray = ray.between(reach.enough_m, reach.until_m);
            }
            let mut is_last = !reach.is_window;
            loop {
                (self.scene).traverse(simd, &mut ray, &mut stacks)?;
                if is_last || ray.range_m == f32::INFINITY {
                    break;
                }
                // The surface in the window may be hidden by a nearer one.
                ray = ray.between(0.0, reach.enough_m);
                is_last = true;
            }
            *hit = self.scene.hit(ray.range_m, ray.place)?;
        }
        Ok(())
    }
}
