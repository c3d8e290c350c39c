//! Features of each point for ground segmentation.
//!
//! ```text
//! slope            angle between surface normal and vertical
//! height_variance  √ mean (z − low)²   over the low points of the nine polar cells around
//! curvature        change of slope along the azimuth of the beam, from below to above: positive
//!                  where the surface turns upwards, as at the foot of a wall
//! height           above the local ground, see [`terrain`](super::terrain)
//! relief           height of the highest point of the polar cell that a car does not pass beneath
//! ```

use glam::Vec3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::inference::FuzzySystem;
use super::polar_grid::PolarPosition;
use super::surface::{BLOCK, MIN_POINTS_PER_TASK, ScanIndex, Shape};
use super::terrain::{Terrain, TerrainConfig};
use crate::simd::{Simd, SimdTask, dispatch};
use crate::validation::{InvalidValue, Validate, in_range, nested, not_negative};

/// Parameters of the features.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct FeatureConfig {
    /// Minimum distance from a point to the neighbours that its surface is computed from [m].
    #[default(0.15)]
    pub spacing_m: f32,
    /// Points nearer to the sensor's axis belong to the own car and are not ground [m].
    #[default(2.0)]
    pub min_distance_m: f32,
    /// Parameters of the elevation map above which the height of a point is measured.
    pub terrain: TerrainConfig,
}

impl Validate for FeatureConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("spacing_m", self.spacing_m, 0.001..=10.0)?;
        not_negative("min_distance_m", self.min_distance_m)?;
        nested("terrain", &self.terrain)
    }
}

/// The features of one point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Features {
    /// Angle between surface normal and vertical [deg].
    pub slope_deg: f32,
    /// Root mean square of the height above the surrounding low points [m].
    pub height_variance_m: f32,
    /// Change of slope along the azimuth, from below to above, positive where the surface turns
    /// upwards [deg].
    pub curvature_deg: f32,
    /// Height above the local ground [m].
    pub height_m: f32,
    /// Height of the highest point around, above the local ground or, of a point below that, above
    /// the point itself [m].
    pub relief_m: f32,
}

impl Features {
    /// Names in rules, in the order of [`to_array`](Self::to_array).
    pub(crate) const NAMES: [&str; 5] =
        ["slope", "height_variance", "curvature", "height", "relief"];
    /// Units, in the same order.
    pub(crate) const UNITS: [&str; 5] = ["deg", "m", "deg", "m", "m"];

    /// Returns the inputs of a fuzzy system.
    #[inline]
    pub(crate) fn to_array(self) -> [f32; 5] {
        [
            self.slope_deg,
            self.height_variance_m,
            self.curvature_deg,
            self.height_m,
            self.relief_m,
        ]
    }
}

/// What the features of a scan's points are computed from.
pub(super) struct ScanFeatures {
    positions: Vec<Option<PolarPosition>>,
    shapes: Vec<Shape>,
    terrain: Terrain,
}

impl ScanFeatures {
    /// Analyses the points of a scan in the lidar frame.
    pub(super) fn new(points: &[Vec3], config: &FeatureConfig) -> Self {
        let index = ScanIndex::new(points, config.min_distance_m, config.spacing_m);
        let shapes = index.shapes();
        let terrain = Terrain::estimate(index.grid, &index.positions, &shapes, &config.terrain);
        Self {
            positions: index.positions,
            shapes,
            terrain,
        }
    }

    /// Returns the features of every point; `None` for points that are not finite, on the own car
    /// or out of range.
    pub(super) fn features(&self) -> Vec<Option<Features>> {
        let points = self.positions.iter().zip(&self.shapes);
        points
            .map(|(position, shape)| Some(Features::new(position.as_ref()?, shape, &self.terrain)))
            .collect()
    }

    /// Infers the output of a fuzzy system for every point, in parallel; 0 for points without
    /// features.
    pub(super) fn infer(&self, system: &FuzzySystem) -> Vec<f32> {
        let mut results = vec![0.0; self.positions.len()];
        results
            .par_chunks_mut(MIN_POINTS_PER_TASK)
            .zip(self.positions.par_chunks(MIN_POINTS_PER_TASK))
            .zip(self.shapes.par_chunks(MIN_POINTS_PER_TASK))
            .for_each(|((results, positions), shapes)| {
                dispatch(InferenceTask {
                    terrain: &self.terrain,
                    system,
                    positions,
                    shapes,
                    results,
                });
            });
        results
    }
}

impl Features {
    #[inline(always)]
    fn new(position: &PolarPosition, shape: &Shape, terrain: &Terrain) -> Self {
        let height_m = position.z - terrain.height_at(position);
        Self {
            slope_deg: shape.slope_rad.to_degrees(),
            curvature_deg: shape.curvature_rad.to_degrees(),
            height_variance_m: terrain.height_above_lows_m(position),
            height_m,
            relief_m: terrain.top_m(position).max(height_m) - height_m.min(0.0),
        }
    }
}

/// Inference for some points of a scan.
struct InferenceTask<'a> {
    terrain: &'a Terrain,
    system: &'a FuzzySystem,
    positions: &'a [Option<PolarPosition>],
    shapes: &'a [Shape],
    results: &'a mut [f32],
}

impl SimdTask for InferenceTask<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let blocks = (self.results.chunks_mut(BLOCK))
            .zip(self.positions.chunks(BLOCK))
            .zip(self.shapes.chunks(BLOCK));
        for ((results, positions), shapes) in blocks {
            let mut block = [[0.0; BLOCK]; 5];
            for (row, (position, shape)) in positions.iter().zip(shapes).enumerate() {
                if let Some(position) = position {
                    let features = Features::new(position, shape, self.terrain).to_array();
                    for (column, feature) in block.iter_mut().zip(features) {
                        column[row] = feature;
                    }
                }
            }
            let inferred = self.system.infer_block(&block);
            for ((result, position), inferred) in results.iter_mut().zip(positions).zip(inferred) {
                *result = if position.is_some() { inferred } else { 0.0 };
            }
        }
    }
}

/// Returns the unit surface normals of all points, of arbitrary sign; `None` without neighbours.
pub(super) fn surface_normals(points: &[Vec3]) -> Vec<Option<Vec3>> {
    let config = FeatureConfig::default();
    ScanIndex::new(points, config.min_distance_m, config.spacing_m).normals()
}

/// Height of the ground below the sensor, in the lidar frame; NaN if the scan has no ground at all [m].
pub(super) fn ground_height_m(points: &[Vec3]) -> f32 {
    let features = ScanFeatures::new(points, &FeatureConfig::default());
    features.terrain.height_below_m()
}
