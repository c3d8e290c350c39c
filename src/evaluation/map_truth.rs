//! Accuracy and completeness of a map against the true surface, where it is known, as in simulations.
//!
//! ```text
//! accuracy     = share of the map's area within 10 cm of the truth
//! completeness = share of the visible truth within 10 cm of the map
//! F            = 2 · accuracy · completeness / (accuracy + completeness)
//! ```
//!
//! Knapitsch et al., *Tanks and Temples*, ACM TOG 36(4), 2017. The visible truth is the surface that the
//! beams of the mapping scans would hit without noise and traffic.

use std::collections::HashSet;

use glam::{IVec3, Vec3};
use serde::Serialize;

use super::map_quality::NEAR_M;
use super::surface_distance::distances_m;
use crate::geometry::{Pose3, Rigid3f, TriangleMesh};
use crate::raycasting::{Hit, Scene};
use crate::sensor::Sensor;

/// Voxel size of the sampling of the truth [m].
const VOXEL_M: f32 = 0.1;
/// Area of the map per sample [m²].
const AREA_M2: f32 = 0.01;

/// Agreement of a map with the true surface.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct TruthAgreement {
    /// Share of the map's area within 10 cm of the truth (unitless).
    pub accuracy: f64,
    /// Share of the visible truth within 10 cm of the map (unitless).
    pub completeness: f64,
    /// Their harmonic mean (unitless).
    pub f_score: f64,
    /// Median distance from the map to the truth, of what is within 10 cm [m].
    pub median_m: f64,
}

impl TruthAgreement {
    /// Compares a map with the truth that is visible from `map_from_lidar` inside the crop box, both in
    /// the map frame; `None` where either is empty.
    pub fn new(
        mesh: &TriangleMesh,
        truth: &TriangleMesh,
        map_from_lidar: &[Pose3],
        sensor: &Sensor,
        crop_m: Vec3,
    ) -> Option<Self> {
        let seen = visible_points(truth, map_from_lidar, sensor, crop_m);
        let samples = samples(mesh);
        if seen.is_empty() || samples.is_empty() {
            return None;
        }
        let mut near = near_distances(&samples, truth);
        let accuracy = near.len() as f64 / samples.len() as f64;
        let completeness = near_distances(&seen, mesh).len() as f64 / seen.len() as f64;
        near.sort_unstable_by(f32::total_cmp);
        Some(Self {
            accuracy,
            completeness,
            f_score: 2.0 * accuracy * completeness / (accuracy + completeness).max(f64::EPSILON),
            median_m: f64::from(near.get(near.len() / 2).copied().unwrap_or(f32::INFINITY)),
        })
    }
}

/// Distances of the points that are near a mesh.
fn near_distances(points: &[Vec3], mesh: &TriangleMesh) -> Vec<f32> {
    let mut distances = distances_m(points, mesh, NEAR_M);
    distances.retain(|distance_m| distance_m.is_finite());
    distances
}

/// Returns the points where the beams of the pixels hit the truth, one per voxel.
fn visible_points(
    truth: &TriangleMesh,
    poses: &[Pose3],
    sensor: &Sensor,
    crop_m: Vec3,
) -> Vec<Vec3> {
    let scene = Scene::new(truth);
    let model = &sensor.range_image;
    let in_lidar = model.directions();
    let mut taken = HashSet::new();
    let mut seen = Vec::new();
    for pose in poses {
        let map_from_lidar = Rigid3f::from(pose);
        let directions: Vec<Vec3> = in_lidar
            .iter()
            .map(|&direction| map_from_lidar.rotate(direction))
            .collect();
        let mut hits = vec![Hit::MISS; directions.len()];
        scene.cast_until(
            map_from_lidar.translation,
            &directions,
            model.max_range,
            &mut hits,
        );
        for ((hit, direction), in_lidar) in hits.iter().zip(&directions).zip(&in_lidar) {
            let is_inside = model.accepts_range(hit.range_m)
                && (*in_lidar * hit.range_m).abs().cmple(crop_m).all();
            if !is_inside {
                continue;
            }
            let point = map_from_lidar.translation + hit.range_m * *direction;
            if taken.insert(voxel_of(point)) {
                seen.push(point);
            }
        }
    }
    seen
}

fn voxel_of(point: Vec3) -> IVec3 {
    (point / VOXEL_M).floor().as_ivec3()
}

/// Samples the area of a mesh uniformly, at the centroids of similar triangles that each of its
/// triangles is subdivided into.
fn samples(mesh: &TriangleMesh) -> Vec<Vec3> {
    let mut samples = Vec::new();
    let mut due = 0.0;
    for triangle in 0..mesh.triangles.len() {
        let [a, b, c] = mesh.corners(triangle);
        let area_m2 = 0.5 * mesh.scaled_normal(triangle).length();
        due += area_m2 / AREA_M2;
        if due < 1.0 {
            continue;
        }
        let cuts = (due.floor().sqrt() as u32).max(1);
        let share = 1.0 / cuts as f32;
        for i in 0..cuts {
            for j in 0..cuts - i {
                let at = |third: f32| {
                    let (u, v) = (share * (i as f32 + third), share * (j as f32 + third));
                    a + u * (b - a) + v * (c - a)
                };
                samples.push(at(1.0 / 3.0));
                if i + j + 1 < cuts {
                    samples.push(at(2.0 / 3.0));
                }
            }
        }
        due -= (cuts * cuts) as f32;
    }
    samples
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A floor of 20 m x `width_m` at a height, in two triangles.
    fn floor(width_m: f32, z: f32) -> TriangleMesh {
        TriangleMesh {
            vertices: vec![
                Vec3::new(-10.0, -5.0, z),
                Vec3::new(10.0, -5.0, z),
                Vec3::new(10.0, width_m - 5.0, z),
                Vec3::new(-10.0, width_m - 5.0, z),
            ],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..TriangleMesh::default()
        }
    }

    fn agreement(mesh: &TriangleMesh) -> TruthAgreement {
        let truth = floor(10.0, -1.7);
        TruthAgreement::new(
            mesh,
            &truth,
            &[Pose3::identity()],
            &Sensor::hdl64e(),
            Vec3::new(30.0, 30.0, 5.0),
        )
        .unwrap()
    }

    #[test]
    fn the_truth_agrees_with_itself() {
        let same = agreement(&floor(10.0, -1.7));
        assert_eq!(
            (same.accuracy, same.completeness, same.f_score),
            (1.0, 1.0, 1.0)
        );
        assert!(same.median_m < 1e-5);
    }

    #[test]
    fn half_a_map_is_accurate_and_not_complete_and_twice_the_map_the_reverse() {
        let half = agreement(&floor(5.0, -1.7));
        assert_eq!(half.accuracy, 1.0);
        assert!((half.completeness - 0.5).abs() < 0.05, "{half:?}");
        let twice = agreement(&floor(20.0, -1.7));
        assert!((twice.accuracy - 0.5).abs() < 0.02, "{twice:?}");
        assert_eq!(twice.completeness, 1.0);
        assert!((twice.f_score - 2.0 / 3.0).abs() < 0.02);
    }

    #[test]
    fn a_map_five_centimetres_too_high_agrees_and_one_of_fifteen_does_not() {
        assert!((agreement(&floor(10.0, -1.65)).median_m - 0.05).abs() < 1e-4);
        assert_eq!(agreement(&floor(10.0, -1.55)).f_score, 0.0);
    }
}
