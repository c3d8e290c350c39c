//! What a run shows about itself, without the true poses.

use nalgebra::Matrix3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::columns::Column;
use super::localization_results::LocalizationResults;
use super::rows::{MetricRow, length, metrics};
use super::trusted::with_gaps;
use crate::evaluation::Summary;
use crate::geometry::{Pose2, distances_m};
use crate::localization::particles::long_axis_m;

/// States, uncertainty and agreement with the map over the frames of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct RunSummary {
    /// Number of frames.
    pub frames: usize,
    /// Number of frames in which the filter was tracking, or that were registered in the map by the refinement.
    pub tracking: Option<usize>,
    /// Number of frames before the first tracked one that were filled back from it; `None` where no states are known.
    pub filled: Option<usize>,
    /// Number of the first frame in which it was tracking.
    pub first_tracked: Option<usize>,
    /// Number of frames in which the car may have been in several places.
    pub ambiguous: Option<usize>,
    /// Length of the path along the trusted poses, across gaps by the straight line [m].
    pub path_m: f64,
    /// Mean speed [m/s]; `None` without times, and if ten frames per second were assumed.
    pub speed_m_per_s: Option<f64>,
    /// Standard deviation of the position, larger axis [m].
    pub position_sigma_m: Option<Summary>,
    /// Standard deviation of the heading [rad].
    pub heading_sigma_rad: Option<Summary>,
    /// Share of the beams above the road that agree with the map (unitless).
    pub agreement: Option<Summary>,
}

/// What is known about each frame of one trajectory.
struct Trajectory<'a> {
    poses: &'a [Pose2],
    /// Whether each pose is part of the trajectory.
    trusted: Vec<bool>,
    /// Whether each frame was tracked, or registered in the map; `None` where no states are known.
    tracked: Option<Vec<bool>>,
    covariances: Option<&'a [Matrix3<f64>]>,
}

impl RunSummary {
    /// The summary of results with their estimates. Uncertainty and agreement are those of the frames in
    /// which the filter was tracking.
    pub fn of(results: &LocalizationResults, estimates: &[Pose2]) -> Self {
        let trajectory = Trajectory {
            poses: &results.trajectory(estimates),
            trusted: results.trusted(),
            tracked: results.tracked(),
            covariances: results.covariances.as_deref(),
        };
        let several = |places: &Column<f64>| places.iter().filter(|&&it| it > 1.0).count();
        Self {
            ambiguous: results.places.as_ref().map(several),
            ..Self::of_trajectory(results, &trajectory, |row| {
                results.agreements.as_ref().map(|all| all[row])
            })
        }
    }

    /// The summary of the refined trajectory.
    pub fn of_refined(results: &LocalizationResults) -> Option<Self> {
        let trajectory = Trajectory {
            poses: results.refined.as_deref()?,
            trusted: results.refined_trusted(),
            tracked: results.refined_tracked(),
            covariances: results.refined_covariances.as_deref(),
        };
        Some(Self::of_trajectory(results, &trajectory, |row| {
            results
                .refinement_agreements
                .as_ref()
                .map(|all| all[row][1])
        }))
    }

