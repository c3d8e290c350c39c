//! Quality of a map along the beams of scans that it was not built from.
//!
//! A map whose surfaces pass through all points can still be useless: localization depends on the
//! first surface that a beam from the sensor hits. For every beam
//!
//! ```text
//! residual   = mapped range − measured range
//! beam-plane = |residual| · |cos(incidence)|      the distance to the plane of the triangle hit
//! ```
//!
//! early: residual < −0.5 m (ghosts, trails, extrapolated surfaces); late: > 0.5 m (a moving object in
//! the scan, or a hole); miss: no surface. The distance of the returns to the nearest surface shows
//! how much of the world is in the map.

use std::collections::HashMap;

use glam::{IVec3, Vec3};
use rayon::prelude::*;
use serde::Serialize;

use super::surface_distance::distances_m;
use crate::geometry::{Pose3, Rigid3f, TriangleMesh};
use crate::lidar::Scan;
use crate::map::scan_cloud::ScanConfig;
use crate::raycasting::{Hit, Scene};

/// A residual beyond this is early or late [m].
const GROSS_M: f32 = 0.5;
/// A distance below this counts as "within", here and against the truth [m].
pub(super) const NEAR_M: f32 = 0.1;
/// Shorter beams are not evaluated [m].
const NEAREST_M: f32 = 3.0;
/// Edge of the cells in which residuals are averaged for a picture [m].
const PICTURE_CELL_M: f32 = 0.5;
/// Every n-th beam is evaluated.
const BEAM_STEP: usize = 7;

/// Shares of all evaluated beams (unitless), and medians over those that hit [m].
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct MapQuality {
    /// Number of evaluated beams.
    pub beams: usize,
    /// Share stopped more than 0.5 m too early.
    pub early: f64,
    /// Share stopped more than 0.5 m too late.
    pub late: f64,
    /// Share that hits no surface.
    pub miss: f64,
    /// Median distance to the plane that was hit [m].
    pub beam_plane_median_m: f64,
    /// Share whose beam-plane distance is under 10 cm.
    pub beam_plane_within_10cm: f64,
    /// Median distance of the returns to the nearest surface [m]; infinite if over 10 cm.
    pub point_median_m: f64,
    /// Share of the returns within 10 cm of a surface.
    pub point_within_10cm: f64,
    /// Median |residual| [m].
    pub ray_median_m: f64,
    /// Median residual [m].
    pub bias_m: f64,
}

/// An evaluated beam.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BeamResidual {
    /// Return of the beam, map frame [m].
    pub point_in_map: Vec3,
    /// Mapped minus measured range [m]; infinite where the map has no surface.
    pub residual_m: f32,
    /// |residual| times cosine of incidence [m].
    pub beam_plane_m: f32,
    /// Distance of the return to the nearest surface [m]; infinite if over 10 cm.
    pub point_m: f32,
    /// First intersection of the beam with the map, map frame [m]; `None` where it has no surface.
    pub stopped_at: Option<Vec3>,
}

/// Compares a map with `count` scans and their poses, inside the crop box. `read` returns them by index
/// and is called from any thread.
pub fn residuals<E: Send>(
    mesh: &TriangleMesh,
    count: usize,
    read: impl Fn(usize) -> Result<(Scan, Pose3), E> + Sync,
    settings: &ScanConfig,
) -> Result<Vec<BeamResidual>, E> {
    let scene = Scene::new(mesh);
    let per_scan = (0..count)
        .into_par_iter()
        .map(|index| {
            let (mut scan, map_from_lidar) = read(index)?;
            scan.drop_invalid(&settings.range_image);
            let points: Vec<Vec3> = scan
                .points
                .into_iter()
                .filter(|point| point.length() > NEAREST_M)
                .step_by(BEAM_STEP)
                .filter(|point| point.abs().cmplt(settings.crop_m).all())
                .collect();
            Ok(compare(
                mesh,
                &scene,
                &Rigid3f::from(&map_from_lidar),
                &points,
            ))
        })
        .collect::<Result<Vec<_>, E>>()?;
    let mut beams: Vec<BeamResidual> = per_scan.into_iter().flatten().collect();
    let points: Vec<Vec3> = beams.iter().map(|beam| beam.point_in_map).collect();
    for (beam, point_m) in beams.iter_mut().zip(distances_m(&points, mesh, NEAR_M)) {
        beam.point_m = point_m;
    }
    Ok(beams)
}

/// Returns per vertex the mean beam-plane distance around it, for a picture [m]; NaN where no beam was
/// evaluated. Gross residuals count as 0.5 m.
pub fn vertex_residuals(mesh: &TriangleMesh, beams: &[BeamResidual]) -> Vec<f32> {
    let cell_of = |point: Vec3| (point / PICTURE_CELL_M).floor().as_ivec3();
    let mut cells: HashMap<IVec3, (f32, f32)> = HashMap::new();
    for beam in beams {
        if let Some(point) = beam.stopped_at {
            let (sum, count) = cells.entry(cell_of(point)).or_default();
            *sum += beam.beam_plane_m.min(GROSS_M);
            *count += 1.0;
        }
    }
    mesh.vertices
        .iter()
        .map(|&vertex| {
            cells
                .get(&cell_of(vertex))
                .map_or(f32::NAN, |(sum, count)| sum / count)
        })
        .collect()
}

