//! The spherical projection of a spinning LiDAR.
//!
//! ```text
//! column = ½ (1 − azimuth / π) · width            azimuth   = atan2(y, x)
//! row    = (1 − (elevation + |fov_down|) / fov) · height    elevation = asin(z / r)
//! ```
//!
//! Column 0 faces backward, the middle column forward, columns increase clockwise; row 0 is the top.
//! Chen et al., *Range Image-based LiDAR Localization for Autonomous Vehicles*, ICRA 2021, eq. 1.
//! Unlike there, a direction outside the vertical field of view has no pixel, and rows may be the beams
//! of a sensor whose elevations are not evenly spaced: a direction then belongs to the nearest beam.

use std::f32::consts::PI;
use std::sync::Arc;

use crate::validation::{InvalidValue, Validate, in_range, not_negative, positive, require};
use glam::Vec3;
use serde::{Deserialize, Serialize};

/// Size, field of view and range limits of a range image: all of them, or with options those that are known.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct LidarModel<N = usize, F = f32> {
    /// Rows.
    pub height: N,
    /// Columns over 360 degrees.
    pub width: N,
    /// Upper edge of the vertical field of view over the horizon [deg].
    pub fov_up: F,
    /// Lower edge of the vertical field of view; below the horizon whatever its sign [deg].
    pub fov_down: F,
    /// Range from which on returns are dropped [m].
    pub max_range: F,
    /// Range up to which returns are dropped [m].
    pub min_range: F,
    /// Elevations of the rows, from the top [deg]; without them, the rows of a field of view are evenly spaced.
    pub elevations: Option<Arc<[f32]>>,
}

impl Default for LidarModel {
    /// A Velodyne HDL-64E with the values of range-mcl.
    fn default() -> Self {
        Self {
            height: 64,
            width: 900,
            fov_up: 3.0,
            fov_down: -25.0,
            max_range: 50.0,
            min_range: 2.0,
            elevations: None,
        }
    }
}

impl LidarModel<Option<usize>, Option<f32>> {
    /// Nothing is known.
    pub(crate) const UNKNOWN: Self = Self {
        height: None,
        width: None,
        fov_up: None,
        fov_down: None,
        max_range: None,
        min_range: None,
        elevations: None,
    };

    /// What is known, and the values of another model where nothing is.
    pub(crate) fn or(&self, other: &LidarModel) -> LidarModel {
        let has_rows = self.height.is_some() || self.fov_up.is_some() || self.fov_down.is_some();
        let others = (other.elevations.as_ref()).filter(|_| !has_rows);
        LidarModel {
            height: (self.height)
                .or(self.elevations.as_ref().map(|elevations| elevations.len()))
                .unwrap_or(other.height),
            width: self.width.unwrap_or(other.width),
            fov_up: self.fov_up.unwrap_or(other.fov_up),
            fov_down: self.fov_down.unwrap_or(other.fov_down),
            max_range: self.max_range.unwrap_or(other.max_range),
            min_range: self.min_range.unwrap_or(other.min_range),
            elevations: self.elevations.as_ref().or(others).cloned(),
        }
    }
}

impl From<&LidarModel> for LidarModel<Option<usize>, Option<f32>> {
    fn from(model: &LidarModel) -> Self {
        Self {
            height: Some(model.height),
            width: Some(model.width),
            fov_up: Some(model.fov_up),
            fov_down: Some(model.fov_down),
            max_range: Some(model.max_range),
            min_range: Some(model.min_range),
            elevations: model.elevations.clone(),
        }
    }
}

