//! Polar elevation map of the ground around the sensor, by region growing over the lowest points
//! of the cells.
//!
//! Near the sensor the ground is the plane of the low points. From ring to ring outwards a cell's
//! low point is ground if it lies near the height that is extrapolated from the cells inside,
//!
//! ```text
//! −(step_m + max_fall_slope · gap) < low − predicted < step_m + max_slope · gap
//! ```
//!
//! with the gap to the last cell of known ground: what is lower than predicted may be behind a
//! crest, what is higher an obstacle. Otherwise the ground is occluded there, and its height is interpolated between the neighbours.

use glam::{Mat3, Vec3};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::polar_grid::{PolarGrid, PolarPosition, SECTORS};
use super::surface::Shape;
use crate::validation::{InvalidValue, Validate, in_range, not_negative, positive};

/// Limits of the change of ground height between cells.
///
/// Defaults: nearly as good on each of three labelled drives and on simulated streets as values
/// that are chosen on the others.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct TerrainConfig {
    /// Change of height that is always accepted, such as a kerb [m].
    #[default(0.15)]
    pub step_m: f32,
    /// Slope relative to the prediction that is accepted in addition, unitless.
    #[default(0.08)]
    pub max_slope: f32,
    /// Maximum change that is accepted across a gap [m].
    #[default(0.6)]
    pub max_jump_m: f32,
    /// Like `max_slope`, for ground below the prediction, unitless.
    #[default(0.3)]
    pub max_fall_slope: f32,
    /// Like `max_jump_m`, for ground below the prediction [m].
    #[default(1.0)]
    pub max_fall_m: f32,
    /// Radius within which the ground is initialized as a plane [m].
    #[default(15.0)]
    pub start_radius_m: f32,
    /// Share of this radius up to which the ground is predicted by the plane, and farther out by the cells inside
    /// (unitless).
    #[default(0.4)]
    pub plane_share: f32,
    /// Distance over which the slope of known ground is averaged [m].
    #[default(2.5)]
    pub slope_memory_m: f32,
    /// Largest slope that is measured between cells of known ground (unitless).
    #[default(0.3)]
    pub max_measured_slope: f32,
    /// Points on steeper surfaces are no candidates for low points of the ground [rad].
    #[default(0.5)]
    pub max_low_slope_rad: f32,
    /// The lowest point of a cell is a reflection from below the ground if the next one is higher by more [m].
    #[default(0.3)]
    pub isolated_m: f32,
    /// Points higher above the ground than this do not count for the relief of their cell: a car
    /// passes beneath [m].
    #[default(2.0)]
    pub clearance_m: f32,
}

impl Validate for TerrainConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        positive("step_m", self.step_m)?;
        not_negative("max_slope", self.max_slope)?;
        positive("max_jump_m", self.max_jump_m)?;
        not_negative("max_fall_slope", self.max_fall_slope)?;
        positive("max_fall_m", self.max_fall_m)?;
        positive("start_radius_m", self.start_radius_m)?;
        in_range("plane_share", self.plane_share, 0.0..=1.0)?;
        positive("slope_memory_m", self.slope_memory_m)?;
        not_negative("max_measured_slope", self.max_measured_slope)?;
        positive("max_low_slope_rad", self.max_low_slope_rad)?;
        positive("isolated_m", self.isolated_m)?;
        positive("clearance_m", self.clearance_m)
    }
}

/// Ground heights and low points per cell of a polar grid, in the lidar frame [m].
#[derive(Clone, Debug)]
pub(super) struct Terrain {
    grid: PolarGrid,
    /// Lowest supported point of gentle slope in the cell; NaN where there is none.
    lows: Vec<f32>,
    /// Mean and variance of the lowest points, of any slope, in the nine cells around.
    surroundings: Vec<(f32, f32)>,
    /// Height of the ground; NaN only if the scan has no ground at all.
    heights: Vec<f32>,
    /// Whether the height was measured, not interpolated.
    known: Vec<bool>,
    /// Slope outwards, unitless.
    slopes: Vec<f32>,
    /// Highest point of the cell below the clearance, moved along the slope to the middle of the
    /// cell; minus infinity where there is none.
    tops: Vec<f32>,
}

