//! Tables and page of the finished runs.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::{Result, ensure};
use schemars::JsonSchema;
use serde::Serialize;

use super::formats::{csv, markdown, text};
use super::layout::Layout;
use super::plan::PlannedRun;
use super::record::RunRecord;
use super::results::ComparisonResults;
use super::{cases, keys, page, tables};
use crate::app::comparison::config::ComparisonConfig;
use crate::app::comparison::table::Table;
use crate::app::run::visible::visible;
use crate::app::run::{Context, Outputs, Printed, output, version};

/// Page of the sequences that are described as hard cases.
const CASES_FILE: &str = "cases.md";

/// `comparison.json`.
#[derive(Serialize, JsonSchema)]
pub struct ComparisonFile<'a> {
    /// Program that collected the runs: version and executable.
    program: String,
    /// The tables, as on the page.
    tables: &'a [Table],
    /// The finished and the failed runs.
    runs: Vec<&'a RunRecord>,
}

/// Writes tables and page of the finished runs; returns the tables for standard output.
pub fn collect(
    config: &ComparisonConfig,
    runs: &[PlannedRun],
    layout: &Layout,
    context: &Context,
) -> Result<Printed> {
    let results = read_results(config, runs, layout)?;
    let found = results.all_records().count();
    ensure!(
        found > 0,
        "no run is finished below {}; run the comparison without --collect, or the commands of --list-jobs",
        layout.root.display()
    );
    tracing::info!("{found} of {} runs are finished", runs.len());
    let programs: BTreeSet<&str> = results.all_records().map(|r| r.program.as_str()).collect();
    if programs.len() > 1 {
        let programs: Vec<&str> = programs.into_iter().collect();
        tracing::warn!(
            "the runs were made by different programs: {}",
            programs.join(", ")
        );
    }
    let tables = tables::tables(&results);
    prepare(&tables, &layout.root, context)?;
    write_tables(&tables, &layout.root)?;
    let page = page::page(&results, &tables, runs, layout)?;
    output::write_text(&layout.root.join("report.html"), &page.to_html())?;
    if let Some(text) = cases::page(&results, &version::program()?) {
        output::write_text(&layout.root.join(CASES_FILE), &text)?;
    }
    output::write_yaml(&layout.root.join("effective_comparison.yml"), config)?;
    let file = ComparisonFile {
        program: version::program()?,
        tables: &tables,
        runs: results.all_records().collect(),
    };
    output::write_json(&layout.root.join("comparison.json"), &file)?;
    // The table of single runs is too wide for a terminal.
    let summaries = tables.iter().filter(|table| table.name != "runs");
    Printed::text(summaries.map(text::table).collect::<Vec<_>>().join("\n")).with_json(&file)
}

/// Reads the records of the planned runs; skips those of other settings.
fn read_results<'a>(
    config: &'a ComparisonConfig,
    runs: &[PlannedRun],
    layout: &Layout,
) -> Result<ComparisonResults<'a>> {
    let mut sequences: Vec<String> = runs.iter().map(|run| run.id.sequence.clone()).collect();
    sequences.dedup();
    let mut records = Vec::new();
    let mut sweep = BTreeMap::<usize, Vec<RunRecord>>::new();
    for run in runs {
        let Some(record) = RunRecord::read(&layout.run(&run.id))? else {
            continue;
        };
        if record.settings != keys::settings_hash(run)? {
            tracing::warn!(
                "{} is skipped: its record has another configuration or version; run it again",
                run.id
            );
            continue;
        }
        match run.particles {
            Some(count) => sweep.entry(count).or_default().push(record),
            None => records.push(record),
        }
    }
    Ok(ComparisonResults {
        config,
        sequences,
        records,
        sweep,
    })
}

fn prepare(tables: &[Table], folder: &Path, context: &Context) -> Result<()> {
    let fixed = [
        CASES_FILE,
        "tables.txt",
        "tables.md",
        "report.html",
        "effective_comparison.yml",
        "plots",
    ];
    let fixed = fixed.map(str::to_owned);
    let outputs = Outputs {
        key: "output_folder",
        main: &folder.join("comparison.json"),
        magic: None,
        names: (tables.iter().map(table_file)).chain(fixed).collect(),
        inputs: context.input().into_iter().collect(),
        force: true,
    };
    outputs.prepare().map(drop)
}

fn table_file(table: &Table) -> String {
    format!("{}.csv", table.name)
}

fn write_tables(tables: &[Table], folder: &Path) -> Result<()> {
    let all: Vec<String> = tables.iter().map(text::table).collect();
    output::write_text(&folder.join("tables.txt"), &visible(&all.join("\n")))?;
    let all: Vec<String> = tables.iter().map(markdown::table).collect();
    output::write_text(&folder.join("tables.md"), &visible(&all.join("\n")))?;
    for table in tables {
        let path = folder.join(table_file(table));
        output::write_file(&path, |file| csv::write(table, file))?;
    }
    Ok(())
}
