//! The page of a run: verdict, path, pictures, numbers, definitions, configuration.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use anyhow::{Context as _, Result};

use crate::app::report::pages::{Cell, Column, Page, PageElement, Section, Table};
use crate::app::report::plotting::Bitmap;
use crate::app::report::results::{MetricRow, Report, Value};
use crate::app::report::run_output::{INTERACTIVE, RunFiles};
use crate::app::run::{output, version};
use crate::evaluation::{LengthErrors, SpatialMetrics, TrajectoryMetrics};

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

/// Pictures of a run after the path: section, file name and caption.
pub const PICTURES: [(&str, &str, &str); 7] = [
    (
        "Errors",
        "errors.png",
        "Position and heading error over time",
    ),
    (
        "One scan",
        "range_images.png",
        "Observed, rendered from the estimate, and their difference: blue is nearer than the map, such as another car, red farther",
    ),
    (
        "States",
        "states.png",
        "Standard deviation of the position that the filter reports, and share of the beams above the road that end on a surface of the map",
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
    ("Map", "map.png", "Map from above with the path of the car"),
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
    let named = |name| report.about.get(name).map(|path| short_name(path));
    let title = match (report.trajectory.is_some(), named("map")) {
        (true, _) => format!("Trajectory {}", named("result").unwrap_or_default()),
        (false, Some(map)) => format!("{} in {map}", named("recording").unwrap_or_default()),
        (false, None) => named("recording").unwrap_or_else(|| "A run".to_owned()),
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

/// The last part of a path; of a folder of scans, the recording that it is in.
fn short_name(path: &str) -> String {
    let mut parts = Path::new(path)
        .components()
        .rev()
        .map(|part| part.as_os_str().to_string_lossy());
    let last = parts.next().unwrap_or_default();
    match (last == "velodyne", parts.next()) {
        (true, Some(folder)) => folder.into_owned(),
        _ => last.into_owned(),
    }
}

impl RunPage<'_> {
    /// Writes `report.html` next to the result.
    pub fn write(&self) -> Result<()> {
        let page = self.page()?;
        output::write_file(&self.files.file("report.html"), |file| page.write(file))
    }

    fn page(&self) -> Result<Page> {
        let section = |title: &str, elements| Section {
            title: title.to_owned(),
            elements,
        };
        let mut sections = vec![section("Path", self.path()?)];
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
            sections.push(section(title, elements));
            if title == "States" {
                sections.push(section("Numbers", numbers(self.report)));
            }
        }
        let mut settings = vec![("program".to_owned(), version::program()?)];
        settings.extend(facts(&self.report.about));
        settings.extend(facts(self.machine));
        let mut elements = vec![PageElement::Facts(settings)];
        for name in TEXTS {
            elements.extend(collapsed(&self.files.file(name), name)?);
        }
        sections.push(section("Definitions", vec![definitions(self.report)]));
        sections.push(section("Inputs and settings", elements));
        sections.retain(|section| !section.elements.is_empty());
        Ok(Page {
            title: self.title.to_owned(),
            verdict: self.report.verdict(),
            subtitle: self.files.result.display().to_string(),
            sections,
        })
    }

    /// The interactive path, and its picture.
    fn path(&self) -> Result<Vec<PageElement>> {
        let plots = self.files.file("plots");
        let content = plots.join(INTERACTIVE);
        let mut elements = Vec::new();
        if content.exists() {
            elements.push(PageElement::Interactive {
                content,
                caption: "Path over the map, colored by error or state. Point at a frame: its scan is drawn where the estimate puts it. Wheel or pinch to zoom, drag to move, double click to see all.".to_owned(),
            });
        }
        elements.extend(picture_or_error(&plots.join("path.png"), "Path, colored by its position error, or without ground truth by its standard deviation"));
        Ok(elements)
    }
}

/// The main metrics of both trajectories, and all of them.
pub fn numbers(report: &Report) -> Vec<PageElement> {
    let mut main = metrics(report, |row| report.is_main(row));
    main.name = "numbers".to_owned();
    let all = Table {
        name: "all_numbers".to_owned(),
        title: "All numbers".to_owned(),
        ..metrics(report, |_row| true)
    };
    vec![PageElement::Table(main), PageElement::CollapsedTable(all)]
}

/// Metrics of both trajectories.
fn metrics(report: &Report, is_shown: impl Fn(&MetricRow) -> bool) -> Table {
    let has_refined = report.is_refined();
    let titles = ["metric", report.estimate_title(), "refined", "unit"];
    let cell = |value: Value| match value {
        Value::Number(number) => Cell::from(number),
        Value::Count(count) => Cell::from(count as f64),
        Value::Flag(_) | Value::NotChecked | Value::Absent => value.to_string().as_str().into(),
    };
    let row = |(row, refined): (MetricRow, Option<Value>)| {
        let mut cells = vec![row.name.into(), cell(row.value)];
        if has_refined {
            cells.push(refined.map_or(Cell::default(), cell));
        }
        cells.push(row.unit.into());
        cells
    };
    let alignment = report.about.get("alignment").map_or("none", String::as_str);
    let errors = [&report.mcl, &report.refined].map(|it| it.as_ref().map(|it| &it.metrics));
    let title = match (errors, &report.trajectory) {
        ([None, None], Some(_)) => {
            format!("Errors in six degrees of freedom; alignment: {alignment}")
        }
        ([None, None], None) if report.has_true_poses => {
            "No trusted pose can be compared with the true poses: what the run shows itself"
                .to_owned()
        }
        ([None, None], None) => "No true poses were given: what the run shows itself".to_owned(),
        ([mcl, refined], _) => {
            format!("{}; alignment: {alignment}", evaluated(mcl, refined))
        }
    };
    let rows = report.joined_rows().into_iter();
    Table {
        name: String::new(),
        title,
        note: String::new(),
        columns: titles
            .into_iter()
            .filter(|title| has_refined || *title != "refined")
            .map(Column::from)
            .collect(),
        rows: rows.filter(|(row, _)| is_shown(row)).map(row).collect(),
    }
}

/// How many frames the errors of the filter and of the refined trajectory are of.
fn evaluated(mcl: Option<&TrajectoryMetrics>, refined: Option<&TrajectoryMetrics>) -> String {
    let skipped = mcl.or(refined).map_or(0, |it| it.skipped_frames);
    let counts = [("MCL", mcl), ("refined", refined)];
    let counts: Vec<String> = counts
        .into_iter()
        .filter_map(|(name, it)| Some(format!("{name} {}", it?.frames)))
        .collect();
    let counts = counts.join(", ");
    format!("Errors without the first {skipped} frames; frames that are trusted: {counts}")
}

/// What each number is.
pub fn definitions(report: &Report) -> PageElement {
    let term = |row: &MetricRow| match row.unit {
        "" => row.name.to_owned(),
        unit => format!("{} [{unit}]", row.name),
    };
    let rows = report.joined_rows().into_iter();
    PageElement::Definitions(
        rows.map(|(row, _)| (term(&row), row.definition.to_owned()))
            .collect(),
    )
}

/// Relative errors of a trajectory by the length of the segments; `None` if it is shorter than all.
pub fn segments(name: &str, metrics: &SpatialMetrics) -> Option<Table> {
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
        columns: [
            "length [m]",
            "translation error [%]",
            "rotation error [deg/100 m]",
            "segments",
        ]
        .map(Column::from)
        .into(),
        rows: metrics.by_length.iter().map(row).collect(),
    })
}

fn stages(seconds: &BTreeMap<String, f64>) -> Table {
    let rows = seconds.iter();
    Table {
        name: "stages".to_owned(),
        title: "Time per stage".to_owned(),
        note: "Stages shared by several runs are listed with the time of their single execution."
            .to_owned(),
        columns: ["stage", "wall time [s]"].map(Column::from).into(),
        rows: rows
            .map(|(stage, &time_s)| vec![stage.as_str().into(), time_s.into()])
            .collect(),
    }
}

pub fn facts(map: &BTreeMap<String, String>) -> Vec<(String, String)> {
    map.clone().into_iter().collect()
}

/// Picture for a page; `None` if the file does not exist.
pub fn picture(path: &Path, caption: &str) -> Result<Option<PageElement>> {
    if !path.exists() {
        return Ok(None);
    }
    let png = Bitmap::read_png(path).and_then(|it| it.to_png());
    Ok(Some(PageElement::Picture {
        png: png.with_context(|| format!("cannot read {}", path.display()))?,
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
