//! Local map: moments of the mapped points in voxels of three scales, and the planes that they form.
//!
//! ```text
//! n, Σ p, Σ p pᵀ  per voxel         sums of the 2 x 2 x 2 voxels nearest to a point: distribution of its neighbours
//! ```
//!
//! A block of eight voxels moves with the point in steps of one voxel, so a point is never farther than half a
//! voxel from the middle of its block. Voxels far from the sensor, and those that got no point over a long path, are
//! removed. The finest block whose points form a plane is the surface near the
//! point: variances λ₀ ≪ λ₁, and λ₁ not ≪ λ₂, as it would be on a single ring.

use foldhash::HashMap;
use glam::{DMat3, DVec3, IVec3, Vec3};
use rayon::prelude::*;

use crate::geometry::PlaneSums;

/// The cell of an edge of one that contains a point; without the calls of `f64::floor`, which is a function where the
/// instruction set has no rounding.
pub fn cell_of(point: DVec3) -> IVec3 {
    let toward_zero = point.as_ivec3();
    let above = toward_zero.as_dvec3().cmpgt(point);
    IVec3::select(above, toward_zero.wrapping_sub(IVec3::ONE), toward_zero)
}

/// Voxel coordinates as one number; they wrap after two million voxels.
pub fn pack(cell: IVec3) -> u64 {
    const BITS: u64 = 21;
    const MASK: u64 = (1 << BITS) - 1;
    let field = |coordinate: i32| i64::from(coordinate) as u64 & MASK;
    field(cell.x) | field(cell.y) << BITS | field(cell.z) << (2 * BITS)
}

/// Moments of the points in a voxel, relative to its lower corner.
#[derive(Clone, Copy, Debug, Default)]
struct Moments {
    count: f32,
    first: Vec3,
    /// xx, yy, zz
    squares: Vec3,
    /// yz, zx, xy
    products: Vec3,
    /// Path of the sensor when the last point was added [m].
    added_at_m: f32,
}

impl Moments {
    /// Adds a point; beyond `limit` points older ones are forgotten.
    fn add(&mut self, p: Vec3, limit: f32) {
        if self.count >= limit {
            let kept = (limit - 1.0) / self.count;
            self.count *= kept;
            self.first *= kept;
            self.squares *= kept;
            self.products *= kept;
        }
        self.count += 1.0;
        self.first += p;
        self.squares += p * p;
        self.products += Vec3::new(p.y * p.z, p.z * p.x, p.x * p.y);
    }

    /// Adds the moments of another cell whose corner is at `offset` from the own one.
    fn merge(&mut self, other: &Self, offset: Vec3) {
        let (n, f) = (other.count, other.first);
        self.count += n;
        self.first += f + offset * n;
        self.squares += other.squares + offset * (2.0 * f + offset * n);
        let cross = |a: Vec3, b: Vec3| Vec3::new(a.y * b.z, a.z * b.x, a.x * b.y);
        self.products +=
            other.products + cross(f, offset) + cross(offset, f) + n * cross(offset, offset);
    }
}

/// Voxels of one scale.
#[derive(Clone, Debug)]
struct VoxelGrid {
    edge_m: f64,
    cells: HashMap<u64, Moments>,
}

/// The surface near a point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Mean of the mapped points [m].
    pub center: DVec3,
    /// How they are spread.
    pub shape: Shape,
}

/// How mapped points are spread.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// A plane with a unit normal of arbitrary sign.
    Plane(DVec3),
    /// Another distribution, with its covariance [m²].
    Other(DMat3),
}

/// The local map.
#[derive(Clone, Debug)]
pub struct VoxelMap {
    levels: [VoxelGrid; 3],
    point_limit: f32,
    /// Last position of the sensor.
    sensor: Option<DVec3>,
    /// Length of its path [m].
    path_m: f64,
    /// Length of its path when voxels were last removed [m].
    removed_at_m: Option<f64>,
}

impl VoxelMap {
    /// An empty map whose finest voxels have an edge `edge_m`.
    pub fn new(edge_m: f64, point_limit: f32) -> Self {
        let level = |scale: f64| VoxelGrid {
            edge_m: edge_m * scale,
            cells: HashMap::default(),
        };
        Self {
            levels: [level(1.0), level(2.0), level(4.0)],
            point_limit,
            sensor: None,
            path_m: 0.0,
            removed_at_m: None,
        }
    }

    /// Adds points.
    pub fn insert(&mut self, points: &[DVec3]) {
        let (point_limit, path_m) = (self.point_limit, self.path_m as f32);
        self.levels.par_iter_mut().for_each(|level| {
            for &point in points {
                let cell = cell_of(point / level.edge_m);
                let offset = (point - cell.as_dvec3() * level.edge_m).as_vec3();
                let moments = level.cells.entry(pack(cell)).or_default();
                moments.add(offset, point_limit);
                moments.added_at_m = path_m;
            }
        });
    }

