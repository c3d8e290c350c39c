//! What a comparison looks like.

use std::path::PathBuf;

use anyhow::{Context as _, Result};

use super::Layout;
use crate::app::comparison::tables::rate;
use crate::app::comparison::{Comparison, RunRecord};
use crate::app::plotting::color::{Rgb, SERIES};
use crate::app::plotting::{LineChart, Mark, NamedPath, Panel, PathPlot, Series};
use crate::app::reporting::SuccessRate;
use crate::app::results::LocalizationResults;
use crate::evaluation::{PlanarError, planar_errors};
use crate::geometry::Pose2;

/// A picture and what it shows.
pub struct Drawn {
    /// The PNG.
    pub path: PathBuf,
    /// What it shows.
    pub caption: String,
}

/// The error of every run; `None` without runs.
pub fn runs(comparison: &Comparison, layout: &Layout) -> Result<Option<Drawn>> {
    let caption = "Average positional error of every run over its seed".to_owned();
    chart("runs.png", caption, &dots(comparison), layout)
}

/// Success against the number of particles; `None` where nobody asked for it.
pub fn success(comparison: &Comparison, layout: &Layout) -> Result<Option<Drawn>> {
    let caption =
        "Success rate against the number of particles, dashed: 95 % interval (Wilson)".to_owned();
    let drawn = success_rates(&comparison.sweep);
    chart("success.png", caption, &drawn, layout)
}

/// The trajectories of all configurations in a sequence over each other, and their errors. Runs
/// whose result is not there are left out.
pub fn sequence(comparison: &Comparison, sequence: &str, layout: &Layout) -> Result<Vec<Drawn>> {
    let found = trajectories(comparison, sequence, layout);
    let Some(first) = found.first() else {
        return Ok(Vec::new());
    };
    let seeds: Vec<String> = found
        .iter()
        .map(|one| format!("{} seed {}", one.name, one.seed))
        .collect();
    let seeds = seeds.join(", ");
    let paths: Vec<NamedPath> = found
        .iter()
        .map(|one| NamedPath {
            name: &one.name,
            color: one.color,
            poses: &one.poses,
        })
        .collect();
    let path = plot(layout, &format!("paths_{sequence}.png"))?;
    PathPlot {
        title: &format!("{sequence}: paths against ground truth"),
        ground_truth: Some(&first.truth),
        paths: &paths,
        map: None,
    }
    .save(&path)?;
    let caption = format!("The paths of all configurations over each other ({seeds})");
    let mut drawn = vec![Drawn { path, caption }];
    let caption = format!("Position and heading error over time ({seeds})");
    let errors = errors(sequence, &found);
    drawn.extend(chart(
        &format!("errors_{sequence}.png"),
        caption,
        &errors,
        layout,
    )?);
    Ok(drawn)
}

/// Saves a chart unless it is empty.
fn chart(name: &str, caption: String, chart: &LineChart, layout: &Layout) -> Result<Option<Drawn>> {
    if chart.panels.iter().all(|panel| panel.series.is_empty()) {
        return Ok(None);
    }
    let path = plot(layout, name)?;
    chart.save(&path)?;
    Ok(Some(Drawn { path, caption }))
}

fn plot(layout: &Layout, name: &str) -> Result<PathBuf> {
    let folder = layout.root.join("plots");
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot create {}", folder.display()))?;
    Ok(folder.join(name))
}

/// What a configuration ended with in a sequence, of its first seed that is there.
struct Trajectory {
    name: String,
    color: Rgb,
    seed: u64,
    frames: Vec<usize>,
    poses: Vec<Pose2>,
    truth: Vec<Pose2>,
}

fn trajectories(comparison: &Comparison, sequence: &str, layout: &Layout) -> Vec<Trajectory> {
    let variants = comparison.variants.iter().enumerate();
    let of_variant = variants.filter_map(|(index, variant)| {
        let mut records: Vec<&RunRecord> = comparison
            .of(Some(sequence), &variant.name)
            .filter(|record| record.judgement().is_some())
            .collect();
        records.sort_by_key(|record| record.id.seed);
        let color = SERIES[index % SERIES.len()];
        (records.into_iter()).find_map(|record| trajectory(record, color, layout))
    });
    of_variant.collect()
}

