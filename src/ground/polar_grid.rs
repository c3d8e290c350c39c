//! A polar grid around the sensor whose rings widen with distance.

use std::f32::consts::{PI, TAU};
use std::num::NonZeroU32;

/// Sectors over 360 degrees.
pub(super) const SECTORS: usize = 180;
/// Width of the rings near the sensor [m].
const RING_M: f32 = 0.5;
/// Radius from which on rings widen [m].
const WIDENING_FROM_M: f32 = 10.0;
/// Width of a far ring per distance from the sensor, unitless.
const WIDENING: f32 = 0.05;
/// Outer radius [m].
const REACH_M: f32 = 120.0;
/// Resolution of the table from distance to ring [1/m].
const STEPS_PER_M: f32 = 8.0;

/// Rings and sectors; cells are numbered ring by ring.
#[derive(Clone, Debug)]
pub(super) struct PolarGrid {
    /// Inner radii of the rings, and the outer radius of the last [m].
    edges_m: Vec<f32>,
    /// Radial coordinate in rings, by distance: 2.5 is the middle of ring 2.
    radial: Vec<f32>,
}

/// The coordinates of a point in a [`PolarGrid`].
#[derive(Clone, Copy, Debug)]
pub(super) struct PolarPosition {
    /// Radial coordinate [rings].
    pub(super) ring: f32,
    /// Angular coordinate [sectors].
    pub(super) sector: f32,
    /// Height in the lidar frame [m].
    pub(super) z: f32,
    /// One more than the index of the cell, so that an `Option` needs no more memory.
    cell: NonZeroU32,
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
        let radial = (0..=(REACH_M * STEPS_PER_M) as usize + 1)
            .map(|step| {
                let distance = step as f32 / STEPS_PER_M;
                while ring + 2 < edges_m.len() && edges_m[ring + 1] <= distance {
                    ring += 1;
                }
                ring as f32 + (distance - edges_m[ring]) / (edges_m[ring + 1] - edges_m[ring])
            })
            .collect();
        Self { edges_m, radial }
    }

    pub(super) fn rings(&self) -> usize {
        self.edges_m.len() - 1
    }

    /// Number of cells.
    pub(super) fn len(&self) -> usize {
        self.rings() * SECTORS
    }

    /// Radius of the middle of a ring [m].
    pub(super) fn middle_m(&self, ring: usize) -> f32 {
        0.5 * (self.edges_m[ring] + self.edges_m[ring + 1])
    }

    /// Width of a ring [m].
    pub(super) fn width_m(&self, ring: usize) -> f32 {
        self.edges_m[ring + 1] - self.edges_m[ring]
    }

    /// Returns the position of a point; `None` beyond the last ring.
    #[inline(always)]
    pub(super) fn locate(
        &self,
        z: f32,
        distance_m: f32,
        azimuth_rad: f32,
    ) -> Option<PolarPosition> {
        if distance_m >= REACH_M {
            return None;
        }
        let step = distance_m * STEPS_PER_M;
        let below = step as usize;
        let (a, b) = (self.radial[below], self.radial[below + 1]);
        let ring = a + (b - a) * (step - below as f32);
        let sector = (azimuth_rad + PI) * (SECTORS as f32 / TAU);
        let index = ring as usize * SECTORS + (sector as usize).min(SECTORS - 1);
        Some(PolarPosition {
            ring,
            sector,
            z,
            cell: NonZeroU32::new(index as u32 + 1)?,
        })
    }
}

impl PolarPosition {
    /// Index of the cell.
    #[inline(always)]
    pub(super) fn cell(&self) -> usize {
        self.cell.get() as usize - 1
    }
}
