//! Rendering on a graphics card through wgpu (Vulkan, OpenGL).
//!
//! Two methods for range images, which find the same ranges:
//!
//! - *cast*: a compute shader sends the rays through a bounding volume hierarchy. A ray costs
//!   some dozens of boxes and a few triangles, however large the map is.
//! - *raster*: the tiles that a pose can see are drawn, an instance per pose, on an atlas of
//!   images; every triangle is a rectangle of pixels whose centre rays are then cast one by one.
//!   Every triangle costs twelve vertices in every image.
//!
//! A range image has some 10⁴ to 10⁵ rays, the tiles around a car 10⁶ triangles. Which method is faster depends on the
//! adapter: [`RenderingMethod::Auto`] measures both with the first scan (images of 57,600 rays on a software adapter: as
//! fast with 20,000 triangles, casting 40 times faster with 1.6 million). Arbitrary beams can
//! only be cast. Comparisons are
//! added up on the device; one number per pose is read back.
//!
//! Ranges are those of the plane of the triangle that the ray hits, by one text (`ray.wgsl`) for
//! both methods.

mod batch_sizes;
mod batches;
mod caster;
mod device;
mod device_map;
mod layout;
mod raster;
mod resident;
mod shaders;
mod sums;
mod two_level;

use std::sync::{Arc, OnceLock};
use std::time::Instant;

use super::backend::{Backend, RenderingMethod};
use super::cpu::POSES_AT_ONCE;
use super::{CpuRenderer, RangeDifference, RangeRenderer, RenderError};
use crate::geometry::{Pose3, Vec3};
use crate::lidar::{Beam, LidarModel, RangeImage};
use crate::memory::MemoryBudget;
use crate::raycasting::SceneSource;

use device::Gpu;
use layout::{FAR, Pose};
use raster::Rasterizer;
use resident::{Loaded, ResidentMap};

pub use device::adapters;

/// Method to render range images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageMethod {
    /// Rays through a hierarchy, by a compute shader.
    Cast,
    /// Triangles on an atlas, by the rasterizer.
    Raster,
}

/// Renders on a graphics device that holds the whole map, or the tiles of it around the poses that are rendered.
pub struct GpuRenderer {
    gpu: Gpu,
    map: ResidentMap,
    rasterizer: Option<Rasterizer>,
    /// Method of the images that are compared; empty until it has been measured.
    method: OnceLock<ImageMethod>,
    /// As in [`SceneSource`].
    has_fronts: bool,
}

impl GpuRenderer {
    /// Opens the best adapter that the backend allows, uploads the tiles of a source when rays may reach them, and drops
    /// those far away. The CPU renders what reaches more tiles than the device holds. Compares images by the requested
    /// method, and renders within a budget of memory.
    ///
    /// # Errors
    /// [`RenderError::NoAdapter`] where there is none, [`RenderError::DeviceRefused`] if it is requested to rasterize and
    /// cannot, and the errors of the device.
    pub fn new(
        source: Arc<dyn SceneSource>,
        (backend, method): (Backend, RenderingMethod),
        memory_budget: MemoryBudget,
    ) -> Result<Self, RenderError> {
        let mut gpu = Gpu::open(backend)?;
        gpu.memory_budget = memory_budget;
        gpu.batch_sizes.poses = gpu.batch_sizes.poses.min(POSES_AT_ONCE);
        let has_fronts = source.has_fronts();
        let map = ResidentMap::new(&gpu, source)?;
        let rasterizer = gpu.can_rasterize.then(|| Rasterizer::new(&gpu));
        gpu.check()?;
        let method = match (method, &rasterizer) {
            (RenderingMethod::Auto, Some(_)) => OnceLock::new(),
            (RenderingMethod::Raster, Some(_)) => ImageMethod::Raster.into(),
            (RenderingMethod::Raster, None) => return Err(cannot_rasterize()),
            (RenderingMethod::Auto | RenderingMethod::Cast, _) => ImageMethod::Cast.into(),
        };
        Ok(Self {
            gpu,
            map,
            rasterizer,
            method,
            has_fronts,
        })
    }

