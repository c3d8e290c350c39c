//! Binary PLY files of triangles, mapped into memory: their vertices and triangles are read where they are.
//!
//! ```text
//! header      text; comments may be the frame of a map and the path of its mapping drive
//! vertices    rows of numbers, among them x y z (float or double); nx ny nz (float), red green blue (uchar)
//! triangles   3 (uchar), three indices (int or uint)
//! ```

use std::path::Path;

use glam::{DVec3, Vec3};
use ply_rs::parser::{Parser, Reader};
use ply_rs::ply::{DefaultElement, Encoding, KeyMap, PropertyDef, PropertyType, ScalarType};

use super::mapping_path::MappingPath;
use super::mesh_origin::PRECISE_M;
use super::ply::size_of;
use crate::geometry::FARTHEST_M;
use crate::map::mesh_view::{MeshView, Vertex};
use crate::shared_bytes::SharedBytes;

/// Bytes of a triangle.
const FACE_BYTES: usize = 13;

/// A mesh in a file, mapped into memory. Missing normals, also those of which one is not finite, point up, missing
/// colours are grey.
#[derive(Clone, Debug)]
pub struct MappedPly {
    bytes: SharedBytes,
    /// Where the vertices and the triangles begin.
    begin: [usize; 2],
    row: RowLayout,
    vertices: usize,
    triangles: usize,
    /// Path of the mapping drive, if it is in the file.
    pub path: Option<MappingPath>,
    /// Added to all positions [m].
    pub origin: DVec3,
}

/// Where the numbers of a vertex are in its row.
#[derive(Clone, Copy, Debug, Default)]
struct RowLayout {
    bytes: usize,
    /// Bytes of a coordinate: 4 or 8.
    coordinate: usize,
    position: [usize; 3],
    normal: Option<[usize; 3]>,
    color: Option<[usize; 3]>,
}

impl RowLayout {
    /// The layout by the properties; `None` where one is a list.
    fn of(properties: &KeyMap<PropertyDef>) -> Option<Self> {
        let mut places = Vec::new();
        let mut bytes = 0;
        for (name, property) in properties {
            let PropertyType::Scalar(kind) = &property.data_type else {
                return None;
            };
            places.push((kind, name, bytes));
            bytes += size_of(kind);
        }
        let all_of = |names: [&str; 3], kind: ScalarType| -> Option<[usize; 3]> {
            let mut at = [0; 3];
            for (at, name) in at.iter_mut().zip(names) {
                let is_it =
                    |place: &&(&ScalarType, &String, usize)| *place.0 == kind && place.1 == name;
                *at = places.iter().find(is_it)?.2;
            }
            Some(at)
        };
        let single = all_of(["x", "y", "z"], ScalarType::Float);
        let double = || all_of(["x", "y", "z"], ScalarType::Double);
        Some(Self {
            bytes,
            coordinate: if single.is_some() { 4 } else { 8 },
            position: single.or_else(double)?,
            normal: all_of(["nx", "ny", "nz"], ScalarType::Float),
            color: all_of(["red", "green", "blue"], ScalarType::UChar),
        })
    }
}

impl MappedPly {
    /// Opens a file; `None` if it has another layout, an index or a coordinate that is not valid, or is to be moved nearer
    /// to the origin: the general reader takes it, or says what is wrong.
    pub fn open(path: &Path) -> Option<Self> {
        let bytes = SharedBytes::of_file(path).ok()?;
        let end = find(&bytes, b"end_header\n")?;
        let begin = end + b"end_header\n".len();
        let mut header = Reader::new(&bytes[..begin]);
        let header = Parser::<DefaultElement>::new()
            .read_header(&mut header)
            .ok()?;
        let mut elements = header.elements.iter();
        let [vertex, face] = ["vertex", "face"].map(|known| {
            let (name, element) = elements.next()?;
            (name == known).then_some(element)
        });
        let (vertex, face) = (vertex?, face?);
        let mut lists = face.properties.iter();
        let (name, corners) = lists.next()?;
        let is_known = header.encoding == Encoding::BinaryLittleEndian
            && matches!(name.as_str(), "vertex_indices" | "vertex_index")
            && matches!(
                corners.data_type,
                PropertyType::List(ScalarType::UChar, ScalarType::Int | ScalarType::UInt)
            );
        let is_last = lists.next().is_none() && elements.next().is_none();
        let row = RowLayout::of(&vertex.properties)?;
        let (vertices, triangles) = (vertex.count, face.count);
        let faces = begin.checked_add(vertices.checked_mul(row.bytes)?)?;
        let size = faces.checked_add(triangles.checked_mul(FACE_BYTES)?)?;
        let comments = header.comments.iter().map(String::as_str);
        let path = MappingPath::from_comments(comments).ok()?;
        let mut mesh = Self {
            begin: [begin, faces],
            row,
            vertices,
            triangles,
            path,
            origin: DVec3::ZERO,
            bytes,
        };
        let is_whole = is_last && mesh.bytes.len() == size && triangles > 0;
        if !(is_known && is_whole && mesh.is_sound()) {
            return None;
        }
        let is_finite = |vertex: u32| mesh.vertex(vertex).normal.is_finite();
        if !(0..vertices as u32).all(is_finite) {
            mesh.row.normal = None;
        }
        Some(mesh)
    }

