//! A linear octree whose nodes carry 4×4×4 cells each: sorted Morton keys per depth, with tables
//! for parents, children and the 26 neighbours, so that nothing is searched for in the inner loops.
//!
//! The cells of depth `d` are `2^-d` of the cube wide. A node of depth `d` holds those of its
//! cells for which any sample nearby is dense enough, and every node has its parent: where finer
//! cells end, the coarser ones go on.

use rayon::prelude::*;

use super::{morton, samples::Samples};

/// Down to this depth the whole cube is divided; only below it the tree adapts.
pub const BASE_DEPTH: u32 = 5;

/// Cells of a node, and grid corners that belong to it: those at the lower ends of its cells.
pub const CELLS: usize = 64;

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
    /// Which of the eight octants have a child.
    pub child_mask: Vec<u8>,
    /// Nodes around each node, x fastest; `len()` where there is none.
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

    /// The child of a node in an octant.
    #[inline]
    pub fn child(&self, node: usize, octant: usize) -> Option<usize> {
        let mask = self.child_mask[node];
        let bit = 1_u8 << octant;
        (mask & bit != 0)
            .then(|| self.first_child[node] as usize + (mask & (bit - 1)).count_ones() as usize)
    }

    /// A neighbour by its offset, -1 to 1 per axis; `None` where there is none.
    #[inline]
    pub fn neighbor(&self, node: usize, offset: [i32; 3]) -> Option<usize> {
        let index = self.neighbors[node][neighbor_index(offset)] as usize;
        (index < self.len()).then_some(index)
    }
}

/// Place of an offset, -1 to 1 per axis, among the 27 neighbours.
#[inline]
pub const fn neighbor_index(offset: [i32; 3]) -> usize {
    ((offset[0] + 1) + 3 * (offset[1] + 1) + 9 * (offset[2] + 1)) as usize
}

/// The nodes of all depths, from the base to the finest.
pub struct Octree {
    /// `levels[0]` is complete; each node of the others has its parent in the one before.
    pub levels: Vec<Level>,
}

impl Octree {
    /// Down to `depth`, with the cells around each sample for which `is_wanted(sample, depth)`.
    pub fn build(
        samples: &Samples,
        depth: u32,
        is_wanted: impl Fn(usize, u32) -> bool + Sync,
    ) -> Self {
        let base = depth.min(BASE_DEPTH);
        let mut keys_per_level: Vec<Vec<u64>> = Vec::new();
        let mut below: Vec<u64> = Vec::new();
        for depth in (base + 1..=depth).rev() {
            let mut keys = keys_around_samples(samples, depth, |sample| is_wanted(sample, depth));
            keys.extend(below.iter().map(|key| key >> 3));
            keys.par_sort_unstable();
            keys.dedup();
            below.clone_from(&keys);
            keys_per_level.push(keys);
        }
        keys_per_level.push((0..1_u64 << (3 * (base - 2))).collect());

        let mut levels: Vec<Level> = Vec::new();
        for (step, keys) in keys_per_level.into_iter().rev().enumerate() {
            let mut level = Level {
                depth: base + step as u32,
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

    /// The node of `levels[level]` that holds a cell of that level's depth.
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

/// Keys of the nodes that hold a wanted sample's cell or one of the 26 cells around it.
fn keys_around_samples(
    samples: &Samples,
    depth: u32,
    is_wanted: impl Fn(usize) -> bool + Sync,
) -> Vec<u64> {
    const CHUNK: usize = 1 << 14;
    let cell_shift = 3 * (samples.depth - depth);
    let nodes_per_axis = 1_i32 << (depth - 2);
    let emit = |key: u64, touched: u32, keys: &mut Vec<u64>| {
        let node = morton::decode(key).map(|x| x as i32);
        for (index, offset) in offsets().enumerate() {
            if touched & 1 << index == 0 {
                continue;
            }
            let other = [0, 1, 2].map(|axis| node[axis] + offset[axis]);
            if other.iter().all(|&x| x >= 0 && x < nodes_per_axis) {
                keys.push(morton::encode(other.map(|x| x as u32)));
            }
        }
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
                if cell == previous || !is_wanted(chunk * CHUNK + index) {
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

/// Offsets of the 27 neighbours in their order.
pub fn offsets() -> impl Iterator<Item = [i32; 3]> {
    (0..27).map(|index| [index % 3 - 1, index / 3 % 3 - 1, index / 9 - 1])
}

/// Bits of the neighbours that hold a cell next to a cell of the node.
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

fn link_base(level: &mut Level) {
    let nodes_per_axis = 1_i32 << (level.depth - 2);
    let none = level.len() as u32;
    level.parents = vec![0; level.len()];
    level.neighbors = (0..level.len() as u64)
        .map(|key| {
            let node = morton::decode(key).map(|x| x as i32);
            let mut neighbors = [none; 27];
            for (index, offset) in offsets().enumerate() {
                let other = [0, 1, 2].map(|axis| node[axis] + offset[axis]);
                if other.iter().all(|&x| x >= 0 && x < nodes_per_axis) {
                    neighbors[index] = morton::encode(other.map(|x| x as u32)) as u32;
                }
            }
            neighbors
        })
        .collect();
}

/// Joins a level to the one above it. A neighbour is a child of the parent's neighbour.
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
    let none = level.len() as u32;
    let above = &*above;
    level.neighbors = level
        .keys
        .par_iter()
        .zip(&level.parents)
        .map(|(key, &parent)| {
            let octant = morton::decode(key & 7).map(|x| x as i32);
            let mut neighbors = [none; 27];
            for (index, offset) in offsets().enumerate() {
                let place = [0, 1, 2].map(|axis| octant[axis] + offset[axis]);
                let beside = place.map(|x| x.div_euclid(2));
                let other_octant = morton::encode(place.map(|x| x.rem_euclid(2) as u32)) as usize;
                if let Some(node) = above
                    .neighbor(parent as usize, beside)
                    .and_then(|node| above.child(node, other_octant))
                {
                    neighbors[index] = node as u32;
                }
            }
            neighbors
        })
        .collect();
}

fn sample_ranges(samples: &Samples, level: &Level, above: Option<&Level>) -> Vec<[u32; 2]> {
    let shift = 3 * (samples.depth + 2 - level.depth);
    (0..level.len())
        .into_par_iter()
        .map(|node| {
            let [begin, end] = above.map_or([0, samples.len() as u32], |above| {
                above.samples[level.parents[node] as usize]
            });
            let codes = &samples.codes[begin as usize..end as usize];
            let key = level.keys[node];
            let first = codes.partition_point(|code| code >> shift < key) as u32;
            let last = codes.partition_point(|code| code >> shift <= key) as u32;
            [begin + first, begin + last]
        })
        .collect()
}
