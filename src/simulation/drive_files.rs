//! A drive on disk, in the layout of KITTI.
//!
//! ```text
//! velodyne/000000.bin ...         points
//! labels/000000.label ...         SemanticKITTI class of each point
//! calib.txt times.txt odometry.txt
//! imu.csv                         only where the configuration has an inertial sensor
//! given_poses.txt poses_in_map.txt    only where the configuration gives poses with errors
//! gnss.csv                        only where there is a receiver
//! poses.txt                       written last
//! ```

use std::fs::File;
use std::io::{self, BufWriter};
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use rayon::prelude::*;

use super::gnss::write_fixes;
use super::{Simulation, calibration};
use crate::files::write_atomically;
use crate::geometry::Pose3;
use crate::recording::MapFrame;
use crate::recording::imu::write_table;
use crate::recording::poses::{write_kitti, write_times};
use crate::recording::velodyne;

/// True poses, written last.
pub const POSES_FILE: &str = "poses.txt";
/// Poses with the errors of the configuration; only where it has some.
pub const GIVEN_POSES_FILE: &str = "given_poses.txt";
/// True poses in the map that is built with the given poses of drive 1; only where these have errors.
pub const POSES_IN_MAP_FILE: &str = "poses_in_map.txt";

const CALIBRATION_FILE: &str = "calib.txt";
const TIMES_FILE: &str = "times.txt";
const IMU_FILE: &str = "imu.csv";
const GNSS_FILE: &str = "gnss.csv";

/// A file of a drive that cannot be written.
#[derive(Debug, thiserror::Error)]
#[error("cannot write {}", path.display())]
pub struct DriveFileError {
    path: PathBuf,
    source: io::Error,
}

/// Paths of the points and of the labels of a scan.
pub fn scan_files(folder: &Path, frame: usize) -> [PathBuf; 2] {
    [
        folder.join(format!("velodyne/{frame:06}.bin")),
        folder.join(format!("labels/{frame:06}.label")),
    ]
}

/// Name of a file of poses, and how they follow.
type PoseTable = (&'static str, fn(&Simulation) -> Vec<Pose3>);

/// Files of scans in a folder, of any number of frames.
pub fn all_scan_files(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let mut paths = Vec::new();
    for (name, extension) in [("velodyne", "bin"), ("labels", "label")] {
        for entry in folder.join(name).read_dir().into_iter().flatten() {
            let path = entry?.path();
            paths.extend(Some(path).filter(|it| it.extension().is_some_and(|it| it == extension)));
        }
    }
    Ok(paths)
}

impl Simulation {
    /// Paths of all files of the drive in a folder.
    pub fn files_in(&self, folder: &Path) -> Vec<PathBuf> {
        let poses = self.tables().into_iter().map(|(name, _)| name);
        let imu = self.config.imu.grade.map(|_| IMU_FILE);
        let tables = [CALIBRATION_FILE, TIMES_FILE].into_iter().chain(imu);
        let gnss = self.config.gnss.is_on().then_some(GNSS_FILE);
        let tables = tables.chain(gnss);
        let tables = tables.chain(poses);
        let scans = (0..self.frames()).flat_map(|frame| scan_files(folder, frame));
        tables.map(|name| folder.join(name)).chain(scans).collect()
    }

    /// Writes a scan into the folders `velodyne` and `labels`, which must exist.
    pub fn write_scan(&self, folder: &Path, frame: usize) -> Result<(), DriveFileError> {
        let [scan_path, label_path] = scan_files(folder, frame);
        let labelled = self.scan(frame);
        write(&label_path, |file| {
            velodyne::write_labels(file, &labelled.classes)
        })?;
        write(&scan_path, |file| {
            velodyne::write_scan(file, &labelled.scan)
        })
    }

    /// Writes the scans that are missing until `written`, which is called after each, breaks; returns the number of
    /// scans that are there, and of those that were.
    pub fn write_missing_scans(
        &self,
        folder: &Path,
        written: &(dyn Fn() -> ControlFlow<()> + Sync),
    ) -> Result<[usize; 2], DriveFileError> {
        let (done, kept) = (AtomicUsize::new(0), AtomicUsize::new(0));
        let is_ended = AtomicBool::new(false);
        (0..self.frames()).into_par_iter().try_for_each(|frame| {
            if is_ended.load(Ordering::Relaxed) {
                return Ok(());
            }
            if scan_files(folder, frame).iter().all(|path| path.exists()) {
                kept.fetch_add(1, Ordering::Relaxed);
            } else {
                self.write_scan(folder, frame)?;
            }
            done.fetch_add(1, Ordering::Relaxed);
            is_ended.fetch_or(written().is_break(), Ordering::Relaxed);
            Ok(())
        })?;
        Ok([done.into_inner(), kept.into_inner()])
    }

    /// Writes calibration, times, fixes, odometry and, last, the poses.
    pub fn write_tables(&self, folder: &Path) -> Result<(), DriveFileError> {
        // The frame of the poses is the world frame of the street.
        let frame = MapFrame {
            calibration: calibration(),
            world_from_first_cam0: Pose3::identity(),
        };
        let world_from_map = frame.world_from_map();
        let times_s = self.times_s();
        write(&folder.join(CALIBRATION_FILE), |file| {
            frame.calibration.write(file)
        })?;
        write(&folder.join(TIMES_FILE), |file| write_times(file, &times_s))?;
        if self.config.imu.grade.is_some() {
            let samples = self.imu_samples();
            write(&folder.join(IMU_FILE), |file| write_table(file, &samples))?;
        }
        if self.config.gnss.is_on() {
            write(&folder.join(GNSS_FILE), |file| {
                write_fixes(file, &self.fixes().map_err(io::Error::other)?)
            })?;
        }
        for (name, poses) in self.tables() {
            let poses = poses(self);
            write(&folder.join(name), |file| {
                write_kitti(file, &poses, &world_from_map, &frame.calibration)
            })?;
        }
        Ok(())
    }

    /// Names and poses of the files of poses, in the order in which they are written.
    fn tables(&self) -> Vec<PoseTable> {
        let mut tables: Vec<PoseTable> = vec![("odometry.txt", Self::odometry)];
        if self.config.given_poses.has_errors() {
            tables.push((GIVEN_POSES_FILE, Self::given_poses));
            tables.push((POSES_IN_MAP_FILE, Self::poses_in_map));
        }
        tables.push((POSES_FILE, Self::poses));
        tables
    }
}

fn write(
    path: &Path,
    write: impl FnOnce(&mut BufWriter<&mut File>) -> io::Result<()>,
) -> Result<(), DriveFileError> {
    write_atomically(path, write).map_err(|source| DriveFileError {
        path: path.to_owned(),
        source,
    })
}
