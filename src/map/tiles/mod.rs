//! Tiles of a map: squares that are made once, kept on disk, and loaded where the car is.

pub(crate) mod cache;
pub(crate) mod contents;
pub(crate) mod file;
pub(crate) mod grid;
pub(crate) mod store;