    /// The means of the finest voxels, in a fixed order.
    pub fn means(&self) -> Vec<DVec3> {
        let level = &self.levels[0];
        let mut keys: Vec<u64> = level.cells.keys().copied().collect();
        keys.sort_unstable();
        let mean = |key: u64| {
            let cell = &level.cells[&key];
            unpack(key).as_dvec3() * level.edge_m + (cell.first / cell.count).as_dvec3()
        };
        keys.into_iter().map(mean).collect()
    }

    /// Moves the sensor. Removes voxels farther than `radius_m` from it, and voxels that got no point while it moved by ten
    /// radii: they have the drift of the odometry since then, and with them the map of a car that stays in one area would grow
    /// without limit. Voxels are checked every 0.02 radii of the path.
    pub fn move_sensor(&mut self, to: DVec3, radius_m: f64) {
        /// Path after which a voxel without a new point is removed, in radii.
        const PATH_IN_RADII: f64 = 10.0;
        /// Path between two checks, in radii.
        const STEP: f64 = 0.02;
        self.path_m += self.sensor.replace(to).map_or(0.0, |it| it.distance(to));
        if (self.removed_at_m).is_some_and(|at_m| self.path_m - at_m < STEP * radius_m) {
            return;
        }
        self.removed_at_m = Some(self.path_m);
        let oldest_m = (self.path_m - PATH_IN_RADII * radius_m) as f32;
        self.levels.par_iter_mut().for_each(|level| {
            let edge_m = level.edge_m;
            level.cells.retain(|&key, cell| {
                let corner = unpack(key).as_dvec3() * edge_m;
                corner.distance_squared(to) <= radius_m * radius_m && cell.added_at_m >= oldest_m
            });
        });
    }

    /// The block of finest voxels around a point: two points in one block have the same surface.
    pub fn block(&self, point: DVec3) -> IVec3 {
        self.levels[0].block(point)
    }

    /// The surface near a point; `None` where nothing is mapped.
    pub fn surface(&self, point: DVec3) -> Option<Surface> {
        let mut other = None;
        for level in &self.levels {
            let Some(surface) = level.surface(point) else {
                continue;
            };
            if matches!(surface.shape, Shape::Plane(_)) {
                return Some(surface);
            }
            other = other.or(Some(surface));
        }
        other
    }
}

/// The inverse of [`pack`].
fn unpack(key: u64) -> IVec3 {
    let field = |shift: u32| ((key << (43 - shift)) as i64 >> 43) as i32;
    IVec3::new(field(0), field(21), field(42))
}

impl VoxelGrid {
    fn block(&self, point: DVec3) -> IVec3 {
        cell_of(point / self.edge_m - 0.5)
    }

