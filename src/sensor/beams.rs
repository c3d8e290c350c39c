//! The beams of a sensor and their elevations.
//!
//! 1. *Rings*, the beam numbers of the points, if the points of a ring have nearly one elevation.
//! 2. *Order*: many files contain one revolution of a beam after the other. A revolution ends where the azimuth
//!    passes the place that no pair of neighbours on one beam crosses. This also holds for scans whose
//!    elevations are smeared by motion compensation or by lasers above one another.
//! 3. *Elevations*: peaks of the elevations, see [`elevations`](super::elevations), in any order of the points.
//!
//! A beam without returns is invisible. If the beams fade out at an edge, the number of beams is the next one
//! that is built.

use std::f32::consts::{PI, TAU};

use serde::{Deserialize, Serialize};

use super::beam::{BeamReturns, MAX_BEAMS, angles, elevation_deg, quantile};
use super::elevations;
use crate::lidar::Scan;

/// What the beams of a sensor follow from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum BeamSource {
    /// The sensor has no rows.
    #[default]
    None,
    /// Beam numbers of the points.
    Rings,
    /// Order of the points.
    Order,
    /// Peaks of the elevations.
    Elevations,
}

/// The beams of a sensor.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Beams {
    /// What they follow from.
    pub source: BeamSource,
    /// Those that returned, from the top.
    pub rows: Vec<BeamReturns>,
    /// Number of beams of the device; `None` without rows.
    pub nominal: Option<usize>,
}

/// Largest width of a ring that is one beam, relative to the distance between rings (unitless).
const NARROW: f32 = 0.6;
/// The same where nothing else shows beams: they may be smeared by motion compensation.
const SMEARED: f32 = 2.0;

/// Finds the beams.
pub fn find(scans: &[Scan]) -> Beams {
    let rings = by_rings(scans);
    let ring_rows = |widest: f32| {
        let rings = rings.as_ref().filter(|rings| rings.width < widest)?;
        Some((BeamSource::Rings, rings.rows.clone()))
    };
    let found = ring_rows(NARROW)
        .or_else(|| Some((BeamSource::Order, by_order_of_scans(scans)?)))
        .or_else(|| Some((BeamSource::Elevations, elevations::rows(scans)?)))
        .or_else(|| ring_rows(SMEARED));
    let Some((source, rows)) = found else {
        return Beams::default();
    };
    let numbered = match (source, &rings) {
        (BeamSource::Rings, Some(rings)) => rings.numbers,
        _ => 0,
    };
    Beams {
        source,
        nominal: Some(nominal(&rows).max(numbered)),
        rows,
    }
}

/// Beams by the rings of the points.
struct Rings {
    rows: Vec<BeamReturns>,
    /// Median width of a ring relative to its distance from the next (unitless).
    width: f32,
    /// Numbers of rings, from 0 or 1 to the last.
    numbers: usize,
}

fn by_rings(scans: &[Scan]) -> Option<Rings> {
    let largest = (0..scans.len()).max_by_key(|&scan| scans[scan].rings.len())?;
    let last = scans.iter().flat_map(|scan| &scan.rings).max()?;
    if usize::from(*last) >= MAX_BEAMS {
        return None;
    }
    let mut elevations = vec![vec![]; usize::from(*last) + 1];
    let mut rows = vec![BeamReturns::default(); elevations.len()];
    for (number, scan) in scans.iter().enumerate() {
        for (&point, &ring) in scan.points.iter().zip(&scan.rings) {
            let [degrees, azimuth_rad] = angles(point);
            let distance_m = point.truncate().length();
            elevations[usize::from(ring)].push([distance_m, degrees]);
            if number == largest {
                rows[usize::from(ring)].azimuths_rad.push(azimuth_rad);
            }
        }
    }
    let numbers = if elevations[0].is_empty() && BUILT.contains(&usize::from(*last)) {
        usize::from(*last)
    } else {
        elevations.len()
    };
    let mut found: Vec<(BeamReturns, f32)> = (rows.into_iter().zip(&mut elevations))
        .filter(|(_, elevations)| !elevations.is_empty())
        .map(|(mut row, returns)| {
            row.elevation_deg = elevation_deg(returns);
            let mut elevations: Vec<f32> = returns.iter().map(|far| far[1]).collect();
            let width = quantile(&mut elevations, 0.95) - quantile(&mut elevations, 0.05);
            (row, width)
        })
        .collect();
    found.sort_by(|a, b| b.0.elevation_deg.total_cmp(&a.0.elevation_deg));
    let mut widths: Vec<f32> = found
        .windows(2)
        .map(|pair| pair[0].1 / (pair[0].0.elevation_deg - pair[1].0.elevation_deg))
        .collect();
    Some(Rings {
        width: (found.len() > 1).then(|| quantile(&mut widths, 0.5))?,
        rows: merged(found.into_iter().map(|(row, _)| row).collect(), 1e-3),
        numbers,
    })
}

