//! Arithmetic on the values of one octree node: its own 4³ grid corners, its closed 5³ corners, and
//! its corners with a rim of one, 6³. x is fastest everywhere.

use super::octree::{CELLS, Level};

/// Corners of the cells of a node, shared ones included.
pub const CLOSED: usize = 125;
/// Own corners with a rim of one on all sides: -1 to 4 per axis.
pub const RIMMED: usize = 216;

/// Own corners and rim from the own corners of the 27 nodes around; 0 where there is no node.
/// `values` ends with one node of zeros.
#[inline]
pub fn gather(values: &[f32], neighbors: &[u32; 27]) -> [f32; RIMMED] {
    let mut out = [0.0; RIMMED];
    for z in 0..6 {
        let (side_z, in_z) = rim_place(z);
        for y in 0..6 {
            let (side_y, in_y) = rim_place(y);
            let side = 3 * side_y + 9 * side_z;
            let row = 4 * in_y + 16 * in_z;
            let out = &mut out[6 * y + 36 * z..][..6];
            let node = |x: usize| neighbors[side + x] as usize * CELLS + row;
            out[0] = values[node(0) + 3];
            out[1..5].copy_from_slice(&values[node(1)..node(1) + 4]);
            out[5] = values[node(2)];
        }
    }
    out
}

/// Which neighbour along an axis, and where in it, for places 0 to 5 that mean -1 to 4.
#[inline]
fn rim_place(place: usize) -> (usize, usize) {
    ((place + 3) >> 2, (place + 3) & 3)
}

/// Own corners and rim from the closed corners of the node and its lower neighbours; 0 where a lower
/// neighbour is missing.
#[inline]
pub fn gather_closed(values: &[f32], level: &Level, node: usize) -> [f32; RIMMED] {
    let mut out = [0.0; RIMMED];
    for corner in 0..8_usize {
        let lower = [corner & 1 != 0, corner & 2 != 0, corner & 4 != 0];
        let Some(from) = level.neighbor(node, lower.map(|is_lower| -i32::from(is_lower))) else {
            continue;
        };
        let from = &values[from * CLOSED..][..CLOSED];
        // On a lower neighbour the rim is its corner 3; on the node itself, all five.
        let places = |is_lower: bool| if is_lower { 3..4 } else { 0..5 };
        let target = |x: usize, is_lower: bool| if is_lower { 0 } else { x + 1 };
        for z in places(lower[2]) {
            for y in places(lower[1]) {
                let row = 6 * target(y, lower[1]) + 36 * target(z, lower[2]);
                for x in places(lower[0]) {
                    out[target(x, lower[0]) + row] = from[x + 5 * y + 25 * z];
                }
            }
        }
    }
    out
}

/// The Laplacian of trilinear elements on unit cells, ∫∇φᵢ·∇u, at the own corners.
///
/// Its stencil is 8/3 at the corner, 0 along the axes, -1/6 across faces and -1/12 across cells:
/// `10/3 u + 1/3 Σ_axes u − 1/12 (1 2 1)³ u`.
#[inline]
pub fn laplacian(u: &[f32; RIMMED]) -> [f32; CELLS] {
    let mut along_x = [[0.0_f32; 4]; 36];
    for (row, sums) in along_x.iter_mut().enumerate() {
        let u = &u[6 * row..6 * row + 6];
        for x in 0..4 {
            sums[x] = u[x] + 2.0 * u[x + 1] + u[x + 2];
        }
    }
    let mut along_y = [[0.0_f32; 4]; 24];
    for z in 0..6 {
        for y in 0..4 {
            for x in 0..4 {
                along_y[y + 4 * z][x] = along_x[y + 6 * z][x]
                    + 2.0 * along_x[y + 1 + 6 * z][x]
                    + along_x[y + 2 + 6 * z][x];
            }
        }
    }
    let mut out = [0.0; CELLS];
    for z in 0..4 {
        for y in 0..4 {
            let center = 1 + 6 * (y + 1) + 36 * (z + 1);
            for x in 0..4 {
                let i = center + x;
                let smooth = along_y[y + 4 * z][x]
                    + 2.0 * along_y[y + 4 * (z + 1)][x]
                    + along_y[y + 4 * (z + 2)][x];
                let axes = (u[i - 1] + u[i + 1]) + (u[i - 6] + u[i + 6]) + (u[i - 36] + u[i + 36]);
                out[x + 4 * y + 16 * z] =
                    (10.0 / 3.0) * u[i] + (1.0 / 3.0) * axes - (1.0 / 12.0) * smooth;
            }
        }
    }
    out
}

