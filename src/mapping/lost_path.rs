//! Recordings whose scans do not show the path that was driven.

use crate::odometry::Trajectory;
use crate::recording::Frame;

/// A path of which the scans show less than half.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "{unmeasured} of {scans} scans do not fit the scans before them, the first of them in frame {first}: they are too far \
     apart, in another order or have wrong times; give poses, or a recording with more scans"
)]
pub struct LostPath {
    /// Number of scans that do not fit.
    pub unmeasured: usize,
    /// Number of scans.
    pub scans: usize,
    /// Frame number of the first that does not fit.
    pub first: usize,
}

impl LostPath {
    /// What is wrong with the path of some frames; `None` where most of their scans show it.
    pub fn of(found: &Trajectory, frames: &[Frame]) -> Option<Self> {
        let is_predicted = |row: &usize| found.odometry[*row].state.is_predicted();
        let rows: Vec<usize> = (0..found.odometry.len()).filter(is_predicted).collect();
        (2 * rows.len() > found.odometry.len()).then(|| Self {
            unmeasured: rows.len(),
            scans: found.odometry.len(),
            first: frames[rows[0]].number,
        })
    }
}
