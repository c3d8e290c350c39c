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

use super::lanes::{LANES, Lanes, PlaneSumsOfLanes, dot, lanes, unit_cross};
use super::range_image::RangeImage;
use crate::simd::{Simd, SimdTask, dispatch};
use crate::validation::{
    InvalidValue, Validate, fraction, in_range, not_negative, positive, require,
};

/// Minimum cosine between normal and beam (unitless): a plane at a more grazing incidence is the gap between two
/// surfaces.
pub(super) const MIN_INCIDENCE: f32 = 0.02;

/// Settings of the normal estimation.
///
/// Defaults: values for sensors with about 2 cm of noise.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
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
        fraction("min_share", self.min_share)
    }
}

/// Unit normals in the lidar frame, towards the sensor, one per pixel, row-major; `None` where
/// there is no return or no plane with enough inliers.
pub fn estimate_normals(image: &RangeImage, config: &NormalConfig) -> Vec<Option<Vec3>> {
    let returns = Returns::of(image);
    let mut normals = vec![None; image.ranges.len()];
    let rows = normals.par_chunks_mut(image.model.width);
    rows.enumerate().for_each(|(row, normals)| {
        let spacing_rad = [
            image.model.row_spacing_rad(row),
            std::f32::consts::TAU / image.model.width as f32,
        ];
        dispatch(RowTask {
            returns: &returns,
            config,
            row,
            spacing_rad,
            normals,
        });
    });
    normals
}

/// The normals of a row of pixels.
struct RowTask<'a> {
    returns: &'a Returns,
    config: &'a NormalConfig,
    row: usize,
    /// Between rows and columns.
    spacing_rad: [f32; 2],
    normals: &'a mut [Option<Vec3>],
}

impl SimdTask for RowTask<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        for (group, normals) in self.normals.chunks_mut(LANES).enumerate() {
            let first = self.returns.index_of(self.row, group * LANES);
            let point = self.returns.points_from(first);
            let found = normals_of(self.returns, self.config, first, &point, self.spacing_rad);
            for (lane, normal) in normals.iter_mut().enumerate() {
                let found = Vec3::new(found[0][lane], found[1][lane], found[2][lane]);
                *normal = Some(found).filter(|normal| !normal.is_nan());
            }
        }
    }
}

/// Normals of the pixels from `first` on; NaN where there is none.
#[inline(always)]
fn normals_of(
    returns: &Returns,
    config: &NormalConfig,
    first: usize,
    point: &[Lanes; 3],
    spacing_rad: [f32; 2],
) -> [Lanes; 3] {
    let range_m = lanes(|lane| {
        let [x, y, z] = [point[0][lane], point[1][lane], point[2][lane]];
        (x * x + y * y + z * z).sqrt()
    });
    // Where there is no return, NaN becomes 1.
    let strides = spacing_rad.map(|angle_rad| {
        range_m.map(|range_m| {
            ((config.spacing_m / (range_m * angle_rad)).round() as usize).clamp(1, MAX_STRIDE)
        })
    });
    let neighborhood = Neighborhood::gather(returns, first, point, &strides);
    let tolerance_m = |normal: &[Lanes; 3]| {
        lanes(|lane| {
            let cosine = dot(normal, point, lane).abs() / range_m[lane];
            let across_m = config.tolerance_m + config.relative_tolerance * range_m[lane];
            across_m.min(config.beam_tolerance_m * cosine)
        })
    };
    let hypothesis = neighborhood.best_plane(tolerance_m);
    let inliers = neighborhood.inliers(&hypothesis, &tolerance_m(&hypothesis));
    let planes = inliers.fit();
    let mut normals = planes.normals;
    for lane in 0..LANES {
        let cosine = -dot(&normals, point, lane) / range_m[lane];
        let least = (config.min_share * neighborhood.count[lane]).floor();
        let is_found = inliers.count[lane] - 1.0 >= least.max(config.min_support as f32)
            // The tilt of a strip hardly wider than the noise is undetermined.
            && planes.middle[lane] >= 4.0 * planes.smallest[lane]
            && cosine.abs() >= MIN_INCIDENCE;
        let sign = if is_found { cosine.signum() } else { f32::NAN };
        for axis in &mut normals {
            axis[lane] *= sign;
        }
    }
    normals
}

