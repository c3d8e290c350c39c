//! Points whose format is that of a data set: records of numbers without a header, and times by the order of the points.

use glam::Vec3;

use super::point_table::{Column, NumberType, Table};

/// How the points of a scan are stored, where its file does not say so itself.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PointFormat {
    /// Numbers of each point; `None`: by the extension of the file.
    pub(crate) records: Option<&'static RecordFormat>,
    /// Order of the points, which has their times where they have none themselves.
    pub(crate) order: Option<ColumnOrder>,
}

/// A number per name and point, one point after the other, little-endian.
#[derive(Debug, PartialEq)]
pub struct RecordFormat {
    /// Names of the numbers, as those of columns of other files, and their types.
    pub fields: &'static [(&'static str, NumberType)],
    /// Coordinates in metres: a factor and an addend for each number x, y and z.
    pub metres: [(f32, f32); 3],
}

/// Points of a whole turn, those of one column after the other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColumnOrder {
    /// Points of a column.
    pub rows: usize,
    /// Columns of a turn.
    pub columns: usize,
    /// Duration of a turn [s].
    pub period_s: f64,
}

impl PointFormat {
    /// Points in records without a known order.
    pub const fn records(records: &'static RecordFormat) -> Self {
        Self {
            records: Some(records),
            order: None,
        }
    }
}

impl RecordFormat {
    /// Records with coordinates in metres.
    pub const fn in_metres(fields: &'static [(&'static str, NumberType)]) -> Self {
        let metres = [(1.0, 0.0); 3];
        Self { fields, metres }
    }

    /// The table of the numbers in a file.
    pub fn table<'a>(&self, bytes: &'a [u8]) -> Result<Table<'a>, String> {
        let stride = self.fields.iter().map(|(_, it)| it.size()).sum::<usize>();
        if stride == 0 || !bytes.len().is_multiple_of(stride) {
            return Err(format!(
                "has {} bytes, which is not a multiple of {stride}, the size of a point; it looks truncated or is of another layout",
                bytes.len()
            ));
        }
        let mut offset = 0;
        let column = |&(name, number_type): &(&str, NumberType)| {
            let column = Column {
                name: name.to_owned(),
                number_type,
                offset,
                stride,
                is_big_endian: false,
            };
            offset += number_type.size();
            column
        };
        let columns = self.fields.iter().map(column).collect();
        Table::of_file(columns, bytes.len() / stride, bytes)
    }

    /// A point in metres.
    pub fn point_m(&self, point: Vec3) -> Vec3 {
        let [x, y, z] = self.metres;
        let of = |(factor, addend): (f32, f32), number: f32| number * factor + addend;
        Vec3::new(of(x, point.x), of(y, point.y), of(z, point.z))
    }
}

impl ColumnOrder {
    /// Time of each point after the first [s]; none if there are more or fewer points than in a turn.
    pub fn times_s(&self, points: usize) -> Vec<f64> {
        if points != self.rows * self.columns {
            return vec![];
        }
        let column_s = self.period_s / self.columns as f64;
        (0..points)
            .map(|point| (point / self.rows) as f64 * column_s)
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FORMAT: RecordFormat = RecordFormat {
        fields: &[
            ("z", NumberType::U16),
            ("x", NumberType::U8),
            ("y", NumberType::U16),
        ],
        metres: [(1.0, 0.0), (-0.5, 100.0), (2.0, 0.0)],
    };

    #[test]
    fn numbers_are_found_by_their_names_and_scaled() {
        let table = FORMAT.table(&[1, 1, 7, 10, 0, 2, 0, 8, 20, 0]).unwrap();
        let (scan, times) = table.points().unwrap();
        assert_eq!(scan.points[0], Vec3::new(7.0, 10.0, 257.0));
        assert_eq!(FORMAT.point_m(scan.points[1]), Vec3::new(8.0, 90.0, 4.0));
        assert!(times.is_empty());
    }

    #[test]
    fn a_part_of_a_point_is_an_error() {
        let message = FORMAT.table(&[0; 11]).unwrap_err();
        assert!(message.contains("11 bytes"), "{message}");
        assert!(FORMAT.table(&[]).unwrap().points().unwrap().0.is_empty());
    }

    #[test]
    fn only_a_whole_turn_has_times() {
        let order = ColumnOrder {
            rows: 2,
            columns: 4,
            period_s: 0.1,
        };
        assert_eq!(
            order.times_s(8),
            [
                0.0,
                0.0,
                0.025,
                0.025,
                0.05,
                0.05,
                0.1 / 4.0 * 3.0,
                0.1 / 4.0 * 3.0
            ]
        );
        assert!(order.times_s(7).is_empty());
    }
}
