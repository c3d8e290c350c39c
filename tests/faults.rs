//! Faults while commands run: kill -9, Ctrl-C and SIGTERM at random moments, full disks, folders that
//! cannot be written, and two processes on one output. After a fault the same command runs again, and
//! its results must be those of an uninterrupted run, without files left over and without foreign
//! files lost.
//!
//! `FPMCL_FAULT_TRIES=100 cargo test --release --test faults campaign -- --nocapture` is the campaign. It stops each
//! command as often as that and prints a table; `FPMCL_FAULT_COMMANDS=compare,simulate` stops only these. The moments
//! follow from a seed.

#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a failing test may panic")]
#![allow(clippy::print_stdout, reason = "the table of the campaign")]

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::io::Write as _;
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use common::skips::skipped;
use common::{COMPARISON_OF_STREET, Recording, copy_into};
use fpmcl::internals::app::LocalizationResults;
use rand::RngExt as _;
use rayon::prelude::*;

/// A command, and the call that prepares its inputs.
struct Stage {
    name: &'static str,
    arguments: &'static [&'static str],
    /// Commands that run before it, without faults.
    before: &'static [&'static str],
}

const STAGES: &[Stage] = &[
    Stage {
        name: "build-map",
        arguments: &["build-map", "build_map.yml"],
        before: &[],
    },
    Stage {
        name: "build-map without poses",
        arguments: &["build-map", "build_map.yml", "--set=poses=odometry"],
        before: &[],
    },
    Stage {
        name: "build-map onto a map",
        arguments: &[
            "build-map",
            "velodyne",
            "--onto=results/map.ply",
            "--output=results/both.ply",
            "--backend=cpu",
        ],
        before: &["build-map"],
    },
    Stage {
        name: "odometry",
        arguments: &["odometry", "velodyne", "--output=results"],
        before: &[],
    },
    Stage {
        name: "localize",
        arguments: &["localize", "localization.yml", "--backend=cpu"],
        before: &["build-map"],
    },
    Stage {
        name: "refine",
        arguments: &["refine", "refinement.yml", "--backend=cpu"],
        before: &["build-map", "localize"],
    },
    Stage {
        name: "refine a trajectory",
        arguments: &[
            "refine",
            "poses.txt",
            "--calib=calib.txt",
            "--recording=velodyne",
            "--map=results/map.ply",
            "--output=results/refined.npz",
            "--uncertainty=0.5,3",
            "--backend=cpu",
        ],
        before: &["build-map"],
    },
    Stage {
        name: "compare",
        arguments: &["compare", "comparison.yml", "--backend=cpu"],
        before: &[],
    },
    Stage {
        name: "simulate",
        arguments: &["simulate", "simulation.yml"],
        before: &[],
    },
];

const FRAMES: usize = 12;

const COMPARISON: &str = "\
output_folder: results
seeds: [1]
configurations:
- name: Fuzzy-PSO-MCL
  refine: True
  build_map: {visualize: False}
  localization: {plot_loc_results: False}
  refinement: {plot_loc_results: False}
";

const SIMULATION: &str = "\
output_folder: results
n_scans: 8
path:
- {length_m: 40, turn_deg: 30, grade_percent: 3}
scanner: {azimuth_steps: 300}
";

/// Faults by signals.
const SIGNALS: &[(&str, i32)] = &[("SIGKILL", 9), ("SIGINT", 2), ("SIGTERM", 15)];

/// Two seconds from a signal to the end, and two for a machine under load.
const LONGEST_STOP: Duration = Duration::from_secs(4);

/// A command that runs longer than this hangs.
const TIMEOUT: Duration = Duration::from_secs(600);

/// The inputs of a stage, and what its uninterrupted run makes of them.
struct Reference {
    stage: &'static Stage,
    inputs: Recording,
    expected: Contents,
    duration: Duration,
}

/// Files by their paths; the bytes of those that are the same in every run.
type Contents = BTreeMap<PathBuf, Option<Vec<u8>>>;

