//! A polar grid about the sensor and an image of directions: where a scan's points are looked
//! up by place and by neighbourhood, for any number of beams.

use std::f32::consts::{FRAC_PI_2, PI, TAU};
use std::num::NonZeroU32;

use glam::Vec3;

/// Sectors of the polar grid over 360 degrees.
pub(super) const SECTORS: usize = 180;
/// Width of the rings near the sensor [m].
const RING_M: f32 = 0.5;
/// Where rings begin to widen [m].
const WIDENING_FROM_M: f32 = 10.0;
/// How much wider than its distance from the sensor a far ring is, unitless.
const WIDENING: f32 = 0.05;
/// Points farther than this belong to no ring [m].
const REACH_M: f32 = 120.0;
/// Steps of the table from distance to ring per metre.
const STEPS_PER_M: f32 = 8.0;

/// Rings that widen with distance, cut into sectors.
#[derive(Clone, Debug)]
pub(super) struct PolarGrid {
    /// Inner radii of the rings, and the outer radius of the last [m].
    pub(super) edges_m: Vec<f32>,
    /// Position in units of rings by distance: 2.5 is the middle of ring 2.
    position: Vec<f32>,
}

impl PolarGrid {
    pub(super) fn new() -> Self {
        let mut edges_m = vec![0.0];
        let mut edge = 0.0;
        while edge < REACH_M {
            edge += RING_M.max(WIDENING * edge * RING_M / (WIDENING * WIDENING_FROM_M));
            edges_m.push(edge);
        }
        let mut ring = 0;
        let position = (0..=(REACH_M * STEPS_PER_M) as usize + 1)
            .map(|step| {
                let distance = step as f32 / STEPS_PER_M;
                while ring + 2 < edges_m.len() && edges_m[ring + 1] <= distance {
                    ring += 1;
                }
                ring as f32 + (distance - edges_m[ring]) / (edges_m[ring + 1] - edges_m[ring])
            })
            .collect();
        Self { edges_m, position }
    }

    pub(super) fn rings(&self) -> usize {
        self.edges_m.len() - 1
    }

    pub(super) fn len(&self) -> usize {
        self.rings() * SECTORS
    }

    /// Distance of the middle of a ring [m].
    pub(super) fn middle_m(&self, ring: usize) -> f32 {
        0.5 * (self.edges_m[ring] + self.edges_m[ring + 1])
    }

    /// Width of a ring [m].
    pub(super) fn width_m(&self, ring: usize) -> f32 {
        self.edges_m[ring + 1] - self.edges_m[ring]
    }

    /// Position in rings and sectors, both with fraction; `None` beyond the last ring.
    #[inline]
    pub(super) fn locate(&self, distance_m: f32, azimuth_rad: f32) -> Option<(f32, f32)> {
        if distance_m >= REACH_M {
            return None;
        }
        let step = distance_m * STEPS_PER_M;
        let below = step as usize;
        let (a, b) = (self.position[below], self.position[below + 1]);
        let ring = a + (b - a) * (step - below as f32);
        let sector = (azimuth_rad + PI) * (SECTORS as f32 / TAU);
        Some((ring, sector))
    }

    /// Index of a position from [`locate`](Self::locate).
    #[inline]
    pub(super) fn index(ring: f32, sector: f32) -> usize {
        ring as usize * SECTORS + (sector as usize).min(SECTORS - 1)
    }
}

/// A point with its place in the polar grid.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placed {
    /// Position in rings, with fraction; negative for a point that has no place.
    pub(super) ring: f32,
    /// Position in sectors, with fraction.
    pub(super) sector: f32,
    /// Height in the lidar frame [m].
    pub(super) z: f32,
    /// Index of its cell; `u32::MAX` for a point that has no place.
    pub(super) cell: u32,
}

impl Placed {
    /// Of a point without a place.
    pub(super) const NOWHERE: Self = Self {
        ring: -1.0,
        sector: 0.0,
        z: f32::NAN,
        cell: u32::MAX,
    };

    #[inline]
    pub(super) fn new(ring: f32, sector: f32, z: f32) -> Self {
        let cell = PolarGrid::index(ring, sector) as u32;
        Self {
            ring,
            sector,
            z,
            cell,
        }
    }

    #[inline]
    pub(super) fn is_somewhere(&self) -> bool {
        self.cell != u32::MAX
    }
}

