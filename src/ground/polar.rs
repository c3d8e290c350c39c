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
    /// Points and their horizontal distances, row-major; the distance is infinite where nothing was seen.
    cells: Vec<(Vec3, f32)>,
}

impl DirectionImage {
    pub(super) const COLUMNS: usize = 1024;
    /// Width of a column [rad].
    pub(super) const COLUMN_RAD: f32 = TAU / Self::COLUMNS as f32;
    const TAN_BOTTOM: f32 = -1.0;
    const TAN_TOP: f32 = 0.45;
    const ROWS_PER_TAN: f32 = 1.0 / 0.007;
    pub(super) const ROWS: usize =
        ((Self::TAN_TOP - Self::TAN_BOTTOM) * Self::ROWS_PER_TAN) as usize;

    pub(super) fn new() -> Self {
        Self {
            cells: vec![(Vec3::ZERO, f32::INFINITY); Self::ROWS * Self::COLUMNS],
        }
    }

    /// The cell of a direction; `None` where it is steeper than any ground is seen at.
    /// Rows count upwards.
    #[inline]
    pub(super) fn index(z: f32, distance_m: f32, azimuth_rad: f32) -> Option<usize> {
        let row = (z / distance_m - Self::TAN_BOTTOM) * Self::ROWS_PER_TAN;
        if !(row >= 0.0 && row < Self::ROWS as f32) {
            return None;
        }
        let column = (azimuth_rad + PI) * (Self::COLUMNS as f32 / TAU);
        Some(row as usize * Self::COLUMNS + (column as usize).min(Self::COLUMNS - 1))
    }

    #[inline]
    pub(super) fn insert(&mut self, index: usize, point: Vec3, distance_m: f32) {
        if distance_m < self.cells[index].1 {
            self.cells[index] = (point, distance_m);
        }
    }

    /// The return `up` rows over and `left` columns beside a cell.
    #[inline]
    pub(super) fn near(&self, index: usize, up: isize, left: isize) -> Option<Vec3> {
        let row = (index / Self::COLUMNS) as isize + up;
        if !(0..Self::ROWS as isize).contains(&row) {
            return None;
        }
        let column = (index % Self::COLUMNS) as isize + left;
        let column = column.rem_euclid(Self::COLUMNS as isize);
        let (point, distance_m) = self.cells[row as usize * Self::COLUMNS + column as usize];
        (distance_m < f32::INFINITY).then_some(point)
    }
}
