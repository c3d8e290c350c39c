//! Tables of runs with known errors.

use std::collections::BTreeMap;

use approx::assert_relative_eq;

use super::*;
use crate::app::comparison::config::ComparisonConfig;
use crate::app::comparison::record::{Outcome, RunId};
use crate::app::report::TrajectoryReport;
use crate::evaluation::{EvaluatedTrajectory, MetricsConfig, RangeMclRules, TrajectoryMetrics};
use crate::geometry::Pose2;

/// A run with a constant error of `error_m` to the left.
fn run(sequence: &str, configuration: &str, seed: u64, error_m: f64) -> RunRecord {
    let truth: Vec<Pose2> = (0..40)
        .map(|k| Pose2::translation(f64::from(k), 0.0))
        .collect();
    let estimates: Vec<Pose2> = truth
        .iter()
        .map(|pose| pose * Pose2::translation(0.0, error_m))
        .collect();
    let trajectory = EvaluatedTrajectory {
        estimates: &estimates,
        ground_truth: &truth,
        times_s: None,
        runtimes_s: Some(&[0.1; 40]),
        trusted: None,
    };
    let report = TrajectoryReport {
        range_mcl: RangeMclRules::default().evaluate(&estimates, &truth),
        metrics: TrajectoryMetrics::new(&trajectory, &MetricsConfig::default()).unwrap(),
        in_space: None,
        consistency: None,
    };
    RunRecord {
        id: RunId {
            sequence: sequence.to_owned(),
            configuration: configuration.to_owned(),
            seed,
        },
        key: String::new(),
        settings: String::new(),
        program: String::new(),
        machine: [].into(),
        stage_seconds: [].into(),
        trust: None,
        outcome: Outcome::Finished(Box::new(report)),
    }
}

fn config() -> ComparisonConfig {
    let configuration = |name: &str, claimed_m| VariantConfig {
        name: name.to_owned(),
        claimed_m,
        ..VariantConfig::default()
    };
    ComparisonConfig {
        seeds: vec![1, 2],
        configurations: vec![configuration("A", Some(1.45)), configuration("B", None)],
        ..ComparisonConfig::default()
    }
}

fn comparison(config: &ComparisonConfig, records: Vec<RunRecord>) -> ComparisonResults<'_> {
    ComparisonResults {
        config,
        sequences: vec!["town".to_owned(), "hill".to_owned()],
        records,
        sweep: BTreeMap::new(),
    }
}

/// Runs of A and B, where B is one centimetre better than A.
fn eight_runs() -> Vec<RunRecord> {
    let mut runs = Vec::new();
    for (sequence, error_m) in [("town", 0.10), ("hill", 0.30)] {
        for seed in [1, 2] {
            let scatter_m = 0.02 * seed as f64;
            runs.push(run(sequence, "A", seed, error_m + scatter_m));
            runs.push(run(sequence, "B", seed, error_m + scatter_m - 0.01));
        }
    }
    runs
}

fn cell<'a>(table: &'a Table, row: usize, name: &str) -> &'a Cell {
    let column = table.columns.iter().position(|column| column.name == name);
    &table.rows[row][column.unwrap()]
}

#[test]
fn the_mean_of_a_configuration_is_over_sequences_and_the_claim_has_its_own_column() {
    let table = table_1(&comparison(&config(), eight_runs()));
    let Cell::Mean(error) = cell(&table, 0, "average positional error") else {
        panic!("{table:?}")
    };
    assert_relative_eq!(error.mean, 0.23, epsilon = 1e-9);
    assert_relative_eq!(
        error.over_seeds.unwrap(),
        0.02 / 2_f64.sqrt(),
        epsilon = 1e-9
    );
    assert_relative_eq!(
        error.over_sequences.unwrap(),
        0.2 / 2_f64.sqrt(),
        epsilon = 1e-9
    );
    let claim = "claimed by the report";
    assert_eq!(cell(&table, 0, claim), &Cell::Number(1.45));
    assert_eq!(cell(&table, 1, claim), &Cell::Absent);
    assert_eq!(cell(&table, 0, "runs"), &Cell::from("4 of 4"));
}

#[test]
fn a_small_difference_in_every_pair_is_significant_despite_a_large_scatter_of_the_runs() {
    let table = differences(&comparison(&config(), eight_runs()));
    let Cell::Difference(error) = cell(&table, 0, "average positional error") else {
        panic!("{table:?}")
    };
    assert_relative_eq!(error.mean, -0.01, epsilon = 1e-9);
    assert_eq!((error.is_significant(), error.pairs), (Some(true), 4));
}

