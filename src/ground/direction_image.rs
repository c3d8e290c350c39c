//! An image of the nearest return in every direction, in which the neighbours of a point are found
//! for any number of beams.

use std::f32::consts::{PI, TAU};
use std::num::NonZeroU32;

use glam::Vec3;

/// The nearest return of every direction, on a grid that is uniform in azimuth and in the tangent
/// of elevation: finer than the beams of any sensor, so that these need not be known.
#[derive(Clone, Debug)]
pub(super) struct DirectionImage {
    /// Ranks of the returns in their columns, from 1; 0 where there is none. Column by column,
    /// because neighbours are mostly searched vertically, with empty rows below each column.
    ranks: Vec<u8>,
    /// Number of returns in the columns before each column.
    starts: Vec<u32>,
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
    cell: u32,
}

/// A cell of a [`DirectionImage`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct DirectionCell(NonZeroU32);

impl DirectionCell {
    /// Returns the cell of a direction; `None` outside the elevations at which ground is visible.
    #[inline(always)]
    pub(super) fn new(z: f32, distance_m: f32, azimuth_rad: f32) -> Option<Self> {
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
    pub(super) fn new(points: &[Vec3], cells: &[Option<DirectionCell>]) -> Self {
        let mut ranks = vec![0; Self::COLUMNS * Self::STRIDE + 1];
        for cell in cells.iter().flatten() {
            ranks[cell.index()] = 1;
        }
        let mut count = 0;
        let mut rank_column = |column: &mut [u8]| {
            let start = count as u32;
            let mut rank = 0;
            // Without branches, which would be mispredicted.
            for cell in column {
                rank += *cell;
                *cell *= rank;
            }
            count += usize::from(rank);
            start
        };
        let columns = ranks.chunks_exact_mut(Self::STRIDE);
        let starts = columns.map(&mut rank_column).collect();
        let mut image = Self {
            ranks,
            starts,
            returns: Vec::new(),
        };

        const NONE: u32 = u32::MAX;
        let squared_distance = |number: u32| points[number as usize].truncate().length_squared();
        let mut nearest = vec![NONE; count];
        for (number, cell) in (0_u32..).zip(cells) {
            let Some(index) = cell.and_then(|cell| image.return_of(cell)) else {
                continue;
            };
            let nearest = &mut nearest[index];
            if *nearest == NONE || squared_distance(number) < squared_distance(*nearest) {
                *nearest = number;
            }
        }
        let to_return = |number: u32| {
            let point = points[number as usize];
            Some(Return {
                point,
                distance_m: point.truncate().length(),
                cell: cells[number as usize]?.index() as u32,
            })
        };
        image.returns = nearest.into_iter().filter_map(to_return).collect();
        image
    }

    /// All returns, column by column, upwards.
    pub(super) fn returns(&self) -> &[Return] {
        &self.returns
    }

    /// Index of the return of a cell.
    #[inline]
    pub(super) fn return_of(&self, cell: DirectionCell) -> Option<usize> {
        self.index_at(cell.index())
    }

    #[inline]
    fn index_at(&self, cell: usize) -> Option<usize> {
        let rank = usize::from(self.ranks[cell]).checked_sub(1)?;
        Some(self.starts[cell / Self::STRIDE] as usize + rank)
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

    /// The returns `left` columns next to a return, in its row, the next above and the next below.
    #[inline]
    pub(super) fn neighbours(&self, index: usize, left: isize) -> impl Iterator<Item = &Return> {
        let cell = self.returns[index].cell as usize;
        let (column, row) = (cell / Self::STRIDE, cell % Self::STRIDE);
        let column = (column as isize + left) as usize % Self::COLUMNS;
        let cell = column * Self::STRIDE + row;
        [cell, cell + 1, cell - 1]
            .into_iter()
            .filter_map(|cell| Some(&self.returns[self.index_at(cell)?]))
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn the_return_of_every_cell_is_its_nearest_point() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let points: Vec<Vec3> = (0..50_000)
            .map(|_| Vec3::from_array([15.0, 15.0, 3.0].map(|far| rng.random_range(-far..far))))
            .collect();
        let cell = |point: &Vec3| {
            DirectionCell::new(point.z, point.truncate().length(), point.y.atan2(point.x))
        };
        let cells: Vec<Option<DirectionCell>> = points.iter().map(cell).collect();
        let image = DirectionImage::new(&points, &cells);
        assert!(image.returns.is_sorted_by_key(|seen| seen.cell));
        let mut is_reached = vec![false; image.returns.len()];
        for (point, cell) in points.iter().zip(&cells) {
            let Some(cell) = *cell else { continue };
            let index = image.return_of(cell).unwrap();
            assert_eq!(image.returns[index].cell as usize, cell.index());
            assert!(image.returns[index].distance_m <= point.truncate().length());
            is_reached[index] |= image.returns[index].point == *point;
        }
        assert!(is_reached.iter().all(|&is_reached| is_reached));
    }
}
