//! The screened Poisson equation, depth by depth from coarse to fine.
//!
//! ```text
//! E(χ) = ∫ |∇χ − V|² + α Σ_s a_s χ(s)² / h      over the hats φ of one depth, cells of width h
//! ```
//!
//! At each depth the solution of the coarser one, which every finer cell can represent exactly,
//! is corrected at the corners whose eight cells are all refined; at the others it stays, so that
//! the function is continuous where cells of different size meet. The pull to 0 is divided by h:
//! then it weighs the same against the gradient at every depth. Kazhdan and Hoppe, *Screened
//! Poisson Surface Reconstruction* (2013), equations 4 to 9 and section 4.2.

use rayon::prelude::*;

use super::base_grid::{copy_closed, corner_index, splat, trilinear};
use super::block::{
    CLOSED, RIMMED, divergence, gather, gather_closed, laplacian, prolong_closed, prolong_rimmed,
};
use super::octree::{CELLS, Level};
use super::samples::Samples;

/// Nodes that a thread takes at once.
const GRAIN: usize = 64;

/// How much of the surface each sample stands for.
pub struct ScreeningWeights<'a> {
    /// Depth at which a cell face holds `samples_per_node` samples, per sample.
    pub depths: &'a [f32],
    /// Confidences.
    pub weights: &'a [f32],
    /// Samples that a cell face holds at a sample's depth.
    pub samples_per_node: f32,
    /// α.
    pub point_weight: f32,
}

impl ScreeningWeights<'_> {
    /// Area of a sample in cell faces of a depth.
    #[inline]
    pub fn area(&self, sample: usize, depth: u32) -> f32 {
        self.weights[sample] * (2.0 * (depth as f32 - self.depths[sample])).exp2()
            / self.samples_per_node
    }

    /// How strongly a sample is pulled to 0. Cells finer than its depth gain it nothing.
    #[inline]
    pub fn pull(&self, sample: usize, depth: u32) -> f32 {
        let finer = (depth as f32 - self.depths[sample]).min(0.0);
        self.point_weight * self.weights[sample] * (2.0 * finer).exp2() / self.samples_per_node
    }

    /// Share of a sample's normal that is splatted at this depth or finer.
    #[inline]
    pub fn share_from(&self, sample: usize, depth: u32) -> f32 {
        (self.depths[sample] - depth as f32 + 1.0).clamp(0.0, 1.0)
    }
}

/// The field of normals that depths up to the present one carry for good, at the closed corners.
pub struct CoarseField(pub [Vec<f32>; 3]);

/// Everything of one depth that the iterations need.
struct System {
    /// Inverse diagonal; 0 at corners that are not free.
    inverse_diagonal: Vec<f32>,
    /// Where the pulls of each node begin.
    offsets: Vec<u32>,
    pulls: Vec<Pull>,
}

/// The samples of one cell, as one, that pull the solution to 0.
struct Pull {
    /// Lowest corner of the cell among the rimmed ones.
    corner: u8,
    weight: f32,
    inside: [f32; 3],
}

/// Places of a cell's corners among the rimmed ones.
const RIM_OFFSETS: [usize; 8] = [0, 1, 6, 7, 36, 37, 42, 43];

/// The solution at the closed corners of `level`, from that of the level above.
pub fn refine(
    above: (&Level, &[f32]),
    level: &Level,
    samples: &Samples,
    weights: &ScreeningWeights<'_>,
    coarse: &CoarseField,
    iterations: usize,
) -> Vec<f32> {
    let mut solution = prolong(above.1, level);
    let right_side = right_side(above.0, level, samples, weights, coarse);
    let system = System::new(level, samples, weights);
    let residual = system.residual(level, &solution, right_side);
    let correction = system.conjugate_gradients(level, residual, iterations);
    add_correction(&mut solution, level, &correction);
    solution
}

