//! The shape of the surface at every point of a scan: its slope, its curvature, its normal.
//!
//! The normal is the cross product of the surface's tangents towards the neighbours above and
//! below, left and right in an image of directions. A neighbour is the first one at least
//! `spacing_m` away, so that noise does not tilt it, and a missing one is replaced by its
//! opposite.

use glam::Vec3;
use rayon::prelude::*;

use super::polar::{Cell, DirectionImage, Placed, PolarGrid, Return, coarse_atan2};

/// Points whose angles are computed together.
const BLOCK: usize = 32;
/// Points that are worth a thread.
const MIN_SHARE: usize = 1024;

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
pub(super) struct ScanIndex {
    pub(super) grid: PolarGrid,
    image: DirectionImage,
    pub(super) places: Vec<Placed>,
    /// Cells of the points in the image.
    cells: Vec<Option<Cell>>,
}

impl ScanIndex {
    /// Points nearer to the sensor's axis than `min_distance_m` have no place.
    pub(super) fn new(points: &[Vec3], min_distance_m: f32) -> Self {
        let grid = PolarGrid::new();
        let place = |&point: &Vec3| {
            let distance_m = point.truncate().length();
            if !(distance_m >= min_distance_m && point.z.is_finite()) {
                return (Placed::NOWHERE, None);
            }
            let azimuth_rad = coarse_atan2(point.y, point.x);
            match grid.locate(distance_m, azimuth_rad) {
                None => (Placed::NOWHERE, None),
                Some((ring, sector)) => (
                    Placed::new(ring, sector, point.z),
                    Cell::of(point.z, distance_m, azimuth_rad),
                ),
            }
        };
        let (mut places, mut cells) = (Vec::new(), Vec::new());
        points
            .par_iter()
            .with_min_len(MIN_SHARE)
            .map(place)
            .unzip_into_vecs(&mut places, &mut cells);
        Self {
            image: DirectionImage::new(points, &cells),
            grid,
            places,
            cells,
        }
    }

    /// The shapes of the surface at all points: computed for the nearest point of every
    /// direction, and taken over by points right beside it.
    pub(super) fn shapes(&self, points: &[Vec3], spacing_m: f32) -> Vec<Shape> {
        let returns = self.image.returns();
        let mut shapes = vec![Shape::UNKNOWN; returns.len()];
        shapes
            .par_chunks_mut(BLOCK)
            .enumerate()
            .with_min_len(MIN_SHARE / BLOCK)
            .for_each(|(block, shapes)| {
                let mut surfaces = Surfaces::<BLOCK>::unknown();
                for row in 0..shapes.len() {
                    let index = block * BLOCK + row;
                    let Return {
                        point, distance_m, ..
                    } = returns[index];
                    let neighbours =
                        Neighbours::of(&self.image, index, point, distance_m, spacing_m);
                    surfaces.set(row, &neighbours, point);
                }
                shapes.copy_from_slice(&surfaces.shapes()[..shapes.len()]);
            });
        points
            .par_iter()
            .zip(&self.cells)
            .enumerate()
            .with_min_len(MIN_SHARE)
            .map(|(number, (&point, cell))| {
                let Some(holder) = cell.and_then(|cell| self.image.holder(cell)) else {
                    return Shape::UNKNOWN;
                };
                let seen = &returns[holder];
                let squared_gap = seen.point.distance_squared(point);
                if seen.number == number as u32 || squared_gap < 0.25 * spacing_m * spacing_m {
                    return shapes[holder];
                }
                let distance_m = point.truncate().length();
                let mut surface = Surfaces::<1>::unknown();
                let neighbours = Neighbours::of(&self.image, holder, point, distance_m, spacing_m);
                surface.set(0, &neighbours, point);
                surface.shapes()[0]
            })
            .collect()
    }

    /// Unit surface normals of all points, of arbitrary sign; `None` without neighbours.
    pub(super) fn normals(&self, points: &[Vec3], spacing_m: f32) -> Vec<Option<Vec3>> {
        points
            .par_iter()
            .zip(&self.cells)
            .with_min_len(MIN_SHARE)
            .map(|(&point, cell)| {
                let holder = self.image.holder((*cell)?)?;
                let distance_m = point.truncate().length();
                Neighbours::of(&self.image, holder, point, distance_m, spacing_m).normal(point)
            })
            .collect()
    }
}

