//! glTF 2.0 binary (`.glb`): a mesh with the colors of its vertices, and paths as ribbons.
//!
//! A file is a header and two chunks, JSON and binary, each padded to four bytes (Khronos Group, *glTF 2.0
//! Specification*, section 4.4). The y axis of glTF points up: the root node turns the z axis of the map there.

use std::io::{self, Write};

use glam::Vec3;
use serde_json::{Value, json};

use crate::app::report::plotting::color::Rgb;
use crate::geometry::{Pose3, TriangleMesh};
use crate::georeference::Georeference;

/// Component types of glTF.
const UNSIGNED_BYTE: u32 = 5121;
const UNSIGNED_INT: u32 = 5125;
const FLOAT: u32 = 5126;
/// Targets of buffer views.
const ARRAY_BUFFER: u32 = 34962;
const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// A level band along a path, colored along it.
pub struct Ribbon<'a> {
    /// Name of the node.
    pub name: &'a str,
    /// Path in the map frame.
    pub path: &'a [Pose3],
    /// Color per pose.
    pub colors: Vec<Rgb>,
}

impl Ribbon<'_> {
    /// Two triangles per step, across the direction of travel.
    fn mesh(&self) -> TriangleMesh {
        const HALF_WIDTH_M: f32 = 0.15;
        let points: Vec<Vec3> = (self.path.iter())
            .map(|pose| Vec3::from(pose.translation.vector.cast::<f32>()))
            .collect();
        let last = points.len().saturating_sub(1);
        let mut mesh = TriangleMesh::default();
        let mut across = Vec3::Y;
        for (k, &point) in points.iter().enumerate() {
            let along = points[(k + 1).min(last)] - points[k.saturating_sub(1)];
            // The direction of the last step where the vehicle stands.
            across = Vec3::Z.cross(along).try_normalize().unwrap_or(across);
            mesh.vertices.push(point - HALF_WIDTH_M * across);
            mesh.vertices.push(point + HALF_WIDTH_M * across);
            mesh.colors.extend([self.colors[k]; 2]);
        }
        for k in 0..last as u32 {
            let [right, left, next_right, next_left] = [2 * k, 2 * k + 1, 2 * k + 2, 2 * k + 3];
            mesh.triangles.push([right, next_right, next_left]);
            mesh.triangles.push([right, next_left, left]);
        }
        mesh
    }
}

/// Nodes of a file, in the map frame.
#[derive(Default)]
pub struct Model {
    nodes: Vec<Value>,
    meshes: Vec<Value>,
    accessors: Vec<Value>,
    views: Vec<Value>,
    binary: Vec<u8>,
    /// The place of the map on the Earth, if it is known.
    pub georeference: Option<Georeference>,
}

impl Model {
    /// Adds a mesh, without its vertices that no triangle has.
    pub fn add_mesh(&mut self, name: &str, mesh: &TriangleMesh) {
        if mesh.triangles.is_empty() {
            return;
        }
        let bounds = mesh.bounds();
        let positions = self.view(bytemuck::cast_slice(&mesh.vertices), None, ARRAY_BUFFER);
        let count = mesh.vertices.len();
        let mut attributes = json!({ "POSITION": self.accessor(json!({
            "bufferView": positions, "componentType": FLOAT, "count": count, "type": "VEC3",
            "min": bounds.min.to_array(), "max": bounds.max.to_array(),
        })) });
        if mesh.colors.len() == count {
            // Four bytes per vertex: attributes start at multiples of four.
            let colors: Vec<[u8; 4]> = (mesh.colors.iter()).map(|&color| linear(color)).collect();
            let colors = self.view(colors.as_flattened(), Some(4), ARRAY_BUFFER);
            attributes["COLOR_0"] = self
                .accessor(json!({
                    "bufferView": colors, "componentType": UNSIGNED_BYTE, "normalized": true,
                    "count": count, "type": "VEC4",
                }))
                .into();
        }
        let indices = mesh.triangles.as_flattened();
        let view = self.view(bytemuck::cast_slice(indices), None, ELEMENT_ARRAY_BUFFER);
        let indices = self.accessor(json!({
            "bufferView": view, "componentType": UNSIGNED_INT, "count": indices.len(), "type": "SCALAR",
        }));
        self.nodes
            .push(json!({ "name": name, "mesh": self.meshes.len() }));
        self.meshes.push(json!({ "name": name, "primitives": [
            { "attributes": attributes, "indices": indices, "material": 0 },
        ] }));
    }

    /// Adds a path.
    pub fn add_ribbon(&mut self, ribbon: &Ribbon) {
        self.add_mesh(ribbon.name, &ribbon.mesh());
    }

