//! `.npy`: an array of one row per point, x, y, z and, if there is a fourth column, intensity; or a structured array
//! with fields of any order and number types.

use std::io::{self, Read};

use npyz::{DType, Endianness, Field, NpyHeader, Order, TypeChar, TypeStr};

use super::point_table::{Column, NumberType, Table};

/// Longest header of an array; those of numbers have about a hundred [bytes].
const LONGEST_HEADER: usize = 1 << 16;

/// Deepest nesting of a header; the time to parse it doubles with each level.
const DEEPEST_HEADER: usize = 8;

/// Reads the header of an array, and checks that reading it needs neither much memory nor much time.
pub fn read_header(reader: &mut impl Read) -> Result<NpyHeader, String> {
    let unreadable = |error: io::Error| format!("is not an npy array: {error}");
    // Magic number, major and minor version, length; with 16 bits in the first version.
    let mut header = vec![0; 10];
    reader.read_exact(&mut header).map_err(unreadable)?;
    if header[6] > 1 {
        header.resize(12, 0);
        reader.read_exact(&mut header[10..]).map_err(unreadable)?;
    }
    let length = header[8..].iter().rev();
    let length = length.fold(0, |length, &byte| length << 8 | usize::from(byte));
    if length > LONGEST_HEADER {
        return Err(format!(
            "is not an npy array: its header of {length} bytes is too long"
        ));
    }
    let start = header.len();
    header.resize(start + length, 0);
    reader
        .read_exact(&mut header[start..])
        .map_err(unreadable)?;
    let (mut depth, mut deepest) = (0_usize, 0);
    for byte in &header[start..] {
        match byte {
            b'{' | b'[' | b'(' => depth += 1,
            b'}' | b']' | b')' => depth = depth.saturating_sub(1),
            _ => {}
        }
        deepest = deepest.max(depth);
    }
    if deepest > DEEPEST_HEADER {
        return Err(format!(
            "is not an npy array: its header is nested {deepest} times"
        ));
    }
    NpyHeader::from_reader(header.as_slice()).map_err(unreadable)
}

/// Reads an array of floats with two dimensions, or a structured array.
pub fn parse(bytes: &[u8]) -> Result<Table<'_>, String> {
    let mut rest = bytes;
    let array = read_header(&mut rest)?;
    match array.dtype() {
        DType::Plain(plain) => of_rows(&array, &plain, rest),
        DType::Record(fields) => {
            let lengths = array.shape().iter();
            let points = lengths.fold(1_usize, |all, &length| all.saturating_mul(length as usize));
            Table::of_file(columns_of(&fields)?, points, rest)
        }
        DType::Array(..) => Err("has arrays as elements; store a row per point".to_owned()),
    }
}

fn of_rows<'a>(array: &NpyHeader, plain: &TypeStr, rest: &'a [u8]) -> Result<Table<'a>, String> {
    let number_type = match number_type(plain) {
        Some(found @ (NumberType::F32 | NumberType::F64)) => found,
        _ => return Err("has numbers that are not float32 or float64".to_owned()),
    };
    let (rows, columns) = match array.shape() {
        &[rows, columns] if columns >= 3 => (rows as usize, columns as usize),
        shape => {
            return Err(format!(
                "has shape {shape:?}, but (points, 3 or more) is needed"
            ));
        }
    };
    let order = array.order();
    let size = number_type.size();
    let names = ["x", "y", "z", "intensity"];
    let column = |(index, name): (usize, &&str)| {
        let (offset, stride) = match order {
            Order::C => (index.saturating_mul(size), columns.saturating_mul(size)),
            Order::Fortran => (index.saturating_mul(rows).saturating_mul(size), size),
        };
        Column {
            name: (*name).to_owned(),
            number_type,
            offset,
            stride,
            is_big_endian: plain.endianness() == Endianness::Big,
        }
    };
    let columns = names[..columns.min(4)].iter().enumerate().map(column);
    Table::of_file(columns.collect(), rows, rest)
}

/// The fields of a structured array that are numbers.
fn columns_of(fields: &[Field]) -> Result<Vec<Column>, String> {
    let mut columns = Vec::new();
    let mut offset = 0_usize;
    for field in fields {
        if let DType::Plain(plain) = &field.dtype
            && let Some(number_type) = number_type(plain)
        {
            columns.push(Column {
                name: field.name.clone(),
                number_type,
                offset,
                stride: 0,
                is_big_endian: plain.endianness() == Endianness::Big,
            });
        }
        let size = field.dtype.num_bytes();
        let size = size.ok_or_else(|| format!("has a field {} of unknown size", field.name))?;
        offset = offset.saturating_add(size);
    }
    for column in &mut columns {
        column.stride = offset;
    }
    Ok(columns)
}

fn number_type(plain: &TypeStr) -> Option<NumberType> {
    let kind = match plain.type_char() {
        TypeChar::Int => "I",
        TypeChar::Uint => "U",
        TypeChar::Float => "F",
        _ => return None,
    };
    NumberType::of(kind, plain.size_field())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_that_would_need_gigabytes_or_years_is_an_error() {
        let message = parse(b"\x93NUMPY\x02\x00\xff\xff\xff\xff{'descr'").unwrap_err();
        assert!(message.contains("is too long"), "{message}");
        let nested = [b"\x93NUMPY\x01\x00\x3e\x00".as_slice(), &[b'{'; 62]].concat();
        let message = parse(&nested).unwrap_err();
        assert!(message.contains("is nested 62 times"), "{message}");
    }
}
