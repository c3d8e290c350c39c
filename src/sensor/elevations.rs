//! Beams as peaks of the elevations of all points.
//!
//! The points of a laser that is mounted at a height z₀ above the origin lie on a cone,
//!
//! ```text
//! tan θ = (z − z₀) / √(x² + y²)
//! ```
//!
//! so that θ is the same at all ranges and z / √(x² + y²) is not. The offset z₀ is the one with the sharpest
//! histogram of θ, for each band of elevation, because lasers in different blocks have different ones. Peaks are
//! maxima with valleys of less than half their height on both sides, for several widths of the window in which
//! points are counted: the widest that serves, since narrower ones divide a blurred beam, unless a narrower one
//! finds more peaks with empty valleys between all of them. Beams are there if peaks that are found in half of the azimuths hold most points
//! of the other half, in the quarter of the gap next to them; of directions without rows it is half.

use rayon::prelude::*;

use super::beam::{BeamReturns, MAX_BEAMS, angles, elevation_deg, quantile};
use crate::lidar::Scan;

/// Points that are examined, about.
const MAX_POINTS: usize = 200_000;
/// Width of a bin of a histogram [deg].
const BIN_DEG: f32 = 0.01;
/// Widths of the window in which points are counted [bins].
const WINDOWS: [usize; 5] = [3, 6, 12, 25, 50];
/// Share of the points near a peak, at least (unitless).
const MIN_SHARE: f64 = 0.75;
/// The widest window is taken whose share is as good; narrower ones divide peaks (unitless).
const SAME_SHARE: f64 = 0.003;
/// Share of the points between any two peaks of a narrower window that is taken nevertheless, at least (unitless).
const CLEAN_SHARE: f64 = 0.99;
/// Peaks that are as many times lower than both neighbours are of stray points.
const STRAY: u32 = 10;
/// Height of a peak, at least: points, and relative to the median peak.
const MIN_PEAK: (u32, f32) = (3, 0.01);

/// A point as a beam saw it.
#[derive(Clone, Copy)]
struct Ray {
    scan: usize,
    distance_m: f32,
    z: f32,
    elevation_deg: f32,
    azimuth_rad: f32,
    /// Angle θ of the cone [deg].
    cone_deg: f32,
}

/// The beams, from the top; `None` if the elevations have no peaks.
pub fn rows(scans: &[Scan]) -> Option<Vec<BeamReturns>> {
    let mut rays = rays(scans);
    set_cones(&mut rays);
    // Neighbouring points are not independent of each other: sectors of azimuth are.
    let is_tested = |ray: &&Ray| (ray.azimuth_rad.to_degrees() / 4.0).floor() as i32 % 2 == 0;
    let tested: Vec<Ray> = rays.iter().filter(is_tested).copied().collect();
    let others: Vec<Ray> = rays.iter().filter(|ray| !is_tested(ray)).copied().collect();
    let fit = |&window: &usize| Fit::of(window, &peaks(&others, window), &tested);
    let fits: Vec<Fit> = WINDOWS.par_iter().map(fit).collect();
    let window = best_window(&fits)?;
    let peaks = peaks(&rays, window);
    (2..=MAX_BEAMS)
        .contains(&peaks.len())
        .then(|| beams_at(&peaks, &rays))
}

fn rays(scans: &[Scan]) -> Vec<Ray> {
    let mut rays = vec![];
    let mut order: Vec<usize> = (0..scans.len()).collect();
    order.sort_by_key(|&scan| usize::MAX - scans[scan].len());
    for scan in order {
        if !rays.is_empty() && rays.len() + scans[scan].len() > MAX_POINTS {
            break;
        }
        rays.extend(scans[scan].points.iter().map(|&point| {
            let [elevation_deg, azimuth_rad] = angles(point);
            Ray {
                scan,
                distance_m: point.truncate().length(),
                z: point.z,
                elevation_deg,
                azimuth_rad,
                cone_deg: elevation_deg,
            }
        }));
    }
    rays
}

