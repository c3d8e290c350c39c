//! Expected ranges: the map as the sensor would see it from any pose.
//!
//! The product's own likelihood compares beams along the very directions that were measured; that of range-mcl compares
//! whole range images, rendered at pixel centres.

pub(crate) mod backend;
pub(crate) mod cpu;
#[cfg(feature = "gpu")]
pub(crate) mod gpu;
mod order;
pub(crate) mod selection;

pub use backend::{Backend, RenderingMethod};
pub(crate) use order::coherent_order;

pub(crate) use cpu::CpuRenderer;

use crate::geometry::{Pose3, Rigid3f, Vec3};
use crate::lidar::{Beam, LidarModel, RangeImage};
use crate::memory::MemoryError;
use crate::raycasting::TileError;

/// Renders the map from many poses at once. Ranges are infinite where there is no surface.
pub trait RangeRenderer: Send + Sync {
    /// Backend and device, for reports.
    fn name(&self) -> String;

    /// Ranges along the centre rays of all pixels, row-major, one image per pose [m].
    /// Ranges outside the limits of the model are infinite.
    ///
    /// # Errors
    /// A tile of the map cannot be read, memory does not suffice, or the graphics card fails.
    fn render(
        &self,
        map_from_lidar: &[Pose3],
        model: &LidarModel,
    ) -> Result<Vec<Vec<f32>>, RenderError>;

    /// Ranges along unit directions of the lidar frame, one row per pose [m]. Surfaces at `until_m` or farther do not
    /// count.
    ///
    /// # Errors
    /// As [`render`](Self::render).
    fn cast(
        &self,
        map_from_lidar: &[Pose3],
        directions: &[Vec3],
        until_m: f32,
    ) -> Result<Vec<Vec<f32>>, RenderError>;

    /// [Ranges](Self::cast) from one pose, negative where the nearest surface is seen from behind [m]. In a map whose surfaces have
    /// no fronts, and by default, none is.
    ///
    /// # Errors
    /// As [`render`](Self::render).
    fn cast_signed(
        &self,
        map_from_lidar: &Pose3,
        directions: &[Vec3],
        until_m: f32,
    ) -> Result<Vec<f32>, RenderError> {
        let mut rows = self.cast(&[*map_from_lidar], directions, until_m)?;
        Ok(rows.pop().unwrap_or_default())
    }

    /// The surfaces that measured beams end on: the nearest surface along each, with its normal, if it is not farther than
    /// `within_m` from the end of the beam.
    ///
    /// By default those of the plane through the ends of three rays that are close together; rays
    /// whose neighbours hit nothing hit nothing here.
    ///
    /// # Errors
    /// As [`render`](Self::render).
    fn surfaces(
        &self,
        map_from_lidar: &Pose3,
        beams: &[Beam],
        within_m: f32,
    ) -> Result<Vec<Option<SurfaceHit>>, RenderError> {
        /// Angle between the three rays [rad]: two millimetres at two metres.
        const APART_RAD: f32 = 1e-3;
        let farthest_m = beams.iter().map(|beam| beam.range_m).fold(0.0, f32::max);
        let mut bundles = Vec::with_capacity(3 * beams.len());
        for Beam { direction, .. } in beams {
            let (aside, above) = direction.any_orthonormal_pair();
            bundles.push(*direction);
            bundles.push((direction + APART_RAD * aside).normalize());
            bundles.push((direction + APART_RAD * above).normalize());
        }
        let ranges = self.cast(&[*map_from_lidar], &bundles, farthest_m + within_m)?;
        let map_from_lidar = Rigid3f::from(map_from_lidar);
        let surface = |((beam, rays), ranges_m): ((&Beam, &[Vec3]), &[f32])| {
            if !is_near_end(beam, ranges_m[0], within_m) {
                return None;
            }
            let end = |ray: usize| rays[ray] * ranges_m[ray];
            let across = (end(1) - end(0)).cross(end(2) - end(0));
            let normal = across.try_normalize()?;
            Some(SurfaceHit {
                range_m: ranges_m[0],
                normal_in_map: map_from_lidar.rotate(facing(normal, rays[0])),
            })
        };
        let ranges = ranges.first().map_or(&[][..], Vec::as_slice);
        let rays = beams.iter().zip(bundles.chunks(3));
        Ok(rays.zip(ranges.chunks(3)).map(surface).collect())
    }