impl Terrain {
    pub(super) fn estimate(
        grid: PolarGrid,
        positions: &[Option<PolarPosition>],
        shapes: &[Shape],
        config: &TerrainConfig,
    ) -> Self {
        let mut lowest = vec![[Lowest::NONE; 2]; grid.len()];
        for (position, shape) in positions.iter().zip(shapes) {
            let Some(position) = position else { continue };
            let [all, gentle] = &mut lowest[position.cell()];
            all.add(position.z);
            if shape.slope_rad < config.max_low_slope_rad {
                gentle.add(position.z);
            }
        }
        let supported = |pair: &[Lowest; 2]| {
            let [all, gentle] = pair.map(|low| low.supported(config.isolated_m));
            (all, gentle)
        };
        let (all_lows, lows): (Vec<f32>, Vec<f32>) = lowest.iter().map(supported).unzip();
        let mut terrain = Self {
            lows,
            surroundings: surroundings(&all_lows),
            heights: vec![f32::NAN; grid.len()],
            known: vec![false; grid.len()],
            slopes: vec![0.0; grid.len()],
            tops: vec![f32::NEG_INFINITY; grid.len()],
            grid,
        };
        if let Some(plane) = terrain.start_plane(config) {
            terrain.grow(config, plane);
            terrain.measure_cells(positions, config);
            terrain.fill();
        }
        terrain
    }

    /// Root mean square of a point's height above the low points of the nine cells around [m].
    #[inline(always)]
    pub(super) fn height_above_lows_m(&self, position: &PolarPosition) -> f32 {
        let (mean, variance) = self.surroundings[position.cell()];
        ((position.z - mean).powi(2) + variance).sqrt()
    }

    /// Height of the ground, bilinear between the middles of the cells [m].
    #[inline(always)]
    pub(super) fn height_at(&self, position: &PolarPosition) -> f32 {
        let (r, s) = (
            (position.ring - 0.5).max(0.0),
            position.sector - 0.5 + SECTORS as f32,
        );
        let (r0, s0) = (r as usize, s as usize);
        let (fr, fs) = (r - r0 as f32, s - s0 as f32);
        let r1 = (r0 + 1).min(self.grid.rings() - 1);
        let (s0, s1) = (s0 % SECTORS, (s0 + 1) % SECTORS);
        let at = |ring: usize, sector: usize| self.heights[ring * SECTORS + sector];
        let inner = at(r0, s0) + fs * (at(r0, s1) - at(r0, s0));
        let outer = at(r1, s0) + fs * (at(r1, s1) - at(r1, s0));
        inner + fr * (outer - inner)
    }

    /// Mean height of the cells around the sensor; NaN if the scan has no ground at all [m].
    pub(super) fn height_below_m(&self) -> f32 {
        self.heights[..SECTORS].iter().sum::<f32>() / SECTORS as f32
    }

    /// Height of the highest point around a point, below the clearance, above the ground [m].
    #[inline(always)]
    pub(super) fn top_m(&self, position: &PolarPosition) -> f32 {
        let cell = position.cell();
        self.tops[cell] - self.heights[cell]
    }

