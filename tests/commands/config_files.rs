//! The configuration files: each loads and survives a round trip, the built-in texts have the
//! defaults and explain every key, and the files of range-mcl load unchanged.

use std::fmt::Debug;
use std::fs;
use std::path::{Path, PathBuf};

use fpmcl::internals::app::ComparisonConfig;
use fpmcl::internals::app::settings::{
    BuildMapConfig, CommandConfig, EvaluationConfig, GroundCommandConfig, Initialization,
    LocalizationConfig, MapInputConfig, OdometryCommandConfig, PoseInputConfig, RecordingConfig,
    RefinementConfig,
};
use fpmcl::lidar::LidarModel;
use fpmcl::sensor::{Sensor, SensorConfig};
use fpmcl::simulation::SimulationConfig;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn load<T: CommandConfig>(path: &Path) -> T {
    T::load(Some(path), &[]).unwrap_or_else(|error| panic!("{error}"))
}

/// Loads a configuration from a text.
fn parse<T: CommandConfig>(text: &str) -> T {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("own.yml");
    fs::write(&path, text).unwrap();
    load(&path)
}

/// The configuration files below a folder, all of them.
fn files_below(folder: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(files_below(&path));
        } else {
            files.push(path);
        }
    }
    files.sort();
    files
}

/// Loads a file as the configuration of the command in its name and checks the round trip.
fn check_round_trip(path: &Path) {
    let name = path.file_name().unwrap().to_str().unwrap();
    match name {
        "build_map.yml" => round_trip::<BuildMapConfig>(path),
        "localization.yml" | "localization_stereo.yml" => round_trip::<LocalizationConfig>(path),
        "refinement.yml" | "refinement_stereo.yml" => round_trip::<RefinementConfig>(path),
        "evaluation.yml" => round_trip::<EvaluationConfig>(path),
        "simulation.yml" => round_trip::<SimulationConfig>(path),
        "comparison.yml"
        | "comparison_hard_starts.yml"
        | "comparison_kitti.yml"
        | "comparison_refiners.yml"
        | "hard_cases.yml" => {
            round_trip::<ComparisonConfig>(path);
        }
        "odometry.yml" => round_trip::<OdometryCommandConfig>(path),
        "ground.yml" => round_trip::<GroundCommandConfig>(path),
        _ => panic!("{} belongs to no command", path.display()),
    }
}

fn round_trip<T: CommandConfig + PartialEq + Debug>(path: &Path) {
    let config: T = load(path);
    let folder = tempfile::tempdir().unwrap();
    let effective = folder.path().join("effective.yml");
    std::fs::write(&effective, config.to_yaml().unwrap()).unwrap();
    assert_eq!(load::<T>(&effective), config, "{}", path.display());
}

/// Checks that a text has a comment for each of its keys: on its line, or above it or its block.
fn require_comments(name: &str, text: &str) {
    let mut is_commented = false;
    for line in text.lines() {
        let Some(key) = key_of(line) else {
            let is_comment = line.trim_start().starts_with('#');
            is_commented = is_comment || is_commented && !line.is_empty();
            continue;
        };
        let is_block = line.trim_end().ends_with(':');
        assert!(
            is_block || line.contains(" # ") || is_commented,
            "{name}: {key}"
        );
    }
}

/// Checks the texts of a command: both have the defaults, the full one every key, the short one few.
fn check_texts<T: CommandConfig + PartialEq + Debug>() {
    let full = T::full_text().unwrap();
    assert_eq!(parse::<T>(&full), T::default(), "{}", T::PATH);
    assert_eq!(parse::<T>(T::SHORT), T::default(), "{}", T::PATH);
    let keys_of = |text: &str| -> Vec<String> {
        let keys = text.lines().filter_map(key_of);
        keys.map(str::to_owned).collect()
    };
    let effective = T::default().to_yaml().unwrap();
    assert_eq!(keys_of(&full), keys_of(&effective), "{}", T::PATH);
    require_comments(T::PATH, &full);
    require_comments(T::PATH, T::SHORT);
    let is_leaf = |line: &&str| {
        let code = line.split(" #").next().unwrap_or_default();
        key_of(code).is_some() && !code.trim_end().ends_with(':')
    };
    let leaves = T::SHORT.lines().filter(is_leaf).count();
    assert!(leaves <= 30, "{} has {leaves} keys", T::PATH);
}