    /// Mean [`RangeDifference::cost`] of the beams, one number per pose [m]; nothing is kept
    /// per beam.
    ///
    /// # Errors
    /// As [`render`](Self::render).
    fn compare(
        &self,
        map_from_lidar: &[Pose3],
        beams: &[Beam],
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError>;

    /// Mean [`RangeDifference::cost`] of the pixels with a return between a measured range image and those that
    /// [`render`](Self::render) renders, one number per pose [m]; 0 without returns.
    ///
    /// # Errors
    /// As [`render`](Self::render).
    fn compare_images(
        &self,
        map_from_lidar: &[Pose3],
        measured: &RangeImage,
        difference: &RangeDifference,
    ) -> Result<Vec<f32>, RenderError>;
}

/// Whether a surface at a range is not farther than `within_m` from the end of a beam.
fn is_near_end(beam: &Beam, range_m: f32, within_m: f32) -> bool {
    (beam.range_m - range_m).abs() <= within_m
}

/// Surface of the map that a ray hits.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceHit {
    /// Distance along the unit direction [m].
    pub range_m: f32,
    /// Unit normal of the surface, map frame, on the side that the ray comes from.
    pub normal_in_map: Vec3,
}

/// Cost of the difference between measured and rendered range: its magnitude, up to a limit.
///
/// ```text
/// cost = min(rendered − measured, short_m)       an object in front of the map
///        min(measured − rendered, long_m)        the beam passed through the map
///        min(measured, no_surface_m)             no surface in the map
/// ```
///
/// With infinite limits this is |measured − rendered| with 0 for "nothing there", as in
/// range-mcl (Chen et al., ICRA 2021).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RangeDifference {
    /// Limit for returns nearer than the map [m].
    pub short_m: f32,
    /// Limit for returns behind a surface of the map [m].
    pub long_m: f32,
    /// Limit where the map has no surface [m].
    pub no_surface_m: f32,
}

impl RangeDifference {
    /// No limits: the comparison of range-mcl.
    pub const UNLIMITED: Self = Self {
        short_m: f32::INFINITY,
        long_m: f32::INFINITY,
        no_surface_m: f32::INFINITY,
    };

    /// Magnitude truncated at `limit_m` in all cases.
    pub const fn truncated(limit_m: f32) -> Self {
        Self {
            short_m: limit_m,
            long_m: limit_m,
            no_surface_m: limit_m,
        }
    }

    /// The cost of one beam [m]; `rendered_m` is infinite where there is no surface.
    #[inline]
    pub fn cost(&self, measured_m: f32, rendered_m: f32) -> f32 {
        if rendered_m == f32::INFINITY {
            measured_m.min(self.no_surface_m)
        } else if rendered_m >= measured_m {
            (rendered_m - measured_m).min(self.short_m)
        } else {
            (measured_m - rendered_m).min(self.long_m)
        }
    }
}

/// Returns the normal on the side that a ray comes from.
fn facing(normal: Vec3, direction: Vec3) -> Vec3 {
    if normal.dot(direction) > 0.0 {
        -normal
    } else {
        normal
    }
}

/// Error while rendering.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum RenderError {
    #[error("backend is gpu, but there is no graphics adapter")]
    NoAdapter,
    #[error("backend is gpu, but fpmcl was built without the feature gpu")]
    NotBuiltIn,
    #[error(
        "method is raster, but the map is rendered on the CPU, because {reason}, which only casts rays; set method to auto or cast"
    )]
    NothingToRasterize { reason: String },
    #[error("the graphics device was lost ({reason}); render again, or on the CPU")]
    DeviceLost { reason: String },
    #[error("the graphics device refused the work ({reason}); render on the CPU")]
    DeviceRefused { reason: String },
    #[error(
        "the map needs {needed} bytes on the graphics device, which binds at most {limit}; render on the CPU"
    )]
    MapTooLarge { needed: u64, limit: u64 },
    #[error(transparent)]
    DeviceMemory(MemoryError),
    #[error(transparent)]
    Memory(#[from] MemoryError),
    #[error(transparent)]
    Tile(#[from] TileError),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_limits_the_cost_is_the_absolute_difference() {
        let difference = RangeDifference::UNLIMITED;
        assert_eq!(difference.cost(10.0, 13.0), 3.0);
        assert_eq!(difference.cost(13.0, 10.0), 3.0);
        assert_eq!(difference.cost(13.0, f32::INFINITY), 13.0);
    }

    #[test]
    fn each_limit_holds_for_its_own_case() {
        let difference = RangeDifference {
            short_m: 1.0,
            long_m: 2.0,
            no_surface_m: 3.0,
        };
        assert_eq!(difference.cost(10.0, 15.0), 1.0);
        assert_eq!(difference.cost(15.0, 10.0), 2.0);
        assert_eq!(difference.cost(15.0, f32::INFINITY), 3.0);
        assert_eq!(difference.cost(10.0, 10.5), 0.5);
    }
}
