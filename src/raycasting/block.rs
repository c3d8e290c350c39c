//! The triangles of a leaf, side by side.

use super::Hit;
use crate::geometry::Vec3;

/// Triangles per block.
pub(super) const TRIANGLES: usize = 4;

/// Coordinates of one corner of each triangle, axis by axis.
pub(super) type Corner = [[f32; TRIANGLES]; 3];

/// A few triangles and their indices: 160 bytes.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(32))]
pub(super) struct Block {
    corners: [Corner; 3],
    indices: [u32; TRIANGLES],
}

impl Block {
    /// Corners and indices of up to [`TRIANGLES`] triangles.
    pub fn new(triangles: impl IntoIterator<Item = ([Vec3; 3], u32)>) -> Self {
        let mut block = Self {
            corners: [[[f32::NAN; TRIANGLES]; 3]; 3],
            indices: [Hit::NO_TRIANGLE; TRIANGLES],
        };
        for (place, (corners, index)) in triangles.into_iter().enumerate() {
            for (corner, position) in corners.into_iter().enumerate() {
                for axis in 0..3 {
                    block.corners[corner][axis][place] = position[axis];
                }
            }
            block.indices[place] = index;
        }
        block
    }

    /// Whether there is a triangle at this place; behind an empty place there is none.
    #[inline(always)]
    pub fn has(&self, place: usize) -> bool {
        self.indices[place] != Hit::NO_TRIANGLE
    }

    /// The index of a triangle in the mesh.
    #[inline(always)]
    pub fn index(&self, place: usize) -> u32 {
        self.indices[place]
    }

    /// All coordinates, corner by corner.
    #[inline(always)]
    pub fn corners(&self) -> &[Corner; 3] {
        &self.corners
    }

    /// The unit normal of a triangle by the right-hand rule.
    pub fn normal(&self, place: usize) -> Vec3 {
        let [a, b, c] = self
            .corners
            .map(|corner| Vec3::from_array(corner.map(|axis| axis[place])).as_dvec3());
        (b - a).cross(c - a).normalize().as_vec3()
    }

    /// The corners relative to an origin.
    #[inline(always)]
    pub fn corners_from(&self, origin: Vec3) -> [Corner; 3] {
        let mut corners = self.corners;
        for corner in &mut corners {
            for axis in 0..3 {
                for coordinate in &mut corner[axis] {
                    *coordinate -= origin[axis];
                }
            }
        }
        corners
    }
}

/// (P + Q) × (Q − P) of an edge PQ of each triangle.
#[inline(always)]
#[expect(
    clippy::needless_range_loop,
    reason = "such loops become vector instructions"
)]
pub(super) fn edge(p: &Corner, q: &Corner) -> Corner {
    let mut sum = [[0.0; TRIANGLES]; 3];
    let mut difference = [[0.0; TRIANGLES]; 3];
    for axis in 0..3 {
        for place in 0..TRIANGLES {
            sum[axis][place] = p[axis][place] + q[axis][place];
            difference[axis][place] = q[axis][place] - p[axis][place];
        }
    }
    let mut edge = [[0.0; TRIANGLES]; 3];
    for axis in 0..3 {
        let (j, k) = ((axis + 1) % 3, (axis + 2) % 3);
        for place in 0..TRIANGLES {
            edge[axis][place] =
                sum[j][place] * difference[k][place] - sum[k][place] * difference[j][place];
        }
    }
    edge
}

/// What rounding can do to the side of an edge of each triangle that a ray passes on.
#[inline(always)]
pub(super) fn rounding(a: &Corner, b: &Corner, c: &Corner) -> [f32; TRIANGLES] {
    let mut rounding = [0.0; TRIANGLES];
    for (place, rounding) in rounding.iter_mut().enumerate() {
        let mut distance = 0.0;
        let mut length = 0.0;
        for axis in 0..3 {
            let (a, b, c) = (a[axis][place], b[axis][place], c[axis][place]);
            distance += a.abs();
            length += (b - a).abs() + (c - a).abs();
        }
        *rounding = 4.0 * f32::EPSILON * length * (distance + length);
    }
    rounding
}
