//! The page of a run: metrics, pictures, timing, configuration.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use anyhow::{Context as _, Result};

use super::run_output::RunFiles;
use super::{output, version};
use crate::app::plotting::palette;
use crate::app::reporting::{Cell, Column, Page, PageElement, Section, Table};
use crate::app::results::{MetricRow, Report, Value};
use crate::evaluation::{LengthErrors, SpatialMetrics};

/// Content of the page, apart from the files of the run.
pub struct RunPage<'a> {
    /// Files of the run.
    pub files: &'a RunFiles,
    /// Title.
    pub title: &'a str,
    /// Metrics.
    pub report: &'a Report,
    /// Wall time per stage [s]; may be empty.
    pub stage_seconds: &'a BTreeMap<String, f64>,
    /// Properties of the machine; may be empty.
    pub machine: &'a BTreeMap<String, String>,
}

/// Pictures of a run: section, file name and caption.
pub const PICTURES: [(&str, &str, &str); 9] = [
    ("View", "view.png", "Map with the path"),
    (
        "Trajectory",
        "path.png",
        "Path, colored by its position error, or without ground truth by its standard deviation",
    ),
    (
        "Errors",
        "errors.png",
        "Position and heading error over time",
    ),
    (
        "Drift",
        "drift.png",
        "Position and heading error against the distance driven along the truth, as evaluated and (dashed) after rigid alignment; relative errors against the length of the segments",
    ),
    (
        "Particles",
        "particles.png",
        "Particles from the first frame to the last",
    ),
    (
        "Range images",
        "range_images.png",
        "Observed, rendered from the estimate, and their difference",
    ),
    ("Map", "map.png", "Map from above with the path of the car"),
    (
        "Likelihood",
        "likelihood.png",
        "Likelihood around the true pose, or the estimate",
    ),
    ("Timing", "runtime.png", "Time per frame"),
];

/// Configuration and log files of a run, where they exist.
pub const TEXTS: [&str; 5] = [
    "effective_build_map.yml",
    "effective_localization.yml",
    "effective_refinement.yml",
    "effective_evaluation.yml",
    "log.txt",
];

/// Writes the page of a run without timing and machine.
pub fn write(files: &RunFiles, report: &Report) -> Result<()> {
    let named = |name| report.about.get(name).map(String::as_str);
    let title = match report.trajectory {
        Some(_) => format!("Trajectory {}", named("result").unwrap_or_default()),
        None => format!("Localization in {}", named("recording").unwrap_or("a run")),
    };
    RunPage {
        files,
        title: &title,
        report,
        stage_seconds: &BTreeMap::new(),
        machine: &BTreeMap::new(),
    }
    .write()
}

impl RunPage<'_> {
    /// Writes `report.html` beside the result.
    pub fn write(&self) -> Result<()> {
        output::write_text(&self.files.file("report.html"), &self.page()?.to_html())
    }

    fn page(&self) -> Result<Page> {
        let section = |title: &str, elements| Section {
            title: title.to_owned(),
            elements,
        };
        let about = PageElement::Facts(facts(&self.report.about));
        let metrics = PageElement::Table(metrics(self.report));
        let mut sections = vec![section("Metrics", vec![about, metrics])];
        for (title, name, caption) in PICTURES {
            let path = self.files.file("plots").join(name);
            let mut elements: Vec<PageElement> =
                picture_or_error(&path, caption).into_iter().collect();
            if title == "Drift" {
                let in_space = self.report.in_space();
                let tables = in_space.into_iter().filter_map(|it| segments(it.0, it.1));
                elements.extend(tables.map(PageElement::Table));
            }
            if title == "Timing" && !self.stage_seconds.is_empty() {
                elements.push(PageElement::Table(stages(self.stage_seconds)));
            }
            if !elements.is_empty() {
                sections.push(section(title, elements));
            }
        }
        let mut versions = vec![("program".to_owned(), version::program()?)];
        versions.extend(facts(self.machine));
        let mut elements = vec![PageElement::Facts(versions)];
        for name in TEXTS {
            elements.extend(collapsed(&self.files.file(name), name)?);
        }
        sections.push(section("Configuration and versions", elements));
        Ok(Page {
            title: self.title.to_owned(),
            subtitle: format!("Result: {}", self.files.result.display()),
            sections,
        })
    }
}

