//! The map as the device reads it: one hierarchy per tile under one over all tiles.
//!
//! Triangles lie tile by tile, so that the rasterizer draws a tile as one run of them, and leaf
//! by leaf within a tile, so that a leaf is one run too. Coordinates are relative to the centre
//! of the map, subtracted in `f64`.

use std::ops::Range;

use glam::{DVec3, Vec3};
use rayon::prelude::*;

use super::layout::{self, Node, Triangle};
use crate::geometry::{Aabb, TriangleMesh};
use crate::raycasting::bvh::{Bvh, Leaves, NodeRef, PrimRef};
use crate::raycasting::is_proper;

/// Most triangles in a leaf: a test costs the device about as much as a node.
const LEAF_SIZE: usize = 4;

/// A tile of the map.
#[derive(Clone, Debug)]
pub(super) struct Tile {
    /// Relative to the centre of the map [m].
    pub bounds: Aabb,
    /// Its triangles among all.
    pub triangles: Range<u32>,
}

impl Tile {
    /// Distance of a place to the box of the tile [m].
    pub fn distance_to(&self, place: Vec3) -> f32 {
        (place.clamp(self.bounds.min, self.bounds.max) - place).length()
    }
}

/// All tiles.
#[derive(Debug)]
pub(super) struct Forest {
    /// Of the map; the origin of all coordinates here [m].
    pub center: DVec3,
    pub nodes: Vec<Node>,
    pub triangles: Vec<Triangle>,
    pub tiles: Vec<Tile>,
    /// The child that leads to everything.
    pub root: u32,
    /// Nodes on the longest way from the root to a leaf: so many children can wait at once.
    pub depth: usize,
}

impl Forest {
    /// Grows the hierarchies; triangles that are degenerate or not finite are left out.
    pub fn grow(tiles: &[TriangleMesh]) -> Self {
        let center = center_of(tiles);
        let trees: Vec<Tree> = tiles
            .par_iter()
            .map(|mesh| Tree::grow(mesh, center))
            .collect();
        let mut forest = Self {
            center,
            nodes: Vec::new(),
            triangles: Vec::new(),
            tiles: Vec::new(),
            root: layout::leaf(0, 0),
            depth: 0,
        };
        let mut roots = Vec::new();
        for tree in trees {
            roots.extend(forest.plant(tree));
        }
        forest.join(&roots);
        forest.depth = forest.longest_way();
        forest
    }

    /// Appends a tile; returns the child that leads to it, `None` where it has no triangles.
    fn plant(&mut self, tree: Tree) -> Option<u32> {
        let root = tree.bvh.root?;
        let (first_node, first) = (self.nodes.len(), self.triangles.len());
        let refer = |child: NodeRef| {
            if child.is_leaf() {
                let range = &tree.leaves.ranges[child.index()];
                layout::leaf(first + range.start as usize, range.len())
            } else {
                (first_node + child.index()) as u32
            }
        };
        let nodes = tree.bvh.nodes.iter();
        self.nodes
            .extend(nodes.map(|n| node(n.bounds, n.children.map(refer))));
        let order = tree.leaves.order.iter();
        self.triangles
            .extend(order.map(|&index| Triangle::new(tree.corners[index as usize])));
        self.tiles.push(Tile {
            bounds: Aabb::of(tree.corners.iter().flatten().copied()),
            triangles: first as u32..self.triangles.len() as u32,
        });
        Some(refer(root))
    }

    /// Puts one hierarchy over those of all tiles.
    fn join(&mut self, roots: &[u32]) {
        let tiles = self.tiles.iter().zip(0..);
        let prims = tiles.map(|(tile, index)| PrimRef::new(tile.bounds, index));
        let (over, leaves) = Bvh::build(prims.collect(), 1);
        let Some(root) = over.root else {
            return;
        };
        let first_node = self.nodes.len();
        let refer = |child: NodeRef| {
            if child.is_leaf() {
                let place = leaves.ranges[child.index()].start as usize;
                roots[leaves.order[place] as usize]
            } else {
                (first_node + child.index()) as u32
            }
        };
        self.nodes.extend(
            over.nodes
                .iter()
                .map(|n| node(n.bounds, n.children.map(refer))),
        );
        self.root = refer(root);
    }

    fn longest_way(&self) -> usize {
        let mut longest = 0;
        let mut waiting = vec![(self.root, 0)];
        while let Some((child, depth)) = waiting.pop() {
            longest = longest.max(depth);
            if child & layout::LEAF == 0 {
                let node = &self.nodes[child as usize];
                waiting.extend([(node.left, depth + 1), (node.right, depth + 1)]);
            }
        }
        longest
    }
}

