//! PLY files of arbitrary elements, properties and rows.

use std::fmt::Write as _;

use arbtest::arbitrary::{Result, Unstructured};

use super::files::{number, rarely};
use super::mutation::EXTREMES;

/// Where the numbers of a file are.
#[derive(Clone, Copy, PartialEq)]
pub enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

const TYPES: &[&str] = &[
    "char", "uchar", "short", "ushort", "int", "uint", "float", "double",
];

const ALIASES: &[&str] = &[
    "int8", "uint8", "int16", "uint16", "int32", "uint32", "float32", "float64",
];

const INTEGERS: &[&str] = &["int", "uint", "ushort", "short", "uchar", "char"];

const OTHER_PROPERTIES: &[&str] = &[
    "intensity",
    "alpha",
    "X",
    "nx",
    "quality",
    "s",
    "vertex_index",
];

struct Property {
    name: &'static str,
    /// Type of the length, for a list.
    list: Option<&'static str>,
    kind: &'static str,
}

struct Element {
    name: &'static str,
    count: usize,
    properties: Vec<Property>,
}

/// A text file.
pub fn ascii(u: &mut Unstructured) -> Result<Vec<u8>> {
    file(u, Encoding::Ascii)
}

/// A binary file of either order of bytes.
pub fn binary(u: &mut Unstructured) -> Result<Vec<u8>> {
    let order = [Encoding::LittleEndian, Encoding::BigEndian];
    let order = *u.choose(&order)?;
    file(u, order)
}

/// Any file.
pub fn any(u: &mut Unstructured) -> Result<Vec<u8>> {
    if u.arbitrary()? { ascii(u) } else { binary(u) }
}

fn file(u: &mut Unstructured, encoding: Encoding) -> Result<Vec<u8>> {
    let vertices = u.int_in_range(1..=12)?;
    let mut elements = vec![vertex(u, vertices)?, face(u)?];
    if rarely(u, 32)? {
        let other = other_element(u)?;
        let place = u.choose_index(elements.len() + 1)?;
        elements.insert(place, other);
    }
    if rarely(u, 8)? {
        elements.reverse();
    }
    let mut bytes = header(u, encoding, &elements)?.into_bytes();
    for element in &elements {
        for _ in 0..element.count {
            for property in &element.properties {
                value(u, encoding, property, vertices, &mut bytes)?;
            }
            if encoding == Encoding::Ascii {
                bytes.push(b'\n');
            }
        }
    }
    Ok(bytes)
}

fn header(u: &mut Unstructured, encoding: Encoding, elements: &[Element]) -> Result<String> {
    let encoding = match encoding {
        Encoding::Ascii => "ascii",
        Encoding::LittleEndian => "binary_little_endian",
        Encoding::BigEndian => "binary_big_endian",
    };
    let mut text = format!("ply\nformat {encoding} 1.0\n");
    for _ in 0..u.int_in_range(0..=3)? {
        let key = u.choose(&["fpmcl map_from_lidar", "fpmcl world_from_map", "of a tool"])?;
        let (x, y) = (number(u)?, number(u)?);
        let rotation = u.choose(&["0 0 0 1", "0 0 0 -1", "0.6 0 0 0.8", "0 0 0 0", "1 1 1 1"])?;
        let _ = writeln!(text, "comment {key} {x} {y} 0 {rotation}");
    }
    for element in elements {
        let count = if rarely(u, 2)? {
            (*u.choose(EXTREMES)?).to_owned()
        } else {
            element.count.to_string()
        };
        let _ = writeln!(text, "element {} {count}", element.name);
        for Property { name, list, kind } in &element.properties {
            let list = list.map_or(String::new(), |length| format!("list {length} "));
            let _ = writeln!(text, "property {list}{kind} {name}");
        }
    }
    Ok(text + "end_header\n")
}

fn scalar(u: &mut Unstructured, name: &'static str, usual: &'static str) -> Result<Property> {
    let kind = match u.arbitrary::<u8>()? {
        254.. => *u.choose(TYPES)?,
        252.. => *u.choose(ALIASES)?,
        _ => usual,
    };
    let list = rarely(u, 1)?.then_some("uchar");
    Ok(Property { name, list, kind })
}

