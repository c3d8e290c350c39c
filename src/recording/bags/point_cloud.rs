//! Scans of `sensor_msgs/PointCloud2` and of Livox' `CustomMsg`.

use super::fields::Fields;
use super::index::Content;
use super::message::Header;
use crate::recording::scan_files::ReadScan;
use crate::recording::scan_files::point_table::{Column, NumberType, Table};
use crate::recording::scan_files::point_times::set_times;

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
    let (mut scan, times) = table.points()?;
    let has_unknown_times = !set_times(&mut scan, &times, Some(stamp_s));
    scan.drop_not_finite();
    Ok(ReadScan {
        scan,
        has_unknown_times,
    })
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
            stride: 0,
            is_big_endian: false,
        });
    }
    let is_big_endian = fields.u8()? != 0;
    let (point_step, row_step) = (fields.u32()? as usize, fields.u32()? as usize);
    for column in &mut columns {
        (column.stride, column.is_big_endian) = (point_step, is_big_endian);
    }
    let length = fields.u32()? as usize;
    let table = Table {
        columns,
        width,
        height,
        row_step,
        data: fields.bytes(length)?.into(),
    };
    check(&table, point_step)?;
    Ok(table)
}

fn livox<'a>(fields: &mut Fields<'a>) -> Result<Table<'a>, String> {
    // Time base, number of points, number of the sensor and three reserved bytes.
    let _before = (fields.u64()?, fields.u32()?, fields.u8()?, fields.bytes(3)?);
    let points = fields.u32()? as usize;
    let (stride, is_big_endian) = (fields.stride(19), fields.is_big_endian());
    let column = |name: &str, number_type, offset| Column {
        name: name.to_owned(),
        number_type,
        offset,
        stride,
        is_big_endian,
    };
    let table = Table {
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
        row_step: 0,
        data: fields.rest().into(),
    };
    check(&table, stride)?;
    Ok(table)
}

/// Requires that the columns of a table that are used are within its points, and these within the data.
fn check(table: &Table, point_step: usize) -> Result<(), String> {
    let (width, height, length) = (table.width, table.height, table.data.len());
    if width == 0 || height == 0 {
        return Ok(());
    }
    let row_bytes = width.saturating_mul(point_step);
    for column in table.used()? {
        let end = table.end_of(column);
        let problem = if end > length {
            format!("its points need {end} bytes")
        } else if column.offset + column.number_type.size() > point_step {
            format!(
                "its points of {point_step} bytes end before `{}`",
                column.name
            )
        } else if height > 1 && table.row_step < row_bytes {
            format!("its rows of {row_bytes} bytes are {} apart", table.row_step)
        } else {
            continue;
        };
        return Err(format!(
            "is damaged: {width} x {height} points in {length} bytes, but {problem}"
        ));
    }
    Ok(())
}
