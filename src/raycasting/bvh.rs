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

use glam::Vec4;
use rayon::prelude::*;

use crate::geometry::Aabb;

/// The most candidate borders per axis, and one.
const BINS: usize = 16;
/// Bins per axis for a handful of items.
const FEWEST_BINS: usize = 4;
/// One more bin for so many more items.
const ITEMS_PER_BIN: usize = 2;
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
    pub fn build(items: &[Item], leaf_size: usize) -> (Self, Leaves) {
        if items.is_empty() {
            return Default::default();
        }
        let mut parcels: Vec<Parcel> = items.iter().map(Parcel::of).collect();
        let tree = Grower { leaf_size }.grow_parallel(Span::of_all(&mut parcels), 0);
        let leaves = Leaves {
            ranges: tree.leaves,
            order: parcels.iter().map(Parcel::index).collect(),
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
        self.ranges.iter().map(|range| self.of(range))
    }

    /// The same on all threads of the current pool.
    pub fn par_iter(&self) -> impl IndexedParallelIterator<Item = &[u32]> {
        self.ranges.par_iter().map(|range| self.of(range))
    }

    fn of(&self, range: &Range<u32>) -> &[u32] {
        &self.order[range.start as usize..range.end as usize]
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
    fn join([left, right]: [Self; 2], bounds: [Extent; 2], axis: usize) -> Self {
        let mut tree = left;
        let (nodes, leaves) = (tree.nodes.len(), tree.leaves.len());
        let shift = |child: Child| child.shifted(nodes, leaves);
        tree.leaves.extend(right.leaves);
        tree.nodes.extend(right.nodes.into_iter().map(|node| Node {
            children: node.children.map(shift),
            ..node
        }));
        let children = [tree.root, shift(right.root)];
        tree.root = Child::node(tree.nodes.len());
        tree.nodes.push(node(bounds, children, axis));
        tree
    }
}

struct Grower {
    leaf_size: usize,
}

impl Grower {
    fn grow_parallel(&self, span: Span, depth: usize) -> Subtree {
        if span.parcels.len() < PARALLEL_FROM {
            let mut tree = Subtree {
                nodes: Vec::with_capacity(span.parcels.len() / 2),
                leaves: Vec::with_capacity(span.parcels.len() / 2),
                root: Child::node(0),
            };
            tree.root = self.grow(&mut tree, span, depth);
            return tree;
        }
        let (axis, [left, right]) = span.cut(depth);
        let bounds = [left.within.boxes, right.within.boxes];
        let (left, right) = rayon::join(
            || self.grow_parallel(left, depth + 1),
            || self.grow_parallel(right, depth + 1),
        );
        Subtree::join([left, right], bounds, axis)
    }

    fn grow(&self, tree: &mut Subtree, span: Span, depth: usize) -> Child {
        // A full leaf takes hardly longer to test than one that is half full, and less memory.
        if span.parcels.len() <= self.leaf_size.max(1) {
            let end = span.first + span.parcels.len();
            tree.leaves.push(span.first as u32..end as u32);
            return Child::leaf(tree.leaves.len() - 1);
        }
        let (axis, sides) = span.cut(depth);
        let bounds = [sides[0].within.boxes, sides[1].within.boxes];
        let index = tree.nodes.len();
        tree.nodes.push(node(bounds, [Child::node(0); 2], axis));
        let children = sides.map(|side| self.grow(tree, side, depth + 1));
        tree.nodes[index].children = children;
        Child::node(index)
    }
}

fn node(bounds: [Extent; 2], children: [Child; 2], axis: usize) -> Node {
    Node {
        bounds: bounds.map(|b| [b.min.x, b.min.y, b.min.z, b.max.x, b.max.y, b.max.z]),
        children,
        axis: axis as u32,
    }
}

/// From and to; the last lane means nothing. Four lanes are one instruction.
#[derive(Clone, Copy)]
struct Extent {
    min: Vec4,
    max: Vec4,
}

impl Extent {
    const EMPTY: Self = Self {
        min: Vec4::INFINITY,
        max: Vec4::NEG_INFINITY,
    };

    #[inline]
    fn union(self, other: Self) -> Self {
        Self {
            min: self.min.min(other.min),
            max: self.max.max(other.max),
        }
    }

    /// Half the surface; 0 for the empty one.
    #[inline]
    fn half_area(self) -> f32 {
        let size = (self.max - self.min).max(Vec4::ZERO);
        size.x * size.y + size.y * size.z + size.z * size.x
    }
}

/// An item as it is moved about: its index rides in the last lane.
#[derive(Clone, Copy)]
struct Parcel(Extent);

impl Parcel {
    fn of(item: &Item) -> Self {
        Self(Extent {
            min: item.bounds.min.extend(f32::from_bits(item.index)),
            max: item.bounds.max.extend(0.0),
        })
    }

    fn index(&self) -> u32 {
        self.0.min.w.to_bits()
    }

    /// Twice the centre of the box.
    #[inline]
    fn centroid(&self) -> Vec4 {
        self.0.min + self.0.max
    }
}

/// What holds of a number of items.
#[derive(Clone, Copy)]
struct Within {
    boxes: Extent,
    centroids: Extent,
}

impl Within {
    const NOTHING: Self = Self {
        boxes: Extent::EMPTY,
        centroids: Extent::EMPTY,
    };

    #[inline]
    fn add(&mut self, parcel: &Parcel) {
        let centroid = parcel.centroid();
        self.boxes = self.boxes.union(parcel.0);
        self.centroids = self.centroids.union(Extent {
            min: centroid,
            max: centroid,
        });
    }

    fn of(parcels: &[Parcel]) -> Self {
        let mut within = Self::NOTHING;
        parcels.iter().for_each(|parcel| within.add(parcel));
        within
    }
}

/// The items of a node.
struct Span<'a> {
    parcels: &'a mut [Parcel],
    /// The place of the first one in the order of all.
    first: usize,
    within: Within,
}