fn prolong(above: &[f32], level: &Level) -> Vec<f32> {
    let mut solution = vec![0.0; level.len() * CLOSED];
    solution
        .par_chunks_mut(CLOSED)
        .with_min_len(GRAIN)
        .enumerate()
        .for_each(|(node, values)| {
            let parent = level.parents[node] as usize;
            let octant = (level.keys[node] & 7) as usize;
            values.copy_from_slice(&prolong_closed(&above[parent * CLOSED..][..CLOSED], octant));
        });
    solution
}

/// ∫∇φᵢ·V of the coarse field and of all samples that are dense enough for this depth. Those that
/// are dense enough for finer ones count here too, as wide as the cells of this depth.
fn right_side(
    above: &Level,
    level: &Level,
    samples: &Samples,
    weights: &ScreeningWeights<'_>,
    coarse: &CoarseField,
) -> Vec<f32> {
    let splatted: [Vec<f32>; 3] = {
        let mut columns = [0, 1, 2].map(|_| vec![0.0; (level.len() + 1) * CELLS]);
        let [x, y, z] = &mut columns;
        x.par_chunks_mut(CELLS)
            .zip(y.par_chunks_mut(CELLS))
            .zip(z.par_chunks_mut(CELLS))
            .zip(0..level.len())
            .with_min_len(GRAIN)
            .for_each(|(((x, y), z), node)| {
                let share = |sample: usize| weights.share_from(sample, level.depth);
                let sums = splat_node(level, node, samples, weights, share, false);
                for (place, corner) in own_places().enumerate() {
                    x[place] = sums[0][corner];
                    y[place] = sums[1][corner];
                    z[place] = sums[2][corner];
                }
            });
        columns
    };
    let mut out = vec![0.0; level.len() * CELLS];
    out.par_chunks_mut(CELLS)
        .with_min_len(GRAIN)
        .enumerate()
        .for_each(|(node, out)| {
            let parent = level.parents[node] as usize;
            let octant = (level.keys[node] & 7) as usize;
            let field = [0, 1, 2].map(|axis| {
                let mut fine = gather(&splatted[axis], &level.neighbors[node]);
                let wide = gather_closed(&coarse.0[axis], above, parent);
                if wide.iter().any(|&v| v != 0.0) {
                    for (fine, wide) in fine.iter_mut().zip(prolong_rimmed(&wide, octant)) {
                        // V has the unit 1/h, and h is half of what it was.
                        *fine += 0.5 * wide;
                    }
                }
                fine
            });
            out.copy_from_slice(&divergence(&field));
        });
    out
}

/// Places of the own corners among the rimmed ones.
fn own_places() -> impl Iterator<Item = usize> {
    (0..CELLS).map(|i| (i & 3) + 1 + 6 * ((i >> 2 & 3) + 1) + 36 * ((i >> 4) + 1))
}

impl CoarseField {
    /// On the base level, from the part of the samples that ends there.
    pub fn base(samples: &Samples, level: &Level, weights: &ScreeningWeights<'_>) -> Self {
        let grid = splat(samples, level.depth, |sample| {
            (1.0 - weights.share_from(sample, level.depth + 1)) * weights.area(sample, level.depth)
        });
        let cells = 1 << level.depth;
        let mut columns = [0, 1, 2].map(|_| vec![0.0; level.len() * CLOSED]);
        for node in 0..level.len() {
            copy_closed(level, node, |(corner, place)| {
                let normal = grid[corner_index(corner, cells)];
                for (column, component) in columns.iter_mut().zip(normal) {
                    column[node * CLOSED + place] = component;
                }
            });
        }
        Self(columns)
    }

