use std::fs::{self, File};
use std::io::Write as _;
use std::path::Path;

use approx::assert_relative_eq;
use nalgebra::Matrix3;
use npyz::{DType, NpyFile, WriterBuilder as _};
use zip::write::SimpleFileOptions;

use super::localization_results::columns;
use super::npz_writer::NpzWriter;
use super::{Column, LocalizationResults, ParticleLog, RowLog};
use crate::geometry::{Pose2, Pose3};

fn results(frames: impl Iterator<Item = usize>) -> LocalizationResults {
    let frames: Vec<usize> = frames.collect();
    let mut particles = ParticleLog::new(5, Path::new("."));
    for row in 0..frames.len() {
        // The second particle of each frame is at the origin and has no weight.
        let frame = [[row as f32, 1.0, 2.0, 0.5], [0.0; 4], [3.0, 4.0, 5.0, 0.5]];
        particles.push_frame(&frame).unwrap();
    }
    let poses = |offset: f64| {
        let pose = |&frame: &usize| Pose2::new([frame as f64, offset].into(), 3.0 - offset);
        Some(frames.iter().map(pose).collect())
    };
    // Quaternions of exactly unit length are read back bit by bit.
    let in_space = |height: f64| {
        let pose = |&frame: &usize| Pose3::translation(frame as f64, 0.5, height);
        Some(frames.iter().map(pose).collect())
    };
    let numbers = |scale: f64| Some(frames.iter().map(|&f| scale * f as f64).collect());
    let matrix = |&frame: &usize| Matrix3::from_diagonal_element(1.0 + frame as f64);
    // Of 0 to 3 points.
    let mut outlines = RowLog::in_folder(Path::new("."));
    for &frame in &frames {
        let points = (0..frame % 4).map(|k| [-100 * k as i16, frame as i16]);
        outlines.push(&points.collect::<Vec<_>>()).unwrap();
    }
    LocalizationResults {
        particles,
        estimates: poses(0.1),
        refined: poses(0.2),
        ground_truth: poses(0.3),
        estimates_in_space: in_space(0.1),
        refined_in_space: in_space(0.2),
        ground_truth_in_space: in_space(0.3),
        odometry: poses(0.4),
        covariances: Some(frames.iter().map(matrix).collect()),
        refined_covariances: Some(frames.iter().map(|frame| 0.5 * matrix(frame)).collect()),
        times_s: numbers(0.1),
        runtimes_s: numbers(0.01),
        refine_runtimes_s: numbers(0.02),
        agreements: numbers(0.001),
        places: numbers(1.0),
        states: Some(frames.iter().map(|&frame| frame as u8 % 3).collect()),
        trajectory_in_space: in_space(0.4),
        trajectory_states: Some(frames.iter().map(|_| 1).collect()),
        refined_states: Some(frames.iter().map(|&frame| frame as u8 % 2).collect()),
        refinement_costs_m: Some(frames.iter().map(|&f| [f as f64, -1.0]).collect()),
        refinement_agreements: Some(frames.iter().map(|&f| [0.5, f as f64]).collect()),
        scan_outlines: Some(outlines),
        selected: Some(40),
        times_are_assumed: true,
        frames: frames.into(),
    }
}

fn assert_same(a: &LocalizationResults, b: &LocalizationResults) {
    let poses = |results: &LocalizationResults| -> Vec<Pose2> {
        [
            &results.estimates,
            &results.refined,
            &results.ground_truth,
            &results.odometry,
        ]
        .into_iter()
        .flat_map(|poses| poses.as_ref().unwrap().to_vec())
        .collect()
    };
    for (a, b) in poses(a).iter().zip(&poses(b)) {
        assert_relative_eq!(a, b, epsilon = 1e-15);
    }
    let without_poses = |results: &LocalizationResults| LocalizationResults {
        estimates: None,
        refined: None,
        ground_truth: None,
        odometry: None,
        ..results.clone()
    };
    assert_eq!(without_poses(a), without_poses(b));
}

#[test]
fn results_are_read_back_from_the_start_from_later_and_with_gaps() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    for written in [
        results(0..4),
        results(7..11),
        results((1..20).step_by(2)),
        results(0..0),
    ] {
        written.write(&path).unwrap();
        assert_same(&LocalizationResults::read(&path).unwrap(), &written);
    }
}