/// Finds the offset of each band of elevation, and with it the angles of the cones.
fn set_cones(rays: &mut [Ray]) {
    const BAND_DEG: f32 = 2.0;
    rays.sort_by(|a, b| a.elevation_deg.total_cmp(&b.elevation_deg));
    let band = |ray: &Ray| (ray.elevation_deg / BAND_DEG).floor() as i32;
    let bands: Vec<&mut [Ray]> = rays.chunk_by_mut(|a, b| band(a) == band(b)).collect();
    bands.into_par_iter().for_each(|rays| {
        let offset_m = offset_m(rays);
        for ray in rays {
            ray.cone_deg = ray.cone(offset_m);
        }
    });
}

impl Ray {
    fn cone(&self, offset_m: f32) -> f32 {
        (self.z - offset_m).atan2(self.distance_m).to_degrees()
    }
}

/// The offset z₀ with the sharpest histogram, zero unless another is clearly sharper [m].
fn offset_m(rays: &[Ray]) -> f32 {
    const STEP_M: f32 = 0.01;
    const STEPS: i32 = 30;
    const BIN_DEG: f32 = 0.03;
    const MAX_RAYS: usize = 4000;
    const MIN_GAIN: f64 = 1.2;
    let sharpness = |offset_m: f32| -> f64 {
        let mut angles: Vec<i32> = (rays.iter().step_by(rays.len().div_ceil(MAX_RAYS)))
            .map(|ray| (ray.cone(offset_m) / BIN_DEG) as i32)
            .collect();
        angles.sort_unstable();
        let counts = angles.chunk_by(|a, b| a == b).map(<[i32]>::len);
        counts.map(|count| (count * count) as f64).sum()
    };
    let candidates = (-STEPS..=STEPS).map(|step| step as f32 * STEP_M);
    let best = candidates
        .map(|offset_m| (offset_m, sharpness(offset_m)))
        .max_by(|a, b| a.1.total_cmp(&b.1));
    match best {
        Some((offset_m, sharpest)) if sharpest > MIN_GAIN * sharpness(0.0) => offset_m,
        _ => 0.0,
    }
}

/// Angles at the peaks of the histogram, ascending [deg].
fn peaks(rays: &[Ray], window: usize) -> Vec<f32> {
    const BINS: usize = (180.0 / BIN_DEG) as usize;
    let mut bins = vec![0_u32; BINS + 1];
    for ray in rays {
        bins[((ray.cone_deg + 90.0) / BIN_DEG) as usize] += 1;
    }
    let mut peaks: Vec<(usize, u32)> = vec![];
    // The highest count since the last valley, or the lowest since the last peak.
    let (mut extreme, mut is_rising) = ((0, 0), false);
    let mut sum = 0;
    for end in 0..bins.len() + window {
        sum += bins.get(end).copied().unwrap_or(0);
        sum -= end.checked_sub(window).map_or(0, |start| bins[start]);
        if is_rising && 2 * (sum + 1) < extreme.1 + 1 {
            peaks.push(extreme);
            (extreme, is_rising) = ((end, sum), false);
        } else if !is_rising && sum + 1 > 2 * (extreme.1 + 1) {
            (extreme, is_rising) = ((end, sum), true);
        } else if is_rising == (sum > extreme.1) && sum != extreme.1 {
            extreme = (end, sum);
        }
    }
    let mut heights: Vec<f32> = peaks.iter().map(|peak| peak.1 as f32).collect();
    let least = MIN_PEAK
        .0
        .max((MIN_PEAK.1 * quantile(&mut heights, 0.5)) as u32);
    peaks.retain(|peak| peak.1 >= least);
    let heights: Vec<u32> = peaks.iter().map(|peak| peak.1).collect();
    let mut number = 0_usize;
    peaks.retain(|peak| {
        let neighbours = [number.wrapping_sub(1), number + 1].map(|other| heights.get(other));
        number += 1;
        !matches!(neighbours, [Some(a), Some(b)] if peak.1 < a.min(b) / STRAY)
    });
    // The window ends with its last bin.
    let angle = |(end, _)| (end as f32 + 1.0 - 0.5 * window as f32) * BIN_DEG - 90.0;
    peaks.into_iter().map(angle).collect()
}

