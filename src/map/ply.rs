//! PLY files of meshes and points.
//!
//! Meshes are written as binary little-endian with vertex x y z, nx ny nz, red green blue and
//! triangles. Files of range-mcl, Open3D, MeshLab and CloudCompare are read (float or double, ASCII or
//! binary, `vertex_indices` or `vertex_index`, polygons are triangulated); the counts of the header
//! are checked against the size of the file before anything is allocated.

use std::fs::File;
use std::io::{BufReader, Write};
use std::path::{Path, PathBuf};

use glam::Vec3;
use ply_rs::parser::{Parser, Reader};
use ply_rs::ply::{
    Addable, BeginList, ElementDef, Encoding, Header, PropertyAccess, PropertyAccessResult,
    PropertyDef, PropertyType, ScalarType,
};
use ply_rs::writer::Writer;

use super::mapping_path::{BadPathComment, MappingPath};
use crate::files::write_atomically;
use crate::geometry::TriangleMesh;

/// Why a PLY file cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum PlyError {
    #[error("cannot read {}: {source}", path.display())]
    Read {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{} is not a readable PLY file: {source}", path.display())]
    Malformed {
        path: PathBuf,
        source: ply_rs::parser::ParseError,
    },
    #[error("{}: {source}", path.display())]
    Path {
        path: PathBuf,
        source: BadPathComment,
    },
    #[error("cannot write {}: {source}", path.display())]
    Write {
        path: PathBuf,
        source: std::io::Error,
    },
    #[error("{} claims {count} of `{element}`, which need at least {needed} bytes, but has only {bytes}; the file is truncated or its header is wrong", path.display())]
    ImpossibleCount {
        path: PathBuf,
        element: String,
        count: usize,
        needed: u128,
        bytes: u64,
    },
    #[error("{} has no element `{element}`; a map is a triangle mesh with vertices and faces", path.display())]
    NoElement {
        path: PathBuf,
        element: &'static str,
    },
    #[error("{} has no triangles; build the map again, or choose another map_file", path.display())]
    NoTriangles { path: PathBuf },
    #[error("{}: face {face} uses vertex {vertex}, but there are {vertices}", path.display())]
    VertexOutOfRange {
        path: PathBuf,
        face: usize,
        vertex: i64,
        vertices: usize,
    },
    #[error("{}: vertex {vertex} is not finite", path.display())]
    NotFinite { path: PathBuf, vertex: usize },
    #[error("{}: vertex {vertex} is at {position}, which is farther from the origin than any place on Earth; the file is damaged, or its unit is not the metre", path.display())]
    TooFar {
        path: PathBuf,
        vertex: usize,
        position: Vec3,
    },
}

/// The circumference of the Earth [m]: no coordinate of a map is larger.
const FARTHEST_M: f32 = 4.0e7;

/// Writes a mesh. Missing normals are computed, missing colours are grey.
///
/// The file is written under a temporary name in the same folder and renamed.
pub fn write(path: &Path, mesh: &TriangleMesh) -> Result<(), PlyError> {
    write_with_comments(path, mesh, Vec::new())
}

/// Writes the mesh of a map with its frame and the path of the mapping drive as comments; see
/// [`MappingPath`].
pub fn write_map(path: &Path, mesh: &TriangleMesh, along: &MappingPath) -> Result<(), PlyError> {
    write_with_comments(path, mesh, along.to_comments())
}

fn write_with_comments(
    path: &Path,
    mesh: &TriangleMesh,
    comments: Vec<String>,
) -> Result<(), PlyError> {
    write_atomically(path, |out| {
        write_to(out, mesh, comments)?;
        out.flush()?;
        out.get_ref().sync_all()
    })
    .map_err(|source| PlyError::Write {
        path: path.to_owned(),
        source,
    })
}

/// Writes points as binary little-endian PLY: x y z, red green blue, and the number `confidence`,
/// which viewers show as a scalar field. Points that are not finite are left out.
///
/// Colours and confidences are one per point.
pub fn write_points(
    path: &Path,
    points: &[Vec3],
    colors: &[[u8; 3]],
    confidences: &[f32],
) -> Result<(), PlyError> {
    debug_assert!(points.len() == colors.len() && points.len() == confidences.len());
    let rows = || {
        let numbers = colors.iter().zip(confidences);
        points
            .iter()
            .zip(numbers)
            .filter(|(point, _)| point.is_finite())
    };
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\n\
         property float x\nproperty float y\nproperty float z\n\
         property uchar red\nproperty uchar green\nproperty uchar blue\n\
         property float confidence\nend_header\n",
        rows().count()
    )
    .into_bytes();
    for (point, (color, confidence)) in rows() {
        bytes.extend(point.to_array().into_iter().flat_map(f32::to_le_bytes));
        bytes.extend(color);
        bytes.extend(confidence.to_le_bytes());
    }
    write_atomically(path, |out| out.write_all(&bytes)).map_err(|source| PlyError::Write {
        path: path.to_owned(),
        source,
    })
}

