//! Numbers of a configuration that decide an allocation or a loop: beyond their limit they are an error
//! that names key, value and limit, before anything is read or written.

use std::fs::{self, File};
use std::io::Write as _;
use std::path::Path;

use zip::write::SimpleFileOptions;

use crate::common::{self, Recording, fpmcl, json, run};

/// A budget that no stage fits in [GiB].
const TINY: &str = "--memory=0.01";

/// Sets one key of a command and expects the error that names it.
#[track_caller]
fn refuses(command: &str, key: &str, value: &str, limit: &str) {
    let message = format!("{key} is ");
    fpmcl(command)
        .set(key, value)
        .fails_with(&[&message, limit]);
}

#[test]
fn maps_are_bounded() {
    for (key, value, limit) in [
        ("crop_x_m", "10000", "500"),
        ("crop_y_m", "1e30", "500"),
        ("crop_z_m", ".inf", "500"),
        ("voxel_size_m", "1e-9", "0.001"),
        ("simplify_resolution_m", "1e-6", "0.01"),
        ("max_distance_m", "1e-9", "0.001"),
        ("smoothing_iterations", "1000000000", "1000"),
        ("depth", "40", "12"),
        ("local_map_size", "1000000000", "10000"),
        ("num_iterations", "1000000000", "100000"),
        ("ransac_n", "1000000000", "1000"),
        ("poisson.iterations", "1000000000", "1000"),
        ("range_image.width", "65536", "4194304"),
        ("range_image.max_range", "1e30", "1000000"),
        ("normals.spacing_m", "1e9", "10"),
        ("visibility.point_voters", "1000000000", "1000"),
        ("own_car_m", "[-1e30, 1e30, -1, 1]", "x_min"),
    ] {
        let call = fpmcl("build-map").set("range_image.height", "4096");
        let message = format!("{key} is ");
        call.set("range_image.width", "900")
            .set(key, value)
            .fails_with(&[&message, limit]);
    }
}

#[test]
fn localization_is_bounded() {
    for (key, value, limit) in [
        ("num_particles", "1000000000000", "1000000"),
        ("num_reduced", "1000000000000", "1000000"),
        ("range_image.height", "100000", "4096"),
        ("panorama.cell_m", "0.0001", "0.05"),
        ("panorama.columns", "65536", "3600"),
        ("panorama.rows", "100000", "256"),
        ("observation.beams", "1000000000000", "1000000"),
        ("observation.min_beams", "1000000000000", "1000000"),
        ("observation.ray_budget", "1000000000000000", "1000000000"),
        ("tempering.searching_rounds", "1000000000", "100"),
        ("proposal.beams", "1000000000000", "1000000"),
        ("proposal.registration.sectors", "1000000000000", "10000"),
        ("proposal.registration.iterations", "1000000000000", "1000"),
        ("refinement.swarm.candidates", "1000000000000", "10000"),
        ("refinement.swarm.iterations", "1000000000000", "1000"),
        ("refinement.smoothing.iterations", "1000000000", "1000"),
        ("refinement.max_reach_m", "1e300", "1000000"),
        ("start.position_m", "1e300", "1000000"),
        ("sensor_height_m", "1e300", "1000000"),
        ("kld.bin_m", "1e-300", "1000000"),
    ] {
        refuses("localize", key, value, limit);
    }
}

#[test]
fn refinement_and_ground_are_bounded() {
    for (key, value, limit) in [
        ("refinement.swarm.candidates", "1000000000000", "10000"),
        ("refinement.gauss_newton.sectors", "1000000000000", "10000"),
        ("range_image.width", "1000000000000", "65536"),
    ] {
        refuses("refine", key, value, limit);
    }
    refuses("ground", "ransac.num_iterations", "1000000000", "100000");
    refuses("ground", "fuzzy.features.spacing_m", "1e30", "10");
}

