//! Scores of ground segmentation against SemanticKITTI classes.
//!
//! ```text
//! precision = TP / (TP + FP)    recall = TP / (TP + FN)    F1 = 2 TP / (2 TP + FP + FN)
//! ```

use std::time::Instant;

use glam::Vec3;
use serde::{Deserialize, Serialize};

use crate::ground::GroundClassifier;

/// Which classes are ground, and which are excluded from the score. The protocols differ by about
/// 3.4 points of F1: never mix them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum GroundProtocol {
    /// Patchwork++ (repository of Lee, Lim and Myung, IROS 2022): unlabelled points, outliers and
    /// vegetation are excluded.
    #[default]
    PatchworkPlusPlus,
    /// Patchwork (Lim, Oh and Myung, RA-L 2021): vegetation is included, as ground where it is low.
    Patchwork,
}

const UNLABELLED: u16 = 0;
const OUTLIER: u16 = 1;
const VEGETATION: u16 = 70;
/// Road, parking, sidewalk, other ground, lane marking, terrain.
const GROUND: [u16; 6] = [40, 44, 48, 49, 60, 72];
/// Height in the lidar frame below which [`GroundProtocol::Patchwork`] takes vegetation for
/// ground [m].
const LOW_VEGETATION_M: f32 = -1.3;

impl GroundProtocol {
    /// Whether a point of a class at height `z` in the lidar frame [m] is ground; `None` if it is
    /// excluded.
    pub fn truth(self, class: u16, z: f32) -> Option<bool> {
        match (class, self) {
            (UNLABELLED | OUTLIER, _) | (VEGETATION, Self::PatchworkPlusPlus) => None,
            (VEGETATION, Self::Patchwork) => Some(z < LOW_VEGETATION_M),
            _ => Some(GROUND.contains(&class)),
        }
    }
}

/// The confusion matrix of ground segmentation [points].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct GroundScore {
    /// Ground classified as ground.
    pub true_positives: u64,
    /// Other points classified as ground.
    pub false_positives: u64,
    /// Ground classified as other.
    pub false_negatives: u64,
    /// Other points classified as other.
    pub true_negatives: u64,
}

impl GroundScore {
    /// Counts one point.
    pub fn add(&mut self, is_predicted_ground: bool, is_ground: bool) {
        *match (is_predicted_ground, is_ground) {
            (true, true) => &mut self.true_positives,
            (true, false) => &mut self.false_positives,
            (false, true) => &mut self.false_negatives,
            (false, false) => &mut self.true_negatives,
        } += 1;
    }

    /// Adds the counts of another scan.
    pub fn merge(&mut self, other: &Self) {
        self.true_positives += other.true_positives;
        self.false_positives += other.false_positives;
        self.false_negatives += other.false_negatives;
        self.true_negatives += other.true_negatives;
    }

    /// Precision, 0 to 1; NaN if no point is classified as ground.
    pub fn precision(&self) -> f64 {
        ratio(self.true_positives, self.false_positives)
    }

    /// Recall, 0 to 1; NaN if there is no ground.
    pub fn recall(&self) -> f64 {
        ratio(self.true_positives, self.false_negatives)
    }

    /// Harmonic mean of precision and recall, 0 to 1.
    pub fn f1(&self) -> f64 {
        let errors = self.false_positives + self.false_negatives;
        ratio(2 * self.true_positives, errors)
    }

    /// Intersection over union, 0 to 1.
    pub fn iou(&self) -> f64 {
        let errors = self.false_positives + self.false_negatives;
        ratio(self.true_positives, errors)
    }
}

fn ratio(correct: u64, errors: u64) -> f64 {
    correct as f64 / (correct + errors) as f64
}

/// The points of a scan with their true classes, if these are known.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LabelledPoints {
    /// Lidar frame [m].
    pub points: Vec<Vec3>,
    /// SemanticKITTI class of each point.
    pub classes: Option<Vec<u16>>,
}

impl LabelledPoints {
    /// Returns whether each point is ground; `None` for excluded points. Empty without classes.
    pub(crate) fn truth(&self, protocol: GroundProtocol) -> Vec<Option<bool>> {
        let classes = self.classes.iter().flatten();
        let points = self.points.iter().zip(classes);
        points
            .map(|(point, &class)| protocol.truth(class, point.z))
            .collect()
    }

    /// Scores the points of a region, classified as ground where the confidence is greater than
    /// the threshold; empty without classes.
    pub fn score(
        &self,
        protocol: GroundProtocol,
        confidences: &[f32],
        threshold: f32,
        region: impl Fn(Vec3) -> bool,
    ) -> GroundScore {
        let mut score = GroundScore::default();
        let truth = self.truth(protocol).into_iter();
        for ((truth, &point), &confidence) in truth.zip(&self.points).zip(confidences) {
            if let Some(is_ground) = truth.filter(|_| region(point)) {
                score.add(confidence > threshold, is_ground);
            }
        }
        score
    }
}

/// Scores and times of a classifier over several scans.
#[derive(Clone, Debug, Default)]
pub struct GroundTally {
    points: usize,
    predicted_ground: usize,
    patchwork_plus_plus: GroundScore,
    patchwork: GroundScore,
    times_ms: Vec<f64>,
}