/// `None` where only the record of a run is there, or its result cannot be read.
fn trajectory(record: &RunRecord, color: Rgb, layout: &Layout) -> Option<Trajectory> {
    let path = layout.run(&record.id).join("localization.npz");
    if !path.exists() {
        return None;
    }
    let results = match LocalizationResults::read(&path) {
        Ok(results) => results,
        Err(error) => {
            tracing::warn!("{} is not drawn: {error}", record.id);
            return None;
        }
    };
    Some(Trajectory {
        name: record.id.configuration.clone(),
        color,
        seed: record.id.seed,
        frames: results.frames,
        poses: results.refined.or(results.estimates)?,
        truth: results.ground_truth?,
    })
}

/// A panel for position and one for heading, a line per configuration.
fn errors(sequence: &str, found: &[Trajectory]) -> LineChart {
    let panel = |y_name: &str, number: fn(&PlanarError) -> f64| {
        let series = found.iter().map(|one| {
            let errors = planar_errors(&one.poses, &one.truth);
            let points = one.frames.iter().zip(&errors);
            let points = points.map(|(&frame, error)| (frame as f64, number(error)));
            Series::line(&one.name, one.color, points)
        });
        Panel {
            y_name: y_name.to_owned(),
            series: series.collect(),
            clip_outliers: true,
            ..Panel::default()
        }
    };
    LineChart {
        title: format!("{sequence}: errors over time"),
        x_name: "frame".to_owned(),
        panels: vec![
            panel("position error [m]", PlanarError::distance_m),
            panel("heading error [deg]", |error| {
                error.turn_rad.abs().to_degrees()
            }),
        ],
        marks: Vec::new(),
    }
}

/// A panel per sequence, a dot per run over its seed.
fn dots(comparison: &Comparison) -> LineChart {
    let panel = |sequence: &String| {
        let variants = comparison.variants.iter().enumerate();
        let series = variants.map(|(index, variant)| {
            // Side by side, so that equal runs do not hide each other.
            let aside = 0.05 * (index as f64 - 0.5 * (comparison.variants.len() - 1) as f64);
            let records = comparison.of(Some(sequence), &variant.name);
            let points = records.filter_map(|record| {
                let seed = record.id.seed as f64 + aside;
                Some((seed, record.judgement()?.metrics.position_m.mean))
            });
            Series {
                name: variant.name.clone(),
                color: SERIES[index % SERIES.len()],
                mark: Mark::Dots,
                points: points.collect(),
            }
        });
        Panel {
            y_name: format!("{sequence}: error [m]"),
            series: series.filter(|series| !series.points.is_empty()).collect(),
            ..Panel::default()
        }
    };
    let panels = comparison.sequences.iter().map(panel);
    LineChart {
        title: "Average positional error of every run".to_owned(),
        x_name: "seed".to_owned(),
        panels: panels.filter(|panel| !panel.series.is_empty()).collect(),
        marks: Vec::new(),
    }
}

/// The share of runs that found the car and kept it, with its interval, over the number of
/// particles.
fn success_rates(sweep: &[(usize, Vec<RunRecord>)]) -> LineChart {
    let rates: Vec<(usize, SuccessRate)> = sweep
        .iter()
        .filter_map(|(count, records)| Some((*count, rate(records.iter())?)))
        .collect();
    let place = |count: usize| (count as f64).log10();
    let line = |name: &str, color, mark, number: fn(&SuccessRate) -> f64| Series {
        name: name.to_owned(),
        color,
        mark,
        points: rates
            .iter()
            .map(|(count, rate)| (place(*count), 100.0 * number(rate)))
            .collect(),
    };
    let series = vec![
        line("success", SERIES[0], Mark::Line, |rate| rate.rate),
        line("95 % interval", SERIES[0], Mark::Dashes, |rate| rate.low),
        line("", SERIES[0], Mark::Dashes, |rate| rate.high),
    ];
    LineChart {
        title: "Success against the number of particles".to_owned(),
        x_name: "log10 of the number of particles".to_owned(),
        panels: vec![Panel {
            y_name: "success [%]".to_owned(),
            series: if rates.is_empty() { Vec::new() } else { series },
            ..Panel::default()
        }],
        marks: rates
            .iter()
            .map(|(count, _)| (place(*count), count.to_string()))
            .collect(),
    }
}
