//! Symmetric linear systems of 6 x 6 blocks, one row per pose.
//!
//! Conjugate gradients, preconditioned by the factorization of the diagonal and the neighbouring blocks: the
//! system of a drive without loops is solved in one iteration, each loop adds a few.
//!
//! Nocedal and Wright, *Numerical Optimization* (2006), algorithm 5.3.

use nalgebra::{Cholesky, Const, Matrix6, Vector6};
use rayon::prelude::*;

/// A symmetric, positive definite system of equations.
#[derive(Clone, Debug)]
pub struct BlockSystem {
    /// Blocks on the diagonal.
    diagonal: Vec<Matrix6<f64>>,
    /// Off-diagonal blocks by row: column and block, in the order of the columns; both halves are stored.
    off_diagonal: Vec<Vec<(usize, Matrix6<f64>)>>,
    /// Right side.
    right_side: Vec<Vector6<f64>>,
}

impl BlockSystem {
    /// A system of zeros.
    pub fn new(rows: usize) -> Self {
        Self {
            diagonal: vec![Matrix6::zeros(); rows],
            off_diagonal: vec![Vec::new(); rows],
            right_side: vec![Vector6::zeros(); rows],
        }
    }

    /// Adds to a row of the right side and to the block on the diagonal.
    pub fn add(&mut self, row: usize, block: &Matrix6<f64>, right_side: &Vector6<f64>) {
        self.diagonal[row] += block;
        self.right_side[row] += right_side;
    }

    /// Adds to an off-diagonal block and to its mirror image.
    pub fn add_off_diagonal(&mut self, row: usize, column: usize, block: &Matrix6<f64>) {
        self.add_half(row, column, block);
        self.add_half(column, row, &block.transpose());
    }

    fn add_half(&mut self, row: usize, column: usize, block: &Matrix6<f64>) {
        let blocks = &mut self.off_diagonal[row];
        match blocks.binary_search_by_key(&column, |entry| entry.0) {
            Ok(found) => blocks[found].1 += block,
            Err(place) => blocks.insert(place, (column, *block)),
        }
    }

    /// Adds rows that were summed elsewhere, each with the blocks right of the diagonal.
    pub fn add_rows(&mut self, rows: Vec<BlockRow>) {
        for (row, sums) in rows.into_iter().enumerate() {
            self.add(row, &sums.diagonal, &sums.right_side);
            for (column, block) in &sums.off_diagonal {
                self.add_off_diagonal(row, *column, block);
            }
        }
    }

    /// The solution; `None` if the system is not positive definite.
    pub fn solve(&self) -> Option<Vec<Vector6<f64>>> {
        self.solve_for(&self.right_side)
    }

    /// The solution for another right side; `None` if the system is not positive definite.
    pub fn solve_for(&self, right_side: &[Vector6<f64>]) -> Option<Vec<Vector6<f64>>> {
        /// Residual relative to the right side.
        const TOLERANCE: f64 = 1e-4;
        const MAX_ITERATIONS: usize = 300;
        let factors = self.factorize()?;
        let mut solution = vec![Vector6::zeros(); self.diagonal.len()];
        let mut residual = right_side.to_vec();
        let limit = TOLERANCE * TOLERANCE * dot(&residual, &residual);
        let mut preconditioned = factors.solve(&residual);
        let mut direction = preconditioned.clone();
        let mut product = dot(&residual, &preconditioned);
        for _ in 0..MAX_ITERATIONS {
            if dot(&residual, &residual) <= limit {
                break;
            }
            let image = self.times(&direction);
            let curvature = dot(&direction, &image);
            if curvature.is_nan() || curvature <= 0.0 {
                return None;
            }
            let length = product / curvature;
            add_scaled(&mut solution, length, &direction);
            add_scaled(&mut residual, -length, &image);
            preconditioned = factors.solve(&residual);
            let next = dot(&residual, &preconditioned);
            let keep = next / product;
            product = next;
            for (direction, new) in direction.iter_mut().zip(&preconditioned) {
                *direction = new + *direction * keep;
            }
        }
        (solution
            .iter()
            .all(|row| row.iter().all(|value| value.is_finite())))
        .then_some(solution)
    }

    /// Log-determinant of a block tridiagonal system, without other off-diagonal blocks; `None` if it is not positive definite.
    pub fn log_determinant(&self) -> Option<f64> {
        let factors = self.factorize()?.0;
        let of_row = |factor: &Factor| 2.0 * factor.own.l_dirty().diagonal().map(f64::ln).sum();
        Some(factors.iter().map(of_row).sum())
    }

    fn times(&self, vector: &[Vector6<f64>]) -> Vec<Vector6<f64>> {
        (0..self.diagonal.len())
            .into_par_iter()
            .map(|row| {
                let mut sum = self.diagonal[row] * vector[row];
                for (column, block) in &self.off_diagonal[row] {
                    sum += block * vector[*column];
                }
                sum
            })
            .collect()
    }

    fn next_to_diagonal(&self, row: usize) -> Option<&Matrix6<f64>> {
        let blocks = &self.off_diagonal[row];
        let found = blocks.binary_search_by_key(&(row + 1), |entry| entry.0);
        found.ok().map(|index| &blocks[index].1)
    }