    fn surface(&self, point: DVec3) -> Option<Surface> {
        /// Fewer points have no plane.
        const MIN_POINTS: f32 = 5.0;
        /// Largest share of the smallest variance in the second one of a plane.
        const FLAT: f64 = 0.1;
        /// Smallest share of the second variance in the largest one of a plane.
        const WIDE: f64 = 0.05;
        let block = self.block(point);
        let edge_m = self.edge_m as f32;
        let mut sums = Moments::default();
        for corner in 0..8 {
            let step = IVec3::new(corner & 1, (corner >> 1) & 1, corner >> 2);
            if let Some(cell) = self.cells.get(&pack(block + step)) {
                // Relative to the middle of the block.
                sums.merge(cell, (step - IVec3::ONE).as_vec3() * edge_m);
            }
        }
        if sums.count < MIN_POINTS {
            return None;
        }
        let middle = (block + IVec3::ONE).as_dvec3() * self.edge_m;
        let (s, p) = (sums.squares.as_dvec3(), sums.products.as_dvec3());
        let second = DMat3::from_cols(
            DVec3::new(s.x, p.z, p.y),
            DVec3::new(p.z, s.y, p.x),
            DVec3::new(p.y, p.x, s.z),
        );
        let count = f64::from(sums.count);
        let first = sums.first.as_dvec3();
        let plane = PlaneSums::from_moments(Vec3::ZERO, count, first, second).fit()?;
        let [smallest, middle_one, largest] = plane.variances;
        if middle_one <= WIDE * largest {
            return None;
        }
        let mean = first / count;
        let outer = DMat3::from_cols(mean * mean.x, mean * mean.y, mean * mean.z);
        Some(Surface {
            center: middle + mean,
            shape: if smallest < FLAT * middle_one {
                Shape::Plane(plane.normal.as_dvec3())
            } else {
                Shape::Other(second * (1.0 / count) - outer)
            },
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_those_of_the_floor_of_coordinates() {
        for value in [-2.0, -1.5, -1e-9, -0.0, 0.0, 0.3, 1.0, 1.999, 7e5 + 0.5] {
            let cell = cell_of(DVec3::new(value, -value, 2.0 * value));
            let expected = DVec3::new(value, -value, 2.0 * value).floor();
            assert_eq!(cell.as_dvec3(), expected);
        }
    }

    #[test]
    fn unpacking_inverts_packing() {
        for cell in [
            IVec3::ZERO,
            IVec3::new(-1, 5, -1_000_000),
            IVec3::new(1_048_575, -3, 7),
        ] {
            assert_eq!(unpack(pack(cell)), cell);
        }
    }

    fn tilted_plane() -> (Vec<DVec3>, DVec3) {
        let normal = DVec3::new(0.2, -0.3, 1.0).normalize();
        let u = normal.any_orthonormal_vector();
        let v = normal.cross(u);
        let origin = DVec3::new(4000.3, -2000.1, 3.3);
        let points = (-20..20).flat_map(|a| {
            (-20..20).map(move |b| origin + u * f64::from(a) * 0.2 + v * f64::from(b) * 0.2)
        });
        (points.collect(), normal)
    }

    #[test]
    fn points_of_a_plane_have_its_normal_also_across_voxels_and_far_from_the_origin() {
        let (points, normal) = tilted_plane();
        let mut map = VoxelMap::new(0.5, 50.0);
        map.insert(&points);
        for &point in points.iter().skip(800).step_by(37).take(5) {
            let surface = map.surface(point + normal * 0.1).unwrap();
            let Shape::Plane(found) = surface.shape else {
                panic!("{surface:?}");
            };
            assert!(found.dot(normal).abs() > 0.9999, "{found}");
            assert!((surface.center - point).dot(normal).abs() < 1e-3);
        }
        assert_eq!(map.surface(points[0] + normal * 50.0), None);
    }

    #[test]
    fn a_surface_is_that_of_the_points_in_all_eight_voxels_of_a_block() {
        // Blocks on both sides of the origin.
        for index in 0..64 {
            let block = IVec3::new(index % 4, index / 4 % 4, index / 16) - 2;
            let middle = (block + IVec3::ONE).as_dvec3();
            let sides = |place: i32| IVec3::new(place & 1, (place >> 1) & 1, place >> 2).as_dvec3();
            let corner = |place| (sides(place) - 0.5) * DVec3::new(1.0, 0.8, 0.6);
            let points: Vec<DVec3> = (0..8).map(|place| middle + corner(place)).collect();
            let mut map = VoxelMap::new(1.0, 50.0);
            map.insert(&points);
            let found = map.surface(middle).unwrap();
            assert!(found.center.distance(middle) < 1e-6, "{block}");
            assert!(matches!(found.shape, Shape::Other(_)));
        }
    }

    #[test]
    fn a_full_voxel_forgets_and_keeps_its_mean() {
        let mut cell = Moments::default();
        for _ in 0..100 {
            cell.add(Vec3::splat(0.1), 10.0);
        }
        for _ in 0..30 {
            cell.add(Vec3::splat(0.3), 10.0);
        }
        assert!((cell.count - 10.0).abs() < 1e-3);
        assert!((cell.first.x / cell.count - 0.3).abs() < 0.01);
    }

    #[test]
    fn distant_voxels_are_removed() {
        let (points, _) = tilted_plane();
        let mut map = VoxelMap::new(0.5, 50.0);
        map.insert(&points);
        map.move_sensor(points[0], 1.0);
        assert!(map.surface(points[0]).is_some() && map.surface(points[1599]).is_none());
        let mut map = VoxelMap::new(0.5, 50.0);
        map.insert(&points);
        map.move_sensor(DVec3::ZERO, 1.0);
        assert!(map.means().is_empty());
    }

    #[test]
    fn voxels_that_no_point_reaches_over_a_long_path_are_removed() {
        let mut map = VoxelMap::new(0.5, 50.0);
        let at = |x: f64| DVec3::new(x, 0.0, 0.0);
        map.insert(&[at(1.0), at(2.0)]);
        // To and fro over 2 m, with a radius of 5 m: 50 m of path.
        for pass in 0..26 {
            assert_eq!(map.means().len(), 2, "{pass}");
            map.move_sensor(at(2.0 * f64::from(pass % 2)), 5.0);
            map.insert(&[at(2.0)]);
        }
        map.move_sensor(at(0.0), 5.0);
        assert_eq!(map.means(), [at(2.0)]);
    }
}
