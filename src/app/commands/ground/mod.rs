//! `ground`: ground segmentation of a recording, with scores if there are labels.
//!
//! Into `output_folder` go
//!
//! ```text
//! labels/000000.label    SemanticKITTI classes: 40 (road) for ground, 99 (other object) else
//! points/000000.ply      the points coloured by confidence: red is ground, blue is not
//! scan_000000.png        a scan from above, errors highlighted
//! memberships.png        the membership functions of the fuzzy rules
//! effective_ground.yml   the effective configuration
//! ground.json            the table on standard output; written last
//! ```

mod input;
pub mod simulated;

use std::fmt::Write as _;
use std::path::Path;

use anyhow::{Context as _, Result, bail, ensure};

pub use self::input::GroundArgs;
use self::input::LabelledScan;
use crate::app::report::ground::{self, GroundReport};
use crate::app::report::plotting::color::Colormap;
use crate::app::run::{Claims, Context, Outputs, Printed, output};
use crate::app::settings::{CommandConfig as _, GroundCommandConfig};
use crate::evaluation::{GroundTally, LabelledPoints};
use crate::files::folder_of;
use crate::geometry::Vec3;
use crate::ground::{FuzzyGround, GroundMethod};
use crate::map::files::ply;
use crate::recording::velodyne;

/// SemanticKITTI class of ground in written labels.
const GROUND_CLASS: u16 = 40;
/// SemanticKITTI class of all other points.
const OTHER_CLASS: u16 = 99;

/// Segments scans, explains a point, or compares the methods on simulated scenes; returns what to
/// print.
pub fn run(args: &GroundArgs, context: &Context) -> Result<Printed> {
    let (config, path) = input::load(args)?;
    if args.simulated {
        return simulated::run(&config, context);
    }
    let path_of_config = args.config.as_deref().or(args.input.as_deref());
    let context = &context.with_config_file(path_of_config, GroundCommandConfig::PATH);
    match args.explain.as_deref() {
        Some(&[x, y, z]) => Ok(Printed::text(explain(&config, &path, Vec3::new(x, y, z))?)),
        _ => {
            let report = segment(&config, &path, context)?;
            Printed::text(report.to_text()).with_json(&report)
        }
    }
}

/// Explains the confidence of the point nearest to a position.
fn explain(config: &GroundCommandConfig, path: &Path, position: Vec3) -> Result<String> {
    ensure!(
        config.ground.method == GroundMethod::Fuzzy,
        "--explain needs fuzzy rules; set ground_method to fuzzy"
    );
    let scans = input::scans(path, config)?;
    let [scan] = scans.as_slice() else {
        bail!(
            "--explain needs one scan, but {} has {}; give the path of one (.bin, .pcd, .ply, .npy), or select one with --set start_idx=N --set n_scans=1",
            path.display(),
            scans.len()
        );
    };
    let scan = scan.read()?;
    let distance_m = |&index: &usize| scan.points[index].distance(position);
    let index = (0..scan.points.len())
        .filter(|&index| scan.points[index].is_finite())
        .min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)))
        .with_context(|| format!("{} has no finite point to explain", path.display()))?;
    let Vec3 { x, y, z } = scan.points[index];
    let distance_m = distance_m(&index);
    let mut text =
        format!("point {index} at {x:.3} {y:.3} {z:.3} m, at a distance of {distance_m:.3} m\n");
    if let Some(classes) = &scan.classes {
        writeln!(text, "its label is class {}", classes[index])?;
    }
    let classifier = FuzzyGround::new(config.ground.fuzzy.clone())?;
    match classifier.features(&scan.points)[index] {
        Some(features) => writeln!(text, "\n{}", classifier.explain(&features))?,
        None => writeln!(
            text,
            "its confidence is 0 because it is out of range, or on the own car: nearer than fuzzy.features.min_distance_m = {} m",
            config.ground.fuzzy.features.min_distance_m
        )?,
    }
    Ok(text)
}

