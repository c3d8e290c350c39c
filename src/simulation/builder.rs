//! Triangle meshes with a material per triangle, and the solids that the street is built from.

use std::f32::consts::{PI, TAU};

use glam::Vec3;
use rand::{Rng, RngExt as _};

use super::classes;
use crate::geometry::{Rigid3f, TriangleMesh};

/// Longest edge of the pieces into which large faces are subdivided [m].
const LONGEST_EDGE_M: f32 = 2.0;

/// Class and reflectance of a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Material {
    /// SemanticKITTI class.
    pub class: u16,
    /// Share of the light that is returned at normal incidence, 0 to 1.
    pub reflectance: f32,
}

impl Material {
    /// A material of a class with a reflectance.
    pub const fn new(class: u16, reflectance: f32) -> Self {
        Self { class, reflectance }
    }
}

/// A mesh with a material per triangle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LabelledMesh {
    /// The triangles.
    pub mesh: TriangleMesh,
    /// Material of each triangle.
    pub materials: Vec<Material>,
}

impl LabelledMesh {
    /// Appends a triangle of three new vertices.
    pub fn push(&mut self, corners: [Vec3; 3], material: Material) {
        let first = self.mesh.vertices.len() as u32;
        self.mesh.vertices.extend(corners);
        self.mesh.triangles.push([first, first + 1, first + 2]);
        self.materials.push(material);
    }
}

/// A horizontal rectangle: extent along x, extent along y, height z [m].
pub type HorizontalRectangle = ([f32; 2], [f32; 2], f32);

/// Adds solids, given in a local frame, to a mesh in the world frame.
pub struct MeshBuilder<'a> {
    target: &'a mut LabelledMesh,
    world_from_local: Rigid3f,
    material: Material,
}

impl<'a> MeshBuilder<'a> {
    /// A builder for solids in a local frame; it starts with a material of class "other object".
    pub fn new(target: &'a mut LabelledMesh, world_from_local: Rigid3f) -> Self {
        Self {
            target,
            world_from_local,
            material: Material::new(classes::OTHER_OBJECT, 0.5),
        }
    }

    /// Sets the material of the triangles added from now on.
    pub fn set_material(&mut self, class: u16, reflectance: f32) {
        self.material = Material::new(class, reflectance);
    }

    /// Adds a triangle, counter-clockwise seen from outside.
    pub fn triangle(&mut self, corners: [Vec3; 3]) {
        let corners = corners.map(|corner| self.world_from_local.apply(corner));
        self.target.push(corners, self.material);
    }

    /// Adds a flat or bent quadrilateral, counter-clockwise seen from outside, subdivided.
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

    /// Adds the four quadrilaterals between two rings of corners, `low` counter-clockwise seen
    /// from `high`.
    pub fn side_faces(&mut self, low: [Vec3; 4], high: [Vec3; 4]) {
        for side in 0..4 {
            let next = (side + 1) % 4;
            self.quad([low[side], low[next], high[next], high[side]]);
        }
    }

    /// Adds a frustum between two horizontal rectangles.
    pub fn frustum(&mut self, bottom: HorizontalRectangle, top: HorizontalRectangle) {
        let [low, high] = [bottom, top].map(|([x0, x1], [y0, y1], z)| {
            [(x0, y0), (x1, y0), (x1, y1), (x0, y1)].map(|(x, y)| Vec3::new(x, y, z))
        });
        self.side_faces(low, high);
        self.quad(high);
        self.quad([low[3], low[2], low[1], low[0]]);
    }

    /// Adds an axis-aligned box with its extents along x, y and z [m].
    pub fn cuboid(&mut self, x: [f32; 2], y: [f32; 2], z: [f32; 2]) {
        self.frustum((x, y, z[0]), (x, y, z[1]));
    }

    /// Extrudes a convex outline in the x-z plane (counter-clockwise seen from -y) along y.
    pub fn prism(&mut self, outline: &[(f32, f32)], [y_min, y_max]: [f32; 2]) {
        let at = |index: usize, y: f32| {
            let (x, z) = outline[index % outline.len()];
            Vec3::new(x, y, z)
        };
        for index in 0..outline.len() {
            let next = index + 1;
            let [near, far] = [y_min, y_max].map(|y| [at(index, y), at(next, y)]);
            self.quad([near[0], far[0], far[1], near[1]]);
            if (1..outline.len() - 1).contains(&index) {
                self.triangle([at(0, y_min), near[0], near[1]]);
                self.triangle([at(0, y_max), far[1], far[0]]);
            }
        }
    }