#[test]
fn simulations_are_bounded() {
    for (key, value, limit) in [
        ("path", "[{length_m: 1e12}]", "100000"),
        ("motion.speed_m_s", "1e-9", "0.1"),
        ("motion.weaving_m", ".nan", "10"),
        ("street.ground.cell_m", "0.0001", "0.1"),
        ("street.ground.reach_m", "1e9", "500"),
        ("street.lamp_spacing_m", "1e-6", "1000000"),
        ("street.plants_per_100_m", "1e12", "1000"),
        ("street.side_street_spacing_m", "1e-6", "5"),
        ("traffic.oncoming_spacing_m", "1e-6", "1000000"),
        ("traffic.pedestrians_per_100_m", "1e12", "1000"),
        ("scanner.beams", "1000000000000", "4096"),
        ("scanner.azimuth_steps", "65537", "65536"),
        ("odometry.step_noise_m", "1e300", "100"),
        ("given_poses.noise_m", "1e300", "100"),
        ("street.changes.foliage_m", "1e300", "5"),
    ] {
        refuses("simulate", key, value, limit);
    }
    for (value, parts) in [
        ("[{to_m: 1e9}]", ["street.structures.1.to_m is ", "101000"]),
        (
            "[{spacing_m: 1e-9}]",
            ["street.structures.1.spacing_m is ", "10000"],
        ),
    ] {
        let call = fpmcl("simulate").set("street.structures", value);
        call.fails_with(&parts);
    }
}

#[test]
fn a_budget_of_memory_that_does_not_suffice_is_an_error_that_names_what_needs_it_and_the_key() {
    let recording = Recording::street(6);
    let parts = ["would need", "more than the budget of 10.2 MiB", "--memory"];
    let build = || recording.fpmcl("build-map").with(TINY);
    let expected = |what, key| [&parts[..], &[what, key]].concat();
    build().fails_with(&expected("the octree of the surface", "depth"));
    (build().set("range_image.height", "1024")).fails_with(&expected("range images", "width"));
    (build().set("crop_x_m", "500"))
        .fails_with(&expected("the plane around a local map", "crop_x_m"));
    assert!(!recording.path("map.ply").exists());

    recording.fpmcl("build-map").succeeds();
    let localize = || recording.fpmcl("localize").with(TINY);
    let search = localize().set("initialization", "extent");
    (search.set("grid_res", "0.05")).fails_with(&expected("the search grid", "panorama.cell_m"));
    let search = localize().set("initialization", "corridor");
    let search = search
        .set("grid_res", "0.05")
        .set("panorama.columns", "360");
    search.fails_with(&expected("the panoramas", "panorama.rows"));
    assert!(!recording.path("results/localization.npz").exists());

    let street = fpmcl("simulate").with(TINY);
    (street.set("n_scans", "1")).fails_with(&expected("the ground of the street", "path"));
}

#[test]
fn the_particles_of_all_frames_may_exceed_the_budget() {
    let recording = Recording::street(12);
    recording.fpmcl("build-map").succeeds();
    // 16 bytes per particle and frame: 6.4 MB per frame of 10.7 MB.
    let call = recording.fpmcl("localize").with(TINY);
    call.set("numParticles", "400000")
        .set("num_reduced", "400000")
        .set("observation.min_beams", "1")
        .set("observation.ray_budget", "1")
        .set("proposal.compared_beams", "1")
        // One beam confirms no pose.
        .exits_with(3);
}

#[test]
fn a_budget_is_a_positive_number() {
    for value in ["0", "-1", "nan", "much"] {
        let call = fpmcl("build-map").with(format!("--memory={value}"));
        call.rejects_usage_with(&["give a number from 0.01"]);
    }
}

#[test]
fn the_size_of_an_octree_cell_is_reported_and_bounded() {
    let recording = Recording::street(4);
    recording.fpmcl("build-map").succeeds();
    let report = json(&recording.path("map.report.json"));
    let cell_m = report["octree_cell_m"].as_f64().unwrap();
    assert!((0.5..1.2).contains(&cell_m), "{cell_m}");
    let coarse = recording
        .fpmcl("build-map")
        .with("--force")
        .set("depth", "4");
    coarse.fails_with(&[
        "octree cells",
        "more than 1.5 m",
        "raise depth, which is 4",
        "extend over",
    ]);
}

