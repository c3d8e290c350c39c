//! `.pcd` of the Point Cloud Library, version 0.7: ascii, binary and binary_compressed, with any order
//! and types of the fields.
//!
//! Format: <https://pointclouds.org/documentation/tutorials/pcd_file_format.html>

use super::point_table::{Column, NumberType, Table, lines_of, numbers_of_text};

/// A field of the header.
struct Field {
    name: String,
    number_type: NumberType,
    count: usize,
}

/// Reads a file.
pub fn parse(bytes: &[u8]) -> Result<Table<'_>, String> {
    let (mut names, mut sizes, mut types, mut counts) = (vec![], vec![], vec![], vec![]);
    let (mut points, mut data) = (None, None);
    let mut rest = bytes;
    while data.is_none() {
        let end = rest.iter().position(|&byte| byte == b'\n');
        let Some(end) = end else {
            return Err("is not a PCD file: its header has no line DATA".to_owned());
        };
        let line = String::from_utf8_lossy(&rest[..end]);
        rest = &rest[end + 1..];
        let mut words = line.split_whitespace().map(str::to_owned);
        let key = words.next().unwrap_or_default();
        let values: Vec<String> = words.collect();
        match key.as_str() {
            "FIELDS" | "COLUMNS" => names = values,
            "SIZE" => sizes = values,
            "TYPE" => types = values,
            "COUNT" => counts = values,
            "POINTS" => points = values.first().and_then(|word| word.parse::<usize>().ok()),
            "DATA" => data = values.first().cloned(),
            _ => {}
        }
    }
    let points = points.ok_or("is not a PCD file: its header has no number of POINTS")?;
    if names.len() != sizes.len() || names.len() != types.len() {
        return Err("is damaged: FIELDS, SIZE and TYPE have different lengths".to_owned());
    }
    let fields: Vec<Field> = (0..names.len())
        .map(|index| {
            let (size, kind) = (sizes[index].as_str(), types[index].as_str());
            let count = match counts.get(index) {
                Some(word) => word.parse().ok().filter(|&count| count <= 1 << 16),
                None => Some(1),
            };
            Ok(Field {
                name: names[index].clone(),
                number_type: (size.parse().ok())
                    .and_then(|bytes| NumberType::of(kind, bytes))
                    .ok_or_else(|| format!("has a field of type {kind} and size {size}"))?,
                count: count.ok_or("is damaged: a COUNT is not a number")?,
            })
        })
        .collect::<Result<_, String>>()?;
    match data.as_deref() {
        Some("ascii") => ascii(&fields, rest, points),
        Some("binary") => Table::of_file(columns(&fields, None), points, rest),
        Some("binary_compressed") => {
            let whole = decompressed(rest, &fields, points)?;
            Table::of_file(columns(&fields, Some(points)), points, whole)
        }
        other => Err(format!(
            "has DATA {}, which is unknown",
            other.unwrap_or("")
        )),
    }
}

/// Places of the fields: point after point, or, with the number of points, field after field.
fn columns(fields: &[Field], points: Option<usize>) -> Vec<Column> {
    let bytes_of = |field: &Field| field.number_type.size() * field.count;
    let step: usize = fields.iter().map(bytes_of).sum();
    let mut start = 0_usize;
    (fields.iter())
        .map(|field| {
            let offset = start;
            start = start.saturating_add(bytes_of(field).saturating_mul(points.unwrap_or(1)));
            Column {
                name: field.name.clone(),
                number_type: field.number_type,
                offset,
                stride: if points.is_some() {
                    bytes_of(field)
                } else {
                    step
                },
                is_big_endian: false,
            }
        })
        .filter(|column| column.stride > 0)
        .collect()
}

/// Reads one line of numbers per point.
fn ascii<'a>(fields: &[Field], text: &'a [u8], points: usize) -> Result<Table<'a>, String> {
    let numbers = fields.iter().map(|field| field.count).sum();
    let bytes = numbers_of_text(lines_of(text)?, numbers, points)?;
    let as_f64 = |field: &Field| Field {
        name: field.name.clone(),
        number_type: NumberType::F64,
        count: field.count,
    };
    let fields: Vec<Field> = fields.iter().map(as_f64).collect();
    Table::of_file(columns(&fields, None), points, bytes)
}

/// Decompresses the data: its size, the size of what it contains, and both as LZF.
fn decompressed(bytes: &[u8], fields: &[Field], points: usize) -> Result<Vec<u8>, String> {
    let damaged = || "has damaged compressed data; copy it again".to_owned();
    let size_at = |offset: usize| {
        let size = bytes.get(offset..)?.first_chunk().copied()?;
        Some(u32::from_le_bytes(size) as usize)
    };
    let (compressed, size) = size_at(0).zip(size_at(4)).ok_or_else(damaged)?;
    let step: usize = fields.iter().map(|f| f.number_type.size() * f.count).sum();
    if points.saturating_mul(step) != size {
        return Err(damaged());
    }
    let data = bytes.get(8..8 + compressed).ok_or_else(damaged)?;
    decompress_lzf(data, size).ok_or_else(damaged)
}

