//! The page of a comparison: everything of it in one file, whatever is there.

use anyhow::Result;

use super::plan::PlannedRun;
use super::{Layout, pictures};
use crate::app::commands::run_page::{self, PICTURES, TEXTS};
use crate::app::commands::version;
use crate::app::comparison::{Comparison, RunRecord};
use crate::app::config::{self, ComparisonConfig, Overrides, settings};
use crate::app::reporting::{Cell, Column, Page, PageElement, Section, Table};

/// Pictures of a run that are told apart by configuration already.
const SHOWN_FOR_ALL: [&str; 2] = ["path.png", "errors.png"];

/// Names of runs that are told, at most.
const NAMED: usize = 20;

/// Draws the pictures of a comparison and puts all together.
pub fn page(
    config: &ComparisonConfig,
    planned: &[PlannedRun],
    comparison: &Comparison,
    tables: &[Table],
    layout: &Layout,
) -> Result<Page> {
    let of = |names: &[&str]| -> Vec<PageElement> {
        let found = tables.iter().filter(|t| names.contains(&t.name.as_str()));
        found.cloned().map(PageElement::Table).collect()
    };
    let mut sections = vec![
        section("What is missing", missing(planned, comparison)),
        section("Tables", of(&["table_1", "table_2"])),
        section("Differences", of(&["differences"])),
    ];
    let mut all = of(&["by_sequence"]);
    all.extend(drawn(pictures::runs(comparison, layout)?)?);
    sections.push(section("Sequences", all));
    for sequence in &comparison.sequences {
        let blocks = of_sequence(comparison, sequence, layout)?;
        sections.push(section(&format!("Sequence {sequence}"), blocks));
    }
    sections.push(section("Time", of(&["timing"])));
    let mut particles: Vec<PageElement> = of(&["particles"]);
    particles.extend(drawn(pictures::success(comparison, layout)?)?);
    sections.push(section("Numbers of particles", particles));
    sections.push(section("Runs", of(&["runs"])));
    let configuration = configuration(config, comparison, layout)?;
    sections.push(section("Configuration and versions", configuration));
    sections.retain(|section| !section.elements.is_empty());
    Ok(Page {
        title: "Comparison".to_owned(),
        subtitle: format!(
            "{} configurations, sequences {}; {} of {} runs.",
            comparison.variants.len(),
            comparison.sequences.join(", "),
            comparison.all_records().count(),
            planned.len()
        ),
        sections,
    })
}

fn section(title: &str, blocks: Vec<PageElement>) -> Section {
    Section {
        title: title.to_owned(),
        elements: blocks,
    }
}

fn drawn(drawn: impl IntoIterator<Item = pictures::Drawn>) -> Result<Vec<PageElement>> {
    let mut blocks = Vec::new();
    for picture in drawn {
        blocks.extend(run_page::picture(&picture.path, &picture.caption)?);
    }
    Ok(blocks)
}

/// Runs that are planned and not there, and those that failed; nothing where all is well.
fn missing(planned: &[PlannedRun], comparison: &Comparison) -> Vec<PageElement> {
    let is_there = |run: &PlannedRun| comparison.all_records().any(|record| record.id == run.id);
    let absent = planned.iter().filter(|run| !is_there(run));
    let absent: Vec<String> = absent.map(|run| run.id.to_string()).collect();
    let failed = comparison.all_records().filter_map(|record| {
        let why = record.failure()?;
        Some((record.id.to_string(), format!("failed: {why}")))
    });
    let failed: Vec<(String, String)> = failed.collect();
    let mut blocks = Vec::new();
    if !absent.is_empty() {
        let more = match absent.len().saturating_sub(NAMED) {
            0 => String::new(),
            more => format!(" and {more} more"),
        };
        let named = absent[..absent.len().min(NAMED)].join(", ");
        blocks.push(PageElement::Paragraph(format!(
            "{} of {} runs are not there, or were run with another configuration: {named}{more}.",
            absent.len(),
            planned.len()
        )));
    }
    if !failed.is_empty() {
        blocks.push(PageElement::Facts(failed));
    }
    blocks
}

