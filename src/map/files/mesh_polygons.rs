//! Polygons of mesh files as triangles.

use super::mesh_error::MeshFileProblem;

/// Divides a polygon into a fan of triangles.
pub(crate) fn fan(corners: &[u32]) -> impl Iterator<Item = [u32; 3]> {
    (corners.windows(2).skip(1)).map(|pair| [corners[0], pair[0], pair[1]])
}

/// Requires that triangles use only existing vertices.
pub(crate) fn require_vertices(
    triangles: &[[u32; 3]],
    vertices: usize,
) -> Result<(), MeshFileProblem> {
    for (face, triangle) in triangles.iter().enumerate() {
        if let Some(&vertex) = triangle.iter().find(|&&v| v as usize >= vertices) {
            return Err(MeshFileProblem::VertexOutOfRange {
                face,
                vertex: i64::from(vertex as i32),
                vertices,
            });
        }
    }
    Ok(())
}
