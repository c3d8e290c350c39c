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

    /// Center of a cell.
    pub fn center(&self, column: usize, row: usize) -> Point2<f64> {
        Point2::new(
            self.origin.x + (column as f64 + 0.5) * self.cell_m,
            self.origin.y + (row as f64 + 0.5) * self.cell_m,
        )
    }
}
