//! Poses of KITTI's raw data from its GNSS and inertial measurements (`oxts`).
//!
//! ```text
//! s = cos(lat₀)    x = s R lon    y = s R ln tan(π/4 + lat/2)    z = alt
//! world_from_imu = Trans(x, y, z) · Rz(yaw) · Ry(pitch) · Rx(roll)
//! ```
//!
//! Geiger et al., *Vision meets Robotics: The KITTI Dataset* (2013), and its development kit: Mercator
//! projection, R = 6,378,137 m.

use std::f64::consts::FRAC_PI_4;
use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Isometry3, Translation3, UnitQuaternion};

use super::calibration::Calibration;
use super::error::RecordingError;
use super::found_fixes::{FoundFixes, is_position};
use super::table::{parse_numbers, pose_from_row, position, read_rows, read_text};
use crate::geometry::Pose3;
use crate::georeference::{Geodetic, GeodeticFix};

const EARTH_RADIUS_M: f64 = 6_378_137.0;

/// Reads `oxts/data/*.txt`, ascending, and `calib_imu_to_velo.txt` in the folder of the recording or in the
/// one above it: poses `world_from_imu`, and `imu_from_lidar` in the place of `cam0_from_lidar`.
pub fn read(oxts: &Path) -> Result<(Vec<Pose3>, Calibration), RecordingError> {
    let files = data_files(oxts)?;
    let mut scale = None;
    let mut poses = Vec::with_capacity(files.len());
    for path in &files {
        let (line, row) = read_row(path)?;
        let [lat, lon, alt, roll, pitch, yaw] = &row.begin;
        let lat_rad = lat.to_radians();
        let scale = *scale.get_or_insert(lat_rad.cos() * EARTH_RADIUS_M);
        let x = scale * lon.to_radians();
        let y = scale * (FRAC_PI_4 + 0.5 * lat_rad).tan().abs().ln();
        poses.push(Isometry3::from_parts(
            position(x, y, *alt, path, line)?,
            UnitQuaternion::from_euler_angles(*roll, *pitch, *yaw),
        ));
    }
    // Relative to the first: coordinates on Earth lose millimetres in single precision.
    let Some(first) = poses.first().copied() else {
        return Err(RecordingError::NoPoses {
            path: oxts.join("data"),
        });
    };
    let origin = Translation3::from(-first.translation.vector);
    poses.iter_mut().for_each(|pose| *pose = origin * *pose);
    Ok((poses, imu_from_lidar(oxts)?))
}

/// The files of the measurements, ascending.
fn data_files(oxts: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    let folder = oxts.join("data");
    let mut files = Vec::new();
    for entry in fs::read_dir(&folder).map_err(RecordingError::read(&folder))? {
        let path = entry.map_err(RecordingError::read(&folder))?.path();
        if path.extension().is_some_and(|extension| extension == "txt") {
            files.push(path);
        }
    }
    files.sort();
    Ok(files)
}

/// The files of the measurements with the times of `oxts/timestamps.txt` [s].
pub fn timed_files(oxts: &Path) -> Result<Vec<(PathBuf, f64)>, RecordingError> {
    let times_file = oxts.join("timestamps.txt");
    let times_s = read_timestamps(&times_file)?;
    let files = data_files(oxts)?;
    if files.len() != times_s.len() {
        return Err(RecordingError::WrongTimes {
            path: times_file,
            times: times_s.len(),
            poses: files.len(),
        });
    }
    Ok(files.into_iter().zip(times_s).collect())
}

/// A row of measurements.
struct Row {
    /// Latitude, longitude [deg], altitude [m], roll, pitch, yaw [rad].
    begin: [f64; 6],
    /// Standard deviation of the position, where it is positive [m].
    accuracy_m: Option<f64>,
}

/// Reads the only row of a file, with the number of its line.
fn read_row(path: &Path) -> Result<(usize, Row), RecordingError> {
    /// Column of the accuracy of the position.
    const POS_ACCURACY: usize = 23;
    let rows = read_rows(path)?;
    let row = rows.first().map(|(line, row)| (*line, row.as_slice()));
    let Some((line, begin)) = row.and_then(|(line, row)| Some((line, row.first_chunk()?))) else {
        return Err(RecordingError::WrongCount {
            path: path.to_owned(),
            line: 1,
            found: row.map_or(0, |(_, row)| row.len()),
            expected: 30,
            layout: "latitude longitude altitude roll pitch yaw ...",
        });
    };
    let accuracy_m = row.and_then(|(_, row)| row.get(POS_ACCURACY).copied());
    let row = Row {
        begin: *begin,
        accuracy_m: accuracy_m.filter(|&accuracy_m| accuracy_m > 0.0),
    };
    Ok((line, row))
}

/// Reads the positions of `oxts/data/*.txt` with the times of `oxts/timestamps.txt`. The antenna is where the measuring
/// unit is, by `calib_imu_to_velo.txt`.
pub fn read_fixes(oxts: &Path) -> Result<FoundFixes, RecordingError> {
    let mut found = FoundFixes::default();
    for (path, time_s) in timed_files(oxts)? {
        let (line, row) = read_row(&path)?;
        let [latitude_deg, longitude_deg, height_m, ..] = row.begin;
        if !is_position(latitude_deg, longitude_deg, height_m) {
            return Err(RecordingError::NotOnEarth {
                path,
                line,
                row: format!("{latitude_deg} {longitude_deg} {height_m}"),
            });
        }
        found.fixes.push(GeodeticFix {
            time_s,
            position: Geodetic {
                latitude_deg,
                longitude_deg,
                height_m,
            },
            horizontal_m: row.accuracy_m,
            vertical_m: row.accuracy_m,
        });
    }
    let imu_from_lidar = imu_from_lidar(oxts).ok();
    found.antenna_m =
        imu_from_lidar.map(|it| it.cam0_from_lidar.inverse().translation.vector.into());
    Ok(found)
}

