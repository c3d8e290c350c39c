//! The tiles of a map on the device: those around the poses that are rendered.
//!
//! What a ray hits never depends on which tiles are there: those within reach of the rays are uploaded before these are
//! cast. Tiles a little farther away come with them, so that a car that drives on finds them there; those farthest away are
//! dropped where all take more than the budget.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use glam::{DVec3, Vec3};

use super::caster::Caster;
use super::device::Gpu;
use super::device_map::DeviceMap;
use super::two_level::{BottomLevel, TwoLevelBvh, center_of};
use crate::geometry::{Aabb, Pose3};
use crate::raycasting::SceneSource;
use crate::rendering::order::poses_by_square;
use crate::rendering::{CpuRenderer, RenderError};

/// Memory of the tiles on the device, at most; while they change, twice as much [bytes].
const BUDGET_BYTES: u64 = 256 << 20;
/// Memory of a triangle and its share of the hierarchy, before that is built [bytes].
pub(super) const TRIANGLE_BYTES: u64 = 96;
/// Tiles this much farther than the rays reach are uploaded with the others [m].
const AHEAD_M: f32 = 100.0;

/// A map on the device and the pipelines that it is bound to.
pub(super) struct Loaded {
    pub map: DeviceMap,
    pub caster: Caster,
}

impl Loaded {
    fn new(gpu: &Gpu, map: DeviceMap, previous: Option<&Self>) -> Self {
        Self {
            caster: Caster::new(gpu, &map, previous.map(|previous| &previous.caster)),
            map,
        }
    }
}

/// A map, all of it or in part on the device.
pub(super) struct ResidentMap {
    resident: Mutex<Arc<Resident>>,
    tiles: Tiles,
}

struct Resident {
    loaded: Arc<Loaded>,
    /// By the numbers of their tiles.
    levels: BTreeMap<usize, Arc<BottomLevel>>,
}

struct Tiles {
    source: Arc<dyn SceneSource>,
    /// Boxes and estimated memory [m, bytes].
    tiles: Vec<(Aabb, u64)>,
    center: DVec3,
    budget_bytes: u64,
    /// Renders what reaches more than the budget.
    cpu: CpuRenderer,
}

impl ResidentMap {
    /// Uploads tiles when rays may reach them; what reaches too many is left to the CPU.
    pub fn new(gpu: &Gpu, source: Arc<dyn SceneSource>) -> Result<Self, RenderError> {
        let counted = |(bounds, triangles)| (bounds, triangles * TRIANGLE_BYTES);
        let tiles: Vec<(Aabb, u64)> = source.tiles().into_iter().map(counted).collect();
        let all_bytes = tiles.iter().map(|(_, bytes)| bytes).sum::<u64>();
        let budget_bytes = BUDGET_BYTES.min(gpu.max_binding_bytes());
        gpu.memory_budget
            .require(
                "the graphics device",
                3.0 * all_bytes.min(budget_bytes) as f64 + gpu.batch_sizes.bytes(),
                "choose a smaller map, render on the CPU",
            )
            .map_err(RenderError::DeviceMemory)?;
        let center = center_of(tiles.iter().map(|(bounds, _)| *bounds));
        let nothing = DeviceMap::upload(gpu, TwoLevelBvh::over(center, &[]))?;
        let resident = Resident {
            loaded: Loaded::new(gpu, nothing, None).into(),
            levels: BTreeMap::new(),
        };
        Ok(Self {
            resident: Mutex::new(resident.into()),
            tiles: Tiles {
                cpu: CpuRenderer::over(source.clone()),
                source,
                tiles,
                center,
                budget_bytes,
            },
        })
    }

    /// Poses that can be rendered at once, by their indices; the renderer to be left all if what is within reach of some of
    /// them takes more than the budget.
    pub fn groups(&self, poses: &[Pose3], reach_m: f32) -> Result<Vec<Vec<usize>>, &CpuRenderer> {
        let tiles = &self.tiles;
        let fits = |group: &[usize]| {
            let around = bounds_of(group.iter().map(|&pose| &poses[pose]));
            tiles.bytes(tiles.within(reach_m, &around)) <= tiles.budget_bytes
        };
        let all: Vec<usize> = (0..poses.len()).collect();
        if fits(&all) {
            return Ok(vec![all]);
        }
        let squares = poses_by_square(poses);
        if squares.iter().all(|square| fits(square)) {
            Ok(squares)
        } else {
            Err(&tiles.cpu)
        }
    }

