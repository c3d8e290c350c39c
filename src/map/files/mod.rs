//! Files of meshes, PLY, OBJ and STL, and the path of the mapping drive in them.

pub(crate) mod mesh_error;
pub(crate) mod mesh_file;
pub(crate) mod mesh_origin;
mod mesh_polygons;
// Formats.
pub(crate) mod mapped_ply;
mod obj;
pub(crate) mod ply;
mod stl;
// The path of the mapping drive.
pub(crate) mod mapping_path;