/// The key at the start of a line.
fn key_of(line: &str) -> Option<&str> {
    let (key, _) = line.trim_start().split_once(':')?;
    key.chars()
        .all(|c| c.is_alphanumeric() || c == '_')
        .then_some(key)
}

#[test]
fn every_file_loads_and_its_effective_configuration_loads_to_an_equal_one() {
    let files = files_below(&root().join("config"));
    assert!(files.len() >= 4);
    for path in files {
        check_round_trip(&path);
    }
}

#[test]
fn the_built_in_texts_have_the_defaults_and_explain_every_key() {
    check_texts::<BuildMapConfig>();
    check_texts::<OdometryCommandConfig>();
    check_texts::<LocalizationConfig>();
    check_texts::<RefinementConfig>();
    check_texts::<EvaluationConfig>();
    check_texts::<GroundCommandConfig>();
    check_texts::<SimulationConfig>();
}

fn recording() -> RecordingConfig {
    RecordingConfig {
        scan_folder: "../data/07/velodyne".into(),
        ..RecordingConfig::default()
    }
}

/// The sensor that range-mcl's files describe.
fn known() -> SensorConfig {
    SensorConfig::from(&Sensor::new(LidarModel::default()))
}

fn poses() -> PoseInputConfig {
    PoseInputConfig {
        pose_file: Some("../data/07/poses.txt".into()),
        calib_file: Some("../data/07/calib.txt".into()),
        ..PoseInputConfig::default()
    }
}

#[test]
fn the_build_map_file_of_range_mcl_loads_unchanged() {
    let config: BuildMapConfig = load(&root().join("tests/range_mcl/build_map.yml"));
    let mut expected = BuildMapConfig {
        recording: recording(),
        given_poses: poses(),
        mesh_file: "../data/mesh_kitti_07.ply".into(),
        ..BuildMapConfig::default()
    };
    expected.map.sensor.range_image = known().range_image;
    let local_map = &mut expected.map.local_map;
    local_map.poisson.depth = Some(9);
    (local_map.crop_x_m, local_map.crop_y_m, local_map.crop_z_m) =
        (Some(30.0), Some(30.0), Some(5.0));
    assert_eq!(config, expected);
}

#[test]
fn the_localization_file_of_range_mcl_loads_unchanged() {
    let config: LocalizationConfig = load(&root().join("tests/range_mcl/localization.yml"));
    let mut expected = LocalizationConfig {
        recording: recording(),
        given_poses: poses(),
        map_input: MapInputConfig {
            map_file: "../data/mesh_kitti_07.ply".into(),
            map_pose_file: Some("../data/07/poses.txt".into()),
            map_calib_file: Some("../data/07/calib.txt".into()),
        },
        result_path: "../results/demo_loc_results.npz".into(),
        pose_tracking: Some(false),
        ..LocalizationConfig::default()
    };
    expected.tracker.sensor.range_image = known().range_image;
    assert_eq!(config, expected);
    assert_eq!(config.initialization(), Initialization::Corridor);
}

#[test]
fn the_evaluation_file_of_range_mcl_loads_unchanged() {
    let config: EvaluationConfig = load(&root().join("tests/range_mcl/evaluation.yml"));
    let expected = EvaluationConfig {
        result_file: "../results/demo_loc_results.npz".into(),
        given_poses: poses(),
        ..EvaluationConfig::default()
    };
    assert_eq!(config, expected);
}
