//! Confidence weights of points in the surface reconstruction.
//!
//! ```text
//! w = |cos(incidence)|^k / (1 + (range / r)²)
//! ```
//!
//! scaled to a mean of 1 over a local map, so that its surface has the same resolution as without.
//! A range error displaces a point from its surface by the cosine of incidence; distant points are
//! sparse, and their normals are averages of larger patches. Kazhdan and Hoppe, *Screened Poisson
//! Surface Reconstruction* (2013), encode confidence in the length of the normals.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::scan_cloud::ScanCloud;
use crate::validation::{InvalidValue, Validate, not_negative, positive};

/// Decrease of confidence with range and incidence. By default all points have equal weight.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct ConfidenceConfig {
    /// r: range at which the confidence is one half [m]; none: independent of range.
    pub half_range_m: Option<f32>,
    /// k: power of the cosine of incidence (unitless); 0: independent of incidence.
    pub incidence_power: f32,
}

impl Validate for ConfidenceConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        not_negative("incidence_power", self.incidence_power)?;
        self.half_range_m
            .map_or(Ok(()), |half| positive("half_range_m", half))
    }
}

impl ConfidenceConfig {
    /// Returns the confidence of each point of a scan, above 0 and at most 1; `None` if all are equal.
    pub(crate) fn of(&self, scan: &ScanCloud) -> Option<Vec<f32>> {
        if *self == Self::default() {
            return None;
        }
        let origin = scan.map_from_lidar.translation;
        let points = scan.cloud.positions.iter().zip(&scan.cloud.normals);
        Some(
            points
                .map(|(&point, &normal)| self.at(point - origin, normal))
                .collect(),
        )
    }

    /// Returns the confidence of a point at the end of a beam, with the unit normal of its surface.
    fn at(&self, beam: Vec3, normal: Vec3) -> f32 {
        /// Lower limit: no measured point is ignored.
        const MIN_CONFIDENCE: f32 = 1e-3;
        let far = self
            .half_range_m
            .map_or(0.0, |half| beam.length_squared() / (half * half));
        let cosine = beam.normalize_or_zero().dot(normal).abs();
        (cosine.powf(self.incidence_power) / (1.0 + far)).max(MIN_CONFIDENCE)
    }
}

/// Scales confidences to a mean of 1.
pub(crate) fn normalize(confidences: &mut [f32]) {
    let sum: f64 = confidences.iter().copied().map(f64::from).sum();
    let scale = confidences.len() as f64 / sum.max(f64::MIN_POSITIVE);
    for confidence in confidences {
        *confidence = (f64::from(*confidence) * scale) as f32;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normalized_confidences_have_a_mean_of_one_and_their_proportions() {
        let mut confidences = [0.1, 0.2, 0.3];
        normalize(&mut confidences);
        for (confidence, expected) in confidences.into_iter().zip([0.5, 1.0, 1.5]) {
            assert!((confidence - expected).abs() < 1e-6, "{confidence}");
        }
        normalize(&mut []);
    }

    #[test]
    fn confidence_is_one_half_at_half_range_and_decreases_with_the_cosine() {
        let uniform = ConfidenceConfig::default();
        assert_eq!(uniform.at(Vec3::new(30.0, 0.0, -1.7), Vec3::Z), 1.0);
        let by_range = ConfidenceConfig {
            half_range_m: Some(20.0),
            ..uniform.clone()
        };
        assert_eq!(by_range.at(20.0 * Vec3::X, Vec3::NEG_X), 0.5);
        assert_eq!(by_range.at(40.0 * Vec3::X, Vec3::Z), 0.2);
        let by_incidence = ConfidenceConfig {
            incidence_power: 1.0,
            ..uniform
        };
        let slanted = by_incidence.at(Vec3::new(3.0, 4.0, 0.0), Vec3::NEG_X);
        assert!((slanted - 0.6).abs() < 1e-6, "{slanted}");
    }
}
