//! Binary bounding volume hierarchy (BVH). Every node holds the boxes of its two children, so that
//! one cache line decides where a packet of rays continues.
//!
//! Built top-down by the surface area heuristic over binned centroids,
//!
//! ```text
//! cost(split) = area(left) · |left| + area(right) · |right|        |·|: number of leaves, if full
//! ```
//!
//! Wald, *On fast Construction of SAH-based Bounding Volume Hierarchies*, RT 2007. Large subtrees
//! are built in parallel; the tree does not depend on the number of threads.

use std::ops::Range;

use glam::Vec4;

use crate::geometry::Aabb;

/// Most bins per axis.
const MAX_BINS: usize = 16;
/// Bins per axis for a handful of primitives.
const MIN_BINS: usize = 4;
/// Primitives per further bin.
const PRIMS_PER_BIN: usize = 2;
/// Subtrees with fewer primitives are built by one thread.
const MIN_PARALLEL: usize = 4096;
/// From this depth on nodes are halved by count, which bounds the depth of the whole tree.
const HALVING_DEPTH: usize = 48;
/// Bound of the depth: below [`HALVING_DEPTH`] each level halves at most 2³² primitives.
pub(super) const MAX_DEPTH: usize = HALVING_DEPTH + 32;

/// Reference to an inner node or to a leaf.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct NodeRef(u32);

impl NodeRef {
    const LEAF: u32 = 1 << 31;

    pub const fn inner(index: usize) -> Self {
        debug_assert!(index < Self::LEAF as usize);
        Self(index as u32)
    }

    pub const fn leaf(index: usize) -> Self {
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
}

/// Two children and their boxes: one cache line.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub(crate) struct BvhNode {
    /// Lower corner x, y, z, then upper corner x, y, z of each child.
    pub bounds: [[f32; 6]; 2],
    pub children: [NodeRef; 2],
    /// Axis along which the first child lies lower.
    pub axis: u32,
}

impl BvhNode {
    fn new(bounds: [Box4; 2], children: [NodeRef; 2], axis: usize) -> Self {
        Self {
            bounds: bounds.map(Box4::to_array),
            children,
            axis: axis as u32,
        }
    }
}

/// The hierarchy.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bvh {
    pub nodes: Vec<BvhNode>,
    /// `None` without primitives.
    pub root: Option<NodeRef>,
    /// Box of all primitives: lower corner x, y, z, then upper corner x, y, z.
    pub bounds: [f32; 6],
}

impl Bvh {
    /// Builds the hierarchy over primitives, at most `leaf_size` to a leaf, and lists the
    /// primitives of each leaf.
    pub fn build(mut prims: Vec<PrimRef>, leaf_size: usize) -> (Self, Leaves) {
        if prims.is_empty() {
            return Default::default();
        }
        let leaf_size = leaf_size.max(1);
        let all = Interval::of_all(&mut prims);
        let bounds = all.bounds.prims.to_array();
        let tree = Subtree::build_parallel(all, leaf_size, 0);
        let leaves = Leaves {
            ranges: tree.leaves,
            order: prims.iter().map(PrimRef::index).collect(),
        };
        let bvh = Self {
            nodes: tree.nodes,
            root: Some(tree.root),
            bounds,
        };
        (bvh, leaves)
    }
}

/// The primitives of each leaf.
#[derive(Default)]
pub(crate) struct Leaves {
    /// Range of each leaf in `order`.
    pub ranges: Vec<Range<u32>>,
    /// Indices of the primitives, leaf by leaf.
    pub order: Vec<u32>,
}

/// A part of the tree that numbers its own nodes and leaves from zero.
struct Subtree {
    nodes: Vec<BvhNode>,
    leaves: Vec<Range<u32>>,
    root: NodeRef,
}

impl Subtree {
    fn build_parallel(interval: Interval, leaf_size: usize, depth: usize) -> Self {
        if interval.prims.len() < MIN_PARALLEL {
            let mut tree = Self {
                nodes: Vec::with_capacity(interval.prims.len() / 2),
                leaves: Vec::with_capacity(interval.prims.len() / 2),
                root: NodeRef::inner(0),
            };
            tree.root = tree.build(interval, leaf_size, depth);
            return tree;
        }
        let (axis, [left, right]) = interval.split(leaf_size, depth);
        let bounds = [left.bounds.prims, right.bounds.prims];
        let (left, right) = rayon::join(
            || Self::build_parallel(left, leaf_size, depth + 1),
            || Self::build_parallel(right, leaf_size, depth + 1),
        );
        left.join(right, bounds, axis)
    }

