//! STL files, binary and text: triangles with corners of their own, which are merged where they are equal.
//!
//! ```text
//! binary   80 bytes, number of triangles u32, then per triangle normal 3 f32, corners 9 f32, 2 bytes
//! text     solid name, then per triangle: facet normal .. outer loop vertex x y z (three) endloop endfacet
//! ```

use std::collections::HashMap;

use glam::DVec3;

use super::mesh_error::MeshFileProblem;

const HEADER_BYTES: usize = 84;
const TRIANGLE_BYTES: usize = 50;

/// Reads vertices [m] and triangles.
pub(crate) fn parse(bytes: &[u8]) -> Result<(Vec<DVec3>, Vec<[u32; 3]>), MeshFileProblem> {
    let corners = match binary(bytes) {
        // The header of a binary file may begin with `solid` too.
        Some(corners) => corners,
        None if bytes.trim_ascii_start().starts_with(b"solid") => text(bytes)?,
        None => return Err(MeshFileProblem::NotStl),
    };
    let mut vertices = Vec::new();
    let mut index_of: HashMap<[u32; 3], u32> = HashMap::with_capacity(corners.len() / 4);
    let indices: Vec<u32> = (corners.iter())
        .map(|corner| {
            // Without the sign of zero.
            let bits = corner.map(|x| (x + 0.0).to_bits());
            *index_of.entry(bits).or_insert_with(|| {
                vertices.push(DVec3::from(corner.map(f64::from)));
                vertices.len() as u32 - 1
            })
        })
        .collect();
    Ok((vertices, indices.as_chunks().0.to_vec()))
}

/// Corners of a binary file; `None` if its size is not that of its number of triangles.
fn binary(bytes: &[u8]) -> Option<Vec<[f32; 3]>> {
    let count = u32::from_le_bytes(*bytes.get(80..)?.first_chunk()?) as usize;
    let triangles = &bytes[HEADER_BYTES..];
    if triangles.len() != count.checked_mul(TRIANGLE_BYTES)? {
        return None;
    }
    let number = |bytes: &[u8; 4]| f32::from_le_bytes(*bytes);
    let corners = |triangle: &[u8]| {
        let (numbers, _) = triangle[12..48].as_chunks::<4>();
        [0, 3, 6].map(|first| [0, 1, 2].map(|axis| number(&numbers[first + axis])))
    };
    Some(
        triangles
            .chunks_exact(TRIANGLE_BYTES)
            .flat_map(corners)
            .collect(),
    )
}

/// Corners of a text file.
fn text(bytes: &[u8]) -> Result<Vec<[f32; 3]>, MeshFileProblem> {
    let mut corners = Vec::new();
    for (index, bytes) in bytes.split(|&byte| byte == b'\n').enumerate() {
        let text = String::from_utf8_lossy(bytes);
        let mut words = text.split_whitespace();
        if words.next() != Some("vertex") {
            continue;
        }
        let numbers: Vec<f32> = words.filter_map(|word| word.parse().ok()).collect();
        let corner = (numbers.try_into()).map_err(|_numbers| MeshFileProblem::BadLine {
            line: index + 1,
            text: text.trim().chars().take(60).collect(),
            expected: "a vertex with the numbers x, y and z",
        })?;
        corners.push(corner);
    }
    Ok(corners)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two triangles with a common edge.
    const SQUARE: [[f32; 3]; 6] = [
        [0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0],
        [1.0, 1.0, 0.25],
        [-0.0, 0.0, 0.0],
        [1.0, 1.0, 0.25],
        [0.0, 1.0, 0.0],
    ];

    fn binary_square(header: &[u8]) -> Vec<u8> {
        let mut bytes = header.to_vec();
        bytes.resize(80, b' ');
        bytes.extend(2_u32.to_le_bytes());
        for corners in SQUARE.chunks(3) {
            bytes.extend([0; 12]);
            bytes.extend(corners.as_flattened().iter().flat_map(|x| x.to_le_bytes()));
            bytes.extend([0; 2]);
        }
        bytes
    }

    fn text_square() -> String {
        let facets = SQUARE.chunks(3).map(|corners| {
            let corner = |[x, y, z]: &[f32; 3]| format!("vertex {x} {y:e} {z}\r\n");
            let corners: String = corners.iter().map(corner).collect();
            format!("facet normal 0 0 1\nouter loop\n{corners}endloop\nendfacet\n")
        });
        format!("solid a square\n{}endsolid\n", facets.collect::<String>())
    }

    #[test]
    fn text_and_binary_files_have_the_same_merged_vertices_in_the_order_of_the_file() {
        for bytes in [
            binary_square(b"solid, by a careless exporter"),
            binary_square(b""),
            text_square().into_bytes(),
        ] {
            let (vertices, triangles) = parse(&bytes).unwrap();
            assert_eq!(vertices.len(), 4);
            assert_eq!(vertices[2], DVec3::new(1.0, 1.0, 0.25));
            assert_eq!(triangles, [[0, 1, 2], [0, 2, 3]]);
        }
    }

    #[test]
    fn truncated_files_and_other_bytes_are_errors() {
        let whole = binary_square(b"");
        for end in [0, 3, 83, 84, whole.len() - 1] {
            assert!(parse(&whole[..end]).is_err(), "{end}");
        }
        let damaged = text_square().replacen("vertex 1", "vertex one", 1);
        let message = parse(damaged.as_bytes()).unwrap_err().to_string();
        assert!(message.contains("line 5"), "{message}");
    }
}
