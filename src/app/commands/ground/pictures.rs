//! Membership functions, and scans from above.

use std::path::Path;

use anyhow::Result;

use crate::app::report::plotting::color::SERIES;
use crate::app::report::plotting::{GroundPlot, LineChart, Panel, Series};
use crate::app::settings::GroundCommandConfig;
use crate::evaluation::{GroundProtocol, LabelledPoints};
use crate::ground::{Features, FuzzyConfig};

/// Samples of a membership function.
const SAMPLES: u16 = 401;
/// Distances ahead and to the sides up to which a scan is drawn [m].
const REACH_M: (f64, f64) = (50.0, 35.0);

/// Draws the membership functions of all fuzzy sets, one panel per linguistic variable.
pub fn draw_memberships(config: &FuzzyConfig, path: &Path) -> Result<()> {
    let mut panels = Vec::new();
    for (variable, sets) in &config.variables {
        let (from, to) = config.chart_range(variable);
        let series = sets.iter().zip(SERIES.iter().cycle());
        let series = series.map(|((set, function), &color)| {
            let sample = |sample| {
                let x = from + f32::from(sample) / f32::from(SAMPLES - 1) * (to - from);
                (x.into(), function.degree(x).into())
            };
            Series::line(set, color, (0..SAMPLES).map(sample))
        });
        panels.push(Panel {
            y_name: "membership".to_owned(),
            own_x_name: Some(name_with_unit(variable)),
            series: series.collect(),
            ..Panel::default()
        });
    }
    let chart = LineChart {
        title: "Membership functions".to_owned(),
        panels,
        ..LineChart::default()
    };
    chart.save(path)
}

/// `height_variance` becomes `height variance [m]`; the output has no unit.
fn name_with_unit(variable: &str) -> String {
    let words = variable.replace('_', " ");
    let mut units = Features::NAMES.iter().zip(Features::UNITS);
    match units.find(|(name, _)| **name == variable) {
        Some((_, unit)) => format!("{words} [{unit}]"),
        None => words,
    }
}

/// Name of the picture of a scan.
pub fn file_name(name: &Path) -> String {
    format!("scan_{}.png", name.display()).replace(['/', '\\'], "_")
}

/// Draws a scan from above.
pub fn draw_scan(
    config: &GroundCommandConfig,
    name: &Path,
    scan: &LabelledPoints,
    confidences: &[f32],
) -> Result<()> {
    let threshold = config.ground_threshold;
    let protocol = GroundProtocol::PatchworkPlusPlus;
    let truth = scan.truth(protocol);
    let mut title = format!("Ground of scan {}", name.display());
    if !truth.is_empty() {
        let f1 = scan.score(protocol, confidences, threshold, |_| true).f1();
        title += &format!(", F1 {:.2} %", 100.0 * f1);
    }
    let plot = GroundPlot {
        title: &title,
        points: &scan.points,
        called_ground: &confidences
            .iter()
            .map(|&c| c > threshold)
            .collect::<Vec<_>>(),
        truth: &truth,
        reach_m: REACH_M,
    };
    plot.save(&config.output_folder.join(file_name(name)))
}
