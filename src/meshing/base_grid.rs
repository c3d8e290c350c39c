//! The coarsest depths, where the whole cube is divided: trilinear finite elements on a full grid
//! with natural (Neumann) boundary, solved by conjugate gradients from coarse to fine.

use super::octree::Level;
use super::samples::Samples;
use super::stencil::{CORNERS, CornerValues, trilinear};
use super::weights::{ConstraintSum, PointConstraint, SampleWeights};

/// Values at the (n + 1)³ corners of n³ cells.
pub struct BaseGrid {
    cells: usize,
    values: Vec<f32>,
}

/// Residual of convergence, relative to the right side.
const TOLERANCE: f64 = 1e-4;
const MAX_ITERATIONS: usize = 300;

/// Solves the depths 2 to `depth`, each starting from the solution of the coarser one.
pub fn solve(samples: &Samples, depth: u32, weights: &SampleWeights<'_>) -> BaseGrid {
    let mut solution = BaseGrid {
        cells: 4,
        values: vec![0.0; 5 * 5 * 5],
    };
    for depth in 2..=depth {
        if depth > 2 {
            solution = solution.prolonged();
        }
        let field = splat(samples, depth, |sample| weights.area(sample, depth));
        let constraints = constraints(samples, depth, weights);
        solution.relax(&divergence(&field, solution.cells), &constraints);
    }
    solution
}

/// The normal field at the corners of the grid of a depth; `area` is in cell faces.
pub fn splat(samples: &Samples, depth: u32, area: impl Fn(usize) -> f32) -> Vec<[f32; 3]> {
    let cells = 1_usize << depth;
    let mut field = vec![[0.0; 3]; (cells + 1).pow(3)];
    for sample in 0..samples.len() {
        let area = area(sample);
        if area <= 0.0 {
            continue;
        }
        let (cell, inside) = samples.cell(sample, depth);
        let corner = grid_index(cell.map(|x| x as usize), cells);
        for (offset, shape) in corner_offsets(cells).into_iter().zip(trilinear(inside)) {
            let sums = &mut field[corner + offset];
            for (sum, normal) in sums.iter_mut().zip(samples.normals[sample]) {
                *sum += shape * area * normal;
            }
        }
    }
    field
}

/// Grid indices of the corners of a node of the base level.
pub fn node_corners(level: &Level, node: usize) -> [usize; CORNERS] {
    let [x, y, z] = level.first_cell(node).map(|x| x as usize);
    std::array::from_fn(|i| grid_index([x + i % 5, y + i / 5 % 5, z + i / 25], 1 << level.depth))
}

impl BaseGrid {
    /// Corner values of all nodes of the base level.
    pub fn into_nodes(self, level: &Level) -> Vec<CornerValues> {
        (0..level.len())
            .map(|node| node_corners(level, node).map(|corner| self.values[corner]))
            .collect()
    }

    /// The same function on cells of half the width.
    fn prolonged(&self) -> Self {
        let ends = |x: usize| [x / 2, x.div_ceil(2)];
        let value = |[x, y, z]: [usize; 3]| {
            let (x, y, z) = (ends(x), ends(y), ends(z));
            let at = |i: usize| {
                self.values[grid_index([x[i & 1], y[i >> 1 & 1], z[i >> 2]], self.cells)]
            };
            0.125 * (((at(0) + at(1)) + (at(2) + at(3))) + ((at(4) + at(5)) + (at(6) + at(7))))
        };
        Self {
            cells: 2 * self.cells,
            values: lattice(2 * self.cells + 1).map(value).collect(),
        }
    }

    /// Conjugate gradients from the present values.
    fn relax(&mut self, right_side: &[f32], constraints: &[PointConstraint]) {
        let cells = self.cells;
        let applied = apply(&self.values, cells, constraints);
        let mut residual: Vec<f32> = (right_side.iter().zip(&applied))
            .map(|(b, a)| b - a)
            .collect();
        let mut direction = residual.clone();
        let mut squared = dot(&residual, &residual);
        let goal = TOLERANCE * TOLERANCE * dot(right_side, right_side);
        for _ in 0..MAX_ITERATIONS {
            if squared <= goal {
                break;
            }
            let applied = apply(&direction, cells, constraints);
            let step = (squared / dot(&direction, &applied)) as f32;
            axpy(&mut self.values, step, &direction);
            axpy(&mut residual, -step, &applied);
            let next = dot(&residual, &residual);
            let beta = (next / squared) as f32;
            squared = next;
            for (p, r) in direction.iter_mut().zip(&residual) {
                *p = r + beta * *p;
            }
        }
    }
}

