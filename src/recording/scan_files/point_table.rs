//! Points as a table of numbers of known types in memory: PCD files, arrays and raw floats.

use glam::Vec3;

use crate::lidar::Scan;

/// Type of a little-endian number.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NumberType {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl NumberType {
    /// Size in bytes.
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::I64 | Self::U64 | Self::F64 => 8,
        }
    }

    /// The number at an offset; `None` beyond the end.
    pub fn read(self, bytes: &[u8], offset: usize) -> Option<f64> {
        fn at<const N: usize>(bytes: &[u8], offset: usize) -> Option<[u8; N]> {
            bytes.get(offset..)?.first_chunk().copied()
        }
        Some(match self {
            Self::I8 => f64::from(i8::from_le_bytes(at(bytes, offset)?)),
            Self::U8 => f64::from(u8::from_le_bytes(at(bytes, offset)?)),
            Self::I16 => f64::from(i16::from_le_bytes(at(bytes, offset)?)),
            Self::U16 => f64::from(u16::from_le_bytes(at(bytes, offset)?)),
            Self::I32 => f64::from(i32::from_le_bytes(at(bytes, offset)?)),
            Self::U32 => f64::from(u32::from_le_bytes(at(bytes, offset)?)),
            Self::I64 => i64::from_le_bytes(at(bytes, offset)?) as f64,
            Self::U64 => u64::from_le_bytes(at(bytes, offset)?) as f64,
            Self::F32 => f64::from(f32::from_le_bytes(at(bytes, offset)?)),
            Self::F64 => f64::from_le_bytes(at(bytes, offset)?),
        })
    }
}

/// A column of the table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Column {
    /// Name, such as `x` or `intensity`.
    pub name: String,
    /// Type of its numbers.
    pub number_type: NumberType,
    /// Position of its first number [bytes].
    pub offset: usize,
    /// Distance between its numbers [bytes].
    pub stride: usize,
}

/// Names of the reflectance in the files of drivers.
pub const INTENSITY: [&str; 6] = [
    "intensity",
    "i",
    "reflectivity",
    "reflectance",
    "remission",
    "scalar_intensity",
];

/// Reads the points of a table of `count` rows; columns beyond position and intensity are ignored.
pub fn scan_of(columns: &[Column], bytes: &[u8], count: usize) -> Result<Scan, String> {
    let named = |names: &[&str]| {
        (columns.iter()).find(|column| names.iter().any(|n| column.name.eq_ignore_ascii_case(n)))
    };
    let position = ["x", "y", "z"].map(|name| named(&[name]).ok_or(name));
    let [x, y, z] = match position {
        [Ok(x), Ok(y), Ok(z)] => [x, y, z],
        _ => {
            let found: Vec<&str> = columns.iter().map(|c| c.name.as_str()).collect();
            let found = found.join(", ");
            return Err(format!("has no columns x, y and z, but: {found}"));
        }
    };
    let intensity = named(&INTENSITY);
    for column in columns {
        let last = count.saturating_sub(1).saturating_mul(column.stride);
        let end = (last.saturating_add(column.offset)).saturating_add(column.number_type.size());
        if count > 0 && end > bytes.len() {
            return Err(format!(
                "is truncated: {count} points need {end} bytes, but there are {}; copy it again",
                bytes.len()
            ));
        }
    }
    let number = |column: &Column, row: usize| {
        let offset = column.offset + row * column.stride;
        column.number_type.read(bytes, offset).unwrap_or(f64::NAN) as f32
    };
    let (points, intensities) = (0..count)
        .map(|row| {
            let point = Vec3::new(number(x, row), number(y, row), number(z, row));
            (point, intensity.map_or(0.0, |column| number(column, row)))
        })
        .unzip();
    Ok(Scan {
        points,
        intensities,
        ..Scan::default()
    })
}
