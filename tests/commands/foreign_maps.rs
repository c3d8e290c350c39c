//! Maps that others made: a mesh without colours and without a mapping path as PLY, OBJ or STL.

use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use fpmcl::geometry::{StampedPose, TriangleMesh, pose2_from_pose3};
use fpmcl::internals::ply;
use fpmcl::map::{Map, MapOptions};
use fpmcl::recording::PoseTrack;
use fpmcl::recording::write_tum;
use fpmcl::rendering::Backend;

use crate::common::{SENSOR, fpmcl, json, run, simulate_two_drives};

const SIMULATION: &str = "\
output_folder: street
n_scans: 8
path:
- {length_m: 40, turn_deg: 30, grade_percent: 5}
scanner: {azimuth_steps: 600}
";

/// Keys of localize for drive 2, whose truth is in the frame of the mesh.
const LOCALIZATION: &str = "\
scan_folder: street/drive_2/velodyne
pose_file: truth.txt
calib_file: null
odometry: ground_truth
initialization: extent
numParticles: 1000
plot_loc_results: False
";

fn obj(mesh: &TriangleMesh) -> String {
    let mut text = "o street\n".to_owned();
    for [x, y, z] in mesh.vertices.iter().map(|vertex| vertex.to_array()) {
        writeln!(text, "v {x} {y} {z}").unwrap();
    }
    for (index, [a, b, c]) in mesh.triangles.iter().enumerate() {
        // Windings of either sense, indices of either sign.
        let count = mesh.vertices.len();
        match index % 2 {
            0 => writeln!(text, "f {}/1 {}/1 {}/1", a + 1, b + 1, c + 1).unwrap(),
            _ => {
                let [a, b, c] = [a, b, c].map(|&vertex| count - vertex as usize);
                writeln!(text, "f -{a} -{c} -{b}").unwrap();
            }
        }
    }
    text
}

fn stl(mesh: &TriangleMesh) -> Vec<u8> {
    let mut bytes = vec![0; 80];
    // With a triangle without area.
    bytes.extend((mesh.triangles.len() as u32 + 1).to_le_bytes());
    let degenerate = [mesh.corners(0)[0]; 3];
    let triangles = (0..mesh.triangles.len()).map(|triangle| mesh.corners(triangle));
    for corners in triangles.chain([degenerate]) {
        bytes.extend([0; 12]);
        let numbers = corners.iter().flat_map(|corner| corner.to_array());
        bytes.extend(numbers.flat_map(f32::to_le_bytes));
        bytes.extend([0; 2]);
    }
    bytes
}

/// Writes the truth of drive 2 in the frame of the mesh, that of the first pose of drive 1; returns it.
fn truth_in_map(folder: &Path) -> Vec<StampedPose> {
    let drive = |number: u32| {
        let file = |name| folder.join(format!("street/drive_{number}/{name}"));
        PoseTrack::read(&file("poses.txt"), Some(&file("calib.txt"))).unwrap()
    };
    let (first, second) = (drive(1), drive(2));
    let map_from_second = first.world_from_map.inverse() * second.world_from_map;
    let poses = second.map_from_lidar.into_iter().enumerate();
    let truth: Vec<StampedPose> = poses
        .map(|(frame, pose)| StampedPose {
            frame,
            time_s: 0.1 * frame as f64,
            map_from_lidar: map_from_second * pose,
        })
        .collect();
    write_tum(fs::File::create(folder.join("truth.txt")).unwrap(), &truth).unwrap();
    truth
}

#[test]
fn a_drive_is_localized_in_a_mesh_of_any_format_without_colors_and_path() {
    let temporary = tempfile::tempdir().unwrap();
    let folder = temporary.path();
    simulate_two_drives(folder, SIMULATION);
    let truth = truth_in_map(folder);
    let mesh = ply::read(&folder.join("street/drive_1/street.ply")).unwrap();
    fs::write(folder.join("street.obj"), obj(&mesh)).unwrap();
    fs::write(folder.join("street.STL"), stl(&mesh)).unwrap();
    fs::write(
        folder.join("localization.yml"),
        format!("{LOCALIZATION}{SENSOR}"),
    )
    .unwrap();

    let options = MapOptions {
        backend: Backend::Cpu,
        ..MapOptions::default()
    };
    let names = ["street/drive_1/street.ply", "street.obj", "street.STL"];
    let maps = names.map(|name| Map::load(&folder.join(name), &options).unwrap());
    for map in &maps {
        assert_eq!(map.tiles, maps[0].tiles);
        for pose in &truth {
            let planar = pose2_from_pose3(&pose.map_from_lidar);
            let patch = map.ground.patch_under(&planar, None).unwrap().unwrap();
            let of_ply = maps[0].ground.patch_under(&planar, None).unwrap().unwrap();
            assert!((patch.height_m - of_ply.height_m).abs() < 1e-4);
            let height_m = patch.attitude_of(&pose.map_from_lidar).height_m;
            assert!((height_m - 1.73).abs() < 0.06, "{height_m}");
        }
    }

    for name in &names[1..] {
        let result = format!("result_path={name}.result/localization.npz");
        let map = format!("map_file={name}");
        let settings = ["--set", &map, "--set", &result, "--backend=cpu"];
        run(
            folder,
            &[&["localize", "localization.yml"], &settings[..]].concat(),
        );
        let report = json(&folder.join(format!("{name}.result/report.json")));
        let rmse_m = &report["mcl"]["metrics"]["position_m"]["rmse"];
        assert!(rmse_m.as_f64().unwrap() < 0.15, "{rmse_m}");
    }
}

#[test]
fn a_mesh_that_cannot_be_a_map_is_an_error_with_its_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
    write(
        "wall.obj",
        "v 0 0 0\nv 0 9 0\nv 0 9 9\nv 0 0 9\nf 1 2 3 4\n",
    );
    write(
        "y_up.obj",
        "v 0 0 0\nv 9 0 0\nv 9 0 9\nv 0 0 9\nf 1 2 3 4\n",
    );
    write("damaged.obj", "v 0 0\n");
    write("short.stl", "solid\n");
    write("map.txt", "text");
    fs::create_dir(folder.path().join("velodyne")).unwrap();
    write("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n");
    write(
        "localization.yml",
        "scan_folder: velodyne\npose_file: poses.txt\ncalib_file: null\n",
    );
    for (name, parts) in [
        (
            "wall.obj",
            &["wall.obj", "no ground", "the z axis of a map points up"][..],
        ),
        (
            "y_up.obj",
            &[
                "y_up.obj",
                "no ground",
                "if its y axis pointed up, it would have 8",
            ],
        ),
        ("damaged.obj", &["damaged.obj", "line 1", "x, y and z"]),
        ("short.stl", &["short.stl", "no triangles"]),
        ("map.txt", &["map.txt", ".ply, .obj or .stl"]),
    ] {
        let call = fpmcl("localize")
            .with("localization.yml")
            .with("--backend=cpu");
        call.in_folder(folder.path())
            .set("map_file", name)
            .fails_with(parts);
    }
}
