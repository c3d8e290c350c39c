//! Shared helpers of the tests of the binary: a procedural recording of a street, and calls such as
//! `fpmcl("build-map").with(&file).fails_with(&["..."])`.

#![allow(dead_code, reason = "each test file uses its own part")]

pub mod picture;
#[path = "../../src/skips_for_tests.rs"]
pub mod skips;

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::thread;
use std::time::{Duration, Instant};

use assert_cmd::Command;
use tempfile::TempDir;

/// A call of the binary with a subcommand, by default in an empty folder.
pub fn fpmcl(subcommand: &str) -> Fpmcl {
    let mut command = Command::cargo_bin("fpmcl").unwrap();
    // Help texts must not depend on the environment.
    command.env_remove("COLUMNS").env("NO_COLOR", "1");
    if !subcommand.is_empty() {
        command.arg(subcommand);
    }
    Fpmcl {
        command,
        folder: tempfile::tempdir().unwrap(),
        in_folder: None,
        may_be_refused: false,
    }
}

/// A call of the binary.
pub struct Fpmcl {
    command: Command,
    folder: TempDir,
    in_folder: Option<PathBuf>,
    /// Whether a result of which less than half is localized is a success.
    may_be_refused: bool,
}

/// The output of a call.
pub struct Output {
    pub stdout: String,
    pub stderr: String,
}

impl Fpmcl {
    /// Adds an argument.
    pub fn with(mut self, argument: impl AsRef<std::ffi::OsStr>) -> Self {
        self.command.arg(argument);
        self
    }

    /// Sets a variable of the environment.
    pub fn environment(mut self, name: &str, value: &str) -> Self {
        self.command.env(name, value);
        self
    }

    /// Overrides a key of the configuration.
    pub fn set(self, key: &str, value: &str) -> Self {
        self.with("--set").with(format!("{key}={value}"))
    }

    /// Sets the working directory.
    pub fn in_folder(mut self, folder: &Path) -> Self {
        self.in_folder = Some(folder.to_owned());
        self
    }

    /// Takes a result of which less than half is localized for a success.
    pub fn may_be_refused(mut self) -> Self {
        self.may_be_refused = true;
        self
    }

    /// Runs the binary and expects success.
    #[track_caller]
    pub fn succeeds(self) -> Output {
        let codes: &[i32] = if self.may_be_refused { &[0, 3] } else { &[0] };
        self.exits_with_one_of(codes)
    }

    /// Runs the binary and expects exit code 1 and one error message that contains all parts.
    #[track_caller]
    pub fn fails_with(self, parts: &[&str]) -> Output {
        self.exits_with_message(1, parts)
    }

    /// Runs the binary and expects the exit code of wrong usage and one error message that contains
    /// all parts.
    #[track_caller]
    pub fn rejects_usage_with(self, parts: &[&str]) -> Output {
        self.exits_with_message(2, parts)
    }

    #[track_caller]
    fn exits_with_message(self, code: i32, parts: &[&str]) -> Output {
        let output = self.exits_with(code);
        let stderr = &output.stderr;
        for part in parts {
            assert!(stderr.contains(part), "no `{part}` in: {stderr}");
        }
        assert_eq!(stderr.matches("error: ").count(), 1, "{stderr}");
        assert!(!stderr.contains("panicked"), "{stderr}");
        assert_eq!(output.stdout, "");
        output
    }

    /// Runs the binary and expects an exit code.
    #[track_caller]
    pub fn exits_with(self, code: i32) -> Output {
        self.exits_with_one_of(&[code])
    }

    #[track_caller]
    fn exits_with_one_of(mut self, codes: &[i32]) -> Output {
        let folder = self.in_folder.as_deref().unwrap_or(self.folder.path());
        let output = self.command.current_dir(folder).output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        let code = output.status.code();
        assert!(
            codes.iter().any(|it| code == Some(*it)),
            "{code:?} {stderr}"
        );
        Output {
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr,
        }
    }
}

/// Runs the binary in a folder, expects success and returns its standard output.
#[track_caller]
pub fn run(folder: &Path, arguments: &[&str]) -> String {
    let call = fpmcl("").in_folder(folder);
    let call = arguments.iter().fold(call, Fpmcl::with);
    call.succeeds().stdout
}

/// Whether the program is built for graphics adapters and finds one.
pub fn has_graphics_adapter() -> bool {
    let machine = run(Path::new("."), &["doctor", "--measure=0"]);
    machine.lines().any(|line| line.starts_with("adapter "))
}

/// Simulates the drives 1 and 2 of a configuration in a folder.
#[track_caller]
pub fn simulate_two_drives(folder: &Path, config: &str) {
    fs::write(folder.join("simulation.yml"), config).unwrap();
    for drive in ["drive=1", "drive=2"] {
        run(folder, &["simulate", "simulation.yml", "--set", drive]);
    }
}

