//! `calib.txt`: where the lidar sits on the camera.

use std::io::{self, Write};
use std::path::Path;

use super::KittiError;
use super::poses::CameraPoses;
use super::table::{parse_numbers, pose_from_row, read_text, row_from_pose};
use crate::geometry::Pose3;

/// The extrinsic calibration of a recording.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    /// Row `Tr`: `p_cam0 = cam0_from_lidar * p_lidar`.
    pub cam0_from_lidar: Pose3,
}

impl Calibration {
    /// Reads the line that starts with `Tr:` (or `Tr_velo_to_cam:`); other lines do not matter.
    pub fn read(path: &Path) -> Result<Self, KittiError> {
        for (index, text) in read_text(path)?.lines().enumerate() {
            let line = index + 1;
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
        Err(KittiError::NoTr {
            path: path.to_owned(),
        })
    }

    /// Writes a `calib.txt` with the line `Tr` alone.
    pub fn write(&self, mut writer: impl Write) -> io::Result<()> {
        writeln!(writer, "Tr: {}", row_from_pose(&self.cam0_from_lidar))
    }

    /// The pose of the lidar relative to its first pose, from camera poses:
    /// `map_from_lidar = inv(Tr) * inv(P₀) * P * Tr`.
    pub fn map_from_lidar(&self, world_from_first_cam0: &Pose3, world_from_cam0: &Pose3) -> Pose3 {
        self.cam0_from_lidar.inverse()
            * world_from_first_cam0.inverse()
            * world_from_cam0
            * self.cam0_from_lidar
    }

    /// The camera pose of a lidar pose; the inverse of [`map_from_lidar`](Self::map_from_lidar).
    pub fn world_from_cam0(&self, world_from_first_cam0: &Pose3, map_from_lidar: &Pose3) -> Pose3 {
        world_from_first_cam0
            * self.cam0_from_lidar
            * map_from_lidar
            * self.cam0_from_lidar.inverse()
    }
}

/// The frame of a map: that of the first lidar pose of the recording that it was built from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapFrame {
    /// The calibration of that recording.
    pub calibration: Calibration,
    /// Its first camera pose.
    pub world_from_first_cam0: Pose3,
}

impl MapFrame {
    /// Reads where a map lies from the poses and the calibration that it was built with.
    pub fn read(pose_file: &Path, calib_file: &Path) -> Result<Self, KittiError> {
        Ok(Self {
            calibration: Calibration::read(calib_file)?,
            world_from_first_cam0: CameraPoses::read(pose_file)?.world_from_cam0[0],
        })
    }

    /// `p_map = map_from_world_lidar * p`, where p is a point in the frame of the first lidar pose
    /// of another recording whose camera poses are given in the same world.
    pub fn map_from_recording(&self, recording: &Self) -> Pose3 {
        let world_from_lidar =
            recording.world_from_first_cam0 * recording.calibration.cam0_from_lidar;
        let world_from_map = self.world_from_first_cam0 * self.calibration.cam0_from_lidar;
        world_from_map.inverse() * world_from_lidar
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

    #[test]
    fn camera_poses_and_lidar_poses_are_inverse_conversions() {
        let calibration = Calibration {
            cam0_from_lidar: Pose3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(1.2, -1.2, 1.2)),
        };
        let first = Pose3::new(Vector3::new(5.0, 6.0, 7.0), Vector3::new(0.3, 0.2, 0.1));
        let pose = Pose3::new(Vector3::new(9.0, 6.5, 7.0), Vector3::new(0.4, 0.2, 0.1));
        let map_from_lidar = calibration.map_from_lidar(&first, &pose);
        let back = calibration.world_from_cam0(&first, &map_from_lidar);
        assert_relative_eq!(back, pose, epsilon = 1e-12);
        let origin = calibration.map_from_lidar(&first, &first);
        assert_relative_eq!(origin, Pose3::identity(), epsilon = 1e-12);
    }

    #[test]
    fn a_recording_that_starts_elsewhere_lies_in_the_map_where_it_is_in_the_world() {
        let calibration = Calibration {
            cam0_from_lidar: Pose3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(1.2, -1.2, 1.2)),
        };
        let frame = |world_from_first_cam0| MapFrame {
            calibration,
            world_from_first_cam0,
        };
        let first = Pose3::new(Vector3::new(5.0, 6.0, 7.0), Vector3::new(0.3, 0.2, 0.1));
        let later = Pose3::new(Vector3::new(9.0, 6.5, 7.0), Vector3::new(0.4, 0.2, 0.1));
        let map_from_recording = frame(first).map_from_recording(&frame(later));
        let expected = calibration.map_from_lidar(&first, &later);
        assert_relative_eq!(map_from_recording, expected, epsilon = 1e-12);
        let same = frame(first).map_from_recording(&frame(first));
        assert_relative_eq!(same, Pose3::identity(), epsilon = 1e-12);
    }

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