/// Reads a mesh. Normals and colours are empty where the file has none.
pub fn read(path: &Path) -> Result<TriangleMesh, PlyError> {
    Ok(read_with_comments(path)?.0)
}

/// Reads the mesh of a map, and the path of its mapping drive if it is in the file.
pub fn read_map(path: &Path) -> Result<(TriangleMesh, Option<MappingPath>), PlyError> {
    let (mesh, comments) = read_with_comments(path)?;
    let comments = comments.iter().map(String::as_str);
    let along = MappingPath::from_comments(comments).map_err(|source| PlyError::Path {
        path: path.to_owned(),
        source,
    })?;
    Ok((mesh, along))
}

fn read_with_comments(path: &Path) -> Result<(TriangleMesh, Vec<String>), PlyError> {
    let read_error = |source| PlyError::Read {
        path: path.to_owned(),
        source,
    };
    let malformed = |source| PlyError::Malformed {
        path: path.to_owned(),
        source,
    };
    let file = File::open(path).map_err(read_error)?;
    let bytes = file.metadata().map_err(read_error)?.len();
    let mut reader = Reader::new(BufReader::with_capacity(1 << 20, file));
    let header = Parser::<Vertex>::new()
        .read_header(&mut reader)
        .map_err(malformed)?;
    check_counts(path, &header, bytes)?;

    let mut vertices: Option<Vec<Vertex>> = None;
    let mut faces: Option<Vec<Face>> = None;
    for (name, element) in &header.elements {
        match name.as_str() {
            "vertex" => {
                let read = Parser::new().read_payload_for_element(&mut reader, element, &header);
                vertices = Some(read.map_err(malformed)?);
            }
            "face" => {
                let read = Parser::new().read_payload_for_element(&mut reader, element, &header);
                faces = Some(read.map_err(malformed)?);
            }
            _ => {
                let skipped: Result<Vec<Skipped>, _> =
                    Parser::new().read_payload_for_element(&mut reader, element, &header);
                skipped.map_err(malformed)?;
            }
        }
    }
    let missing = |element| PlyError::NoElement {
        path: path.to_owned(),
        element,
    };
    let vertices = vertices.ok_or_else(|| missing("vertex"))?;
    let faces = faces.ok_or_else(|| missing("face"))?;
    let properties = &header.elements["vertex"].properties;
    let has = |names: [&str; 3]| names.iter().all(|name| properties.contains_key(*name));
    let mesh = TriangleMesh {
        triangles: triangles_of(path, &faces, vertices.len())?,
        normals: if has(["nx", "ny", "nz"]) {
            vertices.iter().map(|vertex| vertex.normal).collect()
        } else {
            Vec::new()
        },
        colors: if has(["red", "green", "blue"]) {
            vertices.iter().map(|vertex| vertex.color).collect()
        } else {
            Vec::new()
        },
        vertices: vertices.iter().map(|vertex| vertex.position).collect(),
    };
    if mesh.triangles.is_empty() {
        return Err(PlyError::NoTriangles {
            path: path.to_owned(),
        });
    }
    let path = || path.to_owned();
    for (vertex, &position) in mesh.vertices.iter().enumerate() {
        if !position.is_finite() {
            return Err(PlyError::NotFinite {
                path: path(),
                vertex,
            });
        }
        if position.abs().max_element() > FARTHEST_M {
            return Err(PlyError::TooFar {
                path: path(),
                vertex,
                position,
            });
        }
    }
    Ok((mesh, header.comments))
}

#[derive(Debug, Default)]
struct Vertex {
    position: Vec3,
    normal: Vec3,
    color: [u8; 3],
}

impl Vertex {
    fn set_real(&mut self, name: &str, value: f32) -> PropertyAccessResult {
        let target = match name {
            "x" => &mut self.position.x,
            "y" => &mut self.position.y,
            "z" => &mut self.position.z,
            "nx" => &mut self.normal.x,
            "ny" => &mut self.normal.y,
            "nz" => &mut self.normal.z,
            // Colours as numbers from 0 to 1, as some tools write them.
            _ => return self.set_color(name, (value.clamp(0.0, 1.0) * 255.0).round() as u8),
        };
        *target = value;
        PropertyAccessResult::Set
    }

    fn set_color(&mut self, name: &str, value: u8) -> PropertyAccessResult {
        let channel = match name {
            "red" => 0,
            "green" => 1,
            "blue" => 2,
            _ => return PropertyAccessResult::Ignored,
        };
        self.color[channel] = value;
        PropertyAccessResult::Set
    }
}

impl PropertyAccess for Vertex {
    fn new() -> Self {
        Self::default()
    }

