//! What a ray meets first: triangles in bounding volume hierarchies, cast at in packets of rays
//! that share their origin, in bundles of rays of one course, or one by one.
//!
//! A [`Scene`] has a hierarchy per tile, in coordinates relative to the middle of the tile, under
//! one hierarchy over the boxes of the tiles. A triangle lies in one tile, and rays go from tile
//! to tile, so that the borders of tiles cannot be seen. It takes about 97 bytes per triangle.

mod block;
mod bundle;
pub(crate) mod bvh;
mod lanes;
mod lone;
mod packet;
mod scene;
mod triangle;
mod wide;

#[cfg(feature = "gpu")]
pub(crate) use scene::is_proper;
pub use scene::{Reach, Scene};

/// Rays that go through the scene together.
pub const RAYS: usize = packet::RAYS;

/// Surfaces nearer to the origin of a ray are not met [m]: a ray does not meet the surface that
/// it starts on.
pub const NEAREST_M: f32 = 1e-4;

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

#[cfg(test)]
mod tests;
