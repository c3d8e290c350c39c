//! Baseline: one plane for the whole scan, as range-mcl fits it.
//!
//! Fischler and Bolles, *Random Sample Consensus* (1981): planes through random points; the
//! one with the most points near it wins and is fitted to them.

use glam::Vec3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::classifier::GroundClassifier;
use crate::geometry::PlaneSums;
use crate::validation::{InvalidValue, Validate, in_range, positive, require};

/// Ground by the dominant plane.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RansacGround {
    /// How far from the plane ground may lie [m].
    pub distance_threshold: f32,
    /// Points that a plane is made of, at least 3.
    pub ransac_n: usize,
    /// Planes that are tried.
    pub num_iterations: usize,
    /// Of the random points.
    pub seed: u64,
}

impl Default for RansacGround {
    /// The values of range-mcl.
    fn default() -> Self {
        Self {
            distance_threshold: 0.3,
            ransac_n: 3,
            num_iterations: 100,
            seed: 0,
        }
    }
}

impl Validate for RansacGround {
    fn validate(&self) -> Result<(), InvalidValue> {
        positive("distance_threshold", self.distance_threshold)?;
        require(
            self.ransac_n >= 3,
            "ransac_n",
            self.ransac_n,
            "a plane needs 3 points or more",
        )?;
        in_range("num_iterations", self.num_iterations, 1..=1_000_000)
    }
}

#[derive(Clone, Copy)]
struct Plane {
    normal: Vec3,
    offset_m: f32,
}

impl Plane {
    fn through(points: impl Iterator<Item = Vec3>) -> Option<Self> {
        let mut sums = PlaneSums::about(Vec3::ZERO);
        points.for_each(|point| sums.add(point, 1.0));
        sums.fit().map(|plane| Self {
            normal: plane.normal,
            offset_m: plane.normal.dot(plane.center),
        })
    }

    fn has(&self, point: Vec3, tolerance_m: f32) -> bool {
        (self.normal.dot(point) - self.offset_m).abs() < tolerance_m
    }
}

impl RansacGround {
    fn plane(&self, points: &[Vec3]) -> Option<Plane> {
        if points.len() < self.ransac_n.max(3) {
            return None;
        }
        let supporters = |plane: &Plane| {
            let near = |point: &&Vec3| plane.has(**point, self.distance_threshold);
            points.iter().filter(near).count()
        };
        let scored: Vec<(usize, Plane)> = (0..self.num_iterations as u64)
            .into_par_iter()
            .filter_map(|iteration| {
                // A stream per iteration: the same planes at any number of threads.
                let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
                rng.set_stream(iteration);
                let draws =
                    (0..self.ransac_n.max(3)).map(|_| points[rng.random_range(0..points.len())]);
                let plane = Plane::through(draws)?;
                Some((supporters(&plane), plane))
            })
            .collect();
        let mut best: Option<(usize, Plane)> = None;
        for (support, plane) in scored {
            if best.is_none_or(|(most, _)| support > most) {
                best = Some((support, plane));
            }
        }
        let (_, plane) = best?;
        let near = points
            .iter()
            .filter(|point| plane.has(**point, self.distance_threshold));
        Plane::through(near.copied()).or(Some(plane))
    }
}

impl GroundClassifier for RansacGround {
    fn ground_confidence(&self, points: &[Vec3]) -> Vec<f32> {
        let finite: Vec<Vec3> = points
            .iter()
            .copied()
            .filter(|point| point.is_finite())
            .collect();
        let Some(plane) = self.plane(&finite) else {
            return vec![0.0; points.len()];
        };
        points
            .iter()
            .map(|&point| f32::from(u8::from(plane.has(point, self.distance_threshold))))
            .collect()
    }
}