impl Validate for LidarModel<Option<usize>, Option<f32>> {
    /// Checks the known values, and those with each other that depend on each other if both are known.
    fn validate(&self) -> Result<(), InvalidValue> {
        let mut other = LidarModel::default();
        // Limits of what is unknown that contradict nothing.
        if self.fov_up.is_none() || self.fov_down.is_none() {
            (other.fov_up, other.fov_down) = (90.0, -90.0);
        }
        if self.min_range.is_none() || self.max_range.is_none() {
            other.min_range = 0.0;
            other.max_range = self
                .min_range
                .map_or(other.max_range, |min| 2.0 * min.max(1.0));
        }
        if let (None, Some(elevations)) = (self.height, &self.elevations) {
            other.height = elevations.len();
        }
        self.or(&other).validate()
    }
}

impl LidarModel {
    /// Largest number of pixels: ten times those of the largest sensors.
    pub(crate) const MAX_PIXELS: usize = 1 << 22;
}

impl Validate for LidarModel {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("height", self.height, 1..=4096)?;
        in_range("width", self.width, 1..=65_536)?;
        require(
            self.height * self.width <= Self::MAX_PIXELS,
            "width",
            self.width,
            format!(
                "with height {} it must be at most {}: an image has up to {} pixels",
                self.height,
                Self::MAX_PIXELS / self.height,
                Self::MAX_PIXELS
            ),
        )?;
        in_range("fov_up", self.fov_up, -90.0..=90.0)?;
        in_range("fov_down", self.fov_down, -90.0..=90.0)?;
        require(
            self.fov_rad() > 0.0,
            "fov_up",
            self.fov_up,
            format!("it must lie above fov_down, which is {}", self.fov_down),
        )?;
        if let Some(elevations) = &self.elevations {
            require(
                elevations.len() == self.height,
                "elevations",
                elevations.len(),
                format!("there must be one for each of the {} rows", self.height),
            )?;
            let is_valid = elevations.iter().all(|deg| deg.abs() <= 90.0)
                && elevations.is_sorted_by(|upper, lower| upper > lower);
            require(
                is_valid,
                "elevations",
                format!("{elevations:?}"),
                "they must descend, from at most 90 to at least -90 degrees",
            )?;
        }
        not_negative("min_range", self.min_range)?;
        positive("max_range", self.max_range)?;
        require(
            self.min_range < self.max_range,
            "min_range",
            self.min_range,
            format!(
                "it must be less than max_range, which is {}",
                self.max_range
            ),
        )
    }
}

impl LidarModel {
    /// Number of pixels.
    pub fn len(&self) -> usize {
        self.height * self.width
    }

    /// Whether there are no pixels.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Whether a range is within the limits; false if it is not finite.
    pub(crate) fn accepts_range(&self, range_m: f32) -> bool {
        self.min_range < range_m && range_m < self.max_range
    }

    /// Elevation of the centre of a row [rad].
    pub fn elevation_rad(&self, row: usize) -> f32 {
        match &self.elevations {
            Some(elevations) => elevations[row].to_radians(),
            None => self.fov_up_rad() - (row as f32 + 0.5) / self.height as f32 * self.fov_rad(),
        }
    }

    /// Greatest angle between a row and its neighbours [rad].
    pub(crate) fn row_spacing_rad(&self, row: usize) -> f32 {
        let Some(elevations) = &self.elevations else {
            return self.fov_rad() / self.height as f32;
        };
        let neighbors = &elevations[row.saturating_sub(1)..(row + 2).min(elevations.len())];
        let spacing_deg = neighbors.windows(2).map(|pair| pair[0] - pair[1]);
        (spacing_deg.fold(0.0_f32, f32::max).max(0.2)).to_radians()
    }

    /// The unit direction through the center of the pixel at a row-major index.
    pub(crate) fn direction_of(&self, index: usize) -> Vec3 {
        let (row, column) = (index / self.width, index % self.width);
        let elevation_rad = self.elevation_rad(row);
        let azimuth_rad = PI * (1.0 - 2.0 * (column as f32 + 0.5) / self.width as f32);
        Vec3::new(
            elevation_rad.cos() * azimuth_rad.cos(),
            elevation_rad.cos() * azimuth_rad.sin(),
            elevation_rad.sin(),
        )
    }