    /// Fits the plane z = a + b x + c y to the low points around the car: first level at the mode
    /// of their heights, then least squares over those near it.
    fn start_plane(&self, config: &TerrainConfig) -> Option<[f32; 3]> {
        /// Height of a bin of the histogram, and number of bins, three quarters of them below the sensor [m].
        const BIN_M: f32 = 0.2;
        const BINS: usize = 60;
        /// Distances from the plane within which low points count, one fit after the other [m].
        const TOLERANCES_M: [f32; 4] = [0.6, 0.4, 0.2, 0.15];
        let is_near = |ring: &usize| self.grid.middle_m(*ring) <= config.start_radius_m;
        let rings = (0..self.grid.rings()).take_while(is_near).count();
        let lows: Vec<Vec3> = (0..rings * SECTORS)
            .filter(|&cell| self.lows[cell].is_finite())
            .map(|cell| {
                let distance_m = self.grid.middle_m(cell / SECTORS);
                let (sin, cos) = direction(cell % SECTORS);
                Vec3::new(distance_m * cos, distance_m * sin, self.lows[cell])
            })
            .collect();
        if lows.is_empty() {
            return None;
        }
        let mut histogram = [0_u32; BINS];
        for low in &lows {
            let bin = (low.z / BIN_M + 0.75 * BINS as f32) as usize;
            histogram[bin.min(BINS - 1)] += 1;
        }
        // The lowest of the fullest pairs of neighbouring bins.
        let in_bins = |bin: &usize| histogram[*bin] + histogram[bin + 1];
        let fullest = (0..BINS - 1).rev().max_by_key(in_bins)?;
        let level = (fullest as f32 + 1.0 - 0.75 * BINS as f32) * BIN_M;
        let mut plane = [level, 0.0, 0.0];
        for tolerance_m in TOLERANCES_M {
            plane = fit_plane(&lows, plane, tolerance_m).unwrap_or(plane);
        }
        Some(plane)
    }

    /// Grows the ground outwards, ring by ring; see the module.
    fn grow(&mut self, config: &TerrainConfig, [a, b, c]: [f32; 3]) {
        /// Weight of a cell inside that is known in the last ring or the one before.
        const RECENT_WEIGHT: f32 = 4.0;
        /// Largest weight of a new slope.
        const MAX_GAIN: f32 = 0.7;
        /// Share of the slope that remains from ring to ring where the ground is unknown.
        const KEPT_SLOPE: f32 = 0.9;
        let start_slope: [f32; SECTORS] = std::array::from_fn(|sector| {
            let (sin, cos) = direction(sector);
            b * cos + c * sin
        });
        // Slope of the known ground, and distance and height of its last cell, per sector.
        let mut slope = start_slope;
        let mut last_m = [0.0_f32; SECTORS];
        let mut last_height = [a; SECTORS];
        for ring in 0..self.grid.rings() {
            let middle_m = self.grid.middle_m(ring);
            let near = middle_m < config.plane_share * config.start_radius_m;
            let mut now_m = last_m;
            let mut new_slope = slope;
            for sector in 0..SECTORS {
                let cell = ring * SECTORS + sector;
                let [before, after] = neighbours(sector);
                let predicted = if ring == 0 || near {
                    a + middle_m * start_slope[sector]
                } else {
                    let width_m = middle_m - self.grid.middle_m(ring - 1);
                    let mut sum = 0.0;
                    let mut weights = 0.0;
                    for (other, share) in [(before, 1.0), (sector, 2.0), (after, 1.0)] {
                        let is_recent = last_m[other] > middle_m - 1.5 * width_m;
                        let weight = if is_recent {
                            RECENT_WEIGHT * share
                        } else {
                            share
                        };
                        let inner = self.heights[(ring - 1) * SECTORS + other];
                        sum += weight * (inner + slope[other] * width_m);
                        weights += weight;
                    }
                    sum / weights
                };
                let low = self.lows[cell];
                let gap_m = middle_m - last_m[sector].max(last_m[before]).max(last_m[after]);
                let rise_m = (config.step_m + config.max_slope * gap_m).min(config.max_jump_m);
                let fall_m = (config.step_m + config.max_fall_slope * gap_m).min(config.max_fall_m);
                if low - predicted < rise_m && predicted - low < fall_m {
                    self.heights[cell] = low;
                    self.known[cell] = true;
                    now_m[sector] = middle_m;
                    if !near {
                        let run_m = middle_m - last_m[sector];
                        let measured = (low - last_height[sector]) / run_m;
                        let steepest = config.max_measured_slope;
                        let measured = measured.clamp(-steepest, steepest);
                        let gain = (run_m / config.slope_memory_m).min(MAX_GAIN);
                        new_slope[sector] = slope[sector] + gain * (measured - slope[sector]);
                    }
                    last_height[sector] = low;
                } else {
                    self.heights[cell] = predicted;
                    new_slope[sector] = KEPT_SLOPE * slope[sector];
                }
            }
            for (sector, slope) in slope.iter_mut().enumerate() {
                let [before, after] = neighbours(sector);
                *slope = 0.25 * (new_slope[before] + 2.0 * new_slope[sector] + new_slope[after]);
            }
            self.slopes[ring * SECTORS..][..SECTORS].copy_from_slice(&slope);
            last_m = now_m;
        }
    }

