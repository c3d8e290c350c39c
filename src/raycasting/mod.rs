//! What a ray meets first: triangles in a bounding volume hierarchy, cast at in packets of rays
//! that share their origin.

use glam::Vec3;

/// What a ray met first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance along the unit direction [m]; infinite where nothing was met.
    pub range_m: f32,
    /// Index of the triangle in the mesh, or [`Hit::NO_TRIANGLE`].
    pub triangle: u32,
}

impl Hit {
    /// The triangle of a ray that met nothing.
    pub const NO_TRIANGLE: u32 = u32::MAX;

    /// The ray met nothing.
    pub const MISS: Self = Self {
        range_m: f32::INFINITY,
        triangle: Self::NO_TRIANGLE,
    };
}

/// Directions of rays in the frame of the scene.
pub type Directions<'a> = &'a [Vec3];