    /// Appends the nodes and leaves of an interval and returns their root.
    fn build(&mut self, interval: Interval, leaf_size: usize, depth: usize) -> NodeRef {
        // A full leaf takes hardly longer to test than one that is half full, and less memory.
        if interval.prims.len() <= leaf_size {
            let end = interval.first + interval.prims.len();
            self.leaves.push(interval.first as u32..end as u32);
            return NodeRef::leaf(self.leaves.len() - 1);
        }
        let (axis, sides) = interval.split(leaf_size, depth);
        let bounds = [sides[0].bounds.prims, sides[1].bounds.prims];
        let index = self.nodes.len();
        self.nodes
            .push(BvhNode::new(bounds, [NodeRef::inner(0); 2], axis));
        let children = sides.map(|side| self.build(side, leaf_size, depth + 1));
        self.nodes[index].children = children;
        NodeRef::inner(index)
    }

    /// Joins two subtrees under a new node.
    fn join(mut self, right: Self, bounds: [Box4; 2], axis: usize) -> Self {
        let (nodes, leaves) = (self.nodes.len(), self.leaves.len());
        let shift = |node: NodeRef| {
            if node.is_leaf() {
                NodeRef::leaf(node.index() + leaves)
            } else {
                NodeRef::inner(node.index() + nodes)
            }
        };
        self.leaves.extend(right.leaves);
        self.nodes
            .extend(right.nodes.into_iter().map(|node| BvhNode {
                children: node.children.map(shift),
                ..node
            }));
        let children = [self.root, shift(right.root)];
        self.root = NodeRef::inner(self.nodes.len());
        self.nodes.push(BvhNode::new(bounds, children, axis));
        self
    }
}

/// Axis-aligned box in four lanes, of which the last has no meaning.
#[derive(Clone, Copy)]
struct Box4 {
    min: Vec4,
    max: Vec4,
}

impl Box4 {
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

    fn to_array(self) -> [f32; 6] {
        let Self { min, max } = self;
        [min.x, min.y, min.z, max.x, max.y, max.z]
    }

    /// Half the surface area; 0 for the empty box.
    #[inline]
    fn half_area(self) -> f32 {
        let size = (self.max - self.min).max(Vec4::ZERO);
        size.x * size.y + size.y * size.z + size.z * size.x
    }
}

/// Primitive reference: the box of a primitive, with its index in the last lane.
#[derive(Clone, Copy)]
pub(crate) struct PrimRef(Box4);

impl PrimRef {
    pub fn new(bounds: Aabb, index: u32) -> Self {
        Self(Box4 {
            min: bounds.min.extend(f32::from_bits(index)),
            max: bounds.max.extend(0.0),
        })
    }

    fn index(&self) -> u32 {
        self.0.min.w.to_bits()
    }

    /// Twice the centroid of the box.
    #[inline]
    fn centroid(&self) -> Vec4 {
        self.0.min + self.0.max
    }
}

/// Bounds of a set of primitives and of their centroids.
#[derive(Clone, Copy)]
struct Bounds {
    prims: Box4,
    centroids: Box4,
}

impl Bounds {
    const EMPTY: Self = Self {
        prims: Box4::EMPTY,
        centroids: Box4::EMPTY,
    };

    #[inline]
    fn add(&mut self, prim: &PrimRef) {
        let centroid = prim.centroid();
        self.prims = self.prims.union(prim.0);
        self.centroids = self.centroids.union(Box4 {
            min: centroid,
            max: centroid,
        });
    }

    fn of(prims: &[PrimRef]) -> Self {
        let mut bounds = Self::EMPTY;
        prims.iter().for_each(|prim| bounds.add(prim));
        bounds
    }
}

/// The primitives of a node.
struct Interval<'a> {
    prims: &'a mut [PrimRef],
    /// Position of the first one among all.
    first: usize,
    bounds: Bounds,
}

impl<'a> Interval<'a> {
    fn of_all(prims: &'a mut [PrimRef]) -> Self {
        Self {
            bounds: Bounds::of(prims),
            first: 0,
            prims,
        }
    }

    /// Partitions the primitives by the best split; returns its axis and both sides, neither of
    /// which is empty.
    fn split(self, leaf_size: usize, depth: usize) -> (usize, [Self; 2]) {
        let split = (depth < HALVING_DEPTH)
            .then(|| Split::best(self.prims, &self.bounds.centroids, leaf_size))
            .flatten();
        let (axis, middle, bounds) = match split {
            Some(split) => {
                let (middle, bounds) = split.partition(self.prims);
                (split.axis, middle, bounds)
            }
            None => {
                let middle = self.prims.len() / 2;
                let (left, right) = self.prims.split_at(middle);
                (0, middle, [Bounds::of(left), Bounds::of(right)])
            }
        };
        let (left, right) = self.prims.split_at_mut(middle);
        let side = |prims, first, bounds| Self {
            prims,
            first,
            bounds,
        };
        let left = side(left, self.first, bounds[0]);
        (axis, [left, side(right, self.first + middle, bounds[1])])
    }
}