    fn of_trajectory(
        results: &LocalizationResults,
        trajectory: &Trajectory,
        agreement: impl Fn(usize) -> Option<f64>,
    ) -> Self {
        let (states, trusted) = (trajectory.tracked.as_deref(), &trajectory.trusted);
        let is_tracked = |row: usize| states.is_none_or(|tracked| tracked[row]);
        let tracked: Vec<usize> = (0..results.len()).filter(|&row| is_tracked(row)).collect();
        let over_tracked = |value: &dyn Fn(usize) -> Option<f64>| {
            let values: Vec<f64> = tracked.iter().filter_map(|&row| value(row)).collect();
            Summary::new(&values)
        };
        let covariance = |row: usize| Some(trajectory.covariances?[row]);
        let path_m = distances_m(&with_gaps(trajectory.poses, trusted))
            .last()
            .copied()
            .unwrap_or_default();
        let times_s = results.recorded_times().unwrap_or_default().iter();
        let mut times_s = times_s.zip(trusted).filter(|(_, trusted)| **trusted);
        let duration_s = times_s.next().zip(times_s.next_back());
        let duration_s = duration_s.map(|((first_s, _), (last_s, _))| last_s - first_s);
        let filled = (0..results.len()).filter(|&row| trusted[row] && !is_tracked(row));
        Self {
            frames: results.len(),
            tracking: states.map(|_| tracked.len()),
            filled: states.map(|_| filled.count()),
            first_tracked: states.and_then(|_| Some(results.frames[*tracked.first()?])),
            ambiguous: None,
            path_m,
            speed_m_per_s: duration_s.filter(|&s| s > 0.0).map(|s| path_m / s),
            position_sigma_m: over_tracked(&|row| Some(long_axis_m(&covariance(row)?))),
            heading_sigma_rad: over_tracked(&|row| Some(covariance(row)?[(2, 2)].max(0.0).sqrt())),
            agreement: over_tracked(&|row| agreement(row).filter(|&share| share >= 0.0)),
        }
    }

    /// Whether at least half of the frames were tracked, without those that were filled back; `None` where no states are known.
    pub fn localized(&self) -> Option<bool> {
        let tracked = self.tracking?;
        Some(tracked > 0 && 2 * tracked >= self.frames)
    }

    /// Place and duration of the tracking, and how sure it is of itself, in a sentence.
    pub fn verdict(&self) -> String {
        let sure = match (&self.position_sigma_m, &self.agreement) {
            (Some(sigma), Some(agreement)) => format!(
                ", with a standard deviation of {} and {:.0} % of the beams above the road on the map (medians)",
                length(sigma.median),
                100.0 * agreement.median
            ),
            _ => String::new(),
        };
        let several = match self.ambiguous {
            Some(1) => " In 1 frame the car may have been in several places.".to_owned(),
            Some(count @ 2..) => {
                format!(" In {count} frames the car may have been in several places.")
            }
            _ => String::new(),
        };
        let filled = match self.filled.unwrap_or_default() {
            0 => String::new(),
            1 => " The frame before it was filled back by the odometry and agrees with the map."
                .to_owned(),
            count => format!(
                " {count} frames before it were filled back by the odometry and agree with the map."
            ),
        };
        match (self.first_tracked, self.tracking) {
            (Some(first), Some(tracking)) => format!(
                "Found in frame {first}, tracking in {tracking} of {} frames{sure}.{filled}{several}",
                self.frames
            ),
            (None, Some(_)) => format!(
                "Not found: tracking in none of {} frames; the poses must not be used.{several}",
                self.frames
            ),
            (_, None) => format!("{} frames{sure}.", self.frames),
        }
    }

