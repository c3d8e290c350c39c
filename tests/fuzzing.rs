//! Fuzzing of every reader: each input ends in a value or an error, within a second and a gigabyte.
//!
//! An input is a valid file of arbitrary values, of which bytes, lines and numbers are then replaced.
//! It follows from a seed, so that a failure repeats: the message ends in the seed, and
//! `ARBTEST_SEED=SEED cargo test --test fuzzing READER` runs it alone. After an abort, the input is the
//! file that is left in `/dev/shm/fpmcl-fuzzing-*`, or in `target/tmp` where memory is no folder.
//!
//! `FPMCL_FUZZ_INPUTS=1000000 cargo test --release --test fuzzing -- --nocapture` is the long run; it
//! prints a row of a table per reader.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]
#![allow(clippy::print_stdout, reason = "the table of the campaign")]

#[cfg(feature = "bags")]
mod bag_writers;
mod fuzzed;

use std::fs;
use std::path::Path;

use clap::Parser as _;
use fpmcl::geometry::{Pose2, Pose3, TriangleMesh};
use fpmcl::internals::CameraPoses;
use fpmcl::internals::FARTHEST_M;
use fpmcl::internals::app::ComparisonConfig;
use fpmcl::internals::app::LocalizationResults;
use fpmcl::internals::app::settings::{
    BuildMapConfig, CommandConfig, EvaluationConfig, GroundCommandConfig, LocalizationConfig,
    RefinementConfig,
};
use fpmcl::internals::app::{Cli, Command};
use fpmcl::internals::ply;
use fpmcl::internals::scan_files;
use fpmcl::lidar::{PointTiming, Rotation, RotationDirection, Scan};
use fpmcl::recording::{Calibration, Recording};
use fpmcl::recording::{read_labels, write_labels, write_scan};
use fpmcl::recording::{read_times, read_tum, write_kitti, write_times, write_tum};
use fpmcl::simulation::SimulationConfig;

use fuzzed::files;
use fuzzed::harness::{Input, fuzz};

/// The message of an error.
fn text(error: impl std::fmt::Display) -> String {
    format!("{error:#}")
}

/// Number of rows of a text file with rows of numbers.
fn rows_of(bytes: &[u8]) -> usize {
    let text = std::str::from_utf8(bytes).unwrap();
    let rows = text.trim_start_matches('\u{feff}').lines().map(str::trim);
    rows.filter(|row| !row.is_empty() && !row.starts_with('#'))
        .count()
}

/// Checks a pose that was read: a rotation, and a position on Earth.
fn check_pose(pose: &Pose3) {
    let position = pose.translation.vector;
    assert!(position.iter().all(|m| m.abs() <= FARTHEST_M), "{pose}");
    assert!((pose.rotation.norm() - 1.0).abs() < 1e-6, "{pose}");
}

/// Checks that two poses agree up to the digits that are written.
#[track_caller]
fn assert_close(a: &Pose3, b: &Pose3) {
    let (p, q) = (a.translation.vector, b.translation.vector);
    assert!((p - q).amax() <= 1e-5 + 1e-8 * p.amax(), "{a} {b}");
    assert!(a.rotation.angle_to(&b.rotation) < 1e-6, "{a} {b}");
}

#[test]
fn scans() {
    fuzz("scans (.bin)", "000000.bin", files::scan, |file| {
        let scan = read_scan(file)?;
        let bytes_per_point = file.bytes.len().checked_div(scan.len()).unwrap_or(16);
        assert!([16, 20, 24].contains(&bytes_per_point));
        let mut written = Vec::new();
        write_scan(&mut written, &scan).unwrap();
        if bytes_per_point == 16 {
            assert!(written == file.bytes, "other bytes are written");
        }
        Ok(())
    });
}

#[test]
fn scans_pcd() {
    let generate = fuzzed::point_clouds::pcd;
    fuzz("scans (.pcd)", "000000.pcd", generate, |file| {
        read_scan(file).map(drop)
    });
}

#[test]
fn scans_npy() {
    let generate = fuzzed::point_clouds::array;
    fuzz("scans (.npy)", "000000.npy", generate, |file| {
        read_scan(file).map(drop)
    });
}

