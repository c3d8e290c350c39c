//! A linear octree whose nodes have 4×4×4 cells each: sorted Morton keys per depth, with tables of
//! parents, children and the 26 neighbors, so that inner loops need no search.
//!
//! The cells of depth `d` are `2^-d` of the cube wide. A node exists at depth `d` if any sample near
//! its cells is dense enough, and every node has its parent: where finer cells end, the coarser ones
//! continue.

use rayon::prelude::*;

use super::samples::Samples;
use crate::geometry::morton;

/// Depth down to which the whole cube is divided; below it the tree adapts to the samples.
pub const BASE_DEPTH: u32 = 5;

/// Number of cells of a node, and of its own grid corners, the lowest corners of its cells.
pub const CELLS: usize = 64;

/// Minimum number of nodes per parallel task.
pub const GRAIN: usize = 64;

/// The nodes of one depth.
#[derive(Default)]
pub struct Level {
    /// The cells of the nodes are `2^-depth` wide.
    pub depth: u32,
    /// Morton codes of the nodes, ascending.
    pub keys: Vec<u64>,
    /// Node of the level above.
    pub parents: Vec<u32>,
    /// First child in the level below; children are consecutive.
    pub first_child: Vec<u32>,
    /// Bits of the octants that have a child.
    pub child_mask: Vec<u8>,
    /// Nodes around each node, x fastest; `len()` for missing ones.
    pub neighbors: Vec<[u32; 27]>,
    /// Range of the samples inside each node.
    pub samples: Vec<[u32; 2]>,
}

impl Level {
    /// Number of nodes.
    pub fn len(&self) -> usize {
        self.keys.len()
    }

    /// The lowest cell of a node.
    #[inline]
    pub fn first_cell(&self, node: usize) -> [i32; 3] {
        morton::decode(self.keys[node]).map(|x| 4 * x as i32)
    }

    /// The parent of a node and the octant of the node in it.
    #[inline]
    pub fn parent_octant(&self, node: usize) -> (usize, usize) {
        (self.parents[node] as usize, (self.keys[node] & 7) as usize)
    }

    /// The child of a node in an octant.
    #[inline]
    pub fn child(&self, node: usize, octant: usize) -> Option<usize> {
        let mask = self.child_mask[node];
        let bit = 1_u8 << octant;
        (mask & bit != 0)
            .then(|| self.first_child[node] as usize + (mask & (bit - 1)).count_ones() as usize)
    }

    /// A neighbor by its offset, -1 to 1 per axis.
    #[inline]
    pub fn neighbor(&self, node: usize, [x, y, z]: [i32; 3]) -> Option<usize> {
        let direction = (x + 1) + 3 * (y + 1) + 9 * (z + 1);
        let index = self.neighbors[node][direction as usize] as usize;
        (index < self.len()).then_some(index)
    }

    /// The values of a function of the nodes, computed in parallel.
    pub fn par_map<T: Send>(&self, value: impl Fn(usize) -> T + Send + Sync) -> Vec<T> {
        (0..self.len())
            .into_par_iter()
            .with_min_len(GRAIN)
            .map(value)
            .collect()
    }

    /// Calls `visit(sample, cell, position in the cell)` for the samples in cells -1 to `last` (3 or
    /// 4) of a node, in the order of the neighbors.
    #[inline]
    pub fn for_each_sample_around(
        &self,
        node: usize,
        samples: &Samples,
        last: i32,
        mut visit: impl FnMut(usize, [i32; 3], [f32; 3]),
    ) {
        let first = self.first_cell(node);
        let is_near = |offset: &[i32; 3]| offset.iter().all(|&x| x <= last - 3);
        for from in offsets()
            .filter(is_near)
            .filter_map(|offset| self.neighbor(node, offset))
        {
            let [begin, end] = self.samples[from];
            for sample in begin as usize..end as usize {
                let (cell, inside) = samples.cell(sample, self.depth);
                let local = [0, 1, 2].map(|axis| cell[axis] - first[axis]);
                if local.iter().all(|&x| x >= -1 && x <= last) {
                    visit(sample, local, inside);
                }
            }
        }
    }
}

/// The nodes of all depths.
pub struct Octree {
    /// From the base depth to the finest; `levels[0]` is complete, each node of the others has its
    /// parent in the level before.
    pub levels: Vec<Level>,
}

impl Octree {
    /// The octree down to `depth`, with the cells around each sample for which `is_dense(sample,
    /// depth)`.
    pub fn build(
        samples: &Samples,
        depth: u32,
        is_dense: impl Fn(usize, u32) -> bool + Sync,
    ) -> Self {
        let base = depth.min(BASE_DEPTH);
        let mut keys_per_level: Vec<Vec<u64>> = Vec::new();
        for depth in (base + 1..=depth).rev() {
            let mut keys = keys_around_samples(samples, depth, |sample| is_dense(sample, depth));
            let children = keys_per_level.last().into_iter().flatten();
            keys.extend(children.map(|key| key >> 3));
            keys.par_sort_unstable();
            keys.dedup();
            keys_per_level.push(keys);
        }
        keys_per_level.push((0..1_u64 << (3 * (base - 2))).collect());

        let mut levels: Vec<Level> = Vec::new();
        for (depth, keys) in (base..).zip(keys_per_level.into_iter().rev()) {
            let mut level = Level {
                depth,
                first_child: vec![0; keys.len()],
                child_mask: vec![0; keys.len()],
                keys,
                ..Level::default()
            };
            match levels.last_mut() {
                None => link_base(&mut level),
                Some(parents) => link(parents, &mut level),
            }
            level.samples = sample_ranges(samples, &level, levels.last());
            levels.push(level);
        }
        Self { levels }
    }