    fn set_float(&mut self, name: &str, value: f32) -> PropertyAccessResult {
        self.set_real(name, value)
    }

    fn set_double(&mut self, name: &str, value: f64) -> PropertyAccessResult {
        self.set_real(name, value as f32)
    }

    fn set_uchar(&mut self, name: &str, value: u8) -> PropertyAccessResult {
        self.set_color(name, value)
    }

    fn get_float(&self, name: &str) -> Option<f32> {
        Some(match name {
            "x" => self.position.x,
            "y" => self.position.y,
            "z" => self.position.z,
            "nx" => self.normal.x,
            "ny" => self.normal.y,
            "nz" => self.normal.z,
            _ => return None,
        })
    }

    fn get_uchar(&self, name: &str) -> Option<u8> {
        Some(match name {
            "red" => self.color[0],
            "green" => self.color[1],
            "blue" => self.color[2],
            _ => return None,
        })
    }
}

#[derive(Debug, Default)]
struct Face {
    vertices: Vec<u32>,
}

impl Face {
    /// Negative indices become one that no mesh has, and are refused with the rest of those.
    fn set(&mut self, name: &str, vertices: Vec<u32>) -> PropertyAccessResult {
        if !matches!(name, "vertex_indices" | "vertex_index") {
            return PropertyAccessResult::Ignored;
        }
        self.vertices = vertices;
        PropertyAccessResult::Set
    }
}

impl PropertyAccess for Face {
    fn new() -> Self {
        Self::default()
    }

    fn begin_list_uint(&mut self, name: &str, _len: usize) -> BeginList<'_, u32> {
        match name {
            "vertex_indices" | "vertex_index" => BeginList::Fill(&mut self.vertices),
            _ => BeginList::UseSetter,
        }
    }

    fn set_list_int(&mut self, name: &str, value: Vec<i32>) -> PropertyAccessResult {
        let vertices = value
            .iter()
            .map(|&index| u32::try_from(index).unwrap_or(u32::MAX));
        self.set(name, vertices.collect())
    }

    fn set_list_ushort(&mut self, name: &str, value: Vec<u16>) -> PropertyAccessResult {
        self.set(name, value.into_iter().map(u32::from).collect())
    }

    fn set_list_uchar(&mut self, name: &str, value: Vec<u8>) -> PropertyAccessResult {
        self.set(name, value.into_iter().map(u32::from).collect())
    }

    fn get_list_uint(&self, name: &str) -> Option<&[u32]> {
        (name == "vertex_indices").then_some(&self.vertices)
    }
}

/// An element that is skipped.
struct Skipped;

impl PropertyAccess for Skipped {
    fn new() -> Self {
        Self
    }
}

fn write_to(
    out: &mut impl Write,
    mesh: &TriangleMesh,
    comments: Vec<String>,
) -> std::io::Result<()> {
    let (vertex_def, face_def) = definitions(mesh);
    let mut header = Header::new();
    header.encoding = Encoding::BinaryLittleEndian;
    header.comments = comments;
    header.elements.add(vertex_def.clone());
    header.elements.add(face_def.clone());
    Writer::<Vertex>::new().write_header(out, &header)?;

    let with_normals;
    let normals = if mesh.normals.len() == mesh.vertices.len() {
        &mesh.normals
    } else {
        let mut copy = mesh.clone();
        copy.compute_normals();
        with_normals = copy.normals;
        &with_normals
    };
    let writer = Writer::new();
    for (index, &position) in mesh.vertices.iter().enumerate() {
        let vertex = Vertex {
            position,
            normal: normals[index],
            color: mesh.colors.get(index).copied().unwrap_or([128; 3]),
        };
        writer.write_little_endian_element(out, &vertex, &vertex_def)?;
    }
    let writer = Writer::new();
    let mut face = Face::default();
    for triangle in &mesh.triangles {
        face.vertices.clear();
        face.vertices.extend_from_slice(triangle);
        writer.write_little_endian_element(out, &face, &face_def)?;
    }
    Ok(())
}

fn definitions(mesh: &TriangleMesh) -> (ElementDef, ElementDef) {
    let scalar = |name: &str, kind: ScalarType| {
        PropertyDef::new(name.to_owned(), PropertyType::Scalar(kind))
    };
    let mut vertex = ElementDef::new("vertex".to_owned());
    vertex.count = mesh.vertices.len();
    for name in ["x", "y", "z", "nx", "ny", "nz"] {
        vertex.properties.add(scalar(name, ScalarType::Float));
    }
    for name in ["red", "green", "blue"] {
        vertex.properties.add(scalar(name, ScalarType::UChar));
    }
    let mut face = ElementDef::new("face".to_owned());
    face.count = mesh.triangles.len();
    face.properties.add(PropertyDef::new(
        "vertex_indices".to_owned(),
        PropertyType::List(ScalarType::UChar, ScalarType::UInt),
    ));
    (vertex, face)
}

