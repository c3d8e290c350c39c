//! Tables, pictures and a page of the runs that are there.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::{Result, ensure};
use serde::Serialize;

use super::plan::PlannedRun;
use super::{Layout, execute, fingerprint, page};
use crate::app::commands::{output, version};
use crate::app::comparison::{Comparison, RunRecord};
use crate::app::config::ComparisonConfig;
use crate::app::reporting::{Table, csv, markdown, text};

/// `comparison.json`.
#[derive(Serialize)]
struct Collected<'a> {
    program: String,
    tables: &'a [Table],
    runs: &'a [&'a RunRecord],
}

/// Writes what the runs say that are there; returns the tables for standard output.
pub fn collect(config: &ComparisonConfig, runs: &[PlannedRun], layout: &Layout) -> Result<String> {
    let records = records(runs, layout)?;
    ensure!(
        !records.is_empty(),
        "no run is finished below {}; run the comparison without --collect, or the commands of --list-jobs",
        layout.root.display()
    );
    tracing::info!("{} of {} runs are there", records.len(), runs.len());
    let programs: BTreeSet<&str> = records.iter().map(|(_, r)| r.program.as_str()).collect();
    if programs.len() > 1 {
        let programs: Vec<&str> = programs.into_iter().collect();
        tracing::warn!(
            "the runs are of different programs: {}",
            programs.join(", ")
        );
    }
    execute::write_config(config, layout)?;
    let comparison = comparison(config, runs, records);
    let tables = comparison.tables();
    write_tables(&tables, layout)?;
    let all: Vec<&RunRecord> = comparison.all_records().collect();
    output::write_json(
        &layout.root.join("comparison.json"),
        &Collected {
            program: version::program()?,
            tables: &tables,
            runs: &all,
        },
    )?;
    let page = page::page(config, runs, &comparison, &tables, layout)?;
    output::write_text(&layout.root.join("report.html"), &page.to_html())?;
    Ok(shown(&tables))
}

/// The records of the planned runs, as far as they are there and were asked for as they are now.
fn records<'a>(
    runs: &'a [PlannedRun],
    layout: &Layout,
) -> Result<Vec<(&'a PlannedRun, RunRecord)>> {
    let mut records = Vec::new();
    for run in runs {
        let Some(record) = execute::read_record(&layout.run(&run.id))? else {
            continue;
        };
        if record.settings == fingerprint::settings_of(run)? {
            records.push((run, record));
        } else {
            tracing::warn!(
                "{} was run with another configuration or version and is left out; run it again",
                run.id
            );
        }
    }
    Ok(records)
}

/// The sequences that take part, in their order.
fn sequences_of(runs: &[PlannedRun]) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for run in runs {
        if !names.contains(&run.id.sequence) {
            names.push(run.id.sequence.clone());
        }
    }
    names
}

fn comparison(
    config: &ComparisonConfig,
    runs: &[PlannedRun],
    found: Vec<(&PlannedRun, RunRecord)>,
) -> Comparison {
    let mut records = Vec::new();
    let mut sweep = BTreeMap::<usize, Vec<RunRecord>>::new();
    for (run, record) in found {
        match run.particles {
            Some(count) => sweep.entry(count).or_default().push(record),
            None => records.push(record),
        }
    }
    Comparison {
        sequences: sequences_of(runs),
        variants: config.variants(),
        contrasts: config.contrasts(),
        seeds: config.seeds.len(),
        records,
        sweep: sweep.into_iter().collect(),
    }
}

fn write_tables(tables: &[Table], layout: &Layout) -> Result<()> {
    let all: Vec<String> = tables.iter().map(text::table).collect();
    output::write_text(&layout.root.join("tables.txt"), &all.join("\n"))?;
    let all: Vec<String> = tables.iter().map(markdown::table).collect();
    output::write_text(&layout.root.join("tables.md"), &all.join("\n"))?;
    for table in tables {
        let path = layout.root.join(format!("{}.csv", table.name));
        output::write_file(&path, |file| csv::write(table, file))?;
    }
    Ok(())
}

/// What fits a terminal: all but the single runs.
fn shown(tables: &[Table]) -> String {
    let summaries = tables.iter().filter(|table| table.name != "runs");
    summaries.map(text::table).collect::<Vec<_>>().join("\n")
}
