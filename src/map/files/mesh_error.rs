//! Errors of mesh files.

use std::io;
use std::path::{Path, PathBuf};

use glam::DVec3;
use ply_rs::parser::ParseError;

use super::mapping_path::BadPathComment;

/// A mesh file that cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[error("{} {problem}", path.display())]
pub struct MeshFileError {
    /// The file.
    pub path: PathBuf,
    /// Why it cannot be read or written.
    pub problem: MeshFileProblem,
}

/// Why a mesh file cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum MeshFileProblem {
    #[error("cannot be written: {0}")]
    Write(io::Error),
    #[error("cannot be read: {0}")]
    Read(#[from] io::Error),
    #[error(
        "is not a mesh that can be read: the name of a PLY, OBJ or STL file ends in .ply, .obj or .stl"
    )]
    UnknownFormat,
    #[error("is not a readable PLY file: {}", in_one_line(.0))]
    Malformed(#[from] ParseError),
    #[error("contains a damaged mapping path: {0}")]
    Path(#[from] BadPathComment),
    #[error(
        "claims {count} of `{element}`, which need at least {needed} bytes, but has only {bytes}; the file is truncated or its header is wrong"
    )]
    ImpossibleCount {
        element: String,
        count: usize,
        needed: u128,
        bytes: u64,
    },
    #[error("has no element `{0}`; a map is a triangle mesh with vertices and faces")]
    NoElement(&'static str),
    #[error(
        "has no property `{property}` of `{element}` that can be used; a map needs the numbers x, y and z of each vertex and the list of integers vertex_indices of each face"
    )]
    NoProperty {
        element: &'static str,
        property: &'static str,
    },
    #[error("is damaged: line {line} is `{text}`, not {expected}; export it again")]
    BadLine {
        line: usize,
        text: String,
        expected: &'static str,
    },
    #[error(
        "is neither a text STL, which begins with `solid` and has facets, nor a binary one; export it again"
    )]
    NotStl,
    #[error("has no triangles; build the map again, or choose another map")]
    NoTriangles,
    #[error(
        "has {0} vertices or triangles, more than the 4 billion that can be numbered; divide the map"
    )]
    TooLarge(usize),
    #[error(
        "is damaged: face {face} uses vertex {vertex}, but there are {vertices}; build the map again"
    )]
    VertexOutOfRange {
        face: usize,
        vertex: i64,
        vertices: usize,
    },
    #[error("is damaged: vertex {0} is not finite; build the map again")]
    NotFinite(usize),
    #[error(
        "has vertex {vertex} at {position}, which is farther from the origin than any place on Earth; the file is damaged, or its unit is not the metre"
    )]
    TooFar { vertex: usize, position: DVec3 },
    #[error(
        "has coordinates up to {farthest_m:.0} m in single precision, which resolves only {resolution_cm:.0} cm there; scale it to metres if its unit is another one, subtract an offset before exporting, or export a PLY of doubles or an OBJ"
    )]
    TooCoarse { farthest_m: f64, resolution_cm: f64 },
}

/// Requires that so many vertices or triangles can be numbered.
pub(crate) fn require_numbers(count: usize) -> Result<(), MeshFileProblem> {
    match u32::try_from(count) {
        Ok(_) => Ok(()),
        Err(_) => Err(MeshFileProblem::TooLarge(count)),
    }
}

impl MeshFileProblem {
    /// The error of a file.
    pub(crate) fn of(self, path: &Path) -> MeshFileError {
        MeshFileError {
            path: path.to_owned(),
            problem: self,
        }
    }
}

/// What a parser found where, without the nested messages of its grammar.
fn in_one_line(error: &ParseError) -> String {
    let message = error.to_string();
    let found = message.split("\n\tError").next().unwrap_or_default();
    found.split_whitespace().collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use crate::map::files::ply;

    #[test]
    fn a_vertex_that_is_no_number_is_reported_in_one_line() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("map.ply");
        let vertices = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n";
        let faces = "element face 1\nproperty list uchar int vertex_indices\nend_header\n";
        let rows = "0 0 0\n1 0 a\n0 1 0\n3 0 1 2\n";
        std::fs::write(
            &file,
            format!("ply\nformat ascii 1.0\n{vertices}{faces}{rows}"),
        )
        .unwrap();
        let message = ply::read_map(&file).unwrap_err().to_string();
        assert!(
            !message.contains('\n') && message.contains("1 0 a"),
            "{message}"
        );
        assert!(message.contains("ine 11"), "{message}");
    }
}
