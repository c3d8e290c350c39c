//! The report of a run: a JSON file for programs, a verdict and tables for people.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context as _, Result, anyhow};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::live_summary::LiveSummary;
use super::refinement_summary::RefinementSummary;
use super::rows::{MetricRow, Value, consistency_rows, length, metric_rows, metrics, spatial_rows};
use super::run_summary::RunSummary;
use crate::app::run::visible::visible_in_line;
use crate::evaluation::{Consistency, RangeMclErrors, SpatialMetrics, TrajectoryMetrics};

/// The most important rows of a run without true poses. A report of every kind has at most twelve such rows.
const MAIN_OF_RUN: [&str; 6] = [
    "frames",
    "tracking",
    "path",
    "position sigma median",
    "heading sigma median",
    "agreement median",
];
/// Those of a refinement without true poses.
const MAIN_OF_REFINEMENT: [&str; 5] = [
    "refused frames",
    "moved median",
    "moved max",
    "cost median",
    "beams on the map median",
];
/// Those of errors in a map.
const MAIN_OF_ERRORS: [&str; 6] = [
    "position RMSE",
    "position median",
    "position max",
    "heading RMSE",
    "heading max",
    "runtime p50",
];
/// Those of errors of a trajectory in space.
const MAIN_IN_SPACE: [&str; 11] = [
    "position in space RMSE",
    "position in space max",
    "height RMSE",
    "rotation RMSE",
    "position at the end",
    "aligned position RMSE",
    "segments 100-800 m, translation",
    "segments 100-800 m, rotation",
    "segments 5-50 m, translation",
    "segments 5-50 m, rotation",
    "distance in space",
];

/// Errors of one trajectory.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TrajectoryReport {
    /// Errors as range-mcl's evaluation script computes them.
    pub range_mcl: RangeMclErrors,
    /// Errors as defined in the literature.
    pub metrics: TrajectoryMetrics,
    /// Errors in six degrees of freedom, where the poses in space are known.
    #[serde(default)]
    pub in_space: Option<SpatialMetrics>,
    /// Errors against the covariances of the poses, where these are known.
    #[serde(default)]
    pub consistency: Option<Consistency>,
}

impl TrajectoryReport {
    /// All rows: those of range-mcl first.
    pub fn rows(&self) -> Vec<MetricRow> {
        let errors = &self.range_mcl;
        let range_mcl = metrics! {
            "range-mcl success" [""] errors.success.map_or(Value::NotChecked, Value::Flag), "position error under converge_thres at every convergence_interval-th row";
            "range-mcl RMSE location" ["m"] errors.rmse_location_m, "position RMSE from row convergence_interval on, as range-mcl computes it, over all frames";
            "range-mcl RMSE yaw" ["deg"] errors.rmse_yaw_deg, "heading RMSE from row convergence_interval on, as range-mcl computes it, over all frames";
        };
        let in_space = self.in_space.as_ref().map_or_else(Vec::new, spatial_rows);
        let consistency = consistency_rows(self.consistency.as_ref());
        [range_mcl, metric_rows(&self.metrics), consistency, in_space].concat()
    }
}

/// Errors of a run: `report.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Report {
    /// Inputs and settings by name: the recording, the map, the odometry and its source, the
    /// seed, the renderer.
    pub about: BTreeMap<String, String>,
    /// Whether at least half of the frames were tracked by the filter, or, where there is a refined trajectory, tracked or
    /// registered in the map by the refinement; frames that were filled back do not count. `None` where no states are known.
    #[serde(default)]
    pub localized: Option<bool>,
    /// What the run shows without the true poses.
    #[serde(default)]
    pub summary: RunSummary,
    /// Scans, latencies and states of a run of `live`.
    #[serde(default)]
    pub live: Option<LiveSummary>,
    /// What the refinement did, if there was one.
    #[serde(default)]
    pub refinement: Option<RefinementSummary>,
    /// Whether the true poses are known.
    #[serde(default)]
    pub has_true_poses: bool,
    /// Errors of the filter's estimates in the frames in which it was tracking; `None` without true poses or such frames.
    pub mcl: Option<TrajectoryReport>,
    /// Errors of the refined trajectory in the frames in which it is trusted, if there is one and they are any.
    pub refined: Option<TrajectoryReport>,
    /// Errors of a trajectory that is not a result in a map.
    #[serde(default)]
    pub trajectory: Option<SpatialMetrics>,
}

