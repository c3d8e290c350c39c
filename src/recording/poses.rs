//! Camera poses (`poses.txt`), times (`times.txt`) and TUM trajectories.

use std::io::{self, Write};
use std::path::Path;

use nalgebra::Quaternion;

use super::calibration::Calibration;
use super::error::RecordingError;
use super::table::{pose_from_row, position, read_rows, rotation, row_array, row_from_pose};
use crate::geometry::{Pose3, StampedPose};

/// Camera poses of a recording, one per frame: `p_world = world_from_cam0 * p_cam0`.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraPoses {
    /// One pose per frame, at least one.
    pub world_from_cam0: Vec<Pose3>,
}

impl CameraPoses {
    /// Reads rows of twelve numbers.
    pub fn read(path: &Path) -> Result<Self, RecordingError> {
        let world_from_cam0 = read_rows(path)?
            .iter()
            .map(|(line, row)| pose_from_row(row, path, *line))
            .collect::<Result<Vec<_>, _>>()?;
        if world_from_cam0.is_empty() {
            return Err(RecordingError::NoPoses {
                path: path.to_owned(),
            });
        }
        Ok(Self { world_from_cam0 })
    }

    /// The frame of the first lidar pose.
    pub fn frame(&self, calibration: &Calibration) -> MapFrame {
        MapFrame {
            calibration: *calibration,
            world_from_first_cam0: self.world_from_cam0[0],
        }
    }

    /// The lidar poses in the frame of the first one; see `MapFrame::map_from_lidar`.
    pub fn map_from_lidar(&self, calibration: &Calibration) -> Vec<Pose3> {
        let frame = self.frame(calibration);
        self.world_from_cam0
            .iter()
            .map(|pose| frame.map_from_lidar(pose))
            .collect()
    }
}

/// Reads the rows of a pose file, of KITTI (12 numbers) or TUM (8 numbers, with times [s]).
pub fn read_rows_of_poses(path: &Path) -> Result<(CameraPoses, Option<Vec<f64>>), RecordingError> {
    match CameraPoses::read(path) {
        Ok(poses) => Ok((poses, None)),
        Err(RecordingError::WrongCount { found: 8, .. }) => {
            let rows = read_tum(path)?;
            let poses = CameraPoses {
                world_from_cam0: rows.iter().map(|row| row.map_from_lidar).collect(),
            };
            Ok((poses, Some(rows.iter().map(|row| row.time_s).collect())))
        }
        Err(error) => Err(error),
    }
}

/// The frame of a recording: that of its first lidar pose.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapFrame {
    /// Calibration of the recording.
    pub calibration: Calibration,
    /// First camera pose of the recording.
    pub world_from_first_cam0: Pose3,
}

impl MapFrame {
    /// The lidar pose of a camera pose: `map_from_lidar = inv(Tr) * inv(P₀) * P * Tr`.
    pub fn map_from_lidar(&self, world_from_cam0: &Pose3) -> Pose3 {
        let cam0_from_lidar = self.calibration.cam0_from_lidar;
        cam0_from_lidar.inverse()
            * self.world_from_first_cam0.inverse()
            * world_from_cam0
            * cam0_from_lidar
    }

    /// Frame of these lidar poses in the world of the camera poses: `p_world = world_from_map * p_map`.
    pub fn world_from_map(&self) -> Pose3 {
        self.world_from_first_cam0 * self.calibration.cam0_from_lidar
    }
}

/// Writes lidar poses as camera poses in the world of `world_from_map`, as in `poses.txt`: the upper 3 × 4 of each matrix,
/// row-major.
///
/// # Errors
/// Those of the writer.
pub fn write_kitti(
    mut writer: impl Write,
    map_from_lidar: &[Pose3],
    world_from_map: &Pose3,
    calibration: &Calibration,
) -> io::Result<()> {
    map_from_lidar.iter().try_for_each(|pose| {
        writeln!(
            writer,
            "{}",
            row_from_pose(&calibration.world_from_cam0(world_from_map, pose))
        )
    })
}

/// Writes `time x y z qx qy qz qw` rows [s, m] of lidar poses in the map frame.
///
/// # Errors
/// Those of the writer.
pub fn write_tum(mut writer: impl Write, trajectory: &[StampedPose]) -> io::Result<()> {
    trajectory.iter().try_for_each(|pose| {
        let t = pose.map_from_lidar.translation.vector;
        let q = pose.map_from_lidar.rotation.coords;
        writeln!(
            writer,
            "{:.6} {:.6} {:.6} {:.6} {:.9} {:.9} {:.9} {:.9}",
            pose.time_s, t.x, t.y, t.z, q.x, q.y, q.z, q.w
        )
    })
}

