//! Weights of the samples in the two terms of the screened Poisson energy.

use rayon::prelude::*;

use super::stencil::{interpolate, trilinear};

/// Surface area and screening weight of each sample.
pub struct SampleWeights<'a> {
    /// Surface area of each sample in cell faces of depth 0.
    areas: Vec<f32>,
    /// Depth of the finest cells at each sample, which is at most its sampling depth.
    finest: &'a [f32],
    /// Area of a sample at its own depth in cell faces.
    own_area: f32,
    /// Screening weight α.
    point_weight: f32,
}

impl<'a> SampleWeights<'a> {
    /// Weights of samples with the depths at which a cell face holds `samples_per_node` of them, those of the finest cells
    /// at each, and the screening weight α.
    pub fn new(
        depths: &[f32],
        finest: &'a [f32],
        samples_per_node: f32,
        point_weight: f32,
    ) -> Self {
        let own_area = 1.0 / samples_per_node;
        let area = |depth: &f32| own_area * (-2.0 * depth).exp2();
        Self {
            areas: depths.par_iter().map(area).collect(),
            finest,
            own_area,
            point_weight,
        }
    }

    /// Surface area of a sample in cell faces of a depth.
    #[inline]
    pub fn area(&self, sample: usize, depth: u32) -> f32 {
        (1_u64 << (2 * depth)) as f32 * self.areas[sample]
    }

    /// Weight of a sample in the screening term; it does not increase below the sample's depth.
    #[inline]
    pub fn screening(&self, sample: usize, depth: u32) -> f32 {
        self.point_weight * self.area(sample, depth).min(self.own_area)
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
