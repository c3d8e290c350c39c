//! PLY files of meshes and points.
//!
//! Meshes are written as binary little-endian with vertex x y z (double beyond 8 km), nx ny nz, red green blue and
//! triangles. Files of range-mcl, Open3D, MeshLab and CloudCompare are read (float or double, ASCII or
//! binary, `vertex_indices` or `vertex_index`, polygons are triangulated); the counts of the header
//! are checked against the size of the file before anything is allocated.

use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read as _, Write};
use std::path::Path;

use glam::{DVec3, Vec3};
use ply_rs::parser::{Parser, Reader};
use ply_rs::ply::{
    BeginList, Encoding, Header, KeyMap, Property, PropertyAccess, PropertyAccessResult,
    PropertyDef, PropertyType, ScalarType,
};

use super::mapping_path::MappingPath;
use super::mesh_error::{MeshFileError, MeshFileProblem, require_numbers};
use super::mesh_origin::{self, PRECISE_M, Precision};
use super::mesh_polygons::{fan, require_vertices};
use crate::files::write_atomically;
use crate::geometry::{PlyVertex, TriangleMesh};
use crate::map::mesh_view::MeshView;

/// What a file of this program begins with.
const START: &str = "ply\nformat binary_little_endian 1.0\n";
const POSITION: &str = "property float x\nproperty float y\nproperty float z\n";
const POSITION_F64: &str = "property double x\nproperty double y\nproperty double z\n";
const NORMAL: &str = "property float nx\nproperty float ny\nproperty float nz\n";
const COLOR: &str = "property uchar red\nproperty uchar green\nproperty uchar blue\n";
const FACE: &str = "property list uchar uint vertex_indices\n";

/// Writes a mesh. Missing normals are computed, missing colours are grey. That of a map has its frame
/// and the path of the mapping drive as comments; see [`MappingPath`].
///
/// The file is written under a temporary name in the same folder and renamed.
pub fn write(
    path: &Path,
    mesh: &TriangleMesh,
    mapping_path: Option<&MappingPath>,
) -> Result<(), MeshFileError> {
    if mesh.normals.len() == mesh.vertices.len() {
        return write_joined(path, &[mesh], mapping_path);
    }
    let mut mesh = mesh.clone();
    mesh.compute_normals();
    write_joined(path, &[&mesh], mapping_path)
}

