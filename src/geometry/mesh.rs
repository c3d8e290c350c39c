//! Triangle meshes with vertex normals and colors, and axis-aligned boxes.

use glam::{DVec3, Vec3};

/// Step of the lattice of map vertices, 0.49 mm: a power of two, so that sums and differences of its points are exact
/// in `f32` up to 8 km [m].
pub const STEP_M: f32 = 1.0 / 2048.0;

/// The nearest point of the lattice of map vertices.
pub fn on_lattice(position: DVec3) -> DVec3 {
    (position / f64::from(STEP_M)).round() * f64::from(STEP_M)
}

/// Triangles over shared vertices. `normals` and `colors` are per vertex; either is empty
/// if unknown, otherwise as long as `vertices`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// Vertex positions [m].
    pub vertices: Vec<Vec3>,
    /// Unit vertex normals.
    pub normals: Vec<Vec3>,
    /// Vertex colors, red green blue.
    pub colors: Vec<[u8; 3]>,
    /// Vertex indices, counter-clockwise seen from the front.
    pub triangles: Vec<[u32; 3]>,
}

impl TriangleMesh {
    /// The three corners of a triangle [m], in the frame of the mesh.
    #[inline]
    pub fn corners(&self, triangle: usize) -> [Vec3; 3] {
        self.triangles[triangle].map(|vertex| self.vertices[vertex as usize])
    }

    /// Normal of a triangle by the right-hand rule; its length is twice the area.
    #[inline]
    pub(crate) fn scaled_normal(&self, triangle: usize) -> Vec3 {
        let [a, b, c] = self.corners(triangle);
        (b - a).cross(c - a)
    }

    /// Moves each vertex to the nearest point of a lattice of 1/2048 m, by at most 0.43 mm: ray casting keeps such
    /// triangles in less than half of the memory.
    pub fn snap(&mut self) {
        for vertex in &mut self.vertices {
            *vertex = (*vertex / STEP_M).round() * STEP_M;
        }
    }

    /// Appends another mesh without merging vertices. Normals and colors are kept if both have them.
    pub fn append(&mut self, other: &Self) {
        let had_vertices = !self.vertices.is_empty();
        let offset = self.vertices.len() as u32;
        let keep_normals = !had_vertices || self.normals.len() == self.vertices.len();
        let keep_colors = !had_vertices || self.colors.len() == self.vertices.len();
        self.vertices.extend_from_slice(&other.vertices);
        self.triangles
            .extend(other.triangles.iter().map(|t| t.map(|v| v + offset)));
        if keep_normals {
            self.normals.extend_from_slice(&other.normals);
        }
        if keep_colors {
            self.colors.extend_from_slice(&other.colors);
        }
    }

    /// Keeps the triangles whose index and vertices satisfy `keep` and removes unreferenced
    /// vertices. Returns the number of removed triangles.
    pub fn retain_triangles(&mut self, keep: impl Fn(usize, [u32; 3]) -> bool) -> usize {
        let count = self.triangles.len();
        let mut index = 0;
        self.triangles.retain(|&triangle| {
            index += 1;
            keep(index - 1, triangle)
        });
        self.drop_unreferenced_vertices();
        count - self.triangles.len()
    }

    /// Removes the vertices without a triangle and keeps the order of the others.
    pub(crate) fn drop_unreferenced_vertices(&mut self) {
        const UNUSED: u32 = u32::MAX;
        let mut new_index = vec![UNUSED; self.vertices.len()];
        for vertex in self.triangles.iter().flatten() {
            new_index[*vertex as usize] = 0;
        }
        let mut kept = 0;
        for (old, new) in new_index.iter_mut().enumerate() {
            if *new == UNUSED {
                continue;
            }
            *new = kept as u32;
            self.vertices[kept] = self.vertices[old];
            if !self.normals.is_empty() {
                self.normals[kept] = self.normals[old];
            }
            if !self.colors.is_empty() {
                self.colors[kept] = self.colors[old];
            }
            kept += 1;
        }
        self.vertices.truncate(kept);
        self.normals.truncate(kept);
        self.colors.truncate(kept);
        for vertex in self.triangles.iter_mut().flatten() {
            *vertex = new_index[*vertex as usize];
        }
    }