impl Reference {
    fn new(stage: &'static Stage) -> Self {
        let inputs = Recording::street(FRAMES);
        inputs.write(
            "comparison.yml",
            &format!("{COMPARISON}{COMPARISON_OF_STREET}"),
        );
        inputs.write("simulation.yml", SIMULATION);
        for name in ["build_map.yml", "localization.yml", "refinement.yml"] {
            // All outputs are in one folder.
            let text = fs::read_to_string(inputs.path(name)).unwrap();
            inputs.write(name, &text.replace(": map.ply", ": results/map.ply"));
        }
        // One local map: the ground that a scan does not see below the car is in others.
        for before in stage.before {
            inputs.fpmcl(before).succeeds();
        }
        let map = fs::read_to_string(inputs.path("build_map.yml")).unwrap();
        inputs.write(
            "build_map.yml",
            &format!("{map}local_map_size: 3\noverlap_m: 0.6\n"),
        );
        // Files of the user where the outputs are.
        fs::create_dir_all(inputs.path("results")).unwrap();
        inputs.write("mine.txt", "mine");
        inputs.write("results/mine.yml", "mine: True");
        let copy = Copy::of(inputs.folder());
        let start = Instant::now();
        let ended = run(stage, &copy.path(), &[]);
        let duration = start.elapsed();
        assert!(ended.has_result(), "{}", ended.stderr);
        Self {
            stage,
            inputs,
            expected: contents(&copy.path()),
            duration,
        }
    }

    /// Runs the command again after a fault and notes what is not as expected.
    fn check_rerun(&self, folder: &Path, threads: &str, row: &mut Row) {
        if self.rerun(folder, threads, row) {
            self.check(folder, row);
        }
    }

    /// Runs the command again after a fault; whether there is a result.
    fn rerun(&self, folder: &Path, threads: &str, row: &mut Row) -> bool {
        let mut ended = run(self.stage, folder, &[threads]);
        if ended.stderr.contains("--force") && !ended.has_result() {
            row.partial += 1;
            if !has_partial_result(folder) {
                row.note(format!("the rerun needs --force: {}", ended.stderr.trim()));
            }
            ended = run(self.stage, folder, &[threads, "--force"]);
        }
        if !ended.has_result() {
            row.note(format!("rerun: {}", ended.stderr.trim()));
        }
        ended.has_result()
    }

    /// Compares a folder with that of the uninterrupted run.
    fn check(&self, folder: &Path, row: &mut Row) {
        self.check_files(folder, row, |_| true);
    }

    /// Compares some files of a folder with those of the uninterrupted run.
    fn check_files(&self, folder: &Path, row: &mut Row, compares: impl Fn(&Path) -> bool) {
        let mut differences = self.differences(folder);
        differences.retain(|(path, _)| compares(path));
        if differences.is_empty() {
            row.identical += 1;
        } else {
            let words =
                (differences.iter()).map(|(path, what)| format!("{} {what}", path.display()));
            row.note(words.collect::<Vec<_>>().join(", "));
        }
    }

    /// Files that are not those of the uninterrupted run.
    fn differences(&self, folder: &Path) -> Vec<(PathBuf, &'static str)> {
        let found = contents(folder);
        let mut differences = Vec::new();
        for (path, bytes) in &self.expected {
            match found.get(path) {
                None => differences.push((path.clone(), "is missing")),
                Some(found) if found != bytes => differences.push((path.clone(), "differs")),
                Some(_) => {}
            }
        }
        let known = |path: &&PathBuf| !self.expected.contains_key(*path);
        let left_over = found.keys().filter(known);
        differences.extend(left_over.map(|path| (path.clone(), "is left over")));
        differences
    }
}

/// Whether there is a result with some of the frames.
fn has_partial_result(folder: &Path) -> bool {
    let results = LocalizationResults::read(&folder.join("results/localization.npz"));
    results.is_ok_and(|results| results.selected.is_some_and(|all| results.len() < all))
}

/// A row of the table.
#[derive(Default)]
struct Row {
    fault: &'static str,
    command: &'static str,
    tries: usize,
    identical: usize,
    /// Reruns that asked for `--force`, to replace the finished frames of an interrupted `localize`.
    partial: usize,
    /// Commands that ended before the fault.
    finished: usize,
    /// Errors of one line that said what was wrong.
    errors: usize,
    /// Longest time from a signal to the end.
    longest_stop: Duration,
    wrong: Vec<String>,
}

impl Row {
    fn new(fault: &'static str, stage: &Stage) -> Self {
        Self {
            fault,
            command: stage.name,
            ..Self::default()
        }
    }

    fn note(&mut self, wrong: String) {
        self.wrong.push(wrong);
    }

