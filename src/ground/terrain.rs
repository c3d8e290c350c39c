//! The height of the ground around the sensor, grown outwards from the car over the lowest
//! points of a polar grid.
//!
//! Near the sensor the ground is the plane of the low points. From ring to ring a cell's low
//! point is ground if it lies near the height that the cells inside it predict,
//!
//! ```text
//! |low − predicted| < step_m + max_slope · distance to the last cell of known ground
//! ```
//!
//! else something stands in front of the ground there, and the cell takes the height of its
//! known neighbours.

use glam::Vec3;
use serde::{Deserialize, Serialize};

use super::polar::{Placed, PolarGrid, SECTORS};
use super::surface::Shape;

/// How the ground may change from cell to cell.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TerrainConfig {
    /// Change of height that is always believed, such as a kerb [m].
    pub step_m: f32,
    /// Slope relative to the prediction that is believed beyond that, unitless.
    pub max_slope: f32,
    /// The largest change that is believed over a gap [m].
    pub max_jump_m: f32,
    /// Radius within which the ground is taken as one plane to start from [m].
    pub start_radius_m: f32,
    /// Points on steeper surfaces are no low points of the ground [rad].
    pub max_low_slope_rad: f32,
}

impl Default for TerrainConfig {
    /// Chosen on the even-numbered of 21 labelled scans.
    fn default() -> Self {
        Self {
            step_m: 0.15,
            max_slope: 0.08,
            max_jump_m: 0.6,
            start_radius_m: 10.0,
            max_low_slope_rad: 0.8,
        }
    }
}

/// Distance over which the slope of known ground is averaged [m].
const SLOPE_MEMORY_M: f32 = 2.5;

/// Ground heights and low points per cell of a polar grid, in the lidar frame [m].
#[derive(Clone, Debug)]
pub(super) struct Terrain {
    /// Lowest supported point of gentle slope in the cell; NaN where there is none.
    lows: Vec<f32>,
    /// Mean and variance of the lowest points, of whatever slope, in the nine cells around.
    surroundings: Vec<(f32, f32)>,
    /// Height of the ground; NaN only where the scan has no ground at all.
    heights: Vec<f32>,
    known: Vec<bool>,
    /// Slope outwards, unitless.
    slopes: Vec<f32>,
    rings: usize,
}

impl Terrain {
    pub(super) fn estimate(
        grid: &PolarGrid,
        placed: &[Placed],
        shapes: &[Shape],
        config: &TerrainConfig,
    ) -> Self {
        let gentle = |index: usize| shapes[index].slope_rad < config.max_low_slope_rad;
        let (all_lows, lows) = low_points(grid.len(), placed, gentle);
        let mut terrain = Self {
            lows,
            surroundings: surroundings(&all_lows, grid.rings()),
            heights: vec![f32::NAN; grid.len()],
            known: vec![false; grid.len()],
            slopes: vec![0.0; grid.len()],
            rings: grid.rings(),
        };
        if let Some(plane) = terrain.start_plane(grid, config) {
            terrain.grow(grid, config, plane);
            terrain.level(grid, placed, config);
            terrain.fill();
        }
        terrain
    }

    /// Root mean square of a point's height over the low points of the nine cells around [m].
    #[inline]
    pub(super) fn rise_over_lows(&self, place: &Placed) -> f32 {
        let (mean, variance) = self.surroundings[place.cell as usize];
        ((place.z - mean).powi(2) + variance).sqrt()
    }

    /// Height of the ground at a place, between the middles of the cells [m].
    #[inline]
    pub(super) fn height_at(&self, ring: f32, sector: f32) -> f32 {
        let (r, s) = ((ring - 0.5).max(0.0), sector - 0.5 + SECTORS as f32);
        let (r0, s0) = (r as usize, s as usize);
        let (fr, fs) = (r - r0 as f32, s - s0 as f32);
        let r1 = (r0 + 1).min(self.rings - 1);
        let (s0, s1) = (s0 % SECTORS, (s0 + 1) % SECTORS);
        let at = |ring: usize, sector: usize| self.heights[ring * SECTORS + sector];
        let inner = at(r0, s0) + fs * (at(r0, s1) - at(r0, s0));
        let outer = at(r1, s0) + fs * (at(r1, s1) - at(r1, s0));
        inner + fr * (outer - inner)
    }

