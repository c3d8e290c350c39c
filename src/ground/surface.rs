//! The local surface at every point of a scan: slope, curvature, normal.
//!
//! The normal is the cross product of the surface's tangents, the differences of the neighbours
//! above and below, left and right in an image of directions. A neighbour is the first one at
//! least `spacing_m` away, so that noise does not tilt it; where it is missing, or so far away that
//! it lies on another surface, the point itself takes its place.

use std::f32::consts::FRAC_PI_2;

use glam::Vec3;
use rayon::prelude::*;

use super::direction_image::{DirectionCell, DirectionImage, Return};
use super::polar_grid::{PolarGrid, PolarPosition};
use crate::geometry::fast_atan2;
use crate::simd::{Simd, SimdTask, dispatch};

/// Points that are processed together in vectorized loops.
pub(super) const BLOCK: usize = 32;
/// Minimum number of points per parallel task.
pub(super) const MIN_POINTS_PER_TASK: usize = 1024;
/// Maximum number of columns between a point and its neighbours at the sides.
const MAX_COLUMNS: f32 = 5.0;

/// A neighbour above or below that is farther away than the opposite one by this factor lies on
/// another surface, such as the crest of a road before a wall, unitless.
const MAX_GAP_RATIO: f32 = 2.0;

/// Distance of points that share their shape, in spacings of neighbours (unitless).
const SHARED: f32 = 0.5;

/// Slope and curvature of the surface at a point.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    pub(super) slope_rad: f32,
    pub(super) curvature_rad: f32,
}

impl Shape {
    /// The shape at a point without neighbours, which is unlike a road.
    const UNKNOWN: Self = Self {
        slope_rad: FRAC_PI_2,
        curvature_rad: FRAC_PI_2,
    };
}

/// The points of a scan, indexed by position and by direction.
pub(super) struct ScanIndex<'a> {
    points: &'a [Vec3],
    spacing_m: f32,
    pub(super) grid: PolarGrid,
    pub(super) positions: Vec<Option<PolarPosition>>,
    image: DirectionImage,
    /// Cells of the points in the image.
    cells: Vec<Option<DirectionCell>>,
}

impl<'a> ScanIndex<'a> {
    /// Indexes the points that are at least `min_distance_m` away from the sensor's axis.
    pub(super) fn new(points: &'a [Vec3], min_distance_m: f32, spacing_m: f32) -> Self {
        let grid = PolarGrid::new();
        let mut positions = vec![None; points.len()];
        let mut cells = vec![None; points.len()];
        positions
            .par_chunks_mut(MIN_POINTS_PER_TASK)
            .zip(cells.par_chunks_mut(MIN_POINTS_PER_TASK))
            .zip(points.par_chunks(MIN_POINTS_PER_TASK))
            .for_each(|((positions, cells), points)| {
                dispatch(LocationTask {
                    points,
                    min_distance_m,
                    grid: &grid,
                    positions,
                    cells,
                });
            });
        Self {
            points,
            spacing_m,
            grid,
            positions,
            image: DirectionImage::new(points, &cells),
            cells,
        }
    }