    /// The node of `levels[level]` that contains a cell of that level's depth.
    pub fn node_at(&self, level: usize, cell: [i32; 3]) -> Option<usize> {
        let cells = 1 << self.levels[level].depth;
        if cell.iter().any(|&x| x < 0 || x >= cells) {
            return None;
        }
        let key = morton::encode(cell.map(|x| x as u32 >> 2));
        let mut node = (key >> (3 * level)) as usize;
        for step in 0..level {
            let octant = (key >> (3 * (level - 1 - step))) as usize & 7;
            node = self.levels[step].child(node, octant)?;
        }
        Some(node)
    }
}

/// Offsets of the 27 neighbors, x fastest.
pub fn offsets() -> impl Iterator<Item = [i32; 3]> {
    (0..27).map(|index| [index % 3 - 1, index / 3 % 3 - 1, index / 9 - 1])
}

/// Keys of the nodes that contain the cell of a dense sample or one of the 26 cells around it.
fn keys_around_samples(
    samples: &Samples,
    depth: u32,
    is_dense: impl Fn(usize) -> bool + Sync,
) -> Vec<u64> {
    const CHUNK: usize = 1 << 14;
    let cell_shift = 3 * (samples.depth - depth);
    let emit = |key: u64, touched: u32, keys: &mut Vec<u64>| {
        let around = neighbor_keys(key, depth).enumerate();
        keys.extend(around.filter_map(|(index, key)| key.filter(|_| touched & 1 << index != 0)));
    };
    let chunks: Vec<Vec<u64>> = samples
        .codes
        .par_chunks(CHUNK)
        .enumerate()
        .map(|(chunk, codes)| {
            let mut keys = Vec::new();
            let (mut key, mut touched) = (u64::MAX, 0_u32);
            let mut previous = u64::MAX;
            for (index, &code) in codes.iter().enumerate() {
                let cell = code >> cell_shift;
                if cell == previous || !is_dense(chunk * CHUNK + index) {
                    continue;
                }
                previous = cell;
                if cell >> 6 != key {
                    emit(key, touched, &mut keys);
                    (key, touched) = (cell >> 6, 0);
                }
                touched |= touched_neighbors(morton::decode(cell & 63));
            }
            emit(key, touched, &mut keys);
            keys
        })
        .collect();
    let mut keys = chunks.concat();
    keys.par_sort_unstable();
    keys.dedup();
    keys
}

/// Keys of the 27 nodes around a node of a depth; `None` outside the cube.
fn neighbor_keys(key: u64, depth: u32) -> impl Iterator<Item = Option<u64>> {
    let node = morton::decode(key).map(|x| x as i32);
    offsets().map(move |offset| {
        let other = [0, 1, 2].map(|axis| node[axis] + offset[axis]);
        let is_inside = other.iter().all(|&x| x >= 0 && x < 1 << (depth - 2));
        is_inside.then(|| morton::encode(other.map(|x| x as u32)))
    })
}

/// Bits of the neighbors that have a cell next to a cell of the node.
fn touched_neighbors(cell: [u32; 3]) -> u32 {
    offsets().enumerate().fold(0, |bits, (index, offset)| {
        let touches = (0..3).all(|axis| match offset[axis] {
            -1 => cell[axis] == 0,
            1 => cell[axis] == 3,
            _ => true,
        });
        bits | u32::from(touches) << index
    })
}

/// Links the nodes of the complete level.
fn link_base(level: &mut Level) {
    let none = level.len() as u32;
    level.parents = vec![0; level.len()];
    level.neighbors = vec![[none; 27]; level.len()];
    for (key, neighbors) in (0..).zip(&mut level.neighbors) {
        for (neighbor, key) in neighbors.iter_mut().zip(neighbor_keys(key, level.depth)) {
            *neighbor = key.map_or(none, |key| key as u32);
        }
    }
}

/// Links a level to the one above it. A neighbor is a child of the parent's neighbor.
fn link(above: &mut Level, level: &mut Level) {
    let mut parent = 0;
    level.parents = Vec::with_capacity(level.len());
    for (node, key) in level.keys.iter().enumerate() {
        while above.keys[parent] != key >> 3 {
            parent += 1;
        }
        if above.child_mask[parent] == 0 {
            above.first_child[parent] = node as u32;
        }
        above.child_mask[parent] |= 1 << (key & 7);
        level.parents.push(parent as u32);
    }
    level.neighbors = level.par_map(|node| {
        let (parent, octant) = level.parent_octant(node);
        let octant = morton::decode(octant as u64).map(|x| x as i32);
        let mut neighbors = [level.len() as u32; 27];
        for (neighbor, offset) in neighbors.iter_mut().zip(offsets()) {
            let position = [0, 1, 2].map(|axis| octant[axis] + offset[axis]);
            let octant = morton::encode(position.map(|x| x.rem_euclid(2) as u32)) as usize;
            let uncle = above.neighbor(parent, position.map(|x| x.div_euclid(2)));
            if let Some(node) = uncle.and_then(|uncle| above.child(uncle, octant)) {
                *neighbor = node as u32;
            }
        }
        neighbors
    });
}

fn sample_ranges(samples: &Samples, level: &Level, above: Option<&Level>) -> Vec<[u32; 2]> {
    let shift = 3 * (samples.depth + 2 - level.depth);
    level.par_map(|node| {
        let [begin, end] = above.map_or([0, samples.len() as u32], |above| {
            above.samples[level.parents[node] as usize]
        });
        let codes = &samples.codes[begin as usize..end as usize];
        let key = level.keys[node];
        let first = codes.partition_point(|code| code >> shift < key) as u32;
        let last = codes.partition_point(|code| code >> shift <= key) as u32;
        [begin + first, begin + last]
    })
}