    /// Computes area-weighted unit vertex normals.
    pub(crate) fn compute_normals(&mut self) {
        let mut normals = vec![Vec3::ZERO; self.vertices.len()];
        for triangle in 0..self.triangles.len() {
            let normal = self.scaled_normal(triangle);
            for vertex in self.triangles[triangle] {
                normals[vertex as usize] += normal;
            }
        }
        for normal in &mut normals {
            *normal = normal.normalize_or(Vec3::Z);
        }
        self.normals = normals;
    }

    /// Bounding box of all vertices.
    pub fn bounds(&self) -> Aabb {
        Aabb::from_points(self.vertices.iter().copied())
    }
}

/// An axis-aligned bounding box; empty if `min > max`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Aabb {
    /// Lower corner [m].
    pub min: Vec3,
    /// Upper corner [m].
    pub max: Vec3,
}

impl Aabb {
    /// The empty box.
    pub const EMPTY: Self = Self {
        min: Vec3::INFINITY,
        max: Vec3::NEG_INFINITY,
    };

    /// Bounding box of points.
    pub fn from_points(points: impl IntoIterator<Item = Vec3>) -> Self {
        let grown = |bounds: Self, point| Self {
            min: bounds.min.min(point),
            max: bounds.max.max(point),
        };
        points.into_iter().fold(Self::EMPTY, grown)
    }

    /// Bounding box of two boxes.
    #[must_use]
    pub(crate) fn union(self, other: Self) -> Self {
        Self {
            min: self.min.min(other.min),
            max: self.max.max(other.max),
        }
    }

    /// Whether the box contains no point.
    pub fn is_empty(&self) -> bool {
        self.min.cmpgt(self.max).any()
    }

    /// Edge lengths [m].
    pub fn size(&self) -> Vec3 {
        self.max - self.min
    }

    /// Center [m].
    pub(crate) fn center(&self) -> Vec3 {
        0.5 * (self.min + self.max)
    }
}

#[cfg(test)]
impl TriangleMesh {
    /// A wall of 18 x 18 m across the x axis, whose front faces ahead.
    pub(crate) fn wall(x_m: f32) -> Self {
        let corners = [(-9.0, -9.0), (9.0, -9.0), (9.0, 9.0), (-9.0, 9.0)];
        Self {
            vertices: corners.map(|(y, z)| Vec3::new(x_m, y, z)).to_vec(),
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..Self::default()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square() -> TriangleMesh {
        TriangleMesh {
            vertices: vec![Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Y, Vec3::Y],
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..TriangleMesh::default()
        }
    }

    #[test]
    fn the_normal_of_a_counter_clockwise_square_points_up() {
        let mut mesh = square();
        mesh.compute_normals();
        assert!(mesh.normals.iter().all(|&normal| normal == Vec3::Z));
    }

    #[test]
    fn removing_a_triangle_removes_only_its_unshared_vertex() {
        let mut mesh = square();
        let removed = mesh.retain_triangles(|index, _| index == 1);
        assert_eq!(removed, 1);
        assert_eq!(mesh.vertices, [Vec3::ZERO, Vec3::X + Vec3::Y, Vec3::Y]);
        assert_eq!(mesh.triangles, [[0, 1, 2]]);
    }

    #[test]
    fn appending_shifts_the_indices() {
        let mut mesh = square();
        mesh.append(&square());
        assert_eq!(mesh.triangles[2], [4, 5, 6]);
        assert_eq!(mesh.corners(2), square().corners(0));
    }

    #[test]
    fn the_box_of_no_points_is_empty() {
        assert!(Aabb::EMPTY.is_empty());
        assert!(Aabb::from_points([]).is_empty());
        assert_eq!(Aabb::from_points([Vec3::X]).center(), Vec3::X);
    }
}
