//! The screened Poisson equation, depth by depth from coarse to fine.
//!
//! ```text
//! E(χ) = ∫ |∇χ − V|² + α Σ_s a_s χ(s)² / h      over the trilinear B-splines φ of one depth, cell width h
//! ```
//!
//! At each depth the prolonged solution of the coarser one is corrected at the corners whose eight
//! cells are all refined; the other corners are fixed, so that the function is continuous between
//! cells of different size. Division by h gives the screening term the same weight relative to the
//! gradient at every depth. Kazhdan and Hoppe, *Screened Poisson Surface Reconstruction* (2013),
//! equations 4 to 9 and section 4.2.

use rayon::prelude::*;

use super::normal_field::CoarseField;
use super::octree::{CELLS, GRAIN, Level};
use super::samples::Samples;
use super::stencil::{
    CORNERS, CornerValues, OwnValues, PADDED, PADDED_OFFSETS, PaddedValues, corners_in_padded,
    gather_corners, gather_own, laplacian, own_in_padded, prolong_corners, trilinear,
};
use super::weights::{ConstraintSum, PointConstraint, SampleWeights};

/// The linear system of one depth.
struct System {
    /// Inverse diagonal of the matrix; 0 at fixed corners.
    inverse_diagonal: Vec<OwnValues>,
    /// Per chunk of nodes: where the constraints of each node begin, and the constraints, with
    /// indices of padded corners.
    constraints: Vec<(Vec<usize>, Vec<PointConstraint>)>,
}

/// Nodes per chunk of constraints.
const CHUNK: usize = 4 * GRAIN;

/// The solution at the corners of `level`, from that of the level above.
pub fn refine(
    (parents, parent_solution): (&Level, &[CornerValues]),
    level: &Level,
    samples: &Samples,
    weights: &SampleWeights<'_>,
    coarse: &CoarseField,
    iterations: usize,
) -> Vec<CornerValues> {
    let mut solution = level.par_map(|node| {
        let (parent, octant) = level.parent_octant(node);
        prolong_corners(&parent_solution[parent], octant)
    });
    let right_side = coarse.divergence(parents, level, samples, weights);
    let system = System::new(level, samples, weights);
    let residual = system.residual(level, &solution, right_side);
    let correction = system.conjugate_gradients(level, residual, iterations);
    add_correction(&mut solution, level, &correction);
    solution
}

impl System {
    fn new(level: &Level, samples: &Samples, weights: &SampleWeights<'_>) -> Self {
        let starts: Vec<usize> = (0..level.len()).step_by(CHUNK).collect();
        let constraints = starts
            .into_par_iter()
            .map(|start| {
                let (mut offsets, mut constraints) = (vec![0], Vec::new());
                for node in start..level.len().min(start + CHUNK) {
                    add_constraints(level, node, samples, weights, &mut constraints);
                    offsets.push(constraints.len());
                }
                (offsets, constraints)
            })
            .collect();
        let mut system = Self {
            inverse_diagonal: Vec::new(),
            constraints,
        };
        system.inverse_diagonal = level.par_map(|node| system.inverse_diagonal(level, node));
        system
    }

    fn constraints_of(&self, node: usize) -> &[PointConstraint] {
        let (offsets, constraints) = &self.constraints[node / CHUNK];
        &constraints[offsets[node % CHUNK]..offsets[node % CHUNK + 1]]
    }

    fn inverse_diagonal(&self, level: &Level, node: usize) -> OwnValues {
        let mut diagonal = [8.0 / 3.0_f32; PADDED];
        for constraint in self.constraints_of(node) {
            let shapes = trilinear(constraint.inside);
            for (offset, shape) in PADDED_OFFSETS.into_iter().zip(shapes) {
                diagonal[constraint.corner as usize + offset] += constraint.weight * shape * shape;
            }
        }
        let free = free_corners(level, node);
        let mut out = [0.0; CELLS];
        for (own, corner) in own_in_padded().enumerate() {
            if free >> own & 1 == 1 {
                out[own] = 1.0 / diagonal[corner];
            }
        }
        out
    }

    /// Stiffness and screening times `u` at the own corners of a node.
    #[inline]
    fn apply(&self, node: usize, u: &PaddedValues) -> OwnValues {
        let mut out = laplacian(u);
        let constraints = self.constraints_of(node);
        if !constraints.is_empty() {
            let mut screening = [0.0_f32; PADDED];
            for constraint in constraints {
                constraint.apply(u, &PADDED_OFFSETS, &mut screening);
            }
            for (out, corner) in out.iter_mut().zip(own_in_padded()) {
                *out += screening[corner];
            }
        }
        out
    }

    fn residual(
        &self,
        level: &Level,
        solution: &[CornerValues],
        mut right_side: Vec<OwnValues>,
    ) -> Vec<OwnValues> {
        (right_side.par_iter_mut().enumerate())
            .with_min_len(GRAIN)
            .for_each(|(node, out)| {
                let values = gather_corners(|node| &solution[node], level, node);
                for (out, applied) in out.iter_mut().zip(self.apply(node, &values)) {
                    *out -= applied;
                }
            });
        right_side
    }