    /// With the part of the samples that ends at this level.
    pub fn refined(
        &self,
        level: &Level,
        samples: &Samples,
        weights: &ScreeningWeights<'_>,
    ) -> Self {
        let share = |sample: usize| {
            weights.share_from(sample, level.depth) - weights.share_from(sample, level.depth + 1)
        };
        let mut columns = [0, 1, 2].map(|_| vec![0.0; level.len() * CLOSED]);
        let [x, y, z] = &mut columns;
        x.par_chunks_mut(CLOSED)
            .zip(y.par_chunks_mut(CLOSED))
            .zip(z.par_chunks_mut(CLOSED))
            .enumerate()
            .with_min_len(GRAIN)
            .for_each(|(node, ((x, y), z))| {
                let parent = level.parents[node] as usize;
                let octant = (level.keys[node] & 7) as usize;
                let own = splat_node(level, node, samples, weights, share, true);
                for (axis, out) in [x, y, z].into_iter().enumerate() {
                    let wide = &self.0[axis][parent * CLOSED..][..CLOSED];
                    let wide = prolong_closed(wide, octant);
                    for place in 0..CLOSED {
                        let rim = (place % 5 + 1) + 6 * (place / 5 % 5 + 1) + 36 * (place / 25 + 1);
                        out[place] = 0.5 * wide[place] + own[axis][rim];
                    }
                }
            });
        Self(columns)
    }
}

/// The normals of the samples in and around a node on its corners, as far as they come from cells
/// -1 to 3, or with `closed` from -1 to 4.
fn splat_node(
    level: &Level,
    node: usize,
    samples: &Samples,
    weights: &ScreeningWeights<'_>,
    share: impl Fn(usize) -> f32,
    closed: bool,
) -> [[f32; RIMMED]; 3] {
    let mut sums = [[0.0; RIMMED]; 3];
    let last = if closed { 4 } else { 3 };
    for_each_sample_around(level, node, samples, last, |sample, cell, inside| {
        let share = share(sample);
        if share <= 0.0 {
            return;
        }
        let area = share * weights.area(sample, level.depth);
        let corner = rim_index(cell);
        for (offset, shape) in RIM_OFFSETS.into_iter().zip(trilinear(inside)) {
            // The far corners of cell 4 are not asked for.
            if let Some(place) = (corner + offset < RIMMED).then_some(corner + offset) {
                for (sum, normal) in sums.iter_mut().zip(samples.normals[sample]) {
                    sum[place] += shape * area * normal;
                }
            }
        }
    });
    sums
}

/// Place of the lowest corner of a cell, -1 to 4 per axis, among the rimmed ones.
#[inline]
fn rim_index(cell: [i32; 3]) -> usize {
    ((cell[0] + 1) + 6 * (cell[1] + 1) + 36 * (cell[2] + 1)) as usize
}

/// Visits the samples in the cells -1 to `last` (3 or 4) of a node, neighbours in their order.
fn for_each_sample_around(
    level: &Level,
    node: usize,
    samples: &Samples,
    last: i32,
    mut visit: impl FnMut(usize, [i32; 3], [f32; 3]),
) {
    let first = level.first_cell(node);
    let highest = last - 3;
    for dz in -1..=highest {
        for dy in -1..=highest {
            for dx in -1..=highest {
                let Some(from) = level.neighbor(node, [dx, dy, dz]) else {
                    continue;
                };
                let [begin, end] = level.samples[from];
                for sample in begin as usize..end as usize {
                    let (cell, inside) = samples.cell(sample, level.depth);
                    let local = [0, 1, 2].map(|axis| cell[axis] - first[axis]);
                    if local.iter().all(|&x| x >= -1 && x <= last) {
                        visit(sample, local, inside);
                    }
                }
            }
        }
    }
}

impl System {
    fn new(level: &Level, samples: &Samples, weights: &ScreeningWeights<'_>) -> Self {
        let nodes: Vec<usize> = (0..level.len()).collect();
        let chunks: Vec<(Vec<u32>, Vec<Pull>)> = nodes
            .par_chunks(4 * GRAIN)
            .map(|nodes| {
                let mut pulls = Vec::new();
                let counts = nodes
                    .iter()
                    .map(|&node| {
                        let before = pulls.len();
                        pulls_of_node(level, node, samples, weights, &mut pulls);
                        (pulls.len() - before) as u32
                    })
                    .collect();
                (counts, pulls)
            })
            .collect();
        let mut offsets = vec![0];
        let mut pulls = Vec::with_capacity(chunks.iter().map(|(_, pulls)| pulls.len()).sum());
        let mut total = 0;
        for (counts, mut chunk) in chunks {
            for count in counts {
                total += count;
                offsets.push(total);
            }
            pulls.append(&mut chunk);
        }
        let mut system = Self {
            inverse_diagonal: Vec::new(),
            offsets,
            pulls,
        };
        system.inverse_diagonal = system.inverse_diagonal(level);
        system
    }

