//! The sets of the rules, and scans from above.

use std::path::Path;

use anyhow::Result;

use super::input::LabelledPoints;
use super::methods::score;
use crate::app::config::GroundCommandConfig;
use crate::app::plotting::color::SERIES;
use crate::app::plotting::{GroundPlot, LineChart, Panel, Series};
use crate::ground::{Features, FuzzyGround, Protocol};

/// Samples of a membership function.
const SAMPLES: usize = 401;
/// How far a picture reaches ahead and to the sides [m].
const REACH_M: (f64, f64) = (50.0, 35.0);

/// Draws all membership functions, a panel per variable.
pub fn draw_memberships(classifier: &FuzzyGround, path: &Path) -> Result<()> {
    let mut panels: Vec<Panel> = Vec::new();
    for curve in classifier.membership_curves(SAMPLES) {
        let x_name = name_with_unit(&curve.variable);
        if panels.last().and_then(|panel| panel.own_x_name.as_ref()) != Some(&x_name) {
            panels.push(Panel {
                y_name: "membership".to_owned(),
                own_x_name: Some(x_name),
                ..Panel::default()
            });
        }
        if let Some(panel) = panels.last_mut() {
            let color = SERIES[panel.series.len() % SERIES.len()];
            let points = curve.points.iter().map(|&(x, y)| (x.into(), y.into()));
            panel.series.push(Series::line(&curve.set, color, points));
        }
    }
    LineChart {
        title: "Linguistic sets".to_owned(),
        panels,
        ..LineChart::default()
    }
    .save(path)?;
    Ok(())
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

/// Draws a scan from above.
pub fn draw_scan(
    config: &GroundCommandConfig,
    name: &Path,
    scan: &LabelledPoints,
    confidences: &[f32],
) -> Result<()> {
    let threshold = config.ground_threshold;
    let called_ground: Vec<bool> = confidences.iter().map(|&c| c > threshold).collect();
    let protocol = Protocol::PatchworkPlusPlus;
    let classes = scan.classes.iter().flatten();
    let truth: Vec<Option<bool>> = scan
        .points
        .iter()
        .zip(classes)
        .map(|(point, &class)| protocol.truth(class, point.z))
        .collect();
    let f1 = score(scan, confidences, threshold, protocol).f1();
    let title = if truth.is_empty() {
        format!("Ground of scan {}", name.display())
    } else {
        format!("Ground of scan {}, F1 {:.2} %", name.display(), 100.0 * f1)
    };
    let file = format!("scan_{}.png", name.display()).replace(['/', '\\'], "_");
    GroundPlot {
        title: &title,
        points: &scan.points,
        called_ground: &called_ground,
        truth: &truth,
        reach_m: REACH_M,
    }
    .save(&config.output_folder.join(file))?;
    Ok(())
}
