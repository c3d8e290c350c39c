//! Results (`.npz`) of arbitrary shapes, types and numbers.

use std::io::{Cursor, Write as _};

use arbtest::arbitrary::{Result, Unstructured};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use super::files::{number, rarely};
use super::mutation::Mutations;

/// Arrays with their number of columns; none for one number per row.
const COLUMNS: &[(&str, &[u64])] = &[
    ("frames", &[]),
    ("estimates", &[3]),
    ("refined", &[3]),
    ("ground_truth", &[3]),
    ("odometry", &[3]),
    ("covariances", &[9]),
    ("refined_covariances", &[9]),
    ("times_s", &[]),
    ("runtimes_s", &[]),
    ("refine_runtimes_s", &[]),
    ("states", &[]),
    ("an_array_of_another_program", &[2]),
];

const TYPES: &[&str] = &[
    "<f4", "<f8", ">f8", "<i4", "<i8", "|u1", "|b1", "<u8", "|i1", "<f2", "|O", "<c16", "<U3",
    "|V8", "",
];

/// Extents that multiply beyond any memory or to nothing.
const EXTENTS: &[u64] = &[0, 1, 2, 1_000_000_000, 1 << 40, 1 << 60, u64::MAX];

/// A file of localization results.
pub fn results(u: &mut Unstructured) -> Result<Vec<u8>> {
    let mut file = ZipWriter::new(Cursor::new(Vec::new()));
    let rows = u.int_in_range(1..=6)?;
    let capacity = u.int_in_range(1..=5)?;
    let first = match u.arbitrary::<u8>()? {
        254.. => number(u)?,
        200.. => 1.0,
        _ => 0.0,
    };
    add(u, &mut file, "start_idx", "<i8", &[], &mut |_, _| Ok(first))?;
    let mut particle = |u: &mut Unstructured, index: u64| match index % 4 {
        3 => Ok(0.25),
        _ => number(u),
    };
    add(
        u,
        &mut file,
        "particles",
        "<f4",
        &[rows, capacity, 4],
        &mut particle,
    )?;
    for (name, columns) in COLUMNS {
        if u.arbitrary()? {
            continue;
        }
        let kind = match *name {
            "frames" => "<i8",
            "states" => "|u1",
            _ => "<f8",
        };
        let shape = [&[rows], *columns].concat();
        let mut next = |u: &mut Unstructured, index: u64| match *name {
            "frames" if !rarely(u, 2)? => Ok(index as f64),
            _ => number(u),
        };
        add(u, &mut file, name, kind, &shape, &mut next)?;
    }
    Ok(file.finish().unwrap().into_inner())
}

/// Adds an array, mostly of the usual type and shape.
fn add(
    u: &mut Unstructured,
    file: &mut ZipWriter<Cursor<Vec<u8>>>,
    name: &str,
    kind: &str,
    shape: &[u64],
    next: &mut dyn FnMut(&mut Unstructured, u64) -> Result<f64>,
) -> Result<()> {
    let kind = match u.arbitrary::<u8>()? {
        254.. => *u.choose(TYPES)?,
        250.. => "<f8",
        _ => kind,
    };
    let mut numbers = Vec::new();
    for index in 0..shape.iter().product() {
        put(kind, next(u, index)?, &mut numbers);
    }
    let mut shape = shape.to_vec();
    if rarely(u, 3)? {
        for _ in 0..u.int_in_range(1..=2)? {
            let axis = u.choose_index(shape.len() + 1)?;
            let extent = *u.choose(EXTENTS)?;
            match shape.get_mut(axis) {
                Some(place) => *place = extent,
                None => shape.push(extent),
            }
        }
    }
    let mut array = npy(kind, &shape);
    array.extend(numbers);
    if rarely(u, 3)? {
        Mutations::new(u)?.apply(&mut array);
    }
    // Compression takes long.
    let method = match rarely(u, 16)? {
        true => CompressionMethod::Deflated,
        false => CompressionMethod::Stored,
    };
    let options = SimpleFileOptions::default()
        .compression_method(method)
        .large_file(rarely(u, 8)?);
    file.start_file(format!("{name}.npy"), options).unwrap();
    file.write_all(&array).unwrap();
    Ok(())
}

/// The header of an array.
pub fn npy(kind: &str, shape: &[u64]) -> Vec<u8> {
    let extents: String = shape.iter().map(|extent| format!("{extent}, ")).collect();
    let text = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': ({extents}), }}\n");
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.bytes());
    bytes
}

fn put(kind: &str, number: f64, bytes: &mut Vec<u8>) {
    match kind {
        "<f4" => bytes.extend((number as f32).to_le_bytes()),
        ">f8" => bytes.extend(number.to_be_bytes()),
        "<i4" => bytes.extend((number as i32).to_le_bytes()),
        "<i8" | "<u8" => bytes.extend((number as i64).to_le_bytes()),
        "|u1" | "|b1" | "|i1" => bytes.push(number as u8),
        _ => bytes.extend(number.to_le_bytes()),
    }
}