    /// Rows of the report.
    pub fn rows(&self) -> Vec<MetricRow> {
        let position = self.position_sigma_m.as_ref();
        let heading = self.heading_sigma_rad.as_ref();
        metrics! {
            "frames" [""] self.frames, "number of localized frames";
            "tracking" [""] self.tracking, "number of frames in which the filter was tracking";
            "filled" [""] self.filled.filter(|&count| count > 0), "number of frames before the first tracked one whose poses follow from it by the odometry, and agree with the map";
            "first tracked frame" [""] self.first_tracked, "number of the first frame in which the filter was tracking";
            "ambiguous" [""] self.ambiguous.filter(|&count| count > 0), "number of frames in which the car may have been in several places";
            "path" ["m"] self.path_m, "length of the path along the poses that are trusted, across gaps by the straight line";
            "speed" ["m/s"] self.speed_m_per_s, "length of the path over its duration";
            "position sigma median" ["m"] position.map(|it| it.median), "estimated standard deviation along its larger axis, tracked frames";
            "position sigma p95" ["m"] position.map(|it| it.p95), "its 95th percentile";
            "heading sigma median" ["deg"] heading.map(|it| it.median.to_degrees()), "estimated standard deviation, tracked frames";
            "agreement median" [""] self.agreement.as_ref().map(|it| it.median), "share of the beams above the road that end on a surface of the map, tracked frames";
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::localization::State;

    #[test]
    fn a_speed_needs_times_that_were_recorded() {
        let estimates: Vec<Pose2> = (0..3)
            .map(|row| Pose2::translation(2.0 * f64::from(row), 0.0))
            .collect();
        let speed = |times_s: [f64; 3], times_are_assumed: bool| {
            let results = LocalizationResults {
                frames: vec![1, 2, 3].into(),
                times_s: Some(times_s.to_vec().into()),
                times_are_assumed,
                ..LocalizationResults::default()
            };
            RunSummary::of(&results, &estimates).speed_m_per_s
        };
        assert_eq!(speed([0.1, 0.2, 0.3], true), None);
        assert_eq!(speed([7.0, 7.5, 8.0], false), Some(4.0));
        // Recorded ones may be ten per second, too.
        assert!((speed([0.1, 0.2, 0.3], false).unwrap() - 20.0).abs() < 1e-9);
    }

    #[test]
    fn less_than_half_tracked_is_not_localized_however_many_frames_are_filled_back() {
        let states = |tracking: std::ops::Range<usize>| -> Vec<u8> {
            let state = |row: usize| u8::from(tracking.contains(&row));
            (0..30).map(state).collect()
        };
        let estimates = vec![Pose2::identity(); 30];
        let mut results = LocalizationResults {
            frames: (0..30).collect(),
            states: Some(states(1..15).into()),
            trajectory_states: Some(states(0..15).into()),
            ..LocalizationResults::default()
        };
        let summary = RunSummary::of(&results, &estimates);
        assert_eq!((summary.tracking, summary.filled), (Some(14), Some(1)));
        assert_eq!(summary.localized(), Some(false));
        // Also where the filled ones are part of a refined trajectory that has no scan of them.
        results.refined = Some(estimates.clone().into());
        results.refined_states = Some(states(0..15).into());
        let mut costs_m = vec![[0.2, 0.1]; 30];
        costs_m[0] = [-1.0; 2];
        results.refinement_costs_m = Some(costs_m.clone().into());
        let refined = |results: &_| RunSummary::of_refined(results).unwrap();
        assert_eq!(refined(&results).filled, Some(1));
        assert_eq!(refined(&results).localized(), Some(false));
        costs_m[0] = [0.2, 0.1];
        results.refinement_costs_m = Some(costs_m.into());
        assert_eq!(refined(&results).localized(), Some(true));
        results.states = Some(states(0..15).into());
        assert_eq!(RunSummary::of(&results, &estimates).localized(), Some(true));
        assert_eq!(State::Tracking as u8, 1);
    }

    #[test]
    fn uncertainty_is_that_of_the_tracked_frames() {
        let estimates = vec![Pose2::identity(); 2];
        let results = LocalizationResults {
            frames: vec![4, 5].into(),
            states: Some(vec![State::Lost as u8, State::Tracking as u8].into()),
            covariances: Some(
                [100.0, 4.0]
                    .map(nalgebra::Matrix3::from_diagonal_element)
                    .to_vec()
                    .into(),
            ),
            agreements: Some(vec![0.1, -1.0].into()),
            ..LocalizationResults::default()
        };
        let summary = RunSummary::of(&results, &estimates);
        assert_eq!(
            (summary.tracking, summary.first_tracked),
            (Some(1), Some(5))
        );
        assert!((summary.position_sigma_m.unwrap().max - 2.0).abs() < 1e-12);
        assert_eq!(summary.agreement, None);
    }
}
