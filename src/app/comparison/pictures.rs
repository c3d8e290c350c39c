//! Plots of a comparison, each as an element of its page.

use anyhow::Result;

use super::layout::Layout;
use super::record::RunRecord;
use super::results::{ComparisonResults, success_rate};
use super::table::SuccessRate;
use crate::app::report::LocalizationResults;
use crate::app::report::pages::PageElement;
use crate::app::report::plotting::color::{Rgb, SERIES};
use crate::app::report::plotting::{LineChart, Mark, Panel, PathPlot, Series, error_chart};
use crate::app::report::results::with_gaps;
use crate::app::report::run_output::time_axis;
use crate::app::report::run_page::picture;
use crate::app::run::output;
use crate::evaluation::planar_errors;
use crate::geometry::Pose2;

/// Error of every run over its seed; `None` without runs.
pub fn errors_of_runs(results: &ComparisonResults, layout: &Layout) -> Result<Option<PageElement>> {
    let panels = results.sequences.iter().map(|sequence| {
        let names = results.config.configurations.iter().map(|it| &it.name);
        let series = names.enumerate().map(|(index, name)| {
            // Equal errors of different configurations lie side by side.
            let count = results.config.configurations.len();
            let offset = 0.05 * (index as f64 - 0.5 * (count - 1) as f64);
            let runs = results.runs(sequence, name).into_iter();
            let points = runs.filter_map(|run| {
                Some((run.id.seed as f64 + offset, run.metrics()?.position_m.mean))
            });
            Series {
                name: name.clone(),
                color: color(index),
                mark: Mark::Dots,
                points: points.collect(),
            }
        });
        Panel {
            y_name: format!("{sequence}: error [m]"),
            series: series.filter(|series| !series.points.is_empty()).collect(),
            ..Panel::default()
        }
    });
    let chart = LineChart {
        title: "Average positional error of every run".to_owned(),
        x_name: "seed".to_owned(),
        is_x_whole: true,
        panels: panels.filter(|panel| !panel.series.is_empty()).collect(),
        ..LineChart::default()
    };
    let caption = "Average positional error of every run over its seed";
    save_chart("runs.png", caption, &chart, layout)
}

/// Success rate against the number of particles; `None` without a particle sweep.
pub fn success_rates(results: &ComparisonResults, layout: &Layout) -> Result<Option<PageElement>> {
    let rates = results.sweep.iter().filter_map(|(count, records)| {
        let runs: Vec<&RunRecord> = records.iter().collect();
        Some((*count, success_rate(&runs)?))
    });
    let rates: Vec<(usize, SuccessRate)> = rates.collect();
    let x = |count: usize| (count as f64).log10();
    let line = |name: &str, mark, value: fn(&SuccessRate) -> f64| {
        let points = rates.iter().map(|(n, rate)| (x(*n), 100.0 * value(rate)));
        Series {
            mark,
            ..Series::line(name, color(0), points)
        }
    };
    let panel = Panel {
        y_name: "success [%]".to_owned(),
        series: vec![
            line("success", Mark::Line, |rate| rate.rate),
            line("95 % interval", Mark::Dashes, |rate| rate.low),
            line("", Mark::Dashes, |rate| rate.high),
        ],
        ..Panel::default()
    };
    let chart = LineChart {
        title: "Success against the number of particles".to_owned(),
        x_name: "log10 of the number of particles".to_owned(),
        panels: if rates.is_empty() {
            vec![]
        } else {
            vec![panel]
        },
        marks: rates.iter().map(|(n, _)| (x(*n), n.to_string())).collect(),
        ..LineChart::default()
    };
    let caption = "Success rate against the number of particles, dashed: 95 % interval (Wilson)";
    save_chart("success.png", caption, &chart, layout)
}

