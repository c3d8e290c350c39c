//! Surface normals from a range image by robust plane fitting in a 5 x 5 neighborhood.
//!
//! Near the sensor, where neighboring pixels are closer together than the noise allows, the
//! neighborhood takes every second, third or fourth pixel. The hypotheses are the planes through the
//! pixel and two of its outer neighbors; the one with the largest support
//!
//! ```text
//! Σᵢ max(0, 1 − |n · (pᵢ − p)| / tolerance)        tolerance = tolerance_m + relative · range
//!                                                   but at most beam_tolerance_m · |n · beam|
//! ```
//!
//! is selected (MSAC, Torr and Zisserman 2000, over a fixed set of hypotheses), and the principal
//! components of its inliers give the normal. So neighbors beyond a range discontinuity are outliers,
//! missing neighbors are tolerated, and without enough inliers there is no normal.

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::range_image::RangeImage;
use crate::geometry::PlaneSums;
use crate::validation::{
    InvalidValue, Validate, fraction, in_range, not_negative, positive, require,
};

/// Settings of the normal estimation.
///
/// Defaults: values for sensors with about 2 cm of noise.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[serde(default, deny_unknown_fields)]
pub struct NormalConfig {
    /// Desired distance between the pixels of a neighborhood near the sensor [m].
    #[default(0.12)]
    pub spacing_m: f32,
    /// Inlier distance to the plane at range 0 [m].
    #[default(0.05)]
    pub tolerance_m: f32,
    /// Increase of the inlier distance per meter of range (unitless).
    #[default(0.001)]
    pub relative_tolerance: f32,
    /// Inlier distance along the beam [m]; the stricter limit at grazing incidence.
    #[default(1.0)]
    pub beam_tolerance_m: f32,
    /// Minimum number of inliers, without the pixel itself.
    #[default(5)]
    pub min_support: usize,
    /// Minimum share of inliers among the neighbors, 0 to 1 (unitless).
    #[default(0.35)]
    pub min_share: f32,
    /// Minimum cosine between normal and beam (unitless): a plane at a more grazing incidence is the
    /// gap between two surfaces.
    #[default(0.02)]
    pub min_incidence: f32,
}

impl Validate for NormalConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("spacing_m", self.spacing_m, 0.001..=10.0)?;
        positive("tolerance_m", self.tolerance_m)?;
        not_negative("relative_tolerance", self.relative_tolerance)?;
        positive("beam_tolerance_m", self.beam_tolerance_m)?;
        require(
            self.min_support >= 2,
            "min_support",
            self.min_support,
            "a plane needs a pixel and 2 inliers or more",
        )?;
        fraction("min_share", self.min_share)?;
        fraction("min_incidence", self.min_incidence)
    }
}

/// Largest stride between the pixels of a neighborhood.
const MAX_STRIDE: isize = 4;
/// Column and row offsets of the eight outer neighbors, clockwise.
const OUTER: [(isize, isize); 8] = [
    (0, -1),
    (1, -1),
    (1, 0),
    (1, 1),
    (0, 1),
    (-1, 1),
    (-1, 0),
    (-1, -1),
];

/// Unit normals in the lidar frame, towards the sensor, one per pixel, row-major; `None` where
/// there is no return or no plane with enough inliers.
pub fn estimate_normals(image: &RangeImage, config: &NormalConfig) -> Vec<Option<Vec3>> {
    (0..image.model.height)
        .into_par_iter()
        .flat_map_iter(|row| {
            let spacing_rad = image.model.row_spacing_rad(row);
            (0..image.model.width)
                .map(move |column| normal_at(image, config, [row, column], spacing_rad))
        })
        .collect()
}

/// Most returns around a pixel.
const NEIGHBORS: usize = 24;

/// The returns around a pixel, relative to its own.
struct Neighborhood {
    /// x, y and z; far away where there is no return.
    offsets: [[f32; NEIGHBORS]; 3],
    count: usize,
    outer: [Option<Vec3>; 8],
}

