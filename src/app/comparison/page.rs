//! Page of a comparison: tables, plots and configuration in one HTML file, from the available files.

use anyhow::Result;

use super::layout::Layout;
use super::pictures;
use super::plan::PlannedRun;
use super::record::{Outcome, RunRecord};
use super::results::ComparisonResults;
use super::table::{Cell, Column, Table};
use crate::app::comparison::config::{ComparisonConfig, Overrides, settings};
use crate::app::report::pages::{Page, PageElement, Section};
use crate::app::report::results::length;
use crate::app::report::run_page::{PICTURES, TEXTS, collapsed, picture};
use crate::app::run::version;
use crate::app::settings::{self};
use crate::evaluation::Summary;

/// Picture of a run that the comparison has for all configurations together.
const COMBINED_PICTURE: &str = "errors.png";

/// Maximum number of missing runs to list.
const MAX_LISTED: usize = 20;

/// Draws the plots of a comparison and assembles its page.
pub fn page(
    results: &ComparisonResults,
    tables: &[Table],
    planned: &[PlannedRun],
    layout: &Layout,
) -> Result<Page> {
    let elements = |names: &[&str]| -> Vec<PageElement> {
        let tables = tables.iter().filter(|t| names.contains(&t.name.as_str()));
        let tables = tables.cloned().map(Table::without_absent_columns);
        tables.map(|it| PageElement::Table(it.into())).collect()
    };
    let mut sequences = elements(&["by_sequence", "states"]);
    sequences.extend(pictures::errors_of_runs(results, layout)?);
    let mut sections = vec![
        section("Missing runs", missing_runs(results, planned)),
        section("Tables", elements(&["table_1", "table_2"])),
        section("Differences", elements(&["differences"])),
        section("Sequences", sequences),
    ];
    for sequence in &results.sequences {
        let elements = sequence_elements(results, sequence, layout)?;
        sections.push(section(&format!("Sequence {sequence}"), elements));
    }
    let mut particles = elements(&["particles"]);
    particles.extend(pictures::success_rates(results, layout)?);
    sections.extend([
        section("Time", elements(&["timing"])),
        section("Numbers of particles", particles),
        section("Runs", elements(&["runs"])),
        section(
            "Configuration and versions",
            configuration(results, layout)?,
        ),
    ]);
    sections.retain(|section| !section.elements.is_empty());
    Ok(Page {
        title: format!("Comparison on {}", results.sequences.join(", ")),
        verdict: verdict(results),
        subtitle: format!(
            "{} of {} runs of {} configurations.",
            results.all_records().count(),
            planned.len(),
            results.config.configurations.len()
        ),
        sections,
    })
}

/// Mean error and success of each configuration over all its runs, best first.
fn verdict(results: &ComparisonResults) -> String {
    let mut configurations: Vec<(f64, String)> = Vec::new();
    for variant in &results.config.configurations {
        let runs: Vec<&RunRecord> = results.runs_by_sequence(&variant.name).concat();
        let errors: Vec<_> = runs.iter().filter_map(|run| run.metrics()).collect();
        let Some(position) = Summary::new(
            &errors
                .iter()
                .map(|it| it.position_m.rmse)
                .collect::<Vec<_>>(),
        ) else {
            continue;
        };
        let successes = runs.iter().filter(|run| run.is_success()).count();
        let wrong = runs.iter().filter_map(|run| run.trust.as_ref());
        let wrong = match wrong.map(|trust| trust.wrong).sum() {
            0 => String::new(),
            count => format!(", with {count} frames of the filter wrong and tracking"),
        };
        let text = format!(
            "{} {}, {successes} of {} runs successful{wrong}",
            variant.name,
            length(position.mean),
            runs.len()
        );
        configurations.push((position.mean, text));
    }
    configurations.sort_by(|a, b| a.0.total_cmp(&b.0));
    let texts: Vec<String> = configurations.into_iter().map(|(_, text)| text).collect();
    if texts.is_empty() {
        String::new()
    } else {
        format!(
            "Position error (RMS, mean of all runs): {}.",
            texts.join("; ")
        )
    }
}

fn section(title: &str, elements: Vec<PageElement>) -> Section {
    Section {
        title: title.to_owned(),
        elements,
    }
}

