//! The command `compare` on a street of a few scans: finished runs are kept, shared results are
//! created once, and the tables agree with the runs.

use std::collections::BTreeSet;
use std::fs;
use std::path::PathBuf;

use crate::common::{COMPARISON_OF_STREET, Fpmcl, Recording, column, fpmcl, json, numbers};

const FRAMES: usize = 12;

/// Follows the common keys.
const COMPARISON: &str = "\
- {name: elsewhere, optional: True, build_map: {scan_folder: nowhere}}
configurations:
- {name: PCA-MCL, claimed_m: 1.45, build_map: {ground_method: pca}}
- {name: Fuzzy-MCL, claimed_m: 1.02}
- {name: Fuzzy-PSO-MCL, claimed_m: 0.71, refine: True}
particles: {configuration: Fuzzy-MCL, sequences: [street], counts: [10, 40], seeds: [1]}
output_folder: out
seeds: [1, 2]
";

fn comparison() -> String {
    format!("{COMPARISON_OF_STREET}{COMPARISON}")
}

fn recording() -> Recording {
    let recording = Recording::street(FRAMES);
    recording.write("comparison.yml", &comparison());
    recording
}

fn compare(recording: &Recording) -> Fpmcl {
    fpmcl("compare")
        .in_folder(recording.folder())
        .with("comparison.yml")
        .with("--backend=cpu")
}

/// The folders of shared results, without the lock files.
fn shared(recording: &Recording, what: &str) -> Vec<PathBuf> {
    let entries = fs::read_dir(recording.path(&format!("out/shared/{what}"))).unwrap();
    let paths = entries.map(|entry| entry.unwrap().path());
    paths.filter(|path| path.is_dir()).collect()
}

/// The record of each run with its bytes.
fn records(recording: &Recording) -> Vec<(PathBuf, Vec<u8>)> {
    let mut found = Vec::new();
    for configuration in fs::read_dir(recording.path("out/runs/street")).unwrap() {
        for seed in fs::read_dir(configuration.unwrap().path()).unwrap() {
            let path = seed.unwrap().path().join("run.json");
            if path.exists() {
                let bytes = fs::read(&path).unwrap();
                found.push((path, bytes));
            }
        }
    }
    found.sort();
    found
}

#[test]
fn every_run_is_executed_once_and_an_interrupted_comparison_resumes() {
    let recording = recording();
    let job = compare(&recording).with("--job=street/Fuzzy-PSO-MCL/2");
    let output = job.succeeds().stdout;
    assert!(output.contains("average positional error"), "{output}");
    let first = records(&recording);
    assert_eq!(first.len(), 1);
    let collected = compare(&recording).with("--collect").succeeds().stdout;
    assert!(collected.contains("1 of 2"), "{collected}");

    let output = compare(&recording).succeeds();
    let all = records(&recording);
    assert_eq!(all.len(), 3 * 2 + 2);
    assert!(all.contains(&first[0]), "a finished run was executed again");
    assert!(
        output.stderr.contains("elsewhere is skipped"),
        "{}",
        output.stderr
    );
    // Two ground methods; two seeds in each map, and two numbers of particles.
    assert_eq!(shared(&recording, "maps").len(), 2);
    assert_eq!(shared(&recording, "localizations").len(), 2 * 2 + 2);

    // As after a crash: a run without its record, and an incomplete map.
    fs::remove_file(&all[0].0).unwrap();
    fs::remove_file(shared(&recording, "maps")[0].join("finished.json")).unwrap();
    compare(&recording).succeeds();
    let again = records(&recording);
    assert_eq!(again.len(), all.len());
    assert_eq!(again[1..], all[1..], "finished runs were executed again");

    the_tables_agree_with_the_runs(&recording);
    a_run_is_reproduced_by_its_configuration(&recording);
    the_pages_are_self_contained(&recording);
    the_page_is_made_of_the_available_files(&recording);

    // Records of another configuration are not collected.
    let other = compare(&recording)
        .set("seeds", "[1]")
        .set("base.build_map.voxel_size", "0.25");
    other.with("--collect").fails_with(&["no run is finished"]);
}

