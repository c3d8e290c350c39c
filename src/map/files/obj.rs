//! Wavefront OBJ files: vertices and polygons; everything else is skipped.
//!
//! ```text
//! v x y z [w | r g b]
//! f v[/vt[/vn]] ...        counted from 1, or backwards from the last vertex with a minus
//! ```
//!
//! Polygons become fans of triangles; groups and objects are joined.

use glam::DVec3;

use super::mesh_error::MeshFileProblem;
use super::mesh_polygons::{fan, require_vertices};

/// Reads vertices [m] and triangles.
pub(crate) fn parse(bytes: &[u8]) -> Result<(Vec<DVec3>, Vec<[u32; 3]>), MeshFileProblem> {
    let mut vertices: Vec<DVec3> = Vec::new();
    let mut triangles = Vec::new();
    let mut corners: Vec<u32> = Vec::new();
    for (index, bytes) in bytes.split(|&byte| byte == b'\n').enumerate() {
        let text = String::from_utf8_lossy(bytes);
        let mut words = text.split_whitespace();
        let bad = |expected| MeshFileProblem::BadLine {
            line: index + 1,
            text: text.trim().chars().take(60).collect(),
            expected,
        };
        match words.next() {
            Some("v") => {
                let mut number = || words.next()?.parse::<f64>().ok();
                let vertex = || Some(DVec3::new(number()?, number()?, number()?));
                let bad = || bad("a vertex with the numbers x, y and z");
                vertices.push({ vertex }().ok_or_else(bad)?);
            }
            Some("f") => {
                corners.clear();
                for word in words {
                    let number: i64 = (word.split('/').next())
                        .and_then(|number| number.parse().ok())
                        .ok_or_else(|| bad("a face of whole numbers, such as `f 1 2 3` or `f 1/1/1 2/2/2 3/3/3`"))?;
                    let from_start = match number {
                        0.. => number - 1,
                        _ => vertices.len() as i64 + number,
                    };
                    corners.push(u32::try_from(from_start).unwrap_or(u32::MAX));
                }
                triangles.extend(fan(&corners));
            }
            _ => {}
        }
    }
    require_vertices(&triangles, vertices.len())?;
    Ok((vertices, triangles))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polygons_groups_negative_indices_and_the_three_forms_of_a_corner_are_read() {
        let (vertices, triangles) = parse(
            b"# a comment\nmtllib a.mtl\no house\nv 0 0 0 1\nv 1 0 0\r\nv 1 1 0 0.5 0.5 0.5\nv 0 1 0\n\
              vt 0 0\nvn 0 0 1\ng wall\ns off\nusemtl red\nf 1 2/1 3/1/1 4//1\nf -4 -3 -2\nl 1 2\n",
        )
        .unwrap();
        assert_eq!(vertices[2], DVec3::new(1.0, 1.0, 0.0));
        assert_eq!(triangles, [[0, 1, 2], [0, 2, 3], [0, 1, 2]]);
    }

    #[test]
    fn a_damaged_line_is_named_and_a_missing_vertex_is_an_error() {
        for (text, part) in [
            ("v 0 0 0\nv 1 x 0\n", "line 2 is `v 1 x 0`"),
            ("v 0 0 0\nf 1 1 a\n", "line 2"),
            ("v 0 0 0\nf 1 1 2\n", "vertex 1, but there are 1"),
            ("v 0 0 0\nf 0 1 1\n", "vertex -1"),
            ("v 0 0 0\nf -2 1 1\n", "vertex -1"),
        ] {
            let message = parse(text.as_bytes()).unwrap_err().to_string();
            assert!(message.contains(part), "{message}");
        }
    }
}
