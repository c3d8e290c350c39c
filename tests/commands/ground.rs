//! The command `ground` from outside, on scans of simulated streets.

use std::fs;
use std::path::{Path, PathBuf};

use fpmcl::recording::{read_labels, write_labels, write_scan};
use fpmcl::simulation::{LabelledScan, ScannerConfig, slope_scene};
use tempfile::TempDir;

use crate::common::{self, fpmcl};

/// A recording of two labelled scans in front of a slope.
fn recording() -> (TempDir, Vec<LabelledScan>) {
    let folder = tempfile::tempdir().unwrap();
    let scanner = ScannerConfig {
        azimuth_steps: 600,
        ..ScannerConfig::default()
    };
    for name in ["velodyne", "labels"] {
        fs::create_dir(folder.path().join(name)).unwrap();
    }
    let scenes: Vec<LabelledScan> = [3, 4].map(|seed| slope_scene(0.1, &scanner, seed)).into();
    for (number, scene) in scenes.iter().enumerate() {
        let path = |kind: &str| folder.path().join(format!("{kind}/{number:06}"));
        let create = |path: PathBuf| fs::File::create(path).unwrap();
        write_scan(create(path("velodyne").with_extension("bin")), &scene.scan).unwrap();
        write_labels(
            create(path("labels").with_extension("label")),
            &scene.classes,
        )
        .unwrap();
    }
    (folder, scenes)
}

fn coordinates(x: f32, y: f32, z: f32) -> [String; 3] {
    [x, y, z].map(|number| number.to_string())
}

/// Numbers in the row of a method in the table.
fn row(table: &str, method: &str) -> Vec<f64> {
    let line = table.lines().find(|line| line.starts_with(method)).unwrap();
    line[method.len()..]
        .split_whitespace()
        .filter_map(|word| word.parse().ok())
        .collect()
}

#[test]
fn a_decision_is_explained_by_the_rules_that_fired() {
    let (folder, scenes) = recording();
    let scan = folder.path().join("velodyne/000000.bin");
    let points = &scenes[0].scan.points;
    let explanation = |class: u16, min_z_m: f32| {
        let index = (0..points.len())
            .find(|&index| {
                let point = points[index];
                scenes[0].classes[index] == class && point.z > min_z_m && point.length() < 15.0
            })
            .unwrap();
        let [x, y, z] = coordinates(points[index].x, points[index].y, points[index].z);
        let call = fpmcl("ground").with(&scan).with("--explain");
        let text = call.with(x).with(y).with(z).succeeds().stdout;
        assert!(text.contains(&format!("point {index} at ")), "{text}");
        assert!(text.contains(&format!("class {class}")), "{text}");
        for feature in ["slope", "height_variance", "curvature", "height", "relief"] {
            assert!(text.contains(feature), "{text}");
        }
        text
    };
    let road = explanation(fpmcl::simulation::classes::ROAD, -3.0);
    assert!(road.contains(
        "IF height IS level AND slope IS gentle AND curvature IS NOT sharp THEN ground IS high"
    ));
    assert!(
        road.contains("ly ground") && !road.contains("not ground"),
        "{road}"
    );
    let wall = explanation(fpmcl::simulation::classes::BUILDING, 0.0);
    assert!(
        wall.contains("IF relief IS high AND height IS raised THEN ground IS low"),
        "{wall}"
    );
    assert!(wall.contains("definitely not ground"), "{wall}");
}

