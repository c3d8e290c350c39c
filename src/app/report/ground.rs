//! What `ground` leaves behind: `ground.json`, its table, membership functions, and scans from above.

use std::path::Path;

use anyhow::Result;
use schemars::JsonSchema;
use serde::Serialize;

use super::plotting::color::SERIES;
use super::plotting::{GroundPlot, LineChart, Panel, Series};
use crate::evaluation::{GroundMethodReport, GroundProtocol, LabelledPoints};
use crate::file_path::FilePath;
use crate::ground::{Features, FuzzyConfig};

/// The result of a run.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct GroundReport {
    /// Folder of the scans, or the scan.
    pub scans_from: FilePath,
    /// Number of scans.
    pub scans: usize,
    /// Number of scans with labels.
    pub labelled_scans: usize,
    /// Number of points of all scans.
    pub points: usize,
    /// Number of threads.
    pub threads: usize,
    /// The configured method, then the others.
    pub methods: Vec<GroundMethodReport>,
}

impl GroundReport {
    /// Formats the table: both protocols side by side if there are labels.
    pub fn to_text(&self) -> String {
        let plural = if self.threads == 1 { "" } else { "s" };
        let mut text = format!(
            "{} scans of {}, {} with labels, {} points, {} thread{plural}\n",
            self.scans,
            self.scans_from.display(),
            self.labelled_scans,
            self.points,
            self.threads,
        );
        let mut columns = String::new();
        if self.labelled_scans > 0 {
            let protocols = ["Patchwork++", "Patchwork"]
                .map(|name| format!("  {:-^35}", format!(" protocol of {name} [%] ")));
            text += &format!("{:<22}{}\n", "", protocols.concat());
            let scores = ["precision", "recall", "F1", "IoU"];
            columns = scores_row(scores.map(str::to_owned)).repeat(2);
        }
        text += &format!("{:<22}{columns}  ms/scan  ground\n", "method");
        for method in &self.methods {
            text += &format!("{:<22}", method.name);
            let scores = [&method.patchwork_plus_plus, &method.patchwork];
            for scores in scores.into_iter().flatten() {
                let scores = [scores.precision, scores.recall, scores.f1, scores.iou];
                text += &scores_row(scores.map(|score| format!("{:.2}", 100.0 * score)));
            }
            let percent = 100.0 * method.ground_share;
            text += &format!("  {:>7.1}  {percent:>4.1} %\n", method.ms_per_scan);
        }
        text
    }
}

fn scores_row([precision, recall, f1, iou]: [String; 4]) -> String {
    format!("  {precision:>9} {recall:>8} {f1:>8} {iou:>7}")
}

/// Samples of a membership function.
const SAMPLES: u16 = 401;
/// Distances ahead and to the sides up to which a scan is drawn [m].
const REACH_M: (f64, f64) = (50.0, 35.0);

/// Draws the membership functions of all fuzzy sets, one panel per linguistic variable.
pub fn draw_memberships(config: &FuzzyConfig, path: &Path) -> Result<()> {
    let mut panels = Vec::new();
    for (variable, sets) in &config.variables {
        let (from, to) = config.chart_range(variable);
        let series = sets.iter().zip(SERIES.iter().cycle());
        let series = series.map(|((set, function), &color)| {
            let sample = |sample| {
                let x = from + f32::from(sample) / f32::from(SAMPLES - 1) * (to - from);
                (x.into(), function.degree(x).into())
            };
            Series::line(set, color, (0..SAMPLES).map(sample))
        });
        panels.push(Panel {
            y_name: "membership".to_owned(),
            own_x_name: Some(name_with_unit(variable)),
            series: series.collect(),
            ..Panel::default()
        });
    }
    let chart = LineChart {
        title: "Membership functions".to_owned(),
        panels,
        ..LineChart::default()
    };
    chart.save(path)
}

/// `height_variance` becomes `height variance [m]`; the output has no unit.
fn name_with_unit(variable: &str) -> String {
    let words = variable.replace('_', " ");
    let mut units = Features::NAMES.iter().zip(Features::UNITS);
    match units.find(|(name, _)| **name == variable) {
        Some((_, unit)) => format!("{words} [{unit}]"),
        None => words,
    }
}

/// Name of the picture of a scan.
pub fn file_name(name: &Path) -> String {
    format!("scan_{}.png", name.display()).replace(['/', '\\'], "_")
}

/// Draws a scan from above.
pub fn draw_scan(
    folder: &Path,
    name: &Path,
    scan: &LabelledPoints,
    (confidences, threshold): (&[f32], f32),
) -> Result<()> {
    let protocol = GroundProtocol::PatchworkPlusPlus;
    let truth = scan.truth(protocol);
    let mut title = format!("Ground of scan {}", name.display());
    if !truth.is_empty() {
        let f1 = scan.score(protocol, confidences, threshold, |_| true).f1();
        title += &format!(", F1 {:.2} %", 100.0 * f1);
    }
    let called_ground: Vec<bool> = confidences.iter().map(|&c| c > threshold).collect();
    GroundPlot {
        title: &title,
        points: &scan.points,
        called_ground: &called_ground,
        truth: &truth,
        reach_m: REACH_M,
    }
    .save(&folder.join(file_name(name)))
}
