//! What tests of the binary share: a recording of a street that is nowhere but in the test,
//! and the program as a sentence: `fpmcl("build-map").with(&file).fails_saying(&["..."])`.

#![allow(dead_code, reason = "each test file uses its own part")]

pub mod picture;

use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use tempfile::TempDir;

/// The binary with a subcommand, run in an empty folder unless told otherwise.
pub fn fpmcl(subcommand: &str) -> Fpmcl {
    let mut command = Command::cargo_bin("fpmcl").unwrap();
    // Help texts must not depend on who asks for them.
    command.env_remove("COLUMNS").env("NO_COLOR", "1");
    if !subcommand.is_empty() {
        command.arg(subcommand);
    }
    Fpmcl {
        command,
        folder: tempfile::tempdir().unwrap(),
        in_folder: None,
    }
}

/// A call of the program.
pub struct Fpmcl {
    command: Command,
    folder: TempDir,
    in_folder: Option<PathBuf>,
}

/// What a call said.
pub struct Said {
    pub stdout: String,
    pub stderr: String,
}

impl Fpmcl {
    /// With an argument.
    pub fn with(mut self, argument: impl AsRef<std::ffi::OsStr>) -> Self {
        self.command.arg(argument);
        self
    }

    /// With one key of the configuration changed.
    pub fn set(self, key: &str, value: &str) -> Self {
        self.with("--set").with(format!("{key}={value}"))
    }

    /// Run in a folder.
    pub fn in_folder(mut self, folder: &Path) -> Self {
        self.in_folder = Some(folder.to_owned());
        self
    }

    /// Runs and expects success.
    #[track_caller]
    pub fn succeeds(self) -> Said {
        self.exits_with(0)
    }

    /// Runs and expects exit code 1 and one message that has all the parts.
    #[track_caller]
    pub fn fails_saying(self, parts: &[&str]) -> Said {
        self.exits_saying(1, parts)
    }

    /// Runs and expects the exit code of wrong usage and a message that has all the parts.
    #[track_caller]
    pub fn misuse_saying(self, parts: &[&str]) -> Said {
        self.exits_saying(2, parts)
    }

    #[track_caller]
    fn exits_saying(self, code: i32, parts: &[&str]) -> Said {
        let said = self.exits_with(code);
        for part in parts {
            assert!(
                said.stderr.contains(part),
                "no `{part}` in: {}",
                said.stderr
            );
        }
        assert_eq!(said.stderr.matches("error: ").count(), 1, "{}", said.stderr);
        assert!(!said.stderr.contains("panicked"), "{}", said.stderr);
        assert_eq!(said.stdout, "");
        said
    }

    /// Runs and expects an exit code.
    #[track_caller]
    pub fn exits_with(mut self, code: i32) -> Said {
        let folder = self.in_folder.as_deref().unwrap_or(self.folder.path());
        let output = self.command.current_dir(folder).output().unwrap();
        let said = Said {
            stdout: String::from_utf8(output.stdout).unwrap(),
            stderr: String::from_utf8(output.stderr).unwrap(),
        };
        assert_eq!(output.status.code(), Some(code), "{}", said.stderr);
        said
    }
}

/// A recording in KITTI layout in a folder of its own, with configurations for it.
///
/// A street 16 m wide and 60 m long between walls, with boxes as houses and cars, scanned by
/// 32 x 360 beams every half metre.
pub struct Recording {
    folder: TempDir,
}

impl Recording {
    /// Scans `frames` frames.
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

    /// The folder; configurations have paths relative to it.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// A path in the recording.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes a text file into the recording.
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

    /// A subcommand with its configuration, run in the folder of the recording.
    pub fn fpmcl(&self, subcommand: &str) -> Fpmcl {
        let call = fpmcl(subcommand).in_folder(self.folder());
        match subcommand {
            "build-map" => call.with("build_map.yml"),
            "localize" => call.with("localization.yml").with("--backend=cpu"),
            "refine" => call.with("refinement.yml").with("--backend=cpu"),
            other => panic!("no configuration for {other}"),
        }
    }

    /// The bytes of a file in the recording.
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
range_image: {height: 32, width: 360, fov_up: 3, fov_down: -25, max_range: 50, min_range: 1}
";

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
range_image: {height: 32, width: 360, fov_up: 3, fov_down: -25, max_range: 50, min_range: 1}
";

/// Axis-aligned boxes in the street: smallest and largest corner [m], z over the road.
const BOXES: [[[f64; 3]; 2]; 5] = [
    [[8.0, 4.0, 0.0], [12.0, 6.0, 1.5]],
    [[18.0, -6.0, 0.0], [22.5, -4.0, 1.6]],
    [[-9.0, -6.5, 0.0], [-5.0, -4.5, 1.4]],
    [[14.0, 6.5, 0.0], [17.0, 8.0, 4.0]],
    [[28.0, -8.0, 0.0], [31.0, -6.0, 3.0]],
];

/// Height of the sensor over the road [m].
const SENSOR_HEIGHT_M: f64 = 1.73;

/// The points that a sensor `ahead_m` along the street sees, in its own frame.
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

/// Where a ray meets the road, the walls at the sides or those at the ends.
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

/// Where a ray enters a box, if it does.
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
