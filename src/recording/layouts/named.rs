//! What the layout of a data set consists of.

use std::path::Path;

use super::super::calibration::Calibration;
use super::super::error::RecordingError;
use super::super::layout::{Layout, RecordingFiles};
use super::super::poses::CameraPoses;
use crate::geometry::Pose3;

/// The layout of a data set.
pub struct NamedLayout {
    /// Its name.
    pub layout: Layout,
    /// Files and folders by which a folder is recognized, for messages.
    pub needs: &'static str,
    /// The files of a folder, of the named one of several lidars or scenes; `None` if it is not in this layout.
    pub find: fn(&Path, Option<&str>) -> Result<Option<RecordingFiles>, RecordingError>,
    /// Reads the poses, whose file exists.
    pub poses: fn(&RecordingFiles, &Path) -> Result<BodyPoses, RecordingError>,
}

/// Poses of the body on which the lidar is mounted.
pub struct BodyPoses {
    /// Poses: `p_world = world_from_body * p_body`.
    pub world_from_body: Vec<Pose3>,
    /// Their times [s]; `None`: the number of a scan is the row of its pose.
    pub times_s: Option<Vec<f64>>,
    /// The lidar on the body.
    pub body_from_lidar: Pose3,
}

impl BodyPoses {
    /// Poses by their times, in rows.
    pub fn timed(rows: Vec<(f64, Pose3)>, body_from_lidar: Pose3) -> Self {
        let (times_s, world_from_body) = rows.into_iter().unzip();
        Self {
            world_from_body,
            times_s: Some(times_s),
            body_from_lidar,
        }
    }

    /// The body in the place of the camera, its calibration, and the times.
    pub fn into_track(self) -> (CameraPoses, Calibration, Option<Vec<f64>>) {
        let poses = CameraPoses {
            world_from_cam0: self.world_from_body,
        };
        let calibration = Calibration {
            cam0_from_lidar: self.body_from_lidar,
        };
        (poses, calibration, self.times_s)
    }
}

/// The folder of a recording, which may be given as the folder of its scans.
pub fn base<'f>(folder: &'f Path, scans: &str) -> &'f Path {
    if !folder.ends_with(scans) {
        return folder;
    }
    let depth = Path::new(scans).components().count();
    folder.ancestors().nth(depth).unwrap_or(folder)
}

/// The one of several lidars or scenes that is named, or the only one.
pub fn choose<'n>(
    path: &Path,
    kind: &'static str,
    names: &'n [String],
    part: Option<&str>,
) -> Result<&'n str, RecordingError> {
    /// Names in a message.
    const LISTED: usize = 10;
    let error = |part: Option<&str>| {
        let mut known = names[..names.len().min(LISTED)].join(", ");
        if names.len() > LISTED {
            known += &format!(" and {} others", names.len() - LISTED);
        }
        RecordingError::ChoosePart {
            path: path.to_owned(),
            kind,
            named: part.map_or_else(String::new, |part| format!(", and none is {part}")),
            known,
        }
    };
    match (part, names) {
        (None, [only]) => Ok(only),
        (None, _) => Err(error(None)),
        (Some(part), _) => (names.iter())
            .find(|name| name.eq_ignore_ascii_case(part))
            .map(String::as_str)
            .ok_or_else(|| error(Some(part))),
    }
}