/// Writes an array of zeros: a header that claims a shape, and the number of bytes that follow it.
fn write_array(zip: &mut zip::ZipWriter<File>, name: &str, shape: &str, bytes: usize) {
    let kind = if name == "start_idx" { "<i8" } else { "<f4" };
    let mut header = format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}");
    header += &" ".repeat(63 - (10 + header.len()) % 64);
    header.push('\n');
    zip.start_file(format!("{name}.npy"), SimpleFileOptions::default())
        .unwrap();
    zip.write_all(b"\x93NUMPY\x01\x00").unwrap();
    zip.write_all(&(header.len() as u16).to_le_bytes()).unwrap();
    zip.write_all(header.as_bytes()).unwrap();
    let zeros = vec![0; 1 << 20];
    let mut left = bytes;
    while left > 0 {
        let written = left.min(zeros.len());
        zip.write_all(&zeros[..written]).unwrap();
        left -= written;
    }
}

#[test]
fn archives_that_claim_more_than_they_hold_or_unpack_to_more_than_the_budget_are_refused() {
    let recording = Recording::street(2);
    recording.fpmcl("build-map").succeeds();
    let file = "results/localization.npz";
    fs::create_dir(recording.path("results")).unwrap();
    let no_particles = "(frames, N, 4) with N > 0 is needed";
    for (shape, bytes, message) in [
        ("(1000000000, 0, 4)", 0, no_particles),
        ("(1000000000, 1000000000, 4)", 0, "but there are 0"),
        // 16 MB of zeros are 16 kB.
        (
            "(1, 1000000, 4)",
            16_000_000,
            "more than the budget of 10.2 MiB; give a smaller file, or raise the budget",
        ),
    ] {
        let mut zip = zip::ZipWriter::new(File::create(recording.path(file)).unwrap());
        write_array(&mut zip, "particles", shape, bytes);
        write_array(&mut zip, "start_idx", "()", 8);
        zip.finish().unwrap();
        assert!(recording.bytes(file).len() < 20_000);
        for command in ["info", "evaluate"] {
            let call = fpmcl(command).in_folder(recording.folder()).with(file);
            call.with(TINY).fails_with(&[file, "particles", message]);
        }
        let call = recording.fpmcl("refine").with(TINY);
        call.fails_with(&[file, "particles", message]);
    }
}

#[cfg(unix)]
#[test]
fn files_without_end_are_refused() {
    let recording = Recording::street(2);
    let endless = Path::new("/dev/zero");
    let parts = ["/dev/zero", "no end within 256.0 MiB"];
    let build = || recording.fpmcl("build-map").with("--memory=0.1");
    for key in ["pose_file", "calib_file"] {
        build().set(key, "/dev/zero").fails_with(&parts);
    }
    let call = fpmcl("simulate").with(endless).with("--memory=0.1");
    call.fails_with(&parts);
}

#[test]
fn the_odometry_of_scans_that_all_see_the_same_is_within_the_budget() {
    let recording = Recording::street(1);
    let odometry = |scans: usize, memory: &str| {
        for scan in 1..scans {
            let copy = recording.path(&format!("velodyne/{scan:06}.bin"));
            fs::copy(recording.path("velodyne/000000.bin"), copy).unwrap();
        }
        let call = fpmcl("odometry").in_folder(recording.folder());
        call.with("velodyne")
            .with("--output=out")
            .with("--force")
            .with(format!("--memory={memory}"))
    };
    odometry(8, "0.09").succeeds();
    odometry(320, "0.09").fails_with(&[
        "the adjustment of scans that see the same surfaces would need ",
        "select fewer scans with start_idx and n_scans",
    ]);
    odometry(320, "0.01").fails_with(&["the points of all scans", "n_scans"]);
}

/// Runs where there is a graphics adapter.
#[test]
fn the_batches_of_a_graphics_device_are_within_the_budget() {
    if !common::has_graphics_adapter() {
        common::skips::skipped("there is no graphics adapter");
        return;
    }
    let recording = Recording::street(2);
    recording.fpmcl("build-map").succeeds();
    let call = fpmcl("localize").in_folder(recording.folder());
    let stderr = call
        .with("localization.yml")
        .with("--backend=gpu")
        .with(TINY)
        .exits_with(1)
        .stderr;
    // Drivers may print there, too.
    for part in [
        "the graphics device would need",
        "--backend cpu",
        "--memory",
    ] {
        assert!(stderr.contains(part), "{stderr}");
    }
}

