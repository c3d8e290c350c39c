//! Tables, pictures and a page of the runs that are there.

use std::fs;
use std::path::Path;

use anyhow::{Context as _, Result, ensure};
use serde::Serialize;

use super::plan::PlannedRun;
use super::{Layout, execute, fingerprint, pictures};
use crate::commands::output;
use crate::config::{self, ComparisonConfig};
use crate::evaluation::comparison::tables::particle_table;
use crate::evaluation::comparison::{Comparison, RunRecord, Table};
use crate::reporting::{Block, Page, Section, csv, markdown, text};

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
    execute::write_config(config, layout)?;
    let (compared, swept) = records
        .into_iter()
        .partition::<Vec<_>, _>(|(run, _)| run.particles.is_none());
    let comparison = Comparison {
        sequences: sequences_of(runs),
        variants: config.variants(),
        contrasts: config.contrasts(),
        seeds: config.seeds.len(),
        records: compared.into_iter().map(|(_, record)| record).collect(),
    };
    let sweep = by_particles(&swept);
    let mut tables = comparison.tables();
    if !sweep.is_empty() {
        tables.insert(tables.len() - 1, particle_table(&sweep));
    }
    write_tables(&tables, layout)?;
    let swept_records = swept.iter().map(|(_, record)| record);
    let all: Vec<&RunRecord> = comparison.records.iter().chain(swept_records).collect();
    output::write_json(
        &layout.root.join("comparison.json"),
        &Collected {
            program: program(),
            tables: &tables,
            runs: &all,
        },
    )?;
    let drawn = pictures::draw(&comparison, &sweep, layout)?;
    let page = page(config, &comparison, &tables, &drawn)?;
    write(&layout.root.join("report.html"), &page.to_html())?;
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

/// The runs for each number of particles, ascending.
fn by_particles<'a>(records: &'a [(&PlannedRun, RunRecord)]) -> Vec<(usize, Vec<&'a RunRecord>)> {
    let mut groups = std::collections::BTreeMap::<usize, Vec<&RunRecord>>::new();
    for (run, record) in records {
        if let Some(particles) = run.particles {
            groups.entry(particles).or_default().push(record);
        }
    }
    groups.into_iter().collect()
}

fn write_tables(tables: &[Table], layout: &Layout) -> Result<()> {
    let all: Vec<String> = tables.iter().map(text::table).collect();
    write(&layout.root.join("tables.txt"), &all.join("\n"))?;
    let all: Vec<String> = tables.iter().map(markdown::table).collect();
    write(&layout.root.join("tables.md"), &all.join("\n"))?;
    for table in tables {
        let path = layout.root.join(format!("{}.csv", table.name));
        write(&path, &csv::table(table))?;
    }
    Ok(())
}

/// What fits a terminal: all but the single runs.
fn shown(tables: &[Table]) -> String {
    let summaries = tables.iter().filter(|table| table.name != "runs");
    summaries.map(text::table).collect::<Vec<_>>().join("\n")
}

fn page(
    config: &ComparisonConfig,
    comparison: &Comparison,
    tables: &[Table],
    drawn: &[pictures::Drawn],
) -> Result<Page> {
    let section = |title: &str, blocks: Vec<Block>| Section {
        title: title.to_owned(),
        blocks,
    };
    let of = |names: &[&str]| -> Vec<Block> {
        let found = tables.iter().filter(|t| names.contains(&t.name.as_str()));
        found.cloned().map(Block::Table).collect()
    };
    let mut sections = vec![
        section("Tables", of(&["table_1", "table_2"])),
        section("Differences", of(&["differences"])),
        section("Sequences", of(&["by_sequence"])),
    ];
    let mut pictures = Vec::new();
    for picture in drawn {
        let png = fs::read(&picture.path)
            .with_context(|| format!("cannot read {}", picture.path.display()))?;
        pictures.push(Block::Picture {
            png,
            caption: picture.caption.clone(),
        });
    }
    sections.push(section("Pictures", pictures));
    let swept = of(&["particles"]);
    if !swept.is_empty() {
        sections.push(section("Numbers of particles", swept));
    }
    sections.push(section("Runs", of(&["runs"])));
    sections.push(section(
        "Configuration and versions",
        vec![
            Block::Facts(versions(comparison)),
            Block::Folded {
                name: "comparison.yml".to_owned(),
                text: config::to_yaml(config)?,
            },
        ],
    ));
    Ok(Page {
        title: "Comparison".to_owned(),
        subtitle: format!(
            "{} configurations, sequences {}; {} runs.",
            comparison.variants.len(),
            comparison.sequences.join(", "),
            comparison.records.len()
        ),
        sections,
    })
}

/// Programs and machines that took part, each once.
fn versions(comparison: &Comparison) -> Vec<(String, String)> {
    let mut facts: Vec<(String, String)> = vec![("collected by".to_owned(), program())];
    for record in &comparison.records {
        let machine: Vec<&str> = record.machine.values().map(String::as_str).collect();
        let fact = (
            "run by".to_owned(),
            format!("{}, {}", record.program, machine.join(", ")),
        );
        if !facts.contains(&fact) {
            facts.push(fact);
        }
    }
    facts
}

fn program() -> String {
    format!("fpmcl {}", env!("CARGO_PKG_VERSION"))
}

fn write(path: &Path, text: &str) -> Result<()> {
    output::write_whole(path, |file| {
        std::io::Write::write_all(file, text.as_bytes())
    })
}