    /// Factorizes the tridiagonal part; a row whose remainder is not positive definite starts anew.
    fn factorize(&self) -> Option<Factors> {
        let mut factors: Vec<Factor> = Vec::with_capacity(self.diagonal.len());
        for row in 0..self.diagonal.len() {
            let alone = self.diagonal[row];
            let joined = row.checked_sub(1).and_then(|before| {
                let next = *self.next_to_diagonal(before)?;
                let below = factors[before].own.solve(&next).transpose();
                let own = (alone - below * next).cholesky()?;
                Some(Factor { own, below })
            });
            factors.push(match joined {
                Some(factor) => factor,
                None => Factor {
                    own: alone.cholesky()?,
                    below: Matrix6::zeros(),
                },
            });
        }
        Some(Factors(factors))
    }
}

/// Sums of a row of a system.
#[derive(Clone, Debug, Default)]
pub struct BlockRow {
    /// Block on the diagonal.
    pub diagonal: Matrix6<f64>,
    /// Columns right of it, and their blocks.
    pub off_diagonal: Vec<(usize, Matrix6<f64>)>,
    /// Right side.
    pub right_side: Vector6<f64>,
}

/// A row of the factorization L D Lᵀ.
struct Factor {
    /// Block of D.
    own: Cholesky<f64, Const<6>>,
    /// Block of L left of the diagonal.
    below: Matrix6<f64>,
}

struct Factors(Vec<Factor>);

impl Factors {
    fn solve(&self, right_side: &[Vector6<f64>]) -> Vec<Vector6<f64>> {
        let mut solution = right_side.to_vec();
        for row in 1..solution.len() {
            let before = solution[row - 1];
            solution[row] -= self.0[row].below * before;
        }
        for row in (0..solution.len()).rev() {
            let mut value = self.0[row].own.solve(&solution[row]);
            if let Some(next) = self.0.get(row + 1) {
                value -= next.below.transpose() * solution[row + 1];
            }
            solution[row] = value;
        }
        solution
    }
}

fn dot(a: &[Vector6<f64>], b: &[Vector6<f64>]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a.dot(b)).sum()
}

fn add_scaled(sum: &mut [Vector6<f64>], factor: f64, vector: &[Vector6<f64>]) {
    for (sum, value) in sum.iter_mut().zip(vector) {
        *sum += value * factor;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block(seed: usize) -> Matrix6<f64> {
        Matrix6::from_fn(|i, j| ((seed * 36 + i * 6 + j) as f64 * 0.7).sin())
    }

    #[test]
    fn the_solution_solves_a_chain_with_loops() {
        const ROWS: usize = 40;
        let mut system = BlockSystem::new(ROWS);
        let edges = (1..ROWS).map(|row| (row - 1, row));
        for (number, (a, b)) in edges.chain([(3, 37), (0, 20)]).enumerate() {
            let jacobians = [block(number), block(number + 100)];
            let residual = Vector6::from_fn(|i, _| (number * 6 + i) as f64);
            let [of_a, of_b] = jacobians;
            system.add(
                a,
                &(of_a.transpose() * of_a),
                &(of_a.transpose() * residual),
            );
            system.add(
                b,
                &(of_b.transpose() * of_b),
                &(of_b.transpose() * residual),
            );
            system.add_off_diagonal(a, b, &(of_a.transpose() * of_b));
        }
        for row in 0..ROWS {
            system.add(row, &(Matrix6::identity() * 0.1), &Vector6::zeros());
        }
        let solution = system.solve().unwrap();
        let image = system.times(&solution);
        let differences = image.iter().zip(&system.right_side).map(|(a, b)| a - b);
        let differences: Vec<Vector6<f64>> = differences.collect();
        let all = dot(&system.right_side, &system.right_side).sqrt();
        assert!(dot(&differences, &differences).sqrt() < 1e-3 * all);
    }

    #[test]
    fn the_determinant_of_a_chain_is_that_of_its_matrix() {
        let mut system = BlockSystem::new(3);
        let mut matrix = nalgebra::DMatrix::zeros(18, 18);
        for row in 0..3 {
            let own = block(row) * block(row).transpose() + Matrix6::identity() * 4.0;
            system.add(row, &own, &Vector6::zeros());
            matrix.view_mut((6 * row, 6 * row), (6, 6)).copy_from(&own);
        }
        for row in 0..2 {
            let next = block(row + 10) * 0.3;
            system.add_off_diagonal(row, row + 1, &next);
            let (here, there) = (6 * row, 6 * row + 6);
            matrix.view_mut((here, there), (6, 6)).copy_from(&next);
            (matrix.view_mut((there, here), (6, 6))).copy_from(&next.transpose());
        }
        let expected = matrix.determinant().ln();
        assert!((system.log_determinant().unwrap() - expected).abs() < 1e-9 * expected.abs());
    }

    #[test]
    fn a_system_that_is_not_positive_definite_has_no_solution() {
        let mut system = BlockSystem::new(2);
        system.add(0, &Matrix6::identity(), &Vector6::zeros());
        assert!(system.solve().is_none());
    }
}