/// Writes meshes as one, the vertices and triangles of one after those of the other, like [`write`]. Coordinates are
/// double where one is beyond 8 km, so that millimetres are kept.
pub fn write_joined(
    path: &Path,
    meshes: &[&dyn MeshView],
    mapping_path: Option<&MappingPath>,
) -> Result<(), MeshFileError> {
    let count = |of: fn(&dyn MeshView) -> usize| meshes.iter().map(|mesh| of(*mesh)).sum::<usize>();
    let [vertices, triangles] = [
        count(|mesh| mesh.vertices()),
        count(|mesh| mesh.triangles()),
    ];
    require_numbers(vertices.max(triangles)).map_err(|problem| problem.of(path))?;
    let is_far = |mesh: &&dyn MeshView| {
        let mut vertices = 0..mesh.vertices() as u32;
        vertices.any(|vertex| mesh.position(vertex).abs().max_element() > PRECISE_M)
    };
    let is_double = meshes.iter().any(is_far);
    let position = if is_double { POSITION_F64 } else { POSITION };
    let comments = mapping_path.map_or_else(Vec::new, MappingPath::to_comments);
    let comments: String = (comments.iter())
        .map(|comment| format!("comment {comment}\n"))
        .collect();
    let header = format!(
        "{comments}element vertex {vertices}\n{position}{NORMAL}{COLOR}element face {triangles}\n{FACE}"
    );
    write_file(path, &header, |out| {
        for mesh in meshes {
            for index in 0..mesh.vertices() as u32 {
                let vertex = mesh.vertex(index);
                if is_double {
                    for coordinate in vertex.position.to_array() {
                        out.write_all(&coordinate.to_le_bytes())?;
                    }
                } else {
                    write_floats(out, &vertex.position.as_vec3().to_array())?;
                }
                write_floats(out, &vertex.normal.to_array())?;
                out.write_all(&vertex.color)?;
            }
        }
        let mut first = 0;
        for mesh in meshes {
            for triangle in 0..mesh.triangles() {
                out.write_all(&[3])?;
                for index in mesh.triangle(triangle) {
                    out.write_all(&(first + index).to_le_bytes())?;
                }
            }
            first += mesh.vertices() as u32;
        }
        out.flush()?;
        out.get_ref().sync_all()
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
) -> Result<(), MeshFileError> {
    debug_assert!(points.len() == colors.len() && points.len() == confidences.len());
    let finite = || (0..points.len()).filter(|&index| points[index].is_finite());
    let count = finite().count();
    let header = format!("element vertex {count}\n{POSITION}{COLOR}property float confidence\n");
    write_file(path, &header, |out| {
        for index in finite() {
            write_floats(out, &points[index].to_array())?;
            out.write_all(&colors[index])?;
            write_floats(out, &[confidences[index]])?;
        }
        Ok(())
    })
}

/// Writes a file of comments and elements, as in its header, and of their rows.
fn write_file(
    path: &Path,
    header: &str,
    write_rows: impl FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>,
) -> Result<(), MeshFileError> {
    write_atomically(path, |out| {
        writeln!(out, "{START}{header}end_header")?;
        write_rows(out)
    })
    .map_err(|error| MeshFileProblem::Write(error).of(path))
}

fn write_floats(out: &mut impl Write, values: &[f32]) -> io::Result<()> {
    (values.iter()).try_for_each(|value| out.write_all(&value.to_le_bytes()))
}

/// Reads a mesh. Normals and colours are empty where the file has none, normals also where one of
/// them is not finite.
pub fn read(path: &Path) -> Result<TriangleMesh, MeshFileError> {
    Ok(read_map(path)?.0)
}

/// Reads the mesh of a map, and the path of its mapping drive if it is in the file.
pub fn read_map(path: &Path) -> Result<(TriangleMesh, Option<MappingPath>), MeshFileError> {
    read_mesh(path).map_err(|problem| problem.of(path))
}

fn read_mesh(path: &Path) -> Result<(TriangleMesh, Option<MappingPath>), MeshFileProblem> {
    let file = File::open(path)?;
    let bytes = file.metadata()?.len();
    let mut reader = Reader::new(BufReader::with_capacity(1 << 20, file));
    let header = Parser::<PlyVertex>::new().read_header(&mut reader)?;
    check_header(&header, bytes)?;

    let (mut vertices, mut faces): (Option<Vec<PlyVertex>>, Option<Vec<Face>>) = (None, None);
    for (name, element) in &header.elements {
        if name == "vertex" {
            let parser = Parser::new();
            vertices = Some(parser.read_payload_for_element(&mut reader, element, &header)?);
        } else {
            // The rows of unknown elements are parsed as faces, to skip them.
            let rows = Parser::new().read_payload_for_element(&mut reader, element, &header)?;
            if name == "face" {
                faces = Some(rows);
            }
        }
    }
    let (vertices, faces) = (vertices.unwrap_or_default(), faces.unwrap_or_default());
    let properties = &header.elements["vertex"].properties;
    let positions: Vec<DVec3> = vertices.iter().map(|vertex| vertex.position).collect();
    let mut path = MappingPath::from_comments(header.comments.iter().map(String::as_str))?;
    let positions = if path.is_some() {
        mesh_origin::check(&positions)?;
        positions
            .iter()
            .map(|position| position.as_vec3())
            .collect()
    } else {
        let (origin, positions) = mesh_origin::relative(&positions, precision_of(properties))?;
        path = MappingPath::at_origin(origin);
        positions
    };
    let mut mesh = TriangleMesh {
        triangles: triangles_of(&faces, positions.len())?,
        vertices: positions,
        ..TriangleMesh::default()
    };
    if mesh.triangles.is_empty() {
        return Err(MeshFileProblem::NoTriangles);
    }
    let has = |names: [&str; 3]| names.iter().all(|name| properties.contains_key(*name));
    if has(["nx", "ny", "nz"]) {
        let normals = || vertices.iter().map(|vertex| vertex.normal);
        if normals().all(Vec3::is_finite) {
            mesh.normals = normals().collect();
        }
    }
    if has(["red", "green", "blue"]) {
        mesh.colors = vertices.iter().map(|vertex| vertex.color).collect();
    }
    Ok((mesh, path))
}

/// Whether a file begins as a PLY file does.
pub(crate) fn is_ply(path: &Path) -> bool {
    let mut start = [0; 3];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut start));
    read.is_ok() && start == *b"ply"
}

