//! Files of meshes, PLY, OBJ and STL, and the path of the mapping drive in them.

pub(crate) mod mesh_error;
pub mod mesh_file;
pub(crate) mod mesh_origin;
mod mesh_polygons;
// Formats.
pub mod mapped_ply;
mod obj;
pub mod ply;
mod stl;
// The path of the mapping drive.
pub mod mapping_path;
