//! Baseline: normals along the cloud's own vertical, and low points.
//!
//! k is the eigenvector of the smallest eigenvalue of the covariance of the whole cloud; a
//! point is ground if |n · k| is large and it lies below a fixed height. After range-mcl's
//! PCA variant (Chen et al., ICRA 2021), with the eigenvalues in order.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::classifier::GroundClassifier;
use super::features::surface_normals;
use crate::geometry::PlaneSums;
use crate::validation::{InvalidValue, Validate, fraction, require};

/// Ground by principal components.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PcaGround {
    /// Least |cosine| between a point's normal and the cloud's.
    pub min_cosine: f32,
    /// Ground lies below this height in the lidar frame [m].
    pub max_height_m: f32,
}

impl Default for PcaGround {
    /// The values of range-mcl, for a sensor 1.73 m over the road.
    fn default() -> Self {
        Self {
            min_cosine: 0.8,
            max_height_m: -1.1,
        }
    }
}

impl Validate for PcaGround {
    fn validate(&self) -> Result<(), InvalidValue> {
        fraction("min_cosine", self.min_cosine)?;
        require(
            self.max_height_m.is_finite(),
            "max_height_m",
            self.max_height_m,
            "it must be a height in the lidar frame, such as -1.1",
        )
    }
}

impl GroundClassifier for PcaGround {
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
        let mut sums = PlaneSums::about(Vec3::ZERO);
        for &point in points.iter().filter(|point| point.is_finite()) {
            sums.add(point, 1.0);
        }
        let vertical = sums.fit().map_or(Vec3::Z, |plane| plane.normal);
        surface_normals(points)
            .into_iter()
            .zip(points)
            .map(|(normal, point)| {
                let ground = normal.is_some_and(|normal| {
                    normal.dot(vertical).abs() >= self.min_cosine && point.z < self.max_height_m
                });
                f32::from(u8::from(ground))
            })
            .collect()
    }
}

/// Baseline: the rule that the report prints, `min(low(z), gentle(slope))`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReportRule;

impl GroundClassifier for ReportRule {
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
        surface_normals(points)
            .into_iter()
            .zip(points)
            .map(|(normal, point)| {
                normal.map_or(0.0, |normal| {
                    let slope_deg = normal.z.abs().min(1.0).acos().to_degrees();
                    // Memberships over (-5, 0, 1) and (0, 10, 30) that fall from 1 at the second
                    // corner to 0 at the third, and are 0 outside the range.
                    let low = if point.z < -5.0 {
                        0.0
                    } else {
                        (1.0 - point.z).clamp(0.0, 1.0)
                    };
                    let gentle = ((30.0 - slope_deg) / 20.0).clamp(0.0, 1.0);
                    low.min(gentle)
                })
            })
            .collect()
    }
}