    /// The plane z = a + b x + c y of the low points about the car: first level at the height
    /// where most of them are, then fitted to those near it.
    fn start_plane(&self, grid: &PolarGrid, config: &TerrainConfig) -> Option<[f32; 3]> {
        const BIN_M: f32 = 0.2;
        const BINS: usize = 60;
        let mut lows = Vec::new();
        for ring in 0..grid.rings() {
            let distance_m = grid.middle_m(ring);
            if distance_m > config.start_radius_m {
                break;
            }
            for sector in 0..SECTORS {
                let low = self.lows[ring * SECTORS + sector];
                if low.is_finite() {
                    let (sin, cos) = direction(sector);
                    lows.push(Vec3::new(distance_m * cos, distance_m * sin, low));
                }
            }
        }
        let mut histogram = [0_u32; BINS];
        for low in &lows {
            let bin = (low.z / BIN_M + 0.75 * BINS as f32) as usize;
            histogram[bin.min(BINS - 1)] += 1;
        }
        let in_bins = |bin: usize| histogram[bin] + histogram[bin + 1];
        let mut fullest = 0;
        for bin in 1..BINS - 1 {
            if in_bins(bin) > in_bins(fullest) {
                fullest = bin;
            }
        }
        let level = (fullest as f32 + 1.0 - 0.75 * BINS as f32) * BIN_M;
        if lows.is_empty() {
            return None;
        }
        let mut plane = [level, 0.0, 0.0];
        for tolerance_m in [0.6, 0.4, 0.2, 0.15] {
            plane = fit_plane(&lows, plane, tolerance_m).unwrap_or(plane);
        }
        Some(plane)
    }

    /// From ring to ring outwards; see the module.
    fn grow(&mut self, grid: &PolarGrid, config: &TerrainConfig, [a, b, c]: [f32; 3]) {
        // Distance and height of the last known ground, per sector.
        let mut last_m = [0.0_f32; SECTORS];
        let mut last_height = [a; SECTORS];
        // Slope along the sector, from known ground.
        let mut slope = [0.0_f32; SECTORS];
        for (sector, slope) in slope.iter_mut().enumerate() {
            let (sin, cos) = direction(sector);
            *slope = b * cos + c * sin;
        }
        for ring in 0..grid.rings() {
            let middle_m = grid.middle_m(ring);
            let near = middle_m < 0.4 * config.start_radius_m;
            let mut now_m = last_m;
            let mut new_slope = slope;
            for sector in 0..SECTORS {
                let index = ring * SECTORS + sector;
                let (before, after) = ((sector + SECTORS - 1) % SECTORS, (sector + 1) % SECTORS);
                let predicted = if ring == 0 || near {
                    let (sin, cos) = direction(sector);
                    a + middle_m * (b * cos + c * sin)
                } else {
                    let width_m = middle_m - grid.middle_m(ring - 1);
                    let mut sum = 0.0;
                    let mut weights = 0.0;
                    for (other, share) in [(before, 1.0), (sector, 2.0), (after, 1.0)] {
                        let fresh = last_m[other] > middle_m - 1.5 * width_m;
                        let weight = if fresh { 4.0 * share } else { share };
                        let inner = self.heights[(ring - 1) * SECTORS + other];
                        sum += weight * (inner + slope[other] * width_m);
                        weights += weight;
                    }
                    sum / weights
                };
                let low = self.lows[index];
                let gap_m = middle_m - last_m[sector].max(last_m[before]).max(last_m[after]);
                let allowed_m = (config.step_m + config.max_slope * gap_m).min(config.max_jump_m);
                if (low - predicted).abs() < allowed_m {
                    self.heights[index] = low;
                    self.known[index] = true;
                    now_m[sector] = middle_m;
                    if !near {
                        let run_m = middle_m - last_m[sector];
                        let seen = ((low - last_height[sector]) / run_m).clamp(-0.3, 0.3);
                        let gain = (run_m / SLOPE_MEMORY_M).min(0.7);
                        new_slope[sector] = slope[sector] + gain * (seen - slope[sector]);
                    }
                    last_height[sector] = low;
                } else {
                    self.heights[index] = predicted;
                    new_slope[sector] = 0.9 * slope[sector];
                }
            }
            for sector in 0..SECTORS {
                let (before, after) = ((sector + SECTORS - 1) % SECTORS, (sector + 1) % SECTORS);
                slope[sector] =
                    0.25 * (new_slope[before] + 2.0 * new_slope[sector] + new_slope[after]);
            }
            self.slopes[ring * SECTORS..][..SECTORS].copy_from_slice(&slope);
            last_m = now_m;
        }
    }

    /// Moves known ground from the lowest point of a cell to the mean of the points about it,
    /// and along its slope to the middle of the cell.
    fn level(&mut self, grid: &PolarGrid, placed: &[Placed], config: &TerrainConfig) {
        let mut sums = vec![[0.0_f32; 3]; self.heights.len()];
        for point in placed.iter().filter(|point| point.is_somewhere()) {
            let index = point.cell as usize;
            let over_low_m = point.z - self.lows[index];
            if over_low_m.abs() < config.step_m {
                let sums = &mut sums[index];
                sums[0] += 1.0;
                sums[1] += over_low_m;
                sums[2] += point.ring.fract() - 0.5;
            }
        }
        for (index, [count, over_low_m, outward]) in sums.into_iter().enumerate() {
            if self.known[index] && count > 0.0 {
                let run_m = outward / count * grid.width_m(index / SECTORS);
                self.heights[index] += over_low_m / count - self.slopes[index] * run_m;
            }
        }
    }

