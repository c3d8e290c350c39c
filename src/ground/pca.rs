//! Baselines that classify each point by its surface normal and its height alone.

use glam::Vec3;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::classifier::GroundClassifier;
use super::features::{ground_height_m, surface_normals};
use crate::geometry::PlaneSums;
use crate::validation::{InvalidValue, Validate, fraction, require};

/// Ground by principal components: a point is ground if |n · k| is large, k being the eigenvector
/// of the smallest eigenvalue of the covariance of the whole cloud, and it lies below a height.
/// After the PCA variant of range-mcl (Chen et al., ICRA 2021), with the eigenvalues in order.
///
/// Defaults: the values of range-mcl; its maximum height, for a sensor 1.73 m above the road, is one above the ground.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PcaGround {
    /// Minimum |cosine| between the normal of a point and that of the cloud, unitless.
    #[default(0.8)]
    pub min_cosine: f32,
    /// Maximum height of ground in the lidar frame [m]; `None`: 0.63 m above the ground below the sensor, by the height
    /// of its mounting, else by the scan.
    pub max_height_m: Option<f32>,
}

impl PcaGround {
    /// Maximum height above the ground below the sensor: that of range-mcl, 1.73 m - 1.1 m [m].
    const MAX_RISE_M: f32 = 0.63;

    /// The same classifier for the scans of a sensor at a height above the ground [m], if that is known.
    pub(super) fn mounted(self, height_m: Option<f64>) -> Self {
        let known_m = height_m.map(|height_m| Self::MAX_RISE_M - height_m as f32);
        Self {
            max_height_m: self.max_height_m.or(known_m),
            ..self
        }
    }
}

impl Validate for PcaGround {
    fn validate(&self) -> Result<(), InvalidValue> {
        fraction("min_cosine", self.min_cosine)?;
        require(
            self.max_height_m.is_none_or(f32::is_finite),
            "max_height_m",
            self.max_height_m.unwrap_or_default(),
            "it must be a height in the lidar frame, such as -1.1",
        )
    }
}

impl GroundClassifier for PcaGround {
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
        let mut sums = PlaneSums::about(Vec3::ZERO);
        for &point in points.iter().filter(|point| point.is_finite()) {
            sums.add(point);
        }
        let vertical = sums.fit().map_or(Vec3::Z, |plane| plane.normal);
        let max_height_m =
            (self.max_height_m).unwrap_or_else(|| ground_height_m(points) + Self::MAX_RISE_M);
        classify_by_normal(points, |normal, z| {
            let is_level = normal.dot(vertical).abs() >= self.min_cosine;
            f32::from(u8::from(is_level && z < max_height_m))
        })
    }
}

/// Baseline of a project report: one fuzzy rule, `min(low(z), gentle(slope))`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReportRule;

impl GroundClassifier for ReportRule {
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
        classify_by_normal(points, |normal, z| {
            let slope_deg = normal.z.abs().min(1.0).acos().to_degrees();
            // Right flanks of the sets (-5, 0, 1) and (0, 10, 30); 0 outside of the universe.
            let low = if z < -5.0 {
                0.0
            } else {
                (1.0 - z).clamp(0.0, 1.0)
            };
            let gentle = ((30.0 - slope_deg) / 20.0).clamp(0.0, 1.0);
            low.min(gentle)
        })
    }
}

/// Maps unit normal and height of every point to a confidence; 0 for points without a normal.
fn classify_by_normal(points: &[Vec3], confidence: impl Fn(Vec3, f32) -> f32) -> Vec<f32> {
    let normals = surface_normals(points).into_iter().zip(points);
    normals
        .map(|(normal, point)| normal.map_or(0.0, |normal| confidence(normal, point.z)))
        .collect()
}
