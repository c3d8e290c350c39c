//! Two-level bounding volume hierarchy for the device: one per tile under one over all tiles.
//!
//! Triangles are stored tile by tile, so that the rasterizer draws a tile as one range of them, and
//! leaf by leaf within a tile, so that a leaf is one range too. Coordinates are relative to the centre
//! of the map, subtracted in `f64`.

use std::ops::Range;
use std::sync::Arc;

use glam::{DVec3, Vec3};

use super::layout::{self, Node, Triangle};
use crate::geometry::Aabb;
use crate::geometry::mesh::STEP_M;
use crate::raycasting::bvh::{Bvh, Leaves, NodeRef, PrimRef};
use crate::raycasting::is_proper;

/// Maximum number of triangles in a leaf: an intersection costs the device about as much as a node.
const LEAF_SIZE: usize = 4;

/// A tile of the map.
#[derive(Clone, Debug)]
pub(super) struct DeviceTile {
    /// Relative to the centre of the map [m].
    pub bounds: Aabb,
    /// Range of its triangles among all.
    pub triangles: Range<u32>,
}

impl DeviceTile {
    /// Distance of a point to the box of the tile [m].
    pub fn distance_to(&self, point: Vec3) -> f32 {
        (point.clamp(self.bounds.min, self.bounds.max) - point).length()
    }
}

/// Hierarchy over all tiles.
#[derive(Debug)]
pub(super) struct TwoLevelBvh {
    /// Centre of the map, the origin of all coordinates here [m].
    pub center: DVec3,
    pub nodes: Vec<Node>,
    pub triangles: Vec<Triangle>,
    pub tiles: Vec<DeviceTile>,
    /// Reference to the root.
    pub root: u32,
    /// Longest path from the root to a leaf [nodes], which bounds the traversal stack.
    pub depth: usize,
}

impl TwoLevelBvh {
    /// Builds the hierarchy over those of tiles; triangles that are degenerate or not finite are left out of them.
    pub fn over(center: DVec3, bottom_levels: &[Arc<BottomLevel>]) -> Self {
        let mut hierarchy = Self {
            center,
            nodes: Vec::new(),
            triangles: Vec::new(),
            tiles: Vec::new(),
            root: layout::leaf(0, 0),
            depth: 0,
        };
        let mut roots = Vec::new();
        for bottom in bottom_levels {
            roots.extend(hierarchy.append(bottom));
        }
        hierarchy.build_top_level(&roots);
        hierarchy.depth = hierarchy.depth_from_root();
        hierarchy
    }

    /// Appends a tile; returns the reference to its root, `None` if it has no triangles.
    fn append(&mut self, bottom: &BottomLevel) -> Option<u32> {
        let root = bottom.bvh.root?;
        let (first_node, first) = (self.nodes.len(), self.triangles.len());
        let refer = |node: NodeRef| {
            if node.is_leaf() {
                let range = &bottom.leaves.ranges[node.index()];
                layout::leaf(first + range.start as usize, range.len())
            } else {
                (first_node + node.index()) as u32
            }
        };
        let nodes = bottom.bvh.nodes.iter();
        self.nodes
            .extend(nodes.map(|n| node(n.bounds, n.children.map(refer))));
        let order = bottom.leaves.order.iter();
        self.triangles
            .extend(order.map(|&index| Triangle::new(bottom.corners[index as usize])));
        self.tiles.push(DeviceTile {
            bounds: Aabb::from_points(bottom.corners.iter().flatten().copied()),
            triangles: first as u32..self.triangles.len() as u32,
        });
        Some(refer(root))
    }

    /// Builds the hierarchy over the roots of all tiles.
    fn build_top_level(&mut self, roots: &[u32]) {
        let tiles = self.tiles.iter().zip(0..);
        let prims = tiles.map(|(tile, index)| PrimRef::new(tile.bounds, index));
        let (top, leaves) = Bvh::build(prims.collect(), 1);
        let Some(root) = top.root else {
            return;
        };
        let first_node = self.nodes.len();
        let refer = |node: NodeRef| {
            if node.is_leaf() {
                let place = leaves.ranges[node.index()].start as usize;
                roots[leaves.order[place] as usize]
            } else {
                (first_node + node.index()) as u32
            }
        };
        self.nodes.extend(
            top.nodes
                .iter()
                .map(|n| node(n.bounds, n.children.map(refer))),
        );
        self.root = refer(root);
    }

