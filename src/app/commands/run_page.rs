//! A run as one page to look at: numbers, pictures, timing, configuration.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use anyhow::{Context as _, Result};

use super::run_output::RunFiles;
use super::{output, version};
use crate::app::comparison::{Cell, Column, Table};
use crate::app::plotting::palette;
use crate::app::reporting::{Block, Page, Section};
use crate::app::results::{Report, TrajectoryReport, Value};

/// What is told of a run; the rest lies beside its result.
pub struct RunPage<'a> {
    /// Where everything is.
    pub files: &'a RunFiles,
    /// Above everything.
    pub title: &'a str,
    /// The numbers.
    pub report: &'a Report,
    /// Wall time per stage [s]; may be empty.
    pub stage_seconds: &'a BTreeMap<String, f64>,
    /// What it was run on; may be empty.
    pub machine: &'a BTreeMap<String, String>,
}

/// The pictures of a run, each with its section and what it shows.
pub const PICTURES: [(&str, &str, &str); 7] = [
    ("Trajectory", "path.png", "Path against ground truth"),
    (
        "Errors",
        "errors.png",
        "Position and heading error over time",
    ),
    ("Particles", "particles.png", "Particles of the first frame"),
    (
        "Range images",
        "range_images.png",
        "Observed, rendered from the estimate, and their difference",
    ),
    (
        "Map",
        "map.png",
        "The map from above, and the path of the car to be found",
    ),
    (
        "Likelihood",
        "likelihood.png",
        "Likelihood around the true pose",
    ),
    ("Timing", "runtime.png", "Time per frame"),
];

/// Configurations and texts that may lie beside a result.
pub const TEXTS: [&str; 5] = [
    "build_map.yml",
    "localization.yml",
    "refinement.yml",
    "evaluation.yml",
    "log.txt",
];

/// Writes the page of a run that is nothing but its files and its numbers.
pub fn write(files: &RunFiles, report: &Report) -> Result<()> {
    let of = report.about.get("recording");
    RunPage {
        files,
        title: &of.map_or("A run".to_owned(), |recording| {
            format!("The car in {recording}")
        }),
        report,
        stage_seconds: &BTreeMap::new(),
        machine: &BTreeMap::new(),
    }
    .write()
}

impl RunPage<'_> {
    /// Writes `report.html` beside the result.
    pub fn write(&self) -> Result<()> {
        let page = self.page()?;
        output::write_text(&self.files.file("report.html"), &page.to_html())
    }

    fn page(&self) -> Result<Page> {
        let mut sections = vec![Section {
            title: "Numbers".to_owned(),
            blocks: vec![
                Block::Facts(facts(&self.report.about)),
                Block::Table(numbers(self.report)),
            ],
        }];
        for (title, name, caption) in PICTURES {
            let path = self.files.file("plots").join(name);
            let mut blocks: Vec<Block> = picture_or_word(&path, caption).into_iter().collect();
            if title == "Timing" && !self.stage_seconds.is_empty() {
                blocks.push(Block::Table(stages(self.stage_seconds)));
            }
            if !blocks.is_empty() {
                sections.push(Section {
                    title: title.to_owned(),
                    blocks,
                });
            }
        }
        let mut blocks = vec![Block::Facts(
            [("program".to_owned(), version::program()?)]
                .into_iter()
                .chain(facts(self.machine))
                .collect(),
        )];
        for name in TEXTS {
            blocks.extend(folded(&self.files.file(name), name)?);
        }
        sections.push(Section {
            title: "Configuration and versions".to_owned(),
            blocks,
        });
        Ok(Page {
            title: self.title.to_owned(),
            subtitle: format!("Result: {}", self.files.result.display()),
            sections,
        })
    }
}

/// The metrics of both trajectories with their definitions.
fn numbers(report: &Report) -> Table {
    let mcl = report.mcl.rows();
    let refined = report.refined.as_ref().map(TrajectoryReport::rows);
    let heads = ["metric", "MCL", "refined", "unit", "definition"];
    let cell = |value: Value| match value {
        Value::Number(number) => Cell::Number(number),
        Value::Count(count) => Cell::Number(count as f64),
        Value::Flag(_) | Value::Absent => Cell::Text(value.to_string()),
    };
    let row = |index: usize| {
        let row = &mcl[index];
        let refined = refined.as_ref().map(|rows| cell(rows[index].value));
        [Some(Cell::from(row.name)), Some(cell(row.value)), refined]
            .into_iter()
            .flatten()
            .chain([row.unit.into(), row.definition.into()])
            .collect()
    };
    Table {
        name: "numbers".to_owned(),
        title: "Errors from the tenth frame on, without alignment".to_owned(),
        note: String::new(),
        columns: heads
            .into_iter()
            .filter(|head| report.refined.is_some() || *head != "refined")
            .map(Column::named)
            .collect(),
        rows: (0..mcl.len()).map(row).collect(),
    }
}

fn stages(seconds: &BTreeMap<String, f64>) -> Table {
    let mut time = Column::named("wall time");
    time.unit = "s".to_owned();
    Table {
        name: "stages".to_owned(),
        title: "Time per stage".to_owned(),
        note: "Stages that several runs share are told with the time that they took once."
            .to_owned(),
        columns: vec![Column::named("stage"), time],
        rows: seconds
            .iter()
            .map(|(stage, &time_s)| vec![stage.as_str().into(), Cell::Number(time_s)])
            .collect(),
    }
}

fn facts(map: &BTreeMap<String, String>) -> Vec<(String, String)> {
    map.iter().map(|(k, v)| (k.clone(), v.clone())).collect()
}

/// A picture of a page; `None` where there is none.
pub fn picture(path: &Path, caption: &str) -> Result<Option<Block>> {
    if !path.exists() {
        return Ok(None);
    }
    Ok(Some(Block::Picture {
        png: palette::with_palette(path)?,
        caption: caption.to_owned(),
    }))
}

/// A picture of a page, or why it is left out: one that is damaged costs no run its page.
fn picture_or_word(path: &Path, caption: &str) -> Option<Block> {
    picture(path, caption).unwrap_or_else(|error| {
        tracing::warn!("{} is left out of the page: {error:#}", path.display());
        Some(Block::Paragraph(format!("Left out: {error:#}.")))
    })
}

/// A text that is folded away under a name; `None` where there is none.
pub fn folded(path: &Path, name: &str) -> Result<Option<Block>> {
    if !path.exists() {
        return Ok(None);
    }
    let bytes = fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    Ok(Some(Block::Folded {
        name: name.to_owned(),
        text: String::from_utf8_lossy(&bytes).into_owned(),
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::app::plotting::Bitmap;

    #[test]
    fn a_damaged_picture_is_left_out_and_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("map.png");
        assert!(picture_or_word(&path, "The map").is_none());
        fs::write(&path, "half a").unwrap();
        let Some(Block::Paragraph(told)) = picture_or_word(&path, "The map") else {
            panic!("nothing is said of it");
        };
        assert!(told.contains("map.png"), "{told}");
        let pixels = Bitmap::from_fn(2, 2, |_, _| [0; 3]);
        pixels.write_png(fs::File::create(&path).unwrap()).unwrap();
        let shown = picture_or_word(&path, "The map");
        assert!(matches!(shown, Some(Block::Picture { .. })));
    }
}
