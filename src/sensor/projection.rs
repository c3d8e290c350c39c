//! The range image of a sensor, and its limits of range.
//!
//! With rows, each beam is a row, and there are as many columns as azimuth steps, up to the 2048 for which the
//! neighbourhoods of normals are made; sensors with finer steps lose every second return, which shares a pixel with another.
//! Without rows, pixels are squares of half the mean angular distance of the points,
//! of which few share a pixel,
//!
//! ```text
//! ½ √(Ω / n)       Ω: solid angle that has points
//! ```

use std::collections::BTreeSet;

use super::beam::{MAX_BEAMS, angles, quantile};
use super::beams::Beams;
use super::dropped::DroppedPoints;
use crate::lidar::{LidarModel, Scan, is_inside};

/// Columns of a range image, at most and at least.
const MAX_COLUMNS: usize = 2048;
const MIN_COLUMNS: usize = 90;

/// Share of the points between and next to the rows above which beams keep no elevation (unitless).
const MAX_OUTSIDE: f64 = 0.05;

/// The projection; that of KITTI's sensor for no points.
pub fn model(scans: &[Scan], beams: &Beams, columns: usize, own_car_m: [f32; 4]) -> LidarModel {
    if scans.iter().all(Scan::is_empty) {
        return LidarModel::default();
    }
    let (min_range, max_range) = range_limits(scans, own_car_m);
    let rows = match beams.rows.as_slice() {
        [] => rowless(scans),
        _ => of_beams(beams, columns),
    };
    let model = LidarModel {
        min_range,
        max_range,
        ..rows
    };
    let largest = scans.iter().max_by_key(|scan| scan.len());
    let lost = largest.map(|scan| DroppedPoints::count(scan, &model, own_car_m));
    match lost {
        Some(lost) if lost.outside_image as f64 > MAX_OUTSIDE * lost.points as f64 => {
            evenly(scans, model)
        }
        _ => model,
    }
}

/// Evenly spaced rows over all elevations, as many per angle: for beams whose elevations change along a revolution, because the
/// points are in a frame that is inclined to the sensor's, or compensated for fast motion.
fn evenly(scans: &[Scan], beams: LidarModel) -> LidarModel {
    let all = scans.iter().flat_map(|scan| &scan.points);
    let mut elevations: Vec<f32> = all.map(|&point| angles(point)[0]).collect();
    let [fov_up, fov_down] = [0.999, 0.001].map(|share| quantile(&mut elevations, share));
    let rows = beams.height as f32 * (fov_up - fov_down).to_radians() / beams.fov_rad();
    LidarModel {
        height: (rows.ceil() as usize).clamp(1, MAX_BEAMS),
        fov_up,
        fov_down,
        elevations: None,
        ..beams
    }
}

fn of_beams(beams: &Beams, columns: usize) -> LidarModel {
    /// Deviation from even rows, relative to their distance (unitless).
    const EVEN: f32 = 0.1;
    let elevations: Vec<f32> = beams.rows.iter().map(|row| row.elevation_deg).collect();
    let (top, bottom) = (elevations[0], elevations[elevations.len() - 1]);
    let step = (top - bottom) / (elevations.len() - 1).max(1) as f32;
    let even = |row: usize| top - row as f32 * step;
    let is_even = (elevations.iter().enumerate())
        .all(|(row, elevation)| (elevation - even(row)).abs() < EVEN * step);
    LidarModel {
        height: elevations.len(),
        width: columns.clamp(MIN_COLUMNS, MAX_COLUMNS),
        fov_up: (top + 0.5 * step).min(90.0),
        fov_down: (bottom - 0.5 * step).max(-90.0),
        elevations: (!is_even).then(|| elevations.into()),
        ..LidarModel::default()
    }
}

fn rowless(scans: &[Scan]) -> LidarModel {
    /// Edge of the cells that measure the solid angle [deg].
    const CELL_DEG: f32 = 4.0;
    const MAX_ROWS: f32 = 512.0;
    let largest = scans.iter().max_by_key(|scan| scan.len());
    let directions = || {
        largest
            .into_iter()
            .flat_map(|scan| &scan.points)
            .map(|&p| angles(p))
    };
    let cell = |[elevation_deg, azimuth_rad]: [f32; 2]| {
        let azimuth_deg = azimuth_rad.to_degrees();
        [elevation_deg, azimuth_deg].map(|deg| (deg / CELL_DEG).floor() as i32)
    };
    let cells: BTreeSet<[i32; 2]> = directions().map(cell).collect();
    let area = |[row, _]: &[i32; 2]| {
        let elevation_deg = (*row as f32 + 0.5) * CELL_DEG;
        CELL_DEG * CELL_DEG * elevation_deg.to_radians().cos().max(0.0)
    };
    let solid_angle: f32 = cells.iter().map(area).sum();
    let spacing_deg = 0.5 * (solid_angle / directions().count().max(1) as f32).sqrt();

    let all = || {
        scans
            .iter()
            .flat_map(|scan| &scan.points)
            .map(|&p| angles(p)[0])
    };
    let mut elevations: Vec<f32> = all().collect();
    let fov_up = (quantile(&mut elevations, 1.0) + spacing_deg).min(90.0);
    let fov_down = (quantile(&mut elevations, 0.0) - spacing_deg).max(-90.0);
    let columns = (360.0 / spacing_deg).round() as usize;
    LidarModel {
        height: ((fov_up - fov_down) / spacing_deg)
            .ceil()
            .clamp(1.0, MAX_ROWS) as usize,
        width: columns.clamp(MIN_COLUMNS, MAX_COLUMNS),
        fov_up,
        fov_down,
        ..LidarModel::default()
    }
}

/// Least and greatest range of a return [m].
///
/// The greatest is that of nearly all returns, between 50 and 120 m. In a building, where it would be less than 50 m, it is twice
/// that of nearly all returns, because the next room may be larger. The least is that of nearly all returns apart from the own car, but between 0.3 m, where housings and hands are, and 2 m.
fn range_limits(scans: &[Scan], own_car_m: [f32; 4]) -> (f32, f32) {
    const NEARLY_ALL: f64 = 0.99;
    /// Range of the HDL-64E and the OS1-64 by their data sheets [m].
    const FARTHEST_M: f32 = 120.0;
    let mut ranges: Vec<f32> = (scans.iter().flat_map(|scan| &scan.points))
        .filter(|point| !is_inside(**point, own_car_m))
        .map(|point| point.length())
        .collect();
    let nearest = quantile(&mut ranges, 0.1 * (1.0 - NEARLY_ALL));
    let farthest = quantile(&mut ranges, NEARLY_ALL);
    (
        (0.9 * nearest).clamp(0.3, 2.0),
        (2.0 * farthest).clamp(10.0, farthest.clamp(50.0, FARTHEST_M)),
    )
}
