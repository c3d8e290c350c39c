//! Time per scan of each ground classifier: `cargo bench --bench ground`, with
//! `RAYON_NUM_THREADS=1` on one thread.

use divan::{Bencher, black_box};
use fpmcl::geometry::Vec3;
use fpmcl::ground::{
    FuzzyConfig, FuzzyGround, GroundClassifier, Inference, PcaGround, RansacGround, RoadConfig,
    road_plane,
};

fn main() {
    divan::main();
}

/// Number of azimuths per revolution: the width of a range image, and a full scan.
const COLUMNS: [usize; 2] = [1024, 2000];

/// Scan with 64 beams of a street between two walls with a box every 8 m.
fn street(columns: usize) -> Vec<Vec3> {
    const BEAMS: usize = 64;
    let mut points = Vec::with_capacity(BEAMS * columns);
    for beam in 0..BEAMS {
        let elevation = (2.0 - 26.8 * beam as f32 / (BEAMS - 1) as f32).to_radians();
        for column in 0..columns {
            let azimuth = column as f32 / columns as f32 * std::f32::consts::TAU;
            let direction = Vec3::new(
                elevation.cos() * azimuth.cos(),
                elevation.cos() * azimuth.sin(),
                elevation.sin(),
            );
            let road_m = positive(-1.73 / direction.z);
            let wall_m = 9.0 / direction.y.abs().max(1e-3);
            let side_m = 3.0 / direction.y.abs().max(1e-3);
            let in_box =
                (direction.x * side_m).rem_euclid(8.0) < 4.5 && direction.z * side_m < -0.3;
            let box_m = if in_box { side_m } else { f32::INFINITY };
            let range_m = road_m.min(wall_m).min(box_m);
            if range_m < 80.0 {
                points.push(direction * range_m);
            }
        }
    }
    points
}

fn positive(range_m: f32) -> f32 {
    if range_m > 0.0 {
        range_m
    } else {
        f32::INFINITY
    }
}

fn classify(bencher: Bencher, classifier: &dyn GroundClassifier, columns: usize) {
    let points = street(columns);
    bencher
        .counter(divan::counter::ItemsCount::new(points.len()))
        .bench(|| classifier.ground_confidence(black_box(&points)));
}

fn fuzzy(config: FuzzyConfig) -> FuzzyGround {
    FuzzyGround::new(config).expect("the default rules are well-formed")
}

#[divan::bench(args = COLUMNS)]
fn fuzzy_with_all_features(bencher: Bencher, columns: usize) {
    classify(bencher, &fuzzy(FuzzyConfig::default()), columns);
}

#[divan::bench(args = COLUMNS)]
fn fuzzy_with_three_features(bencher: Bencher, columns: usize) {
    classify(bencher, &fuzzy(FuzzyConfig::three_features()), columns);
}

#[divan::bench(args = COLUMNS)]
fn fuzzy_by_sugeno(bencher: Bencher, columns: usize) {
    let config = FuzzyConfig {
        inference: Inference::Sugeno,
        ..FuzzyConfig::default()
    };
    classify(bencher, &fuzzy(config), columns);
}

#[divan::bench(args = COLUMNS)]
fn pca(bencher: Bencher, columns: usize) {
    classify(bencher, &PcaGround::default(), columns);
}

#[divan::bench(args = COLUMNS)]
fn ransac(bencher: Bencher, columns: usize) {
    classify(bencher, &RansacGround::default(), columns);
}

#[divan::bench(args = COLUMNS)]
fn plane_of_the_road(bencher: Bencher, columns: usize) {
    let points = street(columns);
    let ground = fuzzy(FuzzyConfig::default()).ground_confidence(&points);
    bencher.bench(|| road_plane(black_box(&points), &ground, &RoadConfig::default()));
}