/// The hierarchy of a tile that counts its own triangles from zero.
struct Tree {
    bvh: Bvh,
    leaves: Leaves,
    corners: Vec<[Vec3; 3]>,
}

impl Tree {
    fn grow(mesh: &TriangleMesh, center: DVec3) -> Self {
        let corners: Vec<[Vec3; 3]> = (0..mesh.triangles.len())
            .map(|triangle| mesh.corners(triangle))
            .filter(|&corners| is_proper(corners))
            .map(|corners| corners.map(|corner| (corner.as_dvec3() - center).as_vec3()))
            .collect();
        let triangles = corners.iter().zip(0..);
        let prims = triangles.map(|(corners, index)| PrimRef::new(Aabb::of(*corners), index));
        let (bvh, leaves) = Bvh::build(prims.collect(), LEAF_SIZE);
        Self {
            bvh,
            leaves,
            corners,
        }
    }
}

fn center_of(tiles: &[TriangleMesh]) -> DVec3 {
    let vertices = tiles.iter().flat_map(|tile| &tile.vertices);
    let bounds = Aabb::of(vertices.copied().filter(|vertex| vertex.is_finite()));
    if bounds.is_empty() {
        DVec3::ZERO
    } else {
        0.5 * (bounds.min.as_dvec3() + bounds.max.as_dvec3())
    }
}

fn node(bounds: [[f32; 6]; 2], children: [u32; 2]) -> Node {
    let [left, right] = bounds;
    Node {
        left_min: [left[0], left[1], left[2]],
        left: children[0],
        left_max: [left[3], left[4], left[5]],
        right: children[1],
        right_min: [right[0], right[1], right[2]],
        unused_0: 0,
        right_max: [right[3], right[4], right[5]],
        unused_1: 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn square(at: Vec3) -> TriangleMesh {
        TriangleMesh {
            vertices: [Vec3::ZERO, Vec3::X, Vec3::X + Vec3::Y, Vec3::Y]
                .map(|corner| corner + at)
                .to_vec(),
            triangles: vec![[0, 1, 2], [0, 2, 3]],
            ..TriangleMesh::default()
        }
    }

    #[test]
    fn every_triangle_lies_in_exactly_one_leaf_inside_the_boxes_above_it() {
        let tiles: Vec<TriangleMesh> = (0..50_u8)
            .map(|i| square(Vec3::new(f32::from(i % 7) * 3.0, f32::from(i) * 5.0, 0.0)))
            .collect();
        let forest = Forest::grow(&tiles);
        let mut seen = vec![0; forest.triangles.len()];
        let mut waiting = vec![(forest.root, Vec3::NEG_INFINITY, Vec3::INFINITY)];
        while let Some((child, low, high)) = waiting.pop() {
            if child & layout::LEAF == 0 {
                let node = forest.nodes[child as usize];
                waiting.push((node.left, node.left_min.into(), node.left_max.into()));
                waiting.push((node.right, node.right_min.into(), node.right_max.into()));
                continue;
            }
            let first = (child & 0x0fff_ffff) as usize;
            let run = first..first + (child >> 28 & 7) as usize;
            for (times, triangle) in seen[run.clone()].iter_mut().zip(&forest.triangles[run]) {
                *times += 1;
                for [x, y, z, _] in triangle.corners {
                    let corner = Vec3::new(x, y, z);
                    assert!(corner.cmpge(low).all() && corner.cmple(high).all());
                }
            }
        }
        assert_eq!(seen, vec![1; 100]);
    }

    #[test]
    fn the_triangles_of_a_tile_are_one_run() {
        let tiles = [
            square(Vec3::ZERO),
            TriangleMesh::default(),
            square(9.0 * Vec3::X),
        ];
        let forest = Forest::grow(&tiles);
        let runs: Vec<_> = forest.tiles.iter().map(|t| t.triangles.clone()).collect();
        assert_eq!(runs, [0..2, 2..4]);
        assert_eq!(forest.center, DVec3::new(5.0, 0.5, 0.0));
        assert_eq!(
            forest.tiles[1].distance_to(Vec3::new(3.0, 0.0, 2.0)),
            2.0_f32.hypot(1.0)
        );
    }

    #[test]
    fn what_is_not_finite_or_has_no_area_is_left_out() {
        let mut mesh = square(Vec3::ZERO);
        mesh.vertices.extend([Vec3::NAN, Vec3::new(0.5, 0.5, 0.0)]);
        mesh.triangles.extend([[0, 1, 4], [0, 2, 5], [3, 3, 1]]);
        assert_eq!(Forest::grow(&[mesh]).triangles.len(), 2);
        assert!(Forest::grow(&[]).triangles.is_empty());
    }
}
