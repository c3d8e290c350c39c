//! Tables of a comparison.

use std::collections::BTreeSet;

use super::cases;
use super::measures::{Measure, SELECTED, TABLE_1, TABLE_2};
use super::record::RunRecord;
use super::results::{ComparisonResults, success_rate, value};
use super::statistics::{mean_with_spread, paired_difference};
use crate::app::comparison::config::{Contrast, VariantConfig};
use crate::app::comparison::table::{Cell, Column, Table};

const SPREAD: &str = "Mean over sequences ± standard deviation over seeds ± standard deviation over sequences; the first ten frames (half of the frames in runs shorter than twenty) are not evaluated.";

/// All tables, most important first.
pub fn tables(results: &ComparisonResults) -> Vec<Table> {
    let mut tables = vec![
        table_1(results),
        table_2(results),
        differences(results),
        by_sequence(results),
        timing(results),
        cases::states(results),
    ];
    if !results.sweep.is_empty() {
        tables.push(particles(results));
    }
    tables.push(runs(results));
    tables
}

fn table_1(results: &ComparisonResults) -> Table {
    let (mut columns, mut rows) = summary(results, &TABLE_1);
    columns.push(Column {
        name: "claimed by the report".to_owned(),
        unit: "m".to_owned(),
        definition: "average positional error, unverified; sequence and number of runs not stated"
            .to_owned(),
    });
    for (row, variant) in rows.iter_mut().zip(&results.config.configurations) {
        row.push(variant.claimed_m.into());
    }
    let is_claimed = |variant: &VariantConfig| variant.claimed_m.is_some();
    let claimed = if results.config.configurations.iter().any(is_claimed) {
        " What the report claims are its own unpublished results, which were not measured here."
    } else {
        ""
    };
    Table {
        name: "table_1".to_owned(),
        title: "Table 1: error, smoothness, drift, runtime".to_owned(),
        note: format!("{SPREAD}{claimed}"),
        columns,
        rows,
    }
}

fn table_2(results: &ComparisonResults) -> Table {
    let (columns, rows) = summary(results, &TABLE_2);
    Table {
        name: "table_2".to_owned(),
        title: "Table 2: RMSE of x, y and heading, mean pose change".to_owned(),
        note: SPREAD.to_owned(),
        columns,
        rows,
    }
}

/// Columns and rows of a table with one row per configuration.
fn summary(results: &ComparisonResults, measures: &[Measure]) -> (Vec<Column>, Vec<Vec<Cell>>) {
    let planned = results.config.seeds.len() * results.sequences.len();
    let row = |variant: &VariantConfig| {
        let groups = results.runs_by_sequence(&variant.name);
        let runs = groups.concat();
        let count = format!("{} of {planned}", runs.len());
        let start = vec![
            variant.name.as_str().into(),
            Cell::Text(count),
            success_rate(&runs).into(),
        ];
        [start, means(&groups, measures)].concat()
    };
    let rows = results.config.configurations.iter().map(row).collect();
    let start = [
        Column::named("configuration"),
        runs_column(),
        success_column(),
    ];
    (columns(start, measures), rows)
}

/// One row per contrast, one column per measure.
fn differences(results: &ComparisonResults) -> Table {
    let row = |contrast: &Contrast| {
        let start = [
            contrast.of.as_str().into(),
            contrast.against.as_str().into(),
        ];
        let differences = SELECTED
            .iter()
            .map(|measure| paired_difference(&results.differences(contrast, measure)).into());
        start.into_iter().chain(differences).collect()
    };
    Table {
        name: "differences".to_owned(),
        title: "Differences of runs with the same sequence and seed".to_owned(),
        note: "Mean difference and its 95 % confidence interval (Student's paired test, stratified by sequence). `yes`: the interval excludes zero, so the difference is significant for other seeds on these sequences; `no`: it may be chance. Not corrected for multiple comparisons. Negative means less error, less jitter, less time.".to_owned(),
        columns: columns(["configuration", "against"].map(Column::named), &SELECTED),
        rows: results.config.contrasts().iter().map(row).collect(),
    }
}

/// One row per sequence and configuration, one column per measure.
fn by_sequence(results: &ComparisonResults) -> Table {
    let row = |runs: &[&RunRecord]| {
        let mut row = vec![success_rate(runs).into()];
        row.extend(means(&[runs.to_vec()], &SELECTED));
        row
    };
    let [sequence, configuration] = ["sequence", "configuration"].map(Column::named);
    Table {
        name: "by_sequence".to_owned(),
        title: "Results by sequence".to_owned(),
        note: "Mean ± standard deviation over seeds.".to_owned(),
        columns: columns([sequence, configuration, success_column()], &SELECTED),
        rows: rows_by_sequence(results, row),
    }
}

