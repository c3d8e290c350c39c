//! Which poses of a run are trusted: those of frames that are tracking.

use std::borrow::Cow;
use std::ops::Range;

use super::columns::{Column, unknown_pose};
use super::localization_results::LocalizationResults;
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::localization::State;

impl LocalizationResults {
    /// Whether the pose of each frame of [`trajectory`](Self::trajectory) is trusted; all are where no states are known.
    pub fn trusted(&self) -> Vec<bool> {
        self.tracking(self.trajectory_states())
    }

    /// Whether the filter was tracking in each frame, where its states are known.
    pub fn tracked(&self) -> Option<Vec<bool>> {
        (self.states.as_ref()).map(|states| self.tracking(Some(states)))
    }

    /// Whether the refined pose of each frame was tracked or registered in the map: all that are trusted but those that
    /// the filter did not track and no refinement compared with the map, which were filled back.
    pub fn refined_tracked(&self) -> Option<Vec<bool>> {
        let mut tracked = self.tracking(Some(self.refined_states.as_ref()?));
        let of_filter = self.tracking(self.states.as_ref());
        for (row, tracked) in tracked.iter_mut().enumerate() {
            *tracked &= of_filter[row] || !self.is_only_smoothed(row);
        }
        Some(tracked)
    }

    /// Whether a refinement compared no scan of a frame with the map: it has no cost.
    pub fn is_only_smoothed(&self, row: usize) -> bool {
        let costs_m = self.refinement_costs_m.as_ref();
        costs_m.is_some_and(|costs_m| costs_m[row][0] < 0.0)
    }

    /// States of the trajectory of the filter, where any are known.
    pub fn trajectory_states(&self) -> Option<&Column<u8>> {
        self.trajectory_states.as_ref().or(self.states.as_ref())
    }

    /// The trajectory of the filter in space, where it is known.
    pub fn trajectory_in_space(&self) -> Option<&Column<Pose3>> {
        let trajectory = self.trajectory_in_space.as_ref();
        trajectory.or(self.estimates_in_space.as_ref())
    }

    /// Whether the pose of each frame of the best trajectory is trusted: the refined one, if there is one.
    pub fn best_trusted(&self) -> Vec<bool> {
        match &self.refined {
            Some(_) => self.refined_trusted(),
            None => self.trusted(),
        }
    }

    /// Whether the refined pose of each frame is trusted.
    pub fn refined_trusted(&self) -> Vec<bool> {
        match &self.refined_states {
            Some(states) => self.tracking(Some(states)),
            None => self.trusted(),
        }
    }

    /// Whether each frame has a true pose; `None` where no truth was given.
    pub fn has_truth(&self) -> Option<Vec<bool>> {
        let planar = self.ground_truth.as_deref();
        let in_space = self.ground_truth_in_space.as_deref();
        let is_known = |row: usize| {
            planar.is_none_or(|all| !all[row].translation.x.is_nan())
                && in_space.is_none_or(|all| !all[row].translation.x.is_nan())
        };
        let is_given = planar.is_some() || in_space.is_some();
        is_given.then(|| (0..self.len()).map(is_known).collect())
    }

    /// As [`with_truth_only`](Self::with_truth_only), without a copy where all frames have a true pose.
    #[must_use]
    pub fn into_truth_only(self) -> Self {
        let known = match self.with_truth_only() {
            Cow::Owned(known) => Some(known),
            Cow::Borrowed(_) => None,
        };
        known.unwrap_or(self)
    }

    /// The results of the frames that can be evaluated: those with a true pose, where a truth was given.
    pub fn with_truth_only(&self) -> Cow<'_, Self> {
        match self.has_truth() {
            Some(known) if known.contains(&false) => {
                let rows: Vec<usize> = (0..known.len()).filter(|&row| known[row]).collect();
                Cow::Owned(self.select(&rows))
            }
            _ => Cow::Borrowed(self),
        }
    }

    fn tracking(&self, states: Option<&Column<u8>>) -> Vec<bool> {
        let is_tracking = |&state: &u8| state == State::Tracking as u8;
        states.map_or_else(
            || vec![true; self.len()],
            |states| states.iter().map(is_tracking).collect(),
        )
    }

    /// The estimates, where frames before the first tracked one were filled back with them.
    pub fn trajectory<'a>(&self, estimates: &'a [Pose2]) -> Cow<'a, [Pose2]> {
        self.trajectory_in_space
            .as_ref()
            .map_or(estimates.into(), |poses| {
                poses.iter().map(pose2_from_pose3).collect()
            })
    }
}

/// Poses of which those that are not trusted are gaps: not a number, which pictures leave out.
pub fn with_gaps(poses: &[Pose2], trusted: &[bool]) -> Vec<Pose2> {
    let gap = pose2_from_pose3(&unknown_pose());
    (poses.iter().zip(trusted))
        .map(|(pose, &is_trusted)| if is_trusted { *pose } else { gap })
        .collect()
}

/// Rows of each stretch of trusted poses.
pub fn stretches(trusted: &[bool]) -> impl Iterator<Item = Range<usize>> {
    let rows: Vec<usize> = (0..trusted.len()).filter(|&row| trusted[row]).collect();
    let all: Vec<Range<usize>> = (rows.chunk_by(|&a, &b| a + 1 == b))
        .map(|rows| rows[0]..rows[0] + rows.len())
        .collect();
    all.into_iter()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::distances_m;

    #[test]
    fn a_gap_is_bridged_by_a_straight_line_and_what_is_before_the_first_trusted_pose_is_no_way() {
        let poses = [100.0, 1.0, 2.0, -70.0, 5.0, 80.0].map(|x| Pose2::translation(x, 0.0));
        let trusted = [false, true, true, false, true, false];
        let with_gaps = with_gaps(&poses, &trusted);
        assert_eq!(distances_m(&with_gaps), [0.0, 0.0, 1.0, 1.0, 4.0, 4.0]);
        for (pose, is_trusted) in with_gaps.iter().zip(trusted) {
            let numbers = [pose.translation.x, pose.rotation.angle()];
            assert_eq!(numbers.map(|it| !it.is_nan()), [is_trusted; 2]);
        }
    }

    #[test]
    fn the_states_of_a_trajectory_precede_those_of_the_filter() {
        let [searching, tracking] = [State::Searching, State::Tracking].map(|it| it as u8);
        let mut results = LocalizationResults {
            frames: vec![3, 4].into(),
            ..LocalizationResults::default()
        };
        assert_eq!(results.trusted(), [true, true]);
        results.states = Some(vec![searching, tracking].into());
        assert_eq!(results.refined_trusted(), [false, true]);
        results.trajectory_states = Some(vec![tracking, tracking].into());
        assert_eq!(results.trusted(), [true, true]);
        results.refined_states = Some(vec![tracking, searching].into());
        assert_eq!(results.refined_trusted(), [true, false]);
    }
}