/// Segments the scan at a path or all selected scans of a recording, and writes the results.
fn segment(config: &GroundCommandConfig, path: &Path, context: &Context) -> Result<GroundReport> {
    let scans = input::scans(path, config)?;
    let report_file = config.output_folder.join("ground.json");
    input::check_overwrite(config, &scans)?;
    let mut claims = prepare(config, context, &scans, &report_file)?;
    ground::draw_memberships(
        &config.ground.fuzzy,
        &config.output_folder.join("memberships.png"),
    )?;

    let mut methods = config.ground.all_classifiers()?;
    if !(config.compare && scans.iter().any(|scan| scan.label_path.is_some())) {
        methods.truncate(1);
    }
    let mut tallies = vec![GroundTally::default(); methods.len()];
    let (mut labelled_scans, mut points) = (0, 0);
    let task = context.progress.task("ground", scans.len());
    for (position, files) in scans.iter().enumerate() {
        context.interrupt.keeps(format!(
            "{position} of {} scans are in {}; run again with --force for all of them",
            scans.len(),
            config.output_folder.display()
        ));
        context.interrupt.check()?;
        let scan = files.read()?;
        points += scan.points.len();
        labelled_scans += usize::from(scan.classes.is_some());
        let confidences: Vec<Vec<f32>> = std::iter::zip(&methods, &mut tallies)
            .map(|((_, classifier), tally)| {
                tally.classify(classifier.as_ref(), &scan, config.ground_threshold)
            })
            .collect();
        write_scan(config, &files.name, &scan, &confidences[0])?;
        if config.plot_step > 0 && position % config.plot_step == 0 {
            let found = (confidences[0].as_slice(), config.ground_threshold);
            ground::draw_scan(&config.output_folder, &files.name, &scan, found)?;
        }
        task.advance(1);
    }
    let report = GroundReport {
        scans_from: path.into(),
        scans: scans.len(),
        labelled_scans,
        points,
        threads: context.threads,
        methods: std::iter::zip(&methods, &tallies)
            .map(|((name, _), tally)| tally.report(name))
            .collect(),
    };
    claims.begin(&report_file)?;
    output::write_yaml(&config.output_folder.join("effective_ground.yml"), config)?;
    output::write_json(&report_file, &report)?;
    claims.finish(&report_file)?;
    Ok(report)
}

/// Prepares the outputs and the folders of those of single scans.
fn prepare(
    config: &GroundCommandConfig,
    context: &Context,
    scans: &[LabelledScan],
    report_file: &Path,
) -> Result<Claims> {
    let mut names = vec![
        "effective_ground.yml".to_owned(),
        "memberships.png".to_owned(),
    ];
    names.extend(config.write_labels.then(|| "labels".to_owned()));
    names.extend(config.write_plys.then(|| "points".to_owned()));
    if config.plot_step > 0 {
        let drawn = scans.iter().step_by(config.plot_step);
        names.extend(drawn.map(|scan| ground::file_name(&scan.name)));
    }
    let outputs = Outputs {
        key: "output_folder",
        main: report_file,
        magic: None,
        names,
        inputs: context.input().into_iter().collect(),
        force: config.output.force,
    };
    let claims = outputs.prepare()?;
    for (folder, is_written) in [
        ("labels", config.write_labels),
        ("points", config.write_plys),
    ] {
        for scan in scans.iter().filter(|_| is_written) {
            let path = config.output_folder.join(folder).join(&scan.name);
            output::create_folder(folder_of(&path))?;
        }
    }
    Ok(claims)
}

/// Writes labels and coloured points of a scan, as configured.
fn write_scan(
    config: &GroundCommandConfig,
    name: &Path,
    scan: &LabelledPoints,
    confidences: &[f32],
) -> Result<()> {
    let output_path = |folder: &str, extension: &str| {
        let path = config.output_folder.join(folder).join(name);
        path.with_extension(extension)
    };
    if config.write_labels {
        let class = |&confidence: &f32| {
            let is_ground = confidence > config.ground_threshold;
            if is_ground { GROUND_CLASS } else { OTHER_CLASS }
        };
        let classes: Vec<u16> = confidences.iter().map(class).collect();
        let path = output_path("labels", "label");
        output::write_file(&path, |file| velodyne::write_labels(file, &classes))?;
    }
    if config.write_plys {
        let colors = Colormap::Diverging.colors(confidences);
        let path = output_path("points", "ply");
        ply::write_points(&path, &scan.points, &colors, confidences)?;
    }
    Ok(())
}
