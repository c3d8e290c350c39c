//! Text files with rows of numbers.

use std::path::Path;

use nalgebra::{Isometry3, Matrix3, Quaternion, Rotation3, Translation3, UnitQuaternion};

use super::error::RecordingError;
use crate::geometry::{FARTHEST_M, Pose3};
use crate::memory;

/// Reads the rows of a file with their line numbers, without blank lines and comments (`#`).
pub fn read_rows(path: &Path) -> Result<Vec<(usize, Vec<f64>)>, RecordingError> {
    (1..)
        .zip(read_text(path)?.lines().map(str::trim))
        .filter(|(_, text)| !text.is_empty() && !text.starts_with('#'))
        .map(|(line, text)| Ok((line, parse_numbers(text, path, line)?)))
        .collect()
}

/// Reads a whole file as text, without the byte order mark that some editors write.
pub fn read_text(path: &Path) -> Result<String, RecordingError> {
    let bytes = memory::read_file(path).map_err(RecordingError::read(path))?;
    text_of(bytes, path)
}

/// The bytes of a file as text, without the byte order mark.
pub fn text_of(bytes: Vec<u8>, path: &Path) -> Result<String, RecordingError> {
    let mut text = memory::text_of(bytes).map_err(RecordingError::read(path))?;
    if text.starts_with('\u{feff}') {
        text.remove(0);
    }
    Ok(text)
}

/// Parses finite numbers separated by white space.
pub fn parse_numbers(text: &str, path: &Path, line: usize) -> Result<Vec<f64>, RecordingError> {
    text.split_whitespace()
        .map(|word| match word.parse::<f64>() {
            Ok(number) if number.is_finite() => Ok(number),
            _ => Err(RecordingError::NotANumber {
                path: path.to_owned(),
                line,
                word: word.to_owned(),
            }),
        })
        .collect()
}

/// The numbers of a row as an array of a known length.
pub fn row_array<const N: usize>(
    row: &[f64],
    path: &Path,
    line: usize,
    layout: &'static str,
) -> Result<[f64; N], RecordingError> {
    row.try_into()
        .map_err(|_length| RecordingError::WrongCount {
            path: path.to_owned(),
            line,
            found: row.len(),
            expected: N,
            layout,
        })
}

/// A row-major 3x4 matrix as a transform. Its rotation is orthogonalized; a matrix that is not
/// close to a rotation is an error.
pub fn pose_from_row(row: &[f64], path: &Path, line: usize) -> Result<Pose3, RecordingError> {
    let row: [f64; 12] = row_array(row, path, line, "a row-major 3x4 matrix")?;
    let matrix = Matrix3::new(
        row[0], row[1], row[2], row[4], row[5], row[6], row[8], row[9], row[10],
    );
    let skew = (matrix.transpose() * matrix - Matrix3::identity())
        .abs()
        .max();
    if skew > 0.01 || matrix.determinant() < 0.0 {
        return Err(RecordingError::NotARotation {
            path: path.to_owned(),
            line,
        });
    }
    let rotation = nearest_rotation(matrix);
    Ok(Isometry3::from_parts(
        position(row[3], row[7], row[11], path, line)?,
        UnitQuaternion::from_rotation_matrix(&rotation),
    ))
}

/// A position; one that is farther from the origin than any place on Earth is an error.
pub fn position(
    x: f64,
    y: f64,
    z: f64,
    path: &Path,
    line: usize,
) -> Result<Translation3<f64>, RecordingError> {
    match [x, y, z].into_iter().find(|m| m.abs() > FARTHEST_M) {
        Some(value) => Err(RecordingError::OutOfRange {
            path: path.to_owned(),
            line,
            value,
            quantity: "position",
            limit: "40,000 km",
        }),
        None => Ok(Translation3::new(x, y, z)),
    }
}

/// A quaternion that is normalized up to a hundredth, as a rotation; one up to rounding keeps its numbers.
pub fn rotation(
    quaternion: Quaternion<f64>,
    path: &Path,
    line: usize,
) -> Result<UnitQuaternion<f64>, RecordingError> {
    /// Difference to 1 of the norm of a quaternion that is normalized up to rounding.
    const NORMALIZED: f64 = 1e-14;
    let excess = (quaternion.norm() - 1.0).abs();
    if excess > 0.01 {
        return Err(RecordingError::NotARotation {
            path: path.to_owned(),
            line,
        });
    }
    Ok(if excess < NORMALIZED {
        UnitQuaternion::new_unchecked(quaternion)
    } else {
        UnitQuaternion::from_quaternion(quaternion)
    })
}

/// The rotation nearest to a matrix, `U Vᵀ` of its singular value decomposition.
fn nearest_rotation(matrix: Matrix3<f64>) -> Rotation3<f64> {
    let svd = matrix.svd(true, true);
    match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => Rotation3::from_matrix_unchecked(u * v_t),
        _ => Rotation3::from_matrix_unchecked(matrix),
    }
}

/// A transform as a row-major 3x4 matrix in KITTI's number format.
pub fn row_from_pose(pose: &Pose3) -> String {
    let matrix = pose.to_homogeneous();
    let numbers: Vec<String> = (0..3)
        .flat_map(|row| (0..4).map(move |column| (row, column)))
        .map(|index| format!("{:.9e}", matrix[index]))
        .collect();
    numbers.join(" ")
}
