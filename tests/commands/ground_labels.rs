//! Ground segmentation against the labels of SemanticKITTI and nuScenes, where they are available.

use fpmcl::evaluation::{GroundProtocol, GroundScore};
use fpmcl::ground::{
    FuzzyConfig, FuzzyGround, GroundClassifier, PcaGround, RansacGround, ReportRule,
};
use fpmcl::internals::scan_files;
use fpmcl::recording::read_labels;

use crate::common::real_recording;

/// A labelled recording: its folder, the path of a scan in it, and the number of scans.
struct Labelled {
    folder: &'static str,
    scan: fn(usize) -> String,
    scans: usize,
}

/// KITTI odometry 00 and 08, 64 beams, and a scene of nuScenes, 32 beams.
const DRIVES: [Labelled; 3] = [
    Labelled {
        folder: "semantickitti-00-labels",
        scan: |number| format!("velodyne/{number:06}.bin"),
        scans: 21,
    },
    Labelled {
        folder: "semantickitti-08-labels",
        scan: |number| format!("velodyne/{number:06}.bin"),
        scans: 5,
    },
    Labelled {
        folder: "nuscenes-hdl32",
        scan: |number| format!("lidar/{number:06}.pcd.bin"),
        scans: 32,
    },
];

impl Labelled {
    /// Score of a classifier; `None` where the recording is absent.
    fn score(
        &self,
        classifier: &dyn GroundClassifier,
        protocol: GroundProtocol,
    ) -> Option<GroundScore> {
        let folder = real_recording(self.folder)?;
        let mut score = GroundScore::default();
        for number in 0..self.scans {
            let scan = scan_files::read(&folder.join((self.scan)(number))).unwrap();
            let classes = read_labels(&folder.join(format!("labels/{number:06}.label"))).unwrap();
            let confidences = classifier.ground_confidence(&scan.points);
            for ((point, class), confidence) in scan.points.iter().zip(classes).zip(confidences) {
                if let Some(truth) = protocol.truth(class, point.z) {
                    score.add(confidence > 0.5, truth);
                }
            }
        }
        Some(score)
    }
}

#[test]
fn fuzzy_ground_reaches_its_published_scores_and_exceeds_the_baselines_on_every_drive() {
    let fuzzy = FuzzyGround::new(FuzzyConfig::default()).unwrap();
    let baselines: [&dyn GroundClassifier; 3] =
        [&PcaGround::default(), &RansacGround::default(), &ReportRule];
    for (drive, published) in DRIVES
        .iter()
        .zip([[0.992, 0.963], [0.988, 0.963], [0.99, 0.973]])
    {
        let protocols = [GroundProtocol::PatchworkPlusPlus, GroundProtocol::Patchwork];
        for (protocol, min_f1) in protocols.into_iter().zip(published) {
            let Some(score) = drive.score(&fuzzy, protocol) else {
                continue;
            };
            let f1 = score.f1();
            assert!(f1 >= min_f1, "{} {protocol:?}: {f1}", drive.folder);
            for baseline in baselines {
                let other = drive.score(baseline, protocol).unwrap().f1();
                assert!(other < f1, "{} {protocol:?}: {other}", drive.folder);
            }
        }
    }
}

#[test]
fn three_features_reach_their_published_score() {
    let three = FuzzyGround::new(FuzzyConfig::three_features()).unwrap();
    if let Some(score) = DRIVES[0].score(&three, GroundProtocol::PatchworkPlusPlus) {
        assert!(score.f1() >= 0.973, "{score:?} {}", score.f1());
    }
}
