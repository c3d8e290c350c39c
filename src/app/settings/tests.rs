use std::fs;
use std::path::Path;

use super::*;
use crate::rendering::RenderingMethod;
use crate::validation::Validate;

/// Loads a configuration from a text.
fn load_text<T: CommandConfig>(text: &str, settings: &[(&str, &str)]) -> Result<T, ConfigError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("own.yml");
    fs::write(&path, text).unwrap();
    let settings: Vec<(String, String)> = settings
        .iter()
        .map(|(key, value)| ((*key).to_owned(), (*value).to_owned()))
        .collect();
    load(Some(&path), &settings)
}

fn message_of(text: &str, settings: &[(&str, &str)]) -> String {
    load_text::<LocalizationConfig>(text, settings)
        .unwrap_err()
        .to_string()
}

#[track_caller]
fn assert_contains(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "`{part}` is not in: {message}");
    }
}

#[test]
fn an_empty_file_is_the_default_configuration() {
    assert_eq!(
        load_text::<BuildMapConfig>("", &[]).unwrap(),
        BuildMapConfig::default()
    );
    assert_eq!(
        load_text::<EvaluationConfig>("# nothing but a comment\n", &[]).unwrap(),
        EvaluationConfig::default()
    );
}

#[test]
fn every_default_configuration_is_valid() {
    BuildMapConfig::default().validate().unwrap();
    LocalizationConfig::default().validate().unwrap();
    RefinementConfig::default().validate().unwrap();
    EvaluationConfig::default().validate().unwrap();
    GroundCommandConfig::default().validate().unwrap();
}

#[test]
fn a_written_configuration_loads_to_an_equal_one() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("effective.yml");
    for name in [
        "map.ply",
        "007",
        "no",
        "~",
        "- a: b # c",
        "it's \"q\"",
        "a\nb",
        "\u{1b}]0;t\u{7}\r\u{7f}\u{9b}\u{85}",
    ] {
        let mut config = LocalizationConfig {
            motion: MotionSourceConfig {
                odometry: OdometrySource::File,
                odometry_file: Some(name.into()),
            },
            initialization: Some(Initialization::Extent),
            ..LocalizationConfig::default()
        };
        config.map_input.map_file = name.into();
        config.tracker.localizer.move_thres_m = 0.1 + 0.2;
        config.tracker.seed = u64::MAX;
        config.tracker.sensor.range_image.fov_up = Some(0.1);
        config.tracker.sensor.range_image.max_range = Some(1.0e6);
        fs::write(&path, to_yaml(&config).unwrap()).unwrap();
        let loaded: LocalizationConfig = load(Some(&path), &[]).unwrap();
        assert_eq!(loaded, config);
    }
}

#[test]
fn an_unknown_key_is_reported_with_its_line_and_the_nearest_key() {
    let message = message_of("seed: 1\nnumparticles: 100\n", &[]);
    assert_contains(
        &message,
        &["own.yml, line 2", "`numparticles`", "`num_particles`"],
    );
    let message = message_of("range_image:\n  height: 64\n  widht: 900\n", &[]);
    assert_contains(&message, &["line 3", "`widht`", "did you mean `width`?"]);
}

#[test]
fn a_value_of_the_wrong_type_is_reported_with_line_key_and_value() {
    let message = message_of("seed: 1\n\nmove_thres: far\n", &[]);
    assert_contains(
        &message,
        &["own.yml, line 3", "move_thres", "`far`", "a number"],
    );
    let message = message_of("range_image:\n  # rows\n  height: tall # so\n", &[]);
    assert_contains(
        &message,
        &["line 3", "range_image.height", "`tall`", "a whole number"],
    );
    let message = message_of("pose_tracking: perhaps\n", &[]);
    assert_contains(&message, &["line 1", "pose_tracking", "True or False"]);
    let message = message_of("odometry: guess\n", &[]);
    assert_contains(
        &message,
        &["line 1", "`guess`", "auto, scans, file, ground_truth, none"],
    );
}

