//! Sense and period of rotation.
//!
//! For a sensor that turns once in a period T, azimuth and time of a point satisfy α = α₀ ± 2π t / T. The
//! sense is the one for which the directions α ∓ 2π t / T agree: their mean vector is long.

use std::f64::consts::TAU;

use super::beam::angles;
use crate::lidar::{RotationDirection, Scan};
use crate::statistics::median;

/// Shortest and longest period of sensors [s].
const PERIODS_S: std::ops::RangeInclusive<f64> = 0.019..=0.22;

/// Duration of a revolution: the time in which the points of a scan were measured, if they surround the sensor.
pub fn period_s(scans: &[Scan], horizontal_fov_deg: f32) -> Option<f64> {
    let sweeps = scans.iter().filter_map(|scan| {
        let (first, last) = bounds(scan)?;
        (horizontal_fov_deg == 360.0).then_some(last - first)
    });
    median(sweeps).filter(|period_s| PERIODS_S.contains(period_s))
}

/// Duration of a revolution or frame: the interval between scans with consecutive numbers, of scans with their numbers
/// and times, ascending [s].
pub fn interval_s(numbered: &[(usize, f64)]) -> Option<f64> {
    let intervals = numbered.windows(2).map(|pair| {
        let [(before, before_s), (number, time_s)] = [pair[0], pair[1]];
        (time_s - before_s) / (number - before) as f64
    });
    median(intervals).filter(|period_s| PERIODS_S.contains(period_s))
}

/// Sense of rotation by the times of the points.
pub fn direction(scans: &[Scan], horizontal_fov_deg: f32) -> Option<RotationDirection> {
    const LONG: f64 = 0.9;
    let scan = scans.iter().find(|scan| bounds(scan).is_some())?;
    let (first, last) = bounds(scan)?;
    // Not the period of the scans: they may be a subset.
    let period_s = (last - first) * 360.0 / f64::from(horizontal_fov_deg);
    let agreement = |sense: f64| {
        let (mut sin, mut cos) = (0.0, 0.0);
        for (&point, &time_s) in scan.points.iter().zip(&scan.times_s) {
            let phase = f64::from(angles(point)[1]) - sense * TAU * f64::from(time_s) / period_s;
            (sin, cos) = (sin + phase.sin(), cos + phase.cos());
        }
        f64::hypot(sin, cos) / scan.len() as f64
    };
    let (clockwise, counter) = (agreement(-1.0), agreement(1.0));
    match (clockwise > LONG, counter > LONG) {
        (true, false) => Some(RotationDirection::Clockwise),
        (false, true) => Some(RotationDirection::CounterClockwise),
        _ => None,
    }
}

/// First and last time of the points; `None` if they have no different times.
fn bounds(scan: &Scan) -> Option<(f64, f64)> {
    let times = || scan.times_s.iter().map(|&time_s| f64::from(time_s));
    let (first, last) = (times().reduce(f64::min)?, times().reduce(f64::max)?);
    (first < last && last - first < 1e3).then_some((first, last))
}
