//! The memory that the report of a run takes, which must not hold copies of all frames.

use std::path::Path;

use nalgebra::{Matrix3, Vector3};

use super::results::{Column, ParticleLog};
use super::{LocalizationResults, RunFiles, run_output, run_page};
use crate::evaluation::RangeMclRules;
use crate::geometry::{Pose2, Pose3};
use crate::localization::State;

#[path = "../../../tests/fuzzed/allocation.rs"]
mod allocation;

/// A drive with refined and true poses whose columns are in files, as those of a run are.
fn results(frames: usize, folder: &Path) -> LocalizationResults {
    fn column<T: bytemuck::Pod>(
        frames: usize,
        folder: &Path,
        item: impl Fn(usize) -> T,
    ) -> Option<Column<T>> {
        let mut column = Column::in_folder(folder);
        (0..frames).for_each(|row| column.push(item(row)));
        Some(column)
    }
    let heading = |row: usize| 1e-3 * row as f64;
    let planar = move |error_m: f64| {
        move |row: usize| {
            let (sin, cos) = heading(row).sin_cos();
            let radius_m = 500.0 + error_m * (0.1 * row as f64).sin();
            Pose2::new([radius_m * sin, -radius_m * cos].into(), heading(row))
        }
    };
    let in_space = move |error_m: f64| {
        move |row: usize| {
            let pose = planar(error_m)(row);
            let t = pose.translation;
            let height_m = 2.0 + (0.01 * row as f64).sin();
            Pose3::new(
                Vector3::new(t.x, t.y, height_m),
                Vector3::z() * pose.rotation.angle(),
            )
        }
    };
    let number = |value: f64| column(frames, folder, move |_| value);
    let covariance = |_| Matrix3::from_diagonal(&[0.01, 0.04, 1e-4].into());
    let state = |row: usize| State::Tracking as u8 * u8::from(row % 1000 != 7);
    let mut particles = ParticleLog::new(2, folder);
    (0..frames).for_each(|_| particles.push_frame(&[[1.0, 2.0, 0.0, 0.5]; 2]).unwrap());
    LocalizationResults {
        frames: column(frames, folder, |row| row).unwrap_or_default(),
        particles,
        estimates: column(frames, folder, planar(0.2)),
        refined: column(frames, folder, planar(0.05)),
        ground_truth: column(frames, folder, planar(0.0)),
        estimates_in_space: column(frames, folder, in_space(0.2)),
        refined_in_space: column(frames, folder, in_space(0.05)),
        ground_truth_in_space: column(frames, folder, in_space(0.0)),
        odometry: column(frames, folder, |_| Pose2::translation(0.5, 0.0)),
        covariances: column(frames, folder, covariance),
        refined_covariances: column(frames, folder, covariance),
        times_s: column(frames, folder, |row| 0.1 * row as f64),
        runtimes_s: number(0.01),
        refine_runtimes_s: number(0.02),
        agreements: number(0.9),
        places: number(1.0),
        states: column(frames, folder, state),
        refined_states: column(frames, folder, state),
        refinement_costs_m: column(frames, folder, |_| [0.2, 0.1]),
        refinement_agreements: column(frames, folder, |_| [0.8, 0.9]),
        ..LocalizationResults::default()
    }
}

/// The most memory of each stage of a report [bytes].
fn peaks(frames: usize) -> [(&'static str, usize); 4] {
    let folder = tempfile::tempdir().unwrap();
    let files = RunFiles::new(&folder.path().join("result.npz"));
    let results = results(frames, folder.path());
    let evaluate = || run_output::evaluate(&results, &RangeMclRules::default(), [].into());
    let (report, evaluating) = allocation::peak_of(|| evaluate().unwrap());
    let peak = |stage: &dyn Fn() -> anyhow::Result<()>| {
        let (written, peak) = allocation::peak_of(stage);
        written.unwrap();
        peak
    };
    [
        ("evaluation", evaluating),
        (
            "tables",
            peak(&|| run_output::write_report(&files, &results, &report)),
        ),
        (
            "pictures",
            peak(&|| run_output::draw_run(&files, None, &results)),
        ),
        ("page", peak(&|| run_page::write(&files, &report))),
    ]
}

#[test]
fn a_report_takes_little_memory_per_frame() {
    let (few, many) = (10_000, 40_000);
    let per_frame: Vec<(&str, usize)> = (peaks(few).into_iter().zip(peaks(many)))
        .map(|((stage, few_bytes), (_, many_bytes))| {
            (stage, many_bytes.saturating_sub(few_bytes) / (many - few))
        })
        .collect();
    println!("{per_frame:?}");
    for (stage, bytes) in per_frame {
        assert!(bytes < 300, "{stage}: {bytes} bytes per frame");
    }
}