/// Precision of the coordinates: double where one is of that type.
fn precision_of(properties: &KeyMap<PropertyDef>) -> Precision {
    let is_double = |name: &&str| {
        let found = properties.get(*name);
        found.is_some_and(|p| p.data_type == PropertyType::Scalar(ScalarType::Double))
    };
    if ["x", "y", "X", "Y"].iter().any(is_double) {
        Precision::Double
    } else {
        Precision::Single
    }
}

/// A row of the element `face`.
#[derive(Debug, Default)]
struct Face {
    vertices: Vec<u32>,
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

    fn set_property(&mut self, name: &str, property: Property) -> PropertyAccessResult {
        /// Negative indices become one that no mesh has, which is an error.
        fn indices<T: TryInto<u32>>(values: Vec<T>) -> Vec<u32> {
            (values.into_iter())
                .map(|index| index.try_into().unwrap_or(u32::MAX))
                .collect()
        }
        if !matches!(name, "vertex_indices" | "vertex_index") {
            return PropertyAccessResult::Ignored;
        }
        self.vertices = match property {
            Property::ListChar(values) => indices(values),
            Property::ListUChar(values) => indices(values),
            Property::ListShort(values) => indices(values),
            Property::ListUShort(values) => indices(values),
            Property::ListInt(values) => indices(values),
            Property::ListUInt(values) => values,
            _ => return PropertyAccessResult::UnsupportedType,
        };
        PropertyAccessResult::Set
    }
}

/// Checks that the header has the elements and properties of a mesh and does not claim more than the
/// file can hold.
fn check_header(header: &Header, bytes: u64) -> Result<(), MeshFileProblem> {
    let is_scalar = |kind: &PropertyType| matches!(kind, PropertyType::Scalar(_));
    let is_list = |kind: &PropertyType| matches!(kind, PropertyType::List(..));
    type Needed<'a> = (
        &'static str,
        [&'static str; 2],
        &'a dyn Fn(&PropertyType) -> bool,
    );
    let needed: [Needed; 4] = [
        ("vertex", ["x", "X"], &is_scalar),
        ("vertex", ["y", "Y"], &is_scalar),
        ("vertex", ["z", "Z"], &is_scalar),
        ("face", ["vertex_indices", "vertex_index"], &is_list),
    ];
    for (element, names, has_kind) in needed {
        let properties = match header.elements.get(element) {
            Some(found) => &found.properties,
            None => return Err(MeshFileProblem::NoElement(element)),
        };
        let found = names.iter().find_map(|name| properties.get(*name));
        if !found.is_some_and(|property| has_kind(&property.data_type)) {
            let property = names[0];
            return Err(MeshFileProblem::NoProperty { element, property });
        }
    }
    for (name, element) in &header.elements {
        let least: usize = match header.encoding {
            // One character and a space or line break per property.
            Encoding::Ascii => 2 * element.properties.len(),
            _ => (element.properties.values())
                .map(|property| match &property.data_type {
                    PropertyType::Scalar(kind) | PropertyType::List(kind, _) => size_of(kind),
                })
                .sum(),
        };
        let needed = element.count as u128 * least.max(1) as u128;
        if needed > u128::from(bytes) {
            return Err(MeshFileProblem::ImpossibleCount {
                element: name.clone(),
                count: element.count,
                needed,
                bytes,
            });
        }
    }
    Ok(())
}

pub(super) fn size_of(kind: &ScalarType) -> usize {
    match kind {
        ScalarType::Char | ScalarType::UChar => 1,
        ScalarType::Short | ScalarType::UShort => 2,
        ScalarType::Int | ScalarType::UInt | ScalarType::Float => 4,
        ScalarType::Double => 8,
    }
}