    fn pulls_of(&self, node: usize) -> &[Pull] {
        &self.pulls[self.offsets[node] as usize..self.offsets[node + 1] as usize]
    }

    fn inverse_diagonal(&self, level: &Level) -> Vec<f32> {
        let mut out = vec![0.0; level.len() * CELLS];
        out.par_chunks_mut(CELLS)
            .with_min_len(GRAIN)
            .enumerate()
            .for_each(|(node, out)| {
                let mut diagonal = [8.0 / 3.0_f32; RIMMED];
                for pull in self.pulls_of(node) {
                    for (offset, shape) in RIM_OFFSETS.into_iter().zip(trilinear(pull.inside)) {
                        diagonal[pull.corner as usize + offset] += pull.weight * shape * shape;
                    }
                }
                let free = free_corners(level, node);
                for (place, corner) in own_places().enumerate() {
                    if free >> place & 1 == 1 {
                        out[place] = 1.0 / diagonal[corner];
                    }
                }
            });
        out
    }

    /// Stiffness and screening times `u` at the own corners of a node.
    #[inline]
    fn apply(&self, node: usize, u: &[f32; RIMMED]) -> [f32; CELLS] {
        let mut out = laplacian(u);
        let pulls = self.pulls_of(node);
        if pulls.is_empty() {
            return out;
        }
        let mut pulled = [0.0_f32; RIMMED];
        for pull in pulls {
            let corner = pull.corner as usize;
            let shape = trilinear(pull.inside);
            let value: f32 = (0..8).map(|i| shape[i] * u[corner + RIM_OFFSETS[i]]).sum();
            let value = pull.weight * value;
            for i in 0..8 {
                pulled[corner + RIM_OFFSETS[i]] += value * shape[i];
            }
        }
        for (place, corner) in own_places().enumerate() {
            out[place] += pulled[corner];
        }
        out
    }

    fn residual(&self, level: &Level, solution: &[f32], right_side: Vec<f32>) -> Vec<f32> {
        let mut residual = right_side;
        residual
            .par_chunks_mut(CELLS)
            .with_min_len(GRAIN)
            .enumerate()
            .for_each(|(node, out)| {
                let applied = self.apply(node, &gather_closed(solution, level, node));
                for (out, applied) in out.iter_mut().zip(applied) {
                    *out -= applied;
                }
            });
        residual
    }

    /// Preconditioned by the diagonal, from 0; the result ends with one node of zeros.
    fn conjugate_gradients(
        &self,
        level: &Level,
        mut residual: Vec<f32>,
        iterations: usize,
    ) -> Vec<f32> {
        let inverse = &self.inverse_diagonal;
        let count = level.len() * CELLS;
        let mut correction = vec![0.0; count + CELLS];
        let mut direction = vec![0.0; count + CELLS];
        let mut applied = vec![0.0; count];
        let mut energy = 0.0;
        for iteration in 0..iterations {
            let next = sum_over_nodes(&residual, inverse, |r, inverse| r * r * inverse);
            if next <= f64::MIN_POSITIVE {
                break;
            }
            let keep = if iteration == 0 {
                0.0
            } else {
                (next / energy) as f32
            };
            energy = next;
            direction[..count]
                .par_chunks_mut(GRAIN * CELLS)
                .zip(residual.par_chunks(GRAIN * CELLS))
                .zip(inverse.par_chunks(GRAIN * CELLS))
                .for_each(|((p, r), inverse)| {
                    for ((p, r), inverse) in p.iter_mut().zip(r).zip(inverse) {
                        *p = r * inverse + keep * *p;
                    }
                });
            applied
                .par_chunks_mut(CELLS)
                .with_min_len(GRAIN)
                .zip(&level.neighbors)
                .enumerate()
                .for_each(|(node, (out, neighbors))| {
                    out.copy_from_slice(&self.apply(node, &gather(&direction, neighbors)));
                });
            let curvature = sum_over_nodes(&direction[..count], &applied, |p, applied| p * applied);
            let step = (energy / curvature) as f32;
            correction[..count]
                .par_chunks_mut(GRAIN * CELLS)
                .zip(residual.par_chunks_mut(GRAIN * CELLS))
                .zip(direction[..count].par_chunks(GRAIN * CELLS))
                .zip(applied.par_chunks(GRAIN * CELLS))
                .for_each(|(((x, r), p), applied)| {
                    for (((x, r), p), applied) in x.iter_mut().zip(r).zip(p).zip(applied) {
                        *x += step * p;
                        *r -= step * applied;
                    }
                });
        }
        correction
    }
}