/// A new folder for several tests, in the build folder, since nothing removes it when the program ends. Those that are a day old are
/// removed.
pub fn shared_folder() -> TempDir {
    const DAY: Duration = Duration::from_secs(86_400);
    let parent = Path::new(env!("CARGO_TARGET_TMPDIR")).join("shared");
    fs::create_dir_all(&parent).unwrap();
    for entry in fs::read_dir(&parent).unwrap().flatten() {
        let age = entry
            .metadata()
            .and_then(|it| it.modified()?.elapsed().map_err(io::Error::other));
        if age.is_ok_and(|age| age > DAY) {
            let _removed = fs::remove_dir_all(entry.path());
        }
    }
    tempfile::tempdir_in(parent).unwrap()
}

/// A new folder with a copy of all files below another one.
pub fn copy_of(folder: &Path) -> TempDir {
    let copy = tempfile::tempdir().unwrap();
    copy_into(folder, copy.path());
    copy
}

/// Copies all files below a folder.
pub fn copy_into(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy_into(&path, &target);
        } else {
            fs::copy(&path, &target).unwrap();
        }
    }
}

/// Keys of build-map for drive 1 in the folder `street`.
pub const MAP_OF_DRIVE_1: &str = "\
scan_folder: street/drive_1/velodyne
pose_file: street/drive_1/poses.txt
calib_file: street/drive_1/calib.txt
mesh_file: results/map.ply
";

/// Common keys of localize and refine for drive 2 in the map of drive 1.
pub const DRIVE_2_IN_MAP: &str = "\
map_file: results/map.ply
map_pose_file: street/drive_1/poses.txt
map_calib_file: street/drive_1/calib.txt
scan_folder: street/drive_2/velodyne
pose_file: street/drive_2/poses.txt
calib_file: street/drive_2/calib.txt
odometry: file
odometry_file: street/drive_2/odometry.txt
";

/// Common keys of comparisons on [`Recording::street`]: the base and the first sequence, street.
pub const COMPARISON_OF_STREET: &str = "\
base:
  build_map: {depth: 6, voxel_size: 0.2, displacement_threshold_m: 0, simplify_resolution: 0.5}
  localization: {numParticles: 50, num_reduced: 20}
  refinement: {refinement: {method: swarm, swarm: {iterations: 3}}}
sequences:
- name: street
  build_map:
    scan_folder: velodyne
    pose_file: poses.txt
    calib_file: calib.txt
    range_image: {height: 32, width: 360, min_range: 1}
  localization:
    scan_folder: velodyne
    pose_file: poses.txt
    calib_file: calib.txt
    pose_tracking: True
    odometry: ground_truth
    range_image: {height: 32, width: 360, min_range: 1}
";

/// Keys of the sensor of a simulated drive with 600 measurements of a beam per revolution.
pub const SENSOR: &str = "\
range_image: {height: 64, width: 600, fov_up: 3, fov_down: -25, max_range: 50, min_range: 2}
has_rows: True
own_car_m: [-2.5, 2.7, -1.2, 1.2]
motion_compensation: null
";

/// Path of a file under `config/`.
pub fn config_file(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("config")
        .join(name)
}

/// Folder of a real recording; `None`, with a message, where it is missing.
#[track_caller]
pub fn real_recording(name: &str) -> Option<PathBuf> {
    let folder = std::env::var_os("FPMCL_DATA")
        .map_or_else(
            || Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data"),
            PathBuf::from,
        )
        .join(name);
    if !folder.is_dir() {
        skips::skipped(format!("{} is missing", folder.display()));
        return None;
    }
    Some(folder)
}

/// Reads a JSON file.
#[track_caller]
pub fn json(path: &Path) -> serde_json::Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// The cells of a column of a table such as `frames.csv`.
#[track_caller]
pub fn column(table: &Path, name: &str) -> Vec<String> {
    let text = fs::read_to_string(table).unwrap();
    let mut rows = text.lines().map(|row| row.split(','));
    let place = rows.next().unwrap().position(|title| title == name);
    rows.map(|mut row| row.nth(place.unwrap()).unwrap().to_owned())
        .collect()
}

/// The numbers of a column of a table.
#[track_caller]
pub fn numbers(table: &Path, name: &str) -> Vec<f64> {
    let cells = column(table, name).into_iter();
    cells.map(|cell| cell.parse().unwrap()).collect()
}