    /// Finds the top of every cell, and moves known ground from the lowest point of a cell to the
    /// mean of the points near it, and along its slope to the middle of the cell.
    fn measure_cells(&mut self, positions: &[Option<PolarPosition>], config: &TerrainConfig) {
        let mut sums = vec![[0.0_f32; 3]; self.heights.len()];
        for position in positions.iter().flatten() {
            let cell = position.cell();
            // Known ground still has the height of the lowest point.
            let above_low_m = position.z - self.heights[cell];
            let outward = position.ring.fract() - 0.5;
            if above_low_m.abs() < config.step_m {
                let sums = &mut sums[cell];
                sums[0] += 1.0;
                sums[1] += above_low_m;
                sums[2] += outward;
            }
            if above_low_m < config.clearance_m {
                let run_m = outward * self.grid.width_m(cell / SECTORS);
                let top = position.z - self.slopes[cell] * run_m;
                self.tops[cell] = self.tops[cell].max(top);
            }
        }
        for (cell, [count, above_low_m, outward]) in sums.into_iter().enumerate() {
            if self.known[cell] && count > 0.0 {
                let run_m = outward / count * self.grid.width_m(cell / SECTORS);
                self.heights[cell] += above_low_m / count - self.slopes[cell] * run_m;
            }
        }
    }

    /// Smooths unknown heights between their neighbours, in several passes.
    fn fill(&mut self) {
        /// Passes over all unknown cells.
        const PASSES: usize = 6;
        // A pass may run this many cells behind the one before instead of after it: where it is,
        // the neighbours are done. Then the divisions of a pass do not wait for each other.
        const LAG: usize = SECTORS + 1;
        let inner = SECTORS..self.heights.len() - SECTORS;
        let unknown: Vec<usize> = inner.filter(|&cell| !self.known[cell]).collect();
        let weight = |&is_known: &bool| if is_known { 2.0 } else { 0.5 };
        let weights: Vec<f32> = self.known.iter().map(weight).collect();
        for first in 0..unknown.len() + (PASSES - 1) * LAG {
            for pass in 0..PASSES {
                let index = first.wrapping_sub(pass * LAG);
                if let Some(&cell) = unknown.get(index) {
                    smooth(&mut self.heights, &weights, cell);
                }
            }
        }
    }
}

/// Replaces a height by the weighted mean of itself and its four neighbours.
#[inline]
fn smooth(heights: &mut [f32], weights: &[f32], cell: usize) {
    let [before, after] = neighbours(cell % SECTORS);
    let row = cell - cell % SECTORS;
    let (mut sum, mut total) = (heights[cell], 1.0);
    for neighbour in [cell - SECTORS, cell + SECTORS, row + before, row + after] {
        sum += weights[neighbour] * heights[neighbour];
        total += weights[neighbour];
    }
    heights[cell] = sum / total;
}

/// The two lowest heights of a cell [m].
#[derive(Clone, Copy)]
struct Lowest {
    first: f32,
    second: f32,
}

impl Lowest {
    const NONE: Self = Self {
        first: f32::INFINITY,
        second: f32::INFINITY,
    };

    #[inline]
    fn add(&mut self, z: f32) {
        self.second = self.second.min(self.first.max(z));
        self.first = self.first.min(z);
    }

    /// The lowest height, or the second where it is far above: then the lowest is a reflection
    /// from below the ground. NaN without points.
    fn supported(&self, isolated_m: f32) -> f32 {
        if self.first == f32::INFINITY {
            f32::NAN
        } else if self.second < f32::INFINITY && self.second - self.first > isolated_m {
            self.second
        } else {
            self.first
        }
    }
}