#[test]
fn labels_points_pictures_and_scores_of_a_recording_are_written() {
    let (folder, scenes) = recording();
    let output = folder.path().join("out");
    let stdout = fpmcl("ground")
        .with(folder.path())
        .set("output_folder", output.to_str().unwrap())
        .succeeds()
        .stdout;
    for (number, scene) in scenes.iter().enumerate() {
        let classes = read_labels(&output.join(format!("labels/{number:06}.label"))).unwrap();
        assert_eq!(classes.len(), scene.scan.len());
        assert!(classes.iter().all(|class| [40, 99].contains(class)));
        let ply = fs::read(output.join(format!("points/{number:06}.ply"))).unwrap();
        let header = format!("element vertex {}\n", scene.scan.len());
        assert!(String::from_utf8_lossy(&ply[..200]).contains(&header));
        // Three coordinates, three color channels and a confidence.
        let end = ply.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        assert_eq!(ply.len() - end, scene.scan.len() * (12 + 3 + 4));
    }
    for name in [
        "scan_000000.png",
        "memberships.png",
        "effective_ground.yml",
        "ground.json",
    ] {
        assert!(output.join(name).is_file(), "{name}");
    }
    for method in [
        "fuzzy",
        "fuzzy, three features",
        "PCA",
        "RANSAC plane",
        "rule of the report",
    ] {
        let numbers = row(&stdout, &format!("{method:<22}"));
        assert_eq!(numbers.len(), 2 * 4 + 2, "{stdout}");
    }
    let f1 = |method: &str| row(&stdout, &format!("{method:<22}"))[2];
    assert!(f1("fuzzy") > 97.0, "{stdout}");
    assert!(f1("fuzzy") > f1("RANSAC plane"), "{stdout}");
}

#[test]
fn the_scores_belong_to_the_written_labels() {
    let (folder, scenes) = recording();
    let output = folder.path().join("out");
    let stdout = fpmcl("ground")
        .with(folder.path())
        .set("output_folder", output.to_str().unwrap())
        .set("plot_step", "0")
        .set("write_plys", "False")
        .succeeds()
        .stdout;
    let mut score = fpmcl::evaluation::GroundScore::default();
    for (number, scene) in scenes.iter().enumerate() {
        let labels = read_labels(&output.join(format!("labels/{number:06}.label"))).unwrap();
        for (index, label) in labels.into_iter().enumerate() {
            let protocol = fpmcl::evaluation::GroundProtocol::PatchworkPlusPlus;
            let z = scene.scan.points[index].z;
            if let Some(truth) = protocol.truth(scene.classes[index], z) {
                score.add(label == 40, truth);
            }
        }
    }
    let printed = row(&stdout, &format!("{:<22}", "fuzzy"))[2];
    assert!(
        (printed - 100.0 * score.f1()).abs() < 0.006,
        "{printed} {score:?}"
    );
    assert!(!output.join("points").exists());
}

#[test]
fn a_single_scan_and_a_folder_without_labels_are_classified_too() {
    let (folder, _) = recording();
    fs::remove_dir_all(folder.path().join("labels")).unwrap();
    for (input, name) in [("velodyne/000001.bin", "one"), ("velodyne", "all")] {
        let output = folder.path().join(name);
        let stdout = fpmcl("ground")
            .with(folder.path().join(input))
            .set("output_folder", output.to_str().unwrap())
            .set("plot_step", "0")
            .succeeds()
            .stdout;
        assert!(output.join("labels/000001.label").is_file());
        assert!(!stdout.contains("precision"), "{stdout}");
    }
}

/// A bag of the scans of a recording, on two topics.
#[cfg(feature = "bags")]
fn write_bag(path: &Path, scenes: &[LabelledScan]) {
    use crate::bag_writers::{Cloud, Kind, Recorded, mcap, point_cloud2};
    let message = |(number, topic): (usize, &'static str)| {
        let time_ns = 1_700_000_000_000_000_000 + 100_000_000 * number as u64;
        let points = scenes[number].scan.points.iter();
        let points: Vec<_> = points.map(|p| ([p.x, p.y, p.z, 0.0], 0, 0.0)).collect();
        Recorded {
            topic,
            message_type: "sensor_msgs/msg/PointCloud2",
            time_ns,
            data: point_cloud2(Kind::CdrLittle, time_ns, "lidar", &Cloud::of(&points)),
        }
    };
    let numbers = (0..scenes.len()).flat_map(|number| [(number, "/front"), (number, "/rear")]);
    let messages: Vec<Recorded> = numbers.map(message).collect();
    let options = ::mcap::WriteOptions::new().compression(None);
    fs::write(path, mcap(options, "cdr", &messages)).unwrap();
}