fn normal_at(
    image: &RangeImage,
    config: &NormalConfig,
    [row, column]: [usize; 2],
    row_spacing_rad: f32,
) -> Option<Vec3> {
    let index = row * image.model.width + column;
    if !image.has_return(index) {
        return None;
    }
    let (point, range_m) = (image.points[index], image.ranges[index]);
    let stride = |angle_rad: f32| {
        ((config.spacing_m / (range_m * angle_rad)).round() as isize).clamp(1, MAX_STRIDE)
    };
    let column_spacing_rad = std::f32::consts::TAU / image.model.width as f32;
    let strides = [stride(row_spacing_rad), stride(column_spacing_rad)];
    let neighborhood = Neighborhood::gather(image, [row as isize, column as isize], strides);
    let tolerance_m = |normal: Vec3| {
        let cosine = normal.dot(point).abs() / range_m;
        let across_m = config.tolerance_m + config.relative_tolerance * range_m;
        across_m.min(config.beam_tolerance_m * cosine)
    };
    let hypothesis = neighborhood.best_plane(tolerance_m)?;
    let tolerance_m = tolerance_m(hypothesis);
    let min_inliers = config
        .min_support
        .max((config.min_share * neighborhood.count as f32) as usize);

    let mut sums = PlaneSums::about(point);
    sums.add(point);
    let mut inliers = 0;
    let distances_m = neighborhood.distances_m(hypothesis);
    for (number, distance_m) in distances_m[..neighborhood.count].iter().enumerate() {
        if *distance_m < tolerance_m {
            let [x, y, z] = neighborhood.offsets.map(|axis| axis[number]);
            sums.add(point + Vec3::new(x, y, z));
            inliers += 1;
        }
    }
    let plane = sums.fit().filter(|_| inliers >= min_inliers)?;
    // The tilt of a strip hardly wider than the noise is undetermined.
    if plane.variances[1] < 4.0 * plane.variances[0] {
        return None;
    }
    let cosine = -plane.normal.dot(point) / range_m;
    (cosine.abs() >= config.min_incidence).then_some(plane.normal * cosine.signum())
}

impl Neighborhood {
    /// The returns of every `strides`-th row and column around one.
    fn gather(image: &RangeImage, [row, column]: [isize; 2], strides: [isize; 2]) -> Self {
        /// So far away that it supports no plane [m].
        const NOWHERE_M: f32 = 1e9;
        let (height, width) = (image.model.height as isize, image.model.width as isize);
        let point = image.points[(row * width + column) as usize];
        let offsets = [-2, -1, 0, 1, 2_isize];
        let columns = offsets.map(|right| (column + right * strides[1]).rem_euclid(width));
        let mut found = Self {
            offsets: [[NOWHERE_M; NEIGHBORS]; 3],
            count: 0,
            outer: [None; 8],
        };
        let mut grid = [[None; 5]; 5];
        for (down, line) in grid.iter_mut().enumerate() {
            let row = row + offsets[down] * strides[0];
            if !(0..height).contains(&row) {
                continue;
            }
            for (right, cell) in line.iter_mut().enumerate() {
                let index = (row * width + columns[right]) as usize;
                if [down, right] == [2, 2] || !image.has_return(index) {
                    continue;
                }
                let offset = image.points[index] - point;
                *cell = Some(offset);
                found.offsets[0][found.count] = offset.x;
                found.offsets[1][found.count] = offset.y;
                found.offsets[2][found.count] = offset.z;
                found.count += 1;
            }
        }
        for (outer, (right, down)) in found.outer.iter_mut().zip(OUTER) {
            let at =
                |radius: isize| grid[(2 + radius * down) as usize][(2 + radius * right) as usize];
            *outer = at(2).or(at(1));
        }
        found
    }

    /// Distances to the plane through the pixel's return with a unit normal [m].
    fn distances_m(&self, normal: Vec3) -> [f32; NEIGHBORS] {
        let [x, y, z] = &self.offsets;
        let mut distances_m = [0.0; NEIGHBORS];
        for number in 0..NEIGHBORS {
            let along = normal.x * x[number] + normal.y * y[number] + normal.z * z[number];
            distances_m[number] = along.abs();
        }
        distances_m
    }