/// The rows of a scan with as many beams as most scans have; elevations are medians over all of these.
fn by_order_of_scans(scans: &[Scan]) -> Option<Vec<BeamReturns>> {
    let found: Vec<Vec<BeamReturns>> = scans.iter().filter_map(by_order).collect();
    let with = |beams: usize| found.iter().filter(move |rows| rows.len() == beams);
    let usual = (found.iter().map(Vec::len)).max_by_key(|&beams| (with(beams).count(), beams))?;
    let full: Vec<&Vec<BeamReturns>> = with(usual).collect();
    let mut rows = full[0].clone();
    for (number, row) in rows.iter_mut().enumerate() {
        let mut all: Vec<f32> = full.iter().map(|rows| rows[number].elevation_deg).collect();
        row.elevation_deg = quantile(&mut all, 0.5);
    }
    Some(rows)
}

/// Beams of points that are in the order of revolutions; `None` of others.
fn by_order(scan: &Scan) -> Option<Vec<BeamReturns>> {
    /// Share of the steps in the direction of the revolutions, at least (unitless).
    const MIN_FORWARD: f32 = 0.8;
    /// Median change of elevation from point to point, at most; neighbouring beams are farther apart [deg].
    const MAX_CHANGE_DEG: f32 = 0.1;
    /// Returns of a beam, on average and of each, at least.
    const MIN_RETURNS: [usize; 2] = [16, 8];
    let angles: Vec<[f32; 2]> = scan.points.iter().map(|&point| angles(point)).collect();
    let steps = || (angles.windows(2)).map(|pair| wrap(pair[1][1] - pair[0][1]));
    let forward = steps().filter(|&step| step > 0.0).count() as f32;
    let backward = steps().filter(|&step| step < 0.0).count() as f32;
    let sense = if forward > backward { 1.0 } else { -1.0 };
    if forward.max(backward) < MIN_FORWARD * angles.len() as f32 {
        return None;
    }
    let mut changes: Vec<f32> = (angles.windows(2))
        .map(|pair| (pair[1][0] - pair[0][0]).abs())
        .collect();
    let change_deg = quantile(&mut changes, 0.5);

    let start_rad = start_of_revolutions(&angles, sense, change_deg);
    let along = |azimuth_rad: f32| (sense * (azimuth_rad - start_rad)).rem_euclid(TAU);
    let mut first = 0;
    let revolutions: Vec<BeamReturns> = angles
        .chunk_by(|a, b| along(b[1]) > along(a[1]) - SEAM_RAD)
        .filter_map(|returns| {
            let points = &scan.points[first..first + returns.len()];
            first += returns.len();
            let distances = points.iter().map(|point| point.truncate().length());
            let elevations = distances.zip(returns).map(|(m, angles)| [m, angles[0]]);
            (returns.len() >= MIN_RETURNS[1]).then(|| BeamReturns {
                elevation_deg: elevation_deg(&mut elevations.collect::<Vec<_>>()),
                azimuths_rad: returns.iter().map(|angles| angles[1]).collect(),
            })
        })
        .collect();
    if !(2..=MAX_BEAMS).contains(&revolutions.len())
        || revolutions.len() * MIN_RETURNS[0] > angles.len()
    {
        return None;
    }
    let spacing_deg = median_spacing(&revolutions);
    (change_deg < MAX_CHANGE_DEG.min(0.25 * spacing_deg))
        .then(|| merged(revolutions, 0.25 * spacing_deg))
}

