use std::fs::{self, File};

use approx::assert_relative_eq;
use nalgebra::Matrix3;
use ndarray::{Array3, arr0};
use ndarray_npy::{NpzReader, NpzWriter};

use super::{LocalizationResults, ParticleLog};
use crate::geometry::Pose2;

fn results(frames: impl Iterator<Item = usize>) -> LocalizationResults {
    let frames: Vec<usize> = frames.collect();
    let mut particles = ParticleLog::new(5);
    for row in 0..frames.len() {
        // Of every frame the second particle is at the origin and weightless.
        particles.push_frame([[row as f32, 1.0, 2.0, 0.5], [0.0; 4], [3.0, 4.0, 5.0, 0.5]]);
    }
    let poses = |offset: f64| {
        let pose = |&frame: &usize| Pose2::new([frame as f64, offset].into(), 3.0 - offset);
        Some(frames.iter().map(pose).collect::<Vec<_>>())
    };
    let numbers = |scale: f64| Some(frames.iter().map(|&f| scale * f as f64).collect());
    let matrix = |&frame: &usize| Matrix3::from_diagonal_element(1.0 + frame as f64);
    LocalizationResults {
        particles,
        estimates: poses(0.1),
        refined: poses(0.2),
        ground_truth: poses(0.3),
        odometry: poses(0.4),
        covariances: Some(frames.iter().map(matrix).collect()),
        refined_covariances: Some(frames.iter().map(|frame| 0.5 * matrix(frame)).collect()),
        times_s: numbers(0.1),
        runtimes_s: numbers(0.01),
        refine_runtimes_s: numbers(0.02),
        states: Some(frames.iter().map(|&frame| frame as u8 % 3).collect()),
        frames,
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
        .flat_map(|poses| poses.clone().unwrap())
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
fn what_is_written_is_read_back_from_the_start_from_later_and_with_gaps() {
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
    let mut npz = NpzReader::new(File::open(&path).unwrap()).unwrap();
    let particles: Array3<f32> = npz.by_name("particles").unwrap();
    assert_eq!(particles.shape(), [4, 5, 4]);
    assert!(
        particles
            .slice(ndarray::s![..2, .., ..])
            .iter()
            .all(|&x| x == 0.0)
    );
    assert_eq!(particles[(3, 0, 0)], 1.0);
    let start_idx: ndarray::Array0<i64> = npz.by_name("start_idx").unwrap();
    let count: ndarray::Array0<i64> = npz.by_name("numParticles").unwrap();
    assert_eq!((start_idx[()], count[()]), (2, 5));
}

#[test]
fn a_file_of_range_mcl_alone_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    let mut npz = NpzWriter::new_compressed(File::create(&path).unwrap());
    let particles =
        Array3::<f32>::from_shape_fn(
            (3, 2, 4),
            |(frame, row, _)| {
                if frame > 0 && row == 0 { 1.0 } else { 0.0 }
            },
        );
    npz.add_array("particles", &particles).unwrap();
    npz.add_array("start_idx", &arr0(1_i64)).unwrap();
    npz.add_array("numParticles", &arr0(2_i64)).unwrap();
    npz.finish().unwrap();
    let results = LocalizationResults::read(&path).unwrap();
    assert_eq!(results.frames, [1, 2]);
    assert_eq!(results.particles.frame(1), [[1.0; 4]]);
    assert_eq!(results.estimates, None);
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
fn what_does_not_fit_is_said_with_its_array() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("results.npz");
    let write = |particles: Array3<f32>, start_idx: i64| {
        let mut npz = NpzWriter::new_compressed(File::create(&path).unwrap());
        npz.add_array("particles", &particles).unwrap();
        npz.add_array("start_idx", &arr0(start_idx)).unwrap();
        npz.finish().unwrap();
        LocalizationResults::read(&path).unwrap_err().to_string()
    };
    let message = write(Array3::zeros((2, 2, 3)), 0);
    assert!(
        message.contains("`particles`: its shape is [2, 2, 3]"),
        "{message}"
    );
    let message = write(Array3::zeros((2, 2, 4)), 2);
    assert!(
        message.contains("start_idx is 2, but there are 2 rows"),
        "{message}"
    );
    let message = write(Array3::zeros((2, 2, 4)), -1);
    assert!(message.contains("start_idx is -1"), "{message}");
    let message = write(Array3::from_elem((2, 2, 4), f32::NAN), 0);
    assert!(message.contains("`particles`, row 0: NaN"), "{message}");

    let mut confused = results(0..3);
    confused.frames = vec![4, 6, 5];
    confused.write(&path).unwrap();
    let message = LocalizationResults::read(&path).unwrap_err().to_string();
    assert!(message.contains("`frames`, row 2: 5"), "{message}");

    let mut short = results(0..3);
    short.estimates = short.estimates.map(|poses| poses[..2].to_vec());
    let message = short.write(&path).unwrap_err().to_string();
    assert!(
        message.contains("`estimates` has 2 rows for 3 frames"),
        "{message}"
    );
}