#[test]
fn arrays_have_the_shapes_and_types_of_range_mcl() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    results(2..4).write(&path).unwrap();
    let mut archive = zip::ZipArchive::new(File::open(&path).unwrap()).unwrap();
    let particles = NpyFile::new(archive.by_name("particles.npy").unwrap()).unwrap();
    assert_eq!(particles.shape(), [4, 5, 4]);
    let particles: Vec<f32> = particles.into_vec().unwrap();
    assert!(particles[..2 * 5 * 4].iter().all(|&x| x == 0.0));
    assert_eq!(particles[3 * 5 * 4], 1.0);
    for (name, number) in [("start_idx.npy", 2), ("numParticles.npy", 5)] {
        let scalar = NpyFile::new(archive.by_name(name).unwrap()).unwrap();
        assert!(scalar.shape().is_empty());
        assert_eq!(scalar.into_vec::<i64>().unwrap(), [number]);
    }
}

#[test]
fn the_same_results_give_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let (first, second) = (folder.path().join("a.npz"), folder.path().join("b.npz"));
    results(2..4).write(&first).unwrap();
    results(2..4).write(&second).unwrap();
    assert_eq!(fs::read(&first).unwrap(), fs::read(&second).unwrap());
}

#[test]
fn an_array_whose_numbers_are_not_as_many_as_its_shape_has_is_an_error() {
    let write = |count: usize| {
        let mut npy = Vec::new();
        let numbers = (0..count).map(|number| number as f64);
        super::npz::write_npy(&mut npy, &[100_000, 2], numbers).map(|()| npy)
    };
    let file = NpyFile::new(&*write(200_000).unwrap())
        .unwrap()
        .into_vec::<f64>();
    assert!(file.unwrap().into_iter().eq((0..200_000).map(f64::from)));
    for count in [0, 199_999, 200_001] {
        assert!(write(count).is_err(), "{count}");
    }
}

#[test]
fn a_late_first_frame_needs_no_empty_rows_of_gigabytes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    let late = results(1_000_000_000_000..1_000_000_000_003);
    late.write(&path).unwrap();
    assert_eq!(
        LocalizationResults::read(&path).unwrap().frames,
        late.frames
    );
}

#[test]
fn a_file_of_range_mcl_alone_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    let mut npz = NpzWriter::new(File::create(&path).unwrap());
    // The first particle of each frame from frame 1 on.
    let particles = [[0.0; 16], [1.0; 16], [1.0; 16]].map(|mut frame: [f64; 16]| {
        frame[4..].fill(0.0);
        frame
    });
    npz.add("particles", &[3, 4, 4], particles.into_iter().flatten())
        .unwrap();
    npz.add("start_idx", &[], [1_i64]).unwrap();
    npz.add("numParticles", &[], [4_i64]).unwrap();
    npz.finish().unwrap();
    let results = LocalizationResults::read(&path).unwrap();
    assert_eq!(*results.frames, [1, 2]);
    assert_eq!(results.particles.frame(1).unwrap(), [[1.0; 4]]);
    assert_eq!(results.estimates, None);
}

/// Writes a file whose `particles` have a header of this type and shape and these bytes after it.
fn write_particles(
    path: &Path,
    element: &str,
    shape: &[u64],
    bytes: &[u8],
    options: SimpleFileOptions,
) {
    let header = || {
        let element = DType::new_scalar(element.parse().unwrap());
        npyz::WriteOptions::new_header_only()
            .dtype(element)
            .shape(shape)
    };
    let mut archive = zip::ZipWriter::new(File::create(path).unwrap());
    archive.start_file("start_idx.npy", options).unwrap();
    super::npz::write_npy(&mut archive, &[], [0_i64]).unwrap();
    archive.start_file("particles.npy", options).unwrap();
    header().writer(&mut archive).write_header_only().unwrap();
    archive.write_all(bytes).unwrap();
    archive.finish().unwrap();
}