/// Backward steps of the azimuth that end no revolution [rad]: the ends of a sweep overlap where it was compensated for
/// motion, by up to 0.17 on the motorway of KITTI 01. Those that end one are a turn without what did not return, 0.26 or
/// more in KITTI 00, whose uppermost beams have few returns.
const SEAM_RAD: f32 = 0.2;

/// The azimuth that is crossed by the fewest pairs of successive points of about one elevation [rad].
fn start_of_revolutions(angles: &[[f32; 2]], sense: f32, change_deg: f32) -> f32 {
    const BINS: usize = 360;
    let width_rad = TAU / BINS as f32;
    let mut crossings = vec![0_u32; BINS];
    for pair in angles.windows(2) {
        let step = sense * wrap(pair[1][1] - pair[0][1]);
        let same_beam = (pair[1][0] - pair[0][0]).abs() <= 10.0 * change_deg;
        if !same_beam || !(0.0..1.0).contains(&step) {
            continue;
        }
        let from = if sense > 0.0 { pair[0][1] } else { pair[1][1] };
        let first = (from.rem_euclid(TAU) / width_rad).ceil() as usize;
        let end = ((from.rem_euclid(TAU) + step) / width_rad).floor() as usize;
        (first..=end).for_each(|bin| crossings[bin % BINS] += 1);
    }
    let start = (0..BINS).min_by_key(|&bin| crossings[bin]);
    start.unwrap_or(0) as f32 * width_rad
}

fn wrap(angle_rad: f32) -> f32 {
    (angle_rad + PI).rem_euclid(TAU) - PI
}

/// Median difference of elevation between neighbouring beams [deg].
fn median_spacing(beams: &[BeamReturns]) -> f32 {
    let mut elevations: Vec<f32> = beams.iter().map(|beam| beam.elevation_deg).collect();
    elevations.sort_by(f32::total_cmp);
    let mut gaps: Vec<f32> = elevations
        .windows(2)
        .map(|pair| pair[1] - pair[0])
        .collect();
    quantile(&mut gaps, 0.5)
}

/// Beams from the top; those closer than `min_gap_deg` are one.
fn merged(mut beams: Vec<BeamReturns>, min_gap_deg: f32) -> Vec<BeamReturns> {
    beams.sort_by(|a, b| b.elevation_deg.total_cmp(&a.elevation_deg));
    beams.dedup_by(|lower, upper| {
        let same = upper.elevation_deg - lower.elevation_deg < min_gap_deg;
        if same {
            upper.azimuths_rad.append(&mut lower.azimuths_rad);
        }
        same
    });
    beams
}

/// Numbers of beams of the sensors that are built.
const BUILT: [usize; 10] = [1, 2, 4, 8, 16, 32, 40, 64, 128, 256];

/// Number of beams of the device: as many as returned, or the next number that is built if it is almost
/// reached or the beams at an edge have few returns, so that others have none.
fn nominal(rows: &[BeamReturns]) -> usize {
    let mut counts: Vec<f32> = rows
        .iter()
        .map(|row| row.azimuths_rad.len() as f32)
        .collect();
    let (first, last) = (counts[0], counts[rows.len() - 1]);
    let fades = first.min(last) < 0.5 * quantile(&mut counts, 0.5);
    let built = BUILT.into_iter().find(|&built| built >= rows.len());
    match built {
        Some(built) if fades || 25 * rows.len() >= 24 * built => built,
        _ => rows.len(),
    }
}
