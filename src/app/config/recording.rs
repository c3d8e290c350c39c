//! Keys of recordings and sensors that several commands share.

use std::path::Path;
use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::Pose3;
use crate::lidar::{LidarModel, Rotation, RotationDirection};
use crate::validation::{InvalidValue, Validate, in_range, require};

/// Times of points that the data do not have, for motion compensation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MotionCompensation {
    /// Times of the data, else the rotation that fits consecutive scans best.
    Auto,
    /// Times from a clockwise rotation, seen from above.
    Clockwise,
    /// Times from a counter-clockwise rotation.
    CounterClockwise,
}

impl MotionCompensation {
    /// The configured rotation; `None` if it has to be inferred.
    pub fn rotation(self, period_s: f64) -> Option<Rotation> {
        let direction = match self {
            Self::Auto => return None,
            Self::Clockwise => RotationDirection::Clockwise,
            Self::CounterClockwise => RotationDirection::CounterClockwise,
        };
        Some(Rotation {
            direction,
            period_s,
        })
    }
}

/// Size and limits of the range images; `None` is inferred from the scans.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RangeImageConfig {
    /// Rows.
    pub height: Option<usize>,
    /// Columns over 360 degrees.
    pub width: Option<usize>,
    /// Upper edge of the vertical field of view over the horizon [deg].
    pub fov_up: Option<f32>,
    /// Lower edge of the vertical field of view; below the horizon whatever its sign [deg].
    pub fov_down: Option<f32>,
    /// Range from which on returns are dropped [m].
    pub max_range: Option<f32>,
    /// Range up to which returns are dropped [m].
    pub min_range: Option<f32>,
    /// Elevations of the rows, from the top [deg]; without them, rows of a given `height`, `fov_up` or
    /// `fov_down` are evenly spaced.
    pub elevations: Option<Arc<[f32]>>,
    /// Whether each beam keeps its elevation, as those of spinning sensors do; otherwise `build-map` takes normals
    /// from neighbours in space.
    pub has_rows: Option<bool>,
    /// Number of particles that `localize` renders at once.
    pub max_instance: Option<usize>,
    /// Whether `localize` renders the particles in batches instead of one by one.
    pub render_instanced: Option<bool>,
}

impl RangeImageConfig {
    /// The range images of a model.
    pub fn of(model: &LidarModel) -> Self {
        Self {
            height: Some(model.height),
            width: Some(model.width),
            fov_up: Some(model.fov_up),
            fov_down: Some(model.fov_down),
            max_range: Some(model.max_range),
            min_range: Some(model.min_range),
            elevations: model.elevations.clone(),
            ..Self::default()
        }
    }

    /// The sensor model, with the values of another where none is given.
    pub fn model_over(&self, inferred: &LidarModel) -> LidarModel {
        let has_rows = self.height.is_some() || self.fov_up.is_some() || self.fov_down.is_some();
        LidarModel {
            height: (self.height)
                .or(self.elevations.as_ref().map(|elevations| elevations.len()))
                .unwrap_or(inferred.height),
            width: self.width.unwrap_or(inferred.width),
            fov_up: self.fov_up.unwrap_or(inferred.fov_up),
            fov_down: self.fov_down.unwrap_or(inferred.fov_down),
            max_range: self.max_range.unwrap_or(inferred.max_range),
            min_range: self.min_range.unwrap_or(inferred.min_range),
            elevations: match has_rows {
                true => self.elevations.clone(),
                false => self.elevations.clone().or(inferred.elevations.clone()),
            },
        }
    }

    /// The sensor model, with the values of an HDL-64E where none is given.
    pub fn model(&self) -> LidarModel {
        self.model_over(&LidarModel::default())
    }

    /// Sets what is not given.
    pub fn resolve(&mut self, inferred: &LidarModel, has_rows: bool) {
        let (max_instance, render_instanced) = (self.max_instance, self.render_instanced);
        *self = Self {
            has_rows: self.has_rows.or(Some(has_rows)),
            max_instance,
            render_instanced,
            ..Self::of(&self.model_over(inferred))
        };
    }

    /// Requires that the keys of the batches, which only `localize` renders, are not given.
    pub(super) fn without_batches(&self) -> Result<(), InvalidValue> {
        const REMEDY: &str = "only localize renders in batches; remove the key";
        if let Some(value) = self.max_instance {
            return Err(InvalidValue::new("range_image.max_instance", value, REMEDY));
        }
        let Some(value) = self.render_instanced else {
            return Ok(());
        };
        let key = "range_image.render_instanced";
        Err(InvalidValue::new(key, value, REMEDY))
    }

    /// Number of particles that are rendered at once.
    pub fn batch_size(&self) -> usize {
        match self.render_instanced {
            Some(false) => 1,
            _ => self.max_instance.unwrap_or(1024),
        }
    }
}

impl Validate for RangeImageConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        if let Some(max_instance) = self.max_instance {
            in_range("max_instance", max_instance, 1..=1_000_000)?;
        }
        self.model().validate()
    }
}

/// Pose x, y, z [m], roll, pitch, yaw [deg] of the lidar on a body.
pub fn body_from_lidar([x, y, z, roll, pitch, yaw]: [f64; 6]) -> Pose3 {
    let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_radians);
    Pose3::from_parts(
        Vector3::new(x, y, z).into(),
        UnitQuaternion::from_euler_angles(roll, pitch, yaw),
    )
}

/// Requires that a body's pose and a camera's calibration are not both given, and that the numbers are possible.
pub(super) fn mounting(
    calib_file: Option<&Path>,
    body_from_lidar: Option<[f64; 6]>,
) -> Result<(), InvalidValue> {
    let Some(numbers) = body_from_lidar else {
        return Ok(());
    };
    require(
        calib_file.is_none(),
        "body_from_lidar",
        format!("{numbers:?}"),
        "give calib_file or body_from_lidar, not both",
    )?;
    let is_possible = numbers[..3].iter().all(|m| m.abs() <= 1000.0)
        && numbers[3..].iter().all(|deg| deg.abs() <= 360.0);
    require(
        is_possible,
        "body_from_lidar",
        format!("{numbers:?}"),
        "x, y, z must be within 1000 m, and roll, pitch, yaw within 360 degrees",
    )
}