#[test]
fn stored_deflated_and_zip64_entries_of_any_number_type_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    let floats = [1.0_f32; 4].map(f32::to_le_bytes).concat();
    let doubles = [1.0_f64; 4].map(f64::to_be_bytes).concat();
    let integers = [1_i32; 4].map(i32::to_le_bytes).concat();
    let bytes = [1; 4].to_vec();
    for method in [
        zip::CompressionMethod::Stored,
        zip::CompressionMethod::Deflated,
    ] {
        for is_large in [false, true] {
            let options = SimpleFileOptions::default()
                .compression_method(method)
                .large_file(is_large);
            for (element, bytes) in [
                ("<f4", &floats),
                (">f8", &doubles),
                ("<i4", &integers),
                ("|u1", &bytes),
                ("|b1", &bytes),
            ] {
                write_particles(&path, element, &[1, 1, 4], bytes, options);
                let results = LocalizationResults::read(&path).unwrap();
                assert_eq!(results.particles.frame(0).unwrap(), [[1.0; 4]]);
            }
        }
    }
}

#[test]
fn a_shape_without_data_is_an_error_and_is_not_allocated() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    for shape in [[1_000_000_000, 10_000, 4], [u64::MAX, 1 << 40, 4]] {
        write_particles(&path, "<f8", &shape, &[0; 32], SimpleFileOptions::default());
        let message = LocalizationResults::read(&path).unwrap_err().to_string();
        assert!(
            message.contains("results.npz, array `particles`"),
            "{message}"
        );
        assert!(message.contains("but there are 32"), "{message}");
    }
    let options = SimpleFileOptions::default();
    write_particles(&path, "<f4", &[1 << 60, 0, 4], &[], options);
    let message = LocalizationResults::read(&path).unwrap_err().to_string();
    assert!(message.contains("N > 0 is needed"), "{message}");
}

#[test]
fn arrays_that_are_not_numbers_are_rejected_with_their_type() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    for element in ["|O", "<c16", "<U3"] {
        write_particles(
            &path,
            element,
            &[1, 1, 4],
            &[0; 64],
            SimpleFileOptions::default(),
        );
        let message = LocalizationResults::read(&path).unwrap_err().to_string();
        assert!(message.contains("array `particles`"), "{message}");
        assert!(
            message.contains(&format!("of type '{element}'")),
            "{message}"
        );
    }
    let mut archive = zip::ZipWriter::new(File::create(&path).unwrap());
    archive
        .start_file("start_idx.npy", SimpleFileOptions::default())
        .unwrap();
    archive.write_all(b"{\"a json\": 1}").unwrap();
    archive.finish().unwrap();
    let message = LocalizationResults::read(&path).unwrap_err().to_string();
    assert!(
        message.contains("array `start_idx`: it cannot be read"),
        "{message}"
    );
}

#[test]
fn a_file_that_is_cut_off_anywhere_is_an_error_that_names_it() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    results(0..4).write(&path).unwrap();
    let whole = fs::read(&path).unwrap();
    for length in (0..whole.len()).step_by(97) {
        fs::write(&path, &whole[..length]).unwrap();
        let message = LocalizationResults::read(&path).unwrap_err().to_string();
        assert!(message.contains("results.npz"), "{length}: {message}");
    }
}

#[test]
fn a_flipped_byte_is_never_a_panic() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    results(0..4).write(&path).unwrap();
    let whole = fs::read(&path).unwrap();
    for position in (0..whole.len()).step_by(41) {
        let mut broken = whole.clone();
        broken[position] ^= 0x55;
        fs::write(&path, &broken).unwrap();
        if let Err(error) = LocalizationResults::read(&path) {
            assert!(error.to_string().contains("results.npz"));
        }
    }
}