/// `atan2` to 2e-4 rad, which is enough to choose a cell; several times faster than the exact one.
#[inline]
pub(super) fn coarse_atan2(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    // Selected, not branched on, so that loops over it are vectorized.
    let (small, large) = if ay < ax { (ay, ax) } else { (ax, ay) };
    let large = if large > f32::MIN_POSITIVE {
        large
    } else {
        f32::MIN_POSITIVE
    };
    let t = small / large;
    let s = t * t;
    let octant = t * (0.999_787_8 + s * (-0.325_808_4 + s * (0.155_557_6 - s * 0.044_326_12)));
    let quadrant = if ay < ax { octant } else { FRAC_PI_2 - octant };
    let half = if x < 0.0 { PI - quadrant } else { quadrant };
    half.copysign(y)
}

/// The nearest return of every direction, on a grid that is uniform in azimuth and in the
/// tangent of elevation: finer than any sensor's rings, so that it needs to know none.
#[derive(Clone, Debug)]
pub(super) struct DirectionImage {
    /// One more than the index of a return, 0 where nothing was seen. Column by column, because
    /// neighbours are mostly looked for up and down, with empty rows below each column.
    cells: Vec<u32>,
    /// Returns in the order of their cells: neighbours in the image are neighbours in memory.
    returns: Vec<Return>,
}

/// The nearest return of a direction.
#[derive(Clone, Copy, Debug)]
pub(super) struct Return {
    /// Lidar frame [m].
    pub(super) point: Vec3,
    /// From the sensor's axis [m].
    pub(super) distance_m: f32,
    /// Number of the point in the scan.
    pub(super) number: u32,
    cell: u32,
}

impl DirectionImage {
    /// Columns over 360 degrees.
    pub(super) const COLUMNS: usize = 1024;
    /// Width of a column [rad].
    pub(super) const COLUMN_RAD: f32 = TAU / Self::COLUMNS as f32;
    /// How many rows up and down a neighbour is looked for.
    const MAX_ROWS: usize = 8;
    /// Rows, counted upwards.
    const ROWS: usize = 208;
    /// Cells per column; the empty ones keep columns apart.
    const STRIDE: usize = Self::MAX_ROWS + Self::ROWS;
    const TAN_BOTTOM: f32 = -1.0;
    const ROWS_PER_TAN: f32 = 1.0 / 0.007;

    /// Of points that have a cell each, `None` for those that have none.
    pub(super) fn new(points: &[Vec3], cells_of_points: &[Option<Cell>]) -> Self {
        // First the number of the point that holds a cell, then that of its return.
        let mut cells = vec![0; Self::COLUMNS * Self::STRIDE + 1];
        let squared_distance = |number: usize| points[number].truncate().length_squared();
        let mut count = 0;
        for (number, cell) in cells_of_points.iter().enumerate() {
            let Some(cell) = cell else { continue };
            let holder: &mut u32 = &mut cells[cell.index()];
            if *holder == 0 {
                count += 1;
                *holder = number as u32 + 1;
            } else if squared_distance(number) < squared_distance(*holder as usize - 1) {
                *holder = number as u32 + 1;
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

    /// The index of the return that holds a cell.
    #[inline]
    pub(super) fn holder(&self, cell: Cell) -> Option<usize> {
        (self.cells[cell.index()] as usize).checked_sub(1)
    }

    /// The returns over a return, nearest first.
    #[inline]
    pub(super) fn above(&self, index: usize) -> impl Iterator<Item = &Return> {
        let end = self.returns[index].cell + Self::MAX_ROWS as u32;
        let above = self.returns[index + 1..].iter();
        above.take_while(move |other| other.cell <= end)
    }

    /// The returns under a return, nearest first.
    #[inline]
    pub(super) fn below(&self, index: usize) -> impl Iterator<Item = &Return> {
        let end = self.returns[index].cell - Self::MAX_ROWS as u32;
        let below = self.returns[..index].iter().rev();
        below.take_while(move |other| other.cell >= end)
    }

    /// What is `left` columns beside a return, in its row or the next up or down.
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

/// A cell of a [`DirectionImage`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Cell(NonZeroU32);

impl Cell {
    /// The cell of a direction; `None` where it is steeper than any ground is seen at.
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
