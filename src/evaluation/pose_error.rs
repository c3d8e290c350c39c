//! Absolute and relative pose error in space, and the segment errors of the KITTI benchmark.
//!
//! With Q the true and P the estimated poses:
//!
//! ```text
//! APE   Fᵢ = Qᵢ⁻¹ Pᵢ
//! RPE   Eᵢ = (Qᵢ⁻¹ Qᵢ₊δ)⁻¹ (Pᵢ⁻¹ Pᵢ₊δ)
//! ```
//!
//! of which the length of the translation and the angle of the rotation are reported. Sturm et al.,
//! *A Benchmark for the Evaluation of RGB-D SLAM Systems*, IROS 2012, eq. 1 and 3; pairs are
//! chosen as in evo (Grupp 2017), without alignment. Segments are pairs a length apart along the
//! *truth*, whose errors are divided by the length: Geiger, Lenz and Urtasun, *Are we ready for
//! autonomous driving?*, CVPR 2012, as in the benchmark's devkit.

use serde::{Deserialize, Serialize};

use super::statistics::Summary;
use crate::geometry::{Pose3, distances_m};

/// Errors of poses or of pairs of poses.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseErrors {
    /// Lengths of the translations [m].
    pub translations_m: Vec<f64>,
    /// Angles of the rotations, 0 to π [rad].
    pub rotations_rad: Vec<f64>,
}

impl PoseErrors {
    fn of(errors: impl Iterator<Item = Pose3>) -> Self {
        let (translations_m, rotations_rad) = errors
            .map(|error| (error.translation.vector.norm(), error.rotation.angle()))
            .unzip();
        Self {
            translations_m,
            rotations_rad,
        }
    }

    /// Summary of the translations [m]; `None` without errors.
    pub(crate) fn translation(&self) -> Option<Summary> {
        Summary::new(&self.translations_m)
    }

    /// Summary of the rotations [rad]; `None` without errors.
    pub(crate) fn rotation(&self) -> Option<Summary> {
        Summary::new(&self.rotations_rad)
    }
}

/// Absolute errors of poses that correspond one to one, both in the frame of the truth: `truth⁻¹ · estimate` [m, rad].
pub fn absolute_pose_error(estimates: &[Pose3], ground_truth: &[Pose3]) -> PoseErrors {
    let pairs = estimates.iter().zip(ground_truth);
    PoseErrors::of(pairs.map(|(estimate, truth)| truth.inverse() * estimate))
}

/// Relative errors of poses that correspond one to one: of the motions from each to the next [m, rad].
pub fn relative_pose_error(estimates: &[Pose3], ground_truth: &[Pose3]) -> PoseErrors {
    let step = |pair: &[Pose3]| pair[0].inverse() * pair[1];
    let pairs = estimates.windows(2).zip(ground_truth.windows(2));
    PoseErrors::of(pairs.map(|(estimated, truth)| step(truth).inverse() * step(estimated)))
}

/// Lengths of the segments of the KITTI benchmark [m].
pub const KITTI_LENGTHS_M: [f64; 8] = [100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0];
/// The segments of the KITTI benchmark start at every tenth pose.
pub const KITTI_FRAME_STEP: usize = 10;
/// Lengths of the segments of short drives, which start at every pose [m].
pub const SHORT_LENGTHS_M: [f64; 4] = [5.0, 10.0, 20.0, 50.0];

/// Relative error of one segment of a trajectory.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment {
    /// Nominal length [m].
    pub length_m: f64,
    /// Translation error per length (unitless).
    pub translation: f64,
    /// Rotation error per length [rad/m].
    pub rotation_rad_per_m: f64,
}

/// Mean error per distance over segments.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct SegmentErrors {
    /// Translation error per distance driven [%].
    pub translation_percent: f64,
    /// Rotation error per distance driven [deg/m].
    pub rotation_deg_per_m: f64,
    /// Number of segments.
    pub segments: usize,
}

impl SegmentErrors {
    /// The mean over all segments, as the KITTI benchmark averages; `None` without segments.
    pub(crate) fn mean_of<'a>(segments: impl IntoIterator<Item = &'a Segment>) -> Option<Self> {
        let (mut translations, mut rotations, mut count) = (0.0, 0.0, 0);
        for segment in segments {
            translations += segment.translation;
            rotations += segment.rotation_rad_per_m;
            count += 1;
        }
        (count > 0).then(|| Self {
            translation_percent: 100.0 * (translations / count as f64),
            rotation_deg_per_m: (rotations / count as f64).to_degrees(),
            segments: count,
        })
    }

    /// Rotation error per distance driven [deg/100 m].
    pub fn rotation_deg_per_100_m(&self) -> f64 {
        100.0 * self.rotation_deg_per_m
    }
}

