//! `.ply` point clouds: the numbers of the element `vertex`, of any type.

use std::io::{BufRead, Cursor};

use ply_rs::parser::{ParseError, Parser, Reader};
use ply_rs::ply::{DefaultElement, Encoding, Header, PropertyType, ScalarType};

use super::point_table::{Column, NumberType, Table, lines_of, numbers_of_text};

/// Reads the element `vertex`.
pub fn parse(bytes: &[u8]) -> Result<Table<'_>, String> {
    let header = read_header(Cursor::new(bytes))
        .map_err(|error| format!("is not a readable PLY file: {error}"))?;
    let Some(("vertex", element)) = (header.elements.iter().next()).map(|(n, e)| (n.as_str(), e))
    else {
        return Err("does not begin with the element `vertex`".to_owned());
    };
    let points = element.count;
    if points > bytes.len() {
        return Err(format!("claims {points} points in {} bytes", bytes.len()));
    }
    let is_text = header.encoding == Encoding::Ascii;
    let mut columns = Vec::new();
    let mut step = 0;
    for (name, property) in &element.properties {
        let PropertyType::Scalar(scalar) = &property.data_type else {
            return Err(format!(
                "has lists `{name}` among the numbers of its vertices; leave them out"
            ));
        };
        let number_type = if is_text {
            NumberType::F64
        } else {
            number_type(scalar)
        };
        columns.push(Column {
            name: name.clone(),
            number_type,
            offset: step,
            stride: 0,
            is_big_endian: header.encoding == Encoding::BinaryBigEndian,
        });
        step += number_type.size();
    }
    for column in &mut columns {
        column.stride = step;
    }
    let data = data_of(bytes).ok_or("has no line `end_header`")?;
    if is_text {
        let numbers = numbers_of_text(lines_of(data)?.take(points), columns.len(), points)?;
        return Table::of_file(columns, points, numbers);
    }
    Table::of_file(columns, points, data)
}

/// Whether a file is a mesh, by its header.
pub fn has_faces(file: impl BufRead) -> bool {
    read_header(file).is_ok_and(|header| {
        let faces = ["face", "tristrips"].map(|name| header.elements.get(name));
        (faces.into_iter().flatten()).any(|element| element.count > 0)
    })
}

fn read_header(file: impl BufRead) -> Result<Header, ParseError> {
    Parser::<DefaultElement>::new().read_header(&mut Reader::new(file))
}

/// What follows the header.
fn data_of(bytes: &[u8]) -> Option<&[u8]> {
    const END: &[u8] = b"\nend_header";
    let end = bytes.windows(END.len()).position(|window| window == END)?;
    let rest = &bytes[end + END.len()..];
    let line = rest.iter().position(|&byte| byte == b'\n')?;
    Some(&rest[line + 1..])
}

fn number_type(scalar: &ScalarType) -> NumberType {
    match scalar {
        ScalarType::Char => NumberType::I8,
        ScalarType::UChar => NumberType::U8,
        ScalarType::Short => NumberType::I16,
        ScalarType::UShort => NumberType::U16,
        ScalarType::Int => NumberType::I32,
        ScalarType::UInt => NumberType::U32,
        ScalarType::Float => NumberType::F32,
        ScalarType::Double => NumberType::F64,
    }
}
