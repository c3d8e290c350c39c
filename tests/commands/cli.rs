//! The binary from outside: help, exit codes and errors in configurations.

use crate::common::{Recording, config_file, fpmcl};

const COMMANDS: [&str; 11] = [
    "build-map",
    "localize",
    "live",
    "refine",
    "evaluate",
    "compare",
    "simulate",
    "demo",
    "ground",
    "config",
    "doctor",
];

// Command line.

#[test]
fn the_help_matches_its_snapshot() {
    insta::assert_snapshot!("help", fpmcl("--help").succeeds().stdout);
}

#[test]
fn the_help_of_every_command_matches_its_snapshot() {
    for command in COMMANDS {
        let help = fpmcl(command).with("--help").succeeds().stdout;
        insta::assert_snapshot!(format!("help-{command}"), help);
    }
}

#[test]
fn the_help_lists_every_command() {
    let help = fpmcl("-h").succeeds().stdout;
    for command in COMMANDS {
        assert!(help.contains(&format!("\n  {command} ")), "{command}");
    }
}

#[test]
fn the_version_is_the_version_of_the_package() {
    let expected = format!("fpmcl {}\n", env!("CARGO_PKG_VERSION"));
    assert_eq!(fpmcl("--version").succeeds().stdout, expected);
}

#[test]
fn wrong_usage_has_exit_code_2() {
    fpmcl("build-mop").rejects_usage_with(&["build-mop", "build-map"]);
    fpmcl("localize")
        .with("--treads=2")
        .rejects_usage_with(&["--treads", "--threads"]);
    fpmcl("localize")
        .with("--threads=0")
        .rejects_usage_with(&["--threads", "0"]);
    fpmcl("localize")
        .with("--backend=cuda")
        .rejects_usage_with(&["cuda", "auto, cpu, gpu"]);
    fpmcl("localize")
        .with("--set")
        .with("seed")
        .rejects_usage_with(&["key=value"]);
    fpmcl("localize")
        .with("-q")
        .with("-v")
        .rejects_usage_with(&["cannot be used with"]);
    // An argument is no line of its own.
    let output = fpmcl("localize").with("--threads=1\n2");
    output.rejects_usage_with(&[r"1\n2"]);
}

#[cfg(not(feature = "gpu"))]
#[test]
fn a_backend_that_is_not_built_in_is_an_error_that_names_the_feature() {
    let recording = Recording::street(2);
    recording.fpmcl("build-map").succeeds();
    let call = fpmcl("localize").in_folder(recording.folder());
    (call.with("localization.yml").with("--backend=gpu"))
        .fails_with(&["without the feature gpu", "--features gpu"]);
}

#[test]
fn the_doctor_prints_threads_and_backend() {
    let stdout = fpmcl("doctor").with("--measure=0").succeeds().stdout;
    for row in ["instruction sets", "threads in use", "backend auto"] {
        assert!(stdout.contains(row), "{stdout}");
    }
    assert!(!stdout.contains("per second"), "{stdout}");
}

// Configurations.

#[test]
fn a_missing_configuration_is_reported_with_its_path() {
    fpmcl("evaluate")
        .with("own.yml")
        .fails_with(&["cannot read", "own.yml", "give the path"]);
}

#[test]
fn without_a_file_the_built_in_configuration_is_used() {
    fpmcl("build-map").fails_with(&["data/kitti/velodyne, which scan_folder is by default"]);
    fpmcl("ground").fails_with(&["data/kitti/velodyne"]);
    fpmcl("evaluate").fails_with(&["results/localization.npz, which result_file is by default"]);
    let runs = fpmcl("compare").with("--list-jobs").succeeds().stdout;
    assert!(runs.contains("town/Fuzzy-PSO-MCL/5"), "{runs}");
}

#[test]
fn config_prints_the_short_file_and_the_full_one() {
    for (command, file) in [
        ("build-map", "build_map.yml"),
        ("localize", "localization.yml"),
        ("refine", "refinement.yml"),
        ("evaluate", "evaluation.yml"),
        ("ground", "ground.yml"),
        ("simulate", "simulation.yml"),
        ("compare", "comparison.yml"),
    ] {
        let short = fpmcl("config").with(command).succeeds().stdout;
        assert_eq!(short, std::fs::read_to_string(config_file(file)).unwrap());
        let full = fpmcl("config")
            .with(command)
            .with("--full")
            .succeeds()
            .stdout;
        let heading = |text: &str| text.lines().next().map(str::to_owned);
        assert_eq!(heading(&full), heading(&short));
        assert!(full.contains("# Every key with its default."), "{command}");
    }
    fpmcl("config")
        .with("demo")
        .rejects_usage_with(&["demo", "localize"]);
}

#[test]
fn an_unknown_key_is_reported_with_line_and_nearest_key() {
    let recording = Recording::street(0);
    recording.write("build_map.yml", "depth: 8\nvoxel_sise: 0.1\n");
    recording.fpmcl("build-map").fails_with(&[
        "build_map.yml, line 2",
        "unknown key `voxel_sise`",
        "did you mean `voxel_size_m`?",
    ]);
}