    /// Notes an error that is not one line.
    fn check_error(&mut self, ended: &Ended) {
        // A command that does not look up is ended by another thread, which logs why.
        let starts = ["error: ", "ERROR interrupted"];
        let is_error = |line: &&str| starts.iter().any(|start| line.starts_with(start));
        let errors = ended.stderr.lines().filter(is_error).count();
        if ended.stderr.contains("panicked") || errors != 1 {
            self.note(format!("{:?}: {}", ended.status, ended.stderr.trim()));
        } else {
            self.errors += 1;
        }
    }

    fn print(&self) {
        println!(
            "| {} | {} | {} | {} | {} | {} | {} | {:.2} | {} |",
            self.fault,
            self.command,
            self.tries,
            self.identical,
            self.finished,
            self.partial,
            self.errors,
            self.longest_stop.as_secs_f64(),
            self.wrong.len(),
        );
        for wrong in &self.wrong {
            println!("wrong: {} {}: {wrong}", self.fault, self.command);
        }
    }
}

fn print_head() {
    println!(
        "| fault | command | tries | identical | finished before it | some frames kept | errors of one line | longest stop [s] | wrong |\n\
         |---|---|---:|---:|---:|---:|---:|---:|---:|"
    );
}

/// A command that ended.
struct Ended {
    status: ExitStatus,
    stderr: String,
}

impl Ended {
    /// Whether the command ended with a result, of which in a map of few scans less than half may be localized.
    fn has_result(&self) -> bool {
        matches!(self.status.code(), Some(0 | 3))
    }
}

fn start(stage: &Stage, folder: &Path, more: &[&str]) -> Child {
    Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"))
        .args(stage.arguments)
        .args(more)
        .current_dir(folder)
        .stdout(Stdio::null())
        .stderr(fs::File::create(stderr_file(folder, 0)).unwrap())
        .spawn()
        .unwrap()
}

/// The file for the messages of a command, next to its folder so that it is no output.
fn stderr_file(folder: &Path, process: u32) -> PathBuf {
    folder.with_extension(format!("stderr{process}"))
}

fn end(mut child: Child, folder: &Path) -> Ended {
    let start = Instant::now();
    let status = loop {
        match child.try_wait().unwrap() {
            Some(status) => break status,
            None if start.elapsed() > TIMEOUT => {
                child.kill().unwrap();
                panic!("the command hangs in {}", folder.display());
            }
            None => std::thread::sleep(Duration::from_millis(2)),
        }
    };
    let stderr = fs::read_to_string(stderr_file(folder, 0)).unwrap();
    Ended { status, stderr }
}

fn run(stage: &Stage, folder: &Path, more: &[&str]) -> Ended {
    end(start(stage, folder, more), folder)
}

/// A copy of a folder in a temporary folder, with space next to it.
struct Copy(tempfile::TempDir);

impl Copy {
    fn of(folder: &Path) -> Self {
        let copy = Self(tempfile::tempdir().unwrap());
        copy_into(folder, &copy.path());
        copy
    }

    fn path(&self) -> PathBuf {
        self.0.path().join("drive")
    }
}

/// All files below a folder.
fn contents(folder: &Path) -> Contents {
    fn add(folder: &Path, root: &Path, found: &mut Contents) {
        for entry in fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                add(&path, root, found);
            } else {
                found.insert(
                    path.strip_prefix(root).unwrap().to_owned(),
                    stable_bytes(&path),
                );
            }
        }
    }
    let mut found = Contents::new();
    add(folder, folder, &mut found);
    found
}

/// The bytes of a file that every run writes alike: none of those with times of computation.
fn stable_bytes(path: &Path) -> Option<Vec<u8>> {
    let name = path.file_name()?.to_str()?;
    if name.ends_with(".npz") {
        // The file of odometry is no result, and it contains times.
        let results = LocalizationResults::read(path).ok()?;
        let results = LocalizationResults {
            runtimes_s: None,
            refine_runtimes_s: None,
            ..results
        };
        // Each command that adds to a file rounds the headings again, to the last bit of an angle.
        return Some(format!("{results:.9?}").into_bytes());
    }
    if name.ends_with(".yml") {
        let text = fs::read_to_string(path).unwrap();
        let is_stable = |line: &&str| !line.trim_start().starts_with("force:");
        return Some(
            text.lines()
                .filter(is_stable)
                .collect::<String>()
                .into_bytes(),
        );
    }
    let is_stable = [".ply", ".txt", ".bin", ".label", ".npy"]
        .iter()
        .any(|end| name.ends_with(end));
    // What a command logs depends on what it finds finished, and tables contain times.
    (is_stable && !["log.txt", "tables.txt"].contains(&name)).then(|| fs::read(path).unwrap())
}