#[test]
fn unpaired_runs_are_not_part_of_a_difference() {
    let mut runs = eight_runs();
    runs.retain(|run| !(run.id.configuration == "A" && run.id.seed == 2));
    runs.retain(|run| !(run.id.configuration == "B" && run.id.sequence == "hill"));
    let config = config();
    let comparison = comparison(&config, runs);
    let pairs = comparison.differences(&config.contrasts()[0], &TABLE_1[0]);
    assert_eq!(pairs.iter().map(Vec::len).collect::<Vec<_>>(), [1, 0]);
    assert_eq!(table_1(&comparison).rows.len(), 2);
}

#[test]
fn a_failed_run_lowers_the_success_rate_and_has_no_error() {
    let mut runs = eight_runs();
    runs[0].outcome = Outcome::Failed("no ground".to_owned());
    runs.push(run("town", "A", 3, 2.0));
    let table = table_1(&comparison(&config(), runs));
    let Cell::Rate(rate) = cell(&table, 0, "success") else {
        panic!("{table:?}")
    };
    assert_eq!((rate.successes, rate.runs), (3, 5));
    let Cell::Mean(error) = cell(&table, 0, "average positional error") else {
        panic!("{table:?}")
    };
    assert_eq!(error.runs, 4);
}

#[test]
fn every_row_has_a_cell_per_column_and_every_run_a_row() {
    let tables = tables(&comparison(&config(), eight_runs()));
    for table in &tables {
        for row in &table.rows {
            assert_eq!(row.len(), table.columns.len(), "{}", table.name);
        }
    }
    let runs = tables.iter().find(|table| table.name == "runs").unwrap();
    let names: Vec<&Cell> = runs.rows.iter().map(|row| &row[0]).collect();
    let Cell::Link { text, .. } = names[0] else {
        panic!("{names:?}")
    };
    assert_eq!((names.len(), text.as_str()), (8, "town/A/1"));
}

#[test]
fn every_number_of_particles_has_a_row() {
    let runs = eight_runs();
    let some: Vec<RunRecord> = runs.iter().take(3).cloned().collect();
    let config = config();
    let mut comparison = comparison(&config, runs);
    comparison.sweep = [(100, vec![]), (1000, some)].into();
    let table = particles(&comparison);
    assert_eq!(cell(&table, 0, "success"), &Cell::Absent);
    assert_eq!(cell(&table, 1, "success").number(), Some(1.0));
}

#[test]
fn runs_of_the_particle_sweep_are_listed_and_in_no_mean() {
    let mut swept = run("town", "A-100-particles", 1, 9.0);
    swept.id.seed = 7;
    let config = config();
    let mut comparison = comparison(&config, eight_runs());
    let without = tables(&comparison);
    comparison.sweep = [(100, vec![swept])].into();
    let tables = tables(&comparison);
    for (before, after) in without.iter().zip(&tables).take(5) {
        assert_eq!(before, after);
    }
    let runs = tables.last().unwrap();
    let Cell::Link { text, .. } = &runs.rows[8][0] else {
        panic!("{runs:?}")
    };
    assert_eq!(
        (runs.rows.len(), text.as_str()),
        (9, "town/A-100-particles/7")
    );
}

#[test]
fn every_stage_has_a_column_and_a_skipped_stage_no_time() {
    let mut runs = eight_runs();
    for run in &mut runs {
        let seconds = run.id.seed as f64;
        run.stage_seconds.insert("1 map".to_owned(), seconds);
        if run.id.configuration == "B" {
            run.stage_seconds.insert("2 refine".to_owned(), 5.0);
        }
    }
    let table = timing(&comparison(&config(), runs));
    assert_eq!(table.rows.len(), 4);
    assert_eq!(cell(&table, 0, "1 map").number(), Some(1.5));
    assert_eq!(cell(&table, 0, "2 refine"), &Cell::Absent);
    assert_eq!(cell(&table, 1, "2 refine").number(), Some(5.0));
    let per_frame_ms = cell(&table, 1, "runtime per frame").number().unwrap();
    assert_relative_eq!(per_frame_ms, 100.0, epsilon = 1e-9);
}