#[test]
fn scans_ply() {
    let generate = fuzzed::ply::any;
    fuzz("scans (.ply)", "000000.ply", generate, |file| {
        read_scan(file).map(drop)
    });
}

/// Reads the file of a scan; a scan is never larger than its file.
fn read_scan(file: &Input) -> Result<Scan, String> {
    let scan = scan_files::read(file.path).map_err(text)?;
    assert_eq!(scan.points.len(), scan.intensities.len());
    assert!(scan.len() <= file.bytes.len());
    Ok(scan)
}

#[cfg(feature = "bags")]
#[test]
fn bags_mcap() {
    fuzz("bags (.mcap)", "a.mcap", fuzzed::bags::mcap_file, read_bag);
}

#[cfg(feature = "bags")]
#[test]
fn bags_ros1() {
    fuzz("bags (.bag)", "a.bag", fuzzed::bags::ros1_file, read_bag);
}

#[cfg(feature = "bags")]
#[test]
fn bags_database() {
    fuzz("bags (.db3)", "a.db3", fuzzed::bags::database, read_bag);
}

#[cfg(feature = "ros2")]
#[test]
fn received_messages() {
    use fpmcl::internals::received::{
        ReceivedCloud, read_odometry, read_pose_with_deviations, read_transforms,
    };

    fuzz("messages (CDR)", "a.cdr", fuzzed::bags::message, |file| {
        let message = file.bytes;
        let cloud = ReceivedCloud::read(message, 1);
        if let Ok(ReceivedCloud { scan, .. }) = &cloud {
            assert!(scan.points.iter().all(|point| point.is_finite()));
            assert!([0, scan.len()].contains(&scan.times_s.len()));
        }
        let proposal = read_pose_with_deviations(message);
        let proposal = proposal.map(|(pose, deviations)| {
            assert!(deviations.iter().all(|it| *it >= 0.0));
            vec![pose]
        });
        let poses = [read_odometry(message), read_transforms(message), proposal];
        for pose in poses.iter().flatten().flatten() {
            check_pose(&pose.parent_from_child);
        }
        let is_read = cloud.is_ok() || poses.iter().any(Result::is_ok);
        is_read
            .then_some(())
            .ok_or_else(|| "a.cdr is no message".to_owned())
    });
}

/// Reads all scans, poses and transforms of a bag.
#[cfg(feature = "bags")]
fn read_bag(file: &Input) -> Result<(), String> {
    use fpmcl::recording::{Bag, TopicKind};

    let bag = Bag::open(file.path).map_err(text)?;
    for topic in bag.topics_of(TopicKind::Scans) {
        for scan in 0..bag.scan_times(&topic.name).unwrap().len() {
            let scan = bag.read_scan(&topic.name, scan).map_err(text)?;
            assert_eq!(scan.points.len(), scan.intensities.len());
            assert!([0, scan.len()].contains(&scan.times_s.len()));
            assert!([0, scan.len()].contains(&scan.rings.len()));
            assert!(scan.points.iter().all(|point| point.is_finite()));
            assert!(scan.times_s.iter().all(|time_s| time_s.abs() <= 0.51));
        }
    }
    for topic in bag.topics_of(TopicKind::Poses) {
        for pose in bag.poses(&topic.name).map_err(text)? {
            check_pose(&pose.parent_from_child);
        }
    }
    for topic in bag.topics_of(TopicKind::Inertial) {
        bag.imu(&topic.name).map_err(text)?;
    }
    bag.static_transforms().map_err(text)?;
    Ok(())
}

#[test]
fn labels() {
    fuzz("labels (.label)", "000000.label", files::labels, |file| {
        let classes = read_labels(file.path).map_err(text)?;
        assert_eq!(4 * classes.len(), file.bytes.len());
        let mut written = Vec::new();
        write_labels(&mut written, &classes).unwrap();
        assert!(classes == read_labels(&file.write_beside(&written)).unwrap());
        Ok(())
    });
}