/// The result of a classifier over several scans.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct GroundMethodReport {
    /// Name of the method.
    pub name: String,
    /// Median time per scan [ms].
    pub ms_per_scan: f64,
    /// Share of the points that are classified as ground, 0 to 1.
    pub ground_share: f64,
    /// Scores by the protocol of Patchwork++, if any scan has labels.
    pub patchwork_plus_plus: Option<GroundScores>,
    /// Scores by the protocol of Patchwork, if any scan has labels.
    pub patchwork: Option<GroundScores>,
}

/// The scores of a confusion matrix, 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct GroundScores {
    /// Share of the points classified as ground that are ground.
    pub precision: f64,
    /// Share of the ground that is classified as ground.
    pub recall: f64,
    /// Harmonic mean of precision and recall.
    pub f1: f64,
    /// Intersection over union.
    pub iou: f64,
    /// Numbers of points.
    pub counts: GroundScore,
}

impl GroundTally {
    /// Classifies a scan, adds its scores and its time, and returns its confidences.
    pub fn classify(
        &mut self,
        classifier: &dyn GroundClassifier,
        scan: &LabelledPoints,
        threshold: f32,
    ) -> Vec<f32> {
        let start = Instant::now();
        let confidences = classifier.ground_confidence(&scan.points);
        self.times_ms.push(1e3 * start.elapsed().as_secs_f64());
        self.points += confidences.len();
        self.predicted_ground += confidences.iter().filter(|&&c| c > threshold).count();
        let score = |protocol| scan.score(protocol, &confidences, threshold, |_| true);
        self.patchwork_plus_plus
            .merge(&score(GroundProtocol::PatchworkPlusPlus));
        self.patchwork.merge(&score(GroundProtocol::Patchwork));
        confidences
    }

    /// Summarizes the scans.
    pub fn report(&self, name: &str) -> GroundMethodReport {
        let mut times_ms = self.times_ms.clone();
        times_ms.sort_by(f64::total_cmp);
        let scores = |counts: GroundScore| {
            (counts != GroundScore::default()).then(|| GroundScores {
                precision: counts.precision(),
                recall: counts.recall(),
                f1: counts.f1(),
                iou: counts.iou(),
                counts,
            })
        };
        let median_ms = times_ms.get(times_ms.len() / 2).copied();
        GroundMethodReport {
            name: name.to_owned(),
            ms_per_scan: median_ms.unwrap_or_default(),
            ground_share: self.predicted_ground as f64 / self.points.max(1) as f64,
            patchwork_plus_plus: scores(self.patchwork_plus_plus),
            patchwork: scores(self.patchwork),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scores_follow_from_the_counts() {
        let mut score = GroundScore::default();
        for (predicted, actual, times) in [
            (true, true, 6),
            (true, false, 2),
            (false, true, 1),
            (false, false, 9),
        ] {
            (0..times).for_each(|_| score.add(predicted, actual));
        }
        let mut twice = score;
        twice.merge(&score);
        for score in [score, twice] {
            assert_eq!(score.precision(), 6.0 / 8.0);
            assert_eq!(score.recall(), 6.0 / 7.0);
            assert_eq!(score.f1(), 12.0 / 15.0);
            assert_eq!(score.iou(), 6.0 / 9.0);
        }
    }

    #[test]
    fn the_protocols_differ_in_vegetation_only() {
        for class in 0..260 {
            for z in [-1.6, 0.5] {
                let (new, old) = (GroundProtocol::PatchworkPlusPlus, GroundProtocol::Patchwork);
                assert_eq!(
                    new.truth(class, z) == old.truth(class, z),
                    class != VEGETATION
                );
            }
        }
        assert_eq!(
            GroundProtocol::Patchwork.truth(VEGETATION, -1.6),
            Some(true)
        );
        assert_eq!(
            GroundProtocol::Patchwork.truth(VEGETATION, 0.5),
            Some(false)
        );
    }

    #[test]
    fn a_tally_counts_what_the_threshold_and_the_region_select() {
        struct Level;
        impl GroundClassifier for Level {
            fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
                let level = |point: &Vec3| if point.z < 0.0 { 0.9 } else { 0.1 };
                points.iter().map(level).collect()
            }
        }
        let scan = LabelledPoints {
            points: [(1.0, -1.0), (2.0, 1.0), (3.0, -1.0), (4.0, -1.0)]
                .map(|(x, z)| Vec3::new(x, 0.0, z))
                .to_vec(),
            classes: Some(vec![40, 40, 50, 0]),
        };
        let mut tally = GroundTally::default();
        let confidences = tally.classify(&Level, &scan, 0.5);
        let report = tally.report("level");
        assert_eq!(report.ground_share, 0.75);
        let counts = report.patchwork_plus_plus.unwrap().counts;
        assert_eq!((counts.true_positives, counts.false_positives), (1, 1));
        assert_eq!((counts.false_negatives, counts.true_negatives), (1, 0));
        let near = |point: Vec3| point.x < 2.5;
        let near = scan.score(GroundProtocol::Patchwork, &confidences, 0.5, near);
        assert_eq!((near.recall(), near.precision()), (0.5, 1.0));

        let unlabelled = LabelledPoints {
            classes: None,
            ..scan
        };
        let mut tally = GroundTally::default();
        tally.classify(&Level, &unlabelled, 0.5);
        assert_eq!(tally.report("level").patchwork, None);
    }
}