/// The divergence of a trilinear field on unit cells, ∫∇φᵢ·V, at the own corners.
#[inline]
pub fn divergence(field: &[[f32; RIMMED]; 3]) -> [f32; CELLS] {
    let mut out = [0.0; CELLS];
    for (axis, component) in field.iter().enumerate() {
        let strides = [1, 6, 36];
        let (along, across, third) = match axis {
            0 => (strides[0], strides[1], strides[2]),
            1 => (strides[1], strides[0], strides[2]),
            _ => (strides[2], strides[0], strides[1]),
        };
        let difference = |i: usize| component[i - along] - component[i + along];
        let mass = |i: usize| difference(i - across) + 4.0 * difference(i) + difference(i + across);
        for z in 0..4 {
            for y in 0..4 {
                for x in 0..4 {
                    let i = (x + 1) + 6 * (y + 1) + 36 * (z + 1);
                    out[x + 4 * y + 16 * z] +=
                        (mass(i - third) + 4.0 * mass(i) + mass(i + third)) / 72.0;
                }
            }
        }
    }
    out
}

/// The closed corners of a child from those of its parent, by trilinear interpolation.
///
/// One axis after the other, so that nodes which share a corner find the same bits.
pub fn prolong_closed(parent: &[f32], octant: usize) -> [f32; CLOSED] {
    let start = [octant & 1, octant >> 1 & 1, octant >> 2].map(|o| 2 * o);
    let mut coarse = [0.0_f32; 27];
    for z in 0..3 {
        for y in 0..3 {
            for x in 0..3 {
                coarse[x + 3 * y + 9 * z] =
                    parent[(start[0] + x) + 5 * (start[1] + y) + 25 * (start[2] + z)];
            }
        }
    }
    let mut along_x = [0.0_f32; 45];
    for row in 0..9 {
        for x in 0..5 {
            along_x[x + 5 * row] = between(x, |i| coarse[i + 3 * row]);
        }
    }
    let mut along_y = [0.0_f32; 75];
    for z in 0..3 {
        for y in 0..5 {
            for x in 0..5 {
                along_y[x + 5 * y + 25 * z] = between(y, |i| along_x[x + 5 * i + 15 * z]);
            }
        }
    }
    let mut out = [0.0_f32; CLOSED];
    for z in 0..5 {
        for i in 0..25 {
            out[i + 25 * z] = between(z, |j| along_y[i + 25 * j]);
        }
    }
    out
}

/// The value at a fine place from the coarse values at half of it.
#[inline]
fn between(place: usize, coarse: impl Fn(usize) -> f32) -> f32 {
    if place & 1 == 0 {
        coarse(place / 2)
    } else {
        0.5 * (coarse(place / 2) + coarse(place / 2 + 1))
    }
}

/// Own corners and rim of a child from those of its parent, by trilinear interpolation.
pub fn prolong_rimmed(parent: &[f32; RIMMED], octant: usize) -> [f32; RIMMED] {
    let start = [octant & 1, octant >> 1 & 1, octant >> 2].map(|o| 2 * o);
    // Fine places -1 to 4 lie at coarse places -1/2 to 2 after the octant's start.
    let weights = |place: usize| (place.div_ceil(2), place / 2 + 1);
    let mut out = [0.0; RIMMED];
    for z in 0..6 {
        let (z0, z1) = weights(z);
        for y in 0..6 {
            let (y0, y1) = weights(y);
            let at = |x: usize, y: usize, z: usize| {
                parent[(start[0] + x) + 6 * (start[1] + y) + 36 * (start[2] + z)]
            };
            let mut row = [0.0_f32; 4];
            for (x, value) in row.iter_mut().enumerate() {
                *value = 0.25 * ((at(x, y0, z0) + at(x, y1, z0)) + (at(x, y0, z1) + at(x, y1, z1)));
            }
            for x in 0..6 {
                let (x0, x1) = weights(x);
                out[x + 6 * y + 36 * z] = 0.5 * (row[x0] + row[x1]);
            }
        }
    }
    out
}