impl Report {
    /// Reads `report.json`.
    pub fn read_json(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        serde_json::from_str(&text).map_err(|error| {
            anyhow!(
                "{} is not a report of fpmcl: {error}; run evaluate again",
                path.display()
            )
        })
    }

    /// The verdict and a table for the terminal: one column per trajectory, numbers right-aligned. The main rows
    /// only, or all of them with the inputs and settings.
    pub fn to_text(&self, all: bool) -> String {
        let mut rows = self.joined_rows();
        let count = rows.len();
        rows.retain(|(row, _)| all || self.is_main(row));
        let width = rows.iter().map(|(row, _)| row.name.len()).max();
        let width = width.unwrap_or(0);
        let mut text = format!("{}\n\n", self.verdict());
        if all && !self.about.is_empty() {
            text += &(self.about_lines() + "\n");
        }
        let line = |name: &str, mcl: &str, refined: &str, unit: &str| {
            let line = format!("{name:width$}  {mcl:>10}  {refined:>10}  {unit}");
            line.trim_end().to_owned() + "\n"
        };
        let refined_title = if self.is_refined() { "refined" } else { "" };
        text += &line("", self.estimate_title(), refined_title, "unit");
        for (row, refined) in &rows {
            let refined = refined.map_or(String::new(), |value| value.to_string());
            text += &line(row.name, &row.value.to_string(), &refined, row.unit);
        }
        if rows.len() < count {
            text += &format!("{} more rows: --all\n", count - rows.len());
        }
        text
    }

    /// Whether a row is among the most important ones of this report.
    pub fn is_main(&self, row: &MetricRow) -> bool {
        // In a map the planar errors are the main ones.
        let has_errors = self.mcl.is_some() || self.refined.is_some();
        let is_other = MAIN_OF_REFINEMENT.contains(&row.name) || MAIN_IN_SPACE.contains(&row.name);
        MAIN_OF_RUN.contains(&row.name)
            || MAIN_OF_ERRORS.contains(&row.name)
            || (is_other && !has_errors)
    }

    /// What the run found, in one or two sentences.
    pub fn verdict(&self) -> String {
        let found = self.trajectory.is_none().then(|| self.summary.verdict());
        let live = self.live.as_ref().map(LiveSummary::verdict);
        let refined = self.refinement.as_ref().map(RefinementSummary::verdict);
        let errors = [&self.mcl, &self.refined].map(|it| it.as_ref().map(|it| &it.metrics));
        let accuracy = match (accuracy(errors), &self.trajectory) {
            (Some(accuracy), _) => accuracy,
            (None, Some(trajectory)) => {
                let aligned = trajectory.aligned_position_m.as_ref();
                let aligned =
                    aligned.map(|it| format!(", {} after rigid alignment", length(it.rmse)));
                format!(
                    "{} and {:.2} deg (RMS) from the true poses over {:.0} m{}.",
                    length(trajectory.position_m.rmse),
                    trajectory.rotation_rad.rmse.to_degrees(),
                    trajectory.distance_m,
                    aligned.unwrap_or_default()
                )
            }
            (None, None) if self.has_true_poses => {
                "No trusted pose can be compared with the true poses.".to_owned()
            }
            (None, None) => "No true poses were given.".to_owned(),
        };
        let parts = found.into_iter().chain(live).chain(refined);
        parts.chain([accuracy]).collect::<Vec<_>>().join(" ")
    }

    /// The same table in Markdown, with definitions.
    pub fn to_markdown(&self) -> String {
        let mut text = String::new();
        for (name, value) in &self.about {
            // Names from outside are no markup, in a span of code.
            let value = visible_in_line(value).replace('`', "'");
            text += &format!("- {name}: `{value}`\n");
        }
        let [title, rule] = if self.is_refined() {
            [" refined |", "---:|"]
        } else {
            ["", ""]
        };
        text += &format!(
            "\n| | {} |{title} unit | definition |\n|---|---:|{rule}---|---|\n",
            self.estimate_title()
        );
        for (row, refined) in self.joined_rows() {
            let refined = match (self.is_refined(), refined) {
                (false, _) => String::new(),
                (true, None) => " |".to_owned(),
                (true, Some(value)) => format!(" {value} |"),
            };
            let MetricRow {
                name, value, unit, ..
            } = row;
            // A bar inside a cell would end the cell.
            let definition = row.definition.replace('|', "\\|");
            text += &format!("| {name} | {value} |{refined} {unit} | {definition} |\n");
        }
        text
    }

