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

use std::collections::BTreeMap;

use foldhash::HashMap;
use glam::{DVec3, IVec3, Vec3};
use rayon::prelude::*;
use serde::Serialize;

use super::surface_distance::distances_m;
use crate::geometry::{Pose3, Rigid3f, TriangleMesh};
use crate::lidar::Scan;
use crate::raycasting::{Hit, Scene};
use crate::sensor::Sensor;

/// A residual beyond this is early or late [m].
const GROSS_M: f32 = 0.5;
/// A distance below this counts as "within", here and against the truth [m].
pub(super) const NEAR_M: f32 = 0.1;
/// Shorter beams are not evaluated [m].
const NEAREST_M: f32 = 3.0;
/// Edge of the cells in which residuals are averaged for a picture [m].
const PICTURE_CELL_M: f64 = 0.5;
/// Every n-th beam is evaluated.
const BEAM_STEP: usize = 7;

/// Shares of all evaluated beams (unitless), and medians over those that hit [m].
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
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
    sensor: &Sensor,
    crop_m: Vec3,
) -> Result<Vec<BeamResidual>, E> {
    let scene = Scene::new(mesh);
    let per_scan = (0..count)
        .into_par_iter()
        .map(|index| {
            let (mut scan, map_from_lidar) = read(index)?;
            scan.drop_invalid(&sensor.range_image);
            let points: Vec<Vec3> = scan
                .points
                .into_iter()
                .filter(|point| point.length() > NEAREST_M)
                .step_by(BEAM_STEP)
                .filter(|point| point.abs().cmplt(crop_m).all())
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

/// Sums over the residuals of any number of scans, in bounded memory.
#[derive(Clone, Debug, Default)]
pub struct ResidualSums {
    beams: usize,
    hits: usize,
    early: usize,
    late: usize,
    near_plane: usize,
    near_point: usize,
    beam_plane_m: Quantiles,
    point_m: Quantiles,
    ray_m: Quantiles,
    bias_m: Quantiles,
    /// Sum and number of the distances in cells of [`PICTURE_CELL_M`] where beams end.
    cells: HashMap<IVec3, (f32, f32)>,
}

impl ResidualSums {
    /// Adds the residuals of scans, whose points are relative to `origin` [m].
    pub fn add(&mut self, residuals: &[BeamResidual], origin: DVec3) {
        for beam in residuals {
            self.beams += 1;
            self.near_point += usize::from(beam.point_m < NEAR_M);
            self.point_m.add(beam.point_m);
            if beam.residual_m.is_finite() {
                self.hits += 1;
                self.early += usize::from(beam.residual_m < -GROSS_M);
                self.late += usize::from(beam.residual_m > GROSS_M);
                self.near_plane += usize::from(beam.beam_plane_m < NEAR_M);
                self.beam_plane_m.add(beam.beam_plane_m);
                self.ray_m.add(beam.residual_m.abs());
                self.bias_m.add(beam.residual_m);
            }
            if let Some(point) = beam.stopped_at {
                let cell = picture_cell(origin + point.as_dvec3());
                let (sum, count) = self.cells.entry(cell).or_default();
                *sum += beam.beam_plane_m.min(GROSS_M);
                *count += 1.0;
            }
        }
    }

    /// The summary; `None` where no beam hit the map.
    pub fn quality(&self) -> Option<MapQuality> {
        let share = |count: usize| count as f64 / self.beams as f64;
        (self.hits > 0).then(|| MapQuality {
            beams: self.beams,
            early: share(self.early),
            late: share(self.late),
            miss: share(self.beams - self.hits),
            beam_plane_median_m: self.beam_plane_m.median(),
            beam_plane_within_10cm: share(self.near_plane),
            point_median_m: self.point_m.median(),
            point_within_10cm: share(self.near_point),
            ray_median_m: self.ray_m.median(),
            bias_m: self.bias_m.median(),
        })
    }

    /// Per vertex the mean beam-plane distance around it, for a picture [m]; NaN where no beam was evaluated. Gross
    /// residuals count as 0.5 m.
    pub fn at_vertices(&self, mesh: &TriangleMesh) -> Vec<f32> {
        let mean = |vertex: &Vec3| {
            let cell = self.cells.get(&picture_cell(vertex.as_dvec3()));
            cell.map_or(f32::NAN, |(sum, count)| sum / count)
        };
        mesh.vertices.iter().map(mean).collect()
    }
}

fn picture_cell(point: DVec3) -> IVec3 {
    (point / PICTURE_CELL_M).floor().as_ivec3()
}

/// Numbers of values in intervals of a thousandth of the values.
#[derive(Clone, Debug, Default)]
struct Quantiles {
    counts: BTreeMap<i32, usize>,
}

impl Quantiles {
    /// Bits of the fraction that are ignored.
    const DROPPED_BITS: u32 = 13;

    fn add(&mut self, value: f32) {
        *self
            .counts
            .entry(ordered(value.to_bits().cast_signed()) >> Self::DROPPED_BITS)
            .or_default() += 1;
    }

    /// The middle of the interval of the median; NaN without values.
    fn median(&self) -> f64 {
        let half = self.counts.values().sum::<usize>() / 2;
        let mut below = 0;
        let found = self.counts.iter().find(|(_, count)| {
            below += **count;
            below > half
        });
        found.map_or(f64::NAN, |(interval, _)| {
            let middle = (interval << Self::DROPPED_BITS) + (1 << (Self::DROPPED_BITS - 1));
            let value = f32::from_bits(ordered(middle).cast_unsigned());
            f64::from(if value.is_nan() { f32::INFINITY } else { value })
        })
    }
}

/// The bits of a float as a number of the same order, and back.
fn ordered(bits: i32) -> i32 {
    bits ^ ((bits >> 31).cast_unsigned() >> 1).cast_signed()
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
        let mut sums = ResidualSums::default();
        for point in points {
            let residuals = compare(&mesh, &Scene::new(&mesh), &identity, &[*point]);
            sums.add(&residuals, DVec3::ZERO);
        }
        sums.quality().unwrap()
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
        let mut sums = ResidualSums::default();
        sums.add(&beams[..2], DVec3::ZERO);
        // As in a frame 2 m away.
        let moved = beams.map(|beam| BeamResidual {
            stopped_at: beam.stopped_at.map(|point| point - 2.0 * Vec3::X),
            ..beam
        });
        sums.add(&moved[2..], 2.0 * DVec3::X);
        let values = sums.at_vertices(&mesh);
        assert!((values[0] - 0.3).abs() < 1e-6);
        assert!(values[1].is_nan());
    }

    #[test]
    fn a_median_is_that_of_the_sorted_values_to_a_thousandth() {
        let values: Vec<f32> = (0..501).map(|i| (i as f32 * 0.37).sin().powi(3)).collect();
        let mut sorted = values.clone();
        sorted.sort_unstable_by(f32::total_cmp);
        let mut quantiles = Quantiles::default();
        assert!(quantiles.median().is_nan());
        values.iter().for_each(|&value| quantiles.add(value));
        let expected = f64::from(sorted[250]);
        assert!((quantiles.median() - expected).abs() <= 1e-3 * expected.abs());
        (0..600).for_each(|_| quantiles.add(f32::INFINITY));
        assert_eq!(quantiles.median(), f64::INFINITY);
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