/// Mean and variance of the low points of each cell and its eight neighbours; meaningless for
/// cells without points.
fn surroundings(lows: &[f32]) -> Vec<(f32, f32)> {
    let last_ring = lows.len() / SECTORS - 1;
    let around = |(cell, &center): (usize, &f32)| {
        if center.is_nan() {
            return (0.0, 0.0);
        }
        let (ring, sector) = (cell / SECTORS, cell % SECTORS);
        let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0);
        for ring in ring.saturating_sub(1)..=(ring + 1).min(last_ring) {
            let [before, after] = neighbours(sector);
            for sector in [before, sector, after] {
                // Relative to the central cell, against cancellation of squared heights.
                let low = lows[ring * SECTORS + sector] - center;
                if low.is_finite() {
                    sum += low;
                    squares += low * low;
                    count += 1.0;
                }
            }
        }
        let mean = sum / count;
        (center + mean, (squares / count - mean * mean).max(0.0))
    };
    lows.iter().enumerate().map(around).collect()
}

/// The neighbouring sectors.
#[inline]
fn neighbours(sector: usize) -> [usize; 2] {
    [(sector + SECTORS - 1) % SECTORS, (sector + 1) % SECTORS]
}

/// Sine and cosine of the middle of a sector.
fn direction(sector: usize) -> (f32, f32) {
    let azimuth_rad =
        (sector as f32 + 0.5) / SECTORS as f32 * std::f32::consts::TAU - std::f32::consts::PI;
    azimuth_rad.sin_cos()
}

/// Fits a plane by least squares over the points within a tolerance of the previous plane.
fn fit_plane(points: &[Vec3], [a, b, c]: [f32; 3], tolerance_m: f32) -> Option<[f32; 3]> {
    let mut matrix = Mat3::ZERO;
    let mut right = Vec3::ZERO;
    let mut count = 0;
    for point in points {
        if (point.z - a - b * point.x - c * point.y).abs() < tolerance_m {
            let row = Vec3::new(1.0, point.x, point.y);
            matrix += Mat3::from_cols(row, row * point.x, row * point.y);
            right += row * point.z;
            count += 1;
        }
    }
    /// Regularization: no tilt where the points do not determine it [m²].
    const LEVEL_M2: f32 = 10.0;
    matrix.y_axis.y += LEVEL_M2;
    matrix.z_axis.z += LEVEL_M2;
    (count >= 3).then(|| (matrix.inverse() * right).to_array())
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    #[test]
    fn a_point_far_below_the_next_one_of_its_cell_is_a_reflection() {
        let mut lowest = Lowest::NONE;
        for z in [-1.0, -1.6, -2.0] {
            lowest.add(z);
        }
        assert_eq!(lowest.supported(0.3), -1.6);
        assert_eq!(lowest.supported(0.5), -2.0);
    }

    #[test]
    fn interleaved_passes_fill_as_passes_one_after_the_other() {
        let grid = PolarGrid::new();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        // No cell is known far away, as beyond the reach of most scans.
        let is_known = |cell| cell < grid.len() / 2 && rng.random_bool(0.3);
        let known: Vec<bool> = (0..grid.len()).map(is_known).collect();
        let heights: Vec<f32> = known.iter().map(|_| rng.random_range(-3.0..1.0)).collect();
        let weight = |&is_known: &bool| if is_known { 2.0 } else { 0.5 };
        let weights: Vec<f32> = known.iter().map(weight).collect();
        let mut expected = heights.clone();
        for _ in 0..6 {
            let inner = SECTORS..grid.len() - SECTORS;
            for cell in inner.filter(|&cell| !known[cell]) {
                smooth(&mut expected, &weights, cell);
            }
        }
        let mut terrain = Terrain {
            lows: Vec::new(),
            surroundings: Vec::new(),
            heights,
            known,
            slopes: Vec::new(),
            tops: Vec::new(),
            grid,
        };
        terrain.fill();
        assert_eq!(terrain.heights, expected);
    }
}
