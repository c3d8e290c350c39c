//! Weights of the samples in the two terms of the screened Poisson energy.

use std::ops::Range;

use rayon::prelude::*;

use super::samples::Samples;
use super::stencil::{interpolate, trilinear};

/// Surface area and screening weight of each sample.
pub struct SampleWeights {
    /// Number of points that each sample is the mean of.
    counts: Vec<f32>,
    /// Surface area of each sample in cell faces of depth 0.
    areas: Vec<f32>,
    /// Depth of the finest cells at each sample, which is at most its sampling depth.
    finest: Vec<f32>,
    /// Area of a point at its own depth in cell faces.
    own_area: f32,
    /// Screening weight α.
    point_weight: f32,
}

impl SampleWeights {
    /// Weights of samples with the depths at which a cell face holds `samples_per_node` of them, those of the finest cells
    /// at each, and the screening weight α.
    pub fn new(depths: &[f32], finest: Vec<f32>, samples_per_node: f32, point_weight: f32) -> Self {
        let own_area = 1.0 / samples_per_node;
        let area = |depth: &f32| own_area * (-2.0 * depth).exp2();
        Self {
            counts: vec![1.0; depths.len()],
            areas: depths.par_iter().map(area).collect(),
            finest,
            own_area,
            point_weight,
        }
    }

    /// The samples [merged](Samples::merged), with their weights.
    pub fn merge(&self, samples: &Samples) -> (Samples, Self) {
        let sum = |of: &[f32]| -> Vec<f32> {
            samples.cells().map(|cell| of[cell].iter().sum()).collect()
        };
        let most = |cell: Range<usize>| self.finest[cell].iter().copied().fold(0.0, f32::max);
        let weights = Self {
            counts: sum(&self.counts),
            areas: sum(&self.areas),
            finest: samples.cells().map(most).collect(),
            ..*self
        };
        (samples.merged(&self.areas), weights)
    }

    /// Number of points that a sample is the mean of.
    #[inline]
    pub fn count(&self, sample: usize) -> f32 {
        self.counts[sample]
    }

    /// Depth of the finest cells at a sample.
    #[inline]
    pub fn finest(&self, sample: usize) -> f32 {
        self.finest[sample]
    }

    /// Surface area of a sample in cell faces of a depth.
    #[inline]
    pub fn area(&self, sample: usize, depth: u32) -> f32 {
        (1_u64 << (2 * depth)) as f32 * self.areas[sample]
    }

    /// Weight of a sample in the screening term; it does not increase below the depth of its points.
    #[inline]
    pub fn screening(&self, sample: usize, depth: u32) -> f32 {
        let most = self.counts[sample] * self.own_area;
        self.point_weight * self.area(sample, depth).min(most)
    }

    /// Fraction of a sample's normal that is splatted at this depth or finer.
    #[inline]
    pub fn fraction_from(&self, sample: usize, depth: u32) -> f32 {
        (self.finest[sample] - depth as f32 + 1.0).clamp(0.0, 1.0)
    }
}

/// Weighted sum of sample positions in a cell, and the sum of their weights.
#[derive(Clone, Copy, Default)]
pub struct ConstraintSum([f32; 4]);

impl ConstraintSum {
    /// Adds a sample at a position 0 to 1 in the cell.
    #[inline]
    pub fn add(&mut self, weight: f32, inside: [f32; 3]) {
        for (sum, position) in self.0.iter_mut().zip(inside) {
            *sum += weight * position;
        }
        self.0[3] += weight;
    }

    /// The constraint of a cell by the index of its lowest corner; `None` without weight.
    pub fn constraint(&self, corner: usize) -> Option<PointConstraint> {
        let [x, y, z, weight] = self.0;
        (weight > 0.0).then(|| PointConstraint {
            corner: corner as u32,
            weight,
            inside: [x, y, z].map(|sum| (sum / weight).clamp(0.0, 1.0)),
        })
    }
}

