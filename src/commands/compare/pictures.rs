//! What a comparison looks like.

use std::path::PathBuf;

use anyhow::{Context as _, Result};

use super::Layout;
use crate::evaluation::comparison::tables::rate;
use crate::evaluation::comparison::{Comparison, RunRecord, SuccessRate};
use crate::evaluation::{LocalizationResults, planar_errors};
use crate::plotting::color::SERIES;
use crate::plotting::{LineChart, Mark, Panel, Series};

/// A picture and what it shows.
pub struct Drawn {
    /// The PNG.
    pub path: PathBuf,
    /// What it shows.
    pub caption: String,
}

/// Draws all pictures for which there is something to draw.
pub fn draw(
    comparison: &Comparison,
    sweep: &[(usize, Vec<&RunRecord>)],
    layout: &Layout,
) -> Result<Vec<Drawn>> {
    let folder = layout.root.join("plots");
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot create {}", folder.display()))?;
    let mut drawn = Vec::new();
    let mut save = |name: &str, caption: &str, chart: LineChart| -> Result<()> {
        let path = folder.join(name);
        if chart.panels.iter().any(|panel| !panel.series.is_empty()) {
            chart.save(&path)?;
            drawn.push(Drawn {
                path,
                caption: caption.to_owned(),
            });
        }
        Ok(())
    };
    save(
        "runs.png",
        "Average positional error of every run over its seed",
        dots(comparison),
    )?;
    save(
        "errors.png",
        "Position error over time, first seed of each sequence",
        errors(comparison, layout)?,
    )?;
    save(
        "success.png",
        "Success rate against the number of particles, dashed: 95 % interval (Wilson)",
        success(sweep),
    )?;
    Ok(drawn)
}

/// A panel per sequence, a dot per run over its seed.
fn dots(comparison: &Comparison) -> LineChart {
    let panel = |sequence: &String| {
        let variants = comparison.variants.iter().enumerate();
        let series = variants.map(|(index, variant)| {
            // Side by side, so that equal runs do not hide each other.
            let aside = 0.05 * (index as f64 - 0.5 * (comparison.variants.len() - 1) as f64);
            let points = comparison.records.iter().filter_map(|record| {
                let is_own =
                    record.id.sequence == *sequence && record.id.configuration == variant.name;
                let judgement = record.judgement().filter(|_| is_own)?;
                let seed = record.id.seed as f64 + aside;
                Some((seed, judgement.metrics.position_m.mean))
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
            from_zero: true,
            ..Panel::default()
        }
    };
    LineChart {
        title: "Average positional error of every run".to_owned(),
        x_name: "seed".to_owned(),
        panels: filled(comparison.sequences.iter().map(panel)),
        marks: Vec::new(),
    }
}

/// A panel per sequence, a line per configuration.
fn errors(comparison: &Comparison, layout: &Layout) -> Result<LineChart> {
    let mut panels = Vec::new();
    for sequence in &comparison.sequences {
        let mut series = Vec::new();
        for (index, variant) in comparison.variants.iter().enumerate() {
            let of = comparison.records.iter().filter(|record| {
                record.id.sequence == *sequence
                    && record.id.configuration == variant.name
                    && record.judgement().is_some()
            });
            let Some(record) = of.min_by_key(|record| record.id.seed) else {
                continue;
            };
            let path = layout.run(&record.id).join("localization.npz");
            if !path.exists() {
                // Collected from elsewhere: its record came without it.
                continue;
            }
            let results = LocalizationResults::read(&path)?;
            let poses = results.refined.as_deref().or(results.estimates.as_deref());
            let Some((poses, truth)) = poses.zip(results.ground_truth.as_deref()) else {
                continue;
            };
            let errors = planar_errors(poses, truth);
            let points = results.frames.iter().zip(&errors);
            series.push(Series::line(
                &variant.name,
                SERIES[index % SERIES.len()],
                points.map(|(&frame, error)| (frame as f64, error.distance_m())),
            ));
        }
        panels.push(Panel {
            y_name: format!("{sequence}: error [m]"),
            series,
            from_zero: true,
            clip_outliers: true,
            ..Panel::default()
        });
    }
    Ok(LineChart {
        title: "Position error over time, first seed".to_owned(),
        x_name: "frame".to_owned(),
        panels: filled(panels.into_iter()),
        marks: Vec::new(),
    })
}

/// The share of runs that found the car and kept it, with its interval, over the number of
/// particles.
fn success(sweep: &[(usize, Vec<&RunRecord>)]) -> LineChart {
    let rates: Vec<_> = sweep
        .iter()
        .filter_map(|(count, records)| Some((*count, rate(records)?)))
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
        line("95 % interval, low", SERIES[1], Mark::Dashes, |rate| {
            rate.low
        }),
        line("95 % interval, high", SERIES[2], Mark::Dashes, |rate| {
            rate.high
        }),
    ];
    LineChart {
        title: "Success against the number of particles".to_owned(),
        x_name: "log10 of the number of particles".to_owned(),
        panels: vec![Panel {
            y_name: "success [%]".to_owned(),
            series: if rates.is_empty() { Vec::new() } else { series },
            from_zero: true,
            ..Panel::default()
        }],
        marks: rates
            .iter()
            .map(|(count, _)| (place(*count), count.to_string()))
            .collect(),
    }
}

fn filled(panels: impl Iterator<Item = Panel>) -> Vec<Panel> {
    panels.filter(|panel| !panel.series.is_empty()).collect()
}