#[test]
fn poses() {
    fuzz("KITTI poses", "poses.txt", files::poses, |file| {
        let read = |path: &Path| CameraPoses::read(path).map_err(text);
        let poses = read(file.path)?.world_from_cam0;
        assert_eq!(poses.len(), rows_of(file.bytes));
        poses.iter().for_each(check_pose);
        let identity = Pose3::identity();
        let calibration = Calibration {
            cam0_from_lidar: identity,
        };
        let mut written = Vec::new();
        write_kitti(&mut written, &poses, &identity, &calibration).unwrap();
        let again = read(&file.write_beside(&written)).unwrap().world_from_cam0;
        assert_eq!(poses.len(), again.len());
        poses
            .iter()
            .zip(&again)
            .for_each(|(a, b)| assert_close(a, b));
        Ok(())
    });
}

#[test]
fn tum() {
    fuzz("TUM trajectories", "tum.txt", files::tum, |file| {
        let trajectory = read_tum(file.path).map_err(text)?;
        assert_eq!(trajectory.len(), rows_of(file.bytes));
        let mut written = Vec::new();
        write_tum(&mut written, &trajectory).unwrap();
        let again = read_tum(&file.write_beside(&written)).unwrap();
        assert_eq!(trajectory.len(), again.len());
        for (pose, again) in trajectory.iter().zip(&again) {
            check_pose(&pose.map_from_lidar);
            assert!(pose.time_s.is_finite());
            assert_eq!(pose.frame, again.frame);
            assert!((pose.time_s - again.time_s).abs() < 3e-6);
            assert_close(&pose.map_from_lidar, &again.map_from_lidar);
        }
        Ok(())
    });
}

#[test]
fn times() {
    fuzz("times", "times.txt", files::times, |file| {
        let times_s = read_times(file.path).map_err(text)?;
        assert_eq!(times_s.len(), rows_of(file.bytes));
        let mut written = Vec::new();
        write_times(&mut written, &times_s).unwrap();
        let again = read_times(&file.write_beside(&written)).unwrap();
        assert_eq!(times_s.len(), again.len());
        for (time_s, again) in times_s.iter().zip(&again) {
            assert!((time_s - again).abs() <= 1e-6 * time_s.abs(), "{time_s}");
        }
        Ok(())
    });
}

#[test]
fn calibrations() {
    fuzz("calibrations", "calib.txt", files::calibration, |file| {
        let calibration = Calibration::read(file.path).map_err(text)?;
        check_pose(&calibration.cam0_from_lidar);
        let mut written = Vec::new();
        calibration.write(&mut written).unwrap();
        let again = Calibration::read(&file.write_beside(&written)).unwrap();
        assert_close(&calibration.cam0_from_lidar, &again.cam0_from_lidar);
        Ok(())
    });
}

#[test]
fn recordings() {
    fuzz(
        "recordings (folders)",
        "recording.txt",
        files::recording,
        |file| {
            let folder = file.path.with_file_name("recording");
            write_recording(&folder, file.bytes);
            let opened = Recording::open(&folder).and_then(Recording::with_own_poses);
            let sequence = opened.map_err(|error| format!("recording.txt: {error}"))?;
            let frames = &sequence.frames;
            assert!(!frames.is_empty());
            assert!(
                frames
                    .windows(2)
                    .all(|pair| pair[0].number < pair[1].number)
            );
            for frame in frames {
                assert!(frame.time_s.is_finite());
                let position = frame.map_from_lidar.unwrap().translation.vector;
                assert!(position.iter().all(|m| m.is_finite()));
            }
            for frame in &sequence
                .timed(Some(PointTiming::Rotation(Rotation {
                    start_rad: 0.4,
                    direction: RotationDirection::Clockwise,
                    period_s: 0.1,
                })))
                .compensated_by_poses()
                .frames
            {
                let _ = frame.read();
            }
            Ok(())
        },
    );
}

/// Writes the files of a text of [`files::recording`] into an empty folder.
fn write_recording(folder: &Path, bytes: &[u8]) {
    let _ = fs::remove_dir_all(folder);
    fs::create_dir_all(folder.join("velodyne/sub")).unwrap();
    fs::create_dir_all(folder.join("velodyne/.hidden")).unwrap();
    let text = String::from_utf8_lossy(bytes);
    for part in text.split(files::FILE_MARK) {
        let (name, content) = part.split_once('\n').unwrap_or((part, ""));
        // A changed path must not leave the folder; not every one can be written.
        let is_inside = !name.contains("..") && !name.starts_with('/');
        if is_inside && !name.is_empty() {
            let _ = fs::write(folder.join(name), content);
        }
    }
}