fn compare(
    mesh: &TriangleMesh,
    scene: &Scene,
    map_from_lidar: &Rigid3f,
    points: &[Vec3],
) -> Vec<BeamResidual> {
    let directions: Vec<Vec3> = points
        .iter()
        .map(|&point| map_from_lidar.rotate(point.normalize()))
        .collect();
    let mut hits = vec![Hit::MISS; points.len()];
    scene.cast(map_from_lidar.translation, &directions, &mut hits);
    points
        .iter()
        .zip(&directions)
        .zip(&hits)
        .map(|((&point, &direction), hit)| {
            let residual_m = hit.range_m - point.length();
            let beam_plane_m = if hit.triangle == Hit::NO_TRIANGLE {
                f32::INFINITY
            } else {
                let normal = mesh
                    .scaled_normal(hit.triangle as usize)
                    .normalize_or_zero();
                residual_m.abs() * normal.dot(direction).abs()
            };
            BeamResidual {
                point_in_map: map_from_lidar.apply(point),
                residual_m,
                beam_plane_m,
                point_m: f32::INFINITY,
                stopped_at: (hit.triangle != Hit::NO_TRIANGLE)
                    .then(|| map_from_lidar.translation + hit.range_m * direction),
            }
        })
        .collect()
}

impl MapQuality {
    /// Summarizes residuals; `None` without any.
    pub fn of(residuals: &[BeamResidual]) -> Option<Self> {
        let hits: Vec<&BeamResidual> = residuals
            .iter()
            .filter(|beam| beam.residual_m.is_finite())
            .collect();
        if hits.is_empty() {
            return None;
        }
        let share = |count: usize| count as f64 / residuals.len() as f64;
        let count =
            |of: &dyn Fn(&BeamResidual) -> bool| share(hits.iter().filter(|beam| of(beam)).count());
        Some(Self {
            beams: residuals.len(),
            early: count(&|beam| beam.residual_m < -GROSS_M),
            late: count(&|beam| beam.residual_m > GROSS_M),
            miss: share(residuals.len() - hits.len()),
            beam_plane_median_m: median(hits.iter().map(|beam| beam.beam_plane_m)),
            beam_plane_within_10cm: count(&|beam| beam.beam_plane_m < NEAR_M),
            point_median_m: median(residuals.iter().map(|beam| beam.point_m)),
            point_within_10cm: share(
                residuals
                    .iter()
                    .filter(|beam| beam.point_m < NEAR_M)
                    .count(),
            ),
            ray_median_m: median(hits.iter().map(|beam| beam.residual_m.abs())),
            bias_m: median(hits.iter().map(|beam| beam.residual_m)),
        })
    }
}

fn median(values: impl Iterator<Item = f32>) -> f64 {
    let mut values: Vec<f32> = values.collect();
    let middle = values.len() / 2;
    let (_, median, _) = values.select_nth_unstable_by(middle, f32::total_cmp);
    f64::from(*median)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall across the x axis.
    fn wall(x: f32) -> TriangleMesh {
        TriangleMesh {
            vertices: vec![
                Vec3::new(x, -50.0, -50.0),
                Vec3::new(x, 50.0, -50.0),
                Vec3::new(x, 0.0, 50.0),
            ],
            triangles: vec![[0, 1, 2]],
            ..TriangleMesh::default()
        }
    }

    fn quality_of(wall_x: f32, points: &[Vec3]) -> MapQuality {
        let mesh = wall(wall_x);
        let identity = Rigid3f::from(&crate::geometry::Pose3::identity());
        MapQuality::of(&compare(&mesh, &Scene::new(&mesh), &identity, points)).unwrap()
    }

    #[test]
    fn early_late_and_missing_beams_are_distinguished() {
        let points = [
            Vec3::new(10.0, 0.0, 0.0),
            Vec3::new(12.0, 0.0, 0.0),
            Vec3::new(8.0, 0.0, 0.0),
            Vec3::new(-10.0, 0.0, 0.0),
        ];
        let quality = quality_of(10.0, &points);
        assert_eq!(
            (quality.early, quality.late, quality.miss),
            (0.25, 0.25, 0.25)
        );
    }

    #[test]
    fn a_picture_shows_residuals_where_beams_end_and_nothing_elsewhere() {
        let mesh = TriangleMesh {
            vertices: vec![Vec3::new(10.2, 0.1, 0.1), Vec3::new(10.2, 30.0, 0.0)],
            ..TriangleMesh::default()
        };
        let beam = |beam_plane_m, x| BeamResidual {
            point_in_map: Vec3::ZERO,
            residual_m: 0.0,
            beam_plane_m,
            point_m: 0.0,
            stopped_at: Some(Vec3::new(x, 0.2, 0.2)),
        };
        let beams = [beam(0.1, 10.1), beam(9.0, 10.3), beam(0.2, 12.0)];
        let values = vertex_residuals(&mesh, &beams);
        assert!((values[0] - 0.3).abs() < 1e-6);
        assert!(values[1].is_nan());
    }

    #[test]
    fn a_grazing_beam_counts_by_its_distance_to_the_plane() {
        // 45 degrees of incidence, the wall 5 cm behind the point.
        let quality = quality_of(10.05, &[Vec3::new(10.0, 10.0, 0.0)]);
        assert!((quality.beam_plane_median_m - 0.05).abs() < 1e-4);
        assert!((quality.ray_median_m - 0.05 * 2.0_f64.sqrt()).abs() < 1e-4);
        assert!((quality.bias_m - quality.ray_median_m).abs() < 1e-9);
    }
}
