//! The coarsest depths, where the whole cube is divided: trilinear finite elements on a full grid
//! with natural (Neumann) boundary, solved by conjugate gradients from coarse to fine.

use super::block::CLOSED;
use super::octree::Level;
use super::samples::Samples;
use super::solver::ScreeningWeights;

/// Values at the (n + 1)³ corners of n³ cells.
pub struct BaseGrid {
    cells: usize,
    values: Vec<f32>,
}

/// A sample, or all samples of a cell, that pulls the solution towards 0.
struct Pull {
    corner: usize,
    shape: [f32; 8],
    weight: f32,
}

/// Residual at which the base grid counts as solved, relative to the right side.
const TOLERANCE: f64 = 1e-4;
const MAX_ITERATIONS: usize = 300;

/// Solves the depths 2 to `depth` one after the other, each from the solution before.
pub fn solve(samples: &Samples, depth: u32, screening: &ScreeningWeights<'_>) -> BaseGrid {
    let mut solution = BaseGrid::zeros(4);
    for depth in 2..=depth {
        if depth > 2 {
            solution = solution.refined();
        }
        let field = splat(samples, depth, |sample| screening.area(sample, depth));
        let pulls = pulls(samples, depth, screening);
        solution.relax(&divergence(&field, solution.cells), &pulls);
    }
    solution
}

/// The field of normals on the corners of the grid of a depth, each sample with its area in cells.
pub fn splat(samples: &Samples, depth: u32, area: impl Fn(usize) -> f32) -> Vec<[f32; 3]> {
    let cells = 1_usize << depth;
    let mut field = vec![[0.0; 3]; (cells + 1).pow(3)];
    for sample in 0..samples.len() {
        let area = area(sample);
        if area <= 0.0 {
            continue;
        }
        let (cell, inside) = samples.cell(sample, depth);
        let corner = corner_index(cell.map(|x| x as usize), cells);
        for (offset, shape) in corner_offsets(cells).into_iter().zip(trilinear(inside)) {
            for (sum, normal) in field[corner + offset]
                .iter_mut()
                .zip(samples.normals[sample])
            {
                *sum += shape * area * normal;
            }
        }
    }
    field
}

/// Weights of the eight corners of a cell at a place inside it, x fastest.
#[inline]
pub fn trilinear(inside: [f32; 3]) -> [f32; 8] {
    let [x, y, z] = inside.map(|t| [1.0 - t, t]);
    std::array::from_fn(|corner| x[corner & 1] * y[corner >> 1 & 1] * z[corner >> 2])
}

impl BaseGrid {
    fn zeros(cells: usize) -> Self {
        Self {
            cells,
            values: vec![0.0; (cells + 1).pow(3)],
        }
    }

    /// The closed corners of all nodes of the octree's base level.
    pub fn into_nodes(self, level: &Level) -> Vec<f32> {
        let mut nodes = vec![0.0; level.len() * CLOSED];
        for (node, values) in nodes.chunks_mut(CLOSED).enumerate() {
            copy_closed(level, node, |corner| {
                values[corner.1] = self.values[corner_index(corner.0, self.cells)];
            });
        }
        nodes
    }

    /// The same function on half the cells.
    fn refined(&self) -> Self {
        let mut fine = Self::zeros(2 * self.cells);
        let ends = |x: usize| (x / 2, x.div_ceil(2));
        for z in 0..=fine.cells {
            for y in 0..=fine.cells {
                for x in 0..=fine.cells {
                    let ((x0, x1), (y0, y1), (z0, z1)) = (ends(x), ends(y), ends(z));
                    let at = |x, y, z| self.values[corner_index([x, y, z], self.cells)];
                    let low = (at(x0, y0, z0) + at(x1, y0, z0)) + (at(x0, y1, z0) + at(x1, y1, z0));
                    let high =
                        (at(x0, y0, z1) + at(x1, y0, z1)) + (at(x0, y1, z1) + at(x1, y1, z1));
                    fine.values[corner_index([x, y, z], fine.cells)] = 0.125 * (low + high);
                }
            }
        }
        fine
    }

    /// Conjugate gradients from the present values.
    fn relax(&mut self, right_side: &[f32], pulls: &[Pull]) {
        let cells = self.cells;
        let applied = apply(&self.values, cells, pulls);
        let mut residual: Vec<f32> = right_side
            .iter()
            .zip(&applied)
            .map(|(b, a)| b - a)
            .collect();
        let mut direction = residual.clone();
        let mut squared = dot(&residual, &residual);
        let goal = TOLERANCE * TOLERANCE * dot(right_side, right_side);
        for _ in 0..MAX_ITERATIONS {
            if squared <= goal {
                break;
            }
            let applied = apply(&direction, cells, pulls);
            let step = (squared / dot(&direction, &applied)) as f32;
            axpy(&mut self.values, step, &direction);
            axpy(&mut residual, -step, &applied);
            let next = dot(&residual, &residual);
            let keep = (next / squared) as f32;
            squared = next;
            for (p, r) in direction.iter_mut().zip(&residual) {
                *p = r + keep * *p;
            }
        }
    }
}

