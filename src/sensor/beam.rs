//! A beam as seen in scans: directions of points, medians.

use glam::Vec3;

/// Largest number of beams.
pub const MAX_BEAMS: usize = 512;

/// The returns of a beam.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BeamReturns {
    /// Elevation [deg].
    pub elevation_deg: f32,
    /// Azimuths of the returns in one scan [rad].
    pub azimuths_rad: Vec<f32>,
}

/// Elevation [deg] of a beam with returns at distances [m] and elevations [deg]: the median of the farther half. Lasers
/// next to the origin of the lidar frame, and motion, change the elevations of near returns.
pub fn elevation_deg(returns: &mut [[f32; 2]]) -> f32 {
    returns.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let far = &returns[returns.len() / 2..];
    quantile(&mut far.iter().map(|far| far[1]).collect::<Vec<f32>>(), 0.5)
}

/// Elevation [deg] and azimuth [rad] of a point.
pub fn angles(point: Vec3) -> [f32; 2] {
    let elevation = point.z.atan2(point.truncate().length());
    [elevation.to_degrees(), point.y.atan2(point.x)]
}

/// The value that a share of the values lie below; 0 of none.
pub fn quantile(values: &mut [f32], share: f64) -> f32 {
    if values.is_empty() {
        return 0.0;
    }
    let index = ((values.len() - 1) as f64 * share).round() as usize;
    *values.select_nth_unstable_by(index, f32::total_cmp).1
}
