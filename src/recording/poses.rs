//! `poses.txt` (camera poses, 3x4 rows), `times.txt`, and TUM trajectories.

use std::io::{self, Write};
use std::path::Path;

use nalgebra::{Quaternion, Translation3, UnitQuaternion};

use super::table::{pose_from_row, read_rows, row_from_pose};
use super::{Calibration, KittiError};
use crate::geometry::{Pose3, StampedPose, Trajectory};

/// Camera poses of a recording, one per frame: `p_world = world_from_cam0 * p_cam0`.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraPoses {
    /// One per frame, at least one.
    pub world_from_cam0: Vec<Pose3>,
}

impl CameraPoses {
    /// Reads rows of twelve numbers.
    pub fn read(path: &Path) -> Result<Self, KittiError> {
        let world_from_cam0 = read_rows(path)?
            .iter()
            .map(|(line, row)| pose_from_row(row, path, *line))
            .collect::<Result<Vec<_>, _>>()?;
        if world_from_cam0.is_empty() {
            return Err(KittiError::NoPoses {
                path: path.to_owned(),
            });
        }
        Ok(Self { world_from_cam0 })
    }

    /// The lidar poses in the frame of the first one; see [`Calibration::map_from_lidar`].
    pub fn map_from_lidar(&self, calibration: &Calibration) -> Vec<Pose3> {
        self.world_from_cam0
            .iter()
            .map(|pose| calibration.map_from_lidar(&self.world_from_cam0[0], pose))
            .collect()
    }
}

/// Writes lidar poses as camera poses in the convention of the recording's `poses.txt`
/// whose first pose is `world_from_first_cam0`.
pub fn write_kitti(
    mut writer: impl Write,
    map_from_lidar: &[Pose3],
    world_from_first_cam0: &Pose3,
    calibration: &Calibration,
) -> io::Result<()> {
    let rows: String = map_from_lidar
        .iter()
        .map(|pose| row_from_pose(&calibration.world_from_cam0(world_from_first_cam0, pose)) + "\n")
        .collect();
    writer.write_all(rows.as_bytes())
}

/// Writes `time x y z qx qy qz qw` rows of lidar poses in the map frame.
pub fn write_tum(mut writer: impl Write, trajectory: &Trajectory) -> io::Result<()> {
    let rows: String = trajectory
        .poses
        .iter()
        .map(|pose| {
            let t = pose.map_from_lidar.translation.vector;
            let q = pose.map_from_lidar.rotation.coords;
            format!(
                "{:.6} {:.6} {:.6} {:.6} {:.9} {:.9} {:.9} {:.9}\n",
                pose.time_s, t.x, t.y, t.z, q.x, q.y, q.z, q.w
            )
        })
        .collect();
    writer.write_all(rows.as_bytes())
}

/// Reads a TUM trajectory; frames are numbered by row.
pub fn read_tum(path: &Path) -> Result<Trajectory, KittiError> {
    read_rows(path)?
        .iter()
        .enumerate()
        .map(|(frame, (line, row))| {
            let &[time_s, x, y, z, qx, qy, qz, qw] = &row[..] else {
                return Err(KittiError::WrongCount {
                    path: path.to_owned(),
                    line: *line,
                    found: row.len(),
                    expected: 8,
                    layout: "time x y z qx qy qz qw",
                });
            };
            let quaternion = Quaternion::new(qw, qx, qy, qz);
            if (quaternion.norm() - 1.0).abs() > 0.01 {
                return Err(KittiError::NotARotation {
                    path: path.to_owned(),
                    line: *line,
                });
            }
            Ok(StampedPose {
                frame,
                time_s,
                map_from_lidar: Pose3::from_parts(
                    Translation3::new(x, y, z),
                    UnitQuaternion::from_quaternion(quaternion),
                ),
            })
        })
        .collect()
}

/// Reads `times.txt`, one number a row [s].
pub fn read_times(path: &Path) -> Result<Vec<f64>, KittiError> {
    read_rows(path)?
        .iter()
        .map(|(line, row)| match row[..] {
            [time_s] => Ok(time_s),
            _ => Err(KittiError::WrongCount {
                path: path.to_owned(),
                line: *line,
                found: row.len(),
                expected: 1,
                layout: "seconds",
            }),
        })
        .collect()
}

/// Writes `times.txt` [s].
pub fn write_times(mut writer: impl Write, times_s: &[f64]) -> io::Result<()> {
    let rows: String = times_s.iter().map(|time| format!("{time:.6e}\n")).collect();
    writer.write_all(rows.as_bytes())
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
        write_kitti(
            fs::File::create(&path).unwrap(),
            &poses(),
            &first,
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
        let trajectory: Trajectory = poses()
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
        for (a, b) in trajectory.poses.iter().zip(&back.poses) {
            assert_relative_eq!(a.map_from_lidar, b.map_from_lidar, epsilon = 1e-5);
            assert_relative_eq!(a.time_s, b.time_s, epsilon = 1e-6);
        }
    }

    #[test]
    fn a_word_where_a_number_belongs_is_told_with_file_and_line() {
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