/// The surface at `N` points, a column per coordinate, so that angles are computed in a
/// vectorized loop.
struct Surfaces<const N: usize> {
    /// Two tangents.
    along: [[f32; N]; 3],
    across: [[f32; N]; 3],
    /// Squared level length and rise of the way up to a point and of the way on from it.
    before: [[f32; N]; 2],
    after: [[f32; N]; 2],
}

impl<const N: usize> Surfaces<N> {
    /// An upright wall with a sharp edge: nothing speaks for a road there.
    fn unknown() -> Self {
        let (no, yes) = ([0.0; N], [1.0; N]);
        Self {
            along: [no, no, yes],
            across: [no, yes, no],
            before: [yes, no],
            after: [no, yes],
        }
    }

    #[inline]
    fn set(&mut self, row: usize, neighbours: &Neighbours, point: Vec3) {
        let Some((along, across)) = neighbours.tangents(point) else {
            return;
        };
        for axis in 0..3 {
            self.along[axis][row] = along[axis];
            self.across[axis][row] = across[axis];
        }
        let (before, after) = match (neighbours.down, neighbours.up) {
            (Some(down), Some(up)) => (-down, up),
            _ => (Vec3::X, Vec3::X),
        };
        for (columns, way) in [(&mut self.before, before), (&mut self.after, after)] {
            columns[0][row] = way.truncate().length_squared();
            columns[1][row] = way.z;
        }
    }

    #[inline]
    fn shapes(&self) -> [Shape; N] {
        let mut slopes = [0.0; N];
        let mut bends = [0.0; N];
        let (a, b) = (&self.along, &self.across);
        for i in 0..N {
            let x = a[1][i] * b[2][i] - a[2][i] * b[1][i];
            let y = a[2][i] * b[0][i] - a[0][i] * b[2][i];
            let z = a[0][i] * b[1][i] - a[1][i] * b[0][i];
            slopes[i] = coarse_atan2((x * x + y * y).sqrt(), z.abs());
        }
        let (a, b) = (&self.before, &self.after);
        for i in 0..N {
            let (run, next_run) = (a[0][i].sqrt(), b[0][i].sqrt());
            let (rise, next_rise) = (a[1][i], b[1][i]);
            bends[i] = coarse_atan2(
                run * next_rise - rise * next_run,
                run * next_run + rise * next_rise,
            );
        }
        std::array::from_fn(|i| Shape {
            slope_rad: slopes[i],
            curvature_rad: bends[i],
        })
    }
}

/// Vectors from a point to its neighbours on the same surface, as far as there are any.
struct Neighbours {
    up: Option<Vec3>,
    down: Option<Vec3>,
    left: Option<Vec3>,
    right: Option<Vec3>,
}

/// How many columns to the sides a neighbour is looked for.
const MAX_COLUMNS: f32 = 5.0;

impl Neighbours {
    /// Of a point in the cell of a return, which may be the point itself.
    #[inline]
    fn of(
        image: &DirectionImage,
        holder: usize,
        point: Vec3,
        distance_m: f32,
        spacing_m: f32,
    ) -> Self {
        let columns = spacing_m / (distance_m * DirectionImage::COLUMN_RAD);
        let columns = columns.clamp(1.0, MAX_COLUMNS) as isize;
        let beside = |left| beside(image.beside(holder, left), point, distance_m);
        Self {
            up: first_spaced(image.above(holder), point, spacing_m),
            down: first_spaced(image.below(holder), point, spacing_m),
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
    returns: impl Iterator<Item = &'a Return>,
    point: Vec3,
    spacing_m: f32,
) -> Option<Vec3> {
    let mut found = None;
    for other in returns {
        let delta = other.point - point;
        found = Some(delta);
        if delta.length_squared() > spacing_m * spacing_m {
            break;
        }
    }
    found
}

/// Towards the first of the returns that is about as far away as the point.
#[inline]
fn beside<'a>(
    mut returns: impl Iterator<Item = &'a Return>,
    point: Vec3,
    distance_m: f32,
) -> Option<Vec3> {
    let gate_m = 0.3 + 0.02 * distance_m;
    returns
        .find(|other| (other.distance_m - distance_m).abs() < gate_m)
        .map(|other| other.point - point)
}
