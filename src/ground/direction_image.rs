//! An image of the nearest return in every direction, in which the neighbours of a point are found
//! for any number of beams.

use std::f32::consts::{PI, TAU};
use std::num::NonZeroU32;

use glam::Vec3;

/// The nearest return of every direction, on a grid that is uniform in azimuth and in the tangent
/// of elevation: finer than the beams of any sensor, so that these need not be known.
#[derive(Clone, Debug)]
pub(super) struct DirectionImage {
    /// One more than the index of a return, 0 where there is none. Column by column, because
    /// neighbours are mostly searched vertically, with empty rows below each column.
    cells: Vec<u32>,
    /// Returns in the order of their cells: neighbours in the image are neighbours in memory.
    returns: Vec<Return>,
}

/// The nearest return of a direction.
#[derive(Clone, Copy, Debug)]
pub(super) struct Return {
    /// Lidar frame [m].
    pub(super) point: Vec3,
    /// Distance from the sensor's axis [m].
    pub(super) distance_m: f32,
    /// Index of the point in the scan.
    pub(super) number: u32,
    cell: u32,
}

/// A cell of a [`DirectionImage`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Cell(NonZeroU32);

impl Cell {
    /// Returns the cell of a direction; `None` outside the elevations at which ground is visible.
    #[inline]
    pub(super) fn of(z: f32, distance_m: f32, azimuth_rad: f32) -> Option<Self> {
        type Image = DirectionImage;
        let row = (z / distance_m - Image::TAN_BOTTOM) * Image::ROWS_PER_TAN;
        if !(row >= 0.0 && row < Image::ROWS as f32) {
            return None;
        }
        let column = ((azimuth_rad + PI) / Image::COLUMN_RAD) as usize;
        let first = column.min(Image::COLUMNS - 1) * Image::STRIDE + Image::MAX_ROWS;
        NonZeroU32::new((first + row as usize) as u32).map(Self)
    }

    #[inline]
    fn index(self) -> usize {
        self.0.get() as usize
    }
}

impl DirectionImage {
    /// Columns over 360 degrees.
    const COLUMNS: usize = 1024;
    /// Width of a column [rad].
    pub(super) const COLUMN_RAD: f32 = TAU / Self::COLUMNS as f32;
    /// Rows up and down that are searched for a neighbour.
    const MAX_ROWS: usize = 8;
    /// Rows, counted upwards.
    const ROWS: usize = 208;
    /// Cells per column; the empty ones separate columns.
    const STRIDE: usize = Self::MAX_ROWS + Self::ROWS;
    const TAN_BOTTOM: f32 = -1.0;
    const ROWS_PER_TAN: f32 = 1.0 / 0.007;

    /// Builds the image of points with their cells, if they have one.
    pub(super) fn new(points: &[Vec3], cells_of_points: &[Option<Cell>]) -> Self {
        // First one more than the index of the nearest point of a cell, then that of its return.
        let mut cells = vec![0; Self::COLUMNS * Self::STRIDE + 1];
        let squared_distance = |number: usize| points[number].truncate().length_squared();
        let mut count = 0;
        for (number, cell) in cells_of_points.iter().enumerate() {
            let Some(cell) = cell else { continue };
            let nearest: &mut u32 = &mut cells[cell.index()];
            if *nearest == 0 {
                count += 1;
                *nearest = number as u32 + 1;
            } else if squared_distance(number) < squared_distance(*nearest as usize - 1) {
                *nearest = number as u32 + 1;
            }
        }
        let mut returns = Vec::with_capacity(count);
        for (index, cell) in cells.iter_mut().enumerate() {
            if *cell != 0 {
                let number = *cell - 1;
                let point = points[number as usize];
                returns.push(Return {
                    point,
                    distance_m: point.truncate().length(),
                    number,
                    cell: index as u32,
                });
                *cell = returns.len() as u32;
            }
        }
        Self { cells, returns }
    }

    /// All returns, column by column, upwards.
    pub(super) fn returns(&self) -> &[Return] {
        &self.returns
    }

    /// Index of the return of a cell.
    #[inline]
    pub(super) fn return_of(&self, cell: Cell) -> Option<usize> {
        (self.cells[cell.index()] as usize).checked_sub(1)
    }

    /// The returns above a return, nearest first.
    #[inline]
    pub(super) fn above(&self, index: usize) -> impl Iterator<Item = &Return> {
        let end = self.returns[index].cell + Self::MAX_ROWS as u32;
        let above = self.returns[index + 1..].iter();
        above.take_while(move |other| other.cell <= end)
    }

    /// The returns below a return, nearest first.
    #[inline]
    pub(super) fn below(&self, index: usize) -> impl Iterator<Item = &Return> {
        let end = self.returns[index].cell - Self::MAX_ROWS as u32;
        let below = self.returns[..index].iter().rev();
        below.take_while(move |other| other.cell >= end)
    }

    /// The returns `left` columns beside a return, in its row, the next above and the next below.
    #[inline]
    pub(super) fn beside(&self, index: usize, left: isize) -> impl Iterator<Item = &Return> {
        let cell = self.returns[index].cell as usize;
        let (column, row) = (cell / Self::STRIDE, cell % Self::STRIDE);
        let column = (column as isize + left) as usize % Self::COLUMNS;
        let cell = column * Self::STRIDE + row;
        [cell, cell + 1, cell - 1]
            .into_iter()
            .filter_map(|cell| Some(&self.returns[(self.cells[cell] as usize).checked_sub(1)?]))
    }
}