/// Writes rows as [`write_tum`] with all digits: [`read_tum`] returns the same numbers, if the quaternions are normalized.
pub fn write_exact_tum(mut writer: impl Write, trajectory: &[StampedPose]) -> io::Result<()> {
    trajectory.iter().try_for_each(|pose| {
        let t = pose.map_from_lidar.translation.vector;
        let q = pose.map_from_lidar.rotation.coords;
        writeln!(
            writer,
            "{:?} {:?} {:?} {:?} {:?} {:?} {:?} {:?}",
            pose.time_s, t.x, t.y, t.z, q.x, q.y, q.z, q.w
        )
    })
}

/// Reads `time x y z qx qy qz qw` rows [s, m] of lidar poses (TUM); frames are numbered by row.
///
/// # Errors
/// The file cannot be read, or a row does not have eight numbers of a pose.
pub fn read_tum(path: &Path) -> Result<Vec<StampedPose>, RecordingError> {
    read_rows(path)?
        .iter()
        .enumerate()
        .map(|(frame, (line, row))| {
            let [time_s, x, y, z, qx, qy, qz, qw] =
                row_array(row, path, *line, "time x y z qx qy qz qw")?;
            check_time(time_s, path, *line)?;
            let rotation = rotation(Quaternion::new(qw, qx, qy, qz), path, *line)?;
            Ok(StampedPose {
                frame,
                time_s,
                map_from_lidar: Pose3::from_parts(position(x, y, z, path, *line)?, rotation),
            })
        })
        .collect()
}

/// Reads `times.txt`, one number per row [s].
///
/// # Errors
/// The file cannot be read, or its numbers do not ascend.
pub fn read_times(path: &Path) -> Result<Vec<f64>, RecordingError> {
    read_rows(path)?
        .iter()
        .map(|(line, row)| {
            let [time_s] = row_array(row, path, *line, "seconds")?;
            check_time(time_s, path, *line)
        })
        .collect()
}

/// Returns a time that a clock can show, from 1653 to 2286 if it counts from 1970 [s].
pub fn check_time(time_s: f64, path: &Path, line: usize) -> Result<f64, RecordingError> {
    if time_s.abs() <= 1e10 {
        return Ok(time_s);
    }
    Err(RecordingError::OutOfRange {
        path: path.to_owned(),
        line,
        value: time_s,
        quantity: "time",
        limit: "1e10 s; times are in seconds",
    })
}

/// Returns times that ascend [s].
pub(super) fn ascending(path: &Path, times_s: Vec<f64>) -> Result<Vec<f64>, RecordingError> {
    match times_s.windows(2).position(|pair| pair[1] <= pair[0]) {
        Some(frame) => Err(RecordingError::TimesDoNotAscend {
            path: path.to_owned(),
            frame: frame + 1,
            time_s: times_s[frame + 1],
            previous_s: times_s[frame],
        }),
        None => Ok(times_s),
    }
}

