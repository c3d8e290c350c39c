//! Ground segmentation against the labels of SemanticKITTI, where they are available.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use common::real_recording;
use fpmcl::evaluation::{GroundProtocol, GroundScore};
use fpmcl::ground::{
    FuzzyConfig, FuzzyGround, GroundClassifier, PcaGround, RansacGround, ReportRule,
};
use fpmcl::recording::scan_files;
use fpmcl::recording::velodyne::read_labels;

/// Score of a classifier on the odd scans, which were not used to choose parameters.
fn held_out_score(classifier: &dyn GroundClassifier) -> Option<GroundScore> {
    let folder = real_recording("semantickitti-00-labels")?;
    let mut score = GroundScore::default();
    for number in (1..21).step_by(2) {
        let scan = scan_files::read(&folder.join(format!("velodyne/{number:06}.bin"))).unwrap();
        let classes = read_labels(&folder.join(format!("labels/{number:06}.label"))).unwrap();
        let confidences = classifier.ground_confidence(&scan.points);
        for ((point, class), confidence) in scan.points.iter().zip(classes).zip(confidences) {
            if let Some(truth) = GroundProtocol::PatchworkPlusPlus.truth(class, point.z) {
                score.add(confidence > 0.5, truth);
            }
        }
    }
    Some(score)
}

#[test]
fn fuzzy_ground_reaches_its_published_scores_and_exceeds_the_baselines() {
    let fuzzy = |config| held_out_score(&FuzzyGround::new(config).unwrap());
    let (Some(four), Some(three)) = (
        fuzzy(FuzzyConfig::default()),
        fuzzy(FuzzyConfig::three_features()),
    ) else {
        return;
    };
    assert!(four.f1() >= 0.990, "{four:?} {}", four.f1());
    assert!(four.precision() > 0.98 && four.recall() > 0.98, "{four:?}");
    assert!(three.f1() >= 0.973, "{three:?} {}", three.f1());

    let baselines: [&dyn GroundClassifier; 3] =
        [&PcaGround::default(), &RansacGround::default(), &ReportRule];
    for baseline in baselines {
        let score = held_out_score(baseline).unwrap();
        assert!(score.f1() < four.f1(), "{score:?}");
    }
}