    /// The unit directions of the centres of all pixels in the lidar frame, row-major.
    pub fn directions(&self) -> Vec<Vec3> {
        (0..self.len())
            .map(|index| self.direction_of(index))
            .collect()
    }

    /// Upper limit of the field of view [rad].
    pub(crate) fn fov_up_rad(&self) -> f32 {
        self.fov_up.to_radians()
    }

    /// Lower limit of the field of view, negative [rad].
    pub(crate) fn fov_down_rad(&self) -> f32 {
        -self.fov_down.abs().to_radians()
    }

    /// Vertical field of view [rad].
    pub(crate) fn fov_rad(&self) -> f32 {
        self.fov_up_rad() - self.fov_down_rad()
    }
}

#[cfg(test)]
mod tests {
    use super::super::projection::Projection;
    use super::*;

    #[test]
    fn every_pixel_center_projects_into_its_pixel() {
        let model = LidarModel::default();
        let projection = Projection::of(&model);
        for index in 0..model.len() {
            assert_eq!(projection.pixel_of(model.direction_of(index)), Some(index));
        }
    }

    #[test]
    fn rows_of_uneven_beams_take_the_nearest_directions() {
        let elevations = [15.0, 5.0, 1.0, 0.0, -1.0, -9.0];
        let model = LidarModel {
            height: 6,
            fov_up: 20.0,
            elevations: Some(elevations.into()),
            ..LidarModel::default()
        };
        let projection = Projection::of(&model);
        for index in 0..model.len() {
            assert_eq!(projection.pixel_of(model.direction_of(index)), Some(index));
        }
        let row_at = |deg: f32| {
            let (sine, cosine) = deg.to_radians().sin_cos();
            let pixel = projection.pixel_of(Vec3::new(cosine, 0.0, sine))?;
            Some(pixel / model.width)
        };
        assert_eq!(
            [14.0, 9.0, 0.4, 0.6, -1.2].map(row_at),
            [0, 1, 3, 2, 4].map(Some)
        );
        assert_eq!([20.5, -14.0, f32::NAN].map(row_at), [None; 3]);
    }

    #[test]
    fn columns_increase_clockwise_from_backward() {
        let model = LidarModel::default();
        let column = |direction| Projection::of(&model).pixel_of(direction).unwrap() % model.width;
        assert_eq!(column(Vec3::new(1.0, 0.0, 0.0)), 450);
        assert_eq!(column(Vec3::new(0.0, -1.0, 0.0)), 675);
        assert_eq!(column(Vec3::new(0.0, 1.0, 0.0)), 225);
        assert_eq!(column(Vec3::new(-1.0, 0.0, 0.0)), 0);
        assert_eq!(column(Vec3::new(-1.0, -0.0, 0.0)), 0);
    }

    #[test]
    fn a_point_outside_the_field_of_view_is_dropped() {
        let model = LidarModel::default();
        let at = |elevation_deg: f32| {
            let elevation = elevation_deg.to_radians();
            Projection::of(&model).pixel_of(Vec3::new(elevation.cos(), 0.0, elevation.sin()))
        };
        assert_eq!(at(3.1), None);
        assert_eq!(at(2.99).unwrap() / model.width, 0);
        assert_eq!(at(-24.99).unwrap() / model.width, 63);
        assert_eq!(at(-25.1), None);
    }

    #[test]
    fn an_invalid_direction_has_no_pixel() {
        let model = LidarModel::default();
        assert_eq!(Projection::of(&model).pixel_of(Vec3::ZERO), None);
        assert_eq!(Projection::of(&model).pixel_of(Vec3::NAN), None);
    }

    #[test]
    fn the_sign_of_the_lower_limit_does_not_matter() {
        let below = LidarModel::default();
        let unsigned = LidarModel {
            fov_down: 25.0,
            ..below.clone()
        };
        assert_eq!(below.fov_rad(), unsigned.fov_rad());
    }
}
