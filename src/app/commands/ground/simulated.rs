//! `ground --simulated`: all methods on simulated scenes, whose truth is exact.

use anyhow::Result;
use rayon::prelude::*;

use crate::app::run::Context;
use crate::app::run::interrupt::Interrupted;
use crate::app::settings::GroundCommandConfig;
use crate::evaluation::{GroundProtocol, GroundScore, LabelledPoints};
use crate::simulation::{
    LabelledScan, ScannerConfig, Simulation, SimulationConfig, crest_scene, kerb_scene, slope_scene,
};

/// Seeds of the streets of every scene.
const SEEDS: [u64; 3] = [1, 2, 3];
/// Every n-th scan of a drive is used.
const DRIVE_STEP: usize = 20;
/// Points farther ahead lie on or behind the slope or crest of a scene [m].
const AHEAD_M: f32 = 8.0;

/// A row of the table: a name, and the scans of a seed.
type TableRow = (String, Box<dyn Fn(u64) -> Result<Vec<LabelledScan>> + Sync>);

/// Returns the table for standard output.
pub fn run(config: &GroundCommandConfig, context: &Context) -> Result<String> {
    let methods = config.ground().all_classifiers()?;
    let scenes = scenes();
    let task = context.progress.task("ground", scenes.len());
    let columns: String = methods
        .iter()
        .map(|(name, _)| format!(" {name:>21}"))
        .collect();
    let header = format!("{:<24}{columns}\n", "scene");
    let mut tables = [header.clone(), header];
    for (name, scans_of) in scenes {
        if context.interrupt.requested() {
            let kept = "nothing is written by --simulated".to_owned();
            return Err(Interrupted { kept }.into());
        }
        let scans = SEEDS.into_par_iter().map(&*scans_of);
        let scans: Vec<LabelledPoints> = scans
            .collect::<Result<Vec<_>>>()?
            .into_iter()
            .flatten()
            .map(|scan| LabelledPoints {
                points: scan.scan.points,
                classes: Some(scan.classes),
            })
            .collect();
        tables
            .iter_mut()
            .for_each(|table| *table += &format!("{name:<24}"));
        for (_, classifier) in &methods {
            let mut scores = [GroundScore::default(); 2];
            for scan in &scans {
                let confidences = classifier.ground_confidence(&scan.points);
                for (score, min_x_m) in scores.iter_mut().zip([f32::NEG_INFINITY, AHEAD_M]) {
                    score.merge(&scan.score(
                        GroundProtocol::PatchworkPlusPlus,
                        &confidences,
                        config.ground_threshold,
                        |point| point.x > min_x_m,
                    ));
                }
            }
            for (table, score) in tables.iter_mut().zip(scores) {
                *table += &format!(" {:>21.2}", 100.0 * score.f1());
            }
        }
        tables.iter_mut().for_each(|table| table.push('\n'));
        task.advance(1);
    }
    let [whole, ahead] = tables;
    Ok(format!(
        "F1 [%] on simulated streets, protocol of Patchwork++, {} seeds\n\n\
         whole scans\n{whole}\npoints more than {AHEAD_M} m ahead\n{ahead}",
        SEEDS.len()
    ))
}

fn scenes() -> Vec<TableRow> {
    let percent = |grade: f64| (100.0 * grade).round();
    let mut scenes: Vec<TableRow> = Vec::new();
    for grade in [0.0, 0.05, 0.10, 0.15, -0.10] {
        let name = format!("slope {} %", percent(grade));
        scenes.push(one_scan(name, move |scanner, seed| {
            slope_scene(grade, scanner, seed)
        }));
    }
    for grade in [0.05, 0.10, 0.15] {
        let name = format!("crest {} %", percent(grade));
        scenes.push(one_scan(name, move |scanner, seed| {
            crest_scene(grade, scanner, seed)
        }));
    }
    for height_m in [0.05, 0.12, 0.20] {
        let name = format!("kerb {height_m:.2} m");
        scenes.push(one_scan(name, move |scanner, seed| {
            kerb_scene(height_m, scanner, seed)
        }));
    }
    for beams in [64, 32] {
        let scans = move |seed| drive(seed, beams);
        scenes.push((format!("drive, {beams} beams"), Box::new(scans)));
    }
    scenes
}

fn one_scan(
    name: String,
    scan: impl Fn(&ScannerConfig, u64) -> LabelledScan + Sync + 'static,
) -> TableRow {
    let scans = move |seed| Ok(vec![scan(&ScannerConfig::default(), seed)]);
    (name, Box::new(scans))
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
    let frames = (0..simulation.frames()).into_par_iter().step_by(DRIVE_STEP);
    Ok(frames.map(|frame| simulation.scan(frame)).collect())
}