#[test]
fn a_value_of_the_wrong_shape_is_quoted() {
    let message = message_of("range_image: [1]  # rows\n", &[]);
    assert_contains(&message, &["line 1", "`[1]`", "a block of keys"]);
    let message = message_of("seed: 1\nscan_folder: {a: b}\n", &[]);
    assert_contains(&message, &["line 2", "`{a: b}`", "a string"]);
    let message = message_of("start_idx:\n", &[]);
    assert_contains(
        &message,
        &["line 1", "`null`", "start_idx", "a whole number"],
    );
    for text in [
        "ground_color: [1, 2]\n",
        "seed: 0\nground_color: [1, 2, 3, 4]\n",
    ] {
        let message = load_text::<BuildMapConfig>(text, &[])
            .unwrap_err()
            .to_string();
        assert_contains(&message, &["`[1, 2", "ground_color", "a list of length 3"]);
    }
}

#[test]
fn a_syntax_error_is_reported_with_its_line() {
    let message = message_of("seed: 1\nmap_file: [\n", &[]);
    assert_contains(&message, &["own.yml", "line 2"]);
    assert_contains(&message_of("just words\n", &[]), &["own.yml, line 1"]);
}

#[test]
fn a_duplicate_key_is_reported() {
    let message = message_of("seed: 1\nseed: 2\n", &[]);
    assert_contains(
        &message,
        &["own.yml, line 2", "`tracker.seed` is given twice"],
    );
}

#[test]
fn a_setting_replaces_one_key_and_the_last_one_wins() {
    let config: LocalizationConfig = load_text(
        "numParticles: 50\nrange_image:\n  height: 32\n",
        &[
            ("range_image.width", "512"),
            ("range_image.width", "1024"),
            ("scan_folder", "07"),
            ("odometry_file", "odometry.txt"),
            ("odometry", "file"),
        ],
    )
    .unwrap();
    let mut expected = LocalizationConfig {
        motion: MotionSourceConfig {
            odometry: OdometrySource::File,
            odometry_file: Some("odometry.txt".into()),
        },
        ..LocalizationConfig::default()
    };
    expected.recording.scan_folder = "07".into();
    expected.tracker.localizer.num_particles = 50;
    expected.tracker.sensor.range_image.height = Some(32);
    expected.tracker.sensor.range_image.width = Some(1024);
    assert_eq!(config, expected);
}

#[test]
fn a_setting_may_be_a_list_or_reset_a_key() {
    let config: BuildMapConfig =
        load_text("", &[("ground_color", "[0, 1, 0.5]"), ("seed", "3")]).unwrap();
    assert_eq!(config.map.local_map.ground_color, [0.0, 1.0, 0.5]);
    assert_eq!(config.map.local_map.rest_color, [0.0, 0.0, 1.0]);
    assert_eq!(config.map.seed, 3);
    let config: LocalizationConfig =
        load_text("initialization: extent\n", &[("initialization", "null")]).unwrap();
    assert_eq!(config.initialization, None);
}

#[test]
fn an_invalid_setting_is_quoted() {
    let message = message_of("", &[("range_image.widht", "3")]);
    assert_contains(
        &message,
        &["--set range_image.widht=3", "`range_image.width`"],
    );
    let message = message_of("", &[("patience", "3")]);
    assert_contains(
        &message,
        &[
            "is ambiguous",
            "tracking_loss.patience",
            "refinement.swarm.patience",
        ],
    );
    let message = message_of("", &[("seed", "many")]);
    assert_contains(&message, &["--set seed=many", "whole number"]);
    let message = message_of("", &[("range_image", "[1")]);
    assert_contains(&message, &["--set range_image=[1"]);
    let message = message_of("", &[("seed", "-1")]);
    assert_contains(&message, &["--set seed=-1", "not negative"]);
    // The error is of the block of the key.
    let (key, value) = ("fuzzy.variables.height.level", "{triangle: [3, 2, 1]}");
    let message = message_of("", &[(key, value)]);
    assert_contains(&message, &["--set fuzzy.variables.height.level"]);
    let message = message_of("", &[(&"k".repeat(100_000), "1")]);
    assert_contains(&message, &["no known key is similar"]);
}

