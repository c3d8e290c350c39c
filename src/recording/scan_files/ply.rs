//! `.ply` point clouds: x, y, z of any number type, and the intensity if there is one.

use std::io::Cursor;

use glam::Vec3;
use ply_rs::parser::{Parser, Reader};
use ply_rs::ply::{DefaultElement, Property};

use crate::lidar::Scan;

/// Reads the element `vertex`.
pub fn parse(bytes: &[u8]) -> Result<Scan, String> {
    let mut reader = Reader::new(Cursor::new(bytes));
    let parser = Parser::<DefaultElement>::new();
    let unreadable = |error: &dyn std::fmt::Display| format!("is no readable PLY file: {error}");
    let header = parser
        .read_header(&mut reader)
        .map_err(|e| unreadable(&e))?;
    let Some((name, element)) = header
        .elements
        .iter()
        .next()
        .filter(|(name, _)| *name == "vertex")
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
    let rows = (parser.read_payload_for_element(&mut reader, element, &header))
        .map_err(|e| unreadable(&e))?;
    debug_assert_eq!(name, "vertex");
    let named = |names: &[&str]| {
        let is_named = |key: &&String| names.iter().any(|name| key.eq_ignore_ascii_case(name));
        element.properties.keys().find(is_named).cloned()
    };
    let [Some(x), Some(y), Some(z)] = [["x"], ["y"], ["z"]].map(|name| named(&name)) else {
        return Err("has no properties x, y and z of its vertices".to_owned());
    };
    let intensity = named(&["intensity", "scalar_intensity", "reflectance", "remission"]);
    let (points, intensities) = (rows.iter())
        .map(|row| {
            let number = |name: &String| row.get(name).map_or(f32::NAN, number);
            let point = Vec3::new(number(&x), number(&y), number(&z));
            (point, intensity.as_ref().map_or(0.0, number))
        })
        .unzip();
    Ok(Scan {
        points,
        intensities,
    })
}

/// A property as a number; lists are none.
fn number(property: &Property) -> f32 {
    match *property {
        Property::Char(value) => f32::from(value),
        Property::UChar(value) => f32::from(value),
        Property::Short(value) => f32::from(value),
        Property::UShort(value) => f32::from(value),
        Property::Int(value) => value as f32,
        Property::UInt(value) => value as f32,
        Property::Float(value) => value,
        Property::Double(value) => value as f32,
        _ => f32::NAN,
    }
}
