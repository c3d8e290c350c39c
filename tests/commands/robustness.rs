//! What may go wrong on the road, through the binary: every trial of the table in
//! `docs/benchmarks.md`, on a short simulated drive.

use std::fs;
use std::sync::LazyLock;

use fpmcl::internals::app::LocalizationResults;
use fpmcl::internals::ply;
use fpmcl::localization::State;
use fpmcl::recording::read_tum;
use tempfile::TempDir;

use crate::common::{
    self, DRIVE_2_IN_MAP, MAP_OF_DRIVE_1, SENSOR, fpmcl, json, numbers, run, shared_folder,
    simulate_two_drives,
};

/// Frames of a drive; 0.8 m apart.
const FRAMES: usize = 40;

const SIMULATION: &str = "\
output_folder: street
n_scans: 40
path:
- {length_m: 60, turn_deg: 30}
- {length_m: 60, turn_deg: -20}
scanner: {azimuth_steps: 600}
";

/// A folder with a map of drive 1 and the scans of drive 2.
static WORLD: LazyLock<TempDir> = LazyLock::new(|| {
    let temporary = shared_folder();
    let folder = temporary.path();
    simulate_two_drives(folder, SIMULATION);
    let map = format!("{MAP_OF_DRIVE_1}{SENSOR}depth: 8\nvisualize: False\n");
    fs::write(folder.join("build_map.yml"), map).unwrap();
    let query = format!("{DRIVE_2_IN_MAP}{SENSOR}numParticles: 2000\nplot_loc_results: False\n");
    fs::write(folder.join("localization.yml"), query).unwrap();
    run(folder, &["build-map", "build_map.yml"]);
    temporary
});

/// What a trial gives.
struct Outcome {
    /// Largest position error from frame 20 on [m].
    worst_m: f64,
    report: serde_json::Value,
}

/// Localizes with overrides, into a folder with the name of the trial.
fn localize(trial: &str, settings: &[&str]) -> Outcome {
    let folder = WORLD.path();
    let result = format!("{trial}/localization.npz");
    let call = fpmcl("localize")
        .in_folder(folder)
        .with("localization.yml")
        .set("result_path", &result);
    let call = if settings.contains(&"--backend=gpu") {
        call
    } else {
        call.with("--backend=cpu")
    };
    let call = settings
        .iter()
        .fold(call, |call, setting| match setting.split_once('=') {
            Some((key, value)) if !key.starts_with('-') => call.set(key, value),
            _ => call.with(setting),
        });
    call.succeeds();
    let table = folder.join(trial).join("frames.csv");
    let errors_m = numbers(&table, "mcl_position_error_m");
    assert_eq!(errors_m.len(), FRAMES);
    Outcome {
        worst_m: errors_m[20..].iter().copied().fold(0.0, f64::max),
        report: json(&folder.join(trial).join("report.json")),
    }
}

/// Simulates drive 2 again with overrides, in a folder of its own, and returns the settings that
/// localize it.
fn simulated(trial: &str, settings: &[&str]) -> Vec<String> {
    let folder = WORLD.path();
    let mut arguments = vec!["simulate".to_owned(), "simulation.yml".to_owned()];
    let output = format!("output_folder={trial}_street");
    for setting in ["drive=2", &output].iter().chain(settings) {
        arguments.extend(["--set".to_owned(), (*setting).to_owned()]);
    }
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    run(folder, &arguments);
    let drive = format!("{trial}_street/drive_2");
    vec![
        format!("scan_folder={drive}/velodyne"),
        format!("pose_file={drive}/poses.txt"),
        format!("calib_file={drive}/calib.txt"),
        format!("odometry_file={drive}/odometry.txt"),
    ]
}

fn localize_simulated(trial: &str, settings: &[&str]) -> Outcome {
    let drive = simulated(trial, settings);
    let drive: Vec<&str> = drive.iter().map(String::as_str).collect();
    localize(trial, &drive)
}

#[test]
fn a_start_anywhere_is_found_on_the_road_and_in_the_map() {
    for region in ["corridor", "extent"] {
        let outcome = localize(region, &[&format!("initialization={region}")]);
        assert!(outcome.worst_m < 0.2, "{region}: {} m", outcome.worst_m);
    }
}

