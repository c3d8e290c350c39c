//! Baseline: one plane for the whole scan, as range-mcl fits it.
//!
//! Fischler and Bolles, *Random Sample Consensus* (1981): of the planes through random samples,
//! the one with the largest consensus set is fitted to that set.

use glam::Vec3;
use rand::RngExt;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::classifier::GroundClassifier;
use crate::geometry::{PlaneFit, PlaneSums};
use crate::random;
use crate::validation::{InvalidValue, Validate, in_range, positive};

/// Ground by the dominant plane.
///
/// Defaults: the values of range-mcl.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RansacGround {
    /// Maximum distance of ground from the plane [m].
    #[default(0.3)]
    pub distance_threshold: f32,
    /// Points per random sample, at least 3.
    #[default(3)]
    pub ransac_n: usize,
    /// Number of random samples.
    #[default(100)]
    pub num_iterations: usize,
    /// Seed of the random samples.
    pub seed: u64,
}

impl Validate for RansacGround {
    fn validate(&self) -> Result<(), InvalidValue> {
        positive("distance_threshold", self.distance_threshold)?;
        in_range("ransac_n", self.ransac_n, 3..=1000)?;
        in_range("num_iterations", self.num_iterations, 1..=100_000)
    }
}

impl RansacGround {
    fn plane(&self, points: &[Vec3]) -> Option<PlaneFit> {
        let sample_size = self.ransac_n.max(3);
        if points.len() < sample_size {
            return None;
        }
        let candidates: Vec<(usize, PlaneFit)> = (0..self.num_iterations as u64)
            .into_par_iter()
            .filter_map(|iteration| {
                // A stream per iteration: the same planes with any number of threads.
                let mut rng = random::stream(self.seed, iteration);
                let plane =
                    fit((0..sample_size).map(|_| points[rng.random_range(0..points.len())]))?;
                let inliers = points
                    .iter()
                    .filter(|point| self.is_inlier(&plane, **point));
                Some((inliers.count(), plane))
            })
            .collect();
        // The first of the largest: `max_by_key` returns the last.
        let largest = candidates.into_iter().rev();
        let (_, plane) = largest.max_by_key(|&(inliers, _)| inliers)?;
        let inliers = points
            .iter()
            .filter(|point| self.is_inlier(&plane, **point));
        fit(inliers.copied()).or(Some(plane))
    }

    #[inline]
    fn is_inlier(&self, plane: &PlaneFit, point: Vec3) -> bool {
        let offset_m = plane.normal.dot(plane.center);
        (plane.normal.dot(point) - offset_m).abs() < self.distance_threshold
    }
}

impl GroundClassifier for RansacGround {
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
        let finite = points.iter().copied().filter(|point| point.is_finite());
        let Some(plane) = self.plane(&finite.collect::<Vec<_>>()) else {
            return vec![0.0; points.len()];
        };
        let is_ground = |&point| f32::from(u8::from(self.is_inlier(&plane, point)));
        points.iter().map(is_ground).collect()
    }
}

fn fit(points: impl Iterator<Item = Vec3>) -> Option<PlaneFit> {
    let mut sums = PlaneSums::about(Vec3::ZERO);
    points.for_each(|point| sums.add(point));
    sums.fit()
}
