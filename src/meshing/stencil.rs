//! Finite-element stencils on the values of one octree node: trilinear B-splines at its 4³ own grid
//! corners, at the 5³ corners of its cells, and at its own corners with one layer of padding, 6³. x is
//! fastest everywhere.

use super::octree::{CELLS, Level};

/// Number of corners of the cells of a node, with those that it shares with other nodes.
pub const CORNERS: usize = 125;
/// Number of own corners with one layer of padding on all sides: -1 to 4 per axis.
pub const PADDED: usize = 216;

/// Values at the own corners of a node.
pub type OwnValues = [f32; CELLS];
/// Values at all corners of the cells of a node.
pub type CornerValues = [f32; CORNERS];
/// Values at the own corners of a node and the padding.
pub type PaddedValues = [f32; PADDED];

/// Offsets of the corners of a cell among the corners of a node.
pub const CORNER_OFFSETS: [usize; 8] = [0, 1, 5, 6, 25, 26, 30, 31];
/// Offsets of the corners of a cell among the padded corners.
pub const PADDED_OFFSETS: [usize; 8] = [0, 1, 6, 7, 36, 37, 42, 43];

/// Index of a corner, 0 to 4 per axis, among the corners of a node.
#[inline]
pub fn corner_index(corner: [usize; 3]) -> usize {
    corner[0] + 5 * corner[1] + 25 * corner[2]
}

/// Indices of the own corners among the padded ones.
pub fn own_in_padded() -> impl Iterator<Item = usize> {
    (0..CELLS).map(|i| (i & 3) + 1 + 6 * ((i >> 2 & 3) + 1) + 36 * ((i >> 4) + 1))
}

/// Indices of the corners of a node among the padded ones.
pub fn corners_in_padded() -> impl Iterator<Item = usize> {
    (0..CORNERS).map(|i| (i % 5 + 1) + 6 * (i / 5 % 5 + 1) + 36 * (i / 25 + 1))
}

/// Values of the eight trilinear basis functions of a cell, x fastest, at a position 0 to 1 per axis.
#[inline]
pub fn trilinear(inside: [f32; 3]) -> [f32; 8] {
    let [x, y, z] = inside.map(|t| [1.0 - t, t]);
    std::array::from_fn(|corner| x[corner & 1] * y[corner >> 1 & 1] * z[corner >> 2])
}

/// Σ φᵢ uᵢ over the corners of a cell.
#[inline]
pub fn interpolate(u: &[f32], corner: usize, offsets: &[usize; 8], shape: &[f32; 8]) -> f32 {
    (0..8).map(|i| shape[i] * u[corner + offsets[i]]).sum()
}

/// Padded values of a node from the own values of the 27 nodes around it, by index; missing nodes
/// have the index after the last node.
#[inline]
pub fn gather_own<'a>(
    own_values: impl Fn(usize) -> &'a OwnValues,
    neighbors: &[u32; 27],
) -> PaddedValues {
    let mut out = [0.0; PADDED];
    for z in 0..6 {
        let (side_z, in_z) = padding_source(z);
        for y in 0..6 {
            let (side_y, in_y) = padding_source(y);
            let side = 3 * side_y + 9 * side_z;
            let row = 4 * in_y + 16 * in_z;
            let out = &mut out[6 * y + 36 * z..][..6];
            let node = |x: usize| own_values(neighbors[side + x] as usize);
            out[0] = node(0)[row + 3];
            out[1..5].copy_from_slice(&node(1)[row..row + 4]);
            out[5] = node(2)[row];
        }
    }
    out
}

/// Neighbor along an axis, 0 to 2, and index in it of a padded index, 0 to 5.
#[inline]
fn padding_source(index: usize) -> (usize, usize) {
    ((index + 3) >> 2, (index + 3) & 3)
}

/// Padded values of a node from the corner values of the node and its lower neighbors; 0 at missing
/// neighbors.
#[inline]
pub fn gather_corners<'a>(
    corner_values: impl Fn(usize) -> &'a CornerValues,
    level: &Level,
    node: usize,
) -> PaddedValues {
    let mut out = [0.0; PADDED];
    for corner in 0..8_usize {
        let lower = [corner & 1 != 0, corner & 2 != 0, corner & 4 != 0];
        let Some(from) = level.neighbor(node, lower.map(|is_lower| -i32::from(is_lower))) else {
            continue;
        };
        let from = corner_values(from);
        // The padding is corner 3 of a lower neighbor; the node itself gives all five corners.
        let sources = |is_lower: bool| if is_lower { 3..4 } else { 0..5 };
        let target = |x: usize, is_lower: bool| if is_lower { 0 } else { x + 1 };
        for z in sources(lower[2]) {
            for y in sources(lower[1]) {
                let row = 6 * target(y, lower[1]) + 36 * target(z, lower[2]);
                for x in sources(lower[0]) {
                    out[target(x, lower[0]) + row] = from[corner_index([x, y, z])];
                }
            }
        }
    }
    out
}

/// Stiffness of trilinear elements on unit cells, ∫∇φᵢ·∇u, at the own corners.
///
/// Its stencil is 8/3 at the corner, 0 along the axes, -1/6 along face diagonals and -1/12 along cell diagonals:
/// `10/3 u + 1/3 Σ_axes u − 1/12 (1 2 1)³ u`.
#[inline]
pub fn laplacian(u: &PaddedValues) -> OwnValues {
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
pub fn divergence(field: &[PaddedValues; 3]) -> OwnValues {
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

/// Prolongation: corner values of a child from those of its parent.
///
/// One axis after the other, so that nodes which share a corner get identical bits.
pub fn prolong_corners(parent: &CornerValues, octant: usize) -> CornerValues {
    let first = corner_index(octant_start(octant));
    std::array::from_fn(|i| {
        let coarse = |x: usize, y: usize, z: usize| parent[first + corner_index([x, y, z])];
        let along_x = |y: usize, z: usize| midpoint(i % 5, |x| coarse(x, y, z));
        let along_y = |z: usize| midpoint(i / 5 % 5, |y| along_x(y, z));
        midpoint(i / 25, along_y)
    })
}

/// The first corner of an octant among the corners of its parent.
fn octant_start(octant: usize) -> [usize; 3] {
    [octant & 1, octant >> 1 & 1, octant >> 2].map(|o| 2 * o)
}

/// The value at a fine index from the coarse values, which are at the even ones.
#[inline]
fn midpoint(index: usize, coarse: impl Fn(usize) -> f32) -> f32 {
    if index & 1 == 0 {
        coarse(index / 2)
    } else {
        0.5 * (coarse(index / 2) + coarse(index / 2 + 1))
    }
}

/// Prolongation: padded values of a child from those of its parent.
pub fn prolong_padded(parent: &PaddedValues, octant: usize) -> PaddedValues {
    let [start_x, start_y, start_z] = octant_start(octant);
    // Fine indices -1 to 4 are at coarse positions -1/2 to 2 after the start of the octant.
    let ends = |index: usize| (index.div_ceil(2), index / 2 + 1);
    std::array::from_fn(|i| {
        let ((x0, x1), (y0, y1), (z0, z1)) = (ends(i % 6), ends(i / 6 % 6), ends(i / 36));
        let coarse = |x: usize, y: usize, z: usize| {
            parent[(start_x + x) + 6 * (start_y + y) + 36 * (start_z + z)]
        };
        let along_yz = |x: usize| {
            let low = coarse(x, y0, z0) + coarse(x, y1, z0);
            0.25 * (low + (coarse(x, y0, z1) + coarse(x, y1, z1)))
        };
        0.5 * (along_yz(x0) + along_yz(x1))
    })
}
