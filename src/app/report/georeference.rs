//! The place of a map on the Earth, for reports and tables.

use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::Serialize;

use crate::georeference::{AlignedPath, AlignmentSummary, Georeference, ProjectionError};

/// The place of a map on the Earth.
#[derive(Clone, Debug, Serialize, JsonSchema)]
pub struct GeoreferenceReport {
    /// Origin, rotation and accuracy.
    #[serde(flatten)]
    georeference: Georeference,
    /// Code of the zone of UTM in the EPSG registry.
    epsg: u32,
    /// Easting of the origin [m].
    easting_m: f64,
    /// Northing of the origin [m].
    northing_m: f64,
    /// Direction of the x axis of the map in the grid of UTM, from east, counter-clockwise [deg].
    grid_yaw_deg: f64,
    /// The fixes from which it follows; `None` of a map that is read.
    fixes: Option<AlignmentSummary>,
}

impl GeoreferenceReport {
    /// The report of an alignment.
    pub fn new(found: &AlignedPath) -> Result<Self, ProjectionError> {
        Ok(Self {
            fixes: Some(found.summary.clone()),
            ..Self::of(&found.georeference)?
        })
    }

    /// The report of a map that is read.
    pub fn of(georeference: &Georeference) -> Result<Self, ProjectionError> {
        let earth = georeference.on_earth()?;
        let [easting_m, northing_m, _] = earth.utm(&Vector3::zeros())?;
        Ok(Self {
            epsg: georeference.utm.epsg(),
            easting_m,
            northing_m,
            grid_yaw_deg: earth.grid_yaw_rad()?.to_degrees(),
            georeference: georeference.clone(),
            fixes: None,
        })
    }

    /// Rows of the table on standard output.
    pub fn rows(&self) -> Vec<(&'static str, String)> {
        let at = &self.georeference;
        let origin = format!(
            "latitude {:.8}, longitude {:.8} deg, {:.2} m above {}",
            at.latitude_deg,
            at.longitude_deg,
            at.height_m,
            at.height_above.name()
        );
        let hemisphere = if at.utm.is_south { "south" } else { "north" };
        let utm = format!(
            "zone {} {hemisphere} (EPSG:{}), easting {:.2}, northing {:.2} m",
            at.utm.number, self.epsg, self.easting_m, self.northing_m
        );
        let axes = format!(
            "x axis {:.3} deg from grid east, {:.3} deg from true east",
            self.grid_yaw_deg, at.yaw_deg
        );
        let accuracy = format!(
            "{:.2} m horizontally, {:.2} m vertically, {:.3} deg (standard deviations)",
            at.horizontal_m, at.vertical_m, at.heading_deg
        );
        let mut rows = vec![
            ("origin on the Earth", origin),
            ("UTM", utm),
            ("axes", axes),
            ("accuracy on the Earth", accuracy),
        ];
        rows.extend(self.fixes.as_ref().map(|fixes| {
            let text = format!(
                "{}, {} outliers; from the path {:.2} m horizontally, {:.2} m vertically (RMS)",
                fixes.fixes, fixes.outliers, fixes.horizontal_rms_m, fixes.vertical_rms_m
            );
            ("GNSS fixes", text)
        }));
        rows
    }
}