/// Number of the peak above an angle, of the gap around it; the gaps at the ends are also those beyond.
fn gap(peaks: &[f32], angle_deg: f32) -> usize {
    let above = peaks.partition_point(|&peak| peak < angle_deg);
    above.clamp(1, peaks.len() - 1)
}

/// Index of the nearest peak if it is nearer than a quarter of the gap between the peaks around.
fn near(peaks: &[f32], angle_deg: f32) -> Option<usize> {
    let upper = gap(peaks, angle_deg);
    let gap_deg = peaks[upper] - peaks[upper - 1];
    [upper - 1, upper]
        .into_iter()
        .find(|&peak| (peaks[peak] - angle_deg).abs() < 0.25 * gap_deg)
}

/// How well the peaks of a window hold the points.
struct Fit {
    window: usize,
    peaks: usize,
    /// Share of the points that are near a peak.
    share: f64,
    /// The same between two neighbouring peaks, where it is smallest.
    least_share: f64,
}

impl Fit {
    fn of(window: usize, peaks: &[f32], rays: &[Ray]) -> Self {
        let mut fit = Self {
            window,
            peaks: peaks.len(),
            share: 0.0,
            least_share: 0.0,
        };
        if !(2..=MAX_BEAMS).contains(&peaks.len()) || rays.is_empty() {
            return fit;
        }
        // Points near a peak and all points, by the gap that they are in.
        let mut counts = vec![[0_u32; 2]; peaks.len() - 1];
        for ray in rays {
            let is_near = near(peaks, ray.cone_deg).is_some();
            let [near, all] = &mut counts[gap(peaks, ray.cone_deg) - 1];
            *near += u32::from(is_near);
            *all += 1;
        }
        let near: u32 = counts.iter().map(|count| count[0]).sum();
        fit.share = f64::from(near) / rays.len() as f64;
        let shares = (counts.iter()).map(|&[near, all]| f64::from(near) / f64::from(all.max(1)));
        fit.least_share = shares.fold(1.0, f64::min);
        fit
    }
}

/// The widest window whose share is as good as the best, or a narrower one that finds more peaks with
/// next to no point in any valley.
fn best_window(fits: &[Fit]) -> Option<usize> {
    let best = (fits.iter().map(|fit| fit.share)).fold(MIN_SHARE + SAME_SHARE, f64::max);
    let mut chosen: Option<&Fit> = None;
    for fit in fits
        .iter()
        .rev()
        .filter(|fit| fit.share >= best - SAME_SHARE)
    {
        let is_better = |wider: &Fit| fit.peaks > wider.peaks && fit.least_share >= CLEAN_SHARE;
        if chosen.is_none_or(is_better) {
            chosen = Some(fit);
        }
    }
    chosen.map(|fit| fit.window)
}

fn beams_at(peaks: &[f32], rays: &[Ray]) -> Vec<BeamReturns> {
    let first_scan = rays.iter().map(|ray| ray.scan).min();
    let mut beams = vec![(vec![], vec![]); peaks.len()];
    for ray in rays {
        let Some(peak) = near(peaks, ray.cone_deg) else {
            continue;
        };
        beams[peak].0.push([ray.distance_m, ray.elevation_deg]);
        if Some(ray.scan) == first_scan {
            beams[peak].1.push(ray.azimuth_rad);
        }
    }
    let mut beams: Vec<BeamReturns> = (beams.into_iter())
        .filter(|(returns, _)| !returns.is_empty())
        .map(|(mut returns, azimuths_rad)| BeamReturns {
            elevation_deg: elevation_deg(&mut returns),
            azimuths_rad,
        })
        .collect();
    beams.sort_by(|a, b| b.elevation_deg.total_cmp(&a.elevation_deg));
    beams.dedup_by(|lower, upper| lower.elevation_deg >= upper.elevation_deg);
    beams
}
