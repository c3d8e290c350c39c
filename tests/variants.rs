//! Campaign of variants: recordings and maps that differ from what is usual, in one way each.
//!
//! Every call ends with a result or an error of one line, within the memory that it is given, and no frame that is
//! called tracking is off by more than half a metre. A third is tried, with `FPMCL_VARIANTS` set all; `--nocapture` prints
//! the table of `docs/reliability.md`.

#![cfg(unix)]
#![allow(clippy::unwrap_used, reason = "a failing test may panic")]
#![allow(
    clippy::print_stdout,
    reason = "the table is the output of the campaign"
)]

mod common;

use std::ffi::OsStr;
use std::fmt;
use std::fs;
use std::path::{Path, PathBuf};

use assert_cmd::Command;
use fpmcl::geometry::{Pose3, TriangleMesh, Vec3};
use fpmcl::internals::app::LocalizationResults;
use fpmcl::internals::mesh_file;
use fpmcl::localization::State;

use common::run;

/// Number of scans of a drive.
const SCANS: usize = 16;

/// Distance above which a frame is wrong [m].
const WRONG_M: f64 = 0.5;

/// Memory that a call may have [KiB], 3 GiB.
const MEMORY_KIB: usize = 3 << 20;

/// Variants of which every frame is found.
const RIGHT: [(&str, &str); 8] = [
    ("scans", "as recorded"),
    ("scans", "reversed in time"),
    ("scans", "a tenth of the points not a number"),
    ("times", "times in nanoseconds"),
    ("times", "times in milliseconds"),
    ("meshes", "as built, without its path"),
    ("meshes", "normals reversed"),
    ("meshes", "degenerate triangles"),
];

/// Scans of the longest recording, a drive to and fro; more in the campaign.
const LONG: [usize; 2] = [400, 1200];

type Scan = Vec<[f32; 4]>;

/// Name of a variant, its scans, and the poses that can be found.
type Variant = (&'static str, Vec<Scan>, Vec<Option<Pose3>>);

/// How a call ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    /// Every frame that can be localized is tracked where it is.
    Right,
    /// Fewer frames are tracked, none of them wrongly.
    Lost,
    /// An error of one line.
    Refused,
    /// A frame is called tracking, and is wrong.
    Wrong(usize),
    /// A panic, a signal, or more than one error.
    Failed,
}

impl fmt::Display for Outcome {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Right => formatter.pad("right"),
            Self::Lost => formatter.pad("searching or lost"),
            Self::Refused => formatter.pad("error of one line"),
            Self::Wrong(frames) => write!(formatter, "{frames} frames wrong"),
            Self::Failed => formatter.pad("FAILED"),
        }
    }
}

/// The row of a variant.
struct Row {
    class: &'static str,
    variant: String,
    outcome: Outcome,
    /// What was printed, or how far frames are off.
    message: String,
}

/// Two simulated drives, the map of the first, and the poses of the second in it.
struct World {
    folder: tempfile::TempDir,
    scans: Vec<Scan>,
    truth: Vec<Pose3>,
}

impl World {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        for drive in [1, 2] {
            let drive = format!("drive={drive}");
            let scans = format!("n_scans={SCANS}");
            let settings = [
                "output_folder=street",
                &drive,
                &scans,
                "scanner.azimuth_steps=600",
            ];
            let arguments = settings.iter().flat_map(|it| ["--set", it]);
            run(
                folder.path(),
                &[&["simulate"], &*arguments.collect::<Vec<_>>()].concat(),
            );
        }
        let build = [
            "build-map",
            "street/drive_1",
            "--output=map.ply",
            "--set=depth=8",
        ];
        run(
            folder.path(),
            &[&build[..], &["--set=output.plots=False"]].concat(),
        );
        let scan = |row: usize| {
            let bytes = fs::read(
                folder
                    .path()
                    .join(format!("street/drive_2/velodyne/{row:06}.bin")),
            )
            .unwrap();
            let number = |bytes: &[u8]| f32::from_le_bytes(bytes.try_into().unwrap());
            let point = |bytes: &[u8]| [0, 4, 8, 12].map(|start| number(&bytes[start..start + 4]));
            bytes.chunks_exact(16).map(point).collect()
        };
        let scans = (0..SCANS).map(scan).collect();
        let mut world = Self {
            folder,
            scans,
            truth: Vec::new(),
        };
        let plain = world.localize(
            "street/drive_2".as_ref(),
            "map.ply".as_ref(),
            &[
                "--truth=street/drive_2/poses.txt",
                "--calib=street/drive_2/calib.txt",
            ],
        );
        plain.unwrap();
        world.truth = world.results().ground_truth_in_space.unwrap().to_vec();
        world
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn results(&self) -> LocalizationResults {
        LocalizationResults::read(&self.path("out/result.npz")).unwrap()
    }