    /// Results of poses, one per pose: those of `work` with the tiles within reach of rays from them, or, where these are
    /// more than the device holds, those of the CPU.
    fn render_within<T>(
        &self,
        map_from_lidar: &[Pose3],
        reach_m: f32,
        work: impl Fn(&Loaded, &[Pose]) -> Result<Vec<T>, RenderError>,
        on_cpu: impl FnOnce(&CpuRenderer) -> Result<Vec<T>, RenderError>,
    ) -> Result<Vec<T>, RenderError> {
        let groups = match self.map.groups(map_from_lidar, reach_m) {
            Ok(groups) => groups,
            Err(cpu) => return on_cpu(cpu),
        };
        let mut results: Vec<Option<T>> = map_from_lidar.iter().map(|_| None).collect();
        for group in groups {
            let poses: Vec<Pose3> = group.iter().map(|&pose| map_from_lidar[pose]).collect();
            let loaded = self.map.around(&self.gpu, &poses, reach_m)?;
            let of_group = work(&loaded, &loaded.map.poses(&poses))?;
            for (pose, result) in std::iter::zip(group, of_group) {
                results[pose] = Some(result);
            }
        }
        Ok(results.into_iter().flatten().collect())
    }

    /// Ranges along directions, one row per pose, negative where a surface with a front is seen from behind [m]; or what the
    /// CPU finds.
    fn signed_ranges(
        &self,
        map_from_lidar: &[Pose3],
        directions: &[Vec3],
        until_m: f32,
        on_cpu: impl FnOnce(&CpuRenderer) -> Result<Vec<Vec<f32>>, RenderError>,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let cast = |loaded: &Loaded, poses: &[Pose]| {
            let rays = (directions, until_m);
            loaded.caster.cast(&self.gpu, &loaded.map, poses, rays)
        };
        let mut rows = self.render_within(map_from_lidar, until_m, cast, on_cpu)?;
        for range_m in rows.iter_mut().flatten() {
            if *range_m >= until_m.min(FAR) {
                *range_m = f32::INFINITY;
            } else if !self.has_fronts {
                *range_m = range_m.abs();
            }
        }
        Ok(rows)
    }

    /// [`RangeRenderer::render`] by a given method.
    ///
    /// # Errors
    /// The errors of the device; [`RenderError::DeviceRefused`] if images to be rasterized fit no texture,
    /// or if the device cannot rasterize.
    pub fn render_by(
        &self,
        method: ImageMethod,
        map_from_lidar: &[Pose3],
        model: &LidarModel,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let rays = model.directions();
        let draw = |loaded: &Loaded, poses: &[Pose]| match (method, &self.rasterizer) {
            (ImageMethod::Cast, _) => {
                let rays = (&*rays, model.max_range);
                loaded.caster.cast(&self.gpu, &loaded.map, poses, rays)
            }
            (ImageMethod::Raster, Some(rasterizer)) => {
                rasterizer.draw(&self.gpu, &loaded.map, poses, model)
            }
            (ImageMethod::Raster, None) => Err(cannot_rasterize()),
        };
        let on_cpu = |cpu: &CpuRenderer| cpu.render(map_from_lidar, model);
        let mut images = self.render_within(map_from_lidar, model.max_range, draw, on_cpu)?;
        for range_m in images.iter_mut().flatten() {
            *range_m = range_m.abs();
            if *range_m >= FAR || !model.accepts_range(*range_m) {
                *range_m = f32::INFINITY;
            }
        }
        Ok(images)
    }

    /// [`RangeRenderer::compare_images`] by a given method.
    ///
    /// # Errors
    /// As [`render_by`](Self::render_by).
    pub fn compare_images_by(
        &self,
        method: ImageMethod,
        map_from_lidar: &[Pose3],
        measured: &RangeImage,
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        let model = &measured.model;
        let compare = |loaded: &Loaded, poses: &[Pose]| match (method, &self.rasterizer) {
            (ImageMethod::Cast, _) => {
                let beams: Vec<Beam> = measured.center_beams().collect();
                let beams = (&*beams, difference, [model.min_range, model.max_range]);
                (loaded.caster).compare(&self.gpu, &loaded.map, poses, beams)
            }
            (ImageMethod::Raster, Some(rasterizer)) => {
                rasterizer.compare(&self.gpu, &loaded.map, poses, (measured, difference))
            }
            (ImageMethod::Raster, None) => Err(cannot_rasterize()),
        };
        let on_cpu = |cpu: &CpuRenderer| cpu.compare_images(map_from_lidar, measured, difference);
        self.render_within(map_from_lidar, model.max_range, compare, on_cpu)
    }

