//! Why points are lost when a scan is projected.

use serde::{Deserialize, Serialize};

use crate::lidar::{LidarModel, Projection, RangeImage, Scan};

/// Number of points of a scan that a range image loses, by reason; kept plus lost is the total.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct DroppedPoints {
    /// Points of the scan.
    pub points: usize,
    /// Not finite, or at the origin: marks of beams without a return.
    pub without_return: usize,
    /// In the rectangle of the own car.
    pub own_car: usize,
    /// Nearer than the least range.
    pub too_near: usize,
    /// Farther than the greatest range.
    pub too_far: usize,
    /// Above or below the field of view, or between rows.
    pub outside_image: usize,
    /// In the pixel and the direction of a nearer point: the second return of a pulse.
    pub second_return: usize,
    /// In the pixel of a nearer point, in another direction.
    pub same_pixel: usize,
}

/// A reason that calls for another projection.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DropReason {
    /// In the rectangle of the own car.
    OwnCar,
    /// Nearer than the least range.
    TooNear,
    /// Farther than the greatest range.
    TooFar,
    /// Outside the image.
    OutsideImage,
    /// In the pixel of a nearer point.
    SamePixel,
}

impl DropReason {
    /// Keys of the configuration that keep more points.
    pub(crate) fn keys(self) -> &'static str {
        match self {
            Self::OwnCar => "own_car_m",
            Self::TooNear => "range_image.min_range",
            Self::TooFar => "range_image.max_range",
            Self::OutsideImage => {
                "range_image.fov_up, range_image.fov_down, range_image.elevations"
            }
            Self::SamePixel => "range_image.height, range_image.width",
        }
    }

    /// What happened to the points.
    pub(crate) fn description(self) -> &'static str {
        match self {
            Self::OwnCar => "are in the rectangle of the own car",
            Self::TooNear => "are nearer than the least range",
            Self::TooFar => "are farther than the greatest range",
            Self::OutsideImage => "are outside the range image",
            Self::SamePixel => "share a pixel with a nearer point",
        }
    }
}

impl DroppedPoints {
    /// Share of the returns that is too many to lose for one reason (unitless).
    pub(crate) const TOO_MANY: f64 = 0.2;

    /// Counts the points of a scan that are not in its range image.
    pub fn count(scan: &Scan, lidar: &LidarModel, own_car_m: [f32; 4]) -> Self {
        /// Greatest angle between two returns of one pulse [rad].
        const SAME_DIRECTION_RAD: f32 = 3e-4;
        let mut scan = scan.clone();
        let mut counts = Self {
            points: scan.len(),
            ..Self::default()
        };
        let any_range = LidarModel {
            min_range: 0.0,
            max_range: f32::INFINITY,
            ..lidar.clone()
        };
        counts.without_return = scan.drop_invalid(&any_range);
        counts.own_car = scan.drop_inside(own_car_m);
        let image = RangeImage::project(&scan.points, lidar);
        let projection = Projection::of(lidar);
        for (number, &point) in scan.points.iter().enumerate() {
            let range_m = point.length();
            if range_m <= lidar.min_range {
                counts.too_near += 1;
            } else if range_m >= lidar.max_range {
                counts.too_far += 1;
            } else if let Some(pixel) = projection.pixel_of(point) {
                let nearest = image.points[pixel];
                if image.point_index(pixel) == Some(number) {
                    continue;
                } else if nearest.cross(point).length()
                    < SAME_DIRECTION_RAD * image.ranges[pixel] * range_m
                {
                    counts.second_return += 1;
                } else {
                    counts.same_pixel += 1;
                }
            } else {
                counts.outside_image += 1;
            }
        }
        counts
    }

    /// Adds the counts of another scan.
    pub fn add(&mut self, other: &Self) {
        self.points += other.points;
        self.without_return += other.without_return;
        self.own_car += other.own_car;
        self.too_near += other.too_near;
        self.too_far += other.too_far;
        self.outside_image += other.outside_image;
        self.second_return += other.second_return;
        self.same_pixel += other.same_pixel;
    }

    /// Share of the returns that are above or below the field of view, or between rows (unitless).
    pub fn share_outside(&self) -> f64 {
        self.outside_image as f64 / self.returns()
    }

    /// Number of returns, at least one.
    fn returns(&self) -> f64 {
        (self.points - self.without_return - self.second_return).max(1) as f64
    }

    /// The reasons for which more than a share of the returns are lost, with their shares, the most frequent first.
    pub fn above(&self, share: f64) -> Vec<(DropReason, f64)> {
        let returns = self.returns();
        let mut reasons: Vec<(DropReason, f64)> = [
            (DropReason::OwnCar, self.own_car),
            (DropReason::TooNear, self.too_near),
            (DropReason::TooFar, self.too_far),
            (DropReason::OutsideImage, self.outside_image),
            (DropReason::SamePixel, self.same_pixel),
        ]
        .into_iter()
        .map(|(reason, points)| (reason, points as f64 / returns))
        .filter(|&(_, lost)| lost > share)
        .collect();
        reasons.sort_by(|a, b| b.1.total_cmp(&a.1));
        reasons
    }
}