/// Mapping from centroids to bins.
#[derive(Clone, Copy)]
struct BinMapping {
    origin: Vec4,
    bins_per_m: Vec4,
    last: f32,
}

impl BinMapping {
    /// `None` if all centroids coincide. Few primitives need few bins.
    fn new(centroids: &Box4, prims: usize) -> Option<Self> {
        let bins = (MIN_BINS + prims / PRIMS_PER_BIN).min(MAX_BINS) as f32;
        let size = (centroids.max - centroids.min).truncate();
        if size.max_element() <= 0.0 {
            return None;
        }
        let bins_per_m = size.to_array().map(|size| {
            let bins_per_m = bins * (1.0 - 1e-6) / size;
            if bins_per_m.is_finite() {
                bins_per_m
            } else {
                0.0
            }
        });
        Some(Self {
            origin: centroids.min,
            bins_per_m: glam::Vec3::from_array(bins_per_m).extend(0.0),
            last: bins - 1.0,
        })
    }

    /// The bin of a primitive per axis.
    #[inline]
    fn bins(&self, prim: &PrimRef) -> [f32; 4] {
        let place = (prim.centroid() - self.origin) * self.bins_per_m;
        place.min(Vec4::splat(self.last)).to_array()
    }
}

/// Split of a node: primitives up to this bin go left.
struct Split {
    mapping: BinMapping,
    axis: usize,
    bin: usize,
}

impl Split {
    /// The split of least cost over all axes; `None` if none has primitives on both sides.
    fn best(prims: &[PrimRef], centroids: &Box4, leaf_size: usize) -> Option<Self> {
        let mapping = BinMapping::new(centroids, prims.len())?;
        let mut bounds = [[Box4::EMPTY; MAX_BINS]; 3];
        let mut counts = [[0_u32; MAX_BINS]; 3];
        for prim in prims {
            let place = mapping.bins(prim);
            for axis in 0..3 {
                let bin = place[axis] as usize % MAX_BINS;
                bounds[axis][bin] = bounds[axis][bin].union(prim.0);
                counts[axis][bin] += 1;
            }
        }
        let used = mapping.last as usize + 1;
        let mut best: Option<(f32, usize, usize)> = None;
        for axis in 0..3 {
            let costs = split_costs(
                &bounds[axis][..used],
                &counts[axis][..used],
                leaf_size as u32,
            );
            for (bin, &cost) in costs[..used - 1].iter().enumerate() {
                if cost.is_finite() && best.is_none_or(|(least, ..)| cost < least) {
                    best = Some((cost, axis, bin));
                }
            }
        }
        best.map(|(_, axis, bin)| Self { mapping, axis, bin })
    }

    /// Moves the primitives of the left side before the others; returns their number and the
    /// bounds of both sides.
    fn partition(&self, prims: &mut [PrimRef]) -> (usize, [Bounds; 2]) {
        let [mut left, mut right] = [Bounds::EMPTY; 2];
        let (mut middle, mut end) = (0, prims.len());
        while middle < end {
            let prim = prims[middle];
            if self.mapping.bins(&prim)[self.axis] as usize <= self.bin {
                left.add(&prim);
                middle += 1;
            } else {
                right.add(&prim);
                end -= 1;
                prims.swap(middle, end);
            }
        }
        (middle, [left, right])
    }
}

/// area · number of full leaves on both sides of the split after each bin; infinite if a side is empty.
fn split_costs(bounds: &[Box4], counts: &[u32], leaf_size: u32) -> [f32; MAX_BINS] {
    let mut costs = [0.0; MAX_BINS];
    let bins = bounds.iter().zip(counts);
    let splits = &mut costs[..bounds.len() - 1];
    add_side_costs(splits.iter_mut().rev(), bins.clone().rev(), leaf_size);
    add_side_costs(splits.iter_mut(), bins, leaf_size);
    costs
}

/// Adds area · number of leaves of the bins so far to the cost of each split.
fn add_side_costs<'a>(
    costs: impl Iterator<Item = &'a mut f32>,
    bins: impl Iterator<Item = (&'a Box4, &'a u32)>,
    leaf_size: u32,
) {
    let (mut side, mut total) = (Box4::EMPTY, 0);
    for (cost, (bounds, count)) in costs.zip(bins) {
        side = side.union(*bounds);
        total += count;
        *cost += if total == 0 {
            f32::INFINITY
        } else {
            side.half_area() * total.div_ceil(leaf_size) as f32
        };
    }
}