fn the_tables_agree_with_the_runs(recording: &Recording) {
    let comparison = json(&recording.path("out/comparison.json"));
    let table = &comparison["tables"][0];
    let place_of = |name: &str| {
        let columns = table["columns"].as_array().unwrap();
        columns
            .iter()
            .position(|column| column["name"] == name)
            .unwrap()
    };
    let (error, claim) = (
        place_of("average positional error"),
        place_of("claimed by the report"),
    );
    let name = place_of("configuration");
    for (row, claimed_m) in table["rows"]
        .as_array()
        .unwrap()
        .iter()
        .zip([1.45, 1.02, 0.71])
    {
        let configuration = row[name]["text"].as_str().unwrap();
        let of_runs = [1, 2].map(|seed| {
            let folder = format!("out/runs/street/{configuration}/{seed}");
            let record = json(&recording.path(&format!("{folder}/run.json")));
            let pointer = "/outcome/finished/metrics/position_m/mean";
            let error_m = record.pointer(pointer).unwrap().as_f64().unwrap();
            let report = json(&recording.path(&format!("{folder}/report.json")));
            let (trajectory, state) = if configuration.contains("PSO") {
                ("refined", "refined_state")
            } else {
                ("mcl", "state")
            };
            let pointer = format!("/{trajectory}/metrics/position_m/mean");
            let reported_m = report.pointer(&pointer).unwrap().as_f64().unwrap();
            // The first half is not evaluated. A comparison evaluates all other frames, a report those that are tracking.
            let table = recording.path(&format!("{folder}/frames.csv"));
            let errors_m = numbers(&table, &format!("{trajectory}_position_error_m"));
            let is_tracking = column(&table, state).into_iter().map(|it| it == "tracking");
            let evaluated: Vec<(f64, bool)> = errors_m
                .into_iter()
                .zip(is_tracking)
                .skip(FRAMES / 2)
                .collect();
            let mean_m = |frames: Vec<f64>| frames.iter().sum::<f64>() / frames.len() as f64;
            let of_all_m = mean_m(evaluated.iter().map(|frame| frame.0).collect());
            let tracked = evaluated.iter().filter(|frame| frame.1);
            let of_tracked_m = mean_m(tracked.map(|frame| frame.0).collect());
            assert!((of_all_m - error_m).abs() < 1e-4, "{of_all_m} {error_m}");
            assert!(
                (of_tracked_m - reported_m).abs() < 1e-4,
                "{of_tracked_m} {reported_m}"
            );
            if evaluated.iter().all(|frame| frame.1) {
                assert_eq!(reported_m, error_m);
            }
            error_m
        });
        let mean = row[error]["estimate"]["mean"].as_f64().unwrap();
        assert!((mean - 0.5 * (of_runs[0] + of_runs[1])).abs() < 1e-12);
        assert_eq!(row[claim]["number"].as_f64(), Some(claimed_m));
    }
    for name in [
        "table_1",
        "table_2",
        "differences",
        "by_sequence",
        "particles",
        "runs",
    ] {
        let text = fs::read_to_string(recording.path(&format!("out/{name}.csv"))).unwrap();
        assert!(text.lines().count() > 1, "{name}");
    }
    let markdown = fs::read_to_string(recording.path("out/tables.md")).unwrap();
    assert!(markdown.contains("claimed by the report [m]"), "{markdown}");
}

/// The effective configuration of a run reproduces its trajectory.
fn a_run_is_reproduced_by_its_configuration(recording: &Recording) {
    let folder = "out/runs/street/Fuzzy-MCL/2";
    let again = fpmcl("localize")
        .in_folder(recording.folder())
        .with(format!("{folder}/effective_localization.yml"))
        .with("--backend=cpu")
        .set("result_path", "again/localization.npz");
    again.succeeds();
    let name = "mcl_tum.txt";
    let whole = recording.bytes(&format!("{folder}/{name}"));
    assert!(whole == recording.bytes(&format!("again/{name}")));
    let log = String::from_utf8(recording.bytes(&format!("{folder}/log.txt"))).unwrap();
    assert!(log.contains("triangles"), "{log}");
}

fn the_pages_are_self_contained(recording: &Recording) {
    let of_run = "out/runs/street/Fuzzy-PSO-MCL/1/report.html";
    // The comparison has runs, success, paths and errors, and six pictures of the example run.
    for (page, pictures) in [("out/report.html", 4 + 6), (of_run, 8)] {
        let html = String::from_utf8(recording.bytes(page)).unwrap();
        for word in ["src=\"http", "href=\"http", "<link", "@import"] {
            assert!(!html.contains(word), "{page} has {word}");
        }
        let found = html.matches("src=\"data:image/png;base64,iVBOR").count();
        assert_eq!(found, pictures, "{page}");
    }
    let html = String::from_utf8(recording.bytes("out/report.html")).unwrap();
    let links: Vec<&str> = html.split("href=\"runs/").skip(1).collect();
    assert_eq!(links.len(), 3 * 2 + 2);
    for link in links {
        let (path, _) = link.split_once('"').unwrap();
        assert!(
            recording.path(&format!("out/runs/{path}")).exists(),
            "{path}"
        );
    }
}

