//! What tells ground from the rest, per point.
//!
//! ```text
//! slope            angle between the surface normal and the vertical
//! height_variance  √ mean (z − low)²   over the low points of the nine polar cells around
//! curvature        how much the slope changes along the beam's azimuth, from below to above
//! height           over the local ground, see [`terrain`](super::terrain)
//! ```
//!
//! The normal is the cross product of the surface's tangents towards the neighbours above and
//! below, left and right in an image of directions. A neighbour is the first one at least
//! `spacing_m` away, so that noise does not tilt it, and a missing one is replaced by its
//! opposite.

use glam::{Vec2, Vec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::polar::{DirectionImage, PolarGrid, SECTORS, coarse_atan2};
use super::terrain::{Placed, Terrain, TerrainConfig};

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
            spacing_m: 0.2,
            min_distance_m: 2.0,
            terrain: TerrainConfig::default(),
        }
    }
}

/// The features of one point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Features {
    /// Angle between the surface and the horizontal [deg].
    pub slope_deg: f32,
    /// Root mean square of the point's height over the low points around it [m].
    pub height_variance_m: f32,
    /// Change of slope along the azimuth [deg].
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

/// Features of all points of a scan in the lidar frame; `None` for points that are not finite,
/// on the own car or too far away.
pub fn features(points: &[Vec3], config: &FeatureConfig) -> Vec<Option<Features>> {
    let index = ScanIndex::new(points, config);
    let shapes: Vec<Shape> = index.shapes(points, config);
    let terrain = Terrain::estimate(&index.grid, &index.places, &shapes, &config.terrain);
    index
        .places
        .par_iter()
        .zip(&shapes)
        .with_min_len(1024)
        .map(|(place, shape)| {
            place.is_somewhere().then(|| Features {
                slope_deg: shape.slope_rad.to_degrees(),
                curvature_deg: shape.curvature_rad.to_degrees(),
                height_variance_m: rise_over_lows(&terrain, place),
                height_m: place.z - terrain.height_at(place.ring, place.sector),
            })
        })
        .collect()
}

/// Unit surface normals of all points of a scan, of arbitrary sign; `None` without neighbours.
pub(super) fn surface_normals(points: &[Vec3]) -> Vec<Option<Vec3>> {
    let config = FeatureConfig::default();
    let index = ScanIndex::new(points, &config);
    points
        .par_iter()
        .zip(&index.pixels)
        .with_min_len(1024)
        .map(|(&point, &pixel)| {
            let pixel = pixel?.get() as usize - 1;
            Neighbours::of(&index.image, pixel, point, config.spacing_m).normal(point)
        })
        .collect()
}

/// Slope and curvature of the surface at a point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    pub(super) slope_rad: f32,
    pub(super) curvature_rad: f32,
}

impl Shape {
    /// Of a point without neighbours: nothing speaks for a road there.
    const UNKNOWN: Self = Self {
        slope_rad: std::f32::consts::FRAC_PI_2,
        curvature_rad: std::f32::consts::FRAC_PI_2,
    };
}

/// A scan by place and by direction.
struct ScanIndex {
    grid: PolarGrid,
    image: DirectionImage,
    places: Vec<Placed>,
    /// One more than the index of the cell in the image.
    pixels: Vec<Option<std::num::NonZeroU32>>,
}

impl ScanIndex {
    fn new(points: &[Vec3], config: &FeatureConfig) -> Self {
        let mut index = Self {
            grid: PolarGrid::new(),
            image: DirectionImage::new(),
            places: Vec::with_capacity(points.len()),
            pixels: Vec::with_capacity(points.len()),
        };
        for &point in points {
            let distance_m = point.truncate().length();
            let azimuth_rad = coarse_atan2(point.y, point.x);
            let near_or_nan = !(distance_m >= config.min_distance_m && point.z.is_finite());
            let place = if near_or_nan {
                None
            } else {
                index.grid.locate(distance_m, azimuth_rad)
            };
            let pixel = place.and_then(|_| DirectionImage::index(point.z, distance_m, azimuth_rad));
            if let Some(pixel) = pixel {
                index.image.insert(pixel, point, distance_m);
            }
            index
                .places
                .push(place.map_or(Placed::NOWHERE, |(ring, sector)| Placed {
                    ring,
                    sector,
                    z: point.z,
                }));
            index
                .pixels
                .push(pixel.and_then(|pixel| std::num::NonZeroU32::new(pixel as u32 + 1)));
        }
        index
    }

