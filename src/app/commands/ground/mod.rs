//! `ground`: which points are road, and why.
//!
//! Into `output_folder` go
//!
//! ```text
//! labels/000000.label    SemanticKITTI classes: 40 (road) for ground, 99 (other object) else
//! points/000000.ply      the points coloured by confidence: red is ground, blue is not
//! scan_000000.png        a scan from above, its errors highlighted
//! memberships.png        the sets of the fuzzy rules
//! ground.yml             the effective configuration
//! ground.json            the table on standard output; written last
//! ```

mod input;
mod methods;
mod pictures;
mod simulated;

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use serde::Serialize;

use self::input::{LabelledPoints, Source};
use self::methods::{Method, MethodReport, Tally, tally_table};
use super::interrupt::Interrupted;
use super::{Context, output};
use crate::app::cli::GroundArgs;
use crate::app::config::{self, GroundCommandConfig};
use crate::app::plotting::color::Colormap;
use crate::geometry::Vec3;
use crate::ground::{FuzzyGround, GroundMethod};
use crate::map::ply;
use crate::recording::velodyne;

/// Class of ground in written labels.
const GROUND_CLASS: u16 = 40;
/// Class of everything else.
const REST_CLASS: u16 = 99;

/// `ground.json`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct GroundReport {
    /// Folder of the scans, or the scan.
    pub scans_from: PathBuf,
    /// Scans that were judged.
    pub scans: usize,
    /// Of them with labels.
    pub labelled_scans: usize,
    /// Points of all scans.
    pub points: usize,
    /// Threads that shared the work.
    pub threads: usize,
    /// What the chosen method did, then the others.
    pub methods: Vec<MethodReport>,
}

/// Judges scans, or explains a point, or compares on simulated scenes; the text for standard output.
pub fn run(args: &GroundArgs, context: &Context) -> Result<String> {
    let (config, source) = input::load(args)?;
    if args.simulated {
        return simulated::run(&config, context);
    }
    match args.explain.as_deref() {
        Some(&[x, y, z]) => explain(&config, &source, Vec3::new(x, y, z)),
        _ => Ok(judge(&config, &source, context)?.to_text()),
    }
}

/// Why the point nearest to a position has its confidence.
fn explain(config: &GroundCommandConfig, source: &Source, position: Vec3) -> Result<String> {
    let scan_file = match source {
        Source::Scan(path) => path,
        Source::Folder(folder) => anyhow::bail!(
            "--explain needs one scan, but {} is a folder; give the path of one of its .bin files",
            folder.display()
        ),
    };
    ensure!(
        config.ground_method == GroundMethod::Fuzzy,
        "--explain shows fuzzy rules, but ground_method is another; leave it at fuzzy"
    );
    let points = velodyne::read_scan(scan_file)?.points;
    let squared_gap = |point: &Vec3| point.distance_squared(position);
    let nearest = (0..points.len())
        .filter(|&index| points[index].is_finite())
        .min_by(|&a, &b| squared_gap(&points[a]).total_cmp(&squared_gap(&points[b])));
    let Some(index) = nearest else {
        anyhow::bail!("{} has no finite point to explain", scan_file.display());
    };
    let classifier = fuzzy(config)?;
    let point = points[index];
    let mut text = format!(
        "point {index} at {:.3} {:.3} {:.3} m, {:.3} m from there\n",
        point.x,
        point.y,
        point.z,
        point.distance(position)
    );
    let classes = input::labels_of(scan_file, config.label_folder.as_deref(), None)?;
    if let Some(class) = classes.iter().flatten().nth(index) {
        writeln!(text, "its label is class {class}")?;
    }
    match classifier.features(&points)[index] {
        Some(features) => writeln!(text, "\n{}", classifier.explain(&features))?,
        None => writeln!(
            text,
            "not judged: it is on the own car, nearer than fuzzy.features.min_distance_m = {} m, or too far away; its confidence is 0",
            config.fuzzy.features.min_distance_m
        )?,
    }
    Ok(text)
}

