//! Fixes of a GNSS receiver: NMEA sentences (feature `bags`), rows of a table, KITTI's `oxts`; those of a bag are in its
//! messages.

#[cfg(feature = "bags")]
mod nmea;

use std::path::Path;

use super::error::RecordingError;
use super::found_fixes::{FoundFixes, is_position};
use super::oxts;
use super::table::{parse_numbers, text_of};
use crate::georeference::{Geodetic, GeodeticFix, GeodeticFixes};
use crate::memory;

/// Reads the fixes of a file or of a folder `oxts`.
///
/// # Errors
/// The file cannot be read, has a row that is no fix, or no fix at all. Damaged sentences of NMEA are counted.
pub fn read(path: &Path) -> Result<GeodeticFixes, RecordingError> {
    if path.is_dir() {
        return oxts::read_fixes(path)?.checked(path);
    }
    let bytes = memory::read_file(path).map_err(RecordingError::read(path))?;
    #[cfg(feature = "bags")]
    if let Some(found) = nmea::parse(&String::from_utf8_lossy(&bytes)) {
        return found.checked(path);
    }
    table(&text_of(bytes, path)?, path)?.checked(path)
}

/// Reads rows of time [s], latitude, longitude [deg], height above the ellipsoid [m] and, optionally, the standard deviations
/// of the horizontal position and the height [m]; separated by commas, semicolons or spaces. A heading is skipped.
fn table(text: &str, path: &Path) -> Result<FoundFixes, RecordingError> {
    let mut found = FoundFixes::default();
    let is_heading = |line: &str| line.starts_with(|first: char| first.is_ascii_alphabetic());
    for (line, row) in (1..).zip(text.lines().map(str::trim)) {
        if row.is_empty() || row.starts_with('#') || (line == 1 && is_heading(row)) {
            continue;
        }
        let numbers = parse_numbers(&row.replace([',', ';'], " "), path, line)?;
        let (&[time_s, latitude_deg, longitude_deg, height_m], deviations) = (match numbers
            .split_first_chunk::<4>()
        {
            Some((first, rest)) if rest.len() <= 2 => Ok((first, rest)),
            _ => Err(RecordingError::WrongCount {
                path: path.to_owned(),
                line,
                found: numbers.len(),
                expected: 4,
                layout: "time latitude longitude height, then optionally two standard deviations",
            }),
        })?;
        if !is_position(latitude_deg, longitude_deg, height_m) {
            return Err(RecordingError::NotOnEarth {
                path: path.to_owned(),
                line,
                row: row.to_owned(),
            });
        }
        let deviation = |index: usize| deviations.get(index).copied().filter(|&m| m > 0.0);
        found.fixes.push(GeodeticFix {
            time_s,
            position: Geodetic {
                latitude_deg,
                longitude_deg,
                height_m,
            },
            horizontal_m: deviation(0),
            vertical_m: deviation(1),
        });
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use approx::assert_relative_eq;

    use super::*;
    use crate::georeference::HeightReference;

    fn read_of(name: &str, text: impl AsRef<[u8]>) -> Result<GeodeticFixes, RecordingError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn rows_are_the_same_with_commas_and_spaces_with_and_without_a_heading() {
        let commas = "time,latitude,longitude,height\n2,49.1,8.5,110\n1,49.0,8.4,112,0.5,1.5\n";
        let spaces = "# time\n1 49.0 8.4 112 0.5 1.5\n2 49.1 8.5 110\n";
        let [commas, spaces] = [commas, spaces].map(|text| read_of("gnss.csv", text).unwrap());
        assert_eq!(commas.fixes, spaces.fixes);
        assert_eq!(commas.fixes[0].time_s, 1.0);
        assert_eq!(commas.fixes[0].horizontal_m, Some(0.5));
        assert_eq!(commas.fixes[1].vertical_m, None);
        assert_eq!(commas.height_above, HeightReference::Ellipsoid);
    }

    #[test]
    fn a_row_that_is_no_fix_is_an_error_with_its_line() {
        for (text, words) in [
            ("1 49 8.4 110\n2 49 x 110\n", "line 2: `x` is not"),
            ("1 49 8.4\n", "line 1: 3 numbers"),
            ("1 49 8.4 1 2 3 4\n", "line 1: 7 numbers"),
            (
                "1 99 8.4 110\n",
                "line 1: `1 99 8.4 110` is not on the Earth",
            ),
            ("# nothing\n", "has no fixes"),
        ] {
            let error = read_of("gnss.txt", text).unwrap_err().to_string();
            assert!(error.contains(words), "{error}");
        }
    }

    #[cfg(feature = "bags")]
    #[test]
    fn sentences_give_time_position_height_and_deviations_and_damaged_ones_are_counted() {
        let text = "\
            $GPGGA,235959.00,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*65\r\n\
            $GPRMC,235959.00,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*48\r\n\
            $GPGST,235959.00,1.2,,,,0.8,0.6,2.5*72\r\n\
            garbage\r\n\
            1994-03-23T23:59:59Z $GPGGA,000000.00,4807.044,N,01131.000,E,4,08,0.9,545.5,M,46.9,M,,*6B\r\n\
            $GPGGA,000001.00,4807.044,N,01131.000,E,4,08,0.9,545.5,M,46.9,M,,*00\r\n\
            $GPGGA,000002.00,,,,,0,00,,,M,,M,,*4A\r\n";
        // A message of another protocol in between.
        let bytes = [text.as_bytes(), b"\xb5\x62\x01\xfe\r\n"].concat();
        let found = read_of("drive.nmea", bytes).unwrap();
        assert_eq!(
            [found.fixes.len(), found.bad_lines, found.without_position],
            [2, 3, 1]
        );
        // 1994-03-23, and the midnight after it.
        assert_eq!(found.fixes[0].time_s, 764_467_199.0);
        assert_eq!(found.fixes[1].time_s, 764_467_200.0);
        let first = found.fixes[0].position;
        assert_relative_eq!(first.latitude_deg, 48.1173, epsilon = 1e-9);
        assert_relative_eq!(first.longitude_deg, 11.516_666_667, epsilon = 1e-9);
        assert_relative_eq!(first.height_m, 592.3, epsilon = 1e-3);
        assert_eq!(found.height_above, HeightReference::Ellipsoid);
        assert_relative_eq!(
            found.fixes[0].horizontal_m.unwrap(),
            0.5_f64.sqrt(),
            epsilon = 1e-3
        );
        assert_eq!(found.fixes[0].vertical_m, Some(2.5));
    }
}
