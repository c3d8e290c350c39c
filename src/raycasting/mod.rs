//! Ray casting: the nearest triangles along rays, by bounding volume hierarchies that are traversed
//! by packets of rays or by single rays.
//!
//! A [`Scene`] has a hierarchy per tile, in coordinates relative to the middle of the tile, under
//! one hierarchy over the boxes of the tiles. A triangle lies in one tile, and rays go from tile
//! to tile, so that the borders of tiles cannot be seen. With vertices on the lattice of maps
//! ([`TriangleMesh::snap`](crate::geometry::TriangleMesh::snap)) it takes about 40 bytes per triangle, less than half of
//! what other vertices take.

mod all_hits;
pub(crate) mod bvh;
mod error;
mod leaves;
mod packet;
mod place;
mod scene;
mod single;
mod source;
mod tile;
mod traversal;
mod triangle;
mod wide;

use crate::simd::WIDE;
pub use error::{TileError, TileProblem};
use place::Place;
pub use scene::{Scene, TileSource};
pub use source::SceneSource;
pub use tile::Tile;
#[cfg(feature = "gpu")]
pub(crate) use triangle::is_proper;

/// Rays per packet.
pub const RAYS: usize = WIDE;

/// Nearest range at which a surface is hit [m]: a ray does not hit the surface that it starts on.
pub const NEAREST_M: f32 = 1e-4;

/// Nearest hit of a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance along the unit direction [m]; infinite without a hit.
    pub range_m: f32,
    /// Index of the triangle in the mesh, or [`Hit::NO_TRIANGLE`].
    pub triangle: u32,
    place: Place,
}

impl Hit {
    /// The triangle of a ray without a hit.
    pub const NO_TRIANGLE: u32 = u32::MAX;

    /// The ray hits nothing.
    pub const MISS: Self = Self {
        range_m: f32::INFINITY,
        triangle: Self::NO_TRIANGLE,
        place: Place::NONE,
    };
}

/// Range interval in which a ray looks for surfaces.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reach {
    /// Surfaces at this range or farther are not hit [m].
    pub until_m: f32,
    /// Range below which any surface may be reported, not only the nearest [m].
    pub enough_m: f32,
    /// Whether surfaces nearer than `enough_m` need not be reported if there is none from there to
    /// `until_m`.
    pub is_window: bool,
}

impl Reach {
    /// The nearest surface at any range.
    #[cfg(test)]
    pub const UNLIMITED: Self = Self::until(f32::INFINITY);

    /// The nearest surface that is nearer than a range [m].
    pub const fn until(until_m: f32) -> Self {
        Self {
            until_m,
            enough_m: 0.0,
            is_window: false,
        }
    }
}

#[cfg(test)]
mod tests;
