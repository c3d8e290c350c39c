//! Scenes with exact labels for the evaluation of ground segmentation: one scan each, from a
//! vehicle on a straight street with a slope, a crest or kerbs.

use rayon::prelude::*;

use super::centreline::{Centreline, PathSegment};
use super::ego_motion::{EgoMotion, MotionConfig};
use super::random::{Purpose, stream};
use super::scanner::{LabelledScan, ScanTarget, ScannerConfig, simulate_scan};
use super::street::Street;
use super::street_config::StreetConfig;
use super::{Simulation, SimulationConfig, SimulationError};
use crate::memory::MemoryBudget;

/// A named scene: its scans with a seed.
pub type GroundScene = (
    String,
    Box<dyn Fn(u64) -> Result<Vec<LabelledScan>, SimulationError> + Sync>,
);

/// Slopes, crests, kerbs and drives on which methods of ground segmentation are compared.
pub fn ground_scenes() -> Vec<GroundScene> {
    let percent = |grade: f64| (100.0 * grade).round();
    let mut scenes: Vec<GroundScene> = Vec::new();
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
) -> GroundScene {
    let scans = move |seed| Ok(vec![scan(&ScannerConfig::default(), seed)]);
    (name, Box::new(scans))
}

/// Every twentieth scan of a drive through the whole simulated street, with its slope, crest, square and traffic.
fn drive(seed: u64, beams: usize) -> Result<Vec<LabelledScan>, SimulationError> {
    const STEP: usize = 20;
    let config = SimulationConfig {
        seed,
        scanner: ScannerConfig {
            beams,
            ..ScannerConfig::default()
        },
        ..SimulationConfig::default()
    };
    let simulation = Simulation::new(&config, None, MemoryBudget::default())?;
    let frames = (0..simulation.frames()).into_par_iter().step_by(STEP);
    Ok(frames.map(|frame| simulation.scan(frame)).collect())
}

/// Level ground from behind the vehicle to 6 m ahead of it, then a slope of `grade` (0.1 for
/// 10 %; negative downhill).
pub fn slope_scene(grade: f64, scanner: &ScannerConfig, seed: u64) -> LabelledScan {
    let pieces = [(66.0, 0.0), (60.0, grade)];
    straight_street_scene(&pieces, &StreetConfig::default(), scanner, seed)
}

/// A slope of `grade` up to a crest 15 m ahead of the vehicle, and down again as steeply.
pub fn crest_scene(grade: f64, scanner: &ScannerConfig, seed: u64) -> LabelledScan {
    let pieces = [(75.0, grade), (60.0, -grade)];
    straight_street_scene(&pieces, &StreetConfig::default(), scanner, seed)
}

/// A level street with kerbs of a height [m].
pub fn kerb_scene(height_m: f64, scanner: &ScannerConfig, seed: u64) -> LabelledScan {
    let mut street = StreetConfig::default();
    street.ground.kerb_height_m = height_m;
    straight_street_scene(&[(120.0, 0.0)], &street, scanner, seed)
}

/// The scan at 60 m along a straight street of pieces (length [m], grade).
fn straight_street_scene(
    pieces: &[(f64, f64)],
    street: &StreetConfig,
    scanner: &ScannerConfig,
    seed: u64,
) -> LabelledScan {
    const STATION_M: f64 = 60.0;
    let segments: Vec<PathSegment> = pieces
        .iter()
        .map(|&(length_m, grade)| PathSegment::new(length_m, 0.0, 100.0 * grade))
        .collect();
    let path = Centreline::from_segments(&segments, 0.0);
    let Street { surface, ground } = Street::new(&path, street, seed);
    let ego = EgoMotion::new(path, Some(&[STATION_M]), &MotionConfig::default(), seed, 1);
    simulate_scan(
        scanner,
        &[&ScanTarget::new(surface)],
        |delay_s| ego.world_from_lidar(&ground, delay_s),
        &mut stream(seed, Purpose::Scan, 0),
    )
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::super::classes;
    use super::*;

    fn road_ahead(scene: &LabelledScan) -> Vec<Vec3> {
        let points = scene.scan.points.iter().zip(&scene.classes);
        points
            .filter(|(point, class)| {
                **class == classes::ROAD && point.x > 0.0 && point.y.abs() < 1.0
            })
            .map(|(point, _)| *point)
            .collect()
    }

    /// Mean slope of the road between two distances ahead.
    fn slope_between(points: &[Vec3], near_m: f32, far_m: f32) -> f32 {
        let mean_around = |x: f32| {
            let around: Vec<f32> = points
                .iter()
                .filter(|point| (point.x - x).abs() < 2.0)
                .map(|point| point.z)
                .collect();
            assert!(!around.is_empty(), "no road {x} m ahead");
            around.iter().sum::<f32>() / around.len() as f32
        };
        (mean_around(far_m) - mean_around(near_m)) / (far_m - near_m)
    }

    #[test]
    fn a_slope_scene_has_the_requested_grade() {
        for grade in [0.05_f32, 0.10, 0.15] {
            let scene = slope_scene(f64::from(grade), &ScannerConfig::default(), 3);
            assert_eq!(scene.scan.len(), scene.classes.len());
            let road = road_ahead(&scene);
            // The suspension pitches by up to 0.3 degrees, that is 0.005.
            let slope = slope_between(&road, 14.0, 24.0);
            assert!((slope - grade).abs() < 0.02, "{slope} instead of {grade}");
        }
    }

    #[test]
    fn a_crest_occludes_what_is_behind_it() {
        let scene = crest_scene(0.10, &ScannerConfig::default(), 3);
        let road = road_ahead(&scene);
        let farthest_m = road.iter().map(|point| point.x).fold(0.0, f32::max);
        assert!(farthest_m > 10.0 && farthest_m < 32.0, "{farthest_m}");
        let level = kerb_scene(0.12, &ScannerConfig::default(), 3);
        let level_m = road_ahead(&level).iter().map(|p| p.x).fold(0.0, f32::max);
        assert!(level_m > 40.0, "{level_m}");
    }

    #[test]
    fn a_sidewalk_is_as_high_as_its_kerb() {
        // The vehicle has the roll angle of the cross slope.
        const BANK: f32 = 0.025;
        for kerb_m in [0.05_f32, 0.12, 0.2] {
            let scene = kerb_scene(f64::from(kerb_m), &ScannerConfig::default(), 3);
            let height_m = |class: u16, near_m: f32, far_m: f32, quantile: f32| {
                let mut heights: Vec<f32> = scene
                    .scan
                    .points
                    .iter()
                    .zip(&scene.classes)
                    .filter(|(p, c)| {
                        **c == class && p.x.abs() < 6.0 && p.y < -near_m && p.y > -far_m
                    })
                    .map(|(point, _)| point.z + BANK * point.y)
                    .collect();
                assert!(heights.len() > 50, "{} points", heights.len());
                heights.sort_by(f32::total_cmp);
                heights[(heights.len() as f32 * quantile) as usize]
            };
            // The kerb is 2.05 m to the right of the lidar, or behind bays; its face, which is
            // sidewalk too, lies lower than the upper quartile.
            let step_m = height_m(classes::SIDEWALK, 2.2, 6.0, 0.75)
                - height_m(classes::ROAD, 1.7, 2.05, 0.5);
            assert!(
                (step_m - kerb_m).abs() < 0.025,
                "{step_m} instead of {kerb_m}"
            );
        }
    }
}