/// Metrics of both trajectories with their definitions.
fn metrics(report: &Report) -> Table {
    let has_refined = report.refined.is_some();
    let titles = [
        "metric",
        report.estimate_title(),
        "refined",
        "unit",
        "definition",
    ];
    let cell = |value: Value| match value {
        Value::Number(number) => Cell::Number(number),
        Value::Count(count) => Cell::Number(count as f64),
        Value::Flag(_) | Value::NotChecked | Value::Absent => Cell::Text(value.to_string()),
    };
    let row = |(row, refined): (MetricRow, Option<Value>)| {
        let mut cells = vec![row.name.into(), cell(row.value)];
        if has_refined {
            cells.push(refined.map_or(Cell::Text(String::new()), cell));
        }
        cells.extend([row.unit.into(), row.definition.into()]);
        cells
    };
    let alignment = report.about.get("alignment").map_or("none", String::as_str);
    let title = match (&report.mcl, &report.trajectory) {
        (Some(_), _) => format!("Errors from the tenth frame on; alignment: {alignment}"),
        (None, Some(_)) => format!("Errors in six degrees of freedom; alignment: {alignment}"),
        (None, None) => "No true poses were given: what the run shows itself".to_owned(),
    };
    Table {
        name: "numbers".to_owned(),
        title,
        note: String::new(),
        columns: titles
            .into_iter()
            .filter(|title| has_refined || *title != "refined")
            .map(Column::named)
            .collect(),
        rows: report.joined_rows().into_iter().map(row).collect(),
    }
}

/// Relative errors of a trajectory by the length of the segments; `None` if it is shorter than all.
fn segments(name: &str, metrics: &SpatialMetrics) -> Option<Table> {
    let column = |name: &str, unit: &str| Column {
        unit: unit.to_owned(),
        ..Column::named(name)
    };
    let row = |it: &LengthErrors| {
        vec![
            it.length_m.into(),
            it.errors.translation_percent.into(),
            it.errors.rotation_deg_per_100_m().into(),
            (it.errors.segments as f64).into(),
        ]
    };
    (!metrics.by_length.is_empty()).then(|| Table {
        name: format!("segments_{}", name.replace(' ', "_")),
        title: format!("Mean errors over segments by their length: {name}"),
        note: "From every frame up to 50 m, from every tenth from 100 m on; divided by the length."
            .to_owned(),
        columns: vec![
            column("length", "m"),
            column("translation error", "%"),
            column("rotation error", "deg/100 m"),
            Column::named("segments"),
        ],
        rows: metrics.by_length.iter().map(row).collect(),
    })
}

fn stages(seconds: &BTreeMap<String, f64>) -> Table {
    let mut time = Column::named("wall time");
    time.unit = "s".to_owned();
    let rows = seconds.iter();
    Table {
        name: "stages".to_owned(),
        title: "Time per stage".to_owned(),
        note: "Stages shared by several runs are listed with the time of their single execution."
            .to_owned(),
        columns: vec![Column::named("stage"), time],
        rows: rows
            .map(|(stage, &time_s)| vec![stage.as_str().into(), time_s.into()])
            .collect(),
    }
}

fn facts(map: &BTreeMap<String, String>) -> Vec<(String, String)> {
    map.clone().into_iter().collect()
}

/// Picture for a page; `None` if the file does not exist.
pub fn picture(path: &Path, caption: &str) -> Result<Option<PageElement>> {
    if !path.exists() {
        return Ok(None);
    }
    Ok(Some(PageElement::Picture {
        png: palette::with_palette(path)?,
        caption: caption.to_owned(),
    }))
}

/// Picture for a page, or the reason why it is left out: a damaged file must not prevent the page.
fn picture_or_error(path: &Path, caption: &str) -> Option<PageElement> {
    picture(path, caption).unwrap_or_else(|error| {
        tracing::warn!("{} is left out of the page: {error:#}", path.display());
        Some(PageElement::Paragraph(format!("Left out: {error:#}.")))
    })
}

/// Collapsed text of a file; `None` if it does not exist.
pub fn collapsed(path: &Path, name: &str) -> Result<Option<PageElement>> {
    if !path.exists() {
        return Ok(None);
    }
    let bytes = fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    Ok(Some(PageElement::Collapsed {
        name: name.to_owned(),
        text: String::from_utf8_lossy(&bytes).into_owned(),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::plotting::Bitmap;

    #[test]
    fn a_damaged_picture_is_replaced_by_the_reason() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.png");
        assert!(picture_or_error(&path, "The map").is_none());
        fs::write(&path, "half a").unwrap();
        let Some(PageElement::Paragraph(reason)) = picture_or_error(&path, "The map") else {
            panic!("there is no reason");
        };
        assert!(reason.contains("map.png"), "{reason}");
        let pixels = Bitmap::from_fn(2, 2, |_, _| [0; 3]);
        pixels.write_png(fs::File::create(&path).unwrap()).unwrap();
        let shown = picture_or_error(&path, "The map");
        assert!(matches!(shown, Some(PageElement::Picture { .. })));
    }
}