    /// Writes the file.
    pub fn write(&self, mut writer: impl Write) -> io::Result<()> {
        let half = f64::sqrt(0.5);
        let children: Vec<usize> = (0..self.nodes.len()).collect();
        let root =
            json!({ "name": "map", "rotation": [-half, 0.0, 0.0, half], "children": children });
        let nodes: Vec<Value> = self.nodes.iter().cloned().chain([root]).collect();
        let mut asset =
            json!({ "version": "2.0", "generator": concat!("fpmcl ", env!("CARGO_PKG_VERSION")) });
        if let Some(georeference) = &self.georeference {
            asset["extras"] = json!({ "georeference": georeference });
        }
        let mut json = serde_json::to_vec(&json!({
            "asset": asset,
            "scene": 0,
            "scenes": [{ "nodes": [children.len()] }],
            "nodes": nodes,
            "meshes": self.meshes,
            "materials": [{
                "doubleSided": true,
                "pbrMetallicRoughness": { "metallicFactor": 0.0, "roughnessFactor": 1.0 },
            }],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{ "byteLength": self.binary.len() }],
        }))?;
        json.resize(json.len().next_multiple_of(4), b' ');
        let length = 12 + 8 + json.len() + 8 + self.binary.len();
        let too_large = || io::Error::other("the model is larger than the 4 GiB of its format");
        let length = u32::try_from(length).ok().ok_or_else(too_large)?;
        writer.write_all(b"glTF")?;
        writer.write_all(&2_u32.to_le_bytes())?;
        writer.write_all(&length.to_le_bytes())?;
        for (kind, chunk) in [(b"JSON", &json), (b"BIN\0", &self.binary)] {
            writer.write_all(&(chunk.len() as u32).to_le_bytes())?;
            writer.write_all(kind)?;
            writer.write_all(chunk)?;
        }
        Ok(())
    }

    /// Appends bytes, a multiple of four, and returns the index of their view.
    fn view(&mut self, bytes: &[u8], stride: Option<usize>, target: u32) -> usize {
        let mut view = json!({
            "buffer": 0, "byteOffset": self.binary.len(), "byteLength": bytes.len(), "target": target,
        });
        if let Some(stride) = stride {
            view["byteStride"] = stride.into();
        }
        self.binary.extend_from_slice(bytes);
        self.views.push(view);
        self.views.len() - 1
    }

    fn accessor(&mut self, accessor: Value) -> usize {
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }
}

/// A color of a screen (sRGB) in the linear space of vertex colors, opaque.
fn linear(color: Rgb) -> [u8; 4] {
    let channel = |value: u8| {
        let share = f64::from(value) / 255.0;
        let linear = if share <= 0.04045 {
            share / 12.92
        } else {
            ((share + 0.055) / 1.055).powf(2.4)
        };
        (255.0 * linear).round() as u8
    };
    let [red, green, blue] = color.map(channel);
    [red, green, blue, 255]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The JSON and the binary chunk of a file.
    fn parsed(model: &Model) -> (Value, Vec<u8>) {
        let mut file = Vec::new();
        model.write(&mut file).unwrap();
        let number = |at: usize| u32::from_le_bytes(file[at..at + 4].try_into().unwrap()) as usize;
        assert_eq!(
            (&file[..4], number(4), number(8)),
            (&b"glTF"[..], 2, file.len())
        );
        let json = number(12);
        assert_eq!((&file[16..20], json % 4), (&b"JSON"[..], 0));
        assert_eq!(&file[24 + json..28 + json], b"BIN\0");
        assert_eq!(number(20 + json), file.len() - 28 - json);
        let header = serde_json::from_slice(&file[20..20 + json]).unwrap();
        (header, file[28 + json..].to_vec())
    }

    #[test]
    fn vertices_colors_and_triangles_are_where_the_header_says() {
        let mesh = TriangleMesh {
            vertices: vec![Vec3::ZERO, Vec3::X, Vec3::new(0.0, 2.0, -3.0)],
            colors: vec![[255, 0, 0]; 3],
            triangles: vec![[0, 1, 2]],
            ..TriangleMesh::default()
        };
        let mut model = Model::default();
        model.add_mesh("street", &mesh);
        let (header, binary) = parsed(&model);
        let accessor = &header["accessors"][0];
        assert_eq!(accessor["max"], json!([1.0, 2.0, 0.0]));
        assert_eq!(&binary[..36], bytemuck::cast_slice::<_, u8>(&mesh.vertices));
        assert_eq!(&binary[36..40], [255, 0, 0, 255]);
        let view = &header["bufferViews"][2];
        assert_eq!(
            (&view["byteOffset"], &view["byteLength"]),
            (&json!(48), &json!(12))
        );
        assert_eq!(binary.len(), 60);
    }

    #[test]
    fn a_ribbon_is_level_and_as_long_as_its_path_also_where_the_vehicle_stands() {
        let path: Vec<Pose3> = [0.0, 4.0, 4.0, 10.0]
            .map(|x| Pose3::translation(x, 0.0, 1.7))
            .to_vec();
        let ribbon = Ribbon {
            name: "path",
            path: &path,
            colors: vec![[0; 3]; 4],
        };
        let mesh = ribbon.mesh();
        let area = |triangle| 0.5 * mesh.scaled_normal(triangle).length();
        let area: f32 = (0..mesh.triangles.len()).map(area).sum();
        assert!((area - 3.0).abs() < 1e-5, "{area}");
        assert!(
            mesh.vertices
                .iter()
                .all(|vertex| (vertex.z - 1.7).abs() < 1e-6)
        );
        assert!(
            mesh.vertices
                .iter()
                .all(|vertex| (vertex.y.abs() - 0.15).abs() < 1e-6)
        );
    }

    #[test]
    fn what_has_no_triangles_is_left_out() {
        let mut model = Model::default();
        model.add_ribbon(&Ribbon {
            name: "path",
            path: &[Pose3::identity()],
            colors: vec![[0; 3]],
        });
        let (header, binary) = parsed(&model);
        assert_eq!(header["meshes"], json!([]));
        assert!(binary.is_empty());
    }
}