    /// Calls the program within a limit of memory, and returns what it prints; the error is its message.
    fn call(&self, arguments: &[&OsStr]) -> Result<String, String> {
        let program = assert_cmd::cargo::cargo_bin("fpmcl");
        let limited = format!("ulimit -v {MEMORY_KIB}; exec \"$0\" \"$@\"");
        let mut command = Command::new("sh");
        command.args(["-c", &limited]).arg(program).args(arguments);
        let command = command.current_dir(self.folder.path()).env("NO_COLOR", "1");
        let output = command
            .timeout(std::time::Duration::from_secs(120))
            .output()
            .unwrap();
        match output.status.code() {
            // 3: a result of which less than half is localized.
            Some(0 | 3) => Ok(String::from_utf8_lossy(&output.stdout).into_owned()),
            code => Err(format!(
                "{code:?} {}",
                String::from_utf8_lossy(&output.stderr)
            )),
        }
    }

    fn localize(&self, recording: &OsStr, map: &OsStr, options: &[&str]) -> Result<(), String> {
        let fixed = [
            "--output=out/result.npz",
            "--force",
            "--memory=2",
            "--backend=cpu",
            "--threads=2",
            "--set=output.plots=False",
        ];
        let mut arguments: Vec<&OsStr> =
            vec!["localize".as_ref(), recording, "--map".as_ref(), map];
        arguments.extend(fixed.iter().chain(options).map(OsStr::new));
        self.call(&arguments).map(drop)
    }

    /// Localizes scans, of which `truth` has the poses that can be found.
    fn outcome_of(
        &self,
        scans: &[Scan],
        truth: &[Option<Pose3>],
        options: &[&str],
    ) -> (Outcome, String) {
        self.write(scans);
        let ended = self.localize("variant".as_ref(), "map.ply".as_ref(), options);
        self.judged(ended, truth)
    }

    /// Writes scans as a recording.
    fn write(&self, scans: &[Scan]) {
        let folder = self.path("variant");
        drop(fs::remove_dir_all(&folder));
        fs::create_dir(&folder).unwrap();
        for (row, scan) in scans.iter().enumerate() {
            let bytes: Vec<u8> = scan
                .iter()
                .flatten()
                .flat_map(|it| it.to_le_bytes())
                .collect();
            fs::write(folder.join(format!("{row:06}.bin")), bytes).unwrap();
        }
    }

    /// Localizes the drive to and fro, thinned.
    fn outcome_of_long(&self, frames: usize) -> (Outcome, String) {
        const THINNED: usize = 8;
        let thin = |scan: &Scan| scan.iter().step_by(THINNED).copied().collect();
        self.write(&self.scans.iter().map(thin).collect::<Vec<_>>());
        let round = (0..SCANS).chain((1..SCANS - 1).rev()).cycle();
        let rows: Vec<usize> = round.take(frames).collect();
        for (frame, row) in rows.iter().enumerate().skip(SCANS) {
            let [of_row, link] = [*row, frame].map(|it| format!("variant/{it:06}.bin"));
            fs::hard_link(self.path(&of_row), self.path(&link)).unwrap();
        }
        // A car that turns back at once moves as no times of points explain.
        let compensated = ["--set=motion_compensation=null"];
        let ended = self.localize("variant".as_ref(), "map.ply".as_ref(), &compensated);
        let truth: Vec<_> = rows.iter().map(|row| Some(self.truth[*row])).collect();
        self.judged(ended, &truth)
    }