#[test]
fn a_value_of_the_wrong_type_is_reported_with_its_line() {
    let recording = Recording::street(0);
    recording.write("localization.yml", "# start\n\nnumParticles: many\n");
    recording.fpmcl("localize").fails_with(&[
        "localization.yml, line 3",
        "`many`",
        "num_particles",
    ]);
}

#[test]
fn contradictory_values_are_reported_with_a_remedy() {
    for command in ["build-map", "localize"] {
        Recording::street(0)
            .fpmcl(command)
            .set("range_image.max_range", "50")
            .set("range_image.min_range", "60")
            .fails_with(&["less than max_range, which is 50"]);
    }
    fpmcl("refine")
        .with(config_file("refinement.yml"))
        .set("range_image.width", "0")
        .fails_with(&["range_image.width is 0"]);
    fpmcl("evaluate")
        .with(config_file("evaluation.yml"))
        .set("frame_step", "0")
        .fails_with(&["frame_step is 0", "1 takes every frame"]);
    fpmcl("refine")
        .with(config_file("refinement.yml"))
        .set("refinement.max_reach_m", "0.05")
        .fails_with(&["max_reach_m is 0.05", "min_reach_m, which is 0.1"]);
}

#[test]
fn a_setting_of_an_unknown_key_is_reported_with_the_nearest() {
    fpmcl("localize")
        .with(config_file("localization.yml"))
        .set("range_image.widht", "512")
        .fails_with(&["--set range_image.widht=512", "`range_image.width`"]);
}

#[test]
fn invalid_values_are_reported_before_any_work() {
    for (command, file, key, value) in [
        ("build-map", "build_map.yml", "visibility.max_beams", "0"),
        ("build-map", "build_map.yml", "poisson.scale", "1"),
        ("build-map", "build_map.yml", "normals.min_support", "0"),
        ("build-map", "build_map.yml", "own_car_m", "[1, 0, 0, 1]"),
        ("localize", "localization.yml", "observation.beams", "0"),
        ("localize", "localization.yml", "start.position_m", "-1"),
        ("localize", "localization.yml", "panorama.coarse_step", "0"),
        ("localize", "localization.yml", "kld.bin_m", "0"),
        (
            "refine",
            "refinement.yml",
            "refinement.swarm.candidates",
            "0",
        ),
    ] {
        let setting = format!("--set {key}={value}: ");
        fpmcl(command)
            .with(config_file(file))
            .set(key, value)
            .fails_with(&[&setting, &format!("{key} is ")]);
    }
}

#[test]
fn an_invalid_rule_is_reported_with_its_line_and_the_nearest_word() {
    // Both commands use this block.
    let whole = fpmcl("config").with("ground").with("--full");
    let whole = whole.succeeds().stdout;
    let block = &whole[whole.find("\nground:").expect("it contains the block")..];
    let block = &block[..block.find("\noutput:").unwrap_or(block.len())];
    for (command, text) in [("build-map", block), ("ground", whole.as_str())] {
        for (right, wrong, key, message) in [
            (
                "steep AND height_variance IS low",
                "steep AND hight_variance IS low",
                "fuzzy.rules[5]",
                "unknown variable `hight_variance`; the nearest is `height_variance`",
            ),
            (
                "AND height IS raised THEN",
                "AND height raised THEN",
                "fuzzy.rules[8]",
                "expected IS, found `raised`",
            ),
            (
                "level:\n          trapezoid: [-0.45, -0.15,",
                "level: # corners\n          trapezoid: [-0.1, -0.15,",
                "fuzzy.variables.height.level",
                "{trapezoid: [-0.1, -0.15, 0.03, 0.11]}: its corners must be finite and ascend",
            ),
            (
                "      ground:\n        high",
                "      grund:\n        high",
                "fuzzy.variables.grund",
                "no feature: the nearest is `ground`",
            ),
        ] {
            let invalid = text.replace(right, wrong);
            let line = 1 + std::iter::zip(text.lines(), invalid.lines())
                .position(|(before, after)| before != after)
                .expect("the text differs");
            let folder = tempfile::tempdir().expect("a folder");
            let path = folder.path().join("invalid.yml");
            std::fs::write(&path, invalid).expect("it can be written");
            let place = format!("invalid.yml, line {line}: ");
            let key = format!("{key} is ");
            fpmcl(command)
                .with(path)
                .fails_with(&[&place, &key, message]);
        }
    }
}

#[test]
fn an_invalid_rule_on_the_command_line_is_reported_there() {
    fpmcl("build-map")
        .with(config_file("build_map.yml"))
        .set("fuzzy.rules", "[IF height IS hight THEN ground IS low]")
        .fails_with(&[
            "--set fuzzy.rules=[IF height IS hight",
            "fuzzy.rules[1] is",
            "`height` has no set `hight`",
            "nearest",
        ]);
}

#[test]
fn a_setting_of_the_wrong_type_is_quoted() {
    fpmcl("localize")
        .with(config_file("localization.yml"))
        .set("seed", "yesterday")
        .fails_with(&["--set seed=yesterday", "whole number"]);
}
