//! A bounding volume hierarchy over boxes: every node has two children, and knows both their
//! boxes, so that one cache line decides where a packet of rays goes on.
//!
//! Built from above by the surface area heuristic over binned centroids,
//!
//! ```text
//! cost(split) = area(left) · |left| + area(right) · |right|
//! ```
//!
//! Wald, *On fast Construction of SAH-based Bounding Volume Hierarchies*, RT 2007. Large subtrees
//! grow in parallel; the tree does not depend on the number of threads.

use std::ops::Range;

use crate::geometry::{Aabb, Vec3};

/// Candidate borders per axis.
const BINS: usize = 16;
/// Subtrees with fewer items are grown by one thread.
const PARALLEL_FROM: usize = 4096;
/// From this depth on nodes are halved by count, which bounds the depth of the whole tree.
const HALVE_FROM_DEPTH: usize = 48;
/// No tree is deeper: below [`HALVE_FROM_DEPTH`] each level halves at most 2³² items.
pub(super) const MAX_DEPTH: usize = HALVE_FROM_DEPTH + 32;

/// A box and what lies in it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Item {
    pub bounds: Aabb,
    pub index: u32,
}

impl Item {
    /// Twice the centre of the box.
    fn centroid(&self) -> Vec3 {
        self.bounds.min + self.bounds.max
    }
}

/// A reference to an inner node or to a leaf.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Child(u32);

impl Child {
    const LEAF: u32 = 1 << 31;

    pub fn node(index: usize) -> Self {
        debug_assert!(index < Self::LEAF as usize);
        Self(index as u32)
    }

    pub fn leaf(index: usize) -> Self {
        debug_assert!(index < Self::LEAF as usize);
        Self(index as u32 | Self::LEAF)
    }

    #[inline(always)]
    pub fn is_leaf(self) -> bool {
        self.0 & Self::LEAF != 0
    }

    #[inline(always)]
    pub fn index(self) -> usize {
        (self.0 & !Self::LEAF) as usize
    }

    /// The same child after other nodes and leaves were put before its own.
    fn shifted(self, nodes: usize, leaves: usize) -> Self {
        if self.is_leaf() {
            Self::leaf(self.index() + leaves)
        } else {
            Self::node(self.index() + nodes)
        }
    }
}

/// Two children and their boxes: one cache line.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub(crate) struct Node {
    /// Of each child: lower corner x, y, z, then upper corner x, y, z.
    pub bounds: [[f32; 6]; 2],
    pub children: [Child; 2],
    /// Along this axis the first child lies lower.
    pub axis: u32,
}

/// The hierarchy: [`Bvh::root`] leads to everything.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bvh {
    pub nodes: Vec<Node>,
    /// Nothing where there are no items.
    pub root: Option<Child>,
}

impl Bvh {
    /// Grows the hierarchy over items, at most `leaf_size` to a leaf; also gives the indices of
    /// the items in each leaf.
    pub fn build(mut items: Vec<Item>, leaf_size: usize) -> (Self, Leaves) {
        if items.is_empty() {
            return Default::default();
        }
        let tree = Grower { leaf_size }.grow_parallel(&mut items, 0, 0);
        let leaves = Leaves {
            ranges: tree.leaves,
            order: items.iter().map(|item| item.index).collect(),
        };
        let bvh = Self {
            nodes: tree.nodes,
            root: Some(tree.root),
        };
        (bvh, leaves)
    }
}

/// What lies in each leaf.
#[derive(Default)]
pub struct Leaves {
    /// Where the items of each leaf stand in `order`.
    pub ranges: Vec<Range<u32>>,
    /// Indices of the items, leaf by leaf.
    pub order: Vec<u32>,
}

impl Leaves {
    /// The indices of the items, leaf by leaf.
    pub fn iter(&self) -> impl Iterator<Item = &[u32]> {
        self.ranges
            .iter()
            .map(|range| &self.order[range.start as usize..range.end as usize])
    }
}