/// Number of messages of each topic of a log, up to where it ends.
pub fn messages_in(log: &Path) -> BTreeMap<String, usize> {
    let mut counts = BTreeMap::new();
    let log = fs::read(log).unwrap_or_default();
    let options = mcap::read::Options::IgnoreEndMagic.into();
    let messages = mcap::MessageStream::new_with_options(&log, options);
    for message in messages.into_iter().flatten().map_while(Result::ok) {
        *counts.entry(message.channel.topic.clone()).or_default() += 1;
    }
    counts
}

/// Waits until a log that grows has a number of scans.
#[track_caller]
pub fn wait_for_scans(log: &Path, scans: usize) {
    /// Time limit for a log that does not come.
    const TIMEOUT: Duration = Duration::from_secs(120);
    let begin = Instant::now();
    loop {
        let messages = messages_in(log);
        if messages.get("/scan") == Some(&scans) {
            return;
        }
        assert!(begin.elapsed() < TIMEOUT, "{messages:?}");
        thread::sleep(Duration::from_millis(20));
    }
}

/// Replaces a scan by a named pipe, at which the program waits for the test; returns its content.
#[cfg(unix)]
pub fn replace_by_pipe(scan: &Path) -> Vec<u8> {
    let bytes = fs::read(scan).unwrap();
    fs::remove_file(scan).unwrap();
    let made = std::process::Command::new("mkfifo").arg(scan).status();
    assert!(made.unwrap().success());
    bytes
}

/// An interpreter of Python with modules: that of `FPMCL_PYTHON`, of an environment of `.ci/run`, or of the system.
pub fn python_with(modules: &str, environment: &str) -> Option<PathBuf> {
    let of_ci = format!("target/ci/{environment}/bin/python");
    let of_ci = Path::new(env!("CARGO_MANIFEST_DIR")).join(of_ci);
    let given = std::env::var_os("FPMCL_PYTHON").map(PathBuf::from);
    let found = [given, Some(of_ci), Some("python3".into())];
    let has_modules = |python: &PathBuf| {
        let mut command = std::process::Command::new(python);
        let output = command.arg("-c").arg(format!("import {modules}")).output();
        output.is_ok_and(|output| output.status.success())
    };
    found.into_iter().flatten().find(has_modules)
}

/// A recording in KITTI layout in a temporary folder, with configurations.
///
/// A street 16 m wide and 60 m long between walls, with boxes as houses and cars, scanned with
/// 32 x 360 beams every 0.5 m.
pub struct Recording {
    folder: TempDir,
}

impl Recording {
    /// Simulates `frames` scans.
    pub fn street(frames: usize) -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("velodyne")).unwrap();
        let recording = Self { folder };
        let mut poses = String::new();
        for frame in 0..frames {
            let ahead_m = 0.5 * frame as f64;
            recording.write_scan(frame, &scan(ahead_m));
            poses += &format!("1 0 0 0 0 1 0 0 0 0 1 {ahead_m}\n");
        }
        recording.write("poses.txt", &poses);
        recording.write("calib.txt", "Tr: 0 -1 0 0 0 0 -1 0 1 0 0 0\n");
        recording.write("build_map.yml", BUILD_MAP);
        recording.write("localization.yml", LOCALIZATION);
        recording.write("refinement.yml", REFINEMENT);
        recording
    }

    /// Folder of the recording, to which the paths in the configurations are relative.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Path of a file in the recording.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes a text file of the recording.
    pub fn write(&self, name: &str, text: &str) {
        fs::write(self.path(name), text).unwrap();
    }

    /// Replaces the scan of a frame.
    pub fn write_scan(&self, frame: usize, points: &[[f32; 3]]) {
        let bytes: Vec<u8> = points
            .iter()
            .flat_map(|[x, y, z]| [*x, *y, *z, 0.5])
            .flat_map(f32::to_le_bytes)
            .collect();
        fs::write(self.path(&format!("velodyne/{frame:06}.bin")), bytes).unwrap();
    }

    /// Reads the points of a frame.
    pub fn scan(&self, frame: usize) -> Vec<[f32; 3]> {
        let bytes = fs::read(self.path(&format!("velodyne/{frame:06}.bin"))).unwrap();
        let number = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().unwrap());
        bytes
            .chunks_exact(16)
            .map(|point| [0, 4, 8].map(|start| number(&point[start..start + 4])))
            .collect()
    }

    /// A call of a subcommand with its configuration in the folder of the recording.
    pub fn fpmcl(&self, subcommand: &str) -> Fpmcl {
        let call = fpmcl(subcommand).in_folder(self.folder());
        match subcommand {
            "build-map" => call.with("build_map.yml"),
            "localize" => call.with("localization.yml").with("--backend=cpu"),
            // Maps of few scans have no ground below the car, where nothing can be refined.
            "refine" => {
                let call = call.with("refinement.yml").with("--backend=cpu");
                call.may_be_refused()
            }
            other => panic!("no configuration for {other}"),
        }
    }

    /// Content of a file in the recording.
    pub fn bytes(&self, name: &str) -> Vec<u8> {
        let path = self.path(name);
        fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
    }
}

