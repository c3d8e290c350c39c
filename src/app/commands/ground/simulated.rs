//! The slope table: all methods on simulated scenes, whose truth is exact.

use std::fmt::Write as _;

use anyhow::Result;
use rayon::prelude::*;

use super::input::LabelledPoints;
use super::methods::{self, Method, score};
use crate::app::commands::Context;
use crate::app::commands::interrupt::Interrupted;
use crate::app::config::GroundCommandConfig;
use crate::ground::{GroundScore, Protocol};
use crate::simulation::{
    LabelledScan, ScannerConfig, Simulation, SimulationConfig, crest_scene, kerb_scene, slope_scene,
};

/// Streets that every scene is seen in.
const SEEDS: [u64; 3] = [1, 2, 3];
/// Every how manieth scan of a drive is judged.
const DRIVE_STEP: usize = 20;
/// What of a scene lies on or behind its slope or crest: points farther ahead than this [m].
const AHEAD_M: f32 = 8.0;

/// A row of the table.
struct Scene {
    name: String,
    scans: Box<dyn Fn() -> Result<Vec<LabelledScan>> + Sync>,
}

/// The table for standard output.
pub fn run(config: &GroundCommandConfig, context: &Context) -> Result<String> {
    let methods = methods::all(config)?;
    let scenes = scenes();
    let task = context.progress.task("ground", scenes.len());
    let mut whole = String::new();
    let mut ahead = String::new();
    for scene in &scenes {
        if context.interrupt.requested() {
            let kept = "nothing is written by --simulated".to_owned();
            return Err(Interrupted { kept }.into());
        }
        let scans: Vec<LabelledPoints> = (scene.scans)()?.into_iter().map(labelled).collect();
        let scores = scores(&methods, &scans, config.ground_threshold);
        for (table, part) in [(&mut whole, 0), (&mut ahead, 1)] {
            let row: String = scores
                .iter()
                .map(|parts| format!(" {:>21.2}", 100.0 * parts[part].f1()))
                .collect();
            writeln!(table, "{:<24}{row}", scene.name)?;
        }
        task.advance(1);
    }
    let header = header(&methods);
    Ok(format!(
        "F1 [%] on simulated streets, protocol of Patchwork++, {} seeds\n\n\
         whole scans\n{header}{whole}\npoints more than {AHEAD_M} m ahead\n{header}{ahead}",
        SEEDS.len()
    ))
}

fn header(methods: &[Method]) -> String {
    let names: String = methods
        .iter()
        .map(|method| format!(" {:>21}", method.name))
        .collect();
    format!("{:<24}{names}\n", "scene")
}

/// Per method the score of whole scans, and that of what lies ahead.
fn scores(methods: &[Method], scans: &[LabelledPoints], threshold: f32) -> Vec<[GroundScore; 2]> {
    let protocol = Protocol::PatchworkPlusPlus;
    methods
        .iter()
        .map(|method| {
            let mut parts = [GroundScore::default(); 2];
            for scan in scans {
                let confidences = method.classifier.ground_confidence(&scan.points);
                parts[0].merge(&score(scan, &confidences, threshold, protocol));
                let (scan, confidences) = ahead(scan, &confidences);
                parts[1].merge(&score(&scan, &confidences, threshold, protocol));
            }
            parts
        })
        .collect()
}

/// The points ahead with their confidences.
fn ahead(scan: &LabelledPoints, confidences: &[f32]) -> (LabelledPoints, Vec<f32>) {
    let kept: Vec<usize> = (0..scan.points.len())
        .filter(|&index| scan.points[index].x > AHEAD_M)
        .collect();
    let classes = scan.classes.as_ref();
    let part = LabelledPoints {
        points: kept.iter().map(|&index| scan.points[index]).collect(),
        classes: classes.map(|classes| kept.iter().map(|&index| classes[index]).collect()),
    };
    (part, kept.iter().map(|&index| confidences[index]).collect())
}

fn labelled(scan: LabelledScan) -> LabelledPoints {
    LabelledPoints {
        points: scan.scan.points,
        classes: Some(scan.classes),
    }
}

fn scenes() -> Vec<Scene> {
    let percent = |share: f64| (100.0 * share).round();
    let mut scenes: Vec<Scene> = Vec::new();
    for grade in [0.0, 0.05, 0.10, 0.15, -0.10] {
        scenes.push(of_seeds(
            format!("slope {} %", percent(grade)),
            move |seed| slope_scene(grade, &ScannerConfig::default(), seed),
        ));
    }
    for grade in [0.05, 0.10, 0.15] {
        scenes.push(of_seeds(
            format!("crest {} %", percent(grade)),
            move |seed| crest_scene(grade, &ScannerConfig::default(), seed),
        ));
    }
    for height_m in [0.05, 0.12, 0.20] {
        scenes.push(of_seeds(format!("kerb {height_m:.2} m"), move |seed| {
            kerb_scene(height_m, &ScannerConfig::default(), seed)
        }));
    }
    for beams in [64, 32] {
        let scans = move || {
            let mut scans = Vec::new();
            for seed in SEEDS {
                scans.extend(drive(seed, beams)?);
            }
            Ok(scans)
        };
        scenes.push(Scene {
            name: format!("drive, {beams} beams"),
            scans: Box::new(scans),
        });
    }
    scenes
}

fn of_seeds(name: String, scan: impl Fn(u64) -> LabelledScan + Sync + 'static) -> Scene {
    let scans = move || Ok(SEEDS.into_par_iter().map(&scan).collect());
    Scene {
        name,
        scans: Box::new(scans),
    }
}

/// Scans of a drive through the whole simulated street, with its slope, crest, square and traffic.
fn drive(seed: u64, beams: usize) -> Result<Vec<LabelledScan>> {
    let config = SimulationConfig {
        seed,
        scanner: ScannerConfig {
            beams,
            ..ScannerConfig::default()
        },
        ..SimulationConfig::default()
    };
    let simulation = Simulation::new(&config, None)?;
    let frames: Vec<usize> = (0..simulation.frames()).step_by(DRIVE_STEP).collect();
    Ok(frames
        .into_par_iter()
        .map(|frame| simulation.scan(frame))
        .collect())
}