/// Trajectories and errors of all configurations in a sequence, from the first seed whose result
/// file is present; empty without result files.
pub fn trajectories(
    results: &ComparisonResults,
    sequence: &str,
    layout: &Layout,
) -> Result<Vec<PageElement>> {
    let trajectories = read_trajectories(results, sequence, layout);
    let Some(first) = trajectories.first() else {
        return Ok(Vec::new());
    };
    let seeds = trajectories
        .iter()
        .map(|it| format!("{} seed {}", it.name, it.seed));
    let seeds = seeds.collect::<Vec<String>>().join(", ");
    let paths = trajectories
        .iter()
        .map(|it| (it.name.as_str(), it.color, it.path.as_slice()));
    let plot = plot_path(&format!("paths_{sequence}.png"), layout)?;
    PathPlot {
        title: &format!("{sequence}: paths against ground truth"),
        ground_truth: Some(&first.truth),
        paths: &paths.collect::<Vec<_>>(),
        numbers: None,
        map: None,
    }
    .save(&plot)?;
    let paths = picture(&plot, &format!("Paths of all configurations ({seeds})"))?;
    let errors = trajectories.iter().map(|it| {
        let errors = it
            .time
            .iter()
            .copied()
            .zip(planar_errors(&it.poses, &it.truth));
        (it.name.as_str(), it.color, errors)
    });
    let title = format!("{sequence}: errors over time");
    let errors = save_chart(
        &format!("errors_{sequence}.png"),
        &format!("Position and heading error over time ({seeds})"),
        &error_chart(&title, first.time_name, errors),
        layout,
    )?;
    Ok([paths, errors].into_iter().flatten().collect())
}

/// Final trajectory of one run of a configuration.
struct Trajectory {
    name: String,
    color: Rgb,
    seed: u64,
    /// Horizontal axis of charts.
    time_name: &'static str,
    time: Vec<f64>,
    poses: Vec<Pose2>,
    /// The same with gaps where they are not trusted.
    path: Vec<Pose2>,
    truth: Vec<Pose2>,
}

fn read_trajectories(
    results: &ComparisonResults,
    sequence: &str,
    layout: &Layout,
) -> Vec<Trajectory> {
    let configurations = results.config.configurations.iter().enumerate();
    let of_configuration = configurations.filter_map(|(index, configuration)| {
        let mut runs = results.runs(sequence, &configuration.name);
        runs.retain(|run| run.metrics().is_some());
        runs.sort_by_key(|run| run.id.seed);
        let mut found = runs.into_iter();
        found.find_map(|run| read_trajectory(run, color(index), layout))
    });
    of_configuration.collect()
}

/// `None` if the result file of a run is missing or not readable.
fn read_trajectory(record: &RunRecord, color: Rgb, layout: &Layout) -> Option<Trajectory> {
    let path = layout.run(&record.id).join("localization.npz");
    if !path.exists() {
        return None;
    }
    let results = LocalizationResults::read(&path)
        .inspect_err(|error| tracing::warn!("{} is not plotted: {error:#}", record.id))
        .ok()?;
    let (time_name, time) = time_axis(&results);
    Some(Trajectory {
        name: record.id.configuration.clone(),
        color,
        seed: record.id.seed,
        time_name,
        time,
        path: match (&results.refined, &results.estimates) {
            (Some(refined), _) => with_gaps(refined, &results.refined_trusted()),
            (None, estimates) => with_gaps(
                &results.trajectory(estimates.as_deref()?),
                &results.trusted(),
            ),
        },
        poses: results.refined.or(results.estimates)?.to_vec(),
        truth: results.ground_truth?.to_vec(),
    })
}

/// Saves a chart unless it has no panels.
fn save_chart(
    name: &str,
    caption: &str,
    chart: &LineChart,
    layout: &Layout,
) -> Result<Option<PageElement>> {
    if chart.panels.is_empty() {
        return Ok(None);
    }
    let path = plot_path(name, layout)?;
    chart.save(&path)?;
    picture(&path, caption)
}

/// Path of a plot, whose folder is created.
fn plot_path(name: &str, layout: &Layout) -> Result<std::path::PathBuf> {
    let folder = layout.root.join("plots");
    output::create_subfolder(&folder)?;
    Ok(folder.join(name))
}

/// Color of a configuration.
fn color(index: usize) -> Rgb {
    SERIES[index % SERIES.len()]
}