#[test]
fn inconsistent_arrays_are_errors_that_name_the_array() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    let write = |shape: [usize; 3], number: f32, start_idx: i64| {
        let mut npz = NpzWriter::new(File::create(&path).unwrap());
        let numbers = std::iter::repeat_n(number, shape.iter().product());
        npz.add("particles", &shape, numbers).unwrap();
        npz.add("start_idx", &[], [start_idx]).unwrap();
        npz.finish().unwrap();
        LocalizationResults::read(&path).unwrap_err().to_string()
    };
    let message = write([2, 2, 3], 0.0, 0);
    assert!(
        message.contains("`particles`: its shape is [2, 2, 3]"),
        "{message}"
    );
    let message = write([2, 2, 4], 0.0, 2);
    assert!(
        message.contains("start_idx is 2, but there are 2 rows"),
        "{message}"
    );
    let message = write([2, 2, 4], 0.0, -1);
    assert!(message.contains("start_idx is -1"), "{message}");
    let message = write([2, 2, 4], f32::NAN, 0);
    assert!(message.contains("`particles`, row 0: NaN"), "{message}");

    // Beyond float32, in which particles are kept.
    write_particles(
        &path,
        "<f8",
        &[1, 1, 4],
        &[1e300_f64; 4].map(f64::to_le_bytes).concat(),
        SimpleFileOptions::default(),
    );
    let message = LocalizationResults::read(&path).unwrap_err().to_string();
    assert!(message.contains("is not a valid value"), "{message}");

    let mut far = results(0..2);
    far.frames = vec![10, usize::MAX].into();
    far.write(&path).unwrap();
    let message = LocalizationResults::read(&path).unwrap_err().to_string();
    assert!(message.contains("`frames`, row 1"), "{message}");

    let mut disordered = results(0..3);
    disordered.frames = vec![4, 6, 5].into();
    disordered.write(&path).unwrap();
    let message = LocalizationResults::read(&path).unwrap_err().to_string();
    assert!(message.contains("`frames`, row 2: 5"), "{message}");
}

#[test]
fn a_trajectory_without_particles_reads_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("odometry.npz");
    for frames in [0..9, 4..13] {
        let written = LocalizationResults {
            particles: ParticleLog::default(),
            ..results(frames)
        };
        written.write(&path).unwrap();
        assert_same(&LocalizationResults::read(&path).unwrap(), &written);
    }
}

#[test]
fn a_file_written_frame_by_frame_has_its_particles_before_the_end_and_is_the_one_written_at_once() {
    const FRAMES: usize = 20_000;
    const FIRST: usize = 3;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    let mut all = results(FIRST..FIRST + FRAMES);
    all.selected = Some(FRAMES + 1);
    all.particles = ParticleLog::new(50, folder.path());
    macro_rules! without_rows {
        ($($name:ident),*) => {
            LocalizationResults {
                frames: Column::in_folder(folder.path()),
                scan_outlines: Some(RowLog::in_folder(folder.path())),
                $($name: Some(Column::in_folder(folder.path())),)*
                ..all.select(&[])
            }
        };
    }
    let mut growing = columns!(without_rows);
    growing.selected = all.selected;
    let mut writer = growing.writer(&path, &[FIRST]).unwrap();
    let particle = |frame: usize, k: usize| {
        [frame, k, frame * k, 1].map(|number| ((number * 7919) % 1_000_003) as f32)
    };
    for row in 0..FRAMES {
        macro_rules! push {
            ($($name:ident),*) => {
                $(growing.$name.as_mut().unwrap().push(all.$name.as_ref().unwrap()[row]);)*
            };
        }
        columns!(push);
        growing.frames.push(FIRST + row);
        let outline = all.scan_outlines.as_ref().unwrap().row(row).unwrap();
        let outlines = growing.scan_outlines.as_mut().unwrap();
        outlines.push(&outline).unwrap();
        let particles: Vec<_> = (0..40).map(|k| particle(row, k)).collect();
        growing.particles.push_frame(&particles).unwrap();
        all.particles.push_frame(&particles).unwrap();
        writer.push(&growing, row).unwrap();
    }
    // The unfinished file holds all particles but what the compressor buffers.
    let length = || {
        let file = fs::read_dir(folder.path()).unwrap().next().unwrap();
        file.unwrap().metadata().unwrap().len()
    };
    let before = length();
    writer.finish(&growing).unwrap();
    // 68 numbers and three states of each frame.
    let (columns, outlines) = ((68 * 8 + 3) * FRAMES as u64, 100 * FRAMES as u64);
    assert!(length() - before < columns + outlines + 1_000_000);
    assert!(before > 5_000_000, "{before}");

    let read = LocalizationResults::read(&path).unwrap();
    assert_same(&read, &all);
    assert_eq!(
        read.particles.frame(FRAMES - 1).unwrap()[39],
        particle(FRAMES - 1, 39)
    );
    let at_once = folder.path().join("at_once.npz");
    all.write(&at_once).unwrap();
    assert!(fs::read(&path).unwrap() == fs::read(&at_once).unwrap());
}