/// Most returns around a pixel.
const NEIGHBORS: usize = 24;
/// Rows down and columns to the right of a pixel, in strides.
const OFFSETS: [[isize; 2]; NEIGHBORS] = {
    let mut offsets = [[0; 2]; NEIGHBORS];
    let mut number = 0;
    while number < NEIGHBORS {
        let cell = if number < NEIGHBORS / 2 {
            number
        } else {
            number + 1
        };
        offsets[number] = [(cell / 5) as isize - 2, (cell % 5) as isize - 2];
        number += 1;
    }
    offsets
};
/// The eight directions around a pixel, clockwise: number of the outer neighbor and of the one before it.
const AROUND: [[usize; 2]; 8] = [
    [2, 7],
    [4, 8],
    [13, 12],
    [23, 17],
    [21, 16],
    [19, 15],
    [10, 11],
    [0, 6],
];

/// The returns around some pixels, relative to theirs.
struct Neighborhood {
    /// x, y and z; NaN where there is no return.
    offsets: [[Lanes; NEIGHBORS]; 3],
    count: Lanes,
}

impl Neighborhood {
    /// The returns of every `strides`-th row and column around the pixels from `first` on.
    #[inline(always)]
    fn gather(
        returns: &Returns,
        first: usize,
        point: &[Lanes; 3],
        [rows, columns]: &[[usize; LANES]; 2],
    ) -> Self {
        let mut offsets = [[[0.0; LANES]; NEIGHBORS]; 3];
        let are_alike = rows.iter().all(|row| row == &rows[0])
            && columns.iter().all(|column| column == &columns[0]);
        for (number, &[down, right]) in OFFSETS.iter().enumerate() {
            let index = |lane: usize| {
                let [row, column] = [rows[lane] as isize, columns[lane] as isize];
                let offset = down * row * returns.width as isize + right * column;
                (first + lane).wrapping_add_signed(offset)
            };
            for axis in 0..3 {
                let returns = &returns.axes[axis];
                let neighbors = if are_alike {
                    let mut neighbors = [0.0; LANES];
                    neighbors.copy_from_slice(&returns[index(0)..][..LANES]);
                    neighbors
                } else {
                    lanes(|lane| returns[index(lane)])
                };
                offsets[axis][number] = lanes(|lane| neighbors[lane] - point[axis][lane]);
            }
        }
        let mut count = [0.0; LANES];
        for x in &offsets[0] {
            for lane in 0..LANES {
                count[lane] += if x[lane].is_nan() { 0.0 } else { 1.0 };
            }
        }
        Self { offsets, count }
    }

    /// A neighbor in one of the directions around a pixel: the outer one, or else the inner one.
    #[inline(always)]
    fn around(&self, direction: usize) -> [Lanes; 3] {
        let [outer, inner] = AROUND[direction % AROUND.len()];
        let has_outer = &self.offsets[0][outer];
        std::array::from_fn(|axis| {
            let [outer, inner] = [&self.offsets[axis][outer], &self.offsets[axis][inner]];
            lanes(|lane| {
                if has_outer[lane].is_nan() {
                    inner[lane]
                } else {
                    outer[lane]
                }
            })
        })
    }

    /// The unit normals of the planes through the returns of the pixels that have the largest support; NaN without any.
    #[inline(always)]
    fn best_plane(&self, tolerance_m: impl Fn(&[Lanes; 3]) -> Lanes) -> [Lanes; 3] {
        /// With this share of the largest possible support, others are not tried: they have about the same inliers.
        const ENOUGH: f32 = 0.8;
        // Infinite where no other plane is tried.
        let mut most = self
            .count
            .map(|count| if count > 0.0 { 0.0 } else { f32::INFINITY });
        let mut best = [[f32::NAN; LANES]; 3];
        for direction in 0..AROUND.len() {
            let normal = unit_cross(&self.around(direction), &self.around(direction + 2));
            let tolerance_m = tolerance_m(&normal);
            let mut support = [0.0; LANES];
            for number in 0..NEIGHBORS {
                for lane in 0..LANES {
                    let distance_m = self.along(&normal, number, lane).abs();
                    let share = 1.0 - distance_m / tolerance_m[lane];
                    support[lane] += if share > 0.0 { share } else { 0.0 };
                }
            }
            for lane in 0..LANES {
                let is_better = support[lane] > most[lane];
                for axis in 0..3 {
                    best[axis][lane] = if is_better {
                        normal[axis][lane]
                    } else {
                        best[axis][lane]
                    };
                }
                let is_enough = support[lane] > ENOUGH * self.count[lane];
                let support = if is_enough {
                    f32::INFINITY
                } else {
                    support[lane]
                };
                most[lane] = if is_better { support } else { most[lane] };
            }
            if most.iter().all(|&most| most == f32::INFINITY) {
                break;
            }
        }
        best
    }

