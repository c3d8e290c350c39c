//! The ground of a map: which triangles it consists of, its heights, and the attitude of a sensor above it.

pub(crate) mod elevation;
pub(crate) mod heights;
pub(crate) mod surface;
