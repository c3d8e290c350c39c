//! `ground --simulated`: all methods on simulated scenes, whose truth is exact.

use anyhow::Result;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::Serialize;

use crate::app::run::{Context, Printed};
use crate::app::settings::GroundCommandConfig;
use crate::evaluation::{GroundProtocol, GroundScore, LabelledPoints};
use crate::simulation::ground_scenes;

/// Seeds of the streets of every scene.
const SEEDS: [u64; 3] = [1, 2, 3];

/// Points farther ahead lie on or behind the slope or crest of a scene [m].
const AHEAD_M: f32 = 8.0;

/// Score of a method on a simulated scene.
#[derive(Debug, Serialize, JsonSchema)]
pub struct SceneScore {
    /// Name of the scene.
    scene: String,
    /// Name of the method.
    method: String,
    /// F1 of whole scans by the protocol of Patchwork++, 0 to 1.
    f1: f64,
    /// F1 of the points more than 8 m ahead.
    f1_ahead: f64,
}

/// Scores all methods on all scenes; returns what to print.
pub fn run(config: &GroundCommandConfig, context: &Context) -> Result<Printed> {
    let methods = config.ground.all_classifiers()?;
    let scenes = ground_scenes();
    let task = context.progress.task("ground", scenes.len());
    let columns: String = methods
        .iter()
        .map(|(name, _)| format!(" {name:>21}"))
        .collect();
    let header = format!("{:<24}{columns}\n", "scene");
    let mut tables = [header.clone(), header];
    let mut all_scores = Vec::new();
    context.interrupt.keeps("nothing is written by --simulated");
    for (name, scans_of) in scenes {
        context.interrupt.check()?;
        let scans = SEEDS.into_par_iter().map(&*scans_of);
        let scans: Vec<_> = scans.collect::<Result<_, _>>()?;
        let scans = scans.into_iter().flatten().map(|scan| LabelledPoints {
            points: scan.scan.points,
            classes: Some(scan.classes),
        });
        let scans: Vec<LabelledPoints> = scans.collect();
        tables
            .iter_mut()
            .for_each(|table| *table += &format!("{name:<24}"));
        for (method, classifier) in &methods {
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
            let [f1, f1_ahead] = scores.map(|score| score.f1());
            for (table, f1) in tables.iter_mut().zip([f1, f1_ahead]) {
                *table += &format!(" {:>21.2}", 100.0 * f1);
            }
            all_scores.push(SceneScore {
                scene: name.clone(),
                method: (*method).to_string(),
                f1,
                f1_ahead,
            });
        }
        tables.iter_mut().for_each(|table| table.push('\n'));
        task.advance(1);
    }
    let [whole, ahead] = tables;
    let text = format!(
        "F1 [%] on simulated streets, protocol of Patchwork++, {} seeds\n\n\
         whole scans\n{whole}\npoints more than {AHEAD_M} m ahead\n{ahead}",
        SEEDS.len()
    );
    Printed::text(text).with_json(&all_scores)
}
