//! Positions of a receiver, through the binary: a map with a place on the Earth, and a start in it.

use std::fs;
use std::path::Path;

use fpmcl::georeference::{GeodeticFix, GeodeticFixes, Wgs84};
use fpmcl::recording::{read_fixes, read_tum};
use serde_json::Value;

use crate::common::{Fpmcl, fpmcl, json, run, simulate_two_drives};

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

/// Sentences of NMEA with the positions and standard deviations of fixes.
fn nmea(fixes: &GeodeticFixes) -> String {
    let sentence = |text: String| {
        let checksum = text.bytes().fold(0, |sum, byte| sum ^ byte);
        format!("${text}*{checksum:02X}\r\n")
    };
    let degrees_and_minutes = |degrees: f64, width: usize| {
        let minutes = 60.0 * degrees.abs().fract();
        format!("{:0width$}{minutes:011.8}", degrees.abs().trunc())
    };
    let sentences = |fix: &GeodeticFix| {
        // Within the first minute of a day.
        let time = format!("0000{:05.2}", fix.time_s);
        let at = fix.position;
        let latitude = degrees_and_minutes(at.latitude_deg, 2);
        let longitude = degrees_and_minutes(at.longitude_deg, 3);
        let [south, west] = [at.latitude_deg, at.longitude_deg].map(|it| it < 0.0);
        let (ns, ew) = (if south { 'S' } else { 'N' }, if west { 'W' } else { 'E' });
        let height_m = at.height_m;
        let [horizontal_m, vertical_m] = [fix.horizontal_m, fix.vertical_m].map(Option::unwrap);
        [
            sentence(format!(
                "GPGGA,{time},{latitude},{ns},{longitude},{ew},4,10,0.8,{height_m:.3},M,0.0,M,,"
            )),
            sentence(format!(
                "GPGST,{time},0.1,,,,{horizontal_m:.3},{horizontal_m:.3},{vertical_m:.3}"
            )),
        ]
        .concat()
    };
    fixes.fixes.iter().map(sentences).collect()
}

/// Start in a map by the positions of a file, as `localize` reports it: x, y and the radius [m].
#[track_caller]
fn start_of(stderr: &str, file: &str) -> [f64; 3] {
    let line = stderr
        .lines()
        .find_map(|line| line.split_once(&format!("start by {file}: (")));
    let text = line.unwrap_or_else(|| panic!("no start in {stderr}")).1;
    let words = text.split(|letter: char| !matches!(letter, '0'..='9' | '.' | '-'));
    let numbers: Vec<f64> = words.filter_map(|word| word.parse().ok()).collect();
    assert!(
        text.contains("in any heading") && numbers.len() == 3,
        "{text}"
    );
    [numbers[0], numbers[1], numbers[2]]
}

/// A call in a folder.
fn call(folder: &Path, arguments: &[&str]) -> Fpmcl {
    let call = fpmcl("").in_folder(folder);
    arguments.iter().fold(call, Fpmcl::with)
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
    let localized = call(folder, &[&localize[..], &start, &output].concat()).succeeds();
    let [x_m, y_m, within_m] = start_of(&localized.stderr, "street/drive_2/gnss.csv");
    require_near(&folder.join("out/mcl.geojson"), &fixes(2));
    // It is where the drive begins, at 8 m/s.
    let first = read_tum(&folder.join("out/mcl_tum.txt")).unwrap()[0];
    let at = first.map_from_lidar.translation;
    let driven_m = 9.0 * first.time_s;
    let distance_m = (at.x - x_m).hypot(at.y - y_m);
    assert!(within_m < 1.5, "{within_m}");
    assert!(
        distance_m < within_m + driven_m + 0.1,
        "{distance_m} {driven_m}"
    );

    // The same positions as sentences of NMEA, whose times are those of the day.
    fs::write(folder.join("drive.nmea"), nmea(&fixes(2))).unwrap();
    let arguments = ["--gnss", "drive.nmea", "--output", "nmea/localization.npz"];
    let localized = call(folder, &[&localize[..], &arguments].concat()).succeeds();
    let start = start_of(&localized.stderr, "drive.nmea");
    for (found_m, expected_m) in start.into_iter().zip([x_m, y_m, within_m]) {
        assert!((found_m - expected_m).abs() < 0.15, "{start:?}");
    }
    require_near(&folder.join("nmea/mcl.geojson"), &fixes(2));

    // The refined path and the tiles are at the same place.
    run(folder, &["refine", "out/localization.npz"]);
    require_near(&folder.join("out/refined.geojson"), &fixes(2));
    run(folder, &["export", "map.ply", "--pcd", "tiles"]);
    let metadata = folder.join("tiles/pointcloud_map_metadata.yaml");
    let metadata = fs::read_to_string(metadata).unwrap();
    let comment = metadata
        .lines()
        .find_map(|line| line.strip_prefix("# georeference: "));
    let of_tiles: Value = serde_json::from_str(comment.unwrap()).unwrap();
    for key in [
        "latitude_deg",
        "longitude_deg",
        "height_m",
        "yaw_deg",
        "utm",
    ] {
        assert!(!of_tiles[key].is_null());
        assert_eq!(of_tiles[key], info["georeference"][key], "{key}");
    }
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
    let call = |arguments: &[&str]| call(folder, arguments);
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