/// Writes a mesh of squares of two triangles without colours, as other programs write them.
fn write_squares(path: &Path, columns: u32, rows: u32, side_m: f32) {
    let mut text = "ply\nformat binary_little_endian 1.0\n".to_owned();
    for (element, count) in [
        ("vertex", (columns + 1) * (rows + 1)),
        ("face", 2 * columns * rows),
    ] {
        text += &format!("element {element} {count}\n");
        text += match element {
            "vertex" => "property float x\nproperty float y\nproperty float z\n",
            _ => "property list uchar int vertex_indices\n",
        };
    }
    let mut bytes = (text + "end_header\n").into_bytes();
    for (row, column) in (0..=rows).flat_map(|row| (0..=columns).map(move |column| (row, column))) {
        let position = [column as f32 * side_m, row as f32 * side_m, 0.0];
        bytes.extend(position.iter().flat_map(|along| along.to_le_bytes()));
    }
    for (row, column) in (0..rows).flat_map(|row| (0..columns).map(move |column| (row, column))) {
        let first = row * (columns + 1) + column;
        let above = first + columns + 1;
        for corners in [[first, first + 1, above + 1], [first, above + 1, above]] {
            bytes.push(3);
            bytes.extend(corners.iter().flat_map(|corner| corner.to_le_bytes()));
        }
    }
    fs::write(path, bytes).unwrap();
}

#[cfg(unix)]
#[test]
fn maps_of_few_triangles_that_cover_much_ground_load_in_little_memory_and_time() {
    const MOST_KIB: u32 = 1_500_000;
    let recording = Recording::street(2);
    for (name, columns, rows, side_m, is_doubted) in [
        ("anywhere.ply", 1, 1, 4_000.0, false),
        ("street.ply", 331, 114, 0.35, false),
        ("millimetres.ply", 331, 114, 350.0, true),
        ("terrain.ply", 40, 40, 100.0, false),
        ("floor.ply", 1, 1, 800.0, false),
        ("plain.ply", 1, 1, 3_000.0, false),
    ] {
        write_squares(&recording.path(name), columns, rows, side_m);
        let binary = assert_cmd::cargo::cargo_bin!("fpmcl");
        let is_anywhere = name == "anywhere.ply";
        let is_near = !is_anywhere;
        let script = format!(
            "ulimit -v {MOST_KIB}; exec \"$0\" localize localization.yml --backend=cpu --memory=2 --force \
             --set map_file={name} --set map_pose_file=null --set map_calib_file=null --set pose_tracking={is_near}"
        );
        let mut call = assert_cmd::Command::new("sh");
        call.args(["-c", &script])
            .arg(binary)
            .current_dir(recording.folder());
        // Less memory of the arenas of threads.
        call.env("RAYON_NUM_THREADS", "2")
            .env("MALLOC_ARENA_MAX", "2");
        let output = call
            .timeout(std::time::Duration::from_secs(60))
            .output()
            .unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        // In millimetres the car is lost, and all of the map is no place to search in.
        let has_result = matches!(output.status.code(), Some(0 | 3));
        let is_lost =
            output.status.code() == Some(1) && stderr.contains("the search grid would need");
        let is_too_large = output.status.code() == Some(1)
            && stderr.contains("the panoramas of the map would need");
        if is_anywhere {
            assert!(is_too_large, "{name}: {stderr}");
        } else {
            assert!(has_result || (is_lost && is_doubted), "{name}: {stderr}");
        }
        let doubt = "are the coordinates in millimetres?";
        assert_eq!(stderr.contains(doubt), is_doubted, "{name}: {stderr}");
        let info = run(recording.folder(), &["info", name]);
        assert_eq!(info.contains(doubt), is_doubted, "{name}: {info}");
        assert!(
            is_anywhere || recording.bytes("results/localization.npz").len() > 1000,
            "{name}"
        );
    }
}
