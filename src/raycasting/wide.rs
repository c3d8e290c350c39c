//! Wide bounding volume hierarchy: rays against the boxes of up to eight children at once.
//!
//! Made from the binary hierarchy: of the children of a node the one with the largest surface is
//! replaced by its own two, until there are eight. After Wald, Benthin and Boulos,
//! *Getting Rid of Packets: Efficient SIMD Single-Ray Traversal using Multi-branching BVHs*,
//! RT 2008.
//!
//! The boxes of the children are stored in cells of a grid over the box of the whole hierarchy,
//! up to 65,500 per axis, rounded outwards, and the children of one kind lie one after the other:
//! 128 bytes, two cache lines.

use bytemuck::{Pod, Zeroable};

use super::bvh::{Bvh, NodeRef};
use crate::simd::WIDTH;

/// Children of a node.
pub(super) const CHILDREN: usize = WIDTH;
/// Lower corner x, y, z, then upper corner x, y, z.
type Bounds = [f32; 6];

/// Up to eight children and their boxes.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C, align(64))]
pub(super) struct WideNode {
    /// Lower x of each child, lower y, …, upper z, in cells of the [`BoxGrid`].
    pub bounds: [[u16; CHILDREN]; 6],
    first_inner: u32,
    first_leaf: u32,
    /// Number of inner children, which are the first ones.
    inner: u8,
    /// Number of all.
    children: u8,
    unused: [u8; 22],
}

impl WideNode {
    /// Bit mask of the children.
    #[inline(always)]
    pub fn mask(&self) -> u32 {
        (1 << self.children) - 1
    }

    #[inline(always)]
    pub fn child(&self, place: usize) -> NodeRef {
        let inner = usize::from(self.inner);
        if place < inner {
            NodeRef::inner(self.first_inner as usize + place)
        } else {
            NodeRef::leaf(self.first_leaf as usize + place - inner)
        }
    }
}

/// Grid of the boxes of a hierarchy.
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
#[repr(C)]
pub(super) struct BoxGrid {
    /// Where a bound of zero lies [steps of the lattice].
    pub origin: [f32; 3],
    /// Sides of a cell, powers of two [steps of the lattice].
    pub cell: [f32; 3],
}

impl BoxGrid {
    /// Cells that the boxes take up at most; the rest is for rounding.
    const CELLS: f64 = 65_500.0;

    /// A grid over a box.
    fn over(bounds: &Bounds) -> Self {
        let mut grid = Self::default();
        for axis in 0..3 {
            let [min, max] = [bounds[axis], bounds[axis + 3]].map(f64::from);
            let cell = ((max - min) / Self::CELLS).max(1e-30).log2().ceil().exp2();
            grid.cell[axis] = cell as f32;
            grid.origin[axis] = (min - 2.0 * cell) as f32;
        }
        grid
    }

    /// A bound [steps of the lattice] in cells, rounded outwards.
    fn cell_of(&self, side: usize, bound: f32) -> u16 {
        /// Boxes are enlarged by this part of a cell: more than rounding moves a side.
        const SLACK: f64 = 0.05;
        let axis = side % 3;
        let cells = (f64::from(bound) - f64::from(self.origin[axis])) / f64::from(self.cell[axis]);
        if side < 3 {
            (cells - SLACK).floor() as u16
        } else {
            (cells + SLACK).ceil() as u16
        }
    }

    /// The box of a child of a node [steps of the lattice].
    #[inline(always)]
    pub fn bounds_of(&self, node: &WideNode, place: usize) -> Bounds {
        let bound = |side: usize| {
            let axis = side % 3;
            f32::from(node.bounds[side][place]) * self.cell[axis] + self.origin[axis]
        };
        [bound(0), bound(1), bound(2), bound(3), bound(4), bound(5)]
    }
}

/// The hierarchy; its root is the first node.
#[derive(Clone, Debug, Default)]
pub(super) struct WideBvh {
    pub grid: BoxGrid,
    pub nodes: Vec<WideNode>,
}

impl WideBvh {
    /// The hierarchy of the same leaves with fewer nodes, and the leaves in its order.
    pub fn of(bvh: &Bvh) -> (Self, Vec<usize>) {
        let mut leaves = Vec::new();
        let mut wide = Self {
            grid: BoxGrid::over(&bvh.bounds),
            nodes: Vec::new(),
        };
        if let Some(root) = bvh.root {
            wide.nodes.push(WideNode::default());
            let children = if root.is_leaf() {
                vec![(bvh.bounds, root)]
            } else {
                descendants(bvh, root)
            };
            wide.set(0, bvh, children, &mut leaves);
        }
        (wide, leaves)
    }