#[cfg(feature = "bags")]
#[test]
fn scans_of_a_bag_have_the_labels_of_the_same_scans_as_files() {
    let (folder, scenes) = recording();
    let folder = folder.path();
    write_bag(&folder.join("drive.mcap"), &scenes);
    let call = |input: &str| {
        fpmcl("ground")
            .in_folder(folder)
            .with(input)
            .set("output_folder", &input.replace('.', "_"))
            .set("plot_step", "0")
    };
    call("velodyne").succeeds();
    call("drive.mcap").fails_with(&["several topics", "/front", "/rear"]);
    call("drive.mcap").set("topic", "/rear").succeeds();
    let info = |topic: &str| {
        fpmcl("info")
            .in_folder(folder)
            .with("drive.mcap")
            .set("topic", topic)
    };
    info("null").fails_with(&["several topics"]);
    assert!(info("/rear").succeeds().stdout.contains("2, 0 to 1"));
    for number in 0..2 {
        let labels = |output: &str| {
            read_labels(&folder.join(format!("{output}/labels/{number:06}.label"))).unwrap()
        };
        assert_eq!(labels("drive_mcap"), labels("velodyne"));
    }
    let explain = |call: common::Fpmcl| {
        let call = call.set("topic", "/front").with("--explain");
        call.with("9").with("0").with("-1.7")
    };
    explain(call("drive.mcap")).fails_with(&["--explain needs one scan", "n_scans=1"]);
    let one = explain(call("drive.mcap").set("start_idx", "1").set("n_scans", "1"));
    assert!(one.succeeds().stdout.contains("point "));
}

#[test]
fn existing_output_and_true_labels_are_not_overwritten() {
    let (folder, scenes) = recording();
    let call = |output: &Path| {
        fpmcl("ground")
            .with(folder.path())
            .set("output_folder", output.to_str().unwrap())
            .set("plot_step", "0")
            .set("compare", "False")
    };
    let output = folder.path().join("out");
    call(&output).succeeds();
    call(&output).fails_with(&["ground.json exists", "--force", "output_folder"]);
    call(&output).with("--force").succeeds();

    call(folder.path()).fails_with(&["true labels", "choose another output_folder"]);
    let classes = read_labels(&folder.path().join("labels/000000.label")).unwrap();
    assert_eq!(classes, scenes[0].classes);
}

#[test]
fn invalid_input_is_reported_with_a_remedy() {
    let (folder, _) = recording();
    fpmcl("ground").fails_with(&["data/kitti/velodyne"]);
    fpmcl("ground")
        .with("absent.bin")
        .fails_with(&["cannot read", "absent.bin"]);
    fpmcl("ground")
        .with(folder.path())
        .with("--explain")
        .with("1")
        .with("-2")
        .with("-1.7")
        .fails_with(&["--explain needs one scan", ".bin"]);
    fpmcl("ground")
        .with(folder.path())
        .set("fuzzy.rules", "[IF slop IS gentle THEN ground IS high]")
        .fails_with(&["slop", "nearest is `slope`"]);
    fpmcl("ground")
        .with(folder.path())
        .set("ransac.ransac_n", "2")
        .fails_with(&["ransac.ransac_n", "between 3 and 1000"]);

    let labels = folder.path().join("labels/000001.label");
    write_labels(fs::File::create(&labels).unwrap(), &[40; 7]).unwrap();
    fpmcl("ground")
        .with(folder.path())
        .fails_with(&["000001.label has 7 labels", "label_folder"]);
}