/// Records without the other files of their runs, and missing records.
fn the_page_is_made_of_the_available_files(recording: &Recording) {
    let page = || String::from_utf8(recording.bytes("out/report.html")).unwrap();
    let whole = page();
    assert!(!whole.contains("Missing"));
    for text in [
        "Example run: street/Fuzzy-PSO-MCL/1",
        "street/Fuzzy-PSO-MCL/1: Particles from the first frame to the last",
        "numbers of particles, Fuzzy-MCL",
        "build_map.ground_method: &quot;pca&quot;",
        "effective_localization.yml of street/Fuzzy-PSO-MCL/1",
        "(executable ",
    ] {
        assert!(whole.contains(text), "{text}");
    }
    let runs = recording.path("out/runs/street");
    let aside = recording.path("out/runs/aside");
    fs::rename(&runs, &aside).unwrap();
    let keep = |run: &str, names: &[&str]| {
        fs::create_dir_all(runs.join(run).join("plots")).unwrap();
        for name in names {
            fs::copy(aside.join(run).join(name), runs.join(run).join(name)).unwrap();
        }
    };
    keep("PCA-MCL/1", &["run.json"]);
    compare(recording).with("--collect").succeeds();
    let html = page();
    for text in [
        "7 of 8 runs are missing",
        "street/PCA-MCL/2, street/Fuzzy-MCL/1",
        "the result files of the runs are missing",
        "the pictures of the runs are missing",
    ] {
        assert!(html.contains(text), "{text}");
    }
    keep(
        "Fuzzy-MCL/2",
        &["run.json", "localization.npz", "plots/map.png"],
    );
    fs::write(runs.join("Fuzzy-MCL/2/plots/states.png"), "half a").unwrap();
    compare(recording).with("--collect").succeeds();
    let html = page();
    for text in [
        "Example run: street/Fuzzy-MCL/2",
        "Missing or not readable: range_images.png, cannot read",
        "(Fuzzy-MCL seed 2)",
    ] {
        assert!(html.contains(text), "{text}");
    }
    fs::remove_dir_all(&runs).unwrap();
    fs::rename(&aside, &runs).unwrap();
}

#[test]
fn an_outdated_record_is_removed_before_its_run_is_executed_again() {
    let recording = recording();
    let job = || compare(&recording).with("--job=street/Fuzzy-MCL/1");
    job().succeeds();
    assert_eq!(records(&recording).len(), 1);
    let trajectory = "out/runs/street/Fuzzy-MCL/1/mcl_tum.txt";
    let before = recording.bytes(trajectory);

    // With another scan, the run fails after everything but the record is written: there is a
    // folder in the place of a file that its page includes.
    let mut points = recording.scan(0);
    points.truncate(points.len() / 2);
    recording.write_scan(0, &points);
    let text = recording.path("out/runs/street/Fuzzy-MCL/1/effective_evaluation.yml");
    fs::create_dir(&text).unwrap();
    job().fails_with(&["evaluation.yml"]);
    assert_ne!(recording.bytes(trajectory), before);
    assert!(records(&recording).is_empty());
    compare(&recording)
        .with("--collect")
        .fails_with(&["no run is finished"]);
}

#[test]
fn every_run_has_a_command_of_its_own() {
    let recording = recording();
    let listed = compare(&recording)
        .set("seeds", "[1, 5]")
        .with("--list-jobs")
        .succeeds()
        .stdout;
    let jobs: Vec<&str> = listed.lines().collect();
    assert_eq!(jobs.len(), 3 * 2 + 2);
    assert_eq!(jobs.iter().collect::<BTreeSet<_>>().len(), jobs.len());
    for job in &jobs {
        assert!(
            job.contains(
                " compare comparison.yml '--backend=cpu' --set 'seeds=[1, 5]' --job street/"
            ),
            "{job}"
        );
    }
    assert!(!recording.path("out").exists(), "listing executes nothing");
}

#[test]
fn errors_are_reported_before_any_run_is_executed() {
    let recording = recording();
    let fails = |call: Fpmcl, parts: &[&str]| {
        call.fails_with(parts);
    };
    fails(
        compare(&recording).with("--job=street/Fuzzy/1"),
        &["there is no run street/Fuzzy/1", "--list-jobs"],
    );
    fails(
        compare(&recording).with("--collect"),
        &["no run is finished below out"],
    );
    recording.write(
        "comparison.yml",
        &comparison().replace("ground_method: pca", "ground_method: pcb"),
    );
    fails(compare(&recording), &["PCA-MCL", "ground_method", "pcb"]);
    compare(&recording)
        .with("--job=street")
        .rejects_usage_with(&["SEQUENCE/CONFIGURATION/SEED"]);
}
