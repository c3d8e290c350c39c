//! Solids put together from triangles, every triangle with its class and reflectance.

use std::f32::consts::TAU;

use glam::Vec3;
use rand::{Rng, RngExt as _};

use crate::geometry::{Rigid3f, TriangleMesh};

/// Longest edge of the pieces into which large flat faces are cut [m].
const LONGEST_EDGE_M: f32 = 2.0;

/// What a surface is and how much light it returns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Paint {
    /// SemanticKITTI class.
    pub class: u16,
    /// Share of the light that returns at normal incidence, 0 to 1.
    pub reflectance: f32,
}

/// A mesh with a paint per triangle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PaintedMesh {
    /// The surface.
    pub mesh: TriangleMesh,
    /// One per triangle.
    pub paints: Vec<Paint>,
}

impl PaintedMesh {
    /// Appends another mesh.
    pub fn append(&mut self, other: &Self) {
        self.mesh.append(&other.mesh);
        self.paints.extend_from_slice(&other.paints);
    }

    /// Appends a triangle of three new vertices.
    pub fn push(&mut self, corners: [Vec3; 3], paint: Paint) {
        let first = self.mesh.vertices.len() as u32;
        self.mesh.vertices.extend(corners);
        self.mesh.triangles.push([first, first + 1, first + 2]);
        self.paints.push(paint);
    }
}

/// Adds solids given in a frame of their own to a mesh.
pub struct Builder<'a> {
    target: &'a mut PaintedMesh,
    world_from_local: Rigid3f,
    paint: Paint,
}

impl<'a> Builder<'a> {
    /// Starts at a place with a paint.
    pub fn new(target: &'a mut PaintedMesh, world_from_local: Rigid3f, paint: Paint) -> Self {
        Self {
            target,
            world_from_local,
            paint,
        }
    }

    /// Changes the paint of what follows.
    pub fn paint(&mut self, class: u16, reflectance: f32) -> &mut Self {
        self.paint = Paint { class, reflectance };
        self
    }

    /// A triangle, counter-clockwise seen from outside.
    pub fn triangle(&mut self, corners: [Vec3; 3]) {
        let corners = corners.map(|corner| self.world_from_local.apply(corner));
        self.target.push(corners, self.paint);
    }

    /// A flat or bent quadrilateral, counter-clockwise seen from outside, cut into small pieces.
    pub fn quad(&mut self, [a, b, c, d]: [Vec3; 4]) {
        let pieces = |p: Vec3, q: Vec3, r: Vec3, s: Vec3| {
            let edge_m = p.distance(q).max(r.distance(s));
            (edge_m / LONGEST_EDGE_M).ceil().max(1.0) as usize
        };
        let (columns, rows) = (pieces(a, b, d, c), pieces(a, d, b, c));
        let at = |column: usize, row: usize| {
            let (u, v) = (column as f32 / columns as f32, row as f32 / rows as f32);
            a.lerp(b, u).lerp(d.lerp(c, u), v)
        };
        for row in 0..rows {
            for column in 0..columns {
                let [p, q] = [at(column, row), at(column + 1, row)];
                let [r, s] = [at(column + 1, row + 1), at(column, row + 1)];
                self.triangle([p, q, r]);
                self.triangle([p, r, s]);
            }
        }
    }

    /// A box with horizontal top and bottom rectangles that may differ: `bottom` and `top` are
    /// lower and upper corners, x and y of the rectangle and z of its height.
    pub fn frustum(&mut self, bottom: [Vec3; 2], top: [Vec3; 2]) {
        let ring = |[low, high]: [Vec3; 2]| {
            let z = low.z;
            [
                Vec3::new(low.x, low.y, z),
                Vec3::new(high.x, low.y, z),
                Vec3::new(high.x, high.y, z),
                Vec3::new(low.x, high.y, z),
            ]
        };
        let (low, high) = (ring(bottom), ring(top));
        for side in 0..4 {
            let next = (side + 1) % 4;
            self.quad([low[side], low[next], high[next], high[side]]);
        }
        self.quad(high);
        self.quad([low[3], low[2], low[1], low[0]]);
    }

    /// An axis-aligned box between two corners.
    pub fn cuboid(&mut self, min: Vec3, max: Vec3) {
        let bottom = [min, Vec3::new(max.x, max.y, min.z)];
        let top = [Vec3::new(min.x, min.y, max.z), max];
        self.frustum(bottom, top);
    }

    /// A convex outline in the x-z plane (counter-clockwise seen from -y), drawn out along y.
    pub fn prism(&mut self, outline: &[(f32, f32)], y_min: f32, y_max: f32) {
        let at = |index: usize, y: f32| {
            let (x, z) = outline[index % outline.len()];
            Vec3::new(x, y, z)
        };
        for index in 0..outline.len() {
            let next = index + 1;
            self.quad([
                at(index, y_min),
                at(index, y_max),
                at(next, y_max),
                at(next, y_min),
            ]);
            if (1..outline.len() - 1).contains(&index) {
                self.triangle([at(0, y_min), at(index, y_min), at(next, y_min)]);
                self.triangle([at(0, y_max), at(next, y_max), at(index, y_max)]);
            }
        }
    }

