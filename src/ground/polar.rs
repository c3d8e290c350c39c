//! A polar grid about the sensor and an image of directions: where a scan's points are looked
//! up by place and by neighbourhood, for any number of beams.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

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

/// `atan2` to 2e-4 rad, which is enough to choose a cell; several times faster than the exact one.
#[inline]
pub(super) fn coarse_atan2(y: f32, x: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = if ay < ax { (ay, ax) } else { (ax, ay) };
    let t = small / large.max(f32::MIN_POSITIVE);
    let s = t * t;
    let octant = t * (0.999_787_8 + s * (-0.325_808_4 + s * (0.155_557_6 - s * 0.044_326_12)));
    let quadrant = if ay < ax { octant } else { FRAC_PI_2 - octant };
    let half = if x < 0.0 { PI - quadrant } else { quadrant };
    if y < 0.0 { -half } else { half }
}

/// The nearest return of every direction, on a grid that is uniform in azimuth and in the
/// tangent of elevation: finer than any sensor's rings, so that it needs to know none.
#[derive(Clone, Debug)]
pub(super) struct DirectionImage {
    /// One more than the number of the nearest point, 0 where nothing was seen. Column by
    /// column, because neighbours are mostly looked for up and down.
    cells: Vec<u32>,
}

impl DirectionImage {
    /// Columns over 360 degrees.
    pub(super) const COLUMNS: usize = 1024;
    /// Width of a column [rad].
    pub(super) const COLUMN_RAD: f32 = TAU / Self::COLUMNS as f32;
    /// Rows, counted upwards.
    const ROWS: usize = 208;
    const TAN_BOTTOM: f32 = -1.0;
    const ROWS_PER_TAN: f32 = 1.0 / 0.007;

    pub(super) fn new() -> Self {
        Self {
            cells: vec![0; Self::ROWS * Self::COLUMNS],
        }
    }

    /// The cell of a direction; `None` where it is steeper than any ground is seen at.
    #[inline]
    pub(super) fn index(z: f32, distance_m: f32, azimuth_rad: f32) -> Option<usize> {
        let row = (z / distance_m - Self::TAN_BOTTOM) * Self::ROWS_PER_TAN;
        if !(row >= 0.0 && row < Self::ROWS as f32) {
            return None;
        }
        let column = ((azimuth_rad + PI) / Self::COLUMN_RAD) as usize;
        Some(column.min(Self::COLUMNS - 1) * Self::ROWS + row as usize)
    }

    /// Enters `points[number]`, unless a nearer point is there.
    #[inline]
    pub(super) fn insert(&mut self, index: usize, points: &[Vec3], number: usize) {
        let holder = &mut self.cells[index];
        let distance = |number: usize| points[number].truncate().length_squared();
        if *holder == 0 || distance(number) < distance(*holder as usize - 1) {
            *holder = number as u32 + 1;
        }
    }

    /// The number of the point that holds a cell.
    #[inline]
    pub(super) fn holder(&self, index: usize) -> Option<usize> {
        (self.cells[index] as usize).checked_sub(1)
    }

    /// The cells of a column in which something was seen, with the number of the point.
    pub(super) fn holders(&self, column: usize) -> impl Iterator<Item = (usize, usize)> {
        let cells = column * Self::ROWS..(column + 1) * Self::ROWS;
        cells.filter_map(|index| Some((index, self.holder(index)?)))
    }

    /// The cells over and under one, nearest first: at most `most` of each.
    #[inline]
    pub(super) fn above_and_below(&self, index: usize, most: usize) -> (&[u32], &[u32]) {
        let row = index % Self::ROWS;
        let above = most.min(Self::ROWS - 1 - row);
        let below = most.min(row);
        (
            &self.cells[index + 1..=index + above],
            &self.cells[index - below..index],
        )
    }

    /// The number of the return `left` columns beside a cell, in its row or the next up or down.
    #[inline]
    pub(super) fn beside(&self, index: usize, left: isize) -> [u32; 3] {
        let (column, row) = (index / Self::ROWS, index % Self::ROWS);
        let column = (column as isize + left) as usize % Self::COLUMNS;
        let first = column * Self::ROWS;
        let at = |row: usize| self.cells[first + row];
        [
            at(row),
            at((row + 1).min(Self::ROWS - 1)),
            at(row.saturating_sub(1)),
        ]
    }
}
