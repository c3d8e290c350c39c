//! The configurations that are delivered: each loads, says what the defaults say, explains
//! every key, and comes back from disk as it was; and those of range-mcl load unchanged.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

use std::collections::BTreeSet;
use std::fmt::Debug;
use std::fs;
use std::path::{Path, PathBuf};

use fpmcl::app::config::{
    self, BuildMapConfig, ComparisonConfig, EvaluationConfig, GroundCommandConfig, Initialization,
    LocalizationConfig, RefinementConfig, RenderedRangeImage,
};
use fpmcl::simulation::SimulationConfig;
use fpmcl::validation::Validate;
use serde::Serialize;
use serde::de::DeserializeOwned;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn load<T: Validate + Serialize + DeserializeOwned>(path: &Path) -> T {
    config::load(Some(path), Path::new(""), &[]).unwrap_or_else(|error| panic!("{error}"))
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

/// Loads a file as the configuration of the command that its name tells and checks that it
/// comes back; the keys that it should have had.
fn keys_of(path: &Path) -> BTreeSet<String> {
    let name = path.file_name().unwrap().to_str().unwrap();
    // One arm per command: a file that belongs to none is a mistake.
    match name {
        "build_map.yml" => round_trip::<BuildMapConfig>(path),
        "localization.yml" | "localization_stereo.yml" => round_trip::<LocalizationConfig>(path),
        "refinement.yml" | "refinement_stereo.yml" => round_trip::<RefinementConfig>(path),
        "evaluation.yml" => round_trip::<EvaluationConfig>(path),
        "simulation.yml" => round_trip::<SimulationConfig>(path),
        "comparison.yml" | "comparison_kitti.yml" | "comparison_refiners.yml" => {
            round_trip::<ComparisonConfig>(path)
        }
        "ground.yml" => round_trip::<GroundCommandConfig>(path),
        _ => panic!("{} belongs to no command", path.display()),
    }
}

fn round_trip<T>(path: &Path) -> BTreeSet<String>
where
    T: Validate + Serialize + DeserializeOwned + PartialEq + Debug,
{
    let config: T = load(path);
    let folder = tempfile::tempdir().unwrap();
    let effective = folder.path().join("effective.yml");
    config::write(&effective, &config).unwrap();
    assert_eq!(load::<T>(&effective), config, "{}", path.display());
    let text = fs::read_to_string(&effective).unwrap();
    text.lines().filter_map(key_of).map(str::to_owned).collect()
}

/// The key that a line begins with.
fn key_of(line: &str) -> Option<&str> {
    let (key, _) = line.trim_start().split_once(':')?;
    key.chars()
        .all(|c| c.is_alphanumeric() || c == '_')
        .then_some(key)
}

/// The keys that a line has in braces.
fn keys_in_braces(line: &str) -> impl Iterator<Item = &str> {
    let value = line.split(" # ").next().unwrap_or_default();
    value.split(['{', ',']).skip(1).filter_map(key_of)
}

#[test]
fn every_file_loads_and_its_effective_configuration_comes_back() {
    let files = files_below(&root().join("config"));
    assert!(files.len() >= 4);
    for path in files {
        keys_of(&path);
    }
}

#[test]
fn every_key_stands_in_the_file_of_its_command_with_a_comment() {
    for name in [
        "build_map.yml",
        "localization.yml",
        "refinement.yml",
        "evaluation.yml",
        "ground.yml",
    ] {
        let path = root().join("config").join(name);
        let text = fs::read_to_string(&path).unwrap();
        let mut keys = keys_of(&path);
        let mut commented = false;
        for line in text.lines() {
            let Some(key) = key_of(line) else {
                commented = line.trim_start().starts_with('#') || commented && !line.is_empty();
                continue;
            };
            let explained = line.contains(" # ") || commented;
            assert!(explained, "{name} does not explain {key}");
            commented = false;
            keys.remove(key);
            for inner in keys_in_braces(line) {
                keys.remove(inner);
            }
        }
        assert!(keys.is_empty(), "{name} does not show {keys:?}");
    }
}

#[test]
fn the_build_map_file_of_range_mcl_loads_unchanged() {
    let config: BuildMapConfig = load(&root().join("tests/range_mcl/build_map.yml"));
    let expected = BuildMapConfig {
        scan_folder: "../data/07/velodyne".into(),
        pose_file: "../data/07/poses.txt".into(),
        calib_file: "../data/07/calib.txt".into(),
        mesh_file: "../data/mesh_kitti_07.ply".into(),
        visualize: true,
        ..BuildMapConfig::default()
    };
    assert_eq!(config, expected);
}

#[test]
fn the_localization_file_of_range_mcl_loads_unchanged() {
    let config: LocalizationConfig = load(&root().join("tests/range_mcl/localization.yml"));
    let expected = LocalizationConfig {
        scan_folder: "../data/07/velodyne".into(),
        map_file: "../data/mesh_kitti_07.ply".into(),
        map_pose_file: "../data/07/poses.txt".into(),
        map_calib_file: "../data/07/calib.txt".into(),
        pose_file: "../data/07/poses.txt".into(),
        calib_file: "../data/07/calib.txt".into(),
        result_path: "../results/demo_loc_results.npz".into(),
        pose_tracking: false,
        range_image: RenderedRangeImage {
            max_instance: 50,
            ..RenderedRangeImage::default()
        },
        ..LocalizationConfig::default()
    };
    assert_eq!(config, expected);
    assert_eq!(config.initialization(), Initialization::Corridor);
}

#[test]
fn the_evaluation_file_of_range_mcl_loads_unchanged() {
    let config: EvaluationConfig = load(&root().join("tests/range_mcl/evaluation.yml"));
    let expected = EvaluationConfig {
        result_file: "../results/demo_loc_results.npz".into(),
        pose_file: "../data/07/poses.txt".into(),
        calib_file: "../data/07/calib.txt".into(),
        ..EvaluationConfig::default()
    };
    assert_eq!(config, expected);
}

#[test]
fn the_delivered_files_say_what_the_defaults_say() {
    let config = |name: &str| root().join("config").join(name);
    // The map is drawn, since it is the picture that one wants to see first.
    assert_eq!(
        load::<BuildMapConfig>(&config("build_map.yml")),
        BuildMapConfig {
            visualize: true,
            ..BuildMapConfig::default()
        }
    );
    assert_eq!(
        load::<LocalizationConfig>(&config("localization.yml")),
        LocalizationConfig::default()
    );
    assert_eq!(
        load::<RefinementConfig>(&config("refinement.yml")),
        RefinementConfig::default()
    );
    assert_eq!(
        load::<EvaluationConfig>(&config("evaluation.yml")),
        EvaluationConfig::default()
    );
    assert_eq!(
        load::<GroundCommandConfig>(&config("ground.yml")),
        GroundCommandConfig::default()
    );
}