impl<'a> Span<'a> {
    fn of_all(parcels: &'a mut [Parcel]) -> Self {
        Self {
            within: Within::of(parcels),
            first: 0,
            parcels,
        }
    }

    /// Orders the items by side of the best border and cuts them there: the axis, and two sides of
    /// which neither is empty.
    fn cut(self, depth: usize) -> (usize, [Self; 2]) {
        let border = (depth < HALVE_FROM_DEPTH)
            .then(|| Border::best(self.parcels, &self.within.centroids))
            .flatten();
        let (axis, middle, sides) = match border {
            Some(border) => {
                let (middle, sides) = border.partition(self.parcels);
                (border.axis, middle, sides)
            }
            None => {
                let middle = self.parcels.len() / 2;
                let (left, right) = self.parcels.split_at(middle);
                (0, middle, [Within::of(left), Within::of(right)])
            }
        };
        let (left, right) = self.parcels.split_at_mut(middle);
        let left = Self {
            parcels: left,
            first: self.first,
            within: sides[0],
        };
        let right = Self {
            parcels: right,
            first: self.first + middle,
            within: sides[1],
        };
        (axis, [left, right])
    }
}

/// From centroids to bins.
#[derive(Clone, Copy)]
struct Binning {
    origin: Vec4,
    bins_per_m: Vec4,
    last: f32,
}

impl Binning {
    /// `None` where all centroids are one. Few items need few bins.
    fn over(centroids: &Extent, items: usize) -> Option<Self> {
        let bins = (FEWEST_BINS + items / ITEMS_PER_BIN).min(BINS) as f32;
        let size = (centroids.max - centroids.min).truncate();
        if size.max_element() <= 0.0 {
            return None;
        }
        let per_axis = |size: f32| {
            let bins_per_m = bins * (1.0 - 1e-6) / size;
            if bins_per_m.is_finite() {
                bins_per_m
            } else {
                0.0
            }
        };
        Some(Self {
            origin: centroids.min,
            bins_per_m: Vec4::new(per_axis(size.x), per_axis(size.y), per_axis(size.z), 0.0),
            last: bins - 1.0,
        })
    }

    /// The bin of an item per axis.
    #[inline]
    fn of(&self, parcel: &Parcel) -> [f32; 4] {
        let place = (parcel.centroid() - self.origin) * self.bins_per_m;
        place.min(Vec4::splat(self.last)).to_array()
    }
}

/// Items up to this bin go left.
struct Border {
    bins: Binning,
    axis: usize,
    bin: usize,
}

impl Border {
    /// The border of least cost over all axes; `None` where no border has items on both its sides.
    fn best(parcels: &[Parcel], centroids: &Extent) -> Option<Self> {
        let bins = Binning::over(centroids, parcels.len())?;
        let mut bounds = [[Extent::EMPTY; BINS]; 3];
        let mut counts = [[0_u32; BINS]; 3];
        for parcel in parcels {
            let place = bins.of(parcel);
            for axis in 0..3 {
                let bin = place[axis] as usize % BINS;
                bounds[axis][bin] = bounds[axis][bin].union(parcel.0);
                counts[axis][bin] += 1;
            }
        }
        let used = bins.last as usize + 1;
        let mut best: Option<(f32, usize, usize)> = None;
        for axis in 0..3 {
            let costs = border_costs(&bounds[axis][..used], &counts[axis][..used]);
            for (bin, &cost) in costs[..used - 1].iter().enumerate() {
                if cost.is_finite() && best.is_none_or(|(least, ..)| cost < least) {
                    best = Some((cost, axis, bin));
                }
            }
        }
        best.map(|(_, axis, bin)| Self { bins, axis, bin })
    }

    /// Puts the items of the left side before the others: how many they are, and what holds of
    /// both sides.
    fn partition(&self, parcels: &mut [Parcel]) -> (usize, [Within; 2]) {
        let [mut left, mut right] = [Within::NOTHING; 2];
        let (mut middle, mut end) = (0, parcels.len());
        while middle < end {
            let parcel = parcels[middle];
            if self.bins.of(&parcel)[self.axis] as usize <= self.bin {
                left.add(&parcel);
                middle += 1;
            } else {
                right.add(&parcel);
                end -= 1;
                parcels.swap(middle, end);
            }
        }
        (middle, [left, right])
    }
}

/// area · count on both sides of the border behind each bin; infinite where a side is empty.
fn border_costs(bounds: &[Extent], counts: &[u32]) -> [f32; BINS] {
    let cost_of = |side: Extent, count: u32| {
        if count == 0 {
            f32::INFINITY
        } else {
            side.half_area() * count as f32
        }
    };
    let mut costs = [0.0; BINS];
    let (mut side, mut count) = (Extent::EMPTY, 0);
    for bin in (1..bounds.len()).rev() {
        side = side.union(bounds[bin]);
        count += counts[bin];
        costs[bin - 1] = cost_of(side, count);
    }
    let (mut side, mut count) = (Extent::EMPTY, 0);
    for bin in 0..bounds.len() - 1 {
        side = side.union(bounds[bin]);
        count += counts[bin];
        costs[bin] += cost_of(side, count);
    }
    costs
}