    /// Returns the shape of the surface at all points: computed for the nearest point of every
    /// direction, and shared with the points close to it.
    pub(super) fn shapes(&self) -> Vec<Shape> {
        let returns = self.image.returns();
        let mut shared = vec![Shape::UNKNOWN; returns.len()];
        shared
            .par_chunks_mut(BLOCK)
            .enumerate()
            .with_min_len(MIN_POINTS_PER_TASK / BLOCK)
            .for_each(|(block, shapes)| {
                let of_return = |index: usize| (index, returns[index].point);
                let indices = block * BLOCK..block * BLOCK + shapes.len();
                let computed = self.shapes_at(indices.map(of_return));
                shapes.copy_from_slice(&computed[..shapes.len()]);
            });
        let mut shapes = vec![Shape::UNKNOWN; self.points.len()];
        shapes
            .par_chunks_mut(MIN_POINTS_PER_TASK)
            .zip(self.points.par_chunks(MIN_POINTS_PER_TASK))
            .zip(self.cells.par_chunks(MIN_POINTS_PER_TASK))
            .for_each(|((shapes, points), cells)| {
                // Points that are far from the return in their cell.
                let mut far = Vec::new();
                for (row, (&point, cell)) in points.iter().zip(cells).enumerate() {
                    let Some(index) = cell.and_then(|cell| self.image.return_of(cell)) else {
                        continue;
                    };
                    let squared_gap = returns[index].point.distance_squared(point);
                    if squared_gap < SHARED * SHARED * self.spacing_m * self.spacing_m {
                        shapes[row] = shared[index];
                    } else {
                        far.push((row, index));
                    }
                }
                for far in far.chunks(BLOCK) {
                    let at_point = |&(row, index): &(usize, usize)| (index, points[row]);
                    let computed = self.shapes_at(far.iter().map(at_point));
                    for (&(row, _), shape) in far.iter().zip(computed) {
                        shapes[row] = shape;
                    }
                }
            });
        shapes
    }

    /// Computes the shapes at up to [`BLOCK`] points, each with the index of the return in its
    /// cell.
    #[inline]
    fn shapes_at(&self, points: impl Iterator<Item = (usize, Vec3)>) -> [Shape; BLOCK] {
        let mut surfaces = Surfaces::<BLOCK>::unknown();
        for (row, (index, point)) in points.enumerate() {
            let neighbours = self.neighbours(index, point, point.truncate().length());
            surfaces.set(row, &neighbours, point, self.spacing_m);
        }
        surfaces.shapes()
    }

    /// Returns the unit surface normals of all points, of arbitrary sign; `None` without neighbours.
    pub(super) fn normals(&self) -> Vec<Option<Vec3>> {
        self.points
            .par_iter()
            .zip(&self.cells)
            .with_min_len(MIN_POINTS_PER_TASK)
            .map(|(&point, cell)| {
                let index = self.image.return_of((*cell)?)?;
                let neighbours = self.neighbours(index, point, point.truncate().length());
                let (along, across) = neighbours.tangents(point, self.spacing_m)?;
                along.cross(across).try_normalize()
            })
            .collect()
    }

    /// Finds the neighbours of a point in the cell of a return, which may be the point itself.
    #[inline]
    fn neighbours(&self, index: usize, point: Vec3, distance_m: f32) -> Neighbours {
        let columns = self.spacing_m / (distance_m * DirectionImage::COLUMN_RAD);
        let columns = columns.clamp(1.0, MAX_COLUMNS) as isize;
        let neighbour =
            |left| first_neighbour(self.image.neighbours(index, left), point, distance_m);
        Neighbours {
            up: first_spaced(self.image.above(index), point, self.spacing_m),
            down: first_spaced(self.image.below(index), point, self.spacing_m),
            left: neighbour(columns),
            right: neighbour(-columns),
        }
    }
}

/// The search for the cells of some points of a scan.
struct LocationTask<'a> {
    points: &'a [Vec3],
    min_distance_m: f32,
    grid: &'a PolarGrid,
    positions: &'a mut [Option<PolarPosition>],
    cells: &'a mut [Option<DirectionCell>],
}

impl SimdTask for LocationTask<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, _: S) {
        let blocks = (self.points.chunks(BLOCK))
            .zip(self.positions.chunks_mut(BLOCK))
            .zip(self.cells.chunks_mut(BLOCK));
        for ((points, positions), cells) in blocks {
            let mut distances_m = [0.0; BLOCK];
            let mut azimuths_rad = [0.0; BLOCK];
            let directions = distances_m.iter_mut().zip(&mut azimuths_rad);
            for ((distance_m, azimuth_rad), point) in directions.zip(points) {
                *distance_m = point.truncate().length();
                *azimuth_rad = fast_atan2(point.y, point.x);
            }
            for (i, point) in points.iter().enumerate() {
                let (distance_m, azimuth_rad) = (distances_m[i], azimuths_rad[i]);
                if distance_m >= self.min_distance_m && point.z.is_finite() {
                    positions[i] = self.grid.locate(point.z, distance_m, azimuth_rad);
                    let cell = || DirectionCell::new(point.z, distance_m, azimuth_rad);
                    cells[i] = positions[i].and_then(|_| cell());
                }
            }
        }
    }
}