/// Writes `times.txt`, one number per row [s].
///
/// # Errors
/// Those of the writer.
pub fn write_times(mut writer: impl Write, times_s: &[f64]) -> io::Result<()> {
    (times_s.iter()).try_for_each(|time_s| writeln!(writer, "{time_s:.6e}"))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;

    fn poses() -> Vec<Pose3> {
        (0..4)
            .map(|i| {
                let i = f64::from(i);
                Pose3::new(
                    Vector3::new(i, 0.1 * i, 0.0),
                    Vector3::new(0.0, 0.01 * i, 0.2 * i),
                )
            })
            .collect()
    }

    #[test]
    fn camera_poses_and_lidar_poses_are_inverse_conversions() {
        let calibration = Calibration {
            cam0_from_lidar: Pose3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(1.2, -1.2, 1.2)),
        };
        let first = Pose3::new(Vector3::new(5.0, 6.0, 7.0), Vector3::new(0.3, 0.2, 0.1));
        let pose = Pose3::new(Vector3::new(9.0, 6.5, 7.0), Vector3::new(0.4, 0.2, 0.1));
        let frame = MapFrame {
            calibration,
            world_from_first_cam0: first,
        };
        let map_from_lidar = frame.map_from_lidar(&pose);
        let back = calibration.world_from_cam0(&frame.world_from_map(), &map_from_lidar);
        assert_relative_eq!(back, pose, epsilon = 1e-12);
        let origin = frame.map_from_lidar(&first);
        assert_relative_eq!(origin, Pose3::identity(), epsilon = 1e-12);
    }

    #[test]
    fn recordings_with_different_first_poses_share_the_world_frame() {
        let calibration = Calibration {
            cam0_from_lidar: Pose3::new(Vector3::new(0.1, -0.2, 0.3), Vector3::new(1.2, -1.2, 1.2)),
        };
        let frame = |world_from_first_cam0| MapFrame {
            calibration,
            world_from_first_cam0,
        };
        let first = Pose3::new(Vector3::new(5.0, 6.0, 7.0), Vector3::new(0.3, 0.2, 0.1));
        let later = Pose3::new(Vector3::new(9.0, 6.5, 7.0), Vector3::new(0.4, 0.2, 0.1));
        let [world_from_map, world_from_recording] =
            [first, later].map(|pose| frame(pose).world_from_map());
        let map_from_recording = world_from_map.inverse() * world_from_recording;
        let expected = frame(first).map_from_lidar(&later);
        assert_relative_eq!(map_from_recording, expected, epsilon = 1e-12);
    }

    #[test]
    fn kitti_rows_read_back_as_the_lidar_poses_that_were_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("poses.txt");
        let calibration = Calibration {
            cam0_from_lidar: Pose3::new(
                Vector3::new(0.0, -0.1, -0.3),
                Vector3::new(1.2, -1.2, 1.2),
            ),
        };
        let first = Pose3::new(Vector3::new(1.0, 2.0, 3.0), Vector3::new(0.1, 0.2, 0.3));
        let frame = MapFrame {
            calibration,
            world_from_first_cam0: first,
        };
        write_kitti(
            fs::File::create(&path).unwrap(),
            &poses(),
            &frame.world_from_map(),
            &calibration,
        )
        .unwrap();
        let back = CameraPoses::read(&path)
            .unwrap()
            .map_from_lidar(&calibration);
        for (a, b) in poses().iter().zip(&back) {
            assert_relative_eq!(a, b, epsilon = 1e-7);
        }
    }

    #[test]
    fn a_tum_trajectory_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tum.txt");
        let trajectory: Vec<StampedPose> = poses()
            .into_iter()
            .enumerate()
            .map(|(frame, map_from_lidar)| StampedPose {
                frame,
                time_s: 0.1 * frame as f64,
                map_from_lidar,
            })
            .collect();
        write_tum(fs::File::create(&path).unwrap(), &trajectory).unwrap();
        let back = read_tum(&path).unwrap();
        for (a, b) in trajectory.iter().zip(&back) {
            assert_relative_eq!(a.map_from_lidar, b.map_from_lidar, epsilon = 1e-5);
            assert_relative_eq!(a.time_s, b.time_s, epsilon = 1e-6);
        }
    }

    #[test]
    fn exact_rows_of_normalized_poses_read_back_identically() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("tum.txt");
        let pose = |frame: usize| {
            let i = frame as f64;
            let turn = Vector3::new(0.1 * i.sin(), 0.02 * i, 0.037 * i);
            let mut map_from_lidar = Pose3::new(Vector3::new(i / 3.0, 1e5 / (i + 0.7), -0.0), turn);
            map_from_lidar.rotation.renormalize();
            StampedPose {
                frame,
                time_s: 1.7e9 + i / 7.0,
                map_from_lidar,
            }
        };
        let trajectory: Vec<StampedPose> = (0..1000).map(pose).collect();
        write_exact_tum(fs::File::create(&path).unwrap(), &trajectory).unwrap();
        let back = read_tum(&path).unwrap();
        let bits = |rows: &[StampedPose]| -> Vec<[u64; 8]> {
            let numbers = |row: &StampedPose| {
                let t = row.map_from_lidar.translation.vector;
                let q = row.map_from_lidar.rotation.coords;
                [row.time_s, t.x, t.y, t.z, q.x, q.y, q.z, q.w].map(f64::to_bits)
            };
            rows.iter().map(numbers).collect()
        };
        assert!(bits(&back) == bits(&trajectory));
    }

    #[test]
    fn a_word_in_place_of_a_number_is_an_error_with_file_and_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("poses.txt");
        fs::write(
            &path,
            "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 zero 0 1 0 0 0 0 1 0\n",
        )
        .unwrap();
        let message = CameraPoses::read(&path).unwrap_err().to_string();
        assert!(message.contains("poses.txt, line 2: `zero`"), "{message}");
    }
}
