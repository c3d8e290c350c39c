//! Paths as GeoJSON (RFC 7946): longitude, latitude and height of WGS84.

use std::io::{self, Write};

use serde::Serialize;

use super::{Georeference, HeightReference, ProjectionError};
use crate::geometry::StampedPose;

/// Writes poses in the map as one feature: a line string, or several where poses between are missing, with the times of
/// the poses in the property `times_s`.
///
/// # Errors
/// The writer fails, or a pose is not on the Earth.
pub fn write_geojson(
    mut writer: impl Write,
    georeference: &Georeference,
    stretches: &[Vec<StampedPose>],
) -> io::Result<()> {
    let lines = coordinates(georeference, stretches).map_err(io::Error::other)?;
    // A line has two positions or more.
    let is_line = |line: &&Vec<[f64; 3]>| line.len() > 1;
    let lines: Vec<_> = lines.iter().filter(is_line).collect();
    let times_s: Vec<Vec<f64>> = (stretches.iter())
        .filter(|stretch| stretch.len() > 1)
        .map(|stretch| stretch.iter().map(|pose| pose.time_s).collect())
        .collect();
    match (lines.as_slice(), times_s.as_slice()) {
        ([line], [times_s]) => {
            let feature = Feature::new("LineString", line, times_s, georeference);
            serde_json::to_writer(&mut writer, &feature)?;
        }
        _ => {
            let feature = Feature::new("MultiLineString", &lines, &times_s, georeference);
            serde_json::to_writer(&mut writer, &feature)?;
        }
    }
    writeln!(writer)
}

#[derive(Serialize)]
struct Feature<'a, C, T> {
    geometry: Geometry<C>,
    properties: Properties<'a, T>,
    r#type: &'static str,
}

#[derive(Serialize)]
struct Geometry<C> {
    coordinates: C,
    r#type: &'static str,
}

#[derive(Serialize)]
struct Properties<'a, T> {
    /// The place of the map on the Earth, with its zone of UTM.
    georeference: &'a Georeference,
    height_above: HeightReference,
    times_s: T,
}

impl<'a, C, T> Feature<'a, C, T> {
    fn new(kind: &'static str, coordinates: C, times_s: T, georeference: &'a Georeference) -> Self {
        Self {
            geometry: Geometry {
                coordinates,
                r#type: kind,
            },
            properties: Properties {
                georeference,
                height_above: georeference.height_above,
                times_s,
            },
            r#type: "Feature",
        }
    }
}

/// Longitude and latitude to 0.1 mm [deg], and height to 1 mm [m].
fn coordinates(
    georeference: &Georeference,
    stretches: &[Vec<StampedPose>],
) -> Result<Vec<Vec<[f64; 3]>>, ProjectionError> {
    let earth = georeference.on_earth()?;
    let rounded = |value: f64, scale: f64| (value * scale).round() / scale;
    let coordinate = |pose: &StampedPose| {
        let at = earth.geodetic(&pose.map_from_lidar.translation.vector)?;
        Ok([
            rounded(at.longitude_deg, 1e9),
            rounded(at.latitude_deg, 1e9),
            rounded(at.height_m, 1e3),
        ])
    };
    (stretches.iter())
        .map(|stretch| stretch.iter().map(coordinate).collect())
        .collect()
}
