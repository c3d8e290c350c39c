//! The ground confidence of points determines the colors of the map.

use fpmcl::geometry::{Pose3, TriangleMesh, Vec3};
use fpmcl::ground::GroundClassifier;
use fpmcl::lidar::LidarModel;
use fpmcl::lidar::Scan;
use fpmcl::map::{MapBuilder, MapConfig};
use fpmcl::sensor::Sensor;
use fpmcl::simulation::{ScannerConfig, kerb_scene};

/// Classifier with one confidence per scan, which depends on its number of points.
struct ByScan {
    small: f32,
    large: f32,
    large_from: usize,
}

impl GroundClassifier for ByScan {
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
        let is_small = points.len() < self.large_from;
        vec![if is_small { self.small } else { self.large }; points.len()]
    }
}

/// Map of a scan and of the same scan without every fourth point.
fn map(small: f32, large: f32, ground_threshold: f32) -> TriangleMesh {
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
    let large_from = whole.len() * 7 / 8;
    let scans: [Scan; 2] = [whole, thinned];
    let mut config = MapConfig::default();
    config.local_map.ground_threshold = ground_threshold;
    config.local_map.poisson.depth = Some(6);
    (config.local_map.crop_x_m, config.local_map.crop_y_m) = (Some(10.0), Some(10.0));
    config.local_map.visibility.enabled = false;
    config.local_map.simplify_resolution_m = 0.0;
    let sensor = Sensor {
        range_image: LidarModel::default(),
        ..Sensor::hdl64e()
    };
    let builder = MapBuilder::new(config);
    let mut plan = builder.plan(&sensor, vec![Pose3::identity(); 2]).unwrap();
    plan.classifier = Box::new(ByScan {
        small,
        large,
        large_from,
    });
    let read = |key: usize| Ok(scans[key].clone());
    plan.build_local_map(&plan.local_maps[0], &read)
        .unwrap()
        .mesh
}

fn mean_red(mesh: &TriangleMesh) -> f32 {
    let reds = mesh.colors.iter().map(|color| f32::from(color[0]));
    reds.sum::<f32>() / mesh.colors.len() as f32
}

#[test]
fn more_confident_points_make_redder_vertices() {
    let means = [0.0, 0.4, 0.99].map(|confidence| {
        let mesh = map(confidence, confidence, 1.0);
        assert!(mesh.colors.len() > 300);
        mean_red(&mesh)
    });
    assert!(means[0] < 1.0, "{means:?}");
    assert!(
        means.windows(2).all(|pair| pair[0] + 20.0 < pair[1]),
        "{means:?}"
    );
}

#[test]
fn different_confidences_are_averaged_in_the_color() {
    let [low, high] = [0.5, 0.9].map(|confidence| mean_red(&map(confidence, confidence, 1.0)));
    let between = mean_red(&map(0.9, 0.5, 1.0));
    let share = (between - low) / (high - low);
    assert!(share > 0.3 && share < 0.7, "{low} {between} {high}");
}

#[test]
fn the_mean_confidence_of_the_scans_determines_what_is_ground() {
    // Share of the vertices that are red.
    let ground = |small, large| {
        let colors = map(small, large, 0.6).colors;
        let red = colors.iter().filter(|[red, _, blue]| red > blue).count();
        red as f32 / colors.len() as f32
    };
    assert_eq!((ground(0.9, 0.9), ground(0.5, 0.5)), (1.0, 0.0));
    // The mean of a confident and an uncertain scan, 0.7, exceeds the threshold nearly everywhere.
    let (mixed, few) = (ground(0.9, 0.5), ground(0.6, 0.5));
    assert!(mixed > 0.5 && few < 0.1, "{mixed} {few}");
}