/// Reads the rotation and position of the sensor from `calib_imu_to_velo.txt`.
pub fn imu_from_lidar(oxts: &Path) -> Result<Calibration, RecordingError> {
    let above = oxts.ancestors().skip(1).take(2);
    let found = (above.map(|folder| folder.join("calib_imu_to_velo.txt"))).find(|p| p.exists());
    let Some(path) = found else {
        return Err(RecordingError::NoImuCalibration {
            path: oxts.to_owned(),
        });
    };
    let (mut rotation, mut translation) = (Vec::new(), Vec::new());
    for (line, text) in (1..).zip(read_text(&path)?.lines()) {
        match text.split_once(':') {
            Some(("R", numbers)) => rotation = parse_numbers(numbers, &path, line)?,
            Some(("T", numbers)) => translation = parse_numbers(numbers, &path, line)?,
            _ => {}
        }
    }
    let (rows, _) = rotation.as_chunks::<3>();
    let row: Vec<f64> = (rows.iter().zip(&translation))
        .flat_map(|(row, t)| row.iter().copied().chain([*t]))
        .collect();
    let lidar_from_imu = pose_from_row(&row, &path, 1)?;
    Ok(Calibration {
        cam0_from_lidar: lidar_from_imu.inverse(),
    })
}

/// Reads `timestamps.txt`, rows such as `2011-09-26 13:02:25.967790592` [s since 1970].
pub fn read_timestamps(path: &Path) -> Result<Vec<f64>, RecordingError> {
    let text = read_text(path)?;
    let rows = (1..).zip(text.lines().map(str::trim));
    rows.filter(|(_, row)| !row.is_empty())
        .map(|(line, row)| {
            time_s(row).ok_or_else(|| RecordingError::NotANumber {
                path: path.to_owned(),
                line,
                word: row.to_owned(),
            })
        })
        .collect()
}

/// A date and a time of day as seconds since 1970.
fn time_s(row: &str) -> Option<f64> {
    let (date, time) = row.split_once([' ', 'T'])?;
    let mut date = date.split('-').map(|part| part.parse::<i64>().ok());
    let (year, month, day) = (date.next()??, date.next()??, date.next()??);
    let is_date =
        (1970..3000).contains(&year) && (1..=12).contains(&month) && (1..=31).contains(&day);
    let mut time = time.split(':').map(|part| part.parse::<f64>().ok());
    let (hour, minute, second) = (time.next()??, time.next()??, time.next()??);
    // Days since 1970 of the Gregorian calendar; the year begins in March.
    let (y, m) = if month > 2 {
        (year, month - 3)
    } else {
        (year - 1, month + 9)
    };
    let days = 365 * y + y / 4 - y / 100 + y / 400 + (153 * m + 2) / 5 + day - 719_469;
    let seconds = days as f64 * 86_400.0 + hour * 3600.0 + minute * 60.0 + second;
    (is_date && seconds.is_finite()).then_some(seconds)
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    #[test]
    fn a_date_is_the_number_of_seconds_since_1970() {
        assert_eq!(time_s("1970-01-01 00:00:00.5"), Some(0.5));
        assert_eq!(time_s("2000-02-29 12:00:00"), Some(951_825_600.0));
        assert_relative_eq!(time_s("2011-09-26 13:02:25.9").unwrap(), 1_317_042_145.9);
        for wrong in ["", "2011-09-26", "2011-13-26 1:2:3", "x-1-1 1:1:1"] {
            assert_eq!(time_s(wrong), None);
        }
    }

    #[test]
    fn a_drive_to_the_east_and_north_has_its_length() {
        let folder = tempfile::tempdir().unwrap();
        let data = folder.path().join("oxts/data");
        fs::create_dir_all(&data).unwrap();
        let identity = "R: 1 0 0 0 1 0 0 0 1\nT: -0.81 0.32 -0.8\n";
        fs::write(folder.path().join("calib_imu_to_velo.txt"), identity).unwrap();
        for (number, (lat, lon)) in [(49.0, 8.4), (49.0001, 8.4), (49.0, 8.4001)]
            .into_iter()
            .enumerate()
        {
            fs::write(
                data.join(format!("{number:010}.txt")),
                format!("{lat} {lon} 110 0 0 1.5 0 0\n"),
            )
            .unwrap();
        }
        let (poses, imu_from_lidar) = read(&folder.path().join("oxts")).unwrap();
        // A ten-thousandth of a degree of a great circle, and of the parallel.
        let degree_m = EARTH_RADIUS_M * 1e-4_f64.to_radians();
        assert_relative_eq!(poses[1].translation.y, degree_m, epsilon = 1e-3);
        assert_relative_eq!(
            poses[2].translation.x,
            degree_m * 49_f64.to_radians().cos(),
            epsilon = 1e-3
        );
        assert_relative_eq!(poses[0].translation.vector.norm(), 0.0);
        assert_relative_eq!(imu_from_lidar.cam0_from_lidar.translation.x, 0.81);
    }
}
