//! Azimuth steps and the horizontal field of view.

use std::f32::consts::TAU;

use super::beam::{angles, quantile};
use super::beams::Beams;
use crate::lidar::Scan;

/// Azimuth steps of a beam per revolution, from the median difference of azimuth between neighbouring returns;
/// 0 without rows. Differences below that of any sensor are those of two returns of one pulse.
pub fn count(beams: &Beams) -> usize {
    const LEAST_RAD: f32 = TAU / 20_000.0;
    const LARGEST_RAD: f32 = TAU / 36.0;
    let mut steps = vec![];
    for row in &beams.rows {
        let mut azimuths = row.azimuths_rad.clone();
        azimuths.sort_by(f32::total_cmp);
        let differences = azimuths.windows(2).map(|pair| pair[1] - pair[0]);
        steps.extend(differences.filter(|step| (LEAST_RAD..LARGEST_RAD).contains(step)));
    }
    if steps.is_empty() {
        return 0;
    }
    (TAU / quantile(&mut steps, 0.5)).round() as usize
}

/// Horizontal field of view [deg]: 360 without the largest sector that no scan has points in, if it is wide.
pub fn horizontal_fov_deg(scans: &[Scan]) -> f32 {
    const LEAST_GAP_DEG: usize = 20;
    let mut is_seen = [false; 360];
    for &point in scans.iter().flat_map(|scan| &scan.points) {
        is_seen[angles(point)[1].to_degrees().rem_euclid(360.0) as usize % 360] = true;
    }
    let (mut gap, mut widest) = (0, 0);
    for bin in 0..2 * is_seen.len() {
        gap = if is_seen[bin % 360] { 0 } else { gap + 1 };
        widest = widest.max(gap);
    }
    if widest < LEAST_GAP_DEG {
        return 360.0;
    }
    360_usize.saturating_sub(widest) as f32
}
