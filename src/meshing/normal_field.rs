//! The vector field V of the normals, splatted at the depth of each sample, and its divergence.
//!
//! A sample between two depths is divided between both. What ends at a depth or coarser is carried
//! down as a field on the grid; what goes finer counts at the present depth with the width of its cells.

use rayon::prelude::*;

use super::base_grid;
use super::octree::{CELLS, GRAIN, Level};
use super::samples::Samples;
use super::stencil::{
    CornerValues, OwnValues, PADDED, PADDED_OFFSETS, PaddedValues, corners_in_padded, divergence,
    gather_corners, gather_own, own_in_padded, prolong_corners, prolong_padded, trilinear,
};
use super::weights::SampleWeights;

/// Part of the field from the samples that end at a level or coarser, at the corners of its nodes.
pub struct CoarseField(Vec<[CornerValues; 3]>);

impl CoarseField {
    /// The field on the base level.
    pub fn base(samples: &Samples, level: &Level, weights: &SampleWeights<'_>) -> Self {
        let grid = base_grid::splat(samples, level.depth, |sample| {
            (1.0 - weights.fraction_from(sample, level.depth + 1))
                * weights.area(sample, level.depth)
        });
        let at_node = |node| {
            let corners = base_grid::node_corners(level, node);
            [0, 1, 2].map(|axis| corners.map(|corner| grid[corner][axis]))
        };
        Self((0..level.len()).map(at_node).collect())
    }

    /// The field on the next level, with the samples that end there.
    pub fn refined(&self, level: &Level, samples: &Samples, weights: &SampleWeights<'_>) -> Self {
        let fraction = |sample: usize| {
            weights.fraction_from(sample, level.depth)
                - weights.fraction_from(sample, level.depth + 1)
        };
        let at_node = |node| {
            let (parent, octant) = level.parent_octant(node);
            let own = splat_node(level, node, samples, weights, fraction, 4);
            [0, 1, 2].map(|axis| {
                let mut values = prolong_corners(&self.0[parent][axis], octant);
                for (value, index) in values.iter_mut().zip(corners_in_padded()) {
                    *value = 0.5 * *value + own[axis][index];
                }
                values
            })
        };
        Self(level.par_map(at_node))
    }

    /// ∫∇φᵢ·V on the next level, `parents` being the level of this field.
    pub fn divergence(
        &self,
        parents: &Level,
        level: &Level,
        samples: &Samples,
        weights: &SampleWeights<'_>,
    ) -> Vec<OwnValues> {
        let fraction = |sample: usize| weights.fraction_from(sample, level.depth);
        let mut splatted = vec![[[0.0; CELLS]; 3]; level.len() + 1];
        (splatted.par_iter_mut().zip(0..level.len()))
            .with_min_len(GRAIN)
            .for_each(|(out, node)| {
                let sums = splat_node(level, node, samples, weights, fraction, 3);
                for (out, sums) in out.iter_mut().zip(&sums) {
                    for (value, index) in out.iter_mut().zip(own_in_padded()) {
                        *value = sums[index];
                    }
                }
            });
        level.par_map(|node| {
            let (parent, octant) = level.parent_octant(node);
            divergence(&[0, 1, 2].map(|axis| {
                let mut fine = gather_own(|node| &splatted[node][axis], &level.neighbors[node]);
                let coarse = gather_corners(|node| &self.0[node][axis], parents, parent);
                if coarse.iter().any(|&v| v != 0.0) {
                    for (fine, coarse) in fine.iter_mut().zip(prolong_padded(&coarse, octant)) {
                        // V has the unit 1/h, and h is half of the parents'.
                        *fine += 0.5 * coarse;
                    }
                }
                fine
            }))
        })
    }
}

/// The normals of the samples in cells -1 to `last` of a node, splatted at its corners; complete at
/// the own corners for 3, at all corners for 4.
fn splat_node(
    level: &Level,
    node: usize,
    samples: &Samples,
    weights: &SampleWeights<'_>,
    fraction: impl Fn(usize) -> f32,
    last: i32,
) -> [PaddedValues; 3] {
    let mut sums = [[0.0; PADDED]; 3];
    level.for_each_sample_around(node, samples, last, |sample, cell, inside| {
        let fraction = fraction(sample);
        if fraction <= 0.0 {
            return;
        }
        let area = fraction * weights.area(sample, level.depth);
        let corner = ((cell[0] + 1) + 6 * (cell[1] + 1) + 36 * (cell[2] + 1)) as usize;
        for (offset, shape) in PADDED_OFFSETS.into_iter().zip(trilinear(inside)) {
            // The far corners of cell 4 are not needed and may be out of bounds.
            if corner + offset < PADDED {
                for (sum, normal) in sums.iter_mut().zip(samples.normals[sample]) {
                    sum[corner + offset] += shape * area * normal;
                }
            }
        }
    });
    sums
}
