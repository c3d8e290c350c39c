//! Seams between local maps: the road has no gap and no second layer there.

use fpmcl::internals::Scene;
use fpmcl::internals::ply;
use glam::Vec3;

use crate::common::Recording;

/// Height of the road in the frame of the first scan [m].
const ROAD_M: f32 = -1.73;
/// Position of the seam along the road, between the scans 15 and 16 [m].
///
/// Near the ends of the drive, parts of the road are not scanned: the beams reach it from 3.7 m on.
const SEAM_M: f32 = 7.75;

#[test]
fn the_road_has_one_layer_at_the_seam_of_two_local_maps() {
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
        // A low-discrepancy sequence, incommensurable with the cells.
        let along = (0.754_877_666 * f64::from(i) % 1.0 - 0.5) as f32;
        let across = (0.569_840_291 * f64::from(i) % 1.0 - 0.5) as f32;
        let above = Vec3::new(SEAM_M + 1.5 * along, 6.0 * across, 0.0);
        let mut heights_m = Vec::new();
        scene.for_each_hit(above, Vec3::NEG_Z, 3.0, |hit| heights_m.push(-hit.range_m));
        // A ray through an edge hits both triangles.
        heights_m.sort_unstable_by(f32::total_cmp);
        heights_m.dedup_by(|a, b| (*a - *b).abs() < 1e-5);
        assert_eq!(heights_m.len(), 1, "under {above}: {heights_m:?}");
        let error_m = (heights_m[0] - ROAD_M).abs();
        assert!(error_m < 0.02, "under {above}: {error_m} m");
    }
}
