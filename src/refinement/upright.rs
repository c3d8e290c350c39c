//! Upright surfaces of a map seen from above, and the distances to the nearest one.
//!
//! Walls, cars, poles and trunks: what tells one place from another, and attracts a scan from metres away. Distances
//! are those of the raster transform of Borgefors, *Distance Transformations in Digital Images* (1986), within 4 %.

use std::collections::{HashMap, HashSet};

use glam::Vec3;
use nalgebra::Vector2;

use crate::geometry::TriangleMesh;
use crate::map::GroundPatch;

/// Edge of the cells of points [m].
const CELL_M: f32 = 16.0;

/// Distance between points of a surface [m].
const SPACING_M: f32 = 0.2;

/// Heights above the ground between which surfaces count [m].
const HEIGHTS_M: std::ops::Range<f64> = 0.4..6.0;

/// Points on the upright surfaces of a mesh, by cell of the plane.
#[derive(Clone, Debug)]
pub struct UprightSurfaces {
    cells: HashMap<[i32; 2], Vec<Vec3>>,
}

impl UprightSurfaces {
    /// Collects the surfaces of a mesh in the map frame.
    pub fn new(mesh: &TriangleMesh) -> Self {
        /// Vertical component of the normal of an upright surface, at most.
        const UPRIGHT: f32 = 0.5;
        /// Largest number of points along an edge, for meshes with triangles of any size.
        const MOST: f32 = 500.0;
        let mut seen = HashSet::new();
        let mut cells: HashMap<[i32; 2], Vec<Vec3>> = HashMap::new();
        for (number, triangle) in mesh.triangles.iter().enumerate() {
            let normal = mesh.scaled_normal(number);
            if normal.z.abs() >= UPRIGHT * normal.length() {
                continue;
            }
            let [a, b, c] = triangle.map(|vertex| mesh.vertices[vertex as usize]);
            let longest_m = (b - a).length().max((c - a).length());
            let steps = (longest_m / SPACING_M).ceil().clamp(1.0, MOST) as u32;
            for i in 0..steps {
                for j in 0..steps - i {
                    // Middles of the small triangles.
                    let [u, v] = [i, j].map(|step| (step as f32 + 1.0 / 3.0) / steps as f32);
                    let point = a + u * (b - a) + v * (c - a);
                    if seen.insert((point / SPACING_M).floor().as_ivec3()) {
                        cells
                            .entry(cell_of(point.x, point.y))
                            .or_default()
                            .push(point);
                    }
                }
            }
        }
        Self { cells }
    }

    /// Distances to the nearest surface within a radius, of surfaces above the plane of a ground patch.
    pub fn distances(
        &self,
        center: Vector2<f64>,
        patch: &GroundPatch,
        radius_m: f64,
        limit_m: f32,
    ) -> DistanceField {
        let mut field = DistanceField::empty(center, radius_m, limit_m);
        let [low, high] = [-radius_m, radius_m].map(|m| {
            let corner = center.add_scalar(m);
            cell_of(corner.x as f32, corner.y as f32)
        });
        let points = (low[0]..=high[0])
            .flat_map(|x| (low[1]..=high[1]).map(move |y| [x, y]))
            .filter_map(|cell| self.cells.get(&cell))
            .flatten();
        for point in points {
            let offset = Vector2::new(f64::from(point.x), f64::from(point.y)) - center;
            let slope = (patch.normal.x * offset.x + patch.normal.y * offset.y) / patch.normal.z;
            let above_m = f64::from(point.z) - (patch.height_m - slope);
            if HEIGHTS_M.contains(&above_m) {
                field.occupy(f64::from(point.x), f64::from(point.y));
            }
        }
        field.transform();
        field
    }
}

/// Whether a height above the ground is that of an upright surface [m].
pub fn is_upright_height(above_m: f64) -> bool {
    HEIGHTS_M.contains(&above_m)
}

fn cell_of(x: f32, y: f32) -> [i32; 2] {
    [x, y].map(|m| (m / CELL_M).floor() as i32)
}

/// Distances to the nearest occupied cell on a grid, up to a limit.
#[derive(Clone, Debug)]
pub struct DistanceField {
    origin: Vector2<f64>,
    width: usize,
    limit_m: f32,
    distances_m: Vec<f32>,
}

impl DistanceField {
    /// Edge of a cell [m].
    const EDGE_M: f64 = 0.2;

    fn empty(center: Vector2<f64>, radius_m: f64, limit_m: f32) -> Self {
        let width = (2.0 * radius_m / Self::EDGE_M).ceil() as usize + 1;
        Self {
            origin: center.add_scalar(-radius_m),
            width,
            limit_m,
            distances_m: vec![limit_m; width * width],
        }
    }

    fn index(&self, x: f64, y: f64) -> Option<usize> {
        let [column, row] = [x - self.origin.x, y - self.origin.y].map(|m| m / Self::EDGE_M);
        let width = self.width as f64;
        let is_inside = (0.0..width).contains(&column) && (0.0..width).contains(&row);
        is_inside.then(|| row as usize * self.width + column as usize)
    }

    fn occupy(&mut self, x: f64, y: f64) {
        if let Some(index) = self.index(x, y) {
            self.distances_m[index] = 0.0;
        }
    }

    /// Distance at a position [m]; the limit outside the grid.
    pub fn at(&self, x: f64, y: f64) -> f32 {
        self.index(x, y)
            .map_or(self.limit_m, |index| self.distances_m[index])
    }