    /// Measures and reports which method compares images faster.
    fn faster_method(
        &self,
        map_from_lidar: &[Pose3],
        measured: &RangeImage,
        difference: &RangeDifference,
    ) -> Result<ImageMethod, RenderError> {
        /// Number of images that are timed.
        const IMAGES: usize = 8;
        let LidarModel { width, height, .. } = measured.model;
        if !Rasterizer::fits(&self.gpu, &measured.model) {
            tracing::info!(
                "range images of {height} x {width} pixels are cast: they fit no texture"
            );
            return Ok(ImageMethod::Cast);
        }
        let poses = &map_from_lidar[..map_from_lidar.len().min(IMAGES)];
        let time_ms = |method| {
            // Drivers finish shaders with their first use.
            self.compare_images_by(method, &poses[..1], measured, difference)?;
            let start = Instant::now();
            self.compare_images_by(method, poses, measured, difference)?;
            Ok::<_, RenderError>(1e3 * start.elapsed().as_secs_f64() / poses.len() as f64)
        };
        let (cast_ms, raster_ms) = (time_ms(ImageMethod::Cast)?, time_ms(ImageMethod::Raster)?);
        let (method, name) = if raster_ms < cast_ms {
            (ImageMethod::Raster, "raster")
        } else {
            (ImageMethod::Cast, "cast")
        };
        tracing::info!(
            "whole images are rendered by {name}: a range image of {height} x {width} pixels takes {cast_ms:.2} ms by casting rays and {raster_ms:.2} ms by rasterizing on {}",
            self.gpu.report
        );
        Ok(method)
    }
}

/// Range from which on surfaces do not change the cost of a beam [m]; see `cost_of` in `caster.wgsl`.
fn reach_m(beam: &Beam, difference: &RangeDifference) -> f32 {
    if beam.range_m.min(difference.no_surface_m) == difference.short_m {
        beam.range_m + difference.short_m
    } else {
        f32::INFINITY
    }
}

fn cannot_rasterize() -> RenderError {
    RenderError::DeviceRefused {
        reason: "its drawing stages read no storage buffers; set method to cast".to_owned(),
    }
}

impl RangeRenderer for GpuRenderer {
    fn name(&self) -> String {
        format!("gpu: {}", self.gpu.report)
    }

    fn render(
        &self,
        map_from_lidar: &[Pose3],
        model: &LidarModel,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        self.render_by(ImageMethod::Cast, map_from_lidar, model)
    }

    fn cast(
        &self,
        map_from_lidar: &[Pose3],
        directions: &[Vec3],
        until_m: f32,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let on_cpu = |cpu: &CpuRenderer| cpu.cast(map_from_lidar, directions, until_m);
        let mut rows = self.signed_ranges(map_from_lidar, directions, until_m, on_cpu)?;
        for range_m in rows.iter_mut().flatten() {
            *range_m = range_m.abs();
        }
        Ok(rows)
    }

    fn cast_signed(
        &self,
        map_from_lidar: &Pose3,
        directions: &[Vec3],
        until_m: f32,
    ) -> Result<Vec<f32>, RenderError> {
        let poses = [*map_from_lidar];
        let on_cpu = |cpu: &CpuRenderer| Ok(vec![cpu.cast_signed(&poses[0], directions, until_m)?]);
        let mut rows = self.signed_ranges(&poses, directions, until_m, on_cpu)?;
        Ok(rows.pop().unwrap_or_default())
    }

    fn compare(
        &self,
        map_from_lidar: &[Pose3],
        beams: &[Beam],
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        let compare = |loaded: &Loaded, poses: &[Pose]| {
            let beams = (beams, difference, [0.0, FAR]);
            (loaded.caster).compare(&self.gpu, &loaded.map, poses, beams)
        };
        let on_cpu = |cpu: &CpuRenderer| cpu.compare(map_from_lidar, beams, difference);
        let reach_m = beams.iter().map(|beam| reach_m(beam, difference));
        let reach_m = reach_m.fold(0.0, f32::max);
        self.render_within(map_from_lidar, reach_m, compare, on_cpu)
    }

    fn compare_images(
        &self,
        map_from_lidar: &[Pose3],
        measured: &RangeImage,
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        if map_from_lidar.is_empty() {
            return Ok(Vec::new());
        }
        let method = match self.method.get() {
            Some(method) => *method,
            None => {
                let faster = self.faster_method(map_from_lidar, measured, difference)?;
                *self.method.get_or_init(|| faster)
            }
        };
        self.compare_images_by(method, map_from_lidar, measured, difference)
    }
}

#[cfg(test)]
mod tests;