    /// Rows of the summary, then each error of the filter with that of the refined trajectory; no row of which
    /// nothing is known.
    pub fn joined_rows(&self) -> Vec<(MetricRow, Option<Value>)> {
        let mut refined = self.refined.iter().flat_map(TrajectoryReport::rows);
        let errors = self.mcl.iter().flat_map(TrajectoryReport::rows);
        let errors = errors.chain(self.trajectory.iter().flat_map(spatial_rows));
        let mut errors: Vec<_> = errors
            .map(|row| (row, refined.next().map(|row| row.value)))
            .collect();
        errors.extend(refined.map(MetricRow::of_refined));
        let refinement = self.refinement.as_ref();
        let mut of_refined = refinement.into_iter().flat_map(|it| it.trajectory.rows());
        let summary = self.summary.rows().into_iter();
        let summary = summary.map(|row| (row, of_refined.next().map(|row| row.value)));
        let summary: Vec<_> = summary
            .chain(refinement.iter().flat_map(|it| it.rows()))
            .chain(
                self.live
                    .iter()
                    .flat_map(LiveSummary::rows)
                    .map(|row| (row, None)),
            )
            .collect();
        let is_known = |(row, refined): &(MetricRow, Option<Value>)| {
            row.value != Value::Absent || refined.is_some_and(|value| value != Value::Absent)
        };
        summary.into_iter().chain(errors).filter(is_known).collect()
    }

    /// Whether there is a refined trajectory.
    pub fn is_refined(&self) -> bool {
        self.refined.is_some() || self.refinement.is_some()
    }

    /// Title of the column of the errors.
    pub fn estimate_title(&self) -> &'static str {
        match self.trajectory {
            Some(_) => "estimate",
            None => "MCL",
        }
    }

    /// Errors in six degrees of freedom of each trajectory that has them, with its name.
    pub fn in_space(&self) -> Vec<(&'static str, &SpatialMetrics)> {
        let [mcl, refined] = [&self.mcl, &self.refined]
            .map(|report| report.as_ref().and_then(|it| it.in_space.as_ref()));
        let title = self.estimate_title();
        [
            (title, self.trajectory.as_ref()),
            (title, mcl),
            ("refined", refined),
        ]
        .into_iter()
        .filter_map(|(name, metrics)| Some((name, metrics?)))
        .collect()
    }

    fn about_lines(&self) -> String {
        (self.about.iter())
            .map(|(name, value)| format!("{name}: {}\n", visible_in_line(value)))
            .collect()
    }
}

