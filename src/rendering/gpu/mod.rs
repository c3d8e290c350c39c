//! Rendering on a graphics card through wgpu (Vulkan, OpenGL).
//!
//! Two methods for range images, which find the same ranges:
//!
//! - *cast*: a compute shader sends the rays through a bounding volume hierarchy. A ray costs
//!   some dozens of boxes and a few triangles, however large the map is.
//! - *draw*: the tiles that a pose can see are drawn, an instance per pose, on an atlas of
//!   images; every triangle is a rectangle of pixels whose centre rays are then cast one by one.
//!   Every triangle costs twelve vertices in every image.
//!
//! A range image has some 10⁴ to 10⁵ rays, the tiles around a car 10⁶ triangles: casting is the
//! default, drawing the comparison (images of 57,600 rays on a software adapter: as
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
mod shaders;
mod two_level;

use super::backend::Backend;
use super::{RangeDifference, RangeRenderer, RenderError};
use crate::geometry::{Pose3, TriangleMesh, Vec3};
use crate::lidar::{Beam, LidarModel};

use caster::Caster;
use device::Gpu;
use device_map::DeviceMap;
use layout::FAR;
use raster::Rasterizer;

pub use device::adapters;

/// Method to render range images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageMethod {
    /// Rays through a hierarchy, by a compute shader.
    Cast,
    /// Triangles on an atlas, by the rasterizer.
    Draw,
}

/// Renders on a graphics device that holds the whole map.
pub struct GpuRenderer {
    gpu: Gpu,
    map: DeviceMap,
    caster: Caster,
    rasterizer: Option<Rasterizer>,
}

impl GpuRenderer {
    /// Opens the best adapter that the backend allows and uploads the map; renders at most
    /// `max_poses` poses at once.
    ///
    /// # Errors
    /// [`RenderError::NoAdapter`] where there is none, [`RenderError::MapTooLarge`] where the
    /// map does not fit what the device binds, and the errors of the device.
    pub fn new(
        tiles: &[TriangleMesh],
        backend: Backend,
        max_poses: Option<usize>,
    ) -> Result<Self, RenderError> {
        let mut gpu = Gpu::open(backend)?;
        if let Some(max_poses) = max_poses {
            gpu.batch_sizes.poses = gpu.batch_sizes.poses.min(max_poses).max(1);
        }
        let map = DeviceMap::upload(&gpu, tiles)?;
        let caster = Caster::new(&gpu, &map);
        let rasterizer = gpu.can_rasterize.then(|| Rasterizer::new(&gpu));
        gpu.check()?;
        Ok(Self {
            gpu,
            map,
            caster,
            rasterizer,
        })
    }

    /// [`RangeRenderer::render`] by a given method.
    ///
    /// # Errors
    /// The errors of the device; [`RenderError::DeviceRefused`] if images to be drawn fit no texture,
    /// or if the device cannot draw.
    pub fn render_by(
        &self,
        method: ImageMethod,
        map_from_lidar: &[Pose3],
        model: &LidarModel,
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let (gpu, map) = (&self.gpu, &self.map);
        let poses = map.poses(map_from_lidar);
        let mut images = match (method, &self.rasterizer) {
            (ImageMethod::Cast, _) => {
                let rays = model.directions();
                self.caster
                    .cast(gpu, map, &poses, (&rays, model.max_range))?
            }
            (ImageMethod::Draw, Some(rasterizer)) => rasterizer.draw(gpu, map, &poses, model)?,
            (ImageMethod::Draw, None) => {
                return Err(RenderError::DeviceRefused {
                    reason: "its drawing stages read no storage buffers".to_owned(),
                });
            }
        };
        for range_m in images.iter_mut().flatten() {
            if *range_m >= FAR || !model.accepts_range(*range_m) {
                *range_m = f32::INFINITY;
            }
        }
        Ok(images)
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
    ) -> Result<Vec<Vec<f32>>, RenderError> {
        let poses = self.map.poses(map_from_lidar);
        let rays = (directions, f32::INFINITY);
        let mut rows = self.caster.cast(&self.gpu, &self.map, &poses, rays)?;
        for range_m in rows.iter_mut().flatten() {
            if *range_m >= FAR {
                *range_m = f32::INFINITY;
            }
        }
        Ok(rows)
    }

    fn compare(
        &self,
        map_from_lidar: &[Pose3],
        beams: &[Beam],
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError> {
        let poses = self.map.poses(map_from_lidar);
        self.caster
            .compare(&self.gpu, &self.map, &poses, (beams, difference))
    }
}

#[cfg(test)]
mod tests;
