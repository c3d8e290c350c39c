//! Range images: per pixel the range of the nearest return and its measured beam.

use glam::Vec3;
use rayon::prelude::*;

use super::model::LidarModel;
use super::projection::Projection;
use super::scan::Beam;

/// Range of a pixel without a return.
pub const NO_RETURN: f32 = f32::INFINITY;

/// Point index of a pixel without a point.
const NO_POINT: u32 = u32::MAX;

/// Range and point per pixel, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeImage {
    /// Projection of the image.
    pub model: LidarModel,
    /// Range of the nearest return [m]; infinite without a return.
    pub ranges: Vec<f32>,
    /// Nearest return in the lidar frame [m]; zero without one.
    pub points: Vec<Vec3>,
    point_indices: Vec<u32>,
}

impl RangeImage {
    /// Projects points of the lidar frame; a pixel keeps the nearest, the first among equals. Points
    /// that are not finite or are outside the field of view or the range limits are ignored.
    pub fn project(points: &[Vec3], model: &LidarModel) -> Self {
        Self::project_each(points.len(), |number| Some(points[number]), model)
    }

    /// The same of points by their numbers; `None` for those that are left out.
    pub(crate) fn project_each(
        count: usize,
        point_of: impl Fn(usize) -> Option<Vec3> + Sync,
        model: &LidarModel,
    ) -> Self {
        let projection = Projection::of(model);
        let range_and_pixel = |number: usize| {
            let found = point_of(number).and_then(|point| {
                let range_m = point.length();
                let pixel = (model.accepts_range(range_m)).then(|| projection.pixel_of(point));
                Some((range_m, pixel.flatten()? as u32))
            });
            found.unwrap_or((NO_RETURN, 0))
        };
        let found = (0..count).into_par_iter().map(range_and_pixel);
        let found: Vec<(f32, u32)> = found.collect();
        let mut ranges = vec![NO_RETURN; model.len()];
        let mut point_indices = vec![NO_POINT; model.len()];
        for (number, (range_m, pixel)) in found.into_iter().enumerate() {
            let pixel = pixel as usize;
            if range_m != NO_RETURN && range_m < ranges[pixel] {
                ranges[pixel] = range_m;
                point_indices[pixel] = number as u32;
            }
        }
        let nearest = |&number: &u32| (number != NO_POINT).then(|| point_of(number as usize));
        let points = (point_indices.par_iter()).map(|it| nearest(it).flatten().unwrap_or_default());
        Self {
            model: model.clone(),
            ranges,
            points: points.collect(),
            point_indices,
        }
    }

    /// An image of ranges [m], row-major, infinite without a return, with points on the rays through the pixel centres.
    pub fn from_ranges(ranges: Vec<f32>, model: &LidarModel) -> Self {
        debug_assert_eq!(ranges.len(), model.len());
        let points = ranges
            .iter()
            .zip(model.directions())
            .map(|(&range_m, direction)| {
                if range_m.is_finite() {
                    direction * range_m
                } else {
                    Vec3::ZERO
                }
            })
            .collect();
        Self {
            model: model.clone(),
            point_indices: vec![NO_POINT; ranges.len()],
            ranges,
            points,
        }
    }

    /// Whether the pixel at a row-major index has a return.
    #[inline]
    pub fn has_return(&self, index: usize) -> bool {
        self.ranges[index] != NO_RETURN
    }

    /// Index of the projected point in the pixel at a row-major index.
    pub(crate) fn point_index(&self, index: usize) -> Option<usize> {
        let point = self.point_indices[index];
        (point != NO_POINT).then_some(point as usize)
    }

    /// The beam of a pixel along its measured direction; `None` without a return.
    pub(crate) fn beam(&self, index: usize) -> Option<Beam> {
        self.has_return(index).then(|| Beam {
            direction: self.points[index] / self.ranges[index],
            range_m: self.ranges[index],
        })
    }

    /// The measured ranges along the centre rays of their pixels, row-major.
    pub(crate) fn center_beams(&self) -> impl Iterator<Item = Beam> {
        let returns = (0..self.ranges.len()).filter(|&index| self.has_return(index));
        returns.map(|index| Beam {
            direction: self.model.direction_of(index),
            range_m: self.ranges[index],
        })
    }

    /// All beams with a return, row-major.
    pub fn beams(&self) -> impl Iterator<Item = Beam> {
        (0..self.ranges.len()).filter_map(|index| self.beam(index))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pixel_keeps_the_nearest_return_in_any_order() {
        let model = LidarModel::default();
        let near = Vec3::new(10.0, 0.0, 0.0);
        let far = Vec3::new(20.0, 0.0, 0.0);
        for points in [[near, far], [far, near]] {
            let image = RangeImage::project(&points, &model);
            let beams: Vec<Beam> = image.beams().collect();
            assert_eq!(beams.len(), 1);
            assert_eq!(beams[0].range_m, 10.0);
            assert_eq!(beams[0].direction, Vec3::X);
        }
    }

    #[test]
    fn a_pixel_keeps_the_index_and_the_direction_of_its_point() {
        let model = LidarModel::default();
        let points = [Vec3::new(8.0, 3.0, -1.0), Vec3::new(-7.0, 1.0, 0.1)];
        let image = RangeImage::project(&points, &model);
        for (number, &point) in points.iter().enumerate() {
            let index = Projection::of(&model).pixel_of(point).unwrap();
            assert_eq!(image.point_index(index), Some(number));
            let beam = image.beam(index).unwrap();
            assert!((beam.point() - point).length() < 1e-5);
            assert!((beam.direction.length() - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn invalid_points_are_ignored() {
        let model = LidarModel::default();
        let points = [
            Vec3::NAN,
            Vec3::ZERO,
            Vec3::new(f32::INFINITY, 1.0, 1.0),
            Vec3::new(1.0, 0.0, 0.0),
            Vec3::new(10.0, 0.0, 10.0),
        ];
        let image = RangeImage::project(&points, &model);
        assert_eq!(image.beams().count(), 0);
    }

    #[test]
    fn projecting_the_points_of_an_image_reproduces_the_image() {
        let model = LidarModel::default();
        let ranges: Vec<f32> = (0..model.len()).map(|i| 3.0 + (i % 37) as f32).collect();
        let image = RangeImage::from_ranges(ranges.clone(), &model);
        let again = RangeImage::project(&image.points, &model);
        for (a, b) in ranges.iter().zip(&again.ranges) {
            assert!((a - b).abs() < 1e-4, "{a} {b}");
        }
    }
}