/// Copies grid corners to the closed corners of a node: `copy((grid corner, closed index))`.
pub fn copy_closed(level: &Level, node: usize, mut copy: impl FnMut(([usize; 3], usize))) {
    let first = level.first_cell(node).map(|x| x as usize);
    for z in 0..5 {
        for y in 0..5 {
            for x in 0..5 {
                copy((
                    [first[0] + x, first[1] + y, first[2] + z],
                    x + 5 * y + 25 * z,
                ));
            }
        }
    }
}

/// Place of a corner among the (cells + 1)³.
#[inline]
pub fn corner_index(corner: [usize; 3], cells: usize) -> usize {
    corner[0] + (cells + 1) * (corner[1] + (cells + 1) * corner[2])
}

fn corner_offsets(cells: usize) -> [usize; 8] {
    std::array::from_fn(|corner| corner_index([corner & 1, corner >> 1 & 1, corner >> 2], cells))
}

fn pulls(samples: &Samples, depth: u32, screening: &ScreeningWeights<'_>) -> Vec<Pull> {
    let cells = 1_usize << depth;
    let shift = 3 * (samples.depth - depth);
    let mut pulls = Vec::new();
    let mut begin = 0;
    while begin < samples.len() {
        let code = samples.codes[begin] >> shift;
        let (cell, _) = samples.cell(begin, depth);
        let mut sum = [0.0_f32; 4];
        let mut end = begin;
        while end < samples.len() && samples.codes[end] >> shift == code {
            let (_, inside) = samples.cell(end, depth);
            let weight = screening.pull(end, depth);
            for axis in 0..3 {
                sum[axis] += weight * inside[axis];
            }
            sum[3] += weight;
            end += 1;
        }
        if sum[3] > 0.0 {
            pulls.push(Pull {
                corner: corner_index(cell.map(|x| x as usize), cells),
                shape: trilinear([0, 1, 2].map(|axis| (sum[axis] / sum[3]).clamp(0.0, 1.0))),
                weight: sum[3],
            });
        }
        begin = end;
    }
    pulls
}

/// Stiffness and screening times `u`, element by element. Row i of an element is
/// (4 uᵢ − the three across faces − the one across the cell) / 12.
fn apply(u: &[f32], cells: usize, pulls: &[Pull]) -> Vec<f32> {
    let offsets = corner_offsets(cells);
    let mut out = vec![0.0; u.len()];
    for z in 0..cells {
        for y in 0..cells {
            for x in 0..cells {
                let corner = corner_index([x, y, z], cells);
                let local = offsets.map(|offset| u[corner + offset]);
                let sum: f32 = local.iter().sum();
                for (i, offset) in offsets.iter().enumerate() {
                    let axes = local[i ^ 1] + local[i ^ 2] + local[i ^ 4];
                    out[corner + offset] += (5.0 * local[i] + axes - sum) / 12.0;
                }
            }
        }
    }
    for pull in pulls {
        let value: f32 = (0..8)
            .map(|i| pull.shape[i] * u[pull.corner + offsets[i]])
            .sum();
        for i in 0..8 {
            out[pull.corner + offsets[i]] += pull.weight * value * pull.shape[i];
        }
    }
    out
}

/// ∫∇φᵢ·V, element by element.
fn divergence(field: &[[f32; 3]], cells: usize) -> Vec<f32> {
    let offsets = corner_offsets(cells);
    let mut out = vec![0.0; field.len()];
    for z in 0..cells {
        for y in 0..cells {
            for x in 0..cells {
                let corner = corner_index([x, y, z], cells);
                let local = offsets.map(|offset| field[corner + offset]);
                if local.iter().all(|v| *v == [0.0; 3]) {
                    continue;
                }
                for (i, offset) in offsets.iter().enumerate() {
                    out[corner + offset] += element_divergence(&local, i);
                }
            }
        }
    }
    out
}

/// ∫∇φᵢ·V over one unit cell: along the axis ±1/2 for either end, across it the mass 1/3 or 1/6.
fn element_divergence(field: &[[f32; 3]; 8], i: usize) -> f32 {
    let mut sum = 0.0;
    for (j, v) in field.iter().enumerate() {
        let mass = |axis: usize| {
            if (i ^ j) >> axis & 1 == 0 {
                1.0 / 3.0
            } else {
                1.0 / 6.0
            }
        };
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