    /// Conjugate gradients with the Jacobi preconditioner, starting from 0; the result ends with one
    /// node of zeros.
    fn conjugate_gradients(
        &self,
        level: &Level,
        mut residual: Vec<OwnValues>,
        iterations: usize,
    ) -> Vec<OwnValues> {
        let inverse = &self.inverse_diagonal;
        let count = level.len();
        let mut correction = vec![[0.0; CELLS]; count + 1];
        let mut direction = vec![[0.0; CELLS]; count + 1];
        let mut applied = vec![[0.0; CELLS]; count];
        let mut energy = 0.0;
        for iteration in 0..iterations {
            let next = sum_over_nodes(&residual, inverse, |r, inverse| r * r * inverse);
            if next <= f64::MIN_POSITIVE {
                break;
            }
            let beta = if iteration == 0 {
                0.0
            } else {
                (next / energy) as f32
            };
            energy = next;
            (direction[..count]
                .par_iter_mut()
                .zip(&residual)
                .zip(inverse))
            .with_min_len(GRAIN)
            .for_each(|((p, r), inverse)| {
                for i in 0..CELLS {
                    p[i] = r[i] * inverse[i] + beta * p[i];
                }
            });
            (applied.par_iter_mut().zip(&level.neighbors).enumerate())
                .with_min_len(GRAIN)
                .for_each(|(node, (out, neighbors))| {
                    *out = self.apply(node, &gather_own(|node| &direction[node], neighbors));
                });
            let curvature = sum_over_nodes(&direction[..count], &applied, |p, applied| p * applied);
            let step = (energy / curvature) as f32;
            (correction[..count].par_iter_mut().zip(&mut residual))
                .zip(direction[..count].par_iter().zip(&applied))
                .with_min_len(GRAIN)
                .for_each(|((x, r), (p, applied))| {
                    for i in 0..CELLS {
                        x[i] += step * p[i];
                        r[i] -= step * applied[i];
                    }
                });
        }
        correction
    }
}

/// Σ f(a, b), in an order that does not depend on the number of threads.
fn sum_over_nodes(a: &[OwnValues], b: &[OwnValues], f: impl Fn(f32, f32) -> f32 + Sync) -> f64 {
    let node_sum = |(a, b): (&OwnValues, &OwnValues)| {
        f64::from(a.iter().zip(b).map(|(a, b)| f(*a, *b)).sum::<f32>())
    };
    let parts: Vec<f64> = (a.par_chunks(GRAIN).zip(b.par_chunks(GRAIN)))
        .map(|(a, b)| a.iter().zip(b).map(node_sum).sum())
        .collect();
    parts.iter().sum()
}

/// Bits of the own corners whose eight cells are all in the tree.
fn free_corners(level: &Level, node: usize) -> u64 {
    let missing: [bool; 8] = std::array::from_fn(|corner| {
        let offset = [0, 1, 2].map(|axis| -((corner >> axis & 1) as i32));
        level.neighbor(node, offset).is_none()
    });
    (0..CELLS).fold(0, |free, own| {
        let at_end = [own & 3, own >> 2 & 3, own >> 4].map(|x| x == 0);
        let blocked = (1..8).any(|corner| {
            missing[corner] && (0..3).all(|axis| corner >> axis & 1 == 0 || at_end[axis])
        });
        free | u64::from(!blocked) << own
    })
}

/// Appends the constraints of the cells -1 to 3 of a node.
fn add_constraints(
    level: &Level,
    node: usize,
    samples: &Samples,
    weights: &SampleWeights<'_>,
    constraints: &mut Vec<PointConstraint>,
) {
    let mut sums = [ConstraintSum::default(); CORNERS];
    let mut any = false;
    level.for_each_sample_around(node, samples, 3, |sample, cell, inside| {
        let index = ((cell[0] + 1) + 5 * (cell[1] + 1) + 25 * (cell[2] + 1)) as usize;
        sums[index].add(weights.screening(sample, level.depth), inside);
        any = true;
    });
    if any {
        constraints.extend(
            sums.iter()
                .enumerate()
                .filter_map(|(i, sum)| sum.constraint(i % 5 + 6 * (i / 5 % 5) + 36 * (i / 25))),
        );
    }
}

/// Adds a correction at the own corners to the solution at all corners.
fn add_correction(solution: &mut [CornerValues], level: &Level, correction: &[OwnValues]) {
    (solution.par_iter_mut().zip(&level.neighbors))
        .with_min_len(GRAIN)
        .for_each(|(values, neighbors)| {
            let padded = gather_own(|node| &correction[node], neighbors);
            for (value, index) in values.iter_mut().zip(corners_in_padded()) {
                *value += padded[index];
            }
        });
}
