//! Points as a table of numbers of known types in memory: PCD and PLY files, arrays and messages of ROS.

use std::borrow::Cow;

use glam::Vec3;

use crate::lidar::Scan;

/// Type of a number.
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
    /// The type of a kind, `I` (signed), `U` (unsigned) or `F` (floating point), and a size in bytes.
    pub fn of(kind: &str, bytes: u64) -> Option<Self> {
        Some(match (kind, bytes) {
            ("I", 1) => Self::I8,
            ("I", 2) => Self::I16,
            ("I", 4) => Self::I32,
            ("I", 8) => Self::I64,
            ("U", 1) => Self::U8,
            ("U", 2) => Self::U16,
            ("U", 4) => Self::U32,
            ("U", 8) => Self::U64,
            ("F", 4) => Self::F32,
            ("F", 8) => Self::F64,
            _ => return None,
        })
    }

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
    fn read(self, bytes: &[u8], offset: usize, is_big_endian: bool) -> Option<f64> {
        let rest = bytes.get(offset..)?;
        fn first<const N: usize>(bytes: &[u8], is_big_endian: bool) -> Option<[u8; N]> {
            let mut number: [u8; N] = *bytes.first_chunk()?;
            if is_big_endian {
                number.reverse();
            }
            Some(number)
        }
        Some(match self {
            Self::I8 => f64::from(i8::from_le_bytes(first(rest, is_big_endian)?)),
            Self::U8 => f64::from(u8::from_le_bytes(first(rest, is_big_endian)?)),
            Self::I16 => f64::from(i16::from_le_bytes(first(rest, is_big_endian)?)),
            Self::U16 => f64::from(u16::from_le_bytes(first(rest, is_big_endian)?)),
            Self::I32 => f64::from(i32::from_le_bytes(first(rest, is_big_endian)?)),
            Self::U32 => f64::from(u32::from_le_bytes(first(rest, is_big_endian)?)),
            Self::I64 => i64::from_le_bytes(first(rest, is_big_endian)?) as f64,
            Self::U64 => u64::from_le_bytes(first(rest, is_big_endian)?) as f64,
            Self::F32 => f64::from(f32::from_le_bytes(first(rest, is_big_endian)?)),
            Self::F64 => f64::from_le_bytes(first(rest, is_big_endian)?),
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
    /// Order of the bytes of a number.
    pub is_big_endian: bool,
}

/// Names of the reflectance, as drivers have them.
const INTENSITY: [&str; 6] = [
    "intensity",
    "i",
    "reflectivity",
    "reflectance",
    "remission",
    "scalar_intensity",
];

/// Names of the number of the beam.
const RING: [&str; 4] = ["ring", "channel", "line", "ring_id"];

/// Names of the time of a point.
const TIME: [&str; 8] = [
    "time",
    "t",
    "timestamp",
    "time_stamp",
    "offset_time",
    "time_offset",
    "timeoffset",
    "offsettime",
];

/// Names of the coordinates of normals.
const NORMAL: [[&str; 2]; 3] = [["nx", "normal_x"], ["ny", "normal_y"], ["nz", "normal_z"]];

/// Points, in rows.
#[derive(Clone, Debug)]
pub struct Table<'a> {
    /// Columns, with offsets from the first number of a row.
    pub columns: Vec<Column>,
    /// Number of points of a row.
    pub width: usize,
    /// Number of rows.
    pub height: usize,
    /// Distance between rows [bytes].
    pub row_step: usize,
    /// The numbers.
    pub data: Cow<'a, [u8]>,
}

/// The columns of a table that are used.
struct Used<'t> {
    position: [&'t Column; 3],
    intensity: Option<&'t Column>,
    ring: Option<&'t Column>,
    time: Option<&'t Column>,
}

impl<'a> Table<'a> {
    /// A table of one row; an error if its columns are not within the data.
    pub fn of_file(
        columns: Vec<Column>,
        points: usize,
        data: impl Into<Cow<'a, [u8]>>,
    ) -> Result<Self, String> {
        let table = Self {
            columns,
            width: points,
            height: 1,
            row_step: 0,
            data: data.into(),
        };
        let ends = table.columns.iter().map(|column| table.end_of(column));
        let end = ends.max().unwrap_or(0);
        if points > 0 && end > table.data.len() {
            return Err(format!(
                "is truncated: {points} points need {end} bytes, but there are {}; copy it again",
                table.data.len()
            ));
        }
        Ok(table)
    }

    /// End of the last number of a column [bytes].
    pub fn end_of(&self, column: &Column) -> usize {
        let rows = self.height.saturating_sub(1).saturating_mul(self.row_step);
        let points = self.width.saturating_sub(1).saturating_mul(column.stride);
        let first = column.offset.saturating_add(column.number_type.size());
        rows.saturating_add(points).saturating_add(first)
    }

    /// The columns that are used.
    pub fn used(&self) -> Result<impl Iterator<Item = &Column>, String> {
        let used = self.find()?;
        let optional = [used.intensity, used.ring, used.time];
        Ok(used
            .position
            .into_iter()
            .chain(optional.into_iter().flatten()))
    }

    fn find(&self) -> Result<Used<'_>, String> {
        let [Some(x), Some(y), Some(z)] = [["x"], ["y"], ["z"]].map(|name| self.named(&name))
        else {
            let found: Vec<&str> = self.columns.iter().map(|c| c.name.as_str()).collect();
            let found = found.join(", ");
            return Err(format!("has no fields x, y and z, but: {found}"));
        };
        Ok(Used {
            position: [x, y, z],
            intensity: self.named(&INTENSITY),
            ring: self.named(&RING),
            time: self.named(&TIME),
        })
    }

    /// The first column with one of some names, in their order.
    fn named(&self, names: &[&str]) -> Option<&Column> {
        let named = |name: &&str| {
            (self.columns.iter()).find(|column| column.name.eq_ignore_ascii_case(name))
        };
        names.iter().find_map(named)
    }

    /// The numbers of a column, which are within the data.
    fn numbers(&self, column: &Column) -> impl Iterator<Item = f64> {
        let &Column {
            number_type,
            offset,
            stride,
            is_big_endian,
            ..
        } = column;
        // Rows without points may be billions.
        let height = if self.width == 0 { 0 } else { self.height };
        let rows = (0..height).map(move |row| row * self.row_step + offset);
        let offsets = rows.flat_map(move |row| (0..self.width).map(move |n| row + n * stride));
        let read = move |offset| number_type.read(&self.data, offset, is_big_endian);
        offsets.map(move |offset| read(offset).unwrap_or(f64::NAN))
    }

    /// Reads all points, without their times, and what is in the column of these.
    pub fn points(&self) -> Result<(Scan, Vec<f64>), String> {
        let used = self.find()?;
        let points = self.vectors(used.position);
        let intensities = match used.intensity {
            Some(column) => self.numbers(column).map(|number| number as f32).collect(),
            None => vec![0.0; points.len()],
        };
        let rings = used.ring.map(|column| self.numbers(column));
        let times = used.time.map(|column| self.numbers(column));
        let scan = Scan {
            points,
            intensities,
            rings: rings
                .into_iter()
                .flatten()
                .map(|ring| ring as u16)
                .collect(),
            ..Scan::default()
        };
        Ok((scan, times.into_iter().flatten().collect()))
    }

    /// Reads the normals of all points; `None` without columns of them.
    pub fn normals(&self) -> Option<Vec<Vec3>> {
        let [x, y, z] = NORMAL.map(|names| self.named(&names));
        Some(self.vectors([x?, y?, z?]))
    }

    fn vectors(&self, [x, y, z]: [&Column; 3]) -> Vec<Vec3> {
        let rest = self.numbers(y).zip(self.numbers(z));
        let vectors = self.numbers(x).zip(rest);
        vectors
            .map(|(x, (y, z))| Vec3::new(x as f32, y as f32, z as f32))
            .collect()
    }
}

/// Numbers of a text, a line per point, as those of type F64 in memory.
pub fn numbers_of_text<'t>(
    lines: impl Iterator<Item = &'t str>,
    columns: usize,
    points: usize,
) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    let mut rows = 0;
    for (row, line) in lines.enumerate() {
        let words: Vec<&str> = line.split_whitespace().collect();
        if words.len() != columns {
            return Err(format!(
                "has {} numbers in point {row}, not {columns}",
                words.len()
            ));
        }
        for word in words {
            let number: f64 = (word.parse())
                .map_err(|_word| format!("has `{word}` in point {row}, which is not a number"))?;
            bytes.extend(number.to_le_bytes());
        }
        rows += 1;
    }
    if rows != points {
        return Err(format!(
            "is truncated: it has {rows} of {points} points; copy it again"
        ));
    }
    Ok(bytes)
}

/// The lines of a text that are not empty.
pub fn lines_of(text: &[u8]) -> Result<impl Iterator<Item = &str>, String> {
    let text = std::str::from_utf8(text).map_err(|_utf8| "has data that is not text".to_owned())?;
    Ok(text.lines().filter(|line| !line.trim().is_empty()))
}
