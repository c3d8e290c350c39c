//! Eight rays from one origin go through the hierarchy together.
//!
//! With the corners A, B, C of a triangle relative to the origin of the rays, a direction d
//! passes it on one side of all three edges where
//!
//! ```text
//! d · ((P + Q) × (Q − P))      PQ ∈ {AB, BC, CA}
//! ```
//!
//! have one sign: three dot products per ray, and the vectors are the same for all rays of the
//! packet. Seen from the neighbour, an edge gives exactly the negative number, so that no ray
//! slips between two triangles. After Davidovič, Engelhardt, Georgiev, Slusallek and
//! Dachsbacher, *3D Rasterization: A Bridge between Rasterization and Ray Casting*, GI 2012.
//!
//! Plain loops over arrays that the compiler turns into vector instructions. Products and sums
//! are rounded one by one, so that every instruction set gives the same bits.

use super::bvh::{Bvh, Child, MAX_DEPTH};
use super::{Hit, NEAREST_M};
use crate::geometry::Vec3;

/// Rays per packet.
pub(super) const RAYS: usize = 8;
/// Triangles per leaf.
pub(super) const TRIANGLES: usize = 4;
/// Rounding of the slab test, see Ize, *Robust BVH Ray Traversal*, JCGT 2013.
const FARTHER: f32 = 1.0 + 8.0 * f32::EPSILON;
/// Directions are never nearer to an axis plane than this, so that 0 · ∞ does not occur.
const STEEPEST: f32 = 1e18;

/// One number per ray.
type Rays = [f32; RAYS];

/// A few triangles, coordinate by coordinate.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(32))]
pub(super) struct Block {
    /// Corner, axis, triangle.
    corners: [[[f32; TRIANGLES]; 3]; 3],
    indices: [u32; TRIANGLES],
}

impl Block {
    /// Corners and indices of up to [`TRIANGLES`] triangles.
    pub fn new(triangles: impl IntoIterator<Item = ([Vec3; 3], u32)>) -> Self {
        let mut block = Self {
            corners: [[[f32::NAN; TRIANGLES]; 3]; 3],
            indices: [Hit::NO_TRIANGLE; TRIANGLES],
        };
        for (slot, (corners, index)) in triangles.into_iter().enumerate() {
            for (corner, position) in corners.into_iter().enumerate() {
                for axis in 0..3 {
                    block.corners[corner][axis][slot] = position[axis];
                }
            }
            block.indices[slot] = index;
        }
        block
    }
}

/// Directions of a packet and what its rays met so far.
pub(super) struct Packet {
    /// Per axis.
    direction: [Rays; 3],
    inverse: [Rays; 3],
    /// The nearest hit so far, or how far to look [m].
    pub range_m: Rays,
    pub triangle: [u32; RAYS],
    /// Per axis, whether most rays run downwards.
    backwards: [bool; 3],
}

impl Packet {
    /// Up to [`RAYS`] rays; the last one fills the empty places.
    #[inline(always)]
    pub fn new(directions: &[Vec3], max_range_m: &[f32]) -> Self {
        let mut packet = Self {
            direction: [[0.0; RAYS]; 3],
            inverse: [[0.0; RAYS]; 3],
            range_m: [0.0; RAYS],
            triangle: [Hit::NO_TRIANGLE; RAYS],
            backwards: [false; 3],
        };
        let last = directions.len() - 1;
        for ray in 0..RAYS {
            let direction = directions[ray.min(last)];
            packet.range_m[ray] = max_range_m[ray.min(last)];
            for axis in 0..3 {
                packet.direction[axis][ray] = direction[axis];
            }
        }
        for axis in 0..3 {
            let mut sum = 0.0;
            for ray in 0..RAYS {
                let d = packet.direction[axis][ray];
                sum += d;
                let inverse = 1.0 / d;
                packet.inverse[axis][ray] = if inverse.abs() < STEEPEST {
                    inverse
                } else {
                    STEEPEST.copysign(d)
                };
            }
            packet.backwards[axis] = sum < 0.0;
        }
        packet
    }

    /// Finds the nearest triangles; `origin` is in the frame of the hierarchy and its blocks.
    #[inline(always)]
    pub fn cast(&mut self, origin: Vec3, bvh: &Bvh, blocks: &[Block]) {
        let Some(mut current) = bvh.root else {
            return;
        };
        let mut stack = [Child::leaf(0); MAX_DEPTH];
        let mut waiting = 0;
        loop {
            if current.is_leaf() {
                self.meet(origin, &blocks[current.index()]);
            } else {
                let node = &bvh.nodes[current.index()];
                let near = usize::from(self.backwards[node.axis as usize]);
                let into_near = self.enters(origin, &node.bounds[near]);
                let into_far = self.enters(origin, &node.bounds[1 - near]);
                if into_near {
                    if into_far {
                        stack[waiting] = node.children[1 - near];
                        waiting += 1;
                    }
                    current = node.children[near];
                    continue;
                }
                if into_far {
                    current = node.children[1 - near];
                    continue;
                }
            }
            if waiting == 0 {
                return;
            }
            waiting -= 1;
            current = stack[waiting];
        }
    }