    /// Sets a node, and adds all below it.
    fn set(
        &mut self,
        index: usize,
        bvh: &Bvh,
        mut children: Vec<(Bounds, NodeRef)>,
        leaves: &mut Vec<usize>,
    ) {
        children.sort_by_key(|(_, child)| child.is_leaf());
        let inner = children
            .iter()
            .filter(|(_, child)| !child.is_leaf())
            .count();
        let first_inner = self.nodes.len();
        let node = &mut self.nodes[index];
        *node = WideNode {
            first_inner: first_inner as u32,
            first_leaf: leaves.len() as u32,
            inner: inner as u8,
            children: children.len() as u8,
            ..WideNode::default()
        };
        for (place, (bounds, _)) in children.iter().enumerate() {
            for (side, &bound) in bounds.iter().enumerate() {
                node.bounds[side][place] = self.grid.cell_of(side, bound);
            }
        }
        leaves.extend(children[inner..].iter().map(|(_, leaf)| leaf.index()));
        self.nodes
            .resize_with(first_inner + inner, WideNode::default);
        for (place, (_, child)) in children[..inner].iter().enumerate() {
            self.set(first_inner + place, bvh, descendants(bvh, *child), leaves);
        }
    }
}

/// Up to eight descendants that together hold all leaves of an inner node.
fn descendants(bvh: &Bvh, inner: NodeRef) -> Vec<(Bounds, NodeRef)> {
    let children_of = |child: NodeRef| {
        let node = &bvh.nodes[child.index()];
        std::iter::zip(node.bounds, node.children)
    };
    let mut found: Vec<(Bounds, NodeRef)> = children_of(inner).collect();
    while found.len() < CHILDREN {
        let largest = (0..found.len())
            .filter(|&place| !found[place].1.is_leaf())
            .max_by(|&a, &b| half_area(&found[a].0).total_cmp(&half_area(&found[b].0)));
        let Some(largest) = largest else {
            break;
        };
        let (_, child) = found.swap_remove(largest);
        found.extend(children_of(child));
    }
    found
}

fn half_area(bounds: &Bounds) -> f32 {
    let [x, y, z] = [0, 1, 2].map(|axis| bounds[axis + 3] - bounds[axis]);
    x * y + y * z + z * x
}

#[cfg(test)]
mod tests {
    use glam::Vec3;

    use super::super::bvh::PrimRef;
    use super::*;
    use crate::geometry::Aabb;

    #[test]
    fn every_leaf_has_one_place_and_lies_in_its_box() {
        let boxes: Vec<Aabb> = (0..500_u16)
            .map(|number| {
                let along = |step: f32| 9e4 * (f32::from(number) * step).fract();
                let min = Vec3::new(along(0.618), along(0.755), 0.01 * along(0.57));
                let size = Vec3::new(70.0, 1e-3 * f32::from(number), 0.0);
                Aabb {
                    min,
                    max: min + size,
                }
            })
            .collect();
        let prims = boxes
            .iter()
            .zip(0..)
            .map(|(bounds, index)| PrimRef::new(*bounds, index));
        let (bvh, of_leaves) = Bvh::build(prims.collect(), 1);
        let (wide, order) = WideBvh::of(&bvh);
        let mut found = vec![0; boxes.len()];
        for node in &wide.nodes {
            for place in 0..usize::from(node.children) {
                let child = node.child(place);
                if !child.is_leaf() {
                    continue;
                }
                let prim = of_leaves.order[order[child.index()]] as usize;
                found[prim] += 1;
                let [a, b, c, d, e, f] = wide.grid.bounds_of(node, place);
                let Aabb { min, max } = boxes[prim];
                assert!(Vec3::new(a, b, c).cmple(min).all() && max.cmple(Vec3::new(d, e, f)).all());
                // Two cells of the grid on either side.
                let cell = Vec3::from_array(wide.grid.cell);
                assert!(
                    (Vec3::new(d, e, f) - Vec3::new(a, b, c))
                        .cmple(max - min + 4.0 * cell)
                        .all()
                );
            }
        }
        assert!(found.iter().all(|&count| count == 1));
    }
}