/// The segments of given ascending lengths [m] that start at every `frame_step`-th pose. A segment ends at the first
/// pose whose distance along the truth is at least that of the start and the length; its error is divided by
/// the length.
pub fn segments(
    estimates: &[Pose3],
    ground_truth: &[Pose3],
    lengths_m: &[f64],
    frame_step: usize,
) -> Vec<Segment> {
    let driven_m = distances_m(ground_truth);
    let starts = (0..ground_truth.len()).step_by(frame_step.max(1));
    let mut segments = Vec::with_capacity(starts.len() * lengths_m.len());
    for first in starts {
        for &length_m in lengths_m {
            let end_m = driven_m[first] + length_m;
            let last = driven_m.partition_point(|&driven_m| driven_m < end_m);
            if last >= ground_truth.len() {
                break;
            }
            let true_step = ground_truth[first].inverse() * ground_truth[last];
            let error = true_step.inverse() * (estimates[first].inverse() * estimates[last]);
            segments.push(Segment {
                length_m,
                translation: error.translation.vector.norm() / length_m,
                rotation_rad_per_m: error.rotation.angle() / length_m,
            });
        }
    }
    segments
}

/// KITTI's segment errors, 100 to 800 m from every tenth pose; `None` for a path under 100 m.
pub fn kitti_segment_errors(estimates: &[Pose3], ground_truth: &[Pose3]) -> Option<SegmentErrors> {
    SegmentErrors::mean_of(&segments(
        estimates,
        ground_truth,
        &KITTI_LENGTHS_M,
        KITTI_FRAME_STEP,
    ))
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use approx::assert_relative_eq;
    use nalgebra::Vector3;

    use super::*;
    use crate::recording::poses::CameraPoses;

    /// Commands of evo 1.38.1 with their output, run in the folder of the two trajectories.
    const EVO_OUTPUT: &str = include_str!("evo/answers.txt");

    fn fixture(name: &str) -> Vec<Pose3> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("src/evaluation/evo");
        CameraPoses::read(&folder.join(name))
            .unwrap()
            .world_from_cam0
    }

    /// The errors that a command line of evo requests, computed here.
    fn ours(command: &str, estimates: &[Pose3], truth: &[Pose3]) -> Summary {
        let words: Vec<&str> = command.split_whitespace().collect();
        let option = |flag: &str| {
            let place = words.iter().position(|word| *word == flag)?;
            Some(words[place + 1])
        };
        let errors = if words[1] == "evo_ape" {
            absolute_pose_error(estimates, truth)
        } else {
            assert_eq!([option("-d"), option("-u")], [Some("1"), Some("f")]);
            relative_pose_error(estimates, truth)
        };
        match option("-r").unwrap() {
            "trans_part" => errors.translation().unwrap(),
            "angle_rad" => errors.rotation().unwrap(),
            other => panic!("{other}"),
        }
    }

    #[test]
    fn ape_and_rpe_equal_those_of_evo() {
        let (truth, estimates) = (
            fixture("reference_kitti.txt"),
            fixture("estimate_kitti.txt"),
        );
        let mut summary = None;
        let mut compared = 0;
        for line in EVO_OUTPUT.lines() {
            if line.starts_with('$') {
                summary = Some(ours(line, &estimates, &truth));
                continue;
            }
            let (name, value) = line.trim().split_once('\t').unwrap();
            let summary = summary.unwrap();
            let ours = match name {
                "max" => summary.max,
                "mean" => summary.mean,
                "median" => summary.median,
                "rmse" => summary.rmse,
                other => panic!("{other}"),
            };
            assert_relative_eq!(ours, value.parse().unwrap(), epsilon = 1e-6);
            compared += 1;
        }
        assert_eq!(compared, 16);
    }

    /// A straight path of 1 m steps, the estimate of which is `scale` times as long and turns by
    /// `turn_rad` at every step.
    fn straight(count: usize, scale: f64, turn_rad: f64) -> Vec<Pose3> {
        let step = Pose3::new(
            Vector3::new(scale, 0.0, 0.0),
            Vector3::new(0.0, 0.0, turn_rad),
        );
        let mut pose = Pose3::identity();
        (0..count)
            .map(|_| {
                let here = pose;
                pose *= step;
                here
            })
            .collect()
    }

    #[test]
    fn a_path_that_is_one_percent_too_long_has_a_segment_error_of_one_percent() {
        let truth = straight(1000, 1.0, 0.0);
        let errors = kitti_segment_errors(&straight(1000, 1.01, 0.0), &truth).unwrap();
        assert_relative_eq!(errors.translation_percent, 1.0, epsilon = 1e-9);
        assert_relative_eq!(errors.rotation_deg_per_m, 0.0, epsilon = 1e-12);
        // 990 m: from 0, 10, ..., 980 m as far as each length fits.
        let expected: usize = (1..=8)
            .map(|hundreds| 1 + (999 - 100 * hundreds) / 10)
            .sum();
        assert_eq!(errors.segments, expected);
    }

    #[test]
    fn the_rotation_error_of_a_segment_is_the_turn_per_metre() {
        let (truth, turned) = (straight(1000, 1.0, 0.0), straight(1000, 1.0, 1e-4));
        let expected = 100.0 * 1e-4_f64.to_degrees();
        let errors = kitti_segment_errors(&turned, &truth).unwrap();
        assert_relative_eq!(errors.rotation_deg_per_100_m(), expected, epsilon = 1e-6);
        let short = segments(&turned, &truth, &SHORT_LENGTHS_M, 1);
        let errors = SegmentErrors::mean_of(&short).unwrap();
        assert_relative_eq!(errors.rotation_deg_per_100_m(), expected, epsilon = 1e-6);
        assert_eq!(errors.segments, 995 + 990 + 980 + 950);
    }

    #[test]
    fn segment_errors_do_not_depend_on_the_frame_of_either_trajectory() {
        let elsewhere = Pose3::new(Vector3::new(4.0, 5.0, 6.0), Vector3::new(0.3, 0.2, 0.1));
        // Rounded distances must not change where a segment ends.
        let step_m = 1.0 + 1e-7;
        let (truth, estimates) = (straight(300, step_m, 0.01), straight(300, 1.02, 0.0101));
        let moved =
            |poses: &[Pose3]| -> Vec<Pose3> { poses.iter().map(|pose| elsewhere * pose).collect() };
        let here = segments(&estimates, &truth, &SHORT_LENGTHS_M, 1);
        for (estimates, truth) in [
            (moved(&estimates), truth.clone()),
            (estimates.clone(), moved(&truth)),
        ] {
            let there = segments(&estimates, &truth, &SHORT_LENGTHS_M, 1);
            assert_eq!(here.len(), there.len());
            for (a, b) in here.iter().zip(&there) {
                assert_relative_eq!(a.translation, b.translation, epsilon = 1e-9);
                assert_relative_eq!(a.rotation_rad_per_m, b.rotation_rad_per_m, epsilon = 1e-9);
            }
        }
    }

    #[test]
    fn a_segment_ends_at_the_first_pose_at_its_length_or_beyond() {
        // Steps of 3 m: 5 m end at 6 m, 12 m at 12 m.
        let truth = straight(5, 3.0, 0.0);
        let estimates = straight(5, 3.3, 0.0);
        let found = segments(&estimates, &truth, &[5.0, 12.0], 10);
        assert_eq!(found.len(), 2);
        assert_relative_eq!(found[0].translation, 0.6 / 5.0, epsilon = 1e-12);
        assert_relative_eq!(found[1].translation, 1.2 / 12.0, epsilon = 1e-12);
    }

    #[test]
    fn a_path_under_a_hundred_metres_has_no_segments() {
        let path = straight(100, 1.0, 0.0);
        assert_eq!(kitti_segment_errors(&path, &path), None);
    }

    #[test]
    fn relative_errors_do_not_depend_on_the_first_pose() {
        let (truth, estimates) = (
            fixture("reference_kitti.txt"),
            fixture("estimate_kitti.txt"),
        );
        let elsewhere = Pose3::new(Vector3::new(4.0, 5.0, 6.0), Vector3::new(0.3, 0.2, 0.1));
        let moved: Vec<Pose3> = estimates.iter().map(|pose| elsewhere * pose).collect();
        let here = relative_pose_error(&estimates, &truth);
        let there = relative_pose_error(&moved, &truth);
        for (a, b) in here.translations_m.iter().zip(&there.translations_m) {
            assert_relative_eq!(a, b, epsilon = 1e-9);
        }
    }
}