const BUILD_MAP: &str = "\
scan_folder: velodyne
pose_file: poses.txt
calib_file: calib.txt
mesh_file: map.ply
depth: 6
voxel_size: 0.2
simplify_resolution: 0.5
displacement_threshold_m: 0
check_poses: False
has_rows: True
own_car_m: [-2.5, 2.7, -1.2, 1.2]
motion_compensation: null
range_image: {height: 32, width: 360, fov_up: 3, fov_down: -25, max_range: 50, min_range: 1}
";

/// Drives of few frames are localized in their first one.
const LOCALIZATION: &str = "\
scan_folder: velodyne
map_file: map.ply
map_pose_file: poses.txt
map_calib_file: calib.txt
pose_file: poses.txt
calib_file: calib.txt
result_path: results/localization.npz
numParticles: 50
num_reduced: 20
plot_loc_results: False
pose_tracking: True
start: {position_m: 0.2, heading_rad: 0.02}
tracking_loss: {confirming_updates: 1}
odometry: ground_truth
has_rows: True
own_car_m: [-2.5, 2.7, -1.2, 1.2]
motion_compensation: null
range_image: {height: 32, width: 360, fov_up: 3, fov_down: -25, max_range: 50, min_range: 1}
";

const REFINEMENT: &str = "\
scan_folder: velodyne
map_file: map.ply
map_pose_file: poses.txt
map_calib_file: calib.txt
pose_file: poses.txt
calib_file: calib.txt
result_file: results/localization.npz
plot_loc_results: False
refinement: {swarm: {iterations: 5}}
odometry: ground_truth
has_rows: True
own_car_m: [-2.5, 2.7, -1.2, 1.2]
motion_compensation: null
range_image: {height: 32, width: 360, fov_up: 3, fov_down: -25, max_range: 50, min_range: 1}
";

/// Axis-aligned boxes in the street: minimum and maximum corner, z above the road [m].
const BOXES: [[[f64; 3]; 2]; 5] = [
    [[8.0, 4.0, 0.0], [12.0, 6.0, 1.5]],
    [[18.0, -6.0, 0.0], [22.5, -4.0, 1.6]],
    [[-9.0, -6.5, 0.0], [-5.0, -4.5, 1.4]],
    [[14.0, 6.5, 0.0], [17.0, 8.0, 4.0]],
    [[28.0, -8.0, 0.0], [31.0, -6.0, 3.0]],
];

/// Height of the sensor above the road [m].
const SENSOR_HEIGHT_M: f64 = 1.73;

/// Scan `ahead_m` along the street, in the lidar frame [m].
fn scan(ahead_m: f64) -> Vec<[f32; 3]> {
    let origin = [ahead_m, 0.0, SENSOR_HEIGHT_M];
    let mut points = Vec::new();
    for row in 0..32 {
        let elevation = (3.0 - 28.0 * (f64::from(row) + 0.5) / 32.0).to_radians();
        for column in 0..360 {
            let azimuth = (f64::from(column) + 0.5).to_radians();
            let direction = [
                elevation.cos() * azimuth.cos(),
                elevation.cos() * azimuth.sin(),
                elevation.sin(),
            ];
            let range = BOXES
                .iter()
                .filter_map(|[low, high]| entry(origin, direction, *low, *high))
                .fold(street_range(origin, direction), f64::min);
            if range < 50.0 {
                points.push(direction.map(|axis| (axis * range) as f32));
            }
        }
    }
    points
}

/// Range to the road, the side walls and the end walls [m].
fn street_range(origin: [f64; 3], direction: [f64; 3]) -> f64 {
    let to_plane = |axis: usize, at: f64| {
        let range = (at - origin[axis]) / direction[axis];
        if range > 0.0 { range } else { f64::INFINITY }
    };
    [
        to_plane(2, 0.0),
        to_plane(1, 8.0),
        to_plane(1, -8.0),
        to_plane(0, -20.0),
        to_plane(0, 40.0),
    ]
    .into_iter()
    .fold(f64::INFINITY, f64::min)
}

/// Range at which a ray enters a box [m].
fn entry(origin: [f64; 3], direction: [f64; 3], low: [f64; 3], high: [f64; 3]) -> Option<f64> {
    let (mut near, mut far) = (0.0_f64, f64::INFINITY);
    for axis in 0..3 {
        let first = (low[axis] - origin[axis]) / direction[axis];
        let second = (high[axis] - origin[axis]) / direction[axis];
        near = near.max(first.min(second));
        far = far.min(first.max(second));
    }
    (near < far && near > 0.0).then_some(near)
}
