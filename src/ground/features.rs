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

use super::polar::{DirectionImage, PolarGrid, coarse_atan2};
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
            spacing_m: 0.15,
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

/// A scan from which the features of its points are read.
pub(super) struct Scene {
    places: Vec<Placed>,
    shapes: Vec<Shape>,
    terrain: Terrain,
}

impl Scene {
    /// Of all points of a scan in the lidar frame.
    pub(super) fn new(points: &[Vec3], config: &FeatureConfig) -> Self {
        let index = ScanIndex::new(points, config);
        let shapes = index.shapes(points, config);
        let terrain = Terrain::estimate(&index.grid, &index.places, &shapes, &config.terrain);
        Self {
            places: index.places,
            shapes,
            terrain,
        }
    }

    /// Calls `judge` with the features of every point, in parallel; `None` for points that are
    /// not finite, on the own car or too far away.
    pub(super) fn map<T: Send>(&self, judge: impl Fn(Option<Features>) -> T + Sync) -> Vec<T> {
        self.places
            .par_iter()
            .zip(&self.shapes)
            .with_min_len(MIN_SHARE)
            .map(|(place, shape)| {
                judge(place.is_somewhere().then(|| Features {
                    slope_deg: shape.slope_rad.to_degrees(),
                    curvature_deg: shape.curvature_rad.to_degrees(),
                    height_variance_m: self.terrain.rise_over_lows(place),
                    height_m: place.z - self.terrain.height_at(place.ring, place.sector),
                }))
            })
            .collect()
    }
}

/// Points that are worth a thread.
const MIN_SHARE: usize = 1024;

/// Unit surface normals of all points of a scan, of arbitrary sign; `None` without neighbours.
pub(super) fn surface_normals(points: &[Vec3]) -> Vec<Option<Vec3>> {
    let config = FeatureConfig::default();
    let index = ScanIndex::new(points, &config);
    points
        .par_iter()
        .zip(&index.pixels)
        .with_min_len(MIN_SHARE)
        .map(|(&point, &pixel)| {
            let pixel = pixel?.get() as usize - 1;
            Neighbours::of(&index.image, points, pixel, point, config.spacing_m).normal(point)
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
        for (number, &point) in points.iter().enumerate() {
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
                index.image.insert(pixel, points, number);
            }
            index
                .places
                .push(place.map_or(Placed::NOWHERE, |(ring, sector)| {
                    Placed::new(ring, sector, point.z)
                }));
            index
                .pixels
                .push(pixel.and_then(|pixel| std::num::NonZeroU32::new(pixel as u32 + 1)));
        }
        index
    }

    /// The shapes of the surface at all points: computed for the nearest point of every
    /// direction, and taken over by points right beside it.
    fn shapes(&self, points: &[Vec3], config: &FeatureConfig) -> Vec<Shape> {
        let shape_at = |pixel: usize, point: Vec3| {
            Neighbours::of(&self.image, points, pixel, point, config.spacing_m).shape(point)
        };
        let holders: Vec<(u32, Shape)> = (0..DirectionImage::COLUMNS)
            .into_par_iter()
            .with_min_len(64)
            .flat_map_iter(|column| {
                self.image
                    .holders(column)
                    .map(|(pixel, number)| (number as u32, shape_at(pixel, points[number])))
            })
            .collect();
        let mut shapes = vec![Shape::UNKNOWN; points.len()];
        for (number, shape) in holders {
            shapes[number as usize] = shape;
        }
        let others: Vec<(u32, Shape)> = self
            .pixels
            .par_iter()
            .enumerate()
            .with_min_len(MIN_SHARE)
            .filter_map(|(number, pixel)| {
                let pixel = pixel.as_ref()?.get() as usize - 1;
                let holder = self.image.holder(pixel)?;
                if holder == number {
                    return None;
                }
                let point = points[number];
                let squared_gap = (points[holder] - point).length_squared();
                let same = squared_gap < 0.25 * config.spacing_m * config.spacing_m;
                let shape = if same {
                    shapes[holder]
                } else {
                    shape_at(pixel, point)
                };
                Some((number as u32, shape))
            })
            .collect();
        for (number, shape) in others {
            shapes[number as usize] = shape;
        }
        shapes
    }
}

/// Vectors from a point to its neighbours on the same surface, as far as there are any.
struct Neighbours {
    up: Option<Vec3>,
    down: Option<Vec3>,
    left: Option<Vec3>,
    right: Option<Vec3>,
}

/// How many rows up and down a neighbour is looked for.
const MAX_ROWS: usize = 8;
/// How many columns to the sides.
const MAX_COLUMNS: f32 = 5.0;

impl Neighbours {
    #[inline]
    fn of(
        image: &DirectionImage,
        points: &[Vec3],
        pixel: usize,
        point: Vec3,
        spacing_m: f32,
    ) -> Self {
        let distance_m = point.truncate().length();
        let columns = spacing_m / (distance_m * DirectionImage::COLUMN_RAD);
        let columns = columns.clamp(1.0, MAX_COLUMNS) as isize;
        let (above, below) = image.above_and_below(pixel, MAX_ROWS);
        let beside = |left| beside(points, image.beside(pixel, left), point, distance_m);
        Self {
            up: first_spaced(points, above.iter(), point, spacing_m),
            down: first_spaced(points, below.iter().rev(), point, spacing_m),
            left: beside(columns),
            right: beside(-columns),
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

/// Towards the first return that is `spacing_m` away, or the last nearer one.
#[inline]
fn first_spaced<'a>(
    points: &[Vec3],
    cells: impl Iterator<Item = &'a u32>,
    point: Vec3,
    spacing_m: f32,
) -> Option<Vec3> {
    let mut found = None;
    for &cell in cells {
        if cell != 0 {
            let delta = points[cell as usize - 1] - point;
            found = Some(delta);
            if delta.length_squared() > spacing_m * spacing_m {
                break;
            }
        }
    }
    found
}

/// Towards the first of the returns that is about as far away as the point.
#[inline]
fn beside(points: &[Vec3], cells: [u32; 3], point: Vec3, distance_m: f32) -> Option<Vec3> {
    let gate_m = 0.3 + 0.02 * distance_m;
    cells
        .into_iter()
        .filter(|&cell| cell != 0)
        .find_map(|cell| {
            let other = points[cell as usize - 1];
            let jump_m = other.truncate().length() - distance_m;
            (jump_m.abs() < gate_m).then(|| other - point)
        })
}

/// Angle over the horizontal [rad].
fn incline(direction: Vec3) -> f32 {
    let level: Vec2 = direction.truncate();
    coarse_atan2(direction.z, level.length())
}
