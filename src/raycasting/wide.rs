//! Wide bounding volume hierarchy: one ray against the boxes of eight children at once.
//!
//! Made from the binary hierarchy: of the children of a node the one with the largest surface is
//! replaced by its own two, until there are eight. After Wald, Benthin and Boulos,
//! *Getting Rid of Packets: Efficient SIMD Single-Ray Traversal using Multi-branching BVHs*,
//! RT 2008.

use super::bvh::{Bvh, NodeRef};
use super::simd::WIDTH;

/// Children of a node.
pub(super) const CHILDREN: usize = WIDTH;
/// Lower corner x, y, z, then upper corner x, y, z.
type Bounds = [f32; 6];

/// Eight children and their boxes.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub(super) struct WideNode {
    /// Lower x of each child, lower y, …, upper z.
    pub bounds: [[f32; CHILDREN]; 6],
    /// An inverted box marks an absent child.
    pub children: [NodeRef; CHILDREN],
}

/// The hierarchy; its root is the first node.
#[derive(Clone, Debug, Default)]
pub(super) struct WideBvh {
    pub nodes: Vec<WideNode>,
}

impl WideBvh {
    /// The hierarchy of the same leaves with fewer nodes.
    pub fn of(bvh: &Bvh) -> Self {
        let mut wide = Self::default();
        match bvh.root {
            Some(root) if root.is_leaf() => {
                let everywhere = [[f32::NEG_INFINITY; 3], [f32::INFINITY; 3]];
                wide.nodes.push(node(&[(bounds_of(everywhere), root)]));
            }
            Some(root) => {
                wide.add(bvh, root);
            }
            None => {}
        }
        wide
    }

    /// Adds an inner node of the binary hierarchy and all below it.
    fn add(&mut self, bvh: &Bvh, inner: NodeRef) -> NodeRef {
        let mut children = descendants(bvh, inner);
        let index = self.nodes.len();
        self.nodes.push(node(&[]));
        for (_, child) in &mut children {
            if !child.is_leaf() {
                *child = self.add(bvh, *child);
            }
        }
        self.nodes[index] = node(&children);
        NodeRef::inner(index)
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

fn node(children: &[(Bounds, NodeRef)]) -> WideNode {
    let inverted = bounds_of([[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]]);
    let mut node = WideNode {
        bounds: inverted.map(|side| [side; CHILDREN]),
        children: [NodeRef::leaf(0); CHILDREN],
    };
    for (place, (bounds, child)) in children.iter().enumerate() {
        for (side, bound) in bounds.iter().enumerate() {
            node.bounds[side][place] = *bound;
        }
        node.children[place] = *child;
    }
    node
}

fn bounds_of([[a, b, c], [d, e, f]]: [[f32; 3]; 2]) -> Bounds {
    [a, b, c, d, e, f]
}

fn half_area(bounds: &Bounds) -> f32 {
    let [x, y, z] = [0, 1, 2].map(|axis| bounds[axis + 3] - bounds[axis]);
    x * y + y * z + z * x
}