    /// Adds an upright truncated cone, without its bottom: bottom centre, bottom and top radius.
    pub fn cone(&mut self, base: Vec3, radii_m: [f32; 2], height_m: f32, sides: usize) {
        let top = base + Vec3::Z * height_m;
        for side in 0..sides {
            let [[a, d], [b, c]] = [side, side + 1].map(|side| {
                let angle = TAU * (side % sides) as f32 / sides as f32;
                let at = |radius_m: f32, z: f32| {
                    base + Vec3::new(radius_m * angle.cos(), radius_m * angle.sin(), z)
                };
                [at(radii_m[0], 0.0), at(radii_m[1], height_m)]
            });
            self.quad([a, b, c, d]);
            self.triangle([d, c, top]);
        }
    }

    /// Adds an ellipsoid; each vertex is displaced along its radius by up to the share `roughness`.
    pub fn ellipsoid(&mut self, center: Vec3, radii_m: Vec3, roughness: f32, rng: &mut impl Rng) {
        const RINGS: usize = 6;
        const SIDES: usize = 9;
        let mut vertices = [[Vec3::ZERO; SIDES]; RINGS + 1];
        for (ring, row) in vertices.iter_mut().enumerate() {
            let polar = PI * ring as f32 / RINGS as f32;
            let is_pole = ring == 0 || ring == RINGS;
            let pole_scale = 1.0 + roughness * rng.random_range(-1.0..1.0);
            for (side, vertex) in row.iter_mut().enumerate() {
                let scale = if is_pole {
                    pole_scale
                } else {
                    1.0 + roughness * rng.random_range(-1.0..1.0)
                };
                let turn = TAU * side as f32 / SIDES as f32 + 0.3 * ring as f32;
                let (x, y) = (polar.sin() * turn.cos(), polar.sin() * turn.sin());
                *vertex = center + scale * radii_m * Vec3::new(x, y, -polar.cos());
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
    use crate::geometry::Pose3;

    fn built(build: impl FnOnce(&mut MeshBuilder)) -> TriangleMesh {
        let mut target = LabelledMesh::default();
        let identity = Rigid3f::from(&Pose3::identity());
        build(&mut MeshBuilder::new(&mut target, identity));
        assert_eq!(target.materials.len(), target.mesh.triangles.len());
        target.mesh
    }

    /// Volume by the divergence theorem: right only if every face is there and faces outwards.
    fn volume(build: impl FnOnce(&mut MeshBuilder)) -> f32 {
        let mesh = built(build);
        (0..mesh.triangles.len())
            .map(|triangle| {
                let [a, b, c] = mesh.corners(triangle);
                a.dot(b.cross(c)) / 6.0
            })
            .sum()
    }

    #[test]
    fn solids_are_closed_and_face_outwards() {
        let cuboid = volume(|b| b.cuboid([1.0, 4.0], [2.0, 7.0], [3.0, 5.0]));
        assert!((cuboid - 30.0).abs() < 1e-3, "{cuboid}");
        let wedge = volume(|b| b.prism(&[(0.0, 0.0), (3.0, 0.0), (0.0, 2.0)], [-1.0, 4.0]));
        assert!((wedge - 15.0).abs() < 1e-3, "{wedge}");
        let mut rng = StdRng::seed_from_u64(1);
        let ball = volume(|b| b.ellipsoid(Vec3::ONE, Vec3::ONE, 0.0, &mut rng));
        assert!(ball > 3.2 && ball < 4.19, "{ball}");
    }

    #[test]
    fn a_wall_is_subdivided_into_pieces_of_at_most_two_metres() {
        let (x, z) = (7.0 * Vec3::X, 3.0 * Vec3::Z);
        let mesh = built(|b| b.quad([Vec3::ZERO, x, x + z, z]));
        let area: f32 = (0..mesh.triangles.len())
            .map(|triangle| 0.5 * mesh.scaled_normal(triangle).length())
            .sum();
        assert!((area - 21.0).abs() < 1e-4);
        for triangle in 0..mesh.triangles.len() {
            let [a, b, c] = mesh.corners(triangle);
            let size = a.max(b).max(c) - a.min(b).min(c);
            assert!(size.max_element() <= 2.0 + 1e-5);
        }
    }
}