/// A header must not claim more than the file can hold.
fn check_counts(path: &Path, header: &Header, bytes: u64) -> Result<(), PlyError> {
    for (name, element) in &header.elements {
        let least: usize = match header.encoding {
            // One character and a space or line break per property.
            Encoding::Ascii => 2 * element.properties.len(),
            _ => element
                .properties
                .values()
                .map(|property| match &property.data_type {
                    PropertyType::Scalar(kind) | PropertyType::List(kind, _) => size_of(kind),
                })
                .sum(),
        };
        let needed = element.count as u128 * least as u128;
        if needed > u128::from(bytes) {
            return Err(PlyError::ImpossibleCount {
                path: path.to_owned(),
                element: name.clone(),
                count: element.count,
                needed,
                bytes,
            });
        }
    }
    Ok(())
}

fn size_of(kind: &ScalarType) -> usize {
    match kind {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

/// Polygons as fans of triangles.
fn triangles_of(path: &Path, faces: &[Face], vertices: usize) -> Result<Vec<[u32; 3]>, PlyError> {
    let mut triangles = Vec::with_capacity(faces.len());
    for (number, face) in faces.iter().enumerate() {
        if let Some(&vertex) = face.vertices.iter().find(|&&v| v as usize >= vertices) {
            return Err(PlyError::VertexOutOfRange {
                path: path.to_owned(),
                face: number,
                vertex: i64::from(vertex as i32),
                vertices,
            });
        }
        for corner in 2..face.vertices.len() {
            triangles.push([
                face.vertices[0],
                face.vertices[corner - 1],
                face.vertices[corner],
            ]);
        }
    }
    Ok(triangles)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn mesh() -> TriangleMesh {
        TriangleMesh {
            vertices: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::new(1.0, 1.0, 0.5)],
            normals: vec![Vec3::Z; 4],
            colors: vec![[255, 0, 0], [0, 0, 255], [1, 2, 3], [4, 5, 6]],
            triangles: vec![[0, 1, 2], [2, 1, 3]],
        }
    }

    fn read_text(text: &str) -> Result<TriangleMesh, PlyError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn a_written_mesh_reads_back_bit_by_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        write(&path, &mesh()).unwrap();
        assert_eq!(read(&path).unwrap(), mesh());
    }

    #[test]
    fn ascii_with_quads_and_without_normals_reads_as_triangles() {
        let mesh = read_text(
            "ply\nformat ascii 1.0\nelement vertex 4\nproperty double x\nproperty double y\n\
             property double z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n\
             0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n",
        )
        .unwrap();
        assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
        assert!(mesh.normals.is_empty());
    }

    #[test]
    fn a_billion_claimed_vertices_are_refused_before_they_are_allocated() {
        let error = read_text(
            "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\n\
             property float y\nproperty float z\nelement face 1\n\
             property list uchar int vertex_indices\nend_header\n",
        )
        .unwrap_err();
        assert!(matches!(error, PlyError::ImpossibleCount { .. }), "{error}");
        assert!(error.to_string().contains("1000000000"), "{error}");
    }

    #[test]
    fn a_mesh_without_triangles_is_no_map() {
        let error = read_text(
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
             property float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n\
             0 0 0\n",
        )
        .unwrap_err();
        assert!(matches!(error, PlyError::NoTriangles { .. }), "{error}");
    }

    #[test]
    fn a_vertex_that_is_nowhere_on_earth_is_refused() {
        let error = read_text(
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
             property float z\nelement face 1\nproperty list uchar int vertex_indices\n\
             end_header\n0 0 0\n0 1e30 0\n1 0 0\n3 0 1 2\n",
        )
        .unwrap_err();
        assert!(
            matches!(error, PlyError::TooFar { vertex: 1, .. }),
            "{error}"
        );
    }

    #[test]
    fn a_face_that_uses_a_missing_vertex_is_refused() {
        for index in ["7", "-1"] {
            let error = read_text(&format!(
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
                 property float z\nelement face 1\nproperty list uchar int vertex_indices\n\
                 end_header\n0 0 0\n3 0 0 {index}\n",
            ))
            .unwrap_err();
            assert!(
                matches!(error, PlyError::VertexOutOfRange { .. }),
                "{error}"
            );
            assert!(error.to_string().contains(index), "{error}");
        }
    }

    #[test]
    fn text_that_is_no_ply_is_an_error_and_not_a_panic() {
        for text in [
            "",
            "ply",
            "ply\nformat ascii 1.0\n",
            "solid cube\n",
            "ply\nformat ascii 1.0\nelement vertex x\nend_header\n",
        ] {
            assert!(read_text(text).is_err(), "{text:?}");
        }
    }
}