/// Divides polygons into triangles.
fn triangles_of(faces: &[Face], vertices: usize) -> Result<Vec<[u32; 3]>, MeshFileProblem> {
    let mut triangles = Vec::with_capacity(faces.len());
    for face in faces {
        triangles.extend(fan(&face.vertices));
    }
    require_vertices(&triangles, vertices)?;
    Ok(triangles)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;
    use crate::geometry::Pose3;
    use crate::map::files::mapped_ply::MappedPly;

    fn mesh() -> TriangleMesh {
        TriangleMesh {
            vertices: vec![Vec3::ZERO, Vec3::X, Vec3::Y, Vec3::new(1.0, 1.0, 0.5)],
            normals: vec![Vec3::Z; 4],
            colors: vec![[255, 0, 0], [0, 0, 255], [1, 2, 3], [4, 5, 6]],
            triangles: vec![[0, 1, 2], [2, 1, 3]],
        }
    }

    fn read_text(text: &str) -> Result<TriangleMesh, MeshFileError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn a_written_mesh_reads_back_bit_by_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        write(&path, &mesh(), None).unwrap();
        assert_eq!(read(&path).unwrap(), mesh());
    }

    #[test]
    fn a_written_mesh_that_is_mapped_has_the_same_rows() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        let driven = MappingPath {
            map_from_lidar: vec![Pose3::translation(1.0 / 3.0, 2.0, 0.0); 3],
            ..MappingPath::default()
        };
        write(&path, &mesh(), Some(&driven)).unwrap();
        let mapped = MappedPly::open(&path).unwrap();
        assert_eq!(mapped.path, Some(driven));
        assert_eq!(MeshView::triangles(&mapped), 2);
        for vertex in 0..4 {
            assert_eq!(mapped.vertex(vertex), MeshView::vertex(&mesh(), vertex));
        }
        for triangle in 0..2 {
            assert_eq!(mapped.triangle(triangle), mesh().triangles[triangle]);
        }
    }

    #[test]
    fn joined_meshes_keep_their_bits_a_thousand_kilometres_away_and_stay_single_precision_nearby() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        write(&path, &mesh(), None).unwrap();
        for (away_m, coordinate_bytes) in [(4096.0, 4), (1_003_520.0, 8)] {
            let mut far = MappedPly::open(&path).unwrap();
            far.origin = DVec3::new(away_m, -away_m, 0.0);
            let joined = folder.path().join("joined.ply");
            let near = mesh();
            let frame = MappingPath::default();
            write_joined(&joined, &[&near, &far], Some(&frame)).unwrap();
            let mapped = MappedPly::open(&joined).unwrap();
            for index in 0..4 {
                assert_eq!(mapped.vertex(index), MeshView::vertex(&near, index));
                assert_eq!(mapped.vertex(index + 4), far.vertex(index));
            }
            assert_eq!(mapped.triangle(3), far.triangle(1).map(|index| index + 4));
            let rows = 8 * (3 * coordinate_bytes + 15) + 4 * 13;
            let bytes = fs::read(&joined).unwrap();
            assert!(bytes[bytes.len() - rows - 11..].starts_with(b"end_header\n"));
            assert_eq!(read(&joined).unwrap().triangles.len(), 4);
        }
    }

    #[test]
    fn a_file_with_a_fault_or_of_another_layout_is_not_mapped() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        write(&path, &mesh(), None).unwrap();
        let good = fs::read(&path).unwrap();
        let faces = good.len() - 26;
        let changes: [(usize, &[u8]); 4] = [
            (faces, &[4]),
            (faces + 1, &[4]),
            (faces - 27, &f32::NAN.to_le_bytes()),
            (faces - 27, &1e9_f32.to_le_bytes()),
        ];
        for (at, change) in changes {
            let mut bytes = good.clone();
            bytes[at..at + change.len()].copy_from_slice(change);
            fs::write(&path, &bytes).unwrap();
            assert!(MappedPly::open(&path).is_none(), "{change:?} at {at}");
        }
        for length in [0, 30, faces - 40, good.len() - 1] {
            fs::write(&path, &good[..length]).unwrap();
            assert!(MappedPly::open(&path).is_none(), "{length}");
        }
        let text = String::from_utf8_lossy(&good).replace("float nx", "double nx");
        fs::write(&path, text.as_bytes()).unwrap();
        assert!(MappedPly::open(&path).is_none());
    }

    #[test]
    fn normals_that_are_not_finite_are_as_if_missing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        let mut damaged = mesh();
        damaged.normals[2].y = f32::NAN;
        write(&path, &damaged, None).unwrap();
        assert!(read(&path).unwrap().normals.is_empty());
    }

    #[test]
    fn the_bytes_of_a_mesh_are_a_header_and_little_endian_rows() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.ply");
        let triangle = TriangleMesh {
            vertices: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
            triangles: vec![[0, 1, 2]],
            ..TriangleMesh::default()
        };
        write(&path, &triangle, None).unwrap();
        let mut expected = b"ply\nformat binary_little_endian 1.0\n\
            element vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
            property float nx\nproperty float ny\nproperty float nz\n\
            property uchar red\nproperty uchar green\nproperty uchar blue\n\
            element face 1\nproperty list uchar uint vertex_indices\nend_header\n"
            .to_vec();
        for position in triangle.vertices {
            for value in [position.to_array(), Vec3::Z.to_array()].concat() {
                expected.extend(value.to_le_bytes());
            }
            expected.extend([128; 3]);
        }
        expected.extend([3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
        assert!(fs::read(&path).unwrap() == expected);
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

    /// The ASCII file of a triangle whose vertices have properties of a type and names.
    fn triangle(kind: &str, names: [&str; 3], index: &str) -> String {
        let [x, y, z] = names.map(|name| format!("property {kind} {name}\n"));
        format!(
            "ply\nformat ascii 1.0\nelement vertex 3\n{x}{y}{z}element face 1\n\
             property list uchar {index} vertex_index\nend_header\n0 0 1\n2 0 1\n0 3 1\n3 0 1 2\n"
        )
    }

    #[test]
    fn coordinates_and_indices_of_every_type_and_coordinates_in_capitals_are_read() {
        let expected = read_text(&triangle("float", ["x", "y", "z"], "uint")).unwrap();
        assert_eq!(expected.vertices[1], Vec3::new(2.0, 0.0, 1.0));
        for kind in ["char", "uchar", "short", "ushort", "int", "uint", "double"] {
            let mesh = read_text(&triangle(kind, ["X", "Y", "Z"], "uint")).unwrap();
            assert_eq!(mesh, expected, "{kind}");
        }
        for index in ["char", "uchar", "short", "ushort", "int"] {
            let mesh = read_text(&triangle("float", ["x", "y", "z"], index)).unwrap();
            assert_eq!(mesh, expected, "{index}");
        }
    }

    #[test]
    fn a_missing_or_unusable_property_is_named() {
        for (text, property) in [
            (triangle("float", ["x", "y", "height"], "uint"), "`z`"),
            (triangle("list uchar int", ["x", "y", "z"], "uint"), "`x`"),
        ] {
            let message = read_text(&text).unwrap_err().to_string();
            assert!(message.contains(property), "{message}");
        }
        assert!(read_text(&triangle("float", ["x", "y", "z"], "float")).is_err());
        let endless = "ply\nformat ascii 1.0\nelement nothing 1000000000000\n";
        let text = triangle("float", ["x", "y", "z"], "uint");
        let text = text.replace("ply\nformat ascii 1.0\n", endless);
        assert!(matches!(
            read_text(&text).unwrap_err().problem,
            MeshFileProblem::ImpossibleCount { .. }
        ));
    }

    #[test]
    fn a_billion_claimed_vertices_are_rejected_before_they_are_allocated() {
        let error = read_text(
            "ply\nformat binary_little_endian 1.0\nelement vertex 1000000000\nproperty float x\n\
             property float y\nproperty float z\nelement face 1\n\
             property list uchar int vertex_indices\nend_header\n",
        )
        .unwrap_err();
        assert!(
            matches!(error.problem, MeshFileProblem::ImpossibleCount { .. }),
            "{error}"
        );
        assert!(error.to_string().contains("1000000000"), "{error}");
    }

    #[test]
    fn a_mesh_without_triangles_is_rejected() {
        let error = read_text(
            "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
             property float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n\
             0 0 0\n",
        )
        .unwrap_err();
        assert!(
            matches!(error.problem, MeshFileProblem::NoTriangles),
            "{error}"
        );
    }

    #[test]
    fn a_vertex_beyond_the_size_of_the_earth_is_rejected() {
        let error = read_text(
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
             property float z\nelement face 1\nproperty list uchar int vertex_indices\n\
             end_header\n0 0 0\n0 1e30 0\n1 0 0\n3 0 1 2\n",
        )
        .unwrap_err();
        assert!(
            matches!(error.problem, MeshFileProblem::TooFar { vertex: 1, .. }),
            "{error}"
        );
    }

    #[test]
    fn a_face_with_a_missing_vertex_is_rejected() {
        for index in ["7", "-1"] {
            let error = read_text(&format!(
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
                 property float z\nelement face 1\nproperty list uchar int vertex_indices\n\
                 end_header\n0 0 0\n3 0 0 {index}\n",
            ))
            .unwrap_err();
            assert!(
                matches!(error.problem, MeshFileProblem::VertexOutOfRange { .. }),
                "{error}"
            );
            assert!(error.to_string().contains(index), "{error}");
        }
    }

    #[test]
    fn text_that_is_not_ply_is_an_error_and_not_a_panic() {
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