/// Stops a command by signals at random moments and runs it again.
fn stop_at_random_moments(reference: &Reference, tries: usize) -> Vec<Row> {
    let mut rng = fpmcl::internals::stream(14, 0);
    let mut rows: Vec<Row> = (SIGNALS.iter())
        .map(|(name, _)| Row::new(name, reference.stage))
        .collect();
    for number in 0..tries {
        let (name, signal) = SIGNALS[number % SIGNALS.len()];
        let row = &mut rows[number % SIGNALS.len()];
        row.tries += 1;
        let threads = ["--threads=1", "--threads=2"][number / SIGNALS.len() % 2];
        let copy = Copy::of(reference.inputs.folder());
        let moment = reference.duration.mul_f64(1.05 * rng.random::<f64>());
        let child = start(reference.stage, &copy.path(), &[threads]);
        std::thread::sleep(moment);
        let sent = Instant::now();
        let id = child.id().to_string();
        // It may have ended already.
        let _ = Command::new("kill")
            .args(["-s", &name[3..], &id])
            .stderr(Stdio::null())
            .status();
        let ended = end(child, &copy.path());
        let stop = sent.elapsed();
        row.longest_stop = row.longest_stop.max(stop);
        if stop > LONGEST_STOP {
            row.note(format!(
                "it ends {:.1} s after the signal",
                stop.as_secs_f64()
            ));
        }
        if ended.has_result() {
            row.finished += 1;
            reference.check(&copy.path(), row);
            continue;
        }
        let was_stopped = ended.status.signal() == Some(signal) || ended.status.code() == Some(130);
        if !was_stopped {
            row.note(format!("{:?}: {}", ended.status, ended.stderr.trim()));
        } else if ended.status.code() == Some(130) {
            row.check_error(&ended);
        }
        reference.check_rerun(&copy.path(), threads, row);
    }
    rows
}

/// Two processes of one command at the same time: at least one succeeds, the other may be refused.
fn start_twice(reference: &Reference, tries: usize) -> Row {
    let mut row = Row::new("two processes", reference.stage);
    for number in 0..tries {
        row.tries += 1;
        let threads = ["--threads=1", "--threads=2"][number % 2];
        let copy = Copy::of(reference.inputs.folder());
        let first = start(reference.stage, &copy.path(), &[threads]);
        std::thread::sleep(reference.duration.mul_f64(0.1 * (number % 8) as f64));
        let messages = fs::File::create(stderr_file(&copy.path(), 1)).unwrap();
        let second = Command::new(assert_cmd::cargo::cargo_bin!("fpmcl"))
            .args(reference.stage.arguments)
            .arg(threads)
            .current_dir(copy.path())
            .stdout(Stdio::null())
            .stderr(messages)
            .output()
            .unwrap();
        let first = end(first, &copy.path());
        let second = Ended {
            status: second.status,
            stderr: fs::read_to_string(stderr_file(&copy.path(), 1)).unwrap(),
        };
        for ended in [&first, &second] {
            if !ended.has_result() {
                row.check_error(ended);
            }
        }
        if first.has_result() || second.has_result() {
            reference.check(&copy.path(), &mut row);
        } else {
            reference.check_rerun(&copy.path(), threads, &mut row);
        }
    }
    row
}

/// A small disk for the folder `results`, and for the map; needs root.
struct SmallDisk(PathBuf);

impl SmallDisk {
    fn mount(folder: &Path) -> Option<Self> {
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=2m", "tmpfs"])
            .arg(folder)
            .stderr(Stdio::null())
            .status();
        (mounted.is_ok_and(|status| status.success())).then(|| Self(folder.to_owned()))
    }