#[test]
fn ply_ascii() {
    fuzz("PLY, text", "ascii.ply", fuzzed::ply::ascii, read_ply);
}

#[test]
fn ply_binary() {
    fuzz("PLY, binary", "binary.ply", fuzzed::ply::binary, read_ply);
}

fn read_ply(file: &Input) -> Result<(), String> {
    let (mesh, path) = ply::read_map(file.path).map_err(text)?;
    let is_on_earth = |m: f32| f64::from(m.abs()) <= FARTHEST_M;
    let vertices = mesh.vertices.len();
    assert!(
        mesh.vertices
            .iter()
            .all(|v| v.to_array().into_iter().all(is_on_earth))
    );
    assert!(!mesh.triangles.is_empty());
    assert!(
        mesh.triangles
            .iter()
            .flatten()
            .all(|&vertex| (vertex as usize) < vertices)
    );
    assert!([0, vertices].contains(&mesh.normals.len()));
    assert!([0, vertices].contains(&mesh.colors.len()));
    assert!(mesh.normals.iter().all(|normal| normal.is_finite()));
    if let Some(path) = &path {
        check_pose(&path.world_from_map);
        path.map_from_lidar.iter().for_each(check_pose);
    }
    ply::write(&file.written(), &mesh, path.as_ref()).unwrap();
    let (again, path_again) = ply::read_map(&file.written()).unwrap();
    assert_eq!(path, path_again);
    let expected = TriangleMesh {
        // Those that were missing are computed.
        normals: if mesh.normals.is_empty() {
            again.normals.clone()
        } else {
            mesh.normals
        },
        colors: if mesh.colors.is_empty() {
            vec![[128; 3]; vertices]
        } else {
            mesh.colors
        },
        ..mesh
    };
    assert_eq!(again, expected);
    Ok(())
}

#[test]
fn results() {
    fuzz(
        "results (.npz)",
        "results.npz",
        fuzzed::npz::results,
        |file| {
            let read = LocalizationResults::read(file.path).map_err(text)?;
            // True poses may be unknown; all others are finite.
            let results = read.with_truth_only().into_owned();
            check_results(&results);
            results.write(&file.written()).unwrap();
            let again = LocalizationResults::read(&file.written()).unwrap();
            check_equal(&results, &again);
            Ok(())
        },
    );
}

fn check_results(results: &LocalizationResults) {
    let rows = results.len();
    // A trajectory has no particles, and nor has a result whose array has lost its name.
    let rows_with_particles = results.particles.len();
    assert!([0, rows].contains(&rows_with_particles));
    assert!(results.frames.windows(2).all(|pair| pair[0] < pair[1]));
    for row in 0..rows_with_particles {
        let particles = results.particles.frame(row).unwrap();
        assert!(particles.len() <= results.particles.capacity());
        assert!(particles.iter().flatten().all(|number| number.is_finite()));
    }
    for poses in poses_of(results).into_iter().flatten() {
        assert_eq!(poses.len(), rows);
        assert!(
            poses
                .iter()
                .all(|pose| pose.to_homogeneous().iter().all(|x| x.is_finite()))
        );
    }
    for matrices in [&results.covariances, &results.refined_covariances]
        .into_iter()
        .flatten()
    {
        assert_eq!(matrices.len(), rows);
        assert!(matrices.iter().flatten().all(|number| number.is_finite()));
    }
    let numbers = [
        &results.times_s,
        &results.runtimes_s,
        &results.refine_runtimes_s,
    ];
    for numbers in numbers.into_iter().flatten() {
        assert_eq!(numbers.len(), rows);
        assert!(numbers.iter().all(|number| number.is_finite()));
    }
    assert!(
        results
            .states
            .as_ref()
            .is_none_or(|states| states.len() == rows)
    );
}

fn poses_of(results: &LocalizationResults) -> [Option<&[Pose2]>; 4] {
    [
        &results.estimates,
        &results.refined,
        &results.ground_truth,
        &results.odometry,
    ]
    .map(Option::as_deref)
}