    fn depth_from_root(&self) -> usize {
        let mut longest = 0;
        let mut pending = vec![(self.root, 0)];
        while let Some((child, depth)) = pending.pop() {
            longest = longest.max(depth);
            if child & layout::LEAF == 0 {
                let node = &self.nodes[child as usize];
                pending.extend([(node.left, depth + 1), (node.right, depth + 1)]);
            }
        }
        longest
    }
}

/// Hierarchy of a tile that numbers its own triangles from zero.
pub(super) struct BottomLevel {
    bvh: Bvh,
    leaves: Leaves,
    corners: Vec<[Vec3; 3]>,
}

impl BottomLevel {
    /// Builds the hierarchy of triangles by their corners, around the centre of the map, both in its frame [m].
    pub fn build(triangles: impl Iterator<Item = [DVec3; 3]>, center: DVec3) -> Self {
        let corners: Vec<[Vec3; 3]> = triangles
            .map(|corners| corners.map(|corner| (corner - center).as_vec3()))
            .filter(|corners| is_proper(*corners))
            .collect();
        let triangles = corners.iter().zip(0..);
        let prims =
            triangles.map(|(corners, index)| PrimRef::new(Aabb::from_points(*corners), index));
        let (bvh, leaves) = Bvh::build(prims.collect(), LEAF_SIZE);
        Self {
            bvh,
            leaves,
            corners,
        }
    }
}

/// Middle of boxes on the lattice of maps, so that coordinates relative to it are exact; the origin without boxes.
pub(super) fn center_of(boxes: impl Iterator<Item = Aabb>) -> DVec3 {
    let bounds = boxes.fold(Aabb::EMPTY, Aabb::union);
    if bounds.is_empty() {
        return DVec3::ZERO;
    }
    let step_m = f64::from(STEP_M);
    let middle = 0.5 * (bounds.min.as_dvec3() + bounds.max.as_dvec3());
    (middle / step_m).round() * step_m
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
pub(crate) mod tests {
    use super::*;
    use crate::geometry::TriangleMesh;

    /// The hierarchy over all triangles of meshes.
    pub fn build(tiles: &[TriangleMesh]) -> TwoLevelBvh {
        let center = center_of(tiles.iter().map(TriangleMesh::bounds));
        let level = |mesh: &TriangleMesh| {
            let triangles = 0..mesh.triangles.len();
            let corners = |triangle| mesh.corners(triangle).map(|corner| corner.as_dvec3());
            Arc::new(BottomLevel::build(triangles.map(corners), center))
        };
        TwoLevelBvh::over(center, &tiles.iter().map(level).collect::<Vec<_>>())
    }

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
        let hierarchy = build(&tiles);
        let mut seen = vec![0; hierarchy.triangles.len()];
        let mut pending = vec![(hierarchy.root, Vec3::NEG_INFINITY, Vec3::INFINITY)];
        while let Some((child, low, high)) = pending.pop() {
            if child & layout::LEAF == 0 {
                let node = hierarchy.nodes[child as usize];
                pending.push((node.left, node.left_min.into(), node.left_max.into()));
                pending.push((node.right, node.right_min.into(), node.right_max.into()));
                continue;
            }
            let first = (child & 0x0fff_ffff) as usize;
            let range = first..first + (child >> 28 & 7) as usize;
            for (times, triangle) in seen[range.clone()]
                .iter_mut()
                .zip(&hierarchy.triangles[range])
            {
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
    fn the_triangles_of_a_tile_are_one_range() {
        let tiles = [
            square(Vec3::ZERO),
            TriangleMesh::default(),
            square(9.0 * Vec3::X),
        ];
        let hierarchy = build(&tiles);
        let ranges: Vec<_> = hierarchy
            .tiles
            .iter()
            .map(|t| t.triangles.clone())
            .collect();
        assert_eq!(ranges, [0..2, 2..4]);
        assert_eq!(hierarchy.center, DVec3::new(5.0, 0.5, 0.0));
        assert_eq!(
            hierarchy.tiles[1].distance_to(Vec3::new(3.0, 0.0, 2.0)),
            2.0_f32.hypot(1.0)
        );
    }

    #[test]
    fn degenerate_triangles_are_left_out() {
        let mut mesh = square(Vec3::ZERO);
        mesh.vertices.extend([Vec3::NAN, Vec3::new(0.5, 0.5, 0.0)]);
        mesh.triangles.extend([[0, 1, 4], [0, 2, 5], [3, 3, 1]]);
        assert_eq!(build(&[mesh]).triangles.len(), 2);
        assert!(build(&[]).triangles.is_empty());
    }
}
