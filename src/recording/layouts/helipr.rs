//! HeLiPR: four lidars on a car, an OS2-128, a VLP-16, a Livox Avia and an Aeva.
//!
//! Jung et al., *HeLiPR: Heterogeneous LiDAR Dataset for inter-LiDAR Place Recognition under Spatiotemporal Variations* (2024), and
//! its file player: a folder of scans per lidar, whose names are times [ns], and poses of each lidar itself, rows
//! `time x y z qx qy qz qw` [ns, m].

use std::path::Path;

use super::super::error::RecordingError;
use super::super::layout::{Layout, RecordingFiles};
use super::super::scan_files::point_table::NumberType::{self, F32, I32, U8, U16, U32};
use super::super::scan_files::records::{PointFormat, RecordFormat};
use super::super::scan_list;
use super::named::{BodyPoses, NamedLayout, choose};
use super::rows;
use crate::geometry::Pose3;

pub const HELIPR: NamedLayout = NamedLayout {
    layout: Layout::Helipr,
    needs: "LiDAR/ with Aeva/, Avia/, Ouster/ or Velodyne/",
    find,
    poses,
};

/// The lidars, by the names of their folders, and their points.
static LIDARS: [(&str, RecordFormat); 4] = [
    ("Aeva", RecordFormat::in_metres(&AEVA)),
    (
        "Avia",
        RecordFormat::in_metres(&[
            ("x", F32),
            ("y", F32),
            ("z", F32),
            ("reflectivity", U8),
            ("tag", U8),
            ("line", U8),
            ("time", U32),
        ]),
    ),
    (
        "Ouster",
        RecordFormat::in_metres(&[
            ("x", F32),
            ("y", F32),
            ("z", F32),
            ("intensity", F32),
            ("time", U32),
            ("reflectivity", U16),
            ("ring", U16),
            ("ambient", U16),
        ]),
    ),
    (
        "Velodyne",
        RecordFormat::in_metres(&[
            ("x", F32),
            ("y", F32),
            ("z", F32),
            ("intensity", F32),
            ("ring", U16),
            ("time", F32),
        ]),
    ),
];

/// Points of the Aeva.
static AEVA: [(&str, NumberType); 8] = [
    ("x", F32),
    ("y", F32),
    ("z", F32),
    ("reflectivity", F32),
    ("velocity", F32),
    ("time", I32),
    ("line", U8),
    ("intensity", F32),
];

/// Those of its first sessions have no intensity.
static AEVA_WITHOUT_INTENSITY: RecordFormat = RecordFormat::in_metres(AEVA.split_at(7).0);

/// The last scan of the Aeva without intensities [s].
const LAST_WITHOUT_INTENSITY_S: f64 = 1_691_936_557.946_849;

fn find(folder: &Path, part: Option<&str>) -> Result<Option<RecordingFiles>, RecordingError> {
    // The folder of a lidar names it.
    let mut lidars = LIDARS.iter().map(|(name, _)| *name);
    let inner = lidars.find(|name| folder.ends_with(format!("LiDAR/{name}")));
    let base = match inner {
        Some(_) => folder.ancestors().nth(2).unwrap_or(folder),
        None => folder,
    };
    let exists = |(name, _): &&(&str, RecordFormat)| base.join("LiDAR").join(name).is_dir();
    let names: Vec<String> = (LIDARS.iter().filter(exists))
        .map(|(name, _)| (*name).to_owned())
        .collect();
    if names.is_empty() {
        return Ok(None);
    }
    let name = choose(folder, "lidars", &names, part.or(inner))?;
    let scans = base.join("LiDAR").join(name);
    let mut records = LIDARS.iter().find(|(it, _)| *it == name).map(|(_, it)| it);
    if name == "Aeva" {
        let first_s = scan_list::scan_files(&scans)?[0].time_s;
        if first_s.is_some_and(|first_s| first_s <= LAST_WITHOUT_INTENSITY_S) {
            records = Some(&AEVA_WITHOUT_INTENSITY);
        }
    }
    let format = PointFormat {
        records,
        order: None,
    };
    let poses = base.join(format!("LiDAR_GT/global_{name}_gt.txt"));
    Ok(Some(RecordingFiles {
        format,
        part: Some(name.to_owned()),
        ..RecordingFiles::new(Layout::Helipr, scans, poses)
    }))
}

fn poses(_files: &RecordingFiles, path: &Path) -> Result<BodyPoses, RecordingError> {
    let rows = rows::read(path, 8, |row| {
        Ok((row.time_s(0, 1e-9)?, row.position_and_quaternion(1)?))
    })?;
    Ok(BodyPoses::timed(rows, Pose3::identity()))
}
