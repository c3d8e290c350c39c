//! What a refinement did, without the true poses.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::columns::Column;
use super::localization_results::LocalizationResults;
use super::rows::{MetricRow, Value, length, metrics};
use super::run_summary::RunSummary;
use crate::evaluation::{PlanarError, Summary};
use crate::geometry::Pose2;

/// How far a refinement moved the poses, how well they fit the map before and after it, and which it refused.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default)]
pub struct RefinementSummary {
    /// The refined trajectory.
    pub trajectory: RunSummary,
    /// Number of frames that were refined.
    pub refined: usize,
    /// Number of frames that were not placed in the map, and are not in the trajectory.
    pub refused: usize,
    /// Distance of the refined pose from the estimate, of refined frames where both are trusted [m].
    pub moved_m: Option<Summary>,
    /// Turn between them [rad].
    pub turned_rad: Option<Summary>,
    /// Mean cost of the differences to the map before and after the refinement of a frame [m].
    pub cost_m: Option<[Summary; 2]>,
    /// Share of the compared beams that agree with the map before and after (unitless).
    pub agreement: Option<[Summary; 2]>,
}

impl RefinementSummary {
    /// The summary of results with their estimates; `None` if they are not refined.
    pub fn of(results: &LocalizationResults, estimates: &[Pose2]) -> Option<Self> {
        let trajectory = RunSummary::of_refined(results)?;
        let refined = results.refined.as_deref()?;
        let (before, after) = (results.trusted(), results.refined_trusted());
        let trajectory_before = results.trajectory(estimates);
        let (moves_m, turns_rad) = (0..refined.len().min(trajectory_before.len()))
            .filter(|&row| before[row] && after[row] && !results.is_only_smoothed(row))
            .map(|row| PlanarError::between(&refined[row], &trajectory_before[row]))
            .map(|it| (it.distance_m(), it.turn_rad))
            .unzip();
        let known = |column: &Option<Column<[f64; 2]>>| -> Vec<[f64; 2]> {
            let rows = column.iter().flatten().zip(&after);
            rows.filter(|(pair, trusted)| **trusted && pair.iter().all(|&it| it >= 0.0))
                .map(|(pair, _)| *pair)
                .collect()
        };
        let both = |pairs: &[[f64; 2]]| {
            let [before, after] = [0, 1].map(|moment| {
                let values: Vec<f64> = pairs.iter().map(|pair| pair[moment]).collect();
                Summary::new(&values)
            });
            Some([before?, after?])
        };
        let costs_m = known(&results.refinement_costs_m);
        let summary = |values: Vec<f64>| Summary::new(&values);
        Some(Self {
            trajectory,
            refined: costs_m.len(),
            refused: after.iter().filter(|trusted| !**trusted).count(),
            moved_m: summary(moves_m),
            turned_rad: summary(turns_rad),
            cost_m: both(&costs_m),
            agreement: both(&known(&results.refinement_agreements)),
        })
    }

    /// What the refinement did, in a sentence.
    pub fn verdict(&self) -> String {
        let moved = self.moved_m.as_ref().map(|moved| {
            let [median, most] = [moved.median, moved.max].map(length);
            format!(", moved by {median} (median), at most {most}")
        });
        let refused = match self.refused {
            0 => String::new(),
            count => format!("; {count} refused, which could not be placed in the map"),
        };
        let shortfall = match self.trajectory.localized() {
            Some(false) => " Less than half of the frames are tracked or registered in the map.",
            Some(true) | None => "",
        };
        format!(
            "Refined {} of {} frames{}{refused}.{shortfall}",
            self.refined,
            self.trajectory.frames,
            moved.unwrap_or_default()
        )
    }

    /// Rows of the report: of the estimates, and of the refined trajectory.
    pub fn rows(&self) -> Vec<(MetricRow, Option<Value>)> {
        let median = |pair: &Option<[Summary; 2]>, moment: usize| {
            pair.as_ref().map(|pair| pair[moment].median)
        };
        let [before, after] = [0, 1].map(|moment| {
            metrics! {
                "cost median" ["m"] median(&self.cost_m, moment), "mean cost of the differences between a scan and the map, before and after the refinement of its frame";
                "beams on the map median" [""] median(&self.agreement, moment), "share of the compared beams that end on a surface of the map, before and after the refinement of their frame";
            }
        });
        let (moved, turned) = (self.moved_m.as_ref(), self.turned_rad.as_ref());
        let of_refined = metrics! {
            "refined frames" [""] self.refined, "number of frames that were refined";
            "refused frames" [""] self.refused, "number of frames that were not placed in the map, and are not in the refined trajectory";
            "moved median" ["m"] moved.map(|it| it.median), "distance of the refined pose from the estimate";
            "moved max" ["m"] moved.map(|it| it.max), "the frame that was moved most";
            "turned median" ["deg"] turned.map(|it| it.median.to_degrees()), "magnitude of the turn from the estimate to the refined pose";
            "turned max" ["deg"] turned.map(|it| it.max.to_degrees()), "the frame that was turned most";
        };
        let of_refined = of_refined.into_iter().map(MetricRow::of_refined);
        let of_both = before.into_iter().zip(after);
        let of_both = of_both.map(|(before, after)| (before, Some(after.value)));
        of_refined.chain(of_both).collect()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "a failing test may panic")]
mod tests {
    use super::*;

    #[test]
    fn frames_that_were_only_smoothed_do_not_count_as_moved() {
        let at = |x: f64| Pose2::translation(x, 0.0);
        let estimates: Vec<Pose2> = (0..4).map(|row| at(f64::from(row))).collect();
        let mut refined = estimates.clone();
        refined[0] = at(7.0);
        refined[2] = at(2.25);
        let mut results = LocalizationResults {
            frames: (0..4).collect(),
            refined: Some(refined.into()),
            refined_states: Some(vec![1; 4].into()),
            states: Some(vec![1; 4].into()),
            refinement_costs_m: Some(vec![[-1.0; 2], [0.2, 0.1], [0.2, 0.1], [-1.0; 2]].into()),
            ..LocalizationResults::default()
        };
        let summary = RefinementSummary::of(&results, &estimates).unwrap();
        let moved_m = summary.moved_m.as_ref().unwrap();
        // One of the two refined ones by 0.25 m, the other not at all.
        assert_eq!(
            (summary.refined, moved_m.mean, moved_m.max),
            (2, 0.125, 0.25)
        );
        assert!(!summary.verdict().contains("Less than half"));

        results.refined_states = Some(vec![1, 0, 0, 0].into());
        let summary = RefinementSummary::of(&results, &estimates).unwrap();
        assert_eq!((summary.refused, summary.moved_m.is_none()), (3, true));
        let verdict = summary.verdict();
        assert!(verdict.contains("Less than half"), "{verdict}");
    }
}
