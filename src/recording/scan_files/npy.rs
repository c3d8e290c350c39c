//! `.npy`: an array of one row per point, x, y, z and, if there is a fourth column, intensity.

use npyz::{DType, NpyFile, Order, TypeChar};

use super::point_table::{Column, NumberType, scan_of};
use crate::lidar::Scan;

/// Longest header of an array; those of numbers have about a hundred [bytes].
const LONGEST_HEADER: u32 = 1 << 16;

/// Whether the first bytes of an array claim a header that no array of numbers has, and for which memory
/// is not to be allocated.
pub fn has_endless_header(start: &[u8]) -> bool {
    // Magic number, major and minor version, length; with 16 bits in the first version.
    let length = start.get(8..).and_then(<[u8]>::first_chunk);
    let has_long_length = start.get(6).is_some_and(|&major| major > 1);
    has_long_length && length.is_some_and(|&l| u32::from_le_bytes(l) > LONGEST_HEADER)
}

/// Reads an array of floats with two dimensions.
pub fn parse(bytes: &[u8]) -> Result<Scan, String> {
    if has_endless_header(bytes) {
        return Err("is no npy array: its header has no end".to_owned());
    }
    let mut rest = bytes;
    let array = NpyFile::new(&mut rest).map_err(|error| format!("is no npy array: {error}"))?;
    let number_type = match array.dtype() {
        DType::Plain(plain) => match (plain.type_char(), plain.size_field()) {
            (TypeChar::Float, 4) => NumberType::F32,
            (TypeChar::Float, 8) => NumberType::F64,
            _ => return Err("has numbers that are not float32 or float64".to_owned()),
        },
        DType::Array(..) | DType::Record(_) => {
            return Err("is a structured array; store columns x, y, z, intensity".to_owned());
        }
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
        }
    };
    let columns: Vec<Column> = names[..columns.min(4)]
        .iter()
        .enumerate()
        .map(column)
        .collect();
    drop(array);
    scan_of(&columns, rest, rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_for_a_header_of_gigabytes_is_not_allocated() {
        let message = parse(b"\x93NUMPY\x02\x00\xff\xff\xff\xff{'descr'").unwrap_err();
        assert!(message.contains("its header has no end"), "{message}");
    }
}