    fn judged(&self, ended: Result<(), String>, truth: &[Option<Pose3>]) -> (Outcome, String) {
        if let Err(message) = ended {
            return (refusal(&message), message);
        }
        let results = self.results();
        let states = results.states.as_deref().unwrap();
        let found = results.estimates_in_space.as_deref().unwrap();
        let rows = || results.frames.iter().zip(states).zip(found);
        let tracked = || rows().filter(|((_, state), _)| **state == State::Tracking as u8);
        let off_m = |frame: usize, pose: &Pose3| {
            let truth = truth.get(frame).copied().flatten();
            truth.map_or(f64::INFINITY, |truth| {
                (truth.inverse() * pose).translation.vector.norm()
            })
        };
        let distances = tracked().map(|((frame, _), pose)| off_m(*frame, pose));
        let wrong_m: Vec<f64> = distances.filter(|&off_m| off_m > WRONG_M).collect();
        let wrong = wrong_m.len();
        let right = tracked().count() - wrong;
        let known = truth.iter().flatten().count();
        let outcome = if wrong > 0 {
            Outcome::Wrong(wrong)
        } else if known > 0 && right >= known {
            Outcome::Right
        } else {
            Outcome::Lost
        };
        (outcome, format!("off by {wrong_m:.2?} m"))
    }
}

/// The outcome of a call that did not succeed.
fn refusal(message: &str) -> Outcome {
    let is_plain = message.starts_with("Some(1)") && message.matches("error: ").count() == 1;
    if is_plain && !message.contains("panicked") {
        Outcome::Refused
    } else {
        Outcome::Failed
    }
}

/// Whether `info` shows the size of a mesh, and doubts its unit where that is not the metre; without triangles it is a point cloud.
fn is_described(shown: &str, mesh: &TriangleMesh, variant: &str) -> bool {
    if mesh.triangles.is_empty() {
        return shown.contains("a point cloud");
    }
    let bounds = mesh.bounds();
    let ([low, high], size) = ([bounds.min.z, bounds.max.z], bounds.max - bounds.min);
    let extent = format!(
        "{:.0} x {:.0} m, heights {low:.1} to {high:.1} m",
        size.x, size.y
    );
    let triangles = mesh.triangles.len().to_string();
    let has_row = |line: &str| {
        line.split_whitespace()
            .eq(["triangles", triangles.as_str()])
    };
    shown.contains(&extent)
        && shown.lines().any(has_row)
        && shown.contains("are the coordinates in millimetres?") == (variant == "millimetres")
}

