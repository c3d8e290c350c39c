//! How much a point counts in the reconstruction.
//!
//! ```text
//! w = |cos(incidence)|^k / (1 + (range / r)²)
//! ```
//!
//! scaled to a mean of 1 over a local map, so that its surface is as fine as without.
//! A range error moves a point out of a surface by its cosine of incidence, and far points are
//! fewer, with normals of wider patches, than those that another scan has of the same place.
//! Confidence as in Kazhdan and Hoppe, *Screened Poisson Surface Reconstruction* (2013), where it
//! is given with the normals.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::scan_cloud::ScanCloud;
use crate::validation::{InvalidValue, Validate, not_negative, positive};

/// How confidence falls. As it comes, every point counts alike.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ConfidenceConfig {
    /// r: range at which a point counts half [m]; none: range does not matter.
    pub half_range_m: Option<f32>,
    /// k: power of the cosine of incidence (unitless); 0: incidence does not matter.
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
    /// The confidence of each point of a scan, above 0 and at most 1; none if all count alike.
    pub(super) fn of(&self, scan: &ScanCloud) -> Option<Vec<f32>> {
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

    /// Of a beam and the unit normal of the surface that it meets.
    fn at(&self, beam: Vec3, normal: Vec3) -> f32 {
        /// Nothing that was measured counts for nothing.
        const LEAST: f32 = 1e-3;
        let far = self
            .half_range_m
            .map_or(0.0, |half| beam.length_squared() / (half * half));
        let cosine = beam.normalize_or_zero().dot(normal).abs();
        (cosine.powf(self.incidence_power) / (1.0 + far)).max(LEAST)
    }
}

/// Scales confidences to a mean of 1.
pub(super) fn balance(confidences: &mut [f32]) {
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
    fn balanced_confidences_have_a_mean_of_one_and_their_proportions() {
        let mut confidences = [0.1, 0.2, 0.3];
        balance(&mut confidences);
        for (confidence, expected) in confidences.into_iter().zip([0.5, 1.0, 1.5]) {
            assert!((confidence - expected).abs() < 1e-6, "{confidence}");
        }
        balance(&mut []);
    }

    #[test]
    fn a_point_counts_half_at_half_range_and_by_its_cosine() {
        let all_alike = ConfidenceConfig::default();
        assert_eq!(all_alike.at(Vec3::new(30.0, 0.0, -1.7), Vec3::Z), 1.0);
        let by_range = ConfidenceConfig {
            half_range_m: Some(20.0),
            ..all_alike.clone()
        };
        assert_eq!(by_range.at(20.0 * Vec3::X, Vec3::NEG_X), 0.5);
        assert_eq!(by_range.at(40.0 * Vec3::X, Vec3::Z), 0.2);
        let by_incidence = ConfidenceConfig {
            incidence_power: 1.0,
            ..all_alike
        };
        let slanted = by_incidence.at(Vec3::new(3.0, 4.0, 0.0), Vec3::NEG_X);
        assert!((slanted - 0.6).abs() < 1e-6, "{slanted}");
    }
}