    /// Gives cells of unknown ground the height between their neighbours.
    fn fill(&mut self) {
        const PASSES: usize = 6;
        for _ in 0..PASSES {
            for ring in 1..self.rings - 1 {
                for sector in 0..SECTORS {
                    let index = ring * SECTORS + sector;
                    if self.known[index] {
                        continue;
                    }
                    let row = ring * SECTORS;
                    let neighbours = [
                        index - SECTORS,
                        index + SECTORS,
                        row + (sector + SECTORS - 1) % SECTORS,
                        row + (sector + 1) % SECTORS,
                    ];
                    let (mut sum, mut weights) = (self.heights[index], 1.0);
                    for neighbour in neighbours {
                        let weight = if self.known[neighbour] { 2.0 } else { 0.5 };
                        sum += weight * self.heights[neighbour];
                        weights += weight;
                    }
                    self.heights[index] = sum / weights;
                }
            }
        }
    }
}

/// Per cell the lowest point that is not alone: among all points, and among those that are
/// `gentle`. NaN where there is none.
fn low_points(
    cells: usize,
    placed: &[Placed],
    gentle: impl Fn(usize) -> bool,
) -> (Vec<f32>, Vec<f32>) {
    let mut lows = vec![[Lowest::NONE; 2]; cells];
    for (index, point) in placed.iter().enumerate() {
        if !point.is_somewhere() {
            continue;
        }
        let [all, among_gentle] = &mut lows[point.cell as usize];
        all.add(point.z);
        if gentle(index) {
            among_gentle.add(point.z);
        }
    }
    lows.iter()
        .map(|[all, among_gentle]| (all.supported(), among_gentle.supported()))
        .unzip()
}

/// The two lowest heights of a cell.
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

    /// The lowest, or the second where it lies far above: then the lowest is a reflection from
    /// below the ground.
    fn supported(&self) -> f32 {
        const ALONE_M: f32 = 0.3;
        if self.first == f32::INFINITY {
            f32::NAN
        } else if self.second < f32::INFINITY && self.second - self.first > ALONE_M {
            self.second
        } else {
            self.first
        }
    }
}

/// Mean and variance of the low points of each cell with its eight neighbours; meaningless for
/// cells without points.
fn surroundings(lows: &[f32], rings: usize) -> Vec<(f32, f32)> {
    let mut result = vec![(0.0, 0.0); lows.len()];
    for (index, result) in result.iter_mut().enumerate() {
        if lows[index].is_nan() {
            continue;
        }
        let (ring, sector) = (index / SECTORS, index % SECTORS);
        let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0);
        for ring in ring.saturating_sub(1)..=(ring + 1).min(rings - 1) {
            for side in [SECTORS - 1, SECTORS, SECTORS + 1] {
                // Relative to the middle cell, lest squares of heights cancel.
                let low = lows[ring * SECTORS + (sector + side) % SECTORS] - lows[index];
                if low.is_finite() {
                    sum += low;
                    squares += low * low;
                    count += 1.0;
                }
            }
        }
        let mean = sum / count;
        *result = (lows[index] + mean, (squares / count - mean * mean).max(0.0));
    }
    result
}

/// Sine and cosine of the middle of a sector.
fn direction(sector: usize) -> (f32, f32) {
    let azimuth_rad =
        (sector as f32 + 0.5) / SECTORS as f32 * std::f32::consts::TAU - std::f32::consts::PI;
    azimuth_rad.sin_cos()
}

/// Least squares over the points within a tolerance of the plane before.
fn fit_plane(points: &[Vec3], [a, b, c]: [f32; 3], tolerance_m: f32) -> Option<[f32; 3]> {
    let mut matrix = glam::Mat3::ZERO;
    let mut right = Vec3::ZERO;
    let mut count = 0;
    for point in points {
        if (point.z - a - b * point.x - c * point.y).abs() < tolerance_m {
            let row = Vec3::new(1.0, point.x, point.y);
            matrix += glam::Mat3::from_cols(row, row * point.x, row * point.y);
            right += row * point.z;
            count += 1;
        }
    }
    // Hold the tilt at zero where the points do not tell it.
    matrix.y_axis.y += 10.0;
    matrix.z_axis.z += 10.0;
    (count >= 3).then(|| (matrix.inverse() * right).to_array())
}