/// Decompresses LZF: a control byte c < 32 is followed by c + 1 literal bytes; another is a reference of
/// c / 32 + 2 bytes (with one more byte of length if c / 32 = 7) backwards to (c mod 32) · 256 + next
/// byte + 1. `None` if the data is damaged or its size is not `size`.
fn decompress_lzf(data: &[u8], size: usize) -> Option<Vec<u8>> {
    let mut out: Vec<u8> = Vec::new();
    let mut bytes = data.iter().copied();
    while let Some(control) = bytes.next() {
        let control = usize::from(control);
        if control < 32 {
            let literal: Vec<u8> = bytes.by_ref().take(control + 1).collect();
            if literal.len() != control + 1 {
                return None;
            }
            out.extend(literal);
        } else {
            let mut length = (control >> 5) + 2;
            if control >> 5 == 7 {
                length += usize::from(bytes.next()?);
            }
            let back = ((control & 31) << 8) + usize::from(bytes.next()?) + 1;
            let start = out.len().checked_sub(back)?;
            for index in start..start + length {
                out.push(out[index]);
            }
        }
        if out.len() > size {
            return None;
        }
    }
    (out.len() == size).then_some(out)
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::*;
    use crate::lidar::Scan;

    fn read(bytes: &[u8]) -> Result<Scan, String> {
        Ok(parse(bytes)?.points()?.0)
    }

    const HEADER: &str = "# .PCD v0.7\nVERSION 0.7\nFIELDS intensity ring x y z\nSIZE 1 2 8 4 4\n\
        TYPE U U F F F\nCOUNT 1 1 1 1 1\nWIDTH 2\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 2\n";

    /// Point after point.
    fn binary() -> Vec<u8> {
        let mut bytes = Vec::new();
        for (intensity, ring, x, y, z) in [
            (7_u8, 3_u16, 1.5_f64, -2.0_f32, 0.25_f32),
            (9, 4, 4.0, 5.0, 6.0),
        ] {
            bytes.push(intensity);
            bytes.extend(ring.to_le_bytes());
            bytes.extend(x.to_le_bytes());
            bytes.extend(y.to_le_bytes());
            bytes.extend(z.to_le_bytes());
        }
        bytes
    }

    fn file(kind: &str, data: &[u8]) -> Vec<u8> {
        [HEADER.as_bytes(), b"DATA ", kind.as_bytes(), b"\n", data].concat()
    }

    #[test]
    fn all_three_encodings_have_the_same_points() {
        let expected = Scan {
            points: vec![Vec3::new(1.5, -2.0, 0.25), Vec3::new(4.0, 5.0, 6.0)],
            intensities: vec![7.0, 9.0],
            rings: vec![3, 4],
            ..Scan::default()
        };
        let ascii = b"7 3 1.5 -2 0.25\n9 4 4 5 6\n";
        assert_eq!(read(&file("ascii", ascii)).unwrap(), expected);
        assert_eq!(read(&file("binary", &binary())).unwrap(), expected);

        // Field after field, as literals of at most 32 bytes.
        let rows = binary();
        let fields = [(0, 1), (1, 2), (3, 8), (11, 4), (15, 4)];
        let by_field: Vec<u8> = (fields.iter())
            .flat_map(|&(start, size)| [0, 19].map(|row| rows[row + start..][..size].to_vec()))
            .flatten()
            .collect();
        let mut lzf = Vec::new();
        for literal in by_field.chunks(32) {
            lzf.push(literal.len() as u8 - 1);
            lzf.extend(literal);
        }
        let sizes = [lzf.len() as u32, by_field.len() as u32].map(u32::to_le_bytes);
        let data = [sizes.concat(), lzf].concat();
        assert_eq!(read(&file("binary_compressed", &data)).unwrap(), expected);
    }

    #[test]
    fn lzf_repeats_what_is_before() {
        // Literal "ab", then six bytes from two before.
        let data = [1, b'a', b'b', 0b1000_0000, 1];
        assert_eq!(decompress_lzf(&data, 8).unwrap(), b"abababab");
        assert_eq!(decompress_lzf(&data, 7), None);
        assert_eq!(decompress_lzf(&[0b1000_0000, 1], 6), None);
        assert_eq!(decompress_lzf(&[5, b'a'], 6), None);
    }

    #[test]
    fn truncated_and_damaged_files_are_errors() {
        let whole = file("binary", &binary());
        for end in 0..whole.len() {
            assert!(read(&whole[..end]).is_err(), "{end} bytes");
        }
        for (from, to) in [
            ("POINTS 2", "POINTS 99999999999"),
            ("SIZE 1", "SIZE 3"),
            ("COUNT 1", "COUNT x"),
            (" z\n", " height\n"),
        ] {
            let text = HEADER.replace(from, to);
            let bytes = [text.as_bytes(), b"DATA binary\n", &binary()].concat();
            assert!(read(&bytes).is_err(), "{to}");
        }
        let claimed = [u32::MAX.to_le_bytes(), 38_u32.to_le_bytes()].concat();
        assert!(read(&file("binary_compressed", &claimed)).is_err());
    }
}
