//! How densely the surface is sampled around a place: kernel density estimation on the octree.
//!
//! ```text
//! c_d(x) = Σ_s w_s ∫ B_d(x − y) B_d(y − s) dy / 0.55        samples per cell face of depth d
//! δ(x)   = d + log₄(c_d(x) / samples_per_node)               the depth with samples_per_node each
//! ```
//!
//! with quadratic B-splines B at the centres of the cells. Where even that kernel is too fine
//! to hold `samples_per_node`, d is the first coarser depth that does. Kazhdan, Bolitho and
//! Hoppe, *Poisson Surface Reconstruction* (2006), section 4.3; on a surface c falls by 4 per
//! depth, and 0.55 is what a plane through its own kernel sees on average.

use rayon::prelude::*;

use super::octree::{CELLS, Level, Octree, offsets};
use super::samples::Samples;

/// Mean of Σ B(x − i)² over x, for the quadratic B-spline B.
const PLANE_FACTOR: f32 = 0.55;

/// Sample counts on the cells of an octree, smoothed.
pub struct DensityField {
    tree: Octree,
    /// Per level 64 counts per node, and one empty node at the end.
    counts: Vec<Vec<f32>>,
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

    /// The depth whose cell faces hold `samples_per_node` samples, of every sample.
    pub fn sample_depths(&self, samples: &Samples) -> Vec<f32> {
        samples
            .positions
            .par_iter()
            .with_min_len(1024)
            .map(|&position| self.depth_at(position))
            .collect()
    }

    /// The same at any place of the unit cube; never below 0.
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
        // Sparser than the base level knows: on a surface the count grows by 4 per depth.
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
                    let at = [local[0] + x - 1, local[1] + y - 1, local[2] + z - 1];
                    let (side, inside) = split(at);
                    row += weights[0][x as usize]
                        * self.counts[level][neighbors[side] as usize * CELLS + inside];
                }
                sum += weights[1][y as usize] * weights[2][z as usize] * row;
            }
        }
        sum / PLANE_FACTOR
    }
}

/// The neighbour and the place inside it of a cell that lies up to four cells outside of a node.
#[inline]
fn split(cell: [i32; 3]) -> (usize, usize) {
    let side = cell.map(|x| (x + 4) >> 2);
    let inside = cell.map(|x| x & 3);
    (
        (side[0] + 3 * side[1] + 9 * side[2]) as usize,
        (inside[0] + 4 * inside[1] + 16 * inside[2]) as usize,
    )
}

/// The quadratic B-splines of the cell below, the own cell and the one above, at a place 0 to 1 in the own.
#[inline]
fn quadratic(x: f32) -> [f32; 3] {
    [
        0.5 * (1.0 - x) * (1.0 - x),
        0.75 - (x - 0.5) * (x - 0.5),
        0.5 * x * x,
    ]
}

/// Each sample's weight on the 27 cells around it: first every node over itself and a rim of one
/// cell, then the rims are added up in the order of the neighbours.
fn splat(samples: &Samples, level: &Level) -> Vec<f32> {
    const WIDE: usize = 216;
    let mut wide = vec![0.0_f32; (level.len() + 1) * WIDE];
    wide.par_chunks_mut(WIDE)
        .zip(&level.samples)
        .for_each(|(wide, &[begin, end])| {
            for sample in begin as usize..end as usize {
                let (cell, inside) = samples.cell(sample, level.depth);
                let local = cell.map(|x| (x & 3) as usize);
                let weights = inside.map(quadratic);
                for (z, wz) in weights[2].iter().enumerate() {
                    for (y, wy) in weights[1].iter().enumerate() {
                        let row = local[0] + 6 * (local[1] + y) + 36 * (local[2] + z);
                        let w = samples.weights[sample] * wy * wz;
                        for (x, wx) in weights[0].iter().enumerate() {
                            wide[row + x] += w * wx;
                        }
                    }
                }
            }
        });
    let mut counts = vec![0.0_f32; (level.len() + 1) * CELLS];
    counts
        .par_chunks_mut(CELLS)
        .zip(&level.neighbors)
        .for_each(|(counts, neighbors)| {
            for (index, offset) in offsets().enumerate() {
                let from = &wide[neighbors[index] as usize * WIDE..][..WIDE];
                add_rim(counts, from, offset);
            }
        });
    counts
}

/// Adds what a neighbour at `offset` has put onto the cells of a node.
fn add_rim(counts: &mut [f32], from: &[f32], offset: [i32; 3]) {
    // A cell x of the node is cell x - 4·offset of the neighbour, which knows -1 to 4.
    let range = |axis: usize| match offset[axis] {
        -1 => 0..1,
        1 => 3..4,
        _ => 0..4,
    };
    let theirs = |x: i32, axis: usize| (x - 4 * offset[axis] + 1) as usize;
    for z in range(2) {
        for y in range(1) {
            for x in range(0) {
                counts[(x + 4 * y + 16 * z) as usize] +=
                    from[theirs(x, 0) + 6 * theirs(y, 1) + 36 * theirs(z, 2)];
            }
        }
    }
}