#[test]
fn an_invalid_value_is_reported_with_key_value_and_remedy() {
    let message = message_of("range_image:\n  min_range: 60\n  max_range: 50\n", &[]);
    assert_contains(
        &message,
        &[
            "line 2",
            "tracker.sensor.range_image.min_range is 60",
            "max_range, which is 50",
        ],
    );
    for (key, value) in [
        ("range_image.width", "0"),
        ("range_image.fov_up", "-91"),
        ("range_image.max_range", ".nan"),
        ("numParticles", "0"),
        ("num_reduced", "0"),
        ("frame_step", "0"),
        ("n_scans", "0"),
        ("n_scans", "-2"),
        ("grid_res", "-1"),
        ("move_thres", ".inf"),
        ("odometry", "file"),
        ("map_file", "''"),
        ("rendering.method", "raster"),
    ] {
        let message = message_of("", &[(key, value)]);
        assert_contains(&message, &[&format!("--set {key}={value}: "), " is "]);
    }
    for (key, value) in [
        ("depth", "2"),
        ("depth", "13"),
        ("voxel_size", "-0.1"),
        ("min_density", "1"),
        ("crop_x", "0"),
        ("ransac_n", "2"),
        ("ground_color", "[2, 0, 0]"),
    ] {
        let message = load_text::<BuildMapConfig>("", &[(key, value)])
            .unwrap_err()
            .to_string();
        assert_contains(&message, &[&format!("--set {key}={value}: "), " is "]);
    }
    let message = load_text::<EvaluationConfig>("particle_select_ratio: 0\n", &[])
        .unwrap_err()
        .to_string();
    assert_contains(&message, &["line 1", "particle_select_ratio is 0"]);
}

#[test]
fn a_missing_file_is_named() {
    let missing: Result<EvaluationConfig, _> = load(Some(Path::new("nowhere/own.yml")), &[]);
    assert_contains(&missing.unwrap_err().to_string(), &["nowhere/own.yml"]);
}

#[test]
fn the_numbers_of_items_are_not_part_of_the_keys_of_settings() {
    let message = load_text::<BuildMapConfig>("", &[("fuzzy.rules[1]", "x")])
        .unwrap_err()
        .to_string();
    assert_contains(&message, &["unknown key `fuzzy.rules[1]`", "`fuzzy.rules`"]);
}

#[test]
fn the_initialization_follows_from_pose_tracking_unless_it_is_given() {
    let start = |text: &str| {
        let text = format!("pose_file: poses.txt\n{text}");
        load_text::<LocalizationConfig>(&text, &[])
            .unwrap()
            .initialization()
    };
    assert_eq!(start(""), Initialization::Extent);
    assert_eq!(
        start("initial_pose: [1, 2, 90]\n"),
        Initialization::Tracking
    );
    assert_eq!(start("pose_tracking: True\n"), Initialization::Tracking);
    assert_eq!(start("pose_tracking: False\n"), Initialization::Corridor);
    assert_eq!(
        start("pose_tracking: True\ninitialization: extent\n"),
        Initialization::Extent
    );
}

#[test]
fn a_known_start_and_the_true_odometry_need_their_poses() {
    for text in [
        "pose_tracking: True\n",
        "initialization: tracking\n",
        "odometry: ground_truth\n",
    ] {
        assert_contains(&message_of(text, &[]), &["pose_file"]);
    }
    let text = "initial_pose: [1e9, 0, 0]\n";
    assert_contains(&message_of(text, &[]), &["initial_pose", "metres"]);
    let text = "calib_file: calib.txt\nbody_from_lidar: [0, 0, 1.7, 0, 0, 0]\n";
    assert_contains(&message_of(text, &[]), &["calib_file or body_from_lidar"]);
}

#[test]
fn only_whole_range_images_are_rasterized() {
    let text = "rendering: {method: raster}\n";
    assert_contains(
        &message_of(text, &[]),
        &["rendering.method is raster", "reference"],
    );
    let reference = ("observation.likelihood", "reference");
    let config: LocalizationConfig = load_text(text, &[reference]).unwrap();
    assert_eq!(config.map_options().method, RenderingMethod::Raster);
}

#[test]
fn keys_of_batches_have_no_effect() {
    let text = "range_image:\n  max_instance: 50\n  height: 32\n  render_instanced: True\n";
    let config: LocalizationConfig = load_text(text, &[("range_image.max_instance", "7")]).unwrap();
    let mut expected = LocalizationConfig::default();
    expected.tracker.sensor.range_image.height = Some(32);
    assert_eq!(config, expected);
}