    /// Sums of the inliers of planes, and of the returns of the pixels themselves.
    #[inline(always)]
    fn inliers(&self, normal: &[Lanes; 3], tolerance_m: &Lanes) -> PlaneSumsOfLanes {
        let mut sums = PlaneSumsOfLanes::of_origin();
        for number in 0..NEIGHBORS {
            let (mut weight, mut inlier) = ([0.0; LANES], [[0.0; LANES]; 3]);
            for lane in 0..LANES {
                let is_inlier = self.along(normal, number, lane).abs() < tolerance_m[lane];
                weight[lane] = if is_inlier { 1.0 } else { 0.0 };
                for (inlier, offsets) in inlier.iter_mut().zip(&self.offsets) {
                    inlier[lane] = if is_inlier {
                        offsets[number][lane]
                    } else {
                        0.0
                    };
                }
            }
            sums.add(&weight, &inlier);
        }
        sums
    }

    /// Signed distance of a neighbor to the plane through the pixel's return with a unit normal [m].
    #[inline(always)]
    fn along(&self, normal: &[Lanes; 3], number: usize, lane: usize) -> f32 {
        let [x, y, z] = &self.offsets;
        normal[0][lane] * x[number][lane]
            + normal[1][lane] * y[number][lane]
            + normal[2][lane] * z[number][lane]
    }
}

/// Largest stride between the pixels of a neighborhood.
const MAX_STRIDE: usize = 4;
/// Rows and columns around an image that neighborhoods reach.
const MARGIN: usize = 2 * MAX_STRIDE;

/// The returns of an image, an axis after the other, with margins: the columns go on around the sensor, and above and below
/// there are no returns.
struct Returns {
    /// Row-major; NaN where there is no return [m].
    axes: [Vec<f32>; 3],
    /// With margins.
    width: usize,
}

impl Returns {
    fn of(image: &RangeImage) -> Self {
        let (height, own_width) = (image.model.height, image.model.width);
        // The last group of a row may reach beyond it.
        let width = own_width + 2 * MARGIN + LANES;
        let mut axes: [Vec<f32>; 3] =
            std::array::from_fn(|_| vec![f32::NAN; (height + 2 * MARGIN) * width]);
        for row in 0..height {
            let columns = (0..own_width).cycle();
            let columns = columns.skip((own_width - MARGIN % own_width) % own_width);
            for (column, own_column) in columns.take(width).enumerate() {
                let own = row * own_width + own_column;
                if image.has_return(own) {
                    let index = (row + MARGIN) * width + column;
                    for (axis, number) in axes.iter_mut().zip(image.points[own].to_array()) {
                        axis[index] = number;
                    }
                }
            }
        }
        Self { axes, width }
    }

    /// Index of a pixel of the image.
    fn index_of(&self, row: usize, column: usize) -> usize {
        (row + MARGIN) * self.width + MARGIN + column
    }

    /// The returns of the pixels from `first` on.
    #[inline(always)]
    fn points_from(&self, first: usize) -> [Lanes; 3] {
        std::array::from_fn(|axis| lanes(|lane| self.axes[axis][first + lane]))
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;
    use crate::lidar::LidarModel;
    use crate::lidar::range_image::NO_RETURN;
    use crate::simd::Baseline;

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
    fn all_instruction_sets_give_the_same_normals() {
        let image = image_of(ground_and_wall);
        let config = NormalConfig::default();
        let returns = Returns::of(&image);
        let width = image.model.width;
        for (row, best) in estimate_normals(&image, &config).chunks(width).enumerate() {
            let mut normals = vec![None; width];
            let spacing_rad = [
                image.model.row_spacing_rad(row),
                std::f32::consts::TAU / width as f32,
            ];
            let task = RowTask {
                returns: &returns,
                config: &config,
                row,
                spacing_rad,
                normals: &mut normals,
            };
            task.run(Baseline);
            assert_eq!(normals, best);
        }
    }

    #[test]
    fn narrow_images_have_the_normals_of_their_pixels() {
        // Fewer columns than a neighborhood or a group has.
        let model = LidarModel {
            width: 5,
            ..LidarModel::default()
        };
        let ranges = vec![9.0; model.len()];
        let normals = estimate_normals(
            &RangeImage::from_ranges(ranges, &model),
            &NormalConfig::default(),
        );
        assert_eq!(normals.len(), model.len());
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