/// A part of the tree that counts its own nodes and leaves from zero.
struct Subtree {
    nodes: Vec<Node>,
    leaves: Vec<Range<u32>>,
    root: Child,
}

impl Subtree {
    /// The tree of a node over two subtrees.
    fn join(left: (Self, Aabb), right: (Self, Aabb), axis: usize) -> Self {
        let (mut tree, left_bounds) = left;
        let (other, right_bounds) = right;
        let (nodes, leaves) = (tree.nodes.len(), tree.leaves.len());
        let shift = |child: Child| child.shifted(nodes, leaves);
        tree.leaves.extend(other.leaves);
        tree.nodes.extend(other.nodes.into_iter().map(|node| Node {
            children: node.children.map(shift),
            ..node
        }));
        let children = [tree.root, shift(other.root)];
        tree.root = Child::node(tree.nodes.len());
        tree.nodes
            .push(node([left_bounds, right_bounds], children, axis));
        tree
    }
}

/// Where a node is cut in two: its items are already in order.
struct Cut {
    middle: usize,
    axis: usize,
}

struct Grower {
    leaf_size: usize,
}

impl Grower {
    /// `first` is the place of the first item in the order of all.
    fn grow_parallel(&self, items: &mut [Item], first: usize, depth: usize) -> Subtree {
        if items.len() < PARALLEL_FROM {
            let mut tree = Subtree {
                nodes: Vec::with_capacity(items.len() / 2),
                leaves: Vec::with_capacity(items.len() / 2),
                root: Child::node(0),
            };
            tree.root = self.grow(&mut tree, items, first, depth);
            return tree;
        }
        let cut = cut(items, depth, 0);
        let Cut { middle, axis } = cut.expect("a node of many items is always cut");
        let (left, right) = items.split_at_mut(middle);
        let (left, right) = rayon::join(
            || {
                let bounds = bounds_of(left);
                (self.grow_parallel(left, first, depth + 1), bounds)
            },
            || {
                let bounds = bounds_of(right);
                (self.grow_parallel(right, first + middle, depth + 1), bounds)
            },
        );
        Subtree::join(left, right, axis)
    }

    fn grow(&self, tree: &mut Subtree, items: &mut [Item], first: usize, depth: usize) -> Child {
        let Some(Cut { middle, axis }) = cut(items, depth, self.leaf_size) else {
            tree.leaves.push(first as u32..(first + items.len()) as u32);
            return Child::leaf(tree.leaves.len() - 1);
        };
        let (left, right) = items.split_at_mut(middle);
        let bounds = [bounds_of(left), bounds_of(right)];
        let index = tree.nodes.len();
        tree.nodes.push(node(bounds, [Child::node(0); 2], axis));
        let children = [
            self.grow(tree, left, first, depth + 1),
            self.grow(tree, right, first + middle, depth + 1),
        ];
        tree.nodes[index].children = children;
        Child::node(index)
    }
}

fn node(bounds: [Aabb; 2], children: [Child; 2], axis: usize) -> Node {
    Node {
        bounds: bounds.map(|b| [b.min.x, b.min.y, b.min.z, b.max.x, b.max.y, b.max.z]),
        children,
        axis: axis as u32,
    }
}

fn bounds_of(items: &[Item]) -> Aabb {
    items
        .iter()
        .fold(Aabb::EMPTY, |bounds, item| bounds.union(item.bounds))
}

/// Half the surface of a box; 0 for the empty one.
fn half_area(bounds: &Aabb) -> f32 {
    let size = bounds.size().max(Vec3::ZERO);
    size.x * size.y + size.y * size.z + size.z * size.x
}

