//! `ground.json`, and the table on standard output.

use std::path::PathBuf;

use serde::Serialize;

use crate::evaluation::GroundMethodReport;

/// The result of a run.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GroundReport {
    /// Folder of the scans, or the scan.
    pub scans_from: PathBuf,
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