/// Checks that results agree; poses up to the rounding of their headings.
fn check_equal(written: &LocalizationResults, read: &LocalizationResults) {
    let without_poses = |results: &LocalizationResults| LocalizationResults {
        estimates: None,
        refined: None,
        ground_truth: None,
        odometry: None,
        ..results.clone()
    };
    assert_eq!(without_poses(written), without_poses(read));
    for (written, read) in poses_of(written).into_iter().zip(poses_of(read)) {
        assert_eq!(written.is_some(), read.is_some());
        for (a, b) in written
            .into_iter()
            .flatten()
            .zip(read.into_iter().flatten())
        {
            assert_eq!(a.translation, b.translation);
            assert!(a.rotation.angle_to(&b.rotation).abs() < 1e-12);
        }
    }
}

#[test]
fn configurations() {
    fuzz(
        "configurations (YAML)",
        "own.yml",
        fuzzed::configurations::file,
        |file| {
            // The second byte of the file chooses the command.
            match file.bytes.get(1).map_or(0, |byte| byte % 7) {
                0 => read_config::<BuildMapConfig>(file),
                1 => read_config::<LocalizationConfig>(file),
                2 => read_config::<RefinementConfig>(file),
                3 => read_config::<EvaluationConfig>(file),
                4 => read_config::<SimulationConfig>(file),
                5 => read_config::<ComparisonConfig>(file),
                _ => read_config::<GroundCommandConfig>(file),
            }
        },
    );
}

fn read_config<T: CommandConfig + PartialEq>(file: &Input) -> Result<(), String> {
    let config: T = T::load(Some(file.path), &[]).map_err(text)?;
    check_config(&config, file);
    Ok(())
}

/// Checks that a configuration reads back as it is written; no number equals itself that is none.
fn check_config<T: CommandConfig + PartialEq>(config: &T, file: &Input) {
    let written = config.to_yaml().unwrap();
    let path = file.write_beside(written.as_bytes());
    let again: T = T::load(Some(&path), &[]).unwrap_or_else(|e| panic!("{e}: {written}"));
    assert!(*config == again, "{written}");
}

#[test]
fn settings() {
    fuzz(
        "--set KEY=VALUE",
        "settings.txt",
        fuzzed::configurations::setting,
        |file| {
            let Ok(lines) = std::str::from_utf8(file.bytes) else {
                return Err("settings.txt: no arguments of a command line".to_owned());
            };
            // A long command line takes long.
            let mut lines = lines.split('\n').take(20);
            let command = lines.next().and_then(|line| line.parse().ok()).unwrap_or(0) % 7;
            let outcome = match command {
                0 => set::<BuildMapConfig>("build-map", lines, file),
                1 => set::<LocalizationConfig>("localize", lines, file),
                2 => set::<RefinementConfig>("refine", lines, file),
                3 => set::<EvaluationConfig>("evaluate", lines, file),
                4 => set::<SimulationConfig>("simulate", lines, file),
                5 => set::<ComparisonConfig>("compare", lines, file),
                _ => set::<GroundCommandConfig>("ground", lines, file),
            };
            outcome.map_err(|message| {
                // Of a key that contradicts a default.
                let is_of_defaults = message.starts_with("defaults: ");
                assert!(is_of_defaults || message.contains("--set"), "{message}");
                format!("settings.txt: {message}")
            })
        },
    );
}

/// Applies settings of a command line to the defaults of a command.
fn set<'a, T: CommandConfig + PartialEq>(
    command: &str,
    settings: impl Iterator<Item = &'a str>,
    file: &Input,
) -> Result<(), String> {
    let settings = settings.map(|setting| format!("--set={setting}"));
    let arguments = ["fpmcl", command].map(str::to_owned);
    let cli = Cli::try_parse_from(arguments.into_iter().chain(settings)).map_err(text)?;
    let settings = match cli.command {
        Command::BuildMap(args) => args.run.source.settings,
        Command::Localize(args) => args.run.source.settings,
        Command::Refine(args) => args.run.source.settings,
        Command::Evaluate(args) => args.run.source.settings,
        Command::Simulate(args) => args.source.settings,
        Command::Compare(args) => args.source.settings,
        Command::Ground(args) => args.settings,
        other => panic!("{other:?} has no settings"),
    };
    let config = T::default().with_settings(&settings).map_err(text)?;
    check_config(&config, file);
    Ok(())
}
