//! A scan as an image: per pixel the nearest return, its range and the beam that it came along.

use glam::Vec3;

use super::{Beam, LidarModel};

/// The range of a pixel in which nothing was seen: farther than everything.
pub const NO_RETURN: f32 = f32::INFINITY;

/// Which point of the scan won a pixel where none did.
const NO_POINT: u32 = u32::MAX;

/// Ranges and points per pixel, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct RangeImage {
    /// The projection that the image was made with.
    pub model: LidarModel,
    /// Range of the nearest return [m], or [`NO_RETURN`].
    pub ranges: Vec<f32>,
    /// The nearest return itself, lidar frame [m]; zero where there is none.
    pub points: Vec<Vec3>,
    winners: Vec<u32>,
}

impl RangeImage {
    /// Projects points of the lidar frame; the nearest wins, and of two as near the first.
    /// Points outside the field of view or the range limits, or not finite, are left out.
    pub fn project(points: &[Vec3], model: &LidarModel) -> Self {
        let mut image = Self {
            model: *model,
            ranges: vec![NO_RETURN; model.len()],
            points: vec![Vec3::ZERO; model.len()],
            winners: vec![NO_POINT; model.len()],
        };
        for (number, &point) in points.iter().enumerate() {
            let range_m = point.length();
            if !model.accepts_range(range_m) {
                continue;
            }
            let Some(pixel) = model.pixel_of(point) else {
                continue;
            };
            let index = model.index_of(pixel);
            if range_m < image.ranges[index] {
                image.ranges[index] = range_m;
                image.points[index] = point;
                image.winners[index] = number as u32;
            }
        }
        image
    }

    /// An image of ranges without points, such as a renderer makes: the points lie on the pixels' centre rays.
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
            model: *model,
            winners: vec![NO_POINT; ranges.len()],
            ranges,
            points,
        }
    }

    /// Whether something was seen in the pixel at a row-major index.
    #[inline]
    pub fn has_return(&self, index: usize) -> bool {
        self.ranges[index] != NO_RETURN
    }

    /// Which of the projected points won the pixel at a row-major index.
    pub fn point_number(&self, index: usize) -> Option<usize> {
        let number = self.winners[index];
        (number != NO_POINT).then_some(number as usize)
    }

    /// The beam whose return won the pixel, along the direction that was really measured.
    pub fn beam(&self, index: usize) -> Option<Beam> {
        self.has_return(index).then(|| Beam {
            direction: self.points[index] / self.ranges[index],
            range_m: self.ranges[index],
        })
    }

    /// All beams with a return, row by row.
    pub fn beams(&self) -> impl Iterator<Item = Beam> {
        (0..self.ranges.len()).filter_map(|index| self.beam(index))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_return_wins_whatever_the_order() {
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
    fn a_pixel_knows_its_point_and_the_direction_of_its_beam() {
        let model = LidarModel::default();
        let points = [Vec3::new(8.0, 3.0, -1.0), Vec3::new(-7.0, 1.0, 0.1)];
        let image = RangeImage::project(&points, &model);
        for (number, &point) in points.iter().enumerate() {
            let index = model.index_of(model.pixel_of(point).unwrap());
            assert_eq!(image.point_number(index), Some(number));
            let beam = image.beam(index).unwrap();
            assert!((beam.point() - point).length() < 1e-5);
            assert!((beam.direction.length() - 1.0).abs() < 1e-6);
        }
    }

    #[test]
    fn invalid_points_leave_no_trace() {
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
    fn projecting_the_points_of_an_image_gives_the_image_back() {
        let model = LidarModel::default();
        let ranges: Vec<f32> = (0..model.len()).map(|i| 3.0 + (i % 37) as f32).collect();
        let image = RangeImage::from_ranges(ranges.clone(), &model);
        let again = RangeImage::project(&image.points, &model);
        for (a, b) in ranges.iter().zip(&again.ranges) {
            assert!((a - b).abs() < 1e-4, "{a} {b}");
        }
    }
}
