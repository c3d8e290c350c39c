//! Scans in formats with a header.

use arbtest::arbitrary::{Result, Unstructured};

use super::files::{number, rarely};
use super::npz::npy;

/// Types of the fields: letter, size and whether it is a float.
const TYPES: &[(&str, usize)] = &[("F", 4), ("F", 8), ("U", 1), ("U", 2), ("I", 4), ("I", 8)];

const OTHER_FIELDS: &[&str] = &["intensity", "ring", "rgb", "X", "timestamp", "_"];

/// A file of the Point Cloud Library in any encoding.
pub fn pcd(u: &mut Unstructured) -> Result<Vec<u8>> {
    let points = u.int_in_range(1..=12)?;
    let mut names = vec!["x", "y", "z"];
    for _ in 0..u.int_in_range(0..=2)? {
        names.push(u.choose(OTHER_FIELDS)?);
    }
    let (mut sizes, mut types, mut counts) = (String::new(), String::new(), String::new());
    let mut fields = Vec::new();
    for _ in &names {
        let (letter, size) = if rarely(u, 64)? {
            *u.choose(TYPES)?
        } else {
            TYPES[0]
        };
        let count = if rarely(u, 4)? { 3 } else { 1 };
        sizes += &format!(" {size}");
        types += &format!(" {letter}");
        counts += &format!(" {count}");
        fields.push((letter, size, count));
    }
    let kind = *u.choose(&["binary", "binary_compressed", "ascii"])?;
    let mut bytes = format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS {}\nSIZE{sizes}\nTYPE{types}\nCOUNT{counts}\nWIDTH {points}\n\
         HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {kind}\n",
        names.join(" ")
    )
    .into_bytes();
    let mut data = Vec::new();
    for _ in 0..points {
        for &(letter, size, count) in &fields {
            for _ in 0..count {
                let number = number(u)?;
                match (kind, letter, size) {
                    ("ascii", ..) => data.extend(format!("{number} ").bytes()),
                    (_, "F", 4) => data.extend((number as f32).to_le_bytes()),
                    (_, "F", _) => data.extend(number.to_le_bytes()),
                    (_, _, size) => data.extend(&(number as i64).to_le_bytes()[..size]),
                }
            }
        }
        if kind == "ascii" {
            data.push(b'\n');
        }
    }
    if kind == "binary_compressed" {
        data = lzf(u, &data)?;
    }
    bytes.extend(data);
    Ok(bytes)
}

/// Literals, as any data can be stored, and a reference where the randomness has one.
fn lzf(u: &mut Unstructured, data: &[u8]) -> Result<Vec<u8>> {
    let mut compressed = Vec::new();
    for literal in data.chunks(32) {
        compressed.push(literal.len() as u8 - 1);
        compressed.extend(literal);
    }
    if rarely(u, 16)? {
        let reference: [u8; 3] = u.arbitrary()?;
        compressed.extend(reference);
    }
    let sizes = [compressed.len(), data.len()].map(|size| (size as u32).to_le_bytes());
    Ok([sizes.concat(), compressed].concat())
}

/// An array of one row per point.
pub fn array(u: &mut Unstructured) -> Result<Vec<u8>> {
    let rows = u.int_in_range(1..=12)?;
    let columns = u.int_in_range(3..=5)?;
    let kind = *u.choose(&["<f4", "<f8"])?;
    let mut shape = [rows, columns];
    if rarely(u, 8)? {
        shape[u.choose_index(2)?] = *u.choose(&[0, 1 << 40, 1 << 61, u64::MAX])?;
    }
    let mut bytes = npy(kind, &shape);
    for _ in 0..rows * columns {
        let number = number(u)?;
        match kind {
            "<f4" => bytes.extend((number as f32).to_le_bytes()),
            _ => bytes.extend(number.to_le_bytes()),
        }
    }
    Ok(bytes)
}
