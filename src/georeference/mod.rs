//! Where a map is on the Earth: fixes of a GNSS receiver, and the georeference that follows from them.
//!
//! ```text
//! p_ecef = ecef_from_enu(origin) · enu_from_map · p_map
//! ```
//!
//! [`align`] finds the rotation and the origin from a path in the map and [`GeodeticFixes`];
//! [`Georeference::on_earth`] converts points of the map to WGS84 and UTM, and back.

mod alignment;
mod earth;
mod fix;
mod geojson;

pub(crate) use alignment::robust_weights;
pub use alignment::{
    AlignedPath, AlignmentError, AlignmentSummary, FixTarget, GnssConfig, PathOverTime, align,
};
pub use earth::{Geodetic, ProjectionError, UtmZone, Wgs84};
pub use fix::{GeodeticFix, GeodeticFixes, HeightReference};
pub use geojson::write_geojson;

use nalgebra::{Point3, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::{Pose3, pose_from_degrees};
use crate::validation::{InvalidValue, Validate, in_range};

/// The place of a map on the Earth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct Georeference {
    /// Latitude of the map's origin [deg].
    pub latitude_deg: f64,
    /// Longitude of the map's origin [deg].
    pub longitude_deg: f64,
    /// Height of the map's origin [m].
    pub height_m: f64,
    /// What heights are above.
    pub height_above: HeightReference,
    /// Rotation from the map to east, north and up at its origin, about fixed axes x, y, z [deg].
    pub roll_deg: f64,
    /// The same about y.
    pub pitch_deg: f64,
    /// The same about z: from east to the x axis of the map, counter-clockwise.
    pub yaw_deg: f64,
    /// The zone of UTM of the whole map.
    pub utm: UtmZone,
    /// Standard deviation of the horizontal position in the middle of the path [m].
    pub horizontal_m: f64,
    /// The same of the height [m].
    pub vertical_m: f64,
    /// Standard deviation of the yaw [deg].
    pub heading_deg: f64,
}

impl Validate for Georeference {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("latitude_deg", self.latitude_deg, -90.0..=90.0)?;
        in_range("longitude_deg", self.longitude_deg, -180.0..=180.0)?;
        in_range("height_m", self.height_m, -1e5..=1e5)?;
        in_range("roll_deg", self.roll_deg, -360.0..=360.0)?;
        in_range("pitch_deg", self.pitch_deg, -360.0..=360.0)?;
        in_range("yaw_deg", self.yaw_deg, -360.0..=360.0)?;
        in_range("utm.number", self.utm.number, 1..=60)
    }
}

impl Georeference {
    /// Conversions of points of the map.
    ///
    /// # Errors
    /// The origin is not on the Earth.
    pub fn on_earth(&self) -> Result<MapOnEarth, ProjectionError> {
        let wgs84 = Wgs84::new()?;
        let origin = Geodetic {
            latitude_deg: self.latitude_deg,
            longitude_deg: self.longitude_deg,
            height_m: self.height_m,
        };
        let rotation = [self.roll_deg, self.pitch_deg, self.yaw_deg];
        let [roll, pitch, yaw] = rotation;
        let enu_from_map = pose_from_degrees([0.0, 0.0, 0.0, roll, pitch, yaw]);
        Ok(MapOnEarth {
            ecef_from_map: wgs84.ecef_from_enu(&origin)? * enu_from_map,
            utm: self.utm,
            wgs84,
        })
    }
}

/// Conversions between a map and the Earth.
#[derive(Debug)]
pub struct MapOnEarth {
    ecef_from_map: Pose3,
    utm: UtmZone,
    wgs84: Wgs84,
}

impl MapOnEarth {
    /// The position of a point of the map.
    ///
    /// # Errors
    /// The point is at the centre of the Earth.
    pub fn geodetic(&self, point_in_map: &Vector3<f64>) -> Result<Geodetic, ProjectionError> {
        let ecef = self.ecef_from_map * Point3::from(*point_in_map);
        self.wgs84.geodetic(&ecef.coords)
    }

    /// Easting, northing and height of a point of the map, in the zone of the map [m].
    ///
    /// # Errors
    /// The point is too far from the zone.
    pub fn utm(&self, point_in_map: &Vector3<f64>) -> Result<[f64; 3], ProjectionError> {
        let position = self.geodetic(point_in_map)?;
        let [easting_m, northing_m] = self.wgs84.utm(self.utm, &position)?;
        Ok([easting_m, northing_m, position.height_m])
    }

    /// The point of the map at a position.
    ///
    /// # Errors
    /// The latitude is beyond a pole.
    pub fn point_in_map(&self, position: &Geodetic) -> Result<Vector3<f64>, ProjectionError> {
        let ecef = Point3::from(self.wgs84.ecef(position)?);
        Ok((self.ecef_from_map.inverse() * ecef).coords)
    }

    /// Direction of the x axis of the map in the grid of UTM, from east, counter-clockwise [rad].
    ///
    /// # Errors
    /// The origin is too far from the zone.
    pub fn grid_yaw_rad(&self) -> Result<f64, ProjectionError> {
        let [from, to] = [0.0, 100.0].map(|x_m| self.utm(&Vector3::new(x_m, 0.0, 0.0)));
        let (from, to) = (from?, to?);
        Ok((to[1] - from[1]).atan2(to[0] - from[0]))
    }
}