#[test]
fn a_key_whose_value_is_fixed_now_is_refused_with_this_reason() {
    let text = "seed: 1\nproposal: {registration: {iterations: 3, freedom: planar}}\n";
    assert_contains(
        &message_of(text, &[]),
        &["line 2", "freedom` is not a key any more", "remove it"],
    );
    assert_contains(
        &message_of("", &[("widening", "2")]),
        &["--set widening=2", "`widening` is not a key"],
    );
}

#[test]
fn names_of_one_block_are_gathered_and_errors_keep_the_lines_of_the_file() {
    let text = "\
depth: 8
map:
  local_map:
    # rows
    voxel_size_m: 0.2

ground_method: pca
pca: {min_cosine: 0.9}
crop_x: 20
";
    let config: BuildMapConfig = load_text(text, &[]).unwrap();
    let mut expected = BuildMapConfig::default();
    expected.map.local_map.poisson.depth = Some(8);
    expected.map.local_map.voxel_size_m = 0.2;
    expected.map.local_map.crop_x_m = Some(20.0);
    expected.map.ground.method = crate::ground::GroundMethod::Pca;
    expected.map.ground.pca.min_cosine = 0.9;
    assert_eq!(config, expected);

    let message = |text: &str| {
        load_text::<BuildMapConfig>(text, &[])
            .unwrap_err()
            .to_string()
    };
    let wrong = message(&text.replace("crop_x: 20", "crop_x: wide"));
    assert_contains(&wrong, &["line 9", "crop_x_m", "`wide`", "a number"]);
    let impossible = message(&text.replace("depth: 8", "depth: 1"));
    assert_contains(&impossible, &["line 1", "poisson.depth is 1"]);
    let twice = message(&format!("{text}voxel_size: 0.1\n"));
    assert_contains(&twice, &["line 10", "voxel_size_m", "twice"]);
    let block_and_value = message(&format!("{text}ground: null\n"));
    assert_contains(&block_and_value, &["line 10", "ground", "twice"]);
}

#[test]
fn any_style_of_yaml_is_read_or_refused_and_nothing_is_lost() {
    let scans = |text: &str| load_text::<LocalizationConfig>(text, &[]);
    let mut expected = LocalizationConfig::default();
    expected.recording.scan_folder = "/x: y".into();
    expected.recording.topic = Some("foo # }".into());
    expected.tracker.seed = 7;
    for text in [
        "recording: {scan_folder: '/x: y',\n  topic: 'foo # }'}\nseed: 7\n",
        "recording: {\n  scan_folder: \"/x: y\",\n  topic: 'foo # }'\n  }\n\"seed\": 7\n",
        "scan_folder: '/x: y'\n'topic': 'foo # }'\nseed : 7\n",
        "\u{feff}scan_folder:\t'/x: y'\ntopic: >-\n  foo # }\nseed: 7\n...\n",
        "recording:\nscan_folder: '/x: y'\ntopic: 'foo # }'\nseed: 7\r\n",
        "{recording: {scan_folder: '/x: y', topic: 'foo # }'}, tracker: {seed: 7}}\n",
        "---\n# a comment\nseed: 7\nrecording:\n    scan_folder: '/x: y'\n    topic: 'foo # }'\n",
    ] {
        assert_eq!(
            scans(text).map_err(|error| error.to_string()),
            Ok(expected.clone()),
            "{text}"
        );
    }
    let text = "{recording: {frames: {start_idx: 1}},\nnumParticles: 5,\ntracker: {localizer:\n {vigilance: {patience: x}}}}";
    let message = message_of(text, &[]);
    assert_contains(&message, &["line 4", "tracking_loss.patience", "`x`"]);
    for text in [
        "base: &base {seed: 7}\n<<: *base\n",
        "seed: 7\n<<: {topic: foo}\n",
        "...\nseed: 7\n",
        "seed: 7\n...\ntopic: foo\n",
        "recording:\n\tscan_folder: /x\n",
    ] {
        assert!(scans(text).is_err(), "{text}");
    }
}
