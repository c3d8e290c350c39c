//! The planes around a vertex, and the fan of triangles that replaces it after an edge collapse.

use glam::{Vec2, Vec3};

/// Minimum cosine between a new triangle and the mean normal of the old ones: 25 degrees.
const MIN_COSINE: f32 = 0.9;
/// Minimum shape of a new triangle (unitless): twice its area over its longest edge squared.
const MIN_SHAPE: f32 = 0.05;

/// Squared distance of a point to a line segment [m²].
pub fn distance_squared(point: Vec3, a: Vec3, b: Vec3) -> f32 {
    let edge = b - a;
    let share = (point - a).dot(edge) / edge.length_squared().max(f32::MIN_POSITIVE);
    point.distance_squared(a + share.clamp(0.0, 1.0) * edge)
}

/// Error quadric of the planes through one vertex, weighted by area.
#[derive(Default)]
pub struct Quadric {
    /// Σ A n.
    pub normal: Vec3,
    /// Σ A n nᵀ: its diagonal, and yz, zx, xy.
    diagonal: Vec3,
    mixed: Vec3,
    area: f32,
}

impl Quadric {
    /// Adds a plane by its normal, whose length is its weight.
    pub fn add(&mut self, scaled_normal: Vec3) {
        let area = scaled_normal.length();
        if area > 0.0 {
            let n = scaled_normal;
            self.normal += n;
            self.diagonal += n * n / area;
            self.mixed += Vec3::new(n.y * n.z, n.z * n.x, n.x * n.y) / area;
            self.area += area;
        }
    }

    /// Mean squared distance to the planes of a point relative to the vertex [m²].
    pub fn error(&self, p: Vec3) -> f32 {
        let mixed = Vec3::new(p.y * p.z, p.z * p.x, p.x * p.y);
        (self.diagonal.dot(p * p) + 2.0 * self.mixed.dot(mixed)) / self.area
    }
}

/// Triangles with one common vertex, projected along the normal of the triangles that they replace.
#[derive(Default)]
pub struct Fan {
    origin: Vec3,
    /// Two axes of the projection plane, and its normal.
    axes: [Vec3; 3],
    triangles: Vec<FanTriangle>,
}

impl Fan {
    /// Starts a new fan around a vertex.
    pub fn start(&mut self, origin: Vec3, unit_normal: Vec3) {
        let (x, y) = unit_normal.any_orthonormal_pair();
        self.origin = origin;
        self.axes = [x, y, unit_normal];
        self.triangles.clear();
    }

    /// The projection of a point relative to the origin, and its height [m].
    fn project(&self, point: Vec3) -> (Vec2, f32) {
        let p = point - self.origin;
        let [x, y, z] = self.axes.map(|axis| axis.dot(p));
        (Vec2::new(x, y), z)
    }

    /// Whether there is no triangle.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// Adds the triangle of the origin, b and c, and returns true, unless it is flipped, steep, thin or
    /// too large.
    pub fn add(&mut self, index: usize, b: Vec3, c: Vec3, max_edge_m: f32) -> bool {
        let [b, c] = [b, c].map(|corner| self.project(corner));
        let spoke = b.0.length_squared().max(c.0.length_squared());
        let longest = spoke.max(b.0.distance_squared(c.0));
        let area = b.0.perp_dot(c.0);
        // The normal is (lean rotated by 90 degrees, area).
        let lean = b.1 * c.0 - c.1 * b.0;
        let is_level = area >= MIN_COSINE * (lean.length_squared() + area * area).sqrt();
        let is_thick = area > MIN_SHAPE * longest;
        let is_valid = is_level && is_thick && spoke <= max_edge_m * max_edge_m;
        if is_valid {
            let inverse_area = 1.0 / area;
            self.triangles.push(FanTriangle {
                index,
                b,
                c,
                inverse_area,
            });
        }
        is_valid
    }

    /// The index of the triangle below or above a point, and the squared distance to a point on it
    /// that is approximately the nearest.
    pub fn nearest(&self, point: Vec3) -> (usize, f32) {
        let (position, height) = self.project(point);
        let mut best = (f32::NEG_INFINITY, 0, Vec3::X);
        for (index, triangle) in self.triangles.iter().enumerate() {
            let coordinates = triangle.barycentric(position);
            let least = coordinates.min_element();
            if least > best.0 {
                best = (least, index, coordinates);
            }
            if least >= 0.0 {
                break;
            }
        }
        let FanTriangle { index, b, c, .. } = &self.triangles[best.1];
        let coordinates = best.2.max(Vec3::ZERO);
        let coordinates = coordinates / coordinates.element_sum();
        let foot = coordinates.y * b.0 + coordinates.z * c.0;
        let rise = height - coordinates.y * b.1 - coordinates.z * c.1;
        (*index, foot.distance_squared(position) + rise * rise)
    }
}

/// A triangle of the origin and two points, projected.
struct FanTriangle {
    /// Index of the triangle that it replaces.
    index: usize,
    b: (Vec2, f32),
    c: (Vec2, f32),
    inverse_area: f32,
}

impl FanTriangle {
    /// Barycentric coordinates of a point with respect to the origin, b and c.
    fn barycentric(&self, position: Vec2) -> Vec3 {
        let b = position.perp_dot(self.c.0) * self.inverse_area;
        let c = self.b.0.perp_dot(position) * self.inverse_area;
        Vec3::new(1.0 - b - c, b, c)
    }
}