    /// The map with at least the tiles within reach of rays from some poses; these have to be one of the
    /// [groups](Self::groups).
    pub fn around(
        &self,
        gpu: &Gpu,
        poses: &[Pose3],
        reach_m: f32,
    ) -> Result<Arc<Loaded>, RenderError> {
        let resident = self.resident().clone();
        let tiles = &self.tiles;
        let around = bounds_of(poses.iter());
        let is_there = |tile: usize| resident.levels.contains_key(&tile);
        if tiles.within(reach_m, &around).all(is_there) {
            return Ok(resident.loaded.clone());
        }
        // Not under the lock: a thread that waits for the hierarchies may take up work that asks for tiles.
        let mut levels = BTreeMap::new();
        for tile in tiles.kept(reach_m, &around, is_there) {
            let level = match resident.levels.get(&tile) {
                Some(level) => level.clone(),
                None => tiles.level(tile)?,
            };
            levels.insert(tile, level);
        }
        let in_order: Vec<_> = levels.values().cloned().collect();
        let hierarchy = TwoLevelBvh::over(tiles.center, &in_order);
        let map = DeviceMap::upload(gpu, hierarchy)?;
        let loaded = Arc::new(Loaded::new(gpu, map, Some(&resident.loaded)));
        gpu.check()?;
        *self.resident() = Arc::new(Resident {
            loaded: loaded.clone(),
            levels,
        });
        Ok(loaded)
    }

    #[cfg(test)]
    pub fn set_budget(&mut self, budget_bytes: u64) {
        self.tiles.budget_bytes = budget_bytes;
    }

    /// Numbers of the tiles on the device.
    #[cfg(test)]
    pub fn tiles_there(&self) -> Vec<usize> {
        self.resident().levels.keys().copied().collect()
    }

    fn resident(&self) -> MutexGuard<'_, Arc<Resident>> {
        self.resident.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Tiles {
    /// Tiles within a distance of a box.
    fn within(&self, distance_m: f32, around: &Aabb) -> impl Iterator<Item = usize> {
        /// More than the rounding of positions [m].
        const ROUNDING_M: f32 = 0.01;
        let numbers = 0..self.tiles.len();
        numbers.filter(move |&tile| self.distance_m(tile, around) <= distance_m + ROUNDING_M)
    }

    fn distance_m(&self, tile: usize, around: &Aabb) -> f32 {
        let (bounds, _) = self.tiles[tile];
        if bounds.is_empty() || around.is_empty() {
            f32::INFINITY
        } else {
            let apart = (bounds.min - around.max).max(around.min - bounds.max);
            apart.max(Vec3::ZERO).length()
        }
    }

    fn bytes(&self, tiles: impl Iterator<Item = usize>) -> u64 {
        tiles.map(|tile| self.tiles[tile].1).sum()
    }

    /// Tiles to be on the device: those within reach; then those ahead and those that are there, the nearest first, as
    /// long as they fit.
    fn kept(&self, reach_m: f32, around: &Aabb, is_there: impl Fn(usize) -> bool) -> Vec<usize> {
        let mut kept: Vec<usize> = self.within(reach_m, around).collect();
        let mut bytes = self.bytes(kept.iter().copied());
        let mut others: Vec<(f32, usize)> = (0..self.tiles.len())
            .map(|tile| (self.distance_m(tile, around), tile))
            .filter(|(_, tile)| !kept.contains(tile))
            .filter(|&(distance_m, tile)| distance_m <= reach_m + AHEAD_M || is_there(tile))
            .collect();
        others.sort_by(|(one_m, _), (other_m, _)| one_m.total_cmp(other_m));
        for (_, tile) in others {
            bytes += self.tiles[tile].1;
            if bytes > self.budget_bytes {
                break;
            }
            kept.push(tile);
        }
        kept
    }

    fn level(&self, tile: usize) -> Result<Arc<BottomLevel>, RenderError> {
        let triangles = self.source.triangles(tile)?;
        Ok(BottomLevel::build(triangles.into_iter(), self.center).into())
    }
}

/// Box around the origins of poses.
fn bounds_of<'a>(poses: impl Iterator<Item = &'a Pose3>) -> Aabb {
    let origins = poses.map(|pose| pose.translation.vector.cast::<f32>());
    let origins = origins.map(|origin| Vec3::new(origin.x, origin.y, origin.z));
    Aabb::from_points(origins.filter(|origin| origin.is_finite()))
}