/// Vectors from a point to its neighbours on the same surface.
struct Neighbours {
    up: Option<Vec3>,
    down: Option<Vec3>,
    left: Option<Vec3>,
    right: Option<Vec3>,
}

impl Neighbours {
    /// Vertical and horizontal tangent; `None` without vertical neighbours.
    fn tangents(&self, point: Vec3, spacing_m: f32) -> Option<(Vec3, Vec3)> {
        let (mut up, mut down) = (self.up, self.down);
        if let (Some(above), Some(below)) = (up, down) {
            let is_near = |near: Vec3, far: Vec3| {
                let reach = near.length_squared().max(spacing_m * spacing_m);
                far.length_squared() <= MAX_GAP_RATIO * MAX_GAP_RATIO * reach
            };
            up = up.filter(|_| is_near(below, above));
            down = down.filter(|_| is_near(above, below));
        }
        let along = difference(up, down)?;
        // Without neighbours at the sides the surface is assumed to be level across the beam.
        let level = Vec3::new(-point.y, point.x, 0.0);
        Some((along, difference(self.left, self.right).unwrap_or(level)))
    }
}

fn difference(ahead: Option<Vec3>, behind: Option<Vec3>) -> Option<Vec3> {
    match (ahead, behind) {
        (Some(ahead), Some(behind)) => Some(ahead - behind),
        (ahead, behind) => ahead.or(behind.map(|behind| -behind)),
    }
}

/// Returns the vector to the first return that is `spacing_m` away, or else to the last one.
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

/// Returns the vector to the first return about as far away as the point.
#[inline]
fn first_neighbour<'a>(
    mut returns: impl Iterator<Item = &'a Return>,
    point: Vec3,
    distance_m: f32,
) -> Option<Vec3> {
    /// Largest difference of the distances of neighbours at the sides [m], and its increase with the distance.
    const GATE_M: f32 = 0.3;
    const GATE_PER_M: f32 = 0.02;
    let gate_m = GATE_M + GATE_PER_M * distance_m;
    returns
        .find(|other| (other.distance_m - distance_m).abs() < gate_m)
        .map(|other| other.point - point)
}

/// The surface at `N` points, one column per coordinate, so that angles are computed in a
/// vectorized loop.
struct Surfaces<const N: usize> {
    /// Vertical tangents.
    along: [[f32; N]; 3],
    /// Horizontal tangents.
    across: [[f32; N]; 3],
    /// Squared horizontal length and rise from the neighbour below to the point.
    before: [[f32; N]; 2],
    /// Squared horizontal length and rise from the point to the neighbour above.
    after: [[f32; N]; 2],
}

impl<const N: usize> Surfaces<N> {
    /// A vertical wall with a sharp edge, as [`Shape::UNKNOWN`].
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
    fn set(&mut self, row: usize, neighbours: &Neighbours, point: Vec3, spacing_m: f32) {
        let Some((along, across)) = neighbours.tangents(point, spacing_m) else {
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
        for (columns, step) in [(&mut self.before, before), (&mut self.after, after)] {
            columns[0][row] = step.truncate().length_squared();
            columns[1][row] = step.z;
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
            slopes[i] = fast_atan2((x * x + y * y).sqrt(), z.abs());
        }
        let (a, b) = (&self.before, &self.after);
        for i in 0..N {
            let (run, next_run) = (a[0][i].sqrt(), b[0][i].sqrt());
            let (rise, next_rise) = (a[1][i], b[1][i]);
            bends[i] = fast_atan2(
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
