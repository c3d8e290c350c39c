//! Layouts of published data sets. Each is a [`NamedLayout`] in a file of its own: how a folder is recognized, how the points of
//! a scan are stored, and where the poses are and of which body.

mod apollo;
mod boreas;
mod helipr;
mod kitti360;
mod mulran;
mod named;
mod nclt;
mod newer_college;
mod nuscenes;
mod paris_luco;
mod rows;

use std::path::Path;

use self::named::{BodyPoses, NamedLayout};
use super::error::RecordingError;
use super::layout::{Layout, RecordingFiles};
use super::track::PoseTrack;

/// All layouts of data sets; a folder is in the first one that recognizes it.
const NAMED: [&NamedLayout; 9] = [
    &kitti360::KITTI_360,
    &mulran::MULRAN,
    &nclt::NCLT,
    &boreas::BOREAS,
    &helipr::HELIPR,
    &newer_college::NEWER_COLLEGE,
    &nuscenes::NUSCENES,
    &apollo::APOLLO,
    &paris_luco::PARIS_LUCO,
];

/// Finds the files of a recording in a folder: in a layout, or in the one that its files show. Of several lidars or scenes in the
/// folder, `part` names one.
pub fn find(
    folder: &Path,
    layout: Option<Layout>,
    part: Option<&str>,
) -> Result<RecordingFiles, RecordingError> {
    for named in NAMED {
        if layout.is_none_or(|layout| layout == named.layout)
            && let Some(files) = (named.find)(folder, part)?
        {
            return Ok(files);
        }
    }
    let refused = |needs| RecordingError::NotInLayout {
        path: folder.to_owned(),
        layout: layout.map_or("", Layout::name),
        needs,
    };
    if let Some(named) = named(layout) {
        return Err(refused(named.needs));
    }
    match layout {
        None => Ok(RecordingFiles::find(folder)),
        Some(Layout::Folder) => Ok(RecordingFiles {
            layout: Layout::Folder,
            scans: folder.to_owned(),
            ..RecordingFiles::find(folder)
        }),
        Some(Layout::KittiOdometry | Layout::KittiRaw) => {
            let files = RecordingFiles::find(folder);
            if layout == Some(files.layout) {
                return Ok(files);
            }
            Err(refused(match layout {
                Some(Layout::KittiRaw) => "velodyne_points/data/",
                _ => "velodyne/",
            }))
        }
        Some(Layout::Bag) => Err(refused("an .mcap, .bag or .db3 file, or metadata.yaml")),
        Some(_) => Err(refused("scans in memory")),
    }
}

/// Reads the poses of a recording in the layout of a data set; `None` in another layout.
pub fn read_poses(files: &RecordingFiles) -> Option<Result<PoseTrack, RecordingError>> {
    let path = files.poses.as_deref()?;
    let named = named(Some(files.layout))?;
    let track = |body: BodyPoses| {
        let (poses, calibration, times_s) = body.into_track();
        let track = PoseTrack::of(path, poses, calibration, times_s)?;
        let is_partial = true;
        Ok(PoseTrack {
            is_partial,
            ..track
        })
    };
    Some((named.poses)(files, path).and_then(track))
}

fn named(layout: Option<Layout>) -> Option<&'static NamedLayout> {
    NAMED.into_iter().find(|named| Some(named.layout) == layout)
}
