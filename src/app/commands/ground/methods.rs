//! The methods side by side, and what is counted of each.

use std::fmt::Write as _;
use std::time::Instant;

use anyhow::{Context as _, Result};
use serde::Serialize;

use super::input::LabelledPoints;
use crate::app::config::GroundCommandConfig;
use crate::ground::{
    FuzzyConfig, FuzzyGround, GroundClassifier, GroundMethod, GroundScore, Protocol, ReportRule,
};

/// A classifier with its name in tables.
pub struct Method {
    /// In tables.
    pub name: &'static str,
    /// Does it.
    pub classifier: Box<dyn GroundClassifier>,
}

/// What is counted of a method.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    called_ground: usize,
    points: usize,
    patchwork_plus_plus: GroundScore,
    patchwork: GroundScore,
    times_ms: Vec<f64>,
}

/// A row of the table.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct MethodReport {
    /// Of the method.
    pub name: String,
    /// Median time per scan [ms].
    pub ms_per_scan: f64,
    /// Share of the points that was called ground, 0 to 1.
    pub ground_share: f64,
    /// Protocol of Patchwork++, where there are labels.
    pub patchwork_plus_plus: Option<Scores>,
    /// Protocol of Patchwork, where there are labels.
    pub patchwork: Option<Scores>,
}

/// Shares from 0 to 1, with the counts that they follow from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Scores {
    /// Of what was called ground, that which is.
    pub precision: f64,
    /// Of the ground, that which was called so.
    pub recall: f64,
    /// Harmonic mean of the two.
    pub f1: f64,
    /// Intersection over union.
    pub iou: f64,
    /// Points.
    pub counts: GroundScore,
}

impl Scores {
    fn of(counts: GroundScore) -> Self {
        Self {
            precision: counts.precision(),
            recall: counts.recall(),
            f1: counts.f1(),
            iou: counts.iou(),
            counts,
        }
    }
}

/// The chosen method first, then the others.
pub fn all(config: &GroundCommandConfig) -> Result<Vec<Method>> {
    let fuzzy = |config: FuzzyConfig| -> Result<Box<dyn GroundClassifier>> {
        let classifier = FuzzyGround::new(config).context("fuzzy: the rules of the ground")?;
        Ok(Box::new(classifier))
    };
    let own_rules = fuzzy(config.fuzzy.clone())?;
    let (pca, ransac) = (Box::new(config.pca), Box::new(config.ransac));
    let mut methods = vec![
        Method {
            name: "fuzzy",
            classifier: own_rules,
        },
        Method {
            name: "fuzzy, three features",
            classifier: fuzzy(FuzzyConfig::three_features())?,
        },
        Method {
            name: "PCA",
            classifier: pca,
        },
        Method {
            name: "RANSAC plane",
            classifier: ransac,
        },
        Method {
            name: "rule of the report",
            classifier: Box::new(ReportRule),
        },
    ];
    let chosen = match config.ground_method {
        GroundMethod::Fuzzy => 0,
        GroundMethod::Pca => 2,
        GroundMethod::Ransac => 3,
    };
    methods[..=chosen].rotate_right(1);
    Ok(methods)
}

impl Tally {
    /// Has a classifier judge a scan, and counts; its confidences.
    pub fn judge(
        &mut self,
        classifier: &dyn GroundClassifier,
        scan: &LabelledPoints,
        threshold: f32,
    ) -> Vec<f32> {
        let started = Instant::now();
        let confidences = classifier.ground_confidence(&scan.points);
        self.times_ms.push(1e3 * started.elapsed().as_secs_f64());
        self.points += confidences.len();
        self.called_ground += confidences.iter().filter(|&&c| c > threshold).count();
        let (new, old) = (Protocol::PatchworkPlusPlus, Protocol::Patchwork);
        self.patchwork_plus_plus
            .merge(&score(scan, &confidences, threshold, new));
        self.patchwork
            .merge(&score(scan, &confidences, threshold, old));
        confidences
    }

    /// The row of the table.
    pub fn report(&self, name: &str, has_labels: bool) -> MethodReport {
        let mut times_ms = self.times_ms.clone();
        times_ms.sort_by(f64::total_cmp);
        let scores = |counts| has_labels.then(|| Scores::of(counts));
        MethodReport {
            name: name.to_owned(),
            ms_per_scan: times_ms
                .get(times_ms.len() / 2)
                .copied()
                .unwrap_or_default(),
            ground_share: self.called_ground as f64 / self.points.max(1) as f64,
            patchwork_plus_plus: scores(self.patchwork_plus_plus),
            patchwork: scores(self.patchwork),
        }
    }
}

/// What a protocol counts of a scan; nothing without labels.
pub fn score(
    scan: &LabelledPoints,
    confidences: &[f32],
    threshold: f32,
    protocol: Protocol,
) -> GroundScore {
    let mut score = GroundScore::default();
    let classes = scan.classes.iter().flatten();
    for ((point, &class), &confidence) in scan.points.iter().zip(classes).zip(confidences) {
        if let Some(truth) = protocol.truth(class, point.z) {
            score.add(confidence > threshold, truth);
        }
    }
    score
}

/// The rows as text: both protocols side by side where there are labels.
pub fn tally_table(methods: &[MethodReport]) -> String {
    let mut text = String::new();
    let judged = methods
        .iter()
        .any(|method| method.patchwork_plus_plus.is_some());
    if judged {
        let protocol = |name: &str| format!("  {name:-^35}");
        text += &format!(
            "{:<22}{}{}\n",
            "",
            protocol(" protocol of Patchwork++ [%] "),
            protocol(" protocol of Patchwork [%] ")
        );
    }
    let columns = format!(
        "  {:>9} {:>8} {:>8} {:>7}",
        "precision", "recall", "F1", "IoU"
    );
    let scores = if judged {
        columns.repeat(2)
    } else {
        String::new()
    };
    text += &format!("{:<22}{scores}  ms/scan  ground\n", "method");
    for method in methods {
        text += &format!("{:<22}", method.name);
        for scores in [&method.patchwork_plus_plus, &method.patchwork]
            .into_iter()
            .flatten()
        {
            let [precision, recall, f1, iou] =
                [scores.precision, scores.recall, scores.f1, scores.iou].map(|share| 100.0 * share);
            // Writing to a string cannot go wrong.
            let _ = write!(
                text,
                "  {precision:>9.2} {recall:>8.2} {f1:>8.2} {iou:>7.2}"
            );
        }
        let percent = 100.0 * method.ground_share;
        text += &format!("  {:>7.1}  {percent:>4.1} %\n", method.ms_per_scan);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_chosen_method_comes_first_and_all_others_after_it() {
        for (ground_method, first) in [
            (GroundMethod::Fuzzy, "fuzzy"),
            (GroundMethod::Pca, "PCA"),
            (GroundMethod::Ransac, "RANSAC plane"),
        ] {
            let config = GroundCommandConfig {
                ground_method,
                ..GroundCommandConfig::default()
            };
            let names: Vec<&str> = all(&config).unwrap().iter().map(|m| m.name).collect();
            assert_eq!((names[0], names.len()), (first, 5));
        }
    }
}