#[test]
fn frames_before_the_first_one_that_is_found_are_filled_back() {
    let late = [
        "initialization=tracking",
        "tracking_loss.confirming_updates=8",
    ];
    let outcome = localize("filled", &late);
    let summary = &outcome.report["summary"];
    let (first, filled) = (&summary["first_tracked"], &summary["filled"]);
    assert!(first.as_u64().unwrap() > 0 && first == filled, "{summary}");
    let found = read_tum(&WORLD.path().join("filled/mcl_tum.txt")).unwrap();
    assert_eq!(found.len(), FRAMES);
    let result = LocalizationResults::read(&WORLD.path().join("filled/localization.npz")).unwrap();
    let truth = result.ground_truth_in_space.unwrap();
    for (row, (found, truth)) in found.iter().zip(&truth).enumerate() {
        let off_m = (truth.inverse() * found.map_from_lidar)
            .translation
            .vector
            .norm();
        assert!(off_m < 0.2, "row {row}: {off_m} m");
    }
    // The filter's own estimates stay as they were at their time.
    let states = result.states.unwrap();
    assert_ne!(states[0], State::Tracking as u8);
    assert_eq!(
        *result.trajectory_states.unwrap(),
        [State::Tracking as u8; FRAMES]
    );
}

#[test]
fn both_motion_models_and_none_follow_the_car() {
    for model in ["turn_drive_turn", "velocity"] {
        let outcome = localize(model, &[&format!("motion_model={model}")]);
        assert!(outcome.worst_m < 0.2, "{model}: {} m", outcome.worst_m);
    }
    let outcome = localize("no_odometry", &["odometry=none"]);
    assert!(outcome.worst_m < 0.2, "{} m", outcome.worst_m);
}

#[test]
fn a_car_that_is_moved_is_lost_and_found_again() {
    let moved = ["motion.kidnapped_at_frame=12", "motion.kidnapped_by_m=12"];
    let outcome = localize_simulated("kidnapped", &moved);
    assert!(outcome.worst_m < 0.3, "{} m", outcome.worst_m);
    let states = outcome.report["about"]["states"].as_str().unwrap();
    assert!(!states.contains("tracking in 40"), "{states}");
}

#[test]
fn a_lorry_beside_the_car_and_missing_beams_do_not_disturb() {
    let lorry = ["traffic.lorry_from_s=1", "traffic.lorry_for_s=2"];
    let outcome = localize_simulated("lorry", &lorry);
    assert!(outcome.worst_m < 0.3, "{} m", outcome.worst_m);
    let outcome = localize_simulated("dropout", &["scanner.dropout_share=0.3"]);
    assert!(outcome.worst_m < 0.2, "{} m", outcome.worst_m);
}

#[test]
fn a_map_with_a_tenth_of_its_triangles_missing_is_enough() {
    let path = WORLD.path().join("results/map.ply");
    let (mut mesh, drive) = ply::read_map(&path).unwrap();
    let mut number = 0_usize;
    mesh.triangles.retain(|_| {
        number += 1;
        !number.is_multiple_of(10)
    });
    let holes = WORLD.path().join("holes.ply");
    ply::write(&holes, &mesh, drive.as_ref()).unwrap();
    let outcome = localize("holes", &["map_file=holes.ply"]);
    assert!(outcome.worst_m < 0.2, "{} m", outcome.worst_m);
}

#[test]
fn scans_bent_by_the_motion_are_compensated() {
    let drive = simulated(
        "rolling",
        &["scanner.rolling_shutter=true", "odometry.scale_error=0"],
    );
    let mut settings: Vec<&str> = drive.iter().map(String::as_str).collect();
    let bent = localize("bent", &settings);
    settings.push("motion_compensation=counter_clockwise");
    let compensated = localize("compensated", &settings);
    let rmse = |outcome: &Outcome| {
        let metrics = &outcome.report["mcl"]["metrics"];
        metrics["position_m"]["rmse"].as_f64().unwrap()
    };
    assert!(
        rmse(&compensated) < 0.5 * rmse(&bent),
        "{} {}",
        rmse(&compensated),
        rmse(&bent)
    );
}

#[test]
fn localize_refines_where_it_is_asked_to() {
    let outcome = localize("refined", &["refine=True"]);
    let rmse = |name: &str| outcome.report[name]["metrics"]["position_m"]["rmse"].as_f64();
    assert!(rmse("refined").unwrap() < rmse("mcl").unwrap().max(0.02));
}

/// Where the variable `FPMCL_REQUIRE_GPU` is set, a missing adapter is an error.
#[test]
fn the_graphics_card_finds_the_same_path() {
    let has_adapter = common::has_graphics_adapter();
    let required = std::env::var_os("FPMCL_REQUIRE_GPU").is_some_and(|value| value == "1");
    if !has_adapter && !required {
        common::skips::skipped("there is no graphics adapter");
        return;
    }
    let outcome = localize("gpu", &["--backend=gpu"]);
    assert!(outcome.worst_m < 0.2, "{} m", outcome.worst_m);
}
