//! Ranges of panoramas in whole centimetres, and a scan as a panorama.

use glam::Vec3;

use crate::geometry::Rigid3f;
use crate::lidar::{LidarModel, Projection, RangeImage};
use crate::map::ground::elevation::SensorAttitude;

/// Resolution of ranges [m].
pub(crate) const STEP_M: f32 = 0.01;
/// Limits of differences are at most this [m].
pub(crate) const MOST_LIMIT_M: f32 = 200.0;
/// A pixel of a scan without a return: it differs from every range by more than any limit.
pub(crate) const NOTHING: u16 = 0;
/// A pixel of a panorama without a surface: likewise.
pub(crate) const FAR: u16 = u16::MAX;
/// A range of zero.
const NEAREST: u16 = 20_000;
/// Longer ranges are cut off [steps].
const LONGEST: f32 = 25_000.0;

/// A range as a number of steps.
pub(crate) fn steps_of(range_m: f32) -> u16 {
    NEAREST + (range_m / STEP_M).round().clamp(0.0, LONGEST) as u16
}

/// The range of a pixel [m]; that of a pixel without a surface is long.
pub(crate) fn metres_of(steps: u16) -> f32 {
    f32::from(steps.saturating_sub(NEAREST)) * STEP_M
}

/// Limit of a difference [steps].
pub(crate) fn limit_of(limit_m: f32) -> u16 {
    (limit_m / STEP_M).round() as u16
}

/// Returns every `step`-th column of rows of a width.
pub(crate) fn thinned(rows: &[u16], width: usize, step: usize) -> Vec<u16> {
    rows.chunks(width)
        .flat_map(|row| row.iter().copied().step_by(step))
        .collect()
}

/// A scan as a level panorama with each row repeated, so that a shift is a slice.
pub(crate) struct ScanPanorama {
    /// Columns of a panorama.
    pub width: usize,
    /// [Steps](STEP_M).
    pub ranges: Vec<u16>,
}

impl ScanPanorama {
    /// Takes the return nearest to the centre of each pixel. Pixels without a return differ from every
    /// range by the limit, at all headings.
    pub fn new(scan: &RangeImage, attitude: &SensorAttitude, model: &LidarModel) -> Self {
        let road_from_lidar = Rigid3f::from(&attitude.road_from_lidar());
        let (directions, projection) = (model.directions(), Projection::of(model));
        let mut nearest = vec![(-1.0_f32, NOTHING); model.len()];
        for beam in scan.beams() {
            let direction: Vec3 = road_from_lidar.rotate(beam.direction);
            let Some(index) = projection.pixel_of(direction) else {
                continue;
            };
            let closeness = direction.dot(directions[index]);
            if closeness > nearest[index].0 {
                nearest[index] = (closeness, steps_of(beam.range_m));
            }
        }
        let ranges = nearest
            .chunks(model.width)
            .flat_map(|row| row.iter().chain(row))
            .map(|&(_, range)| range)
            .collect();
        Self {
            width: model.width,
            ranges,
        }
    }

    /// Returns every `step`-th column.
    pub fn thinned(&self, step: usize) -> Self {
        Self {
            width: self.width.div_ceil(step),
            ranges: thinned(&self.ranges, self.width, step),
        }
    }
}
