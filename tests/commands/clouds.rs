//! Files of points and meshes from outside: what `info` and `build-map` take them for.

use std::fs;
use std::path::Path;

use crate::common::{self, fpmcl, run};

/// A street of 40 m between walls: x, y, z and the normal of each point.
fn street() -> Vec<[f32; 6]> {
    let mut points = Vec::new();
    for i in 0..400 {
        let x = 0.1 * i as f32;
        points.extend((-59..60).map(|j| [x, 0.1 * j as f32, 0.0, 0.0, 0.0, 1.0]));
        for side in [-1.0, 1.0] {
            points.extend((1..40).map(|j| [x, 6.0 * side, 0.1 * j as f32, 0.0, -side, 0.0]));
        }
    }
    points
}

fn pcd(points: &[[f32; 6]]) -> Vec<u8> {
    let header = format!(
        "VERSION 0.7\nFIELDS x y z normal_x normal_y normal_z\nSIZE 4 4 4 4 4 4\nTYPE F F F F F F\n\
         COUNT 1 1 1 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA binary\n",
        points.len()
    );
    let numbers = points
        .iter()
        .flatten()
        .flat_map(|number| number.to_le_bytes());
    [header.into_bytes(), numbers.collect()].concat()
}

fn build(folder: &Path, cloud: &str, output: &str) -> common::Fpmcl {
    fpmcl("build-map")
        .in_folder(folder)
        .with(cloud)
        .with(format!("--output={output}"))
        .set("visualize", "False")
}

#[test]
fn normals_of_a_cloud_are_used_if_all_are_unit_vectors() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    let mut points = street();
    fs::write(folder.join("good.pcd"), pcd(&points)).unwrap();
    let output = build(folder, "good.pcd", "good.ply").succeeds();
    assert!(
        output.stderr.contains("normals are those of good.pcd"),
        "{}",
        output.stderr
    );
    points[7][5] = 0.5;
    fs::write(folder.join("bad.pcd"), pcd(&points)).unwrap();
    let output = build(folder, "bad.pcd", "bad.ply").succeeds();
    assert!(
        output
            .stderr
            .contains("normals are estimated, because 1 of"),
        "{}",
        output.stderr
    );

    // The map is no cloud to be meshed again.
    build(folder, "good.ply", "again.ply").fails_with(&["is a mesh already", "--map good.ply"]);
    assert!(!folder.join("again.ply").exists());
    let described = run(folder, &["info", "good.ply"]);
    assert!(described.contains("triangles"), "{described}");
    let described = run(folder, &["info", "good.pcd"]);
    for part in [
        "78800 (x y z)",
        "40 x 12 m, heights 0.0 to 3.9 m",
        "as a point cloud",
    ] {
        assert!(described.contains(part), "{described}");
    }
}

#[test]
fn info_takes_the_topic_and_no_other_key() {
    fpmcl("info")
        .with(".")
        .set("topics", "/a")
        .fails_with(&["unknown key", "topic"]);
}