/// Orders the items of a node by side of its best border; `None` where they fit into a leaf.
fn cut(items: &mut [Item], depth: usize, leaf_size: usize) -> Option<Cut> {
    // A full leaf takes hardly longer to test than one that is half full, and less memory.
    if items.len() <= leaf_size.max(1) {
        return None;
    }
    let border = (depth < HALVE_FROM_DEPTH)
        .then(|| best_border(items))
        .flatten();
    let Some(border) = border else {
        return Some(Cut {
            middle: items.len() / 2,
            axis: 0,
        });
    };
    let middle = partition(items, |item| {
        border.bins.bin_of(item)[border.axis] <= border.bin
    });
    Some(Cut {
        middle,
        axis: border.axis,
    })
}

/// Puts the items that are left before the others; how many they are.
fn partition(items: &mut [Item], is_left: impl Fn(&Item) -> bool) -> usize {
    let mut middle = 0;
    for index in 0..items.len() {
        if is_left(&items[index]) {
            items.swap(index, middle);
            middle += 1;
        }
    }
    middle
}

/// From centroids to bins.
#[derive(Clone, Copy)]
struct Binning {
    origin: Vec3,
    bins_per_m: Vec3,
}

impl Binning {
    /// `None` where all centroids are one.
    fn over(items: &[Item]) -> Option<Self> {
        let centroids = Aabb::of(items.iter().map(Item::centroid));
        let size = centroids.size();
        if size.max_element() <= 0.0 {
            return None;
        }
        let per_axis = |size: f32| {
            let bins_per_m = BINS as f32 * (1.0 - 1e-6) / size;
            if bins_per_m.is_finite() {
                bins_per_m
            } else {
                0.0
            }
        };
        Some(Self {
            origin: centroids.min,
            bins_per_m: Vec3::new(per_axis(size.x), per_axis(size.y), per_axis(size.z)),
        })
    }

    #[inline]
    fn bin_of(&self, item: &Item) -> [usize; 3] {
        let place = (item.centroid() - self.origin) * self.bins_per_m;
        [place.x, place.y, place.z].map(|place| (place as usize).min(BINS - 1))
    }
}

/// Items up to this bin go left.
struct Border {
    bins: Binning,
    axis: usize,
    bin: usize,
}

/// The border of least cost over all axes; `None` where no border has items on both its sides.
fn best_border(items: &[Item]) -> Option<Border> {
    let binning = Binning::over(items)?;
    let mut bounds = [[Aabb::EMPTY; BINS]; 3];
    let mut counts = [[0_u32; BINS]; 3];
    for item in items {
        for (axis, bin) in binning.bin_of(item).into_iter().enumerate() {
            bounds[axis][bin] = bounds[axis][bin].union(item.bounds);
            counts[axis][bin] += 1;
        }
    }
    let mut best: Option<(f32, usize, usize)> = None;
    for axis in 0..3 {
        for (bin, cost) in border_costs(&bounds[axis], &counts[axis])
            .into_iter()
            .enumerate()
        {
            if cost.is_finite() && best.is_none_or(|(least, ..)| cost < least) {
                best = Some((cost, axis, bin));
            }
        }
    }
    best.map(|(_, axis, bin)| Border {
        bins: binning,
        axis,
        bin,
    })
}

/// area · count on both sides of the border behind each bin; infinite where a side is empty.
fn border_costs(bounds: &[Aabb; BINS], counts: &[u32; BINS]) -> [f32; BINS - 1] {
    let mut costs = [0.0; BINS - 1];
    let mut add = |bins: &mut dyn Iterator<Item = usize>, border_of: fn(usize) -> usize| {
        let (mut side, mut count) = (Aabb::EMPTY, 0);
        for bin in bins {
            side = side.union(bounds[bin]);
            count += counts[bin];
            costs[border_of(bin)] += if count == 0 {
                f32::INFINITY
            } else {
                half_area(&side) * count as f32
            };
        }
    };
    add(&mut (0..BINS - 1), |bin| bin);
    add(&mut (1..BINS).rev(), |bin| bin - 1);
    costs
}
