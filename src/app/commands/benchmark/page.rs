//! The page of a benchmark.

use std::path::Path;

use anyhow::Result;

use super::figures::BenchmarkReport;
use super::published::Published;
use crate::app::report::RunFiles;
use crate::app::report::pages::{Column, Page, PageElement, Section, Table};
use crate::app::report::run_page::{PICTURES, definitions, facts, numbers, picture, segments};

/// Assembles the page from the figures and the pictures of the stages.
pub fn page(report: &BenchmarkReport, map: &Path, localized: &RunFiles) -> Result<Page> {
    let odometry = &report.odometry;
    let mut of_odometry = vec![PageElement::Facts(vec![
        ("scans".to_owned(), odometry.scans.to_string()),
        (
            "of them predicted".to_owned(),
            odometry.predicted.to_string(),
        ),
        ("path".to_owned(), format!("{:.1} m", odometry.path_m)),
    ])];
    for (name, errors) in [
        ("odometry, scan by scan", &odometry.scan_by_scan),
        ("after loops and adjustment", &odometry.adjusted),
    ] {
        let Some(errors) = errors else { continue };
        of_odometry.push(PageElement::Paragraph(format!("Errors: {name}.")));
        of_odometry.extend(numbers(errors));
        let metrics = errors.trajectory.as_ref();
        let table = metrics.and_then(|metrics| segments(name, metrics));
        of_odometry.extend(table.map(PageElement::Table));
    }
    let figures = &report.map;
    let mut of_map = vec![PageElement::Facts(vec![
        ("scans".to_owned(), figures.mapped_frames.to_string()),
        ("path".to_owned(), format!("{:.1} m", figures.path_m)),
        ("triangles".to_owned(), figures.triangles.to_string()),
        ("size".to_owned(), format!("{:.1} MB", figures.map_mb)),
        ("time".to_owned(), format!("{:.1} s", figures.seconds)),
    ])];
    of_map.extend(picture(map, "The map from above")?);
    let mut of_localization = numbers(&report.localization);
    if let Some(aligned) = &report.localization_aligned {
        of_localization.push(PageElement::Paragraph(
            "The same after a rigid alignment of the path with the true poses: these figures count where the truths of the two sessions are not in one frame."
                .to_owned(),
        ));
        of_localization.extend(numbers(aligned));
    }
    let plots = localized.file("plots");
    for (_, name, caption) in [("", "path.png", "Path"), PICTURES[0], PICTURES[2]] {
        of_localization.extend(picture(&plots.join(name), caption)?);
    }
    let seconds = report.stage_seconds.iter();
    let mut settings = vec![("program".to_owned(), report.program.clone())];
    settings.extend(facts(&report.machine));
    settings.extend(
        seconds.map(|(name, time_s)| (format!("time of {name}"), format!("{time_s:.0} s"))),
    );
    let reports = [odometry.scan_by_scan.as_deref(), Some(&report.localization)];
    let defined = reports.into_iter().flatten().map(definitions);
    let section = |title: &str, elements| Section {
        title: title.to_owned(),
        elements,
    };
    let (shown, aligned) = match &report.localization_aligned {
        Some(aligned) => (aligned, "; errors after a rigid alignment"),
        None => (&report.localization, ""),
    };
    Ok(Page {
        title: format!("Benchmark on {}", report.recording.display()),
        verdict: shown.verdict(),
        subtitle: match &report.second {
            Some(second) => format!("{} localized in its map{aligned}.", second.display()),
            None => "Every other scan localized in the map of the others.".to_owned(),
        },
        sections: vec![
            section("Odometry", of_odometry),
            section("Map", of_map),
            section("Localization", of_localization),
            section(
                "Published figures",
                vec![PageElement::Table(published(&report.published))],
            ),
            section("Definitions", defined.collect()),
            section("Program and machine", vec![PageElement::Facts(settings)]),
        ],
    })
}

/// Figures of peers, as they were published.
fn published(figures: &[Published]) -> Table {
    Table {
        name: "published".to_owned(),
        title: "What others have published".to_owned(),
        note: "Not measured here; by the definitions of their authors. KISS-ICP raises the points of KITTI by 0.205 degrees. Here they are as recorded unless elevation_bias_deg is 0.205; only then do its figures compare with ours."
            .to_owned(),
        columns: ["method", "data", "figure", "quantity", "source"]
            .map(Column::from)
            .into(),
        rows: (figures.iter())
            .map(|it| {
                [it.method, it.data, it.figure, it.quantity, it.source]
                    .map(Into::into)
                    .into()
            })
            .collect(),
    }
}