/// Semantic variants of the scans: order, units, axes and emptiness.
fn scan_variants(world: &World) -> Vec<Variant> {
    let known: Vec<Option<Pose3>> = world.truth.iter().copied().map(Some).collect();
    let scans = &world.scans;
    let each = |change: fn(&[f32; 4]) -> Option<[f32; 4]>| -> Vec<Scan> {
        let scans = scans.iter();
        scans
            .map(|scan| scan.iter().filter_map(change).collect())
            .collect()
    };
    let reversed = |poses: &[Option<Pose3>]| poses.iter().rev().copied().collect::<Vec<_>>();
    let twice = |row: usize| row / 2;
    let none = vec![None; SCANS];
    let odd_empty = |row: usize| {
        if row % 2 == 1 {
            Scan::new()
        } else {
            scans[row].clone()
        }
    };
    vec![
        ("as recorded", scans.clone(), known.clone()),
        (
            "reversed in time",
            scans.iter().rev().cloned().collect(),
            reversed(&known),
        ),
        (
            "every scan twice",
            (0..2 * SCANS)
                .map(|row| scans[twice(row)].clone())
                .collect(),
            (0..2 * SCANS).map(|row| known[twice(row)]).collect(),
        ),
        (
            "millimetres",
            each(|&[x, y, z, i]| Some([1e3 * x, 1e3 * y, 1e3 * z, i])),
            none.clone(),
        ),
        (
            "ranges times 0.9",
            each(|&[x, y, z, i]| Some([0.9 * x, 0.9 * y, 0.9 * z, i])),
            none.clone(),
        ),
        (
            "ranges times 1.05",
            each(|&[x, y, z, i]| Some([1.05 * x, 1.05 * y, 1.05 * z, i])),
            none.clone(),
        ),
        (
            "y mirrored",
            each(|&[x, y, z, i]| Some([x, -y, z, i])),
            none.clone(),
        ),
        (
            "z downwards",
            each(|&[x, y, z, i]| Some([x, y, -z, i])),
            none.clone(),
        ),
        (
            "x and y swapped",
            each(|&[x, y, z, i]| Some([y, x, z, i])),
            none.clone(),
        ),
        (
            "y and z swapped",
            each(|&[x, y, z, i]| Some([x, z, y, i])),
            none.clone(),
        ),
        (
            "28 degrees of view",
            each(|&[x, y, z, i]| (y.abs() < 0.25 * x).then_some([x, y, z, i])),
            known.clone(),
        ),
        (
            "a tenth of the points not a number",
            each(|&[x, y, z, i]| {
                let is_lost = (100.0 * x).rem_euclid(10.0) < 1.0;
                Some(if is_lost {
                    [f32::NAN, y, z, i]
                } else {
                    [x, y, z, i]
                })
            }),
            known.clone(),
        ),
        (
            "every other scan empty",
            (0..SCANS).map(odd_empty).collect(),
            known.clone(),
        ),
        (
            "scans of one point",
            scans.iter().map(|scan| vec![scan[0]]).collect(),
            none.clone(),
        ),
        ("empty scans", vec![Scan::new(); SCANS], none),
    ]
}

/// Variants of the mesh of a map.
fn mesh_variants(mesh: &TriangleMesh) -> Vec<(&'static str, TriangleMesh, bool)> {
    let with = |change: fn(&mut TriangleMesh)| {
        let mut mesh = mesh.clone();
        change(&mut mesh);
        mesh
    };
    vec![
        ("as built, without its path", mesh.clone(), true),
        (
            "normals reversed",
            with(|mesh| mesh.triangles.iter_mut().for_each(|it| it.swap(1, 2))),
            true,
        ),
        (
            "degenerate triangles",
            with(|mesh| mesh.triangles.extend((0..500).map(|i| [i, i, i + 1]))),
            true,
        ),
        (
            "millimetres",
            with(|mesh| mesh.vertices.iter_mut().for_each(|it| *it *= 1000.0)),
            false,
        ),
        (
            "upside down",
            with(|mesh| {
                mesh.vertices
                    .iter_mut()
                    .for_each(|it| *it = Vec3::new(it.x, -it.y, -it.z))
            }),
            false,
        ),
        (
            "y upwards",
            with(|mesh| {
                mesh.vertices
                    .iter_mut()
                    .for_each(|it| *it = Vec3::new(it.x, it.z, -it.y))
            }),
            false,
        ),
        (
            "a terrain of 4 x 4 km in squares of 100 m",
            with(|mesh| {
                let row = |k: u32| k / 41;
                mesh.vertices = (0..41 * 41)
                    .map(|k| {
                        Vec3::new(
                            100.0 * (k % 41) as f32,
                            100.0 * row(k) as f32,
                            (k % 7) as f32,
                        )
                    })
                    .collect();
                let corners = (0..40 * 41).filter(|k| k % 41 < 40);
                mesh.triangles = corners
                    .flat_map(|k| [[k, k + 1, k + 42], [k, k + 42, k + 41]])
                    .collect();
            }),
            false,
        ),
        (
            "a floor of two triangles",
            with(|mesh| {
                mesh.vertices = [[-50., -50.], [50., -50.], [50., 50.], [-50., 50.]]
                    .map(|[x, y]| Vec3::new(x, y, 0.0))
                    .into();
                mesh.triangles = vec![[0, 1, 2], [0, 2, 3]];
            }),
            false,
        ),
        (
            "coordinates not a number",
            with(|mesh| {
                mesh.vertices
                    .iter_mut()
                    .step_by(10)
                    .for_each(|it| it.x = f32::NAN)
            }),
            false,
        ),
        ("no triangles", with(|mesh| mesh.triangles.clear()), false),
    ]
}

