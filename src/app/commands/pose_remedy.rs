//! What to do about poses that do not fit the scans.

use crate::mapping::PoseReport;
use crate::odometry::PoseMeaning;

/// What to change where poses do not fit the scans; `poses` names their key, file or topic.
pub fn remedy(report: &PoseReport, poses: &str) -> String {
    match report.better() {
        None | Some(PoseMeaning::Given) => format!(
            "; check that {poses} belongs to this recording, and that calib_file or body_from_lidar describe the body whose poses it has"
        ),
        Some(PoseMeaning::Camera) => ": give calib_file with the line Tr".to_owned(),
        Some(PoseMeaning::Lidar) => ": remove calib_file and body_from_lidar".to_owned(),
        Some(PoseMeaning::Inverse) => format!(": invert the rows of {poses}"),
        Some(PoseMeaning::Mirrored) => format!(": negate y, roll and yaw in the rows of {poses}"),
        Some(PoseMeaning::Turned(rad)) => format!(
            ": give body_from_lidar with a yaw of {:.0} degrees",
            rad.to_degrees()
        ),
    }
}