    /// Spreads the distances forwards, then backwards.
    fn transform(&mut self) {
        let width = self.width as isize;
        let straight = Self::EDGE_M as f32;
        let diagonal = straight * std::f32::consts::SQRT_2;
        let before = [
            (-1, 0, straight),
            (0, -1, straight),
            (-1, -1, diagonal),
            (1, -1, diagonal),
        ];
        let cells: Vec<(isize, isize)> = (0..width)
            .flat_map(|row| (0..width).map(move |column| (column, row)))
            .collect();
        let mut spread = |(column, row): (isize, isize), sign: isize| {
            let mut least = self.distances_m[(row * width + column) as usize];
            for (dx, dy, length) in before {
                let (x, y) = (column + sign * dx, row + sign * dy);
                if (0..width).contains(&x) && (0..width).contains(&y) {
                    least = least.min(self.distances_m[(y * width + x) as usize] + length);
                }
            }
            self.distances_m[(row * width + column) as usize] = least;
        };
        cells.iter().for_each(|&cell| spread(cell, 1));
        cells.iter().rev().for_each(|&cell| spread(cell, -1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall along y at x = 5, 4 m high, and the ground.
    fn wall() -> TriangleMesh {
        let corner = |x, y, z| Vec3::new(x, y, z);
        TriangleMesh {
            vertices: vec![
                corner(5.0, -20.0, 0.0),
                corner(5.0, 20.0, 0.0),
                corner(5.0, 20.0, 4.0),
                corner(5.0, -20.0, 4.0),
                corner(-20.0, -20.0, 1.0),
                corner(20.0, -20.0, 1.0),
                corner(20.0, 20.0, 1.0),
            ],
            triangles: vec![[0, 1, 2], [0, 2, 3], [4, 5, 6]],
            ..TriangleMesh::default()
        }
    }

    fn level() -> GroundPatch {
        GroundPatch {
            height_m: 0.0,
            normal: nalgebra::Vector3::z(),
        }
    }

    #[test]
    fn distances_are_those_to_the_nearest_upright_surface_up_to_the_limit() {
        let surfaces = UprightSurfaces::new(&wall());
        let field = surfaces.distances(Vector2::new(1.0, 2.0), &level(), 10.0, 3.0);
        for y in [-4.0, 0.0, 3.3, 9.0] {
            for x in [2.5, 3.4, 4.6, 5.1, 6.0] {
                let expected = (5.0_f64 - x).abs() as f32;
                let found = field.at(x, y);
                assert!((found - expected).abs() < 0.25, "{x} {y} {found}");
            }
            assert_eq!(field.at(0.5, y), 3.0);
        }
        assert_eq!(field.at(100.0, 0.0), 3.0);
    }

    #[test]
    fn heights_are_above_the_plane_of_a_sloping_ground() {
        let surfaces = UprightSurfaces::new(&wall());
        let is_near = |height_m: f64| {
            // The ground rises by sqrt(2) m per metre along x and by 1 m per metre along y: at the wall, 4 m ahead and 2 m
            // aside, it is 7.66 m higher than at the centre.
            let slope = GroundPatch {
                height_m,
                normal: nalgebra::Vector3::new(-0.5_f64.sqrt(), -0.5, 0.5),
            };
            let field = surfaces.distances(Vector2::new(1.0, 2.0), &slope, 8.0, 3.0);
            field.at(5.0, 4.0) < 0.5
        };
        // The wall of 4 m has parts that are 0.4 to 6 m above it if the centre is at -13.66 to -4.06 m.
        for height_m in [-13.0, -11.0, -8.0, -5.0] {
            assert!(is_near(height_m), "{height_m}");
        }
        for height_m in [-15.0, -3.0, 0.0, 8.0] {
            assert!(!is_near(height_m), "{height_m}");
        }
    }

    #[test]
    fn distances_between_cells_are_those_of_steps_to_eight_neighbours_up_to_the_limit() {
        let mut field = DistanceField::empty(Vector2::new(3.0, -2.0), 4.0, 2.5);
        let occupied = [(1.7, -3.9), (4.1, -0.3)];
        occupied.iter().for_each(|&(x, y)| field.occupy(x, y));
        field.transform();
        for i in 0..41 {
            for j in 0..41 {
                let (x, y) = (-0.9 + 0.2 * f64::from(i), -5.9 + 0.2 * f64::from(j));
                let exact = |&(a, b): &(f64, f64)| {
                    // Steps to the eight neighbours.
                    let (dx, dy) = ((x - a).abs(), (y - b).abs());
                    dx.max(dy) + (std::f64::consts::SQRT_2 - 1.0) * dx.min(dy)
                };
                let expected = occupied.iter().map(exact).fold(2.5, f64::min) as f32;
                let found = field.at(x, y);
                assert!(
                    (found - expected).abs() < 1e-3,
                    "{x} {y} {found} {expected}"
                );
            }
        }
        // Outside the grid.
        for (x, y) in [(-1.1, -2.0), (7.3, -2.0), (3.0, -6.1), (3.0, 2.3)] {
            assert_eq!(field.at(x, y), 2.5);
        }
    }

    #[test]
    fn surfaces_below_the_plane_of_the_ground_do_not_count() {
        let surfaces = UprightSurfaces::new(&wall());
        let above = GroundPatch {
            height_m: 10.0,
            ..level()
        };
        let field = surfaces.distances(Vector2::zeros(), &above, 8.0, 3.0);
        assert_eq!(field.at(5.0, 0.0), 3.0);
    }
}
