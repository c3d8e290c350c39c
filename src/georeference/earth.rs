//! Coordinates on the Earth: geodetic, Earth-centred, local level and UTM, all of WGS84.
//!
//! ```text
//! p_ecef = ecef_from_enu · p_enu        columns of the rotation: east, north, up at latitude φ and longitude λ
//! east  = (−sin λ, cos λ, 0)    north = (−sin φ cos λ, −sin φ sin λ, cos φ)    up = (cos φ cos λ, cos φ sin λ, sin φ)
//! ```
//!
//! A map is a rigid body in Earth-centred coordinates: neither the scale of UTM, 4 cm in 100 m, nor the curvature of the
//! Earth, 8 cm in 1 km, is in it. Projections are those of proj4rs, a port of PROJ: Poder and Engsager's transverse Mercator.

use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use proj4rs::errors::Error;
use proj4rs::proj::Proj;
use proj4rs::transform::transform;
use serde::{Deserialize, Serialize};

use crate::geometry::Pose3;

/// A position on the Earth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Geodetic {
    /// Latitude, north is positive [deg].
    pub latitude_deg: f64,
    /// Longitude, east is positive [deg].
    pub longitude_deg: f64,
    /// Height [m].
    pub height_m: f64,
}

/// A position that cannot be projected.
#[derive(Debug, thiserror::Error)]
#[error("a position cannot be projected: {0}; give positions of WGS84 on the Earth's surface")]
pub struct ProjectionError(#[from] Error);

/// A zone of UTM.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
pub struct UtmZone {
    /// Number, 1 to 60.
    pub number: u8,
    /// Whether northings count from 10,000 km south of the equator.
    pub is_south: bool,
}

impl UtmZone {
    /// The zone of a position, with the exceptions of Norway and Svalbard.
    pub fn of(position: &Geodetic) -> Self {
        let (lat, lon) = (position.latitude_deg, position.longitude_deg);
        let lon = (lon + 180.0).rem_euclid(360.0) - 180.0;
        let regular = ((lon + 180.0) / 6.0) as u8 + 1;
        let number = if (56.0..64.0).contains(&lat) && (3.0..12.0).contains(&lon) {
            32
        } else if (72.0..84.0).contains(&lat) && (0.0..42.0).contains(&lon) {
            match lon {
                lon if lon < 9.0 => 31,
                lon if lon < 21.0 => 33,
                lon if lon < 33.0 => 35,
                _ => 37,
            }
        } else {
            regular.min(60)
        };
        Self {
            number,
            is_south: lat < 0.0,
        }
    }

    /// Its code in the EPSG registry, 32601 to 32760.
    pub fn epsg(self) -> u32 {
        (if self.is_south { 32700 } else { 32600 }) + u32::from(self.number)
    }
}

/// Conversions between Earth-centred, geodetic and UTM coordinates.
#[derive(Debug)]
pub struct Wgs84 {
    geodetic: Proj,
    geocentric: Proj,
}

impl Wgs84 {
    /// The conversions.
    ///
    /// # Errors
    /// None, but for those of the library.
    pub fn new() -> Result<Self, ProjectionError> {
        Ok(Self {
            geodetic: Proj::from_proj_string("+proj=longlat +datum=WGS84 +no_defs")?,
            geocentric: Proj::from_proj_string("+proj=geocent +datum=WGS84 +units=m +no_defs")?,
        })
    }

    /// Earth-centred coordinates of a position [m].
    ///
    /// # Errors
    /// The latitude is beyond a pole.
    pub fn ecef(&self, position: &Geodetic) -> Result<Vector3<f64>, ProjectionError> {
        let mut point = radians(position);
        transform(&self.geodetic, &self.geocentric, &mut point)?;
        Ok(Vector3::new(point.0, point.1, point.2))
    }

    /// The position with Earth-centred coordinates [m].
    ///
    /// # Errors
    /// The point is at the centre of the Earth.
    pub fn geodetic(&self, ecef: &Vector3<f64>) -> Result<Geodetic, ProjectionError> {
        let mut point = (ecef.x, ecef.y, ecef.z);
        transform(&self.geocentric, &self.geodetic, &mut point)?;
        Ok(degrees(point))
    }

    /// Easting and northing in a zone, which need not be that of the position [m].
    ///
    /// # Errors
    /// The position is too far from the zone.
    pub fn utm(&self, zone: UtmZone, position: &Geodetic) -> Result<[f64; 2], ProjectionError> {
        let mut point = radians(position);
        transform(&self.geodetic, &projection(zone)?, &mut point)?;
        Ok([point.0, point.1])
    }

    /// The position at an easting and a northing of a zone, at a height [m].
    ///
    /// # Errors
    /// The coordinates are outside of the projection.
    pub fn from_utm(
        &self,
        zone: UtmZone,
        [easting_m, northing_m, height_m]: [f64; 3],
    ) -> Result<Geodetic, ProjectionError> {
        let mut point = (easting_m, northing_m, height_m);
        transform(&projection(zone)?, &self.geodetic, &mut point)?;
        Ok(degrees(point))
    }

    /// `p_ecef = ecef_from_enu * p_enu` of the level frame at a position: x east, y north, z up.
    ///
    /// # Errors
    /// The latitude is beyond a pole.
    pub fn ecef_from_enu(&self, position: &Geodetic) -> Result<Pose3, ProjectionError> {
        let translation = Translation3::from(self.ecef(position)?);
        Ok(Pose3::from_parts(translation, enu_rotation(position)))
    }
}

/// Rotation `ecef_from_enu` at a position.
fn enu_rotation(position: &Geodetic) -> UnitQuaternion<f64> {
    let (sin_lat, cos_lat) = position.latitude_deg.to_radians().sin_cos();
    let (sin_lon, cos_lon) = position.longitude_deg.to_radians().sin_cos();
    let axes = Matrix3::from_columns(&[
        Vector3::new(-sin_lon, cos_lon, 0.0),
        Vector3::new(-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat),
        Vector3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat),
    ]);
    UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(axes))
}