    /// The unit normal of the plane through the pixel's return that has the largest support.
    fn best_plane(&self, tolerance_m: impl Fn(Vec3) -> f32) -> Option<Vec3> {
        /// Sums that are made side by side.
        const LANES: usize = 8;
        /// With this share of the largest possible support, others are not tried: they have about the same inliers.
        const ENOUGH: f32 = 0.8;
        let mut best = (0.0, None);
        for first in 0..8 {
            let (Some(a), Some(b)) = (self.outer[first], self.outer[(first + 2) % 8]) else {
                continue;
            };
            let Some(normal) = a.cross(b).try_normalize() else {
                continue;
            };
            let per_tolerance = 1.0 / tolerance_m(normal);
            let distances_m = self.distances_m(normal);
            let mut sums = [0.0_f32; LANES];
            for distances_m in distances_m.chunks_exact(LANES) {
                for lane in 0..LANES {
                    let support = 1.0 - distances_m[lane] * per_tolerance;
                    sums[lane] += if support > 0.0 { support } else { 0.0 };
                }
            }
            let support: f32 = sums.iter().sum();
            if support > best.0 {
                best = (support, Some(normal));
            }
            if support > ENOUGH * self.count as f32 {
                break;
            }
        }
        best.1
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::lidar::{LidarModel, NO_RETURN};

    /// The image of a scene given as the range along a unit direction.
    fn image_of(range_along: impl Fn(Vec3) -> f32) -> RangeImage {
        let model = LidarModel::default();
        let ranges = model
            .directions()
            .into_iter()
            .map(|direction| {
                let range_m = range_along(direction);
                if model.accepts_range(range_m) {
                    range_m
                } else {
                    NO_RETURN
                }
            })
            .collect();
        RangeImage::from_ranges(ranges, &model)
    }

    /// Range to the plane `normal · p = offset`, infinite behind.
    fn plane_range(direction: Vec3, normal: Vec3, offset: f32) -> f32 {
        let range_m = offset / normal.dot(direction);
        if range_m > 0.0 {
            range_m
        } else {
            f32::INFINITY
        }
    }

    fn ground_and_wall(direction: Vec3) -> f32 {
        plane_range(direction, Vec3::Z, -1.73).min(plane_range(direction, Vec3::X, 12.0))
    }

    #[test]
    fn normals_of_ground_and_wall_are_correct_and_face_the_sensor() {
        let image = image_of(ground_and_wall);
        let normals = estimate_normals(&image, &NormalConfig::default());
        let (mut returns, mut found) = (0, 0);
        for (index, normal) in normals.iter().enumerate() {
            returns += usize::from(image.has_return(index));
            let Some(normal) = *normal else { continue };
            found += 1;
            let best = normal.dot(Vec3::Z).max(normal.dot(-Vec3::X));
            assert!(best > 0.99, "{normal} at {index}");
            assert!(normal.dot(image.points[index]) < 0.0);
        }
        assert!(found as f32 > 0.97 * returns as f32, "{found} of {returns}");
    }

    #[test]
    fn a_range_discontinuity_gives_no_false_normals() {
        // Two walls across the view, one 6 m behind the other, side by side.
        let image = image_of(|direction| {
            let near = plane_range(direction, Vec3::X, 8.0);
            let far = plane_range(direction, Vec3::X, 14.0);
            if direction.y > 0.0 { near } else { far }
        });
        let normals = estimate_normals(&image, &NormalConfig::default());
        assert!(normals.iter().flatten().count() > 10_000);
        for normal in normals.iter().flatten() {
            assert!(normal.dot(-Vec3::X) > 0.999, "{normal}");
        }
    }

    #[test]
    fn missing_neighbors_are_tolerated() {
        let full = image_of(ground_and_wall);
        let ranges = full
            .ranges
            .iter()
            .enumerate()
            // Every third pixel is missing, along the rows and down the columns.
            .map(|(index, &range_m)| {
                if (index + index / 900) % 3 == 0 {
                    NO_RETURN
                } else {
                    range_m
                }
            })
            .collect();
        let holed = RangeImage::from_ranges(ranges, &full.model);
        let normals = estimate_normals(&holed, &NormalConfig::default());
        let returns = holed.beams().count();
        let found = normals.iter().flatten().count();
        assert!(found as f32 > 0.9 * returns as f32, "{found} of {returns}");
        for normal in normals.iter().flatten() {
            assert!(
                normal.dot(Vec3::Z).max(normal.dot(-Vec3::X)) > 0.99,
                "{normal}"
            );
        }
    }

    #[test]
    fn a_scatter_of_points_has_no_normals() {
        let model = LidarModel::default();
        // Independent ranges: no two neighbors share a surface.
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let ranges = (0..model.len())
            .map(|_| rng.random_range(5.0..40.0))
            .collect();
        let image = RangeImage::from_ranges(ranges, &model);
        let found = estimate_normals(&image, &NormalConfig::default())
            .iter()
            .flatten()
            .count();
        assert!((found as f32) < 0.03 * model.len() as f32, "{found}");
    }

    #[test]
    fn an_isolated_pixel_has_no_normal() {
        let model = LidarModel::default();
        let mut ranges = vec![NO_RETURN; model.len()];
        ranges[30 * model.width + 7] = 9.0;
        let image = RangeImage::from_ranges(ranges, &model);
        assert!(
            estimate_normals(&image, &NormalConfig::default())
                .iter()
                .all(Option::is_none)
        );
    }

    #[test]
    fn the_neighborhood_wraps_around_the_last_column() {
        let image = image_of(|direction| plane_range(direction, Vec3::Z, -1.73));
        let normals = estimate_normals(&image, &NormalConfig::default());
        let row = 50 * image.model.width;
        for column in [0, 1, 898, 899] {
            assert!(normals[row + column].is_some_and(|normal| normal.z > 0.999));
        }
    }
}
