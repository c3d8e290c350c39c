//! Mesh files of maps: PLY, OBJ and STL, by the ending of the name or by the first bytes.

use std::path::Path;

use glam::DVec3;

use super::mapping_path::MappingPath;
use super::mesh_error::{MeshFileError, MeshFileProblem, require_numbers};
use super::mesh_origin::{Precision, relative};
use super::{obj, ply, stl};
use crate::geometry::TriangleMesh;
use crate::memory;

/// Reads the mesh of a map, and its path and frame if they are in the file.
///
/// The mesh of a file with coordinates beyond 8 km and without a path is moved near the origin; the
/// translation of `world_from_map` moves it back.
pub fn read(path: &Path) -> Result<(TriangleMesh, Option<MappingPath>), MeshFileError> {
    let ending = path.extension().map(|ending| ending.to_ascii_lowercase());
    let parse = match ending.as_ref().and_then(|ending| ending.to_str()) {
        Some("obj") => |bytes: &[u8]| Ok((obj::parse(bytes)?, Precision::Double)),
        Some("stl") => |bytes: &[u8]| Ok((stl::parse(bytes)?, Precision::Single)),
        Some("ply") => return ply::read_map(path),
        _ if ply::is_ply(path) => return ply::read_map(path),
        _ => return Err(MeshFileProblem::UnknownFormat.of(path)),
    };
    let bytes = memory::read_file(path).map_err(|error| MeshFileProblem::Read(error).of(path))?;
    let read = parse(&bytes)
        .and_then(|((vertices, triangles), precision)| mesh_of(&vertices, triangles, precision));
    read.map_err(|problem: MeshFileProblem| problem.of(path))
}

/// Checks a mesh and moves it near the origin.
fn mesh_of(
    vertices: &[DVec3],
    triangles: Vec<[u32; 3]>,
    precision: Precision,
) -> Result<(TriangleMesh, Option<MappingPath>), MeshFileProblem> {
    if triangles.is_empty() {
        return Err(MeshFileProblem::NoTriangles);
    }
    require_numbers(vertices.len().max(triangles.len()))?;
    let (origin, vertices) = relative(vertices, precision)?;
    let mesh = TriangleMesh {
        vertices,
        triangles,
        ..TriangleMesh::default()
    };
    Ok((mesh, MappingPath::at_origin(origin)))
}