/// Errors of the filter and of the refined trajectory against true poses in a sentence; `None` without any.
fn accuracy([mcl, refined]: [Option<&TrajectoryMetrics>; 2]) -> Option<String> {
    let errors = |it: &TrajectoryMetrics, of: &str| {
        let [rmse, worst] = [it.position_m.rmse, it.position_m.max].map(length);
        let heading_deg = it.heading_rad.rmse.to_degrees();
        let frames = match it.untrusted_frames {
            0 => String::new(),
            untrusted => {
                format!(
                    " in the {} of {} frames that are trusted",
                    it.frames,
                    it.frames + untrusted
                )
            }
        };
        format!("{rmse} and {heading_deg:.3} deg (RMS){of}{frames}, at most {worst}")
    };
    const FROM: &str = " from the true poses";
    match (mcl, refined) {
        (Some(mcl), Some(refined)) => Some(format!(
            "{}; refined {}.",
            errors(mcl, FROM),
            errors(refined, "")
        )),
        (Some(mcl), None) => Some(format!("{}.", errors(mcl, FROM))),
        (None, Some(refined)) => Some(format!("Refined {}.", errors(refined, FROM))),
        (None, None) => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::{EvaluatedTrajectory, MetricsConfig, RangeMclRules};
    use crate::geometry::Pose2;

    fn trajectory(error_m: f64) -> TrajectoryReport {
        let truth: Vec<Pose2> = (0..300)
            .map(|k| Pose2::translation(f64::from(k), 0.0))
            .collect();
        let shift = Pose2::translation(0.0, error_m);
        let estimates: Vec<Pose2> = truth.iter().map(|pose| shift * pose).collect();
        let trajectory = EvaluatedTrajectory {
            estimates: &estimates,
            ground_truth: &truth,
            times_s: None,
            runtimes_s: Some(&[0.0125; 300]),
            trusted: None,
        };
        TrajectoryReport {
            range_mcl: RangeMclRules::default().evaluate(&estimates, &truth),
            metrics: TrajectoryMetrics::new(&trajectory, &MetricsConfig::default()).unwrap(),
            in_space: None,
            consistency: None,
        }
    }

    fn report() -> Report {
        Report {
            about: [("odometry".to_owned(), "from file".to_owned())].into(),
            localized: None,
            summary: RunSummary::default(),
            live: None,
            refinement: None,
            has_true_poses: true,
            mcl: Some(trajectory(0.25)),
            refined: Some(trajectory(0.02)),
            trajectory: None,
        }
    }

    #[test]
    fn a_report_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("report.json");
        std::fs::write(&path, serde_json::to_string_pretty(&report()).unwrap()).unwrap();
        // To the last digit of every number.
        assert_eq!(Report::read_json(&path).unwrap(), report());
        std::fs::write(&path, "{\"mcl\": 3}").unwrap();
        let message = Report::read_json(&path).unwrap_err().to_string();
        assert!(message.contains("report.json is not a report"), "{message}");
    }

    #[test]
    fn columns_are_aligned_and_units_stand_next_to_the_numbers() {
        let text = report().to_text(true);
        let line = |name: &str| text.lines().find(|line| line.starts_with(name)).unwrap();
        let words: Vec<&str> = line("position RMSE").split_whitespace().collect();
        assert_eq!(words, ["position", "RMSE", "0.2500", "0.0200", "m"]);
        let ends: Vec<usize> = text
            .lines()
            .filter(|line| line.contains("RMSE") && line.ends_with(" m"))
            .map(str::len)
            .collect();
        assert!(
            ends.len() >= 6 && ends.iter().all(|end| *end == ends[0]),
            "{text}"
        );
        assert!(line("runtime p50").ends_with("ms"), "{text}");
    }

    #[test]
    fn the_verdict_comes_first_and_at_most_twelve_rows_without_all() {
        let report = report();
        let (short, all) = (report.to_text(false), report.to_text(true));
        let verdict =
            "25.0 cm and 0.000 deg (RMS) from the true poses, at most 25.0 cm; refined 2.0 cm";
        assert!(short.lines().next().unwrap().contains(verdict), "{short}");
        let rows = |text: &str| text.lines().filter(|line| line.contains("  ")).count() - 1;
        assert!(rows(&short) <= 12 && rows(&all) > 30, "{short}");
        let rest = format!("{} more rows: --all", rows(&all) - rows(&short));
        assert!(short.contains(&rest), "{short}");
        assert!(!all.lines().any(|line| line.ends_with("  -")), "{all}");
    }

    #[test]
    fn every_row_of_the_markdown_table_has_as_many_cells() {
        let mut both = report();
        for cells in [5, 4] {
            let markdown = both.to_markdown();
            let table: Vec<&str> = markdown
                .lines()
                .filter(|line| line.starts_with('|'))
                .collect();
            assert!(table.len() > 30);
            for line in table {
                let bars = line.replace("\\|", "").matches('|').count();
                assert_eq!(bars, cells + 1, "{line}");
            }
            both.refined = None;
        }
    }

    #[test]
    fn names_from_outside_are_no_markup_in_the_report() {
        let mut named = report();
        let name = "`<b>x</b>`\n| \u{1b}[2Jmap\u{202e}".to_owned();
        named.about = [("map".to_owned(), name)].into();
        let markdown = named.to_markdown();
        let first = markdown.lines().next().unwrap();
        assert_eq!(first.matches('`').count(), 2, "{first}");
        assert!(first.starts_with("- map: `'<b>x</b>'"), "{first}");
        assert!(first.ends_with('`') && !first.contains(['\u{1b}', '\u{202e}']));
    }

    #[test]
    fn numbers_keep_four_digits() {
        for (number, text) in [
            (0.018_93, "0.0189"),
            (1.234_56, "1.235"),
            (123.456, "123.5"),
            (12_345.6, "12346"),
            (-0.5, "-0.5000"),
            (0.0, "0.0000"),
        ] {
            assert_eq!(Value::Number(number).to_string(), text);
        }
    }
}
