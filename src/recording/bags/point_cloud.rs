//! Scans of `sensor_msgs/PointCloud2` and of Livox' `CustomMsg`.

use glam::Vec3;

use super::fields::Fields;
use super::index::Content;
use super::message::Header;
use super::point_times::sweep_times;
use crate::lidar::Scan;
use crate::recording::scan_files::point_table::{INTENSITY, NumberType};

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

/// A scan as it is read.
pub struct ReadScan {
    pub scan: Scan,
    /// Whether the points have numbers by the name of a time which make no sense as one.
    pub has_unknown_times: bool,
}

/// Reads a message; `log_s` is its moment if it has no stamp.
pub fn read_scan(fields: &mut Fields, content: Content, log_s: f64) -> Result<ReadScan, String> {
    let header = Header::read(fields)?;
    let table = match content {
        Content::LivoxCloud => livox(fields)?,
        _ => point_cloud2(fields)?,
    };
    let stamp_s = if header.stamp_s == 0.0 {
        log_s
    } else {
        header.stamp_s
    };
    table.scan(stamp_s)
}

/// A field of all points.
struct Column {
    name: String,
    number_type: NumberType,
    offset: usize,
}

/// Points in rows.
struct Table<'a> {
    columns: Vec<Column>,
    width: usize,
    height: usize,
    /// Distance between points, and between rows of them [bytes].
    point_step: usize,
    row_step: usize,
    is_big_endian: bool,
    data: &'a [u8],
}

fn point_cloud2<'a>(fields: &mut Fields<'a>) -> Result<Table<'a>, String> {
    let (height, width) = (fields.u32()? as usize, fields.u32()? as usize);
    let mut columns = Vec::new();
    for _ in 0..fields.u32()? {
        let (name, offset, datatype, _count) =
            (fields.text()?, fields.u32()?, fields.u8()?, fields.u32()?);
        let number_type = match datatype {
            1 => NumberType::I8,
            2 => NumberType::U8,
            3 => NumberType::I16,
            4 => NumberType::U16,
            5 => NumberType::I32,
            6 => NumberType::U32,
            7 => NumberType::F32,
            8 => NumberType::F64,
            _ => continue,
        };
        columns.push(Column {
            name,
            number_type,
            offset: offset as usize,
        });
    }
    let is_big_endian = fields.u8()? != 0;
    let (point_step, row_step) = (fields.u32()? as usize, fields.u32()? as usize);
    let length = fields.u32()? as usize;
    Ok(Table {
        columns,
        width,
        height,
        point_step,
        row_step,
        is_big_endian,
        data: fields.bytes(length)?,
    })
}

fn livox<'a>(fields: &mut Fields<'a>) -> Result<Table<'a>, String> {
    // Time base, number of points, number of the sensor and three reserved bytes.
    let _before = (fields.u64()?, fields.u32()?, fields.u8()?, fields.bytes(3)?);
    let points = fields.u32()? as usize;
    let column = |name: &str, number_type, offset| Column {
        name: name.to_owned(),
        number_type,
        offset,
    };
    let point_step = fields.stride(19);
    Ok(Table {
        columns: vec![
            column("offset_time", NumberType::U32, 0),
            column("x", NumberType::F32, 4),
            column("y", NumberType::F32, 8),
            column("z", NumberType::F32, 12),
            column("reflectivity", NumberType::U8, 16),
            column("line", NumberType::U8, 18),
        ],
        width: points,
        height: 1,
        point_step,
        row_step: 0,
        is_big_endian: fields.is_big_endian(),
        data: fields.rest(),
    })
}

impl Table<'_> {
    /// The first column with one of some names, in their order.
    fn named(&self, names: &[&str]) -> Option<&Column> {
        let named = |name: &&str| {
            (self.columns.iter()).find(|column| column.name.eq_ignore_ascii_case(name))
        };
        names.iter().find_map(named)
    }

    /// Requires that all points and a column of them are within the data.
    fn check(&self, column: &Column) -> Result<(), String> {
        let size = column.number_type.size();
        let rows = self.height.saturating_sub(1).saturating_mul(self.row_step);
        let points = self.width.saturating_sub(1).saturating_mul(self.point_step);
        let end = (rows.saturating_add(points)).saturating_add(column.offset + size);
        let row_bytes = self.width.saturating_mul(self.point_step);
        let problem = if end > self.data.len() {
            format!("its points need {end} bytes")
        } else if column.offset + size > self.point_step {
            format!(
                "its points of {} bytes end before `{}`",
                self.point_step, column.name
            )
        } else if self.height > 1 && self.row_step < row_bytes {
            format!("its rows of {row_bytes} bytes are {} apart", self.row_step)
        } else {
            return Ok(());
        };
        let (width, height, length) = (self.width, self.height, self.data.len());
        Err(format!(
            "is damaged: {width} x {height} points in {length} bytes, but {problem}"
        ))
    }

    fn number(&self, column: &Column, at: usize) -> f64 {
        let size = column.number_type.size();
        let mut bytes = [0; 8];
        let number = self
            .data
            .get(at + column.offset..)
            .and_then(|rest| rest.get(..size));
        bytes[..size].copy_from_slice(number.unwrap_or(&[0; 8][..size]));
        if self.is_big_endian {
            bytes[..size].reverse();
        }
        column.number_type.read(&bytes, 0).unwrap_or(f64::NAN)
    }

    /// The points with finite coordinates.
    fn scan(&self, stamp_s: f64) -> Result<ReadScan, String> {
        let [Some(x), Some(y), Some(z)] = [["x"], ["y"], ["z"]].map(|name| self.named(&name))
        else {
            let found: Vec<&str> = self.columns.iter().map(|c| c.name.as_str()).collect();
            return Err(format!(
                "has no fields x, y and z, but: {}",
                found.join(", ")
            ));
        };
        let [intensity, ring, time] = [&INTENSITY[..], &RING, &TIME].map(|names| self.named(names));
        let mut scan = Scan {
            time_s: Some(stamp_s),
            ..Scan::default()
        };
        let mut has_unknown_times = false;
        if self.width == 0 || self.height == 0 {
            return Ok(ReadScan {
                scan,
                has_unknown_times,
            });
        }
        for column in [Some(x), Some(y), Some(z), intensity, ring, time]
            .into_iter()
            .flatten()
        {
            self.check(column)?;
        }
        let (mut times, mut is_measured) = (Vec::new(), Vec::new());
        for row in 0..self.height {
            for column in 0..self.width {
                let at = row * self.row_step + column * self.point_step;
                let point = [x, y, z].map(|axis| self.number(axis, at) as f32);
                let point = Vec3::from_array(point);
                if !point.is_finite() {
                    continue;
                }
                scan.points.push(point);
                let intensity = intensity.map_or(0.0, |column| self.number(column, at) as f32);
                scan.intensities.push(intensity);
                scan.rings
                    .extend(ring.map(|column| self.number(column, at) as u16));
                times.extend(time.map(|column| self.number(column, at)));
                is_measured.push(point != Vec3::ZERO);
            }
        }
        match sweep_times(&times, &is_measured, stamp_s) {
            Some(sweep) => {
                scan.times_s = sweep.times_s;
                scan.time_s = Some(sweep.middle_s);
            }
            None => has_unknown_times = !times.is_empty(),
        }
        Ok(ReadScan {
            scan,
            has_unknown_times,
        })
    }
}
