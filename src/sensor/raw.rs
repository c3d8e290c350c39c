//! Whether scans are as measured, from the elevations of their beams.
//!
//! Noise moves a point along its beam, so that the points of a beam as measured lie on a cone, in the plane of
//! distance d and height z on a line, exact to the rounding of coordinates. Motion compensation moves them sideways,
//! most at the ends of the sweep. A motion by s during a revolution leaves them at a horizontal distance from their cone of
//!
//! ```text
//! s |cos α| |α| / 2π      α: azimuth from the middle of the sweep; median 0.09 s
//! ```
//!
//! The scans of drive 0005 of KITTI, in millimetres, have medians of 1.5 to 2.1 mm, those of an HDL-32 and a VLP-16 in
//! single precision less than 0.01 mm; those of KITTI's odometry 01, compensated, 158 to 228 mm, and of nuScenes 45 to 95 mm.

use super::beam::quantile;
use crate::lidar::{LidarModel, Projection, Scan};

/// Largest median of the distances of points as measured from the cones of their beams: twice that of coordinates in
/// millimetres, or that of scans compensated for a motion by 4 cm during a revolution [m].
const EXACT_M: f32 = 0.004;

/// Whether all of some scans with rows are as measured; compensated scans of a sensor at rest are, too.
pub fn are_raw(scans: &[Scan], rows: &LidarModel) -> bool {
    let mut distances = scans
        .iter()
        .map(|scan| cone_distance_m(scan, rows))
        .peekable();
    distances.peek().is_some() && distances.all(|m| m.is_some_and(|m| m < EXACT_M))
}

/// Median horizontal distance of the points from the cones of their beams [m]; `None` if no beam shows it.
fn cone_distance_m(scan: &Scan, rows: &LidarModel) -> Option<f32> {
    /// Points of a beam, at least.
    const MIN_POINTS: usize = 32;
    /// Distance over which a cone is seen, at least [m].
    const MIN_LENGTH_M: f32 = 1.0;
    /// Slope of a cone on which horizontal motion is seen, at least (unitless).
    const MIN_SLOPE: f32 = 0.05;
    let mut distances_m = vec![];
    for points in &mut by_beam(scan, rows) {
        if points.len() < MIN_POINTS {
            continue;
        }
        points.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let (near, far) = points.split_at(points.len() / 2);
        let mean = |half: &[[f32; 2]]| {
            [0, 1].map(|axis| {
                let sum: f64 = half.iter().map(|point| f64::from(point[axis])).sum();
                (sum / half.len() as f64) as f32
            })
        };
        let (near, far) = (mean(near), mean(far));
        let slope = (far[1] - near[1]) / (far[0] - near[0]);
        if far[0] - near[0] > MIN_LENGTH_M && slope.abs() > MIN_SLOPE {
            let off = |point: &[f32; 2]| point[0] - near[0] - (point[1] - near[1]) / slope;
            distances_m.extend(points.iter().map(|point| off(point).abs()));
        }
    }
    (!distances_m.is_empty()).then(|| quantile(&mut distances_m, 0.5))
}

/// Distance and height of the points of each beam, by rings or else by the rows of their elevations [m].
fn by_beam(scan: &Scan, rows: &LidarModel) -> Vec<Vec<[f32; 2]>> {
    let mut beams: Vec<Vec<[f32; 2]>> = vec![];
    let projection = Projection::of(rows);
    for (number, &point) in scan.points.iter().enumerate() {
        let beam = match scan.rings.get(number) {
            Some(&ring) => Some(usize::from(ring)),
            None => projection.pixel_of(point).map(|pixel| pixel / rows.width),
        };
        let Some(beam) = beam else {
            continue;
        };
        if beam >= beams.len() {
            beams.resize(beam + 1, vec![]);
        }
        beams[beam].push([point.truncate().length(), point.z]);
    }
    beams
}