    fn remount(&self, options: &str) {
        let status = Command::new("mount")
            .args(["-o", options])
            .arg(&self.0)
            .status();
        assert!(status.unwrap().success());
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

/// A command whose folder `results` is on a disk that is full, and then not; `None` without root.
fn fill_the_disk(reference: &Reference) -> Option<Row> {
    let mut row = Row::new("full disk of 2 MB", reference.stage);
    for free_bytes in [0, 5_000, 30_000, 100_000, 250_000] {
        let copy = Copy::of(reference.inputs.folder());
        let results = copy.path().join("results");
        let disk = SmallDisk::mount(&results)?;
        copy_into(&reference.inputs.path("results"), &results);
        let ballast = results.join("ballast");
        fill(&ballast, free_bytes);
        row.tries += 1;
        let ended = run(reference.stage, &copy.path(), &[]);
        match ended.has_result() {
            true => row.finished += 1,
            false => row.check_error(&ended),
        }
        let leftover = contents(&results)
            .keys()
            .find(|path| is_temporary(path))
            .cloned();
        if let Some(path) = leftover {
            row.note(format!("{} is left over", path.display()));
        }
        fs::remove_file(&ballast).unwrap();
        disk.remount("remount,size=64m");
        if ended.has_result() || reference.rerun(&copy.path(), "--threads=2", &mut row) {
            // What the disk had no place for may be missing in a cache until a command needs it.
            let is_cached = |path: &Path| {
                path.components()
                    .any(|part| part.as_os_str() == "map.ply.tiles")
            };
            reference.check_files(&copy.path(), &mut row, |path| !is_cached(path));
        }
    }
    Some(row)
}

/// Writes a file that fills its disk, then takes bytes off its end.
fn fill(path: &Path, free_bytes: u64) {
    let mut file = fs::File::create(path).unwrap();
    while file.write_all(&[1; 4096]).is_ok() {}
    let bytes = file.metadata().unwrap().len();
    file.set_len(bytes.saturating_sub(free_bytes)).unwrap();
}

fn is_temporary(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str());
    name.is_some_and(|name| name.starts_with(".fpmcl-"))
}

/// A command whose folder `results` cannot be written; `None` without root.
fn protect_the_folder(reference: &Reference) -> Option<Row> {
    let mut row = Row::new("read-only folder", reference.stage);
    let copy = Copy::of(reference.inputs.folder());
    let results = copy.path().join("results");
    let disk = SmallDisk::mount(&results)?;
    copy_into(&reference.inputs.path("results"), &results);
    let before = contents(&results);
    disk.remount("remount,ro");
    row.tries += 1;
    let ended = run(reference.stage, &copy.path(), &[]);
    if ended.has_result() {
        row.note("it succeeds".to_owned());
    } else {
        row.check_error(&ended);
    }
    if contents(&results) != before {
        row.note("files have changed".to_owned());
    }
    disk.remount("remount,rw,size=64m");
    reference.check_rerun(&copy.path(), "--threads=2", &mut row);
    Some(row)
}

fn assert_nothing_is_wrong(rows: &[Row]) {
    let wrong: usize = rows.iter().map(|row| row.wrong.len()).sum();
    assert_eq!(wrong, 0, "see the table");
}

#[test]
fn a_command_that_is_stopped_gives_the_same_results_when_it_runs_again() {
    let rows_of = |stage| {
        let reference = Reference::new(stage);
        let mut rows = stop_at_random_moments(&reference, 3);
        rows.push(start_twice(&reference, 1));
        rows
    };
    // Several at a time: a command that waits or is being stopped leaves cores idle.
    let all: Vec<Row> = STAGES.par_iter().flat_map_iter(rows_of).collect();
    print_head();
    all.iter().for_each(Row::print);
    assert_nothing_is_wrong(&all);
}

#[test]
fn campaign() {
    let Ok(tries) = std::env::var("FPMCL_FAULT_TRIES") else {
        skipped("FPMCL_FAULT_TRIES is not set: the campaign takes half an hour");
        return;
    };
    let tries = tries.parse().unwrap();
    let commands = std::env::var("FPMCL_FAULT_COMMANDS").ok();
    let is_chosen = |stage: &&Stage| {
        let names = commands.as_deref().map(|names| names.split(','));
        names.is_none_or(|mut names| names.any(|name| name == stage.name))
    };
    print_head();
    let mut all = Vec::new();
    for stage in STAGES.iter().filter(is_chosen) {
        let reference = Reference::new(stage);
        let mut rows = stop_at_random_moments(&reference, tries);
        rows.push(start_twice(&reference, tries.div_ceil(10)));
        let disks = [fill_the_disk(&reference), protect_the_folder(&reference)];
        for row in disks {
            match row {
                Some(row) => rows.push(row),
                None => skipped(format!("a disk of its own for {} needs root", stage.name)),
            }
        }
        rows.iter().for_each(Row::print);
        all.extend(rows);
    }
    assert_nothing_is_wrong(&all);
}