    /// An upright cylinder or cone on its bottom centre.
    pub fn cylinder(&mut self, base: Vec3, radii_m: [f32; 2], height_m: f32, sides: usize) {
        let at = |side: usize, radius_m: f32, z: f32| {
            let angle = TAU * (side % sides) as f32 / sides as f32;
            base + Vec3::new(radius_m * angle.cos(), radius_m * angle.sin(), z)
        };
        let [low_m, high_m] = radii_m;
        for side in 0..sides {
            let next = side + 1;
            self.quad([
                at(side, low_m, 0.0),
                at(next, low_m, 0.0),
                at(next, high_m, height_m),
                at(side, high_m, height_m),
            ]);
            let top = base + Vec3::Z * height_m;
            self.triangle([at(side, high_m, height_m), at(next, high_m, height_m), top]);
        }
    }

    /// A lumpy ellipsoid; each vertex is moved along its radius by up to `roughness` of it.
    pub fn blob(&mut self, center: Vec3, radii_m: Vec3, roughness: f32, rng: &mut impl Rng) {
        const RINGS: usize = 6;
        const SIDES: usize = 9;
        let mut vertices = vec![[Vec3::ZERO; SIDES]; RINGS + 1];
        for (ring, row) in vertices.iter_mut().enumerate() {
            let polar = std::f32::consts::PI * ring as f32 / RINGS as f32;
            let pole_scale = 1.0 + roughness * rng.random_range(-1.0..1.0);
            for (side, vertex) in row.iter_mut().enumerate() {
                let at_pole = ring == 0 || ring == RINGS;
                let scale = if at_pole {
                    pole_scale
                } else {
                    1.0 + roughness * rng.random_range(-1.0..1.0)
                };
                let turn = TAU * side as f32 / SIDES as f32 + 0.3 * ring as f32;
                let unit = Vec3::new(
                    polar.sin() * turn.cos(),
                    polar.sin() * turn.sin(),
                    -polar.cos(),
                );
                *vertex = center + scale * radii_m * unit;
            }
        }
        for ring in 0..RINGS {
            for side in 0..SIDES {
                let next = (side + 1) % SIDES;
                let [a, b] = [vertices[ring][side], vertices[ring][next]];
                let [c, d] = [vertices[ring + 1][next], vertices[ring + 1][side]];
                if ring > 0 {
                    self.triangle([a, b, c]);
                }
                if ring < RINGS - 1 {
                    self.triangle([a, c, d]);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use rand::{SeedableRng as _, rngs::StdRng};

    use super::*;

    /// Volume by the divergence theorem: right only if every face is there and looks outwards.
    fn volume(build: impl FnOnce(&mut Builder)) -> f32 {
        let mut target = PaintedMesh::default();
        let still = Rigid3f::from(&crate::geometry::Pose3::identity());
        let paint = Paint {
            class: 1,
            reflectance: 0.5,
        };
        build(&mut Builder::new(&mut target, still, paint));
        assert_eq!(target.paints.len(), target.mesh.triangles.len());
        (0..target.mesh.triangles.len())
            .map(|triangle| {
                let [a, b, c] = target.mesh.corners(triangle);
                a.dot(b.cross(c)) / 6.0
            })
            .sum()
    }

    #[test]
    fn solids_are_closed_and_look_outwards() {
        let cuboid = volume(|b| b.cuboid(Vec3::new(1.0, 2.0, 3.0), Vec3::new(4.0, 7.0, 5.0)));
        assert!((cuboid - 30.0).abs() < 1e-3, "{cuboid}");
        let wedge = volume(|b| b.prism(&[(0.0, 0.0), (3.0, 0.0), (0.0, 2.0)], -1.0, 4.0));
        assert!((wedge - 15.0).abs() < 1e-3, "{wedge}");
        let mut rng = StdRng::seed_from_u64(1);
        let ball = volume(|b| b.blob(Vec3::ONE, Vec3::ONE, 0.0, &mut rng));
        assert!(ball > 3.2 && ball < 4.19, "{ball}");
    }

    #[test]
    fn a_wall_is_cut_into_pieces_of_at_most_two_metres() {
        let mut target = PaintedMesh::default();
        let still = Rigid3f::from(&crate::geometry::Pose3::identity());
        let paint = Paint {
            class: 1,
            reflectance: 0.5,
        };
        Builder::new(&mut target, still, paint).quad([
            Vec3::ZERO,
            7.0 * Vec3::X,
            7.0 * Vec3::X + 3.0 * Vec3::Z,
            3.0 * Vec3::Z,
        ]);
        let area: f32 = (0..target.mesh.triangles.len())
            .map(|triangle| 0.5 * target.mesh.scaled_normal(triangle).length())
            .sum();
        assert!((area - 21.0).abs() < 1e-4);
        for triangle in 0..target.mesh.triangles.len() {
            let [a, b, c] = target.mesh.corners(triangle);
            let size = a.max(b).max(c) - a.min(b).min(c);
            assert!(size.max_element() <= 2.0 + 1e-5);
        }
    }
}