/// Screening term of one cell: its samples, merged at their weighted mean, pull the solution to 0.
pub struct PointConstraint {
    /// Index of the lowest corner of the cell.
    pub corner: u32,
    /// Sum of the screening weights.
    pub weight: f32,
    /// Mean position in the cell, 0 to 1 per axis.
    pub inside: [f32; 3],
}

impl PointConstraint {
    /// Adds w φ φᵀ u to `out`; `offsets` are those of a cell's corners.
    #[inline]
    pub fn apply(&self, u: &[f32], offsets: &[usize; 8], out: &mut [f32]) {
        let corner = self.corner as usize;
        let shape = trilinear(self.inside);
        let value = self.weight * interpolate(u, corner, offsets, &shape);
        for i in 0..8 {
            out[corner + offsets[i]] += value * shape[i];
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use glam::Vec3;
    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::*;
    use crate::geometry::PointCloud;

    /// Samples of random points, of which some share cells, and their weights.
    fn random(seed: u64) -> (Samples, SampleWeights) {
        const POINTS: usize = 500;
        let mut rng = StdRng::seed_from_u64(seed);
        let mut vector = || Vec3::from_array([(); 3].map(|()| rng.random_range(-1.0..1.0)));
        let (positions, normals) = (0..POINTS).map(|_| (vector(), vector())).unzip();
        let cloud = PointCloud {
            positions,
            normals,
            ..PointCloud::default()
        };
        let samples = Samples::new(&cloud, |extent_m| (3, 1.1 * extent_m)).unwrap();
        let depths: Vec<f32> = (0..samples.len())
            .map(|_| rng.random_range(1.0..3.0))
            .collect();
        let weights = SampleWeights::new(&depths, depths.clone(), 1.5, 10.0);
        (samples, weights)
    }

    #[test]
    fn one_sample_per_cell_has_the_sums_of_its_points() {
        for seed in 1..4 {
            let (samples, weights) = random(seed);
            let (merged, of_merged) = weights.merge(&samples);
            assert!(merged.codes.is_sorted_by(|a, b| a < b) && merged.len() < samples.len());
            let mut from = 0;
            for sample in 0..merged.len() {
                let points = (from..samples.len())
                    .take_while(|&point| samples.codes[point] == merged.codes[sample]);
                let points: Vec<usize> = points.collect();
                from += points.len();
                assert_eq!(of_merged.count(sample), points.len() as f32);
                assert_eq!(merged.cell(sample, 3).0, samples.cell(points[0], 3).0);
                let sum = |of: &dyn Fn(usize) -> f32| points.iter().map(|&it| of(it)).sum::<f32>();
                let area = of_merged.area(sample, 2);
                assert_relative_eq!(area, sum(&|it| weights.area(it, 2)), max_relative = 1e-5);
                for axis in 0..3 {
                    let [normal, position] = [&samples.normals, &samples.positions]
                        .map(|of| sum(&|it| weights.area(it, 2) * of[it][axis]));
                    let (mean, at) = (merged.normals[sample][axis], merged.positions[sample][axis]);
                    assert_relative_eq!(area * mean, normal, epsilon = 1e-5);
                    assert_relative_eq!(area * at, position, max_relative = 1e-5);
                }
                let most = points
                    .iter()
                    .map(|&it| weights.finest(it))
                    .fold(0.0, f32::max);
                assert_eq!(of_merged.finest(sample), most);
            }
            assert_eq!(from, samples.len());
        }
    }

    #[test]
    fn the_screening_of_a_cell_is_that_of_its_points_and_has_the_same_limit() {
        let (samples, _) = random(1);
        let alike = SampleWeights::new(
            &vec![2.0; samples.len()],
            vec![2.0; samples.len()],
            1.5,
            10.0,
        );
        let (merged, of_merged) = alike.merge(&samples);
        for depth in 1..4 {
            let sum = |count, of: &SampleWeights| {
                (0..count).map(|it| of.screening(it, depth)).sum::<f32>()
            };
            let (all, expected) = (sum(merged.len(), &of_merged), sum(samples.len(), &alike));
            assert_relative_eq!(all, expected, max_relative = 1e-4);
        }
    }
}
