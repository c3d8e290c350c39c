//! The planes around a vertex, and the fan of triangles that takes their place when it goes.

use glam::{Vec2, Vec3};

/// No new triangle leans farther from the mean of the old ones: cosine of 25 degrees.
const MIN_COSINE: f32 = 0.9;
/// No new triangle is thinner than this: twice its area over its longest edge squared.
const MIN_SHAPE: f32 = 0.05;

/// Squared distance of a place to the line between two others [m²].
pub fn distance_squared(place: Vec3, a: Vec3, b: Vec3) -> f32 {
    let edge = b - a;
    let share = (place - a).dot(edge) / edge.length_squared().max(f32::MIN_POSITIVE);
    place.distance_squared(a + share.clamp(0.0, 1.0) * edge)
}

/// The planes through one vertex, weighted by area.
#[derive(Default)]
pub struct Planes {
    /// Sum of A n.
    pub normal: Vec3,
    /// Sum of A n nᵀ: its diagonal, and yz, zx, xy.
    diagonal: Vec3,
    mixed: Vec3,
    area: f32,
}

impl Planes {
    /// Adds a plane by its normal, as long as its weight.
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

    /// Mean squared distance of a place, seen from the vertex, to the planes [m²].
    pub fn cost(&self, p: Vec3) -> f32 {
        let mixed = Vec3::new(p.y * p.z, p.z * p.x, p.x * p.y);
        (self.diagonal.dot(p * p) + 2.0 * self.mixed.dot(mixed)) / self.area
    }
}

/// Triangles that have one vertex in common, seen along the normal of what they replace.
#[derive(Default)]
pub struct Fan {
    frame: Frame,
    blades: Vec<Blade>,
}

impl Fan {
    /// Forgets the triangles before.
    pub fn start(&mut self, origin: Vec3, unit_normal: Vec3) {
        self.frame = Frame::new(origin, unit_normal);
        self.blades.clear();
    }

    /// Whether there is no triangle.
    pub fn is_empty(&self) -> bool {
        self.blades.is_empty()
    }

    /// Adds the triangle between the origin, b and c. Whether it may be: neither turned over, nor
    /// steep, nor a needle, nor too large.
    pub fn add(&mut self, index: usize, b: Vec3, c: Vec3, max_edge_m: f32) -> bool {
        let [b, c] = [b, c].map(|corner| self.frame.of(corner));
        let spoke = b.0.length_squared().max(c.0.length_squared());
        let longest = spoke.max(b.0.distance_squared(c.0));
        let area = b.0.perp_dot(c.0);
        // The normal is this, turned by 90 degrees, and the area.
        let lean = b.1 * c.0 - c.1 * b.0;
        let is_level = area >= MIN_COSINE * (lean.length_squared() + area * area).sqrt();
        let is_fat = area > MIN_SHAPE * longest;
        let may_be = is_level && is_fat && spoke <= max_edge_m * max_edge_m;
        if may_be {
            self.blades.push(Blade::new(index, b, c, area));
        }
        may_be
    }

    /// The triangle below or above a point, and the squared distance to a place on it that is the
    /// nearest or almost the nearest.
    pub fn nearest(&self, point: Vec3) -> (usize, f32) {
        let (place, height) = self.frame.of(point);
        let mut best = (f32::NEG_INFINITY, 0, Vec3::X);
        for (index, blade) in self.blades.iter().enumerate() {
            let shares = blade.shares(place);
            let least = shares.min_element();
            if least > best.0 {
                best = (least, index, shares);
            }
            if least >= 0.0 {
                break;
            }
        }
        let blade = &self.blades[best.1];
        let shares = best.2.max(Vec3::ZERO);
        let shares = shares / shares.element_sum();
        let foot = shares.y * blade.b.0 + shares.z * blade.c.0;
        let rise = height - shares.y * blade.b.1 - shares.z * blade.c.1;
        (blade.index, foot.distance_squared(place) + rise * rise)
    }
}

/// Seen from a vertex along a normal: places in the plane, and heights over it [m].
#[derive(Default)]
struct Frame {
    origin: Vec3,
    x: Vec3,
    y: Vec3,
    z: Vec3,
}

impl Frame {
    fn new(origin: Vec3, z: Vec3) -> Self {
        let (x, y) = z.any_orthonormal_pair();
        Self { origin, x, y, z }
    }

    fn of(&self, point: Vec3) -> (Vec2, f32) {
        let p = point - self.origin;
        (Vec2::new(self.x.dot(p), self.y.dot(p)), self.z.dot(p))
    }
}

/// A new triangle between the frame's origin and two places.
struct Blade {
    /// Which of the triangles of the ring it replaces.
    index: usize,
    b: (Vec2, f32),
    c: (Vec2, f32),
    inverse_area: f32,
}

impl Blade {
    fn new(index: usize, b: (Vec2, f32), c: (Vec2, f32), area: f32) -> Self {
        let inverse_area = 1.0 / area;
        Self {
            index,
            b,
            c,
            inverse_area,
        }
    }

    /// Shares of the origin, b and c in a place; none is negative inside.
    fn shares(&self, place: Vec2) -> Vec3 {
        let b = place.perp_dot(self.c.0) * self.inverse_area;
        let c = self.b.0.perp_dot(place) * self.inverse_area;
        Vec3::new(1.0 - b - c, b, c)
    }
}
