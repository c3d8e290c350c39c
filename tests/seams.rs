//! Local maps of one road, joined by the program: where they meet there is neither a slit nor a
//! second road.

#![allow(clippy::unwrap_used, reason = "a failing test may panic")]

mod common;

use common::Recording;
use fpmcl::map::ply;
use fpmcl::raycasting::Scene;
use glam::Vec3;

/// The road, in the frame of the first scan [m].
const ROAD_M: f32 = -1.73;
/// Between the scans 15 and 16, which are half a metre apart: nearer to the ends of the drive there
/// is road that no beam reaches, for the sensor sees none within 3.7 m [m].
const BORDER_M: f32 = 7.75;

#[test]
fn over_the_border_of_two_local_maps_the_road_is_there_once() {
    let recording = Recording::street(32);
    recording
        .fpmcl("build-map")
        .set("depth", "8")
        .set("local_map_size", "16")
        .set("overlap_m", "5")
        .set("max_distance_m", "0.5")
        .succeeds();
    let map = ply::read(&recording.path("map.ply")).unwrap();
    let scene = Scene::new(&map);
    for i in 0..40_000 {
        // Ways that have no common measure with the cells.
        let along = (0.754_877_666 * f64::from(i) % 1.0 - 0.5) as f32;
        let across = (0.569_840_291 * f64::from(i) % 1.0 - 0.5) as f32;
        let above = Vec3::new(BORDER_M + 1.5 * along, 6.0 * across, 0.0);
        let mut heights_m = Vec::new();
        scene.for_each_hit(above, Vec3::NEG_Z, 3.0, |hit| heights_m.push(-hit.range_m));
        // An edge belongs to both of its triangles.
        heights_m.sort_unstable_by(f32::total_cmp);
        heights_m.dedup_by(|a, b| (*a - *b).abs() < 1e-5);
        assert_eq!(heights_m.len(), 1, "under {above}: {heights_m:?}");
        let step_m = (heights_m[0] - ROAD_M).abs();
        assert!(step_m < 0.02, "under {above}: {step_m} m");
    }
}