/// All configurations in a sequence, and one run of it with all its pictures.
fn of_sequence(
    comparison: &Comparison,
    sequence: &str,
    layout: &Layout,
) -> Result<Vec<PageElement>> {
    let mut blocks = drawn(pictures::sequence(comparison, sequence, layout)?)?;
    if blocks.is_empty() {
        blocks.push(PageElement::Paragraph(
            "No result of its runs is here: paths and errors over time are left out.".to_owned(),
        ));
    }
    let Some(shown) = shown_run(comparison, sequence, layout) else {
        blocks.push(PageElement::Paragraph(
            "No folder of its runs is here: particles, range images, map, likelihood and time per frame are left out."
                .to_owned(),
        ));
        return Ok(blocks);
    };
    blocks.push(PageElement::Paragraph(format!(
        "One run with all its pictures: {}, the first seed of the last configuration whose pictures are here. Every other run has a page of its own beside this one (Runs).",
        shown.id
    )));
    let mut left_out = Vec::new();
    for (_, name, caption) in PICTURES {
        if SHOWN_FOR_ALL.contains(&name) {
            continue;
        }
        let path = layout.run(&shown.id).join("plots").join(name);
        match run_page::picture(&path, &format!("{}: {caption}", shown.id)) {
            Ok(Some(picture)) => blocks.push(picture),
            Ok(None) => left_out.push(name.to_owned()),
            Err(error) => left_out.push(format!("{error:#}")),
        }
    }
    if !left_out.is_empty() {
        blocks.push(PageElement::Paragraph(format!(
            "Not there, or not readable: {}.",
            left_out.join(", ")
        )));
    }
    Ok(blocks)
}

/// The first seed of the last configuration that has any picture.
fn shown_run<'a>(
    comparison: &'a Comparison,
    sequence: &'a str,
    layout: &Layout,
) -> Option<&'a RunRecord> {
    let has_pictures = |record: &&RunRecord| {
        let plots = layout.run(&record.id).join("plots");
        let own = PICTURES.iter().map(|(_, name, _)| plots.join(name));
        record.judgement().is_some() && own.into_iter().any(|path| path.exists())
    };
    comparison.variants.iter().rev().find_map(|variant| {
        let found = comparison.of(Some(sequence), &variant.name);
        found
            .filter(has_pictures)
            .min_by_key(|record| record.id.seed)
    })
}

/// What was asked for, what it was made by and with which files in force.
fn configuration(
    config: &ComparisonConfig,
    comparison: &Comparison,
    layout: &Layout,
) -> Result<Vec<PageElement>> {
    let mut blocks = vec![
        PageElement::Facts(versions(comparison)?),
        PageElement::Table(differing(config)),
        PageElement::Collapsed {
            name: "comparison.yml".to_owned(),
            text: config::to_yaml(config)?,
        },
    ];
    let sequences = &comparison.sequences;
    let shown = sequences
        .iter()
        .find_map(|sequence| shown_run(comparison, sequence, layout));
    let Some(shown) = shown else {
        return Ok(blocks);
    };
    for name in TEXTS.iter().filter(|name| name.ends_with(".yml")) {
        let path = layout.run(&shown.id).join(name);
        if let Some(text) = run_page::collapsed(&path, &format!("{name} of {}", shown.id))? {
            blocks.push(text);
        }
    }
    Ok(blocks)
}

/// The keys that all runs have in common, and those of each sequence and configuration.
fn differing(config: &ComparisonConfig) -> Table {
    let base = &config.base;
    let row = |name: &str, blocks: &[(&str, &Overrides)]| -> Vec<Cell> {
        let keys = blocks.iter().flat_map(|(block, overrides)| {
            let keys = settings(overrides).into_iter();
            keys.map(move |(key, value)| format!("{block}.{key}: {value}"))
        });
        let keys: Vec<String> = keys.collect();
        vec![name.into(), Cell::Text(keys.join("; "))]
    };
    let stages = |build_map, localization, refinement| {
        [
            ("build_map", build_map),
            ("localization", localization),
            ("refinement", refinement),
        ]
    };
    let mut rows = vec![row(
        "all",
        &stages(&base.build_map, &base.localization, &base.refinement),
    )];
    for sequence in &config.sequences {
        let mut blocks = stages(
            &sequence.build_map,
            &sequence.localization,
            &sequence.refinement,
        )
        .to_vec();
        blocks.extend(sequence.simulation.iter().map(|keys| ("simulation", keys)));
        rows.push(row(&format!("sequence {}", sequence.name), &blocks));
    }
    for variant in &config.configurations {
        let is_refined = if variant.refine { ", refined" } else { "" };
        rows.push(row(
            &format!("{}{is_refined}", variant.name),
            &stages(
                &variant.build_map,
                &variant.localization,
                &variant.refinement,
            ),
        ));
    }
    if let Some(sweep) = &config.particles {
        let name = format!("numbers of particles, {}", sweep.configuration);
        rows.push(row(&name, &[("localization", &sweep.localization)]));
    }
    Table {
        name: "keys".to_owned(),
        title: "What differs from the defaults".to_owned(),
        note: "A key of the sequence overrides that of all, a key of the configuration overrides both.".to_owned(),
        columns: ["who", "keys"].map(Column::named).into(),
        rows,
    }
}

/// Programs and machines that took part, each once.
fn versions(comparison: &Comparison) -> Result<Vec<(String, String)>> {
    let mut facts = vec![("collected by".to_owned(), version::program()?)];
    for record in comparison.all_records() {
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