/// Σ f(a, b), in an order that does not depend on the number of threads.
fn sum_over_nodes(a: &[f32], b: &[f32], f: impl Fn(f32, f32) -> f32 + Sync) -> f64 {
    let parts: Vec<f64> = a
        .par_chunks(GRAIN * CELLS)
        .zip(b.par_chunks(GRAIN * CELLS))
        .map(|(a, b)| {
            a.chunks(CELLS)
                .zip(b.chunks(CELLS))
                .map(|(a, b)| f64::from(a.iter().zip(b).map(|(a, b)| f(*a, *b)).sum::<f32>()))
                .sum()
        })
        .collect();
    parts.iter().sum()
}

/// Bits of the own corners whose eight cells are all in the tree.
fn free_corners(level: &Level, node: usize) -> u64 {
    let mut free = 0_u64;
    let mut missing = [false; 8];
    for (corner, missing) in missing.iter_mut().enumerate() {
        let offset = [0, 1, 2].map(|axis| -((corner >> axis & 1) as i32));
        *missing = level.neighbor(node, offset).is_none();
    }
    for place in 0..CELLS {
        let at_end = [place & 3, place >> 2 & 3, place >> 4].map(|x| x == 0);
        let blocked = (1..8).any(|corner| {
            missing[corner] && (0..3).all(|axis| corner >> axis & 1 == 0 || at_end[axis])
        });
        free |= u64::from(!blocked) << place;
    }
    free
}

/// The samples of each cell -1 to 3 of a node, as one pull at their mean.
fn pulls_of_node(
    level: &Level,
    node: usize,
    samples: &Samples,
    weights: &ScreeningWeights<'_>,
    pulls: &mut Vec<Pull>,
) {
    let mut sums = [[0.0_f32; 4]; CLOSED];
    let mut any = false;
    for_each_sample_around(level, node, samples, 3, |sample, cell, inside| {
        let place = ((cell[0] + 1) + 5 * (cell[1] + 1) + 25 * (cell[2] + 1)) as usize;
        let weight = weights.pull(sample, level.depth);
        for axis in 0..3 {
            sums[place][axis] += weight * inside[axis];
        }
        sums[place][3] += weight;
        any = true;
    });
    if !any {
        return;
    }
    for (place, sum) in sums.iter().enumerate().filter(|(_, sum)| sum[3] > 0.0) {
        pulls.push(Pull {
            corner: (place % 5 + 6 * (place / 5 % 5) + 36 * (place / 25)) as u8,
            weight: sum[3],
            inside: [0, 1, 2].map(|axis| (sum[axis] / sum[3]).clamp(0.0, 1.0)),
        });
    }
}

/// Adds the own corners of a correction to the closed corners of the solution.
fn add_correction(solution: &mut [f32], level: &Level, correction: &[f32]) {
    solution
        .par_chunks_mut(CLOSED)
        .with_min_len(GRAIN)
        .zip(&level.neighbors)
        .for_each(|(values, neighbors)| {
            let rimmed = gather(correction, neighbors);
            for (place, value) in values.iter_mut().enumerate() {
                *value += rimmed[(place % 5 + 1) + 6 * (place / 5 % 5 + 1) + 36 * (place / 25 + 1)];
            }
        });
}