/// Planned runs without a record, and failed runs; empty if there are none.
fn missing_runs(results: &ComparisonResults, planned: &[PlannedRun]) -> Vec<PageElement> {
    let has_record = |run: &&PlannedRun| results.all_records().any(|record| record.id == run.id);
    let missing = planned.iter().filter(|run| !has_record(run));
    let missing: Vec<String> = missing.map(|run| run.id.to_string()).collect();
    let failed = results
        .all_records()
        .filter_map(|record| match &record.outcome {
            Outcome::Finished(_) => None,
            Outcome::Failed(message) => Some((record.id.to_string(), format!("failed: {message}"))),
        });
    let failed: Vec<(String, String)> = failed.collect();
    let mut elements = Vec::new();
    if !missing.is_empty() {
        let listed = missing[..missing.len().min(MAX_LISTED)].join(", ");
        let more = match missing.len().saturating_sub(MAX_LISTED) {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        elements.push(PageElement::Paragraph(format!(
            "{} of {} runs are missing or have another configuration: {listed}{more}.",
            missing.len(),
            planned.len()
        )));
    }
    if !failed.is_empty() {
        elements.push(PageElement::Facts(failed));
    }
    elements
}

/// All configurations in a sequence, and the pictures of one of its runs.
fn sequence_elements(
    results: &ComparisonResults,
    sequence: &str,
    layout: &Layout,
) -> Result<Vec<PageElement>> {
    let mut elements = pictures::trajectories(results, sequence, layout)?;
    if elements.is_empty() {
        elements.push(PageElement::Paragraph(
            "No paths and no errors over time: the result files of the runs are missing."
                .to_owned(),
        ));
    }
    let Some(run) = example_run(results, sequence, layout) else {
        elements.push(PageElement::Paragraph(
            "No particles, range images, map and time per frame: the pictures of the runs are missing."
                .to_owned(),
        ));
        return Ok(elements);
    };
    elements.push(PageElement::Paragraph(format!(
        "Example run: {}, the first seed of the last configuration with pictures. Every run has a page of its own, linked from the table of runs.",
        run.id
    )));
    let mut omitted = Vec::new();
    for (_, name, caption) in PICTURES {
        if name == COMBINED_PICTURE {
            continue;
        }
        let path = layout.run(&run.id).join("plots").join(name);
        match picture(&path, &format!("{}: {caption}", run.id)) {
            Ok(Some(picture)) => elements.push(picture),
            Ok(None) => omitted.push(name.to_owned()),
            Err(error) => omitted.push(format!("{error:#}")),
        }
    }
    if !omitted.is_empty() {
        let omitted = omitted.join(", ");
        elements.push(PageElement::Paragraph(format!(
            "Missing or not readable: {omitted}."
        )));
    }
    Ok(elements)
}

/// First seed of the last configuration that has a finished run with pictures.
fn example_run<'a>(
    results: &'a ComparisonResults,
    sequence: &str,
    layout: &Layout,
) -> Option<&'a RunRecord> {
    let has_pictures = |record: &&RunRecord| {
        let plots = layout.run(&record.id).join("plots");
        let mut names = PICTURES.iter().map(|(_, name, _)| name);
        record.metrics().is_some() && names.any(|name| plots.join(name).exists())
    };
    results.config.configurations.iter().rev().find_map(|it| {
        let runs = results.runs(sequence, &it.name).into_iter();
        runs.filter(has_pictures).min_by_key(|run| run.id.seed)
    })
}

/// Programs, overrides and effective configurations.
fn configuration(results: &ComparisonResults, layout: &Layout) -> Result<Vec<PageElement>> {
    let mut elements = vec![
        PageElement::Facts(versions(results)?),
        PageElement::Table(overrides_table(results.config).into()),
        PageElement::Collapsed {
            name: "comparison.yml".to_owned(),
            text: settings::to_yaml(results.config)?,
        },
    ];
    let mut examples = results.sequences.iter();
    let example = examples.find_map(|sequence| example_run(results, sequence, layout));
    let Some(run) = example else {
        return Ok(elements);
    };
    for name in TEXTS.iter().filter(|name| name.ends_with(".yml")) {
        let path = layout.run(&run.id).join(name);
        elements.extend(collapsed(&path, &format!("{name} of {}", run.id))?);
    }
    Ok(elements)
}

/// Overrides of all runs, of each sequence and of each configuration.
fn overrides_table(config: &ComparisonConfig) -> Table {
    let row = |name: String, elements: &[(&str, &Overrides)]| -> Vec<Cell> {
        let keys = elements.iter().flat_map(|(block, overrides)| {
            let keys = settings(overrides).into_iter();
            keys.map(move |(key, value)| format!("{block}.{key}: {value}"))
        });
        let keys: Vec<String> = keys.collect();
        vec![Cell::Text(name), Cell::Text(keys.join("; "))]
    };
    let stages = |build_map, localization, refinement| {
        vec![
            ("build_map", build_map),
            ("localization", localization),
            ("refinement", refinement),
        ]
    };
    let base = &config.base;
    let mut elements = stages(&base.build_map, &base.localization, &base.refinement);
    elements.push(("simulation", &base.simulation));
    let mut rows = vec![row("all".to_owned(), &elements)];
    for it in &config.sequences {
        let mut elements = stages(&it.build_map, &it.localization, &it.refinement);
        elements.extend(it.simulation.iter().map(|keys| ("simulation", keys)));
        elements.push(("second_drive", &it.second_drive));
        rows.push(row(format!("sequence {}", it.name), &elements));
    }
    for it in &config.configurations {
        let refined = if it.refine { ", refined" } else { "" };
        let elements = stages(&it.build_map, &it.localization, &it.refinement);
        rows.push(row(format!("{}{refined}", it.name), &elements));
    }
    if let Some(sweep) = &config.particles {
        let name = format!("numbers of particles, {}", sweep.configuration);
        rows.push(row(name, &[("localization", &sweep.localization)]));
    }
    Table {
        name: "keys".to_owned(),
        title: "Differences from the defaults".to_owned(),
        note:
            "Keys of a sequence override those of all runs, keys of a configuration override both."
                .to_owned(),
        columns: ["scope", "keys"].map(Column::named).into(),
        rows,
    }
}

/// Programs and machines of the runs, each once.
fn versions(results: &ComparisonResults) -> Result<Vec<(String, String)>> {
    let mut facts = vec![("collected by".to_owned(), version::program()?)];
    for record in results.all_records() {
        let machine = record.machine.iter();
        let machine: String = machine
            .map(|(key, value)| format!(", {key} {value}"))
            .collect();
        let fact = ("run by".to_owned(), record.program.clone() + &machine);
        if !facts.contains(&fact) {
            facts.push(fact);
        }
    }
    Ok(facts)
}
