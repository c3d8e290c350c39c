//! From oriented points to a triangle mesh.
