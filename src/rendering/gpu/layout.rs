//! Memory layout of the data that the shaders read.
//!
//! Keep in sync with `ray.wgsl`, `cost.wgsl`, `sum.wgsl`, `caster.wgsl`, `pixels.wgsl`, `reduce.wgsl` and
//! `raster.wgsl`; a test compares the sizes, and the parity tests the rest.

use bytemuck::{Pod, Zeroable};

use crate::geometry::mesh::STEP_M;
use crate::geometry::{Pose3, Vec3};

/// Range without a surface: WGSL has no infinity.
pub(super) const FAR: f32 = 3.0e38;
/// Threads per work group.
pub(super) const LANES: u32 = 64;
/// Beams or pixels per work group.
pub(super) const BEAMS_PER_GROUP: u32 = 256;
/// Two rectangles of two triangles: one in the image, one for what lies beyond its seam.
pub(super) const VERTICES_PER_TRIANGLE: u32 = 12;
/// Flag of a reference to a leaf.
pub(super) const LEAF: u32 = 1 << 31;
/// Maximum number of triangles in a leaf.
pub(super) const MAX_LEAF: usize = 7;

/// Reference to a leaf.
pub(super) fn leaf(first: usize, count: usize) -> u32 {
    debug_assert!(count <= MAX_LEAF && first < 1 << 28);
    LEAF | (count as u32) << 28 | first as u32
}

/// Two children of the hierarchy and their boxes.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct Node {
    pub left_min: [f32; 3],
    pub left: u32,
    pub left_max: [f32; 3],
    pub right: u32,
    pub right_min: [f32; 3],
    pub unused_0: u32,
    pub right_max: [f32; 3],
    pub unused_1: u32,
}

/// Corners relative to the centre of the map [m].
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct Triangle {
    pub corners: [[f32; 4]; 3],
}

impl Triangle {
    pub fn new(corners: [Vec3; 3]) -> Self {
        Self {
            corners: corners.map(|corner| corner.extend(0.0).to_array()),
        }
    }
}

/// A pose relative to the centre of the map: the axes of the lidar frame, and its origin, which is the sum of a point on
/// the lattice of maps and a remainder [m].
///
/// The difference of a corner and a point on the lattice is exact within 8 km, so that a range is as accurate far from
/// the centre of the map as near it: a rounded origin moves all ranges of a pose by up to 0.2 mm, and their mean cost with
/// them.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct Pose {
    pub axes: [[f32; 4]; 3],
    pub origin: [f32; 4],
    pub remainder: [f32; 4],
}

impl Pose {
    /// Subtracts the centre in `f64`, so that a pose far from the origin of the map keeps its digits.
    pub fn new(map_from_lidar: &Pose3, center: nalgebra::Vector3<f64>) -> Self {
        let rotation = map_from_lidar.rotation.to_rotation_matrix();
        let four = |v: nalgebra::Vector3<f64>| [v.x as f32, v.y as f32, v.z as f32, 0.0];
        let step_m = f64::from(STEP_M);
        let exact = map_from_lidar.translation.vector - center;
        let origin = exact.map(|along| f64::from(((along / step_m).round() * step_m) as f32));
        Self {
            axes: [0, 1, 2].map(|axis| four(rotation.matrix().column(axis).into_owned())),
            origin: four(origin),
            remainder: four(exact - origin),
        }
    }
}

/// Parameters of the caster.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct Query {
    /// Number of rays or beams.
    pub rays: u32,
    /// Work groups per pose.
    pub groups: u32,
    /// Reference to the root.
    pub root: u32,
    /// Surfaces up to this range hide what is behind them, but are not seen [m].
    pub min_m: f32,
    /// Surfaces at this range or farther are not hit [m].
    pub far_m: f32,
    pub short_m: f32,
    pub long_m: f32,
    pub no_surface_m: f32,
}

/// A pixel with a return.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct Pixel {
    /// Row-major index.
    pub index: u32,
    pub range_m: f32,
}

/// Parameters of the comparison of drawn images with a measured one.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct Comparison {
    /// Number of pixels with a return.
    pub pixels: u32,
    /// Work groups per image.
    pub groups: u32,
    pub width: u32,
    pub height: u32,
    /// Images side by side in the atlas.
    pub columns: u32,
    /// Pixels between rows of the atlas.
    pub stride: u32,
    pub min_m: f32,
    pub max_m: f32,
    pub short_m: f32,
    pub long_m: f32,
    pub no_surface_m: f32,
    pub unused: u32,
}

/// Number of terms of the sum of a pose.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct Reduction {
    pub terms: u32,
    pub unused: [u32; 3],
}

/// Positions of images in the texture that they are drawn to.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct Atlas {
    pub width: u32,
    pub height: u32,
    pub columns: u32,
    pub unused: u32,
    pub atlas_size: [f32; 2],
    pub fov_up_rad: f32,
    pub fov_rad: f32,
    pub far_m: f32,
    pub unused_end: [u32; 3],
}
