//! Tables of poses: numbers separated by commas or white space.

use std::path::Path;

use nalgebra::{Quaternion, UnitQuaternion};

use super::super::error::RecordingError;
use super::super::poses::check_time;
use super::super::table::{parse_numbers, pose_from_row, position, read_text, rotation};
use crate::geometry::Pose3;

/// A row of a table.
pub struct PoseRow<'p> {
    path: &'p Path,
    line: usize,
    numbers: Vec<f64>,
}

/// Reads the rows of a table of at least so many columns, without a header of words, comments (`#`), and rows in which a number is
/// missing (`nan`).
pub fn read<T>(
    path: &Path,
    columns: usize,
    row: impl Fn(&PoseRow<'_>) -> Result<T, RecordingError>,
) -> Result<Vec<T>, RecordingError> {
    let mut rows = Vec::new();
    for (line, text) in (1..).zip(read_text(path)?.replace(',', " ").lines()) {
        let mut words = text.split_whitespace();
        let first = words.next().unwrap_or("#");
        let is_header = line == 1 && first.parse::<f64>().is_err();
        let mut all = text.split_whitespace();
        if first.starts_with('#') || is_header || all.any(|it| it.eq_ignore_ascii_case("nan")) {
            continue;
        }
        let numbers = parse_numbers(text, path, line)?;
        if numbers.len() < columns {
            return Err(RecordingError::WrongCount {
                path: path.to_owned(),
                line,
                found: numbers.len(),
                expected: columns,
                layout: "a row of the poses of the data set",
            });
        }
        rows.push(row(&PoseRow {
            path,
            line,
            numbers,
        })?);
    }
    if rows.is_empty() {
        return Err(RecordingError::NoPoses {
            path: path.to_owned(),
        });
    }
    Ok(rows)
}

impl PoseRow<'_> {
    /// A number that is a time, in a unit [s].
    pub fn time_s(&self, column: usize, unit_s: f64) -> Result<f64, RecordingError> {
        check_time(self.numbers[column] * unit_s, self.path, self.line)
    }

    /// A number that counts.
    pub fn index(&self, column: usize) -> usize {
        self.numbers[column] as usize
    }

    /// A row-major 3x4 matrix.
    pub fn matrix(&self, first: usize) -> Result<Pose3, RecordingError> {
        pose_from_row(&self.numbers[first..first + 12], self.path, self.line)
    }

    /// A position and a quaternion x, y, z, w.
    pub fn position_and_quaternion(&self, first: usize) -> Result<Pose3, RecordingError> {
        let [x, y, z, w] = [3, 4, 5, 6].map(|column| self.numbers[first + column]);
        let quaternion = Quaternion::new(w, x, y, z);
        self.pose(first, rotation(quaternion, self.path, self.line)?)
    }

    /// A position, and the angles at some columns of `Rz(yaw) · Ry(pitch) · Rx(roll)` [rad].
    pub fn position_and_angles(
        &self,
        first: usize,
        [roll, pitch, yaw]: [usize; 3],
    ) -> Result<Pose3, RecordingError> {
        let [roll, pitch, yaw] = [roll, pitch, yaw].map(|column| self.numbers[column]);
        let rotation = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
        self.pose(first, rotation)
    }

    fn pose(&self, first: usize, rotation: UnitQuaternion<f64>) -> Result<Pose3, RecordingError> {
        let [x, y, z] = [0, 1, 2].map(|column| self.numbers[first + column]);
        let translation = position(x, y, z, self.path, self.line)?;
        Ok(Pose3::from_parts(translation, rotation))
    }
}