    fn shapes(&self, points: &[Vec3], config: &FeatureConfig) -> Vec<Shape> {
        points
            .par_iter()
            .zip(&self.pixels)
            .with_min_len(1024)
            .map(|(&point, &pixel)| match pixel {
                Some(pixel) => {
                    let pixel = pixel.get() as usize - 1;
                    Neighbours::of(&self.image, pixel, point, config.spacing_m).shape(point)
                }
                None => Shape::UNKNOWN,
            })
            .collect()
    }
}

/// Root mean square of the height over the low points of the cells around.
fn rise_over_lows(terrain: &Terrain, place: &Placed) -> f32 {
    let (ring, sector) = (place.ring as usize, place.sector as usize);
    let (mut sum, mut count) = (0.0, 0.0);
    for ring in ring.saturating_sub(1)..=ring + 1 {
        for side in [SECTORS - 1, SECTORS, SECTORS + 1] {
            let low = terrain.low(ring, (sector + side) % SECTORS);
            if low.is_finite() {
                sum += (place.z - low) * (place.z - low);
                count += 1.0;
            }
        }
    }
    (sum / f32::max(count, 1.0)).sqrt()
}

/// Vectors from a point to its neighbours on the same surface, as far as there are any.
struct Neighbours {
    up: Option<Vec3>,
    down: Option<Vec3>,
    left: Option<Vec3>,
    right: Option<Vec3>,
}

/// How many rows up and down a neighbour is looked for.
const MAX_ROWS: isize = 8;
/// How many columns to the sides.
const MAX_COLUMNS: f32 = 5.0;

impl Neighbours {
    fn of(image: &DirectionImage, pixel: usize, point: Vec3, spacing_m: f32) -> Self {
        let distance_m = point.truncate().length();
        let columns = spacing_m / (distance_m * DirectionImage::COLUMN_RAD);
        let columns = columns.clamp(1.0, MAX_COLUMNS) as isize;
        Self {
            up: above(image, pixel, point, spacing_m, 1),
            down: above(image, pixel, point, spacing_m, -1),
            left: beside(image, pixel, point, distance_m, columns),
            right: beside(image, pixel, point, distance_m, -columns),
        }
    }

    fn tangents(&self, point: Vec3) -> Option<(Vec3, Vec3)> {
        let along = difference(self.up, self.down)?;
        // Without neighbours at the sides the surface is taken as level across.
        let level = Vec3::new(-point.y, point.x, 0.0);
        Some((along, difference(self.left, self.right).unwrap_or(level)))
    }

    fn normal(&self, point: Vec3) -> Option<Vec3> {
        let (along, across) = self.tangents(point)?;
        along.cross(across).try_normalize()
    }

    #[inline]
    fn shape(&self, point: Vec3) -> Shape {
        let Some((along, across)) = self.tangents(point) else {
            return Shape::UNKNOWN;
        };
        let normal = along.cross(across);
        let curvature_rad = match (self.up, self.down) {
            (Some(up), Some(down)) => (incline(up) - incline(-down)).abs(),
            _ => 0.0,
        };
        Shape {
            slope_rad: coarse_atan2(normal.truncate().length(), normal.z.abs()),
            curvature_rad,
        }
    }
}

fn difference(ahead: Option<Vec3>, behind: Option<Vec3>) -> Option<Vec3> {
    match (ahead, behind) {
        (Some(ahead), Some(behind)) => Some(ahead - behind),
        (Some(ahead), None) => Some(ahead),
        (None, Some(behind)) => Some(-behind),
        (None, None) => None,
    }
}

/// The nearest return `sign` up that is `spacing_m` away, or the farthest nearer one.
#[inline]
fn above(
    image: &DirectionImage,
    pixel: usize,
    point: Vec3,
    spacing_m: f32,
    sign: isize,
) -> Option<Vec3> {
    let mut found = None;
    for step in 1..=MAX_ROWS {
        if let Some(other) = image.near(pixel, sign * step, 0) {
            let delta = other - point;
            found = Some(delta);
            if delta.length_squared() > spacing_m * spacing_m {
                break;
            }
        }
    }
    found
}

/// The return `left` columns beside a point if it is about as far away.
#[inline]
fn beside(
    image: &DirectionImage,
    pixel: usize,
    point: Vec3,
    distance_m: f32,
    left: isize,
) -> Option<Vec3> {
    let gate_m = 0.3 + 0.02 * distance_m;
    [0, 1, -1].into_iter().find_map(|up| {
        let other = image.near(pixel, up, left)?;
        let jump_m = other.truncate().length() - distance_m;
        (jump_m.abs() < gate_m).then(|| other - point)
    })
}

/// Angle over the horizontal [rad].
fn incline(direction: Vec3) -> f32 {
    let level: Vec2 = direction.truncate();
    coarse_atan2(direction.z, level.length())
}
