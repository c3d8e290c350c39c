//! The confidence of points reaches the map: its colours, and what of it is simplified.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

use fpmcl::geometry::{Pose3, TriangleMesh, Vec3};
use fpmcl::ground::GroundClassifier;
use fpmcl::map::local_map::{self, LocalMapCounts, LocalMapSettings, Watcher};
use fpmcl::map::plan::{self, Ownership};
use fpmcl::recording::Frame;
use fpmcl::recording::velodyne::write_scan;
use fpmcl::simulation::{ScannerConfig, kerb_scene};

/// As sure of every point of a scan as of the others: of small scans otherwise than of large.
struct ByScan {
    small: f32,
    large: f32,
    border: usize,
}

impl GroundClassifier for ByScan {
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
        let is_small = points.len() < self.border;
        vec![if is_small { self.small } else { self.large }; points.len()]
    }
}

/// The map of two scans from one place, the second without every fourth point.
fn map(small: f32, large: f32, ground_threshold: f32) -> (TriangleMesh, LocalMapCounts) {
    let folder = tempfile::tempdir().unwrap();
    let scanner = ScannerConfig {
        azimuth_steps: 600,
        ..ScannerConfig::default()
    };
    let whole = kerb_scene(0.12, &scanner, 3).scan;
    let mut thinned = whole.clone();
    let mut number = 0;
    thinned.points.retain(|_| {
        number += 1;
        number % 4 != 0
    });
    thinned.intensities.truncate(thinned.points.len());
    let border = whole.len() * 7 / 8;
    let frames: Vec<Frame> = [whole, thinned]
        .iter()
        .enumerate()
        .map(|(number, scan)| {
            let scan_path = folder.path().join(format!("{number}.bin"));
            write_scan(std::fs::File::create(&scan_path).unwrap(), scan).unwrap();
            Frame {
                number,
                scan_path,
                time_s: 0.1 * number as f64,
                map_from_lidar: Pose3::identity(),
                sweep: None,
            }
        })
        .collect();
    let mut settings = LocalMapSettings {
        ground_threshold,
        ..LocalMapSettings::default()
    };
    settings.poisson.depth = 6;
    settings.scan.crop_m = Vec3::new(10.0, 10.0, 5.0);
    settings.visibility.enabled = false;
    let plans = plan::local_maps(&frames, 10, 0.0);
    let ownership = Ownership::new(&frames, &plans, 50.0);
    let watcher = Watcher {
        scan_done: &|| (),
        stage: &|_| (),
        cancelled: &|| false,
    };
    let classifier = ByScan {
        small,
        large,
        border,
    };
    let built = local_map::build(
        &frames,
        &plans[0],
        &ownership,
        &settings,
        &classifier,
        &watcher,
    )
    .unwrap();
    (built.mesh, built.counts)
}

fn mean_red(mesh: &TriangleMesh) -> f32 {
    let reds = mesh.colors.iter().map(|color| f32::from(color[0]));
    reds.sum::<f32>() / mesh.colors.len() as f32
}

#[test]
fn surer_points_make_redder_vertices() {
    let means = [0.0, 0.4, 1.0].map(|confidence| {
        // A threshold that nothing reaches leaves every vertex where it is.
        let (mesh, counts) = map(confidence, confidence, 1.1);
        assert!(mesh.colors.len() > 300);
        assert_eq!(counts.simplified_triangles, 0);
        mean_red(&mesh)
    });
    assert!(means[0] < 1.0, "{means:?}");
    assert!(
        means.windows(2).all(|pair| pair[0] + 20.0 < pair[1]),
        "{means:?}"
    );
}

#[test]
fn what_two_scans_disagree_on_lies_between_them() {
    let [low, high] = [0.5, 0.9].map(|confidence| mean_red(&map(confidence, confidence, 1.1).0));
    let between = mean_red(&map(0.9, 0.5, 1.1).0);
    let share = (between - low) / (high - low);
    assert!(share > 0.3 && share < 0.7, "{low} {between} {high}");
}

#[test]
fn the_mean_over_scans_decides_what_is_simplified() {
    let simplified = |small, large| map(small, large, 0.6).1.simplified_triangles;
    let (agreed, none) = (simplified(0.9, 0.9), simplified(0.5, 0.5));
    assert!(agreed > 100, "{agreed}");
    assert_eq!(none, 0);
    // One scan is sure and one is not: their mean, 0.7, is enough nearly everywhere.
    let outvoted = simplified(0.9, 0.5);
    assert!(2 * outvoted > agreed, "{outvoted} of {agreed}");
    let still_none = simplified(0.6, 0.5);
    assert!(10 * still_none < agreed, "{still_none} of {agreed}");
}