/// All index triples below n, x fastest.
fn lattice(n: usize) -> impl Iterator<Item = [usize; 3]> {
    (0..n).flat_map(move |z| (0..n).flat_map(move |y| (0..n).map(move |x| [x, y, z])))
}

/// Index of a corner among the (cells + 1)³.
#[inline]
fn grid_index(corner: [usize; 3], cells: usize) -> usize {
    corner[0] + (cells + 1) * (corner[1] + (cells + 1) * corner[2])
}

fn corner_offsets(cells: usize) -> [usize; 8] {
    std::array::from_fn(|corner| grid_index([corner & 1, corner >> 1 & 1, corner >> 2], cells))
}

fn constraints(samples: &Samples, depth: u32, weights: &SampleWeights<'_>) -> Vec<PointConstraint> {
    let shift = 3 * (samples.depth - depth);
    let mut constraints = Vec::new();
    let mut begin = 0;
    for codes in samples.codes.chunk_by(|a, b| a >> shift == b >> shift) {
        let (cell, _) = samples.cell(begin, depth);
        let mut sum = ConstraintSum::default();
        for sample in begin..begin + codes.len() {
            let (_, inside) = samples.cell(sample, depth);
            sum.add(weights.screening(sample, depth), inside);
        }
        constraints.extend(sum.constraint(grid_index(cell.map(|x| x as usize), 1 << depth)));
        begin += codes.len();
    }
    constraints
}

/// Stiffness and screening times `u`, element by element. Row i of an element is
/// (4 uᵢ − the three along face diagonals − the one along the cell diagonal) / 12.
fn apply(u: &[f32], cells: usize, constraints: &[PointConstraint]) -> Vec<f32> {
    let offsets = corner_offsets(cells);
    let mut out = vec![0.0; u.len()];
    lattice(cells).for_each(|cell| {
        let corner = grid_index(cell, cells);
        let local = offsets.map(|offset| u[corner + offset]);
        let sum: f32 = local.iter().sum();
        for (i, offset) in offsets.iter().enumerate() {
            let axes = local[i ^ 1] + local[i ^ 2] + local[i ^ 4];
            out[corner + offset] += (5.0 * local[i] + axes - sum) / 12.0;
        }
    });
    for constraint in constraints {
        constraint.apply(u, &offsets, &mut out);
    }
    out
}

/// ∫∇φᵢ·V, element by element.
fn divergence(field: &[[f32; 3]], cells: usize) -> Vec<f32> {
    let offsets = corner_offsets(cells);
    let mut out = vec![0.0; field.len()];
    for cell in lattice(cells) {
        let corner = grid_index(cell, cells);
        let local = offsets.map(|offset| field[corner + offset]);
        if local.iter().any(|v| *v != [0.0; 3]) {
            for (i, offset) in offsets.iter().enumerate() {
                out[corner + offset] += element_divergence(&local, i);
            }
        }
    }
    out
}

/// ∫∇φᵢ·V over one unit cell: along the axis ±1/2 at either end, across it the mass 1/3 or 1/6.
fn element_divergence(field: &[[f32; 3]; 8], i: usize) -> f32 {
    let mut sum = 0.0;
    for (j, v) in field.iter().enumerate() {
        let is_same = |axis: usize| (i ^ j) >> axis & 1 == 0;
        let mass = |axis: usize| if is_same(axis) { 1.0 / 3.0 } else { 1.0 / 6.0 };
        let slope = |axis: usize| if i >> axis & 1 == 1 { 0.5 } else { -0.5 };
        sum += slope(0) * mass(1) * mass(2) * v[0]
            + mass(0) * slope(1) * mass(2) * v[1]
            + mass(0) * mass(1) * slope(2) * v[2];
    }
    sum
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from(a * b)).sum()
}

fn axpy(y: &mut [f32], factor: f32, x: &[f32]) {
    for (y, x) in y.iter_mut().zip(x) {
        *y += factor * x;
    }
}