/// Judges all scans of a source.
fn judge(config: &GroundCommandConfig, source: &Source, context: &Context) -> Result<GroundReport> {
    let scans = source.scans(config)?;
    let report_file = config.output_folder.join("ground.json");
    output::prepare(&report_file, "output_folder", config.force)?;
    input::keep_truth_safe(config, source)?;
    let mut methods = methods::all(config)?;
    let any_labels = scans.iter().any(|scan| scan.label_path.is_some());
    if !(config.compare && any_labels) {
        methods.truncate(1);
    }
    pictures::draw_memberships(
        &fuzzy(config)?,
        &config.output_folder.join("memberships.png"),
    )?;

    let mut tallies = vec![Tally::default(); methods.len()];
    let (mut labelled_scans, mut points) = (0, 0);
    let task = context.progress.task("ground", scans.len());
    for (position, scan) in scans.iter().enumerate() {
        if context.interrupt.requested() {
            let kept = format!(
                "{position} of {} scans are in {}; run again with --force for all of them",
                scans.len(),
                config.output_folder.display()
            );
            return Err(Interrupted { kept }.into());
        }
        let labelled = scan.read()?;
        points += labelled.points.len();
        labelled_scans += usize::from(labelled.classes.is_some());
        let chosen = judge_scan(&methods, &mut tallies, &labelled, config.ground_threshold);
        write_scan(config, &scan.name, &labelled, &chosen)?;
        if config.plot_step > 0 && position % config.plot_step == 0 {
            pictures::draw_scan(config, &scan.name, &labelled, &chosen)?;
        }
        task.advance(1);
    }
    let report = GroundReport {
        scans_from: source.path().to_owned(),
        scans: scans.len(),
        labelled_scans,
        points,
        threads: context.threads,
        methods: methods
            .iter()
            .zip(&tallies)
            .map(|(method, tally)| tally.report(method.name, labelled_scans > 0))
            .collect(),
    };
    config::write(&config.output_folder.join("ground.yml"), config)?;
    output::write_json(&report_file, &report)?;
    Ok(report)
}

/// The confidences of the first method; all methods are tallied.
fn judge_scan(
    methods: &[Method],
    tallies: &mut [Tally],
    scan: &LabelledPoints,
    threshold: f32,
) -> Vec<f32> {
    let mut chosen = Vec::new();
    for (index, (method, tally)) in methods.iter().zip(tallies).enumerate() {
        let confidences = tally.judge(method.classifier.as_ref(), scan, threshold);
        if index == 0 {
            chosen = confidences;
        }
    }
    chosen
}

/// Writes what is to be written of a scan.
fn write_scan(
    config: &GroundCommandConfig,
    name: &Path,
    scan: &LabelledPoints,
    confidences: &[f32],
) -> Result<()> {
    if config.write_labels {
        let classes: Vec<u16> = confidences
            .iter()
            .map(|&confidence| {
                if confidence > config.ground_threshold {
                    GROUND_CLASS
                } else {
                    REST_CLASS
                }
            })
            .collect();
        let path = output_path(config, "labels", name, "label")?;
        output::write_file(&path, |file| velodyne::write_labels(file, &classes))?;
    }
    if config.write_plys {
        let colors: Vec<[u8; 3]> = confidences
            .iter()
            .map(|&confidence| Colormap::Diverging.at(f64::from(confidence)))
            .collect();
        let path = output_path(config, "points", name, "ply")?;
        output::replace(&path, |part| {
            Ok(ply::write_points(part, &scan.points, &colors, confidences)?)
        })?;
    }
    Ok(())
}

/// A file of a scan in the output folder; its folder is made.
fn output_path(
    config: &GroundCommandConfig,
    kind: &str,
    name: &Path,
    extension: &str,
) -> Result<PathBuf> {
    let path = config
        .output_folder
        .join(kind)
        .join(name)
        .with_extension(extension);
    let folder = path.parent().unwrap_or(&path);
    fs::create_dir_all(folder).with_context(|| format!("cannot create {}", folder.display()))?;
    Ok(path)
}

fn fuzzy(config: &GroundCommandConfig) -> Result<FuzzyGround> {
    FuzzyGround::new(config.fuzzy.clone()).context("fuzzy: the rules of the ground")
}

impl GroundReport {
    /// The table for people.
    pub fn to_text(&self) -> String {
        let mut text = format!(
            "{} scans of {}, {} with labels, {} points, {} {}\n",
            self.scans,
            self.scans_from.display(),
            self.labelled_scans,
            self.points,
            self.threads,
            if self.threads == 1 {
                "thread"
            } else {
                "threads"
            }
        );
        text.push_str(&tally_table(&self.methods));
        text
    }
}
