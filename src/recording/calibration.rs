//! `calib.txt`: the pose of the lidar relative to the camera.

use std::io::{self, Write};
use std::path::Path;

use super::error::RecordingError;
use super::table::{parse_numbers, pose_from_row, read_text, row_from_pose};
use crate::geometry::Pose3;

/// The extrinsic calibration of a recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    /// Row `Tr`: `p_cam0 = cam0_from_lidar * p_lidar`.
    pub cam0_from_lidar: Pose3,
}

impl Calibration {
    /// The calibration of a recording whose poses are those of the lidar.
    pub fn identity() -> Self {
        Self {
            cam0_from_lidar: Pose3::identity(),
        }
    }

    /// Reads the line that starts with `Tr:` (or `Tr_velo_to_cam:`); other lines are ignored.
    ///
    /// # Errors
    /// The file cannot be read, or has no such line of 12 numbers.
    pub fn read(path: &Path) -> Result<Self, RecordingError> {
        for (line, text) in (1..).zip(read_text(path)?.lines()) {
            let Some((key, numbers)) = text.split_once(':') else {
                continue;
            };
            if matches!(key.trim(), "Tr" | "Tr_velo_to_cam") {
                let row = parse_numbers(numbers, path, line)?;
                return Ok(Self {
                    cam0_from_lidar: pose_from_row(&row, path, line)?,
                });
            }
        }
        Err(RecordingError::NoTr {
            path: path.to_owned(),
        })
    }

    /// Writes a `calib.txt` that contains only the line `Tr`.
    ///
    /// # Errors
    /// Those of the writer.
    pub fn write(&self, mut writer: impl Write) -> io::Result<()> {
        writeln!(writer, "Tr: {}", row_from_pose(&self.cam0_from_lidar))
    }

    /// Camera pose of a lidar pose given in a map: `world_from_cam0 = world_from_map * map_from_lidar * inv(Tr)`.
    pub(crate) fn world_from_cam0(&self, world_from_map: &Pose3, map_from_lidar: &Pose3) -> Pose3 {
        world_from_map * map_from_lidar * self.cam0_from_lidar.inverse()
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn a_written_calibration_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("calib.txt");
        let calibration = Calibration {
            cam0_from_lidar: Pose3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(1.2, -1.2, 1.2)),
        };
        calibration
            .write(std::fs::File::create(&path).unwrap())
            .unwrap();
        let back = Calibration::read(&path).unwrap();
        assert_relative_eq!(
            back.cam0_from_lidar,
            calibration.cam0_from_lidar,
            epsilon = 1e-8
        );
    }
}