/// One row per sequence and configuration, one column per stage.
fn timing(results: &ComparisonResults) -> Table {
    let per_frame = [TABLE_1[5]];
    let stages = results.records.iter().flat_map(|r| r.stage_seconds.keys());
    let stages: BTreeSet<&String> = stages.collect();
    let stage_column = |stage: &&String| Column {
        name: (*stage).clone(),
        unit: "s".to_owned(),
        definition: "wall time of the whole sequence, reading and drawing included".to_owned(),
    };
    let row = |runs: &[&RunRecord]| {
        let seconds = |stage: &&String| {
            let seconds = runs.iter().filter_map(|run| run.stage_seconds.get(*stage));
            mean_with_spread(&[seconds.copied().collect()]).into()
        };
        let mut row: Vec<Cell> = stages.iter().map(seconds).collect();
        row.extend(means(&[runs.to_vec()], &per_frame));
        row
    };
    let start = ["sequence", "configuration"].map(Column::named);
    let start = start.into_iter().chain(stages.iter().map(stage_column));
    Table {
        name: "timing".to_owned(),
        title: "Time per stage".to_owned(),
        note: "Mean ± standard deviation over seeds. A stage that several runs share, such as building the map, is executed once; its time counts for each of them.".to_owned(),
        columns: columns(start, &per_frame),
        rows: rows_by_sequence(results, row),
    }
}

/// One row per number of particles.
fn particles(results: &ComparisonResults) -> Table {
    let measures = [TABLE_1[0], TABLE_2[2], TABLE_1[5]];
    let row = |(count, records): (&usize, &Vec<RunRecord>)| {
        let runs: Vec<&RunRecord> = records.iter().collect();
        let successful = runs.iter().copied().filter(|run| run.is_success());
        let start = vec![
            Cell::Number(*count as f64),
            Cell::Text(runs.len().to_string()),
            success_rate(&runs).into(),
        ];
        [start, means(&[successful.collect()], &measures)].concat()
    };
    let start = [Column::named("particles"), runs_column(), success_column()];
    Table {
        name: "particles".to_owned(),
        title: "Success against the number of particles".to_owned(),
        note: "Errors and runtime: mean ± standard deviation over the successful runs.".to_owned(),
        columns: columns(start, &measures),
        rows: results.sweep.iter().map(row).collect(),
    }
}

/// One row per run.
fn runs(results: &ComparisonResults) -> Table {
    let measures: Vec<Measure> = [TABLE_1, TABLE_2].concat();
    let row = |record: &RunRecord| {
        let link = Cell::Link {
            text: record.id.to_string(),
            to: format!("runs/{}/report.html", record.id),
        };
        let success = if record.is_success() { "yes" } else { "no" };
        let values = measures.iter().map(|m| Cell::from(value(record, m)));
        [link, success.into()].into_iter().chain(values).collect()
    };
    Table {
        name: "runs".to_owned(),
        title: "All runs".to_owned(),
        note: String::new(),
        columns: columns(["run", "success"].map(Column::named), &measures),
        rows: results.all_records().map(row).collect(),
    }
}

/// Rows with sequence and configuration in front.
fn rows_by_sequence(
    results: &ComparisonResults,
    row: impl Fn(&[&RunRecord]) -> Vec<Cell>,
) -> Vec<Vec<Cell>> {
    let mut rows = Vec::new();
    for sequence in &results.sequences {
        for variant in &results.config.configurations {
            let names = vec![sequence.as_str().into(), variant.name.as_str().into()];
            rows.push([names, row(&results.runs(sequence, &variant.name))].concat());
        }
    }
    rows
}

/// Mean of each measure over groups of runs, one group per sequence.
fn means(groups: &[Vec<&RunRecord>], measures: &[Measure]) -> Vec<Cell> {
    let mean = |measure: &Measure| {
        let values = |runs: &Vec<&RunRecord>| {
            let values = runs.iter().filter_map(|run| value(run, measure));
            values.collect()
        };
        let values: Vec<Vec<f64>> = groups.iter().map(values).collect();
        mean_with_spread(&values).into()
    };
    measures.iter().map(mean).collect()
}

/// Columns of a table, those of measures last.
fn columns(start: impl IntoIterator<Item = Column>, measures: &[Measure]) -> Vec<Column> {
    let measures = measures.iter().map(|measure| Column {
        name: measure.name.to_owned(),
        unit: measure.unit.to_owned(),
        definition: measure.definition.to_owned(),
    });
    start.into_iter().chain(measures).collect()
}

fn runs_column() -> Column {
    Column {
        definition: "executed runs, of the planned runs".to_owned(),
        ..Column::named("runs")
    }
}

fn success_column() -> Column {
    Column {
        name: "success".to_owned(),
        unit: "%".to_owned(),
        definition: "runs with errors within 0.5 m and 2 degrees in ten consecutive frames and in all frames after them, whatever those before them are; with Wilson's 95 % interval".to_owned(),
    }
}

#[cfg(test)]
#[path = "tables_tests.rs"]
mod tests;
