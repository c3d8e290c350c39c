//! What tells ground from the rest, per point.
//!
//! ```text
//! slope            angle between the surface normal and the vertical
//! height_variance  √ mean (z − low)²   over the low points of the nine polar cells around
//! curvature        change of slope along the beam's azimuth, from below to above: positive where
//!                  the surface turns upwards, as at the foot of a wall
//! height           over the local ground, see [`terrain`](super::terrain)
//! ```

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::polar::Placed;
use super::surface::{ScanIndex, Shape};
use super::terrain::{Terrain, TerrainConfig};
use crate::validation::{InvalidValue, Validate, not_negative, positive};

/// How features are computed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FeatureConfig {
    /// Distance from a point to the neighbours that tell its slope [m].
    pub spacing_m: f32,
    /// Points nearer to the sensor's axis than this are on the own car and no ground [m].
    pub min_distance_m: f32,
    /// The local ground, over which the height of a point is measured.
    pub terrain: TerrainConfig,
}

impl Default for FeatureConfig {
    fn default() -> Self {
        Self {
            spacing_m: 0.15,
            min_distance_m: 2.0,
            terrain: TerrainConfig::default(),
        }
    }
}

impl Validate for FeatureConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        positive("spacing_m", self.spacing_m)?;
        not_negative("min_distance_m", self.min_distance_m)?;
        positive("terrain.step_m", self.terrain.step_m)?;
        not_negative("terrain.max_slope", self.terrain.max_slope)?;
        positive("terrain.max_jump_m", self.terrain.max_jump_m)?;
        positive("terrain.start_radius_m", self.terrain.start_radius_m)?;
        positive("terrain.max_low_slope_rad", self.terrain.max_low_slope_rad)
    }
}

/// The features of one point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Features {
    /// Angle between the surface and the horizontal [deg].
    pub slope_deg: f32,
    /// Root mean square of the point's height over the low points around it [m].
    pub height_variance_m: f32,
    /// Change of slope along the azimuth, from below to above, positive where the surface turns
    /// upwards [deg].
    pub curvature_deg: f32,
    /// Height over the local ground [m].
    pub height_m: f32,
}

impl Features {
    /// Their names in rules, in the order of [`to_array`](Self::to_array).
    pub const NAMES: [&str; 4] = ["slope", "height_variance", "curvature", "height"];
    /// Their units.
    pub const UNITS: [&str; 4] = ["deg", "m", "deg", "m"];

    /// As inputs of a fuzzy system.
    #[inline]
    pub fn to_array(&self) -> [f32; 4] {
        [
            self.slope_deg,
            self.height_variance_m,
            self.curvature_deg,
            self.height_m,
        ]
    }
}

/// A scan from which the features of its points are read.
pub(super) struct Scene {
    places: Vec<Placed>,
    shapes: Vec<Shape>,
    terrain: Terrain,
}

/// Points that are worth a thread.
const MIN_SHARE: usize = 1024;

impl Scene {
    /// Of all points of a scan in the lidar frame.
    pub(super) fn new(points: &[Vec3], config: &FeatureConfig) -> Self {
        let index = ScanIndex::new(points, config.min_distance_m);
        let shapes = index.shapes(points, config.spacing_m);
        let terrain = Terrain::estimate(&index.grid, &index.places, &shapes, &config.terrain);
        Self {
            places: index.places,
            shapes,
            terrain,
        }
    }

    /// The features of every point; `None` for points that are not finite, on the own car or too
    /// far away.
    pub(super) fn features(&self) -> Vec<Option<Features>> {
        let places = self.places.iter().zip(&self.shapes);
        places
            .map(|(place, shape)| place.is_somewhere().then(|| self.features_at(place, shape)))
            .collect()
    }

    /// What `judge` makes of the features of every point, which it is given in blocks of `N`,
    /// in parallel; 0 for points without features.
    pub(super) fn judge<const N: usize>(
        &self,
        judge: impl Fn(&[[f32; N]; 4]) -> [f32; N] + Sync,
    ) -> Vec<f32> {
        let mut answers = vec![0.0; self.places.len()];
        answers
            .par_chunks_mut(N)
            .zip(self.places.par_chunks(N))
            .zip(self.shapes.par_chunks(N))
            .with_min_len(MIN_SHARE / N)
            .for_each(|((answers, places), shapes)| {
                let mut columns = [[0.0; N]; 4];
                for (row, (place, shape)) in places.iter().zip(shapes).enumerate() {
                    if place.is_somewhere() {
                        let features = self.features_at(place, shape).to_array();
                        for (column, feature) in columns.iter_mut().zip(features) {
                            column[row] = feature;
                        }
                    }
                }
                let judged = judge(&columns);
                for ((answer, place), judged) in answers.iter_mut().zip(places).zip(judged) {
                    *answer = if place.is_somewhere() { judged } else { 0.0 };
                }
            });
        answers
    }

    #[inline]
    fn features_at(&self, place: &Placed, shape: &Shape) -> Features {
        Features {
            slope_deg: shape.slope_rad.to_degrees(),
            curvature_deg: shape.curvature_rad.to_degrees(),
            height_variance_m: self.terrain.rise_over_lows(place),
            height_m: place.z - self.terrain.height_at(place.ring, place.sector),
        }
    }
}

/// Unit surface normals of all points of a scan, of arbitrary sign; `None` without neighbours.
pub(super) fn surface_normals(points: &[Vec3]) -> Vec<Option<Vec3>> {
    let config = FeatureConfig::default();
    ScanIndex::new(points, config.min_distance_m).normals(points, config.spacing_m)
}