fn projection(zone: UtmZone) -> Result<Proj, Error> {
    let south = if zone.is_south { " +south" } else { "" };
    Proj::from_proj_string(&format!(
        "+proj=utm +zone={}{south} +datum=WGS84 +units=m +no_defs",
        zone.number
    ))
}

fn radians(position: &Geodetic) -> (f64, f64, f64) {
    let (lat, lon) = (position.latitude_deg, position.longitude_deg);
    (lon.to_radians(), lat.to_radians(), position.height_m)
}

fn degrees((lon, lat, height_m): (f64, f64, f64)) -> Geodetic {
    Geodetic {
        latitude_deg: lat.to_degrees(),
        longitude_deg: lon.to_degrees(),
        height_m,
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_abs_diff_eq;

    use super::*;

    fn at(latitude_deg: f64, longitude_deg: f64, height_m: f64) -> Geodetic {
        Geodetic {
            latitude_deg,
            longitude_deg,
            height_m,
        }
    }

    fn zone(number: u8, is_south: bool) -> UtmZone {
        UtmZone { number, is_south }
    }

    /// PROJ, `test/gie/more_builtins.gie` (tolerance there: 0.1 mm) and the documentation of gie; on the ellipsoid GRS80,
    /// whose flattening differs from that of WGS84 by 0.1 mm at the pole.
    const UTM_32: [([f64; 2], [f64; 2]); 2] = [
        ([55.0, 12.0], [691_875.632_14, 6_098_907.825_01]),
        ([56.0, 12.0], [687_071.439_1, 6_210_141.326_7]),
    ];

    #[test]
    fn utm_has_the_values_that_proj_publishes_on_both_hemispheres() {
        let wgs84 = Wgs84::new().unwrap();
        for ([lat, lon], [easting_m, northing_m]) in UTM_32 {
            let north = wgs84.utm(zone(32, false), &at(lat, lon, 0.0)).unwrap();
            assert_abs_diff_eq!(north[0], easting_m, epsilon = 1e-3);
            assert_abs_diff_eq!(north[1], northing_m, epsilon = 1e-3);
            // The south is the mirror image of the north, from 10,000 km.
            let south = wgs84.utm(zone(32, true), &at(-lat, lon, 0.0)).unwrap();
            assert_abs_diff_eq!(south[0], easting_m, epsilon = 1e-3);
            assert_abs_diff_eq!(south[1], 1e7 - northing_m, epsilon = 1e-3);
        }
    }

    #[test]
    fn earth_centred_coordinates_are_those_of_the_guidance_of_epsg() {
        // IOGP Publication 373-7-2, section 4.1.1: WGS 84 / EPSG method 9602.
        let position = at(
            53.0 + 48.0 / 60.0 + 33.820 / 3600.0,
            2.0 + 7.0 / 60.0 + 46.380 / 3600.0,
            73.0,
        );
        let wgs84 = Wgs84::new().unwrap();
        let ecef = wgs84.ecef(&position).unwrap();
        let published = Vector3::new(3_771_793.968, 140_253.342, 5_124_304.349);
        assert!((ecef - published).norm() < 2e-3, "{ecef}");
    }

    #[test]
    fn there_and_back_is_the_same_place_everywhere() {
        let wgs84 = Wgs84::new().unwrap();
        let places = [
            at(49.0, 8.4, 115.0),
            at(-33.9, 151.2, 40.0),
            at(0.0, -179.9, -30.0),
            at(78.2, 15.6, 500.0),
            at(-54.8, -68.3, 8000.0),
        ];
        for place in places {
            let zone = UtmZone::of(&place);
            let [easting_m, northing_m] = wgs84.utm(zone, &place).unwrap();
            let from_utm = wgs84.from_utm(zone, [easting_m, northing_m, place.height_m]);
            let from_ecef = wgs84.geodetic(&wgs84.ecef(&place).unwrap());
            for found in [from_utm.unwrap(), from_ecef.unwrap()] {
                // 1e-11 degrees are a micrometre.
                assert_abs_diff_eq!(found.latitude_deg, place.latitude_deg, epsilon = 1e-10);
                assert_abs_diff_eq!(found.longitude_deg, place.longitude_deg, epsilon = 1e-10);
                assert_abs_diff_eq!(found.height_m, place.height_m, epsilon = 1e-5);
            }
        }
    }

    #[test]
    fn zones_are_six_degrees_wide_but_for_norway_and_svalbard() {
        let number = |lat, lon| UtmZone::of(&at(lat, lon, 0.0)).number;
        assert_eq!(
            [number(49.0, 8.4), number(49.0, 5.999), number(49.0, 6.0)],
            [32, 31, 32]
        );
        assert_eq!(
            [number(0.0, -180.0), number(0.0, 180.0), number(0.0, 179.99)],
            [1, 1, 60]
        );
        assert_eq!(
            [number(60.4, 5.3), number(78.2, 8.9), number(78.2, 15.6)],
            [32, 31, 33]
        );
        assert_eq!(UtmZone::of(&at(-1.0, 37.0, 0.0)).epsg(), 32737);
        assert_eq!(UtmZone::of(&at(1.0, 37.0, 0.0)).epsg(), 32637);
    }

    #[test]
    fn the_level_frame_has_north_towards_larger_latitudes_and_up_towards_larger_heights() {
        let wgs84 = Wgs84::new().unwrap();
        let place = at(49.0, 8.4, 100.0);
        let enu_from_ecef = wgs84.ecef_from_enu(&place).unwrap().inverse();
        let in_enu = |position: Geodetic| {
            let ecef = wgs84.ecef(&position).unwrap();
            enu_from_ecef.transform_point(&ecef.into()).coords
        };
        let north = in_enu(at(49.001, 8.4, 100.0));
        let east = in_enu(at(49.0, 8.401, 100.0));
        let up = in_enu(at(49.0, 8.4, 150.0));
        assert!(north.y > 111.0 && north.x.abs() < 1e-3, "{north}");
        assert!(east.x > 73.0 && east.y.abs() < 1e-3, "{east}");
        assert!((up - Vector3::new(0.0, 0.0, 50.0)).norm() < 1e-6, "{up}");
    }
}