    /// Whether vertices have normals.
    pub fn has_normals(&self) -> bool {
        self.row.normal.is_some()
    }

    /// Whether the path of a mapping drive is in the file.
    pub fn has_path(&self) -> bool {
        (self.path.as_ref()).is_some_and(|path| !path.map_from_lidar.is_empty())
    }

    /// Whether all indices are those of vertices, and all vertices are where a map may be.
    fn is_sound(&self) -> bool {
        let has_vertices = |index: usize| {
            self.face(index)[0] == 3
                && (self.triangle(index).iter()).all(|&vertex| (vertex as usize) < self.vertices)
        };
        // Coordinates without the frame of a map are moved where they are large.
        let farthest_m = match self.path {
            Some(_) => FARTHEST_M,
            None => PRECISE_M,
        };
        let is_near = |vertex: u32| {
            let position = self.position(vertex);
            position.is_finite() && position.abs().max_element() <= farthest_m
        };
        u32::try_from(self.vertices.max(self.triangles)).is_ok()
            && (0..self.triangles).all(has_vertices)
            && (0..self.vertices as u32).all(is_near)
    }

    fn row(&self, vertex: u32) -> &[u8] {
        &self.bytes[self.begin[0] + vertex as usize * self.row.bytes..][..self.row.bytes]
    }

    fn face(&self, index: usize) -> &[u8] {
        &self.bytes[self.begin[1] + index * FACE_BYTES..][..FACE_BYTES]
    }
}

impl MeshView for MappedPly {
    fn vertices(&self) -> usize {
        self.vertices
    }

    fn triangles(&self) -> usize {
        self.triangles
    }

    fn vertex(&self, index: u32) -> Vertex {
        let row = self.row(index);
        let normal =
            |at: [usize; 3]| Vec3::from_array(at.map(|at| f32::from_le_bytes(array(&row[at..]))));
        Vertex {
            position: self.position(index),
            normal: self.row.normal.map_or(Vec3::Z, normal),
            color: self.row.color.map_or([128; 3], |at| at.map(|at| row[at])),
        }
    }

    fn triangle(&self, index: usize) -> [u32; 3] {
        let row = self.face(index);
        [1, 5, 9].map(|at| u32::from_le_bytes(array(&row[at..])))
    }

    fn position(&self, index: u32) -> DVec3 {
        let row = self.row(index);
        let coordinate = |at: usize| match self.row.coordinate {
            4 => f64::from(f32::from_le_bytes(array(&row[at..]))),
            _ => f64::from_le_bytes(array(&row[at..])),
        };
        self.origin + DVec3::from_array(self.row.position.map(coordinate))
    }
}

/// The first bytes of a row.
fn array<const N: usize>(bytes: &[u8]) -> [u8; N] {
    let mut array = [0; N];
    array.copy_from_slice(&bytes[..N]);
    array
}

/// Where a sequence of bytes that a line ends begins.
fn find(bytes: &[u8], line: &[u8]) -> Option<usize> {
    let mut at = 0;
    while !bytes[at..].starts_with(line) {
        at += 1 + bytes[at..].iter().position(|&byte| byte == b'\n')?;
    }
    Some(at)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::map::files::ply;

    /// A triangle with a scalar per vertex, doubles and no normals, as other programs write it.
    fn file(x: f64, kind: &str, corner: i32) -> Vec<u8> {
        let mut bytes = format!(
            "ply\nformat binary_little_endian 1.0\nobj_info of a scanner\nelement vertex 3\nproperty short ring\n\
             property double x\nproperty double y\nproperty double z\nproperty uchar red\nproperty uchar green\n\
             property uchar blue\nelement face 1\nproperty list uchar {kind} vertex_index\nend_header\n"
        )
        .into_bytes();
        for position in [[0.25, 0.0, 1.0], [x, 0.0, 1.0], [0.25, 2.0, 1.0]] {
            bytes.extend(7_i16.to_le_bytes());
            bytes.extend(position.into_iter().flat_map(f64::to_le_bytes));
            bytes.extend([1, 2, 3]);
        }
        bytes.push(3);
        bytes.extend([0, 1, corner].into_iter().flat_map(i32::to_le_bytes));
        bytes
    }

    #[test]
    fn other_rows_are_read_as_the_reader_of_all_files_reads_them() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        fs::write(&path, file(5.0, "int", 2)).unwrap();
        let (mapped, read) = (MappedPly::open(&path).unwrap(), ply::read(&path).unwrap());
        assert_eq!(mapped.triangle(0), read.triangles[0]);
        for index in 0..3 {
            assert_eq!(mapped.vertex(index), MeshView::vertex(&read, index));
        }
    }

    #[test]
    fn what_other_readers_refuse_or_move_is_not_mapped() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        for (x, kind, corner) in [
            (5.0, "int", -1),
            (5.0, "int", 3),
            (5.0, "short", 2),
            (f64::NAN, "int", 2),
            (500_000.0, "int", 2),
        ] {
            fs::write(&path, file(x, kind, corner)).unwrap();
            assert!(MappedPly::open(&path).is_none(), "{x} {kind} {corner}");
        }
    }
}