fn vertex(u: &mut Unstructured, count: usize) -> Result<Element> {
    let mut properties = Vec::new();
    let mut add = |u: &mut Unstructured, names: &[&'static str], kind| -> Result<()> {
        for name in names {
            properties.push(scalar(u, name, kind)?);
        }
        Ok(())
    };
    let position = *u.choose(&["float", "double"])?;
    add(u, &["x", "y", "z"], position)?;
    if u.arbitrary()? {
        add(u, &["nx", "ny", "nz"], "float")?;
    }
    if u.arbitrary()? {
        let color = *u.choose(&["uchar", "float"])?;
        add(u, &["red", "green", "blue"], color)?;
    }
    if rarely(u, 32)? {
        let name = *u.choose(OTHER_PROPERTIES)?;
        add(u, &[name], "float")?;
    }
    Ok(Element {
        name: "vertex",
        count,
        properties,
    })
}

fn face(u: &mut Unstructured) -> Result<Element> {
    let mut properties = vec![Property {
        name: u.choose(&["vertex_indices", "vertex_index"])?,
        list: Some(if rarely(u, 16)? {
            *u.choose(INTEGERS)?
        } else {
            "uchar"
        }),
        kind: if rarely(u, 64)? {
            u.choose(INTEGERS)?
        } else {
            "int"
        },
    }];
    if rarely(u, 16)? {
        let name = *u.choose(OTHER_PROPERTIES)?;
        properties.push(scalar(u, name, "float")?);
    }
    Ok(Element {
        name: "face",
        count: u.int_in_range(1..=8)?,
        properties,
    })
}

fn other_element(u: &mut Unstructured) -> Result<Element> {
    let mut properties = Vec::new();
    for _ in 0..u.int_in_range(0..=2)? {
        let name = *u.choose(OTHER_PROPERTIES)?;
        properties.push(Property {
            name,
            list: u.arbitrary::<bool>()?.then_some("uchar"),
            kind: u.choose(TYPES)?,
        });
    }
    Ok(Element {
        name: u.choose(&["edge", "camera", "vertex", "face"])?,
        count: u.int_in_range(0..=4)?,
        properties,
    })
}

fn value(
    u: &mut Unstructured,
    encoding: Encoding,
    property: &Property,
    vertices: usize,
    bytes: &mut Vec<u8>,
) -> Result<()> {
    let Some(length_kind) = property.list else {
        let number = number(u)?;
        put(encoding, property.kind, number, bytes);
        return Ok(());
    };
    let length = match u.arbitrary::<u8>()? {
        254.. => u.int_in_range(0..=9)?,
        220.. => 4,
        _ => 3,
    };
    put(encoding, length_kind, f64::from(length), bytes);
    for _ in 0..length {
        let index = u.arbitrary::<u16>()? as usize % vertices.max(1);
        put(encoding, property.kind, index as f64, bytes);
    }
    Ok(())
}

fn put(encoding: Encoding, kind: &str, number: f64, bytes: &mut Vec<u8>) {
    if encoding == Encoding::Ascii {
        let text = match kind {
            "float" | "double" | "float32" | "float64" => format!("{number} "),
            _ => format!("{} ", number as i8),
        };
        bytes.extend(text.bytes());
        return;
    }
    let start = bytes.len();
    match kind {
        "char" | "int8" => bytes.extend((number as i8).to_le_bytes()),
        "uchar" | "uint8" => bytes.extend((number as u8).to_le_bytes()),
        "short" | "int16" => bytes.extend((number as i16).to_le_bytes()),
        "ushort" | "uint16" => bytes.extend((number as u16).to_le_bytes()),
        "int" | "int32" => bytes.extend((number as i32).to_le_bytes()),
        "uint" | "uint32" => bytes.extend((number as u32).to_le_bytes()),
        "float" | "float32" => bytes.extend((number as f32).to_le_bytes()),
        _ => bytes.extend(number.to_le_bytes()),
    }
    if encoding == Encoding::BigEndian {
        bytes[start..].reverse();
    }
}
