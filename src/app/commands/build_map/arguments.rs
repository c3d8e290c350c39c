//! Arguments of `build-map`.

use std::path::Path;

use clap::Args;
use serde::Serialize;

use crate::app::run::{RecordingArgs, RunArgs};
use crate::file_path::FilePath;
use crate::recording::scan_files;

/// Arguments of `build-map`.
#[derive(Clone, Debug, Args, Serialize)]
pub struct BuildMapArgs {
    /// Configuration and machine.
    #[command(flatten)]
    #[serde(flatten)]
    pub run: RunArgs,

    /// The recording.
    #[command(flatten)]
    #[serde(flatten)]
    pub recording: RecordingArgs,

    /// Map to write; sets the key `mesh_file`.
    #[arg(long = "output", value_name = "MAP")]
    pub mesh_file: Option<FilePath>,

    /// Poses of the recording, rows of KITTI or TUM, or a topic of the bag; by default those that it contains, else from the scans. Sets the key `pose_file`.
    #[arg(long = "poses", value_name = "FILE")]
    pub pose_file: Option<FilePath>,

    /// Calibration of the camera whose poses these are; sets the key `calib_file`.
    #[arg(long = "calib", value_name = "FILE")]
    pub calib_file: Option<FilePath>,

    /// Inertial sensor whose rates predict rotations and compensate scans, and whose forces make poses level that are found from the scans: a table of times, rates and forces, a folder oxts, or a topic of the bag; sets the key `imu_file`.
    #[arg(long = "imu", value_name = "FILE")]
    pub imu_file: Option<FilePath>,

    /// Positions of a GNSS receiver, which give the map its place on the Earth: sentences of NMEA, rows of time, latitude,
    /// longitude and height, a folder oxts, or a topic of the bag; sets the key `gnss_file`.
    #[arg(long = "gnss", value_name = "SOURCE")]
    pub gnss_file: Option<FilePath>,

    /// Map to which the recording is added: it is localized there, and what has changed is replaced. Sets the key `onto`.
    #[arg(long, value_name = "MAP")]
    pub onto: Option<FilePath>,

    /// Find the poses, print one independent command per local map that is not finished, and exit.
    #[arg(long, group = "part")]
    #[serde(skip)]
    pub list_jobs: bool,

    /// Build one local map only, by its number.
    #[arg(long, value_name = "NUMBER", group = "part")]
    #[serde(skip)]
    pub job: Option<usize>,

    /// Join the local maps that jobs have built.
    #[arg(long, group = "part")]
    #[serde(skip)]
    pub collect: bool,
}

/// A part of the work of `build-map`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BuildPart {
    /// Find the poses, and print a command per local map that is not finished.
    List,
    /// Build a local map by its number.
    LocalMap(usize),
    /// Join the finished local maps.
    Collect,
}

impl BuildMapArgs {
    /// The key whose value is the input.
    pub fn input_key(&self) -> &'static str {
        let is_cloud = |path: &Path| path.is_file() && scan_files::is_scan(path);
        if self.run.source.input().is_some_and(is_cloud) {
            "cloud_file"
        } else {
            "scan_folder"
        }
    }

    /// The part of the work that is asked for; `None` for all of it.
    pub fn part(&self) -> Option<BuildPart> {
        if self.list_jobs {
            return Some(BuildPart::List);
        }
        let collect = self.collect.then_some(BuildPart::Collect);
        self.job.map(BuildPart::LocalMap).or(collect)
    }
}
