//! `.ply` point clouds: x, y, z of any number type, and the intensity if there is one.

use std::io::Cursor;

use ply_rs::parser::{Parser, Reader};
use ply_rs::ply::PropertyType;

use crate::geometry::PlyVertex;
use crate::lidar::Scan;

/// Reads the element `vertex`.
pub fn parse(bytes: &[u8]) -> Result<Scan, String> {
    let mut reader = Reader::new(Cursor::new(bytes));
    let parser = Parser::<PlyVertex>::new();
    let unreadable = |error: &dyn std::fmt::Display| format!("is not a readable PLY file: {error}");
    let header = parser
        .read_header(&mut reader)
        .map_err(|e| unreadable(&e))?;
    let Some(("vertex", element)) = (header.elements.iter().next()).map(|(n, e)| (n.as_str(), e))
    else {
        return Err("does not begin with the element `vertex`".to_owned());
    };
    if element.count > bytes.len() {
        return Err(format!(
            "claims {} points in {} bytes",
            element.count,
            bytes.len()
        ));
    }
    let is_number = |names: [&str; 2]| {
        let found = names.iter().find_map(|name| element.properties.get(*name));
        found.is_some_and(|property| matches!(property.data_type, PropertyType::Scalar(_)))
    };
    if ![["x", "X"], ["y", "Y"], ["z", "Z"]]
        .into_iter()
        .all(is_number)
    {
        return Err("has no numbers x, y and z of its vertices".to_owned());
    }
    let rows = (parser.read_payload_for_element(&mut reader, element, &header))
        .map_err(|e| unreadable(&e))?;
    let (points, intensities) = rows
        .iter()
        .map(|row| (row.position.as_vec3(), row.intensity))
        .unzip();
    Ok(Scan {
        points,
        intensities,
        ..Scan::default()
    })
}