fn write_ply(path: &Path, mesh: &TriangleMesh) {
    let (vertices, triangles) = (&mesh.vertices, &mesh.triangles);
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n",
        vertices.len(),
        triangles.len()
    );
    text.extend(
        vertices
            .iter()
            .map(|it| format!("{} {} {}\n", it.x, it.y, it.z)),
    );
    text.extend(triangles.iter().map(|[a, b, c]| format!("3 {a} {b} {c}\n")));
    fs::write(path, text).unwrap();
}

#[test]
fn no_variant_is_wrong_and_sure_or_ends_in_anything_but_an_error() {
    let is_campaign = std::env::var_os("FPMCL_VARIANTS").is_some();
    let step = if is_campaign { 1 } else { 3 };
    let world = World::new();
    let mut rows = Vec::new();
    let mut add = |class, variant: &str, (outcome, message): (Outcome, String)| {
        rows.push(Row {
            class,
            variant: variant.to_owned(),
            outcome,
            message,
        });
    };
    for (variant, scans, truth) in scan_variants(&world).into_iter().step_by(step) {
        add("scans", variant, world.outcome_of(&scans, &truth, &[]));
    }
    let known: Vec<Option<Pose3>> = world.truth.iter().copied().map(Some).collect();
    let long = LONG[usize::from(is_campaign)];
    let variant = format!("{long} scans, a drive to and fro");
    add("long recordings", &variant, world.outcome_of_long(long));
    for (variant, unit) in [
        ("times in nanoseconds", 1e8),
        ("times in milliseconds", 100.0),
        ("equal times", 0.0),
        ("times backwards", -0.1),
    ] {
        let times = (0..SCANS).map(|row| format!("{}\n", unit * row as f64));
        fs::write(
            world.path("street/drive_2/times.txt"),
            times.collect::<String>(),
        )
        .unwrap();
        let ended = world.localize("street/drive_2".as_ref(), "map.ply".as_ref(), &[]);
        add("times", variant, world.judged(ended, &known));
    }
    fs::remove_file(world.path("street/drive_2/times.txt")).unwrap();
    let mesh = mesh_file::read(&world.path("map.ply")).unwrap().0;
    for (variant, mesh, is_place) in mesh_variants(&mesh).into_iter().step_by(step) {
        write_ply(&world.path("variant.ply"), &mesh);
        let truth = if is_place {
            known.clone()
        } else {
            vec![None; SCANS]
        };
        let ended = world.localize("street/drive_2".as_ref(), "variant.ply".as_ref(), &[]);
        add("meshes", variant, world.judged(ended, &truth));
        let described = world.call(&["info", "variant.ply"].map(OsStr::new));
        let described = match described {
            Ok(shown) if is_described(&shown, &mesh, variant) => (Outcome::Right, shown),
            Ok(shown) => (Outcome::Failed, shown),
            Err(message) => (refusal(&message), message),
        };
        add("meshes, info", variant, described);
    }
    println!("| class | variant | outcome |\n|---|---|---|");
    for row in &rows {
        println!("| {} | {} | {} |", row.class, row.variant, row.outcome);
    }
    let is_bad = |row: &&Row| match row.outcome {
        Outcome::Failed | Outcome::Wrong(_) => true,
        outcome => outcome != Outcome::Right && RIGHT.contains(&(row.class, row.variant.as_str())),
    };
    let bad: Vec<String> = (rows.iter().filter(is_bad))
        .map(|row| {
            let Row {
                class,
                variant,
                outcome,
                message,
            } = row;
            format!("{class}, {variant}: {outcome} {message}")
        })
        .collect();
    assert!(bad.is_empty(), "{}", bad.join("\n"));
}