    /// Whether any ray enters a box before its nearest hit.
    #[inline(always)]
    fn enters(&self, origin: Vec3, bounds: &[f32; 6]) -> bool {
        let mut near = [0.0; RAYS];
        let mut far = self.range_m;
        for axis in 0..3 {
            let lower = bounds[axis] - origin[axis];
            let upper = bounds[axis + 3] - origin[axis];
            for ray in 0..RAYS {
                let a = lower * self.inverse[axis][ray];
                let b = upper * self.inverse[axis][ray];
                near[ray] = max(near[ray], min(a, b));
                far[ray] = min(far[ray], max(a, b));
            }
        }
        let mut any = false;
        for ray in 0..RAYS {
            any |= near[ray] <= far[ray] * FARTHER;
        }
        any
    }

    /// Takes the hits of a block that are nearer than what was known.
    #[inline(always)]
    fn meet(&mut self, origin: Vec3, block: &Block) {
        let corners = relative(block, origin);
        let edges = [(0, 1), (1, 2), (2, 0)].map(|(p, q)| edge(&corners[p], &corners[q]));
        for triangle in 0..TRIANGLES {
            let index = block.indices[triangle];
            if index == Hit::NO_TRIANGLE {
                break;
            }
            let sides = edges.map(|edge| self.dot(edge.map(|axis| axis[triangle])));
            let mut any = false;
            let mut inside = [false; RAYS];
            for ray in 0..RAYS {
                let least = min(min(sides[0][ray], sides[1][ray]), sides[2][ray]);
                let most = max(max(sides[0][ray], sides[1][ray]), sides[2][ray]);
                inside[ray] = least >= 0.0 || most <= 0.0;
                any |= inside[ray];
            }
            if !any {
                continue;
            }
            // Each side weighs the corner that lies opposite.
            let [c, a, b] = [2, 0, 1].map(|corner| {
                let corner: &[[f32; TRIANGLES]; 3] = &corners[corner];
                self.dot(corner.map(|axis| axis[triangle]))
            });
            for ray in 0..RAYS {
                let [w, u, v] = [sides[0][ray], sides[1][ray], sides[2][ray]];
                let range_m = (u * a[ray] + v * b[ray] + w * c[ray]) / (u + v + w);
                let best = self.range_m[ray];
                let nearer = range_m < best || (range_m == best && index < self.triangle[ray]);
                if inside[ray] && nearer && range_m > NEAREST_M {
                    self.range_m[ray] = range_m;
                    self.triangle[ray] = index;
                }
            }
        }
    }

    /// Directions times one vector.
    #[inline(always)]
    fn dot(&self, vector: [f32; 3]) -> Rays {
        let [x, y, z] = &self.direction;
        std::array::from_fn(|ray| x[ray] * vector[0] + y[ray] * vector[1] + z[ray] * vector[2])
    }

    /// What a ray of the packet met.
    #[inline(always)]
    pub fn hit(&self, ray: usize) -> Hit {
        if self.triangle[ray] == Hit::NO_TRIANGLE {
            Hit::MISS
        } else {
            Hit {
                range_m: self.range_m[ray],
                triangle: self.triangle[ray],
            }
        }
    }
}

/// Coordinates of a corner of each triangle.
type Corner = [[f32; TRIANGLES]; 3];

#[inline(always)]
fn relative(block: &Block, origin: Vec3) -> [Corner; 3] {
    let mut corners = block.corners;
    for corner in &mut corners {
        for axis in 0..3 {
            for coordinate in &mut corner[axis] {
                *coordinate -= origin[axis];
            }
        }
    }
    corners
}

/// (P + Q) × (Q − P) of each triangle.
#[inline(always)]
fn edge(p: &Corner, q: &Corner) -> Corner {
    let sum = zip(p, q, |p, q| p + q);
    let difference = zip(p, q, |p, q| q - p);
    std::array::from_fn(|axis| {
        let (j, k) = ((axis + 1) % 3, (axis + 2) % 3);
        std::array::from_fn(|triangle| {
            sum[j][triangle] * difference[k][triangle] - sum[k][triangle] * difference[j][triangle]
        })
    })
}

#[inline(always)]
fn zip(p: &Corner, q: &Corner, f: impl Fn(f32, f32) -> f32) -> Corner {
    std::array::from_fn(|axis| std::array::from_fn(|t| f(p[axis][t], q[axis][t])))
}

/// As the instruction does it: without the care of [`f32::min`] for what is no number.
#[inline(always)]
fn min(a: f32, b: f32) -> f32 {
    if a < b { a } else { b }
}

/// As the instruction does it: without the care of [`f32::max`] for what is no number.
#[inline(always)]
fn max(a: f32, b: f32) -> f32 {
    if a > b { a } else { b }
}
