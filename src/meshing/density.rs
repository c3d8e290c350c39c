//! Sampling density of the surface: kernel density estimation on the octree.
//!
//! ```text
//! c_d(x) = Σ_s w_s ∫ B_d(x − y) B_d(y − s) dy / 0.55        samples per cell face at depth d
//! δ(x)   = d + log₄(c_d(x) / samples_per_node)               depth at which a face has samples_per_node
//! ```
//!
//! with quadratic B-splines B at the centers of the cells; d is the finest depth of the kernel at which
//! c reaches `samples_per_node`. Kazhdan, Bolitho and Hoppe, *Poisson Surface Reconstruction* (2006),
//! section 4.3; on a surface c decreases by a factor of 4 per depth, and 0.55 is the mean response of
//! the kernel to a plane through it.

use rayon::prelude::*;

use super::octree::{CELLS, Level, Octree, offsets};
use super::samples::Samples;
use super::stencil::{OwnValues, PADDED, PaddedValues};

/// Mean of Σ B(x − i)² over x, for the quadratic B-spline B.
const PLANE_FACTOR: f32 = 0.55;

/// Smoothed sample counts on the cells of an octree.
pub struct DensityField {
    tree: Octree,
    /// Per level the counts of each node, and one empty node at the end.
    counts: Vec<Vec<OwnValues>>,
    samples_per_node: f32,
}

impl DensityField {
    /// Counts the samples at every depth down to `depth`.
    pub fn new(samples: &Samples, depth: u32, samples_per_node: f32) -> Self {
        let tree = Octree::build(samples, depth, |_, _| true);
        let counts = tree
            .levels
            .iter()
            .map(|level| splat(samples, level))
            .collect();
        Self {
            tree,
            counts,
            samples_per_node,
        }
    }

    /// The density at every sample, see [`depth_at`](Self::depth_at).
    pub fn sample_depths(&self, samples: &Samples) -> Vec<f32> {
        samples
            .positions
            .par_iter()
            .with_min_len(1024)
            .map(|&position| self.depth_at(position))
            .collect()
    }

    /// The depth at which a cell face has `samples_per_node` samples, at a position in the unit cube; at
    /// least 0.
    pub fn depth_at(&self, position: [f32; 3]) -> f32 {
        let mut finer = 0.0;
        for level in (0..self.tree.levels.len()).rev() {
            let count = self.count_at(level, position);
            let depth = self.tree.levels[level].depth as f32;
            if count >= self.samples_per_node {
                let excess = (count / self.samples_per_node).ln();
                let is_finest = level + 1 == self.tree.levels.len();
                let growth = if is_finest || finer <= 0.0 {
                    4.0_f32.ln()
                } else {
                    (count / finer).ln().max(0.1)
                };
                return depth + (excess / growth).min(if is_finest { f32::MAX } else { 1.0 });
            }
            finer = count;
        }
        // Sparser than the base level: extrapolated by a factor of 4 per depth.
        let base = self.tree.levels[0].depth as f32;
        (base + (finer.max(1e-6) / self.samples_per_node).ln() / 4.0_f32.ln()).max(0.0)
    }

    fn count_at(&self, level: usize, position: [f32; 3]) -> f32 {
        let nodes = &self.tree.levels[level];
        let cells = (1_u32 << nodes.depth) as f32;
        let scaled = position.map(|x| x * cells);
        let cell = scaled.map(|x| x.floor() as i32);
        let Some(node) = self.tree.node_at(level, cell) else {
            return 0.0;
        };
        let weights = [0, 1, 2].map(|axis| quadratic(scaled[axis] - cell[axis] as f32));
        let local = cell.map(|x| x & 3);
        let neighbors = &nodes.neighbors[node];
        let mut sum = 0.0;
        for z in 0..3 {
            for y in 0..3 {
                let mut row = 0.0;
                for x in 0..3 {
                    let (side, inside) =
                        split([local[0] + x - 1, local[1] + y - 1, local[2] + z - 1]);
                    row += weights[0][x as usize]
                        * self.counts[level][neighbors[side] as usize][inside];
                }
                sum += weights[1][y as usize] * weights[2][z as usize] * row;
            }
        }
        sum / PLANE_FACTOR
    }
}

/// The neighbor that contains a cell up to four cells outside of a node, and the index in it.
#[inline]
fn split(cell: [i32; 3]) -> (usize, usize) {
    let side = cell.map(|x| (x + 4) >> 2);
    let inside = cell.map(|x| x & 3);
    (
        (side[0] + 3 * side[1] + 9 * side[2]) as usize,
        (inside[0] + 4 * inside[1] + 16 * inside[2]) as usize,
    )
}

/// The quadratic B-splines of the lower, the own and the upper cell at a position 0 to 1 in the own one.
#[inline]
fn quadratic(x: f32) -> [f32; 3] {
    [
        0.5 * (1.0 - x) * (1.0 - x),
        0.75 - (x - 0.5) * (x - 0.5),
        0.5 * x * x,
    ]
}

/// Splats each sample's weight on the 27 cells around it: first each node on its own cells and one
/// layer of padding, then the padding is added up in the order of the neighbors.
fn splat(samples: &Samples, level: &Level) -> Vec<OwnValues> {
    let mut padded = vec![[0.0_f32; PADDED]; level.len() + 1];
    (padded.par_iter_mut().zip(&level.samples)).for_each(|(padded, &[begin, end])| {
        for sample in begin as usize..end as usize {
            let (cell, inside) = samples.cell(sample, level.depth);
            let local = cell.map(|x| (x & 3) as usize);
            let weights = inside.map(quadratic);
            for (z, wz) in weights[2].iter().enumerate() {
                for (y, wy) in weights[1].iter().enumerate() {
                    let row = local[0] + 6 * (local[1] + y) + 36 * (local[2] + z);
                    let w = wy * wz;
                    for (x, wx) in weights[0].iter().enumerate() {
                        padded[row + x] += w * wx;
                    }
                }
            }
        }
    });
    let mut counts = vec![[0.0_f32; CELLS]; level.len() + 1];
    (counts.par_iter_mut().zip(&level.neighbors)).for_each(|(counts, neighbors)| {
        for (&neighbor, offset) in neighbors.iter().zip(offsets()) {
            add_neighbor(counts, &padded[neighbor as usize], offset);
        }
    });
    counts
}

/// Adds the part of a neighbor's padded counts that is on the cells of a node.
fn add_neighbor(counts: &mut OwnValues, from: &PaddedValues, offset: [i32; 3]) {
    // Cell x of the node is cell x - 4·offset of the neighbor, whose padded counts are -1 to 4.
    let [range_x, range_y, range_z] = offset.map(|offset| match offset {
        -1 => 0..1,
        1 => 3..4,
        _ => 0..4,
    });
    let source = |x: i32, axis: usize| (x - 4 * offset[axis] + 1) as usize;
    for z in range_z {
        for y in range_y.clone() {
            for x in range_x.clone() {
                counts[(x + 4 * y + 16 * z) as usize] +=
                    from[source(x, 0) + 6 * source(y, 1) + 36 * source(z, 2)];
            }
        }
    }
}
