//! Positions of a receiver, through the binary: a map with a place on the Earth, and a start in it.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use std::fs;
use std::path::Path;

use common::{fpmcl, json, run, simulate_two_drives};
use fpmcl::georeference::{GeodeticFixes, Wgs84};
use fpmcl::recording::read_fixes;
use serde_json::Value;

/// A street with a bend, and a receiver of 2 cm in the southern hemisphere.
const SIMULATION: &str = "\
output_folder: street
n_scans: 40
path:
- {length_m: 45, turn_deg: 60, grade_percent: 3}
scanner:
  beams: 32
  azimuth_steps: 1000
gnss:
  interval_s: 0.1
  latitude_deg: -33.9
  longitude_deg: 151.2
  horizontal_m: 0.02
  vertical_m: 0.03
  correlation_s: 0.5
  reflected_share: 0
";

/// The largest horizontal and vertical distance of a path as GeoJSON from the positions of the same times [m].
fn distances_m(geojson: &Value, fixes: &GeodeticFixes) -> [f64; 2] {
    let wgs84 = Wgs84::new().unwrap();
    let coordinates = geojson["geometry"]["coordinates"].as_array().unwrap();
    let times_s = geojson["properties"]["times_s"].as_array().unwrap();
    assert_eq!(geojson["geometry"]["type"], "LineString");
    // Sydney.
    assert_eq!(geojson["properties"]["georeference"]["utm"]["number"], 56);
    assert_eq!(coordinates.len(), times_s.len());
    let mut largest_m = [0.0_f64; 2];
    for (coordinate, time_s) in coordinates.iter().zip(times_s) {
        let fix = fixes.near(time_s.as_f64().unwrap(), 0.01).unwrap();
        let [longitude_deg, latitude_deg, height_m] =
            [0, 1, 2].map(|index| coordinate[index].as_f64().unwrap());
        let found = fpmcl::georeference::Geodetic {
            latitude_deg,
            longitude_deg,
            height_m,
        };
        let enu_from_ecef = wgs84.ecef_from_enu(&fix.position).unwrap().inverse();
        let ecef = wgs84.ecef(&found).unwrap();
        let error = enu_from_ecef.transform_point(&ecef.into()).coords;
        largest_m[0] = largest_m[0].max(error.xy().norm());
        largest_m[1] = largest_m[1].max(error.z.abs());
    }
    largest_m
}

fn require_near(geojson: &Path, fixes: &GeodeticFixes) {
    let [horizontal_m, vertical_m] = distances_m(&json(geojson), fixes);
    assert!(
        horizontal_m < 0.15 && vertical_m < 0.2,
        "{horizontal_m} {vertical_m}"
    );
}

#[test]
fn a_drive_in_a_map_on_the_earth_is_where_its_receiver_was() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    simulate_two_drives(folder, SIMULATION);
    let drive = |drive: usize| folder.join(format!("street/drive_{drive}"));
    let fixes = |number| read_fixes(&drive(number).join("gnss.csv")).unwrap();

    // As the receiver is.
    let gnss = "--gnss street/drive_1/gnss.csv --set gnss.errors.correlation_s=0.5";
    let gnss: Vec<&str> = gnss.split(' ').collect();
    let build = ["build-map", "street/drive_1", "--output", "map.ply"];
    run(folder, &[&build[..], &gnss].concat());
    let report = json(&folder.join("map.report.json"));
    let place = &report["georeference"];
    assert_eq!(place["epsg"], 32_756);
    assert_eq!(place["fixes"]["outliers"], 0);
    assert!(place["horizontal_m"].as_f64().unwrap() < 0.2, "{place}");

    // What was written is what is read.
    let info: Value = serde_json::from_str(&run(folder, &["info", "map.ply", "--json"])).unwrap();
    for key in ["easting_m", "northing_m", "yaw_deg", "epsg"] {
        assert_eq!(info["georeference"][key], place[key], "{key}");
    }
    run(folder, &["export", "map.ply", "--geojson", "map.geojson"]);
    let line = &json(&folder.join("map.geojson"))["geometry"]["coordinates"];
    assert!(line.as_array().unwrap().len() > 10);

    // Another drive, from anywhere in the circle of the first position and from any heading.
    let start = ["--gnss", "street/drive_2/gnss.csv"];
    let localize = ["localize", "street/drive_2", "--map", "map.ply"];
    let output = ["--output", "out/localization.npz"];
    run(folder, &[&localize[..], &start, &output].concat());
    require_near(&folder.join("out/mcl.geojson"), &fixes(2));
    run(
        folder,
        &["export", "out/localization.npz", "--geojson", "run.geojson"],
    );
    require_near(&folder.join("run.geojson"), &fixes(2));
    // Models and logs have the place of the map, too.
    for (input, more) in [
        ("map.ply", &["--glb", "map.glb"][..]),
        (
            "out/localization.npz",
            &["--mcap", "run.mcap", "--points", "0"],
        ),
    ] {
        run(folder, &[&["export", input], more].concat());
        let bytes = fs::read(folder.join(more[1])).unwrap();
        let text = String::from_utf8_lossy(&bytes);
        let utm = text.find("georeference").map(|at| &text[at..]);
        let utm = utm.and_then(|text| text.split("\"number\":").nth(1));
        assert!(utm.is_some_and(|text| text.starts_with("56")), "{input}");
    }

    // Poses from the scans are where the receiver was, too.
    let odometry = ["odometry", "street/drive_1", "--output", "poses"];
    run(folder, &[&odometry[..], &gnss].concat());
    require_near(&folder.join("poses/poses.geojson"), &fixes(1));
    assert!(json(&folder.join("poses/report.json"))["georeference"].is_object());
}

#[test]
fn what_is_missing_is_an_error_that_says_what_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    simulate_two_drives(folder, SIMULATION);
    let call = |arguments: &[&str]| {
        let call = fpmcl("").in_folder(folder);
        arguments.iter().fold(call, common::Fpmcl::with)
    };
    run(
        folder,
        &["build-map", "street/drive_1", "--output", "map.ply"],
    );
    let localize = ["localize", "street/drive_2", "--map", "map.ply", "--gnss"];
    call(&[&localize[..], &["street/drive_2/gnss.csv"]].concat())
        .fails_with(&["place of the map", "initial_pose"]);
    call(&["export", "map.ply", "--geojson", "map.geojson"]).fails_with(&["map.ply", "--gnss"]);
    let build = [
        "build-map",
        "street/drive_1",
        "--output",
        "other.ply",
        "--gnss",
    ];
    call(&[&build[..], &["nowhere.csv"]].concat()).fails_with(&["gnss_file", "nowhere.csv"]);
    // Times of another clock.
    let text = fs::read_to_string(folder.join("street/drive_1/gnss.csv")).unwrap();
    let (heading, rows) = text.split_once('\n').unwrap();
    let later: String = rows.lines().map(|row| format!("1700000{row}\n")).collect();
    fs::write(folder.join("later.csv"), format!("{heading}\n{later}")).unwrap();
    call(&[&build[..], &["later.csv"]].concat()).fails_with(&["clock_offset_s", "0 of "]);
}
