//! Regular grids over the x-y plane.

use nalgebra::Point2;

/// Square cells over a rectangle of the x-y plane, row-major with x fastest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Grid2 {
    /// Lower corner of cell (0, 0) [m].
    pub origin: Point2<f64>,
    /// Edge length of a cell [m].
    pub cell_m: f64,
    /// Number of cells along x.
    pub columns: usize,
    /// Number of cells along y.
    pub rows: usize,
}

impl Grid2 {
    /// The grid that covers a rectangle with at least one cell.
    pub fn covering(min: Point2<f64>, max: Point2<f64>, cell_m: f64) -> Self {
        let cells = |extent_m: f64| ((extent_m / cell_m).ceil() as usize).max(1);
        Self {
            origin: min,
            cell_m,
            columns: cells(max.x - min.x),
            rows: cells(max.y - min.y),
        }
    }

    /// Number of cells.
    pub fn len(&self) -> usize {
        self.columns * self.rows
    }

    /// Whether there are no cells.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Column and row of a position; `None` outside.
    pub fn cell_at(&self, x: f64, y: f64) -> Option<(usize, usize)> {
        let column = ((x - self.origin.x) / self.cell_m).floor();
        let row = ((y - self.origin.y) / self.cell_m).floor();
        let inside =
            column >= 0.0 && row >= 0.0 && column < self.columns as f64 && row < self.rows as f64;
        inside.then_some((column as usize, row as usize))
    }

    /// Center of a cell.
    pub fn center(&self, column: usize, row: usize) -> Point2<f64> {
        Point2::new(
            self.origin.x + (column as f64 + 0.5) * self.cell_m,
            self.origin.y + (row as f64 + 0.5) * self.cell_m,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_cell_contains_its_center() {
        let grid = Grid2::covering(Point2::new(-3.0, 2.0), Point2::new(4.1, 5.0), 0.5);
        for row in 0..grid.rows {
            for column in 0..grid.columns {
                let center = grid.center(column, row);
                assert_eq!(grid.cell_at(center.x, center.y), Some((column, row)));
            }
        }
    }

    #[test]
    fn positions_outside_have_no_cell() {
        let grid = Grid2::covering(Point2::origin(), Point2::new(1.0, 1.0), 0.5);
        for (x, y) in [
            (-0.01, 0.5),
            (0.5, -0.01),
            (1.01, 0.5),
            (0.5, 1.01),
            (f64::NAN, 0.0),
        ] {
            assert_eq!(grid.cell_at(x, y), None, "{x} {y}");
        }
    }
}
