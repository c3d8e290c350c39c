//! Extraction of an isosurface of a function on the octree, without cracks between cells of different
//! size.
//!
//! Marching cubes on the leaf cells. A leaf with finer neighbors takes the segments of its faces from
//! them and its vertices from the finest edges, so that both sides have the same polyline: Kazhdan,
//! Klein, Dalal and Hoppe, *Unconstrained Isosurface Extraction on Arbitrary Octrees* (2007). The
//! function is trilinear in every leaf and continuous, so an edge of a leaf is crossed at most once,
//! however finely its neighbors divide it.

use rayon::prelude::*;

use super::case_table::{
    cell_case, corner_signs, edge, face_corners, face_edges, face_segments, join_loops,
};
use super::octree::{CELLS, Level, Octree};
use super::stencil::{CORNER_OFFSETS, CORNERS, CornerValues, corner_index};
use crate::geometry::morton;

/// A mesh in the unit cube.
pub struct UnitMesh {
    /// Vertex positions.
    pub vertices: Vec<[f32; 3]>,
    /// Vertex indices, counter-clockwise seen from where the function is higher.
    pub triangles: Vec<[u32; 3]>,
}

/// A function on an octree by its values at the corners of all nodes.
pub struct NodalFunction<'a> {
    /// The octree.
    pub tree: &'a Octree,
    /// Values per level and node.
    pub values: &'a [Vec<CornerValues>],
}

/// A vertex of the isosurface before merging.
#[derive(Clone, Copy)]
struct Vertex {
    /// Lowest corner of its edge or cell on the finest grid, and its number there.
    key: u64,
    position: [f32; 3],
}

/// The triangles of a few nodes.
#[derive(Default)]
struct MeshPart {
    vertices: Vec<Vertex>,
    triangles: Vec<[u32; 3]>,
}

/// Nodes per mesh part.
const PART_NODES: usize = 256;
/// Cache entry of an edge without a vertex.
const NONE: u32 = u32::MAX;
/// Minimum distance of vertices to the ends of their edges (unitless share), against triangles
/// without area.
const MARGIN: f32 = 0.005;

/// Extracts the surface where the function has the value `iso_value`.
pub fn extract(function: &NodalFunction<'_>, iso_value: f32) -> UnitMesh {
    let mut parts = Vec::new();
    for (level, nodes) in function.tree.levels.iter().enumerate() {
        let starts: Vec<usize> = (0..nodes.len()).step_by(PART_NODES).collect();
        parts.par_extend(starts.into_par_iter().map(|start| {
            let mut extraction = Extraction {
                function,
                iso_value,
                level,
                part: MeshPart::default(),
            };
            for node in start..(start + PART_NODES).min(nodes.len()) {
                extraction.add_node(node);
            }
            extraction.part
        }));
    }
    merge(&parts)
}

/// Merges vertices with equal keys; they are in the order of their keys.
fn merge(parts: &[MeshPart]) -> UnitMesh {
    let all = || parts.iter().flat_map(|part| &part.vertices);
    let mut keys: Vec<(u64, u32)> = (all().zip(0..))
        .map(|(vertex, index)| (vertex.key, index))
        .collect();
    keys.par_sort_unstable();
    let positions: Vec<[f32; 3]> = all().map(|vertex| vertex.position).collect();
    let mut merged = vec![0_u32; keys.len()];
    let mut vertices = Vec::new();
    for same in keys.chunk_by(|a, b| a.0 == b.0) {
        for &(_, index) in same {
            merged[index as usize] = vertices.len() as u32;
        }
        vertices.push(positions[same[0].1 as usize]);
    }
    let mut triangles = Vec::new();
    let mut start = 0;
    for part in parts {
        let of_part = part.triangles.iter();
        triangles.extend(of_part.map(|t| t.map(|vertex| merged[start + vertex as usize])));
        start += part.vertices.len();
    }
    UnitMesh {
        vertices,
        triangles,
    }
}

struct Extraction<'a> {
    function: &'a NodalFunction<'a>,
    iso_value: f32,
    level: usize,
    part: MeshPart,
}

/// The octant of a node that contains one of its cells.
#[inline]
fn octant_of(cell: [usize; 3]) -> usize {
    (cell[0] >> 1) | (cell[1] >> 1) << 1 | (cell[2] >> 1) << 2
}

fn add(a: [usize; 3], b: [usize; 3]) -> [usize; 3] {
    [a[0] + b[0], a[1] + b[1], a[2] + b[2]]
}

impl Extraction<'_> {
    fn nodes(&self, level: usize) -> &Level {
        &self.function.tree.levels[level]
    }

    fn values(&self, level: usize, node: usize) -> &CornerValues {
        &self.function.values[level][node]
    }

    fn child(&self, level: usize, node: usize, cell: [usize; 3]) -> Option<usize> {
        self.nodes(level).child(node, octant_of(cell))
    }

    fn add_node(&mut self, node: usize) {
        let nodes = self.nodes(self.level);
        let values = self.values(self.level, node);
        let first = values[0] > self.iso_value;
        if nodes.child_mask[node] == 255 || values.iter().all(|&v| (v > self.iso_value) == first) {
            return;
        }
        let has_no_finer_neighbor = nodes.neighbors[node]
            .iter()
            .all(|&other| other as usize == nodes.len() || nodes.child_mask[other as usize] == 0);
        let mut edge_vertices = [NONE; 3 * CORNERS];
        for index in 0..CELLS {
            let cell = [index & 3, index >> 2 & 3, index >> 4];
            if self.child(self.level, node, cell).is_some() {
                continue;
            }
            let values = self.values(self.level, node);
            let corners = CORNER_OFFSETS.map(|offset| values[corner_index(cell) + offset]);
            let in_front = corner_signs(corners.map(|value| value > self.iso_value));
            if in_front == 0 || in_front == 255 {
                continue;
            }
            if has_no_finer_neighbor {
                self.add_cell(node, cell, in_front, &mut edge_vertices);
            } else {
                self.add_transition_cell(node, cell);
            }
        }
    }

    /// Adds a cell without finer neighbors.
    fn add_cell(
        &mut self,
        node: usize,
        cell: [usize; 3],
        in_front: u8,
        edge_vertices: &mut [u32; 3 * CORNERS],
    ) {
        let case = cell_case(in_front);
        let mut ids = [NONE; 16];
        for &id in case.triangles.iter().flatten().filter(|&&id| id < 12) {
            let (offset, axis) = edge(id.into());
            let corner = add(cell, offset);
            let entry = &mut edge_vertices[corner_index(corner) + CORNERS * axis];
            if *entry == NONE {
                let ends = self.edge_values(self.level, node, corner, axis);
                let global = self.global_corner(self.level, node, corner);
                *entry = self.add_vertex(self.vertex_on(self.level, global, axis, ends));
            }
            ids[id as usize] = *entry;
        }
        for (number, polygon) in case.centers.iter().enumerate() {
            let polygon: Vec<u32> = polygon.iter().map(|&id| ids[id as usize]).collect();
            ids[12 + number] = self.add_center(node, cell, number, &polygon);
        }
        let triangles = case.triangles.iter();
        (self.part.triangles).extend(triangles.map(|t| t.map(|id| ids[id as usize])));
    }

    /// Adds a cell that may have finer neighbors.
    fn add_transition_cell(&mut self, node: usize, cell: [usize; 3]) {
        let mut segments: Vec<(Vertex, Vertex)> = Vec::new();
        for axis in 0..3 {
            for side in 0..2 {
                let before = segments.len();
                self.add_face_segments(node, cell, (axis, side), &mut segments);
                if side == 1 {
                    for segment in &mut segments[before..] {
                        *segment = (segment.1, segment.0);
                    }
                }
            }
        }
        let loops = join_loops(segments, |a, b| a.key == b.key);
        for (number, polygon) in loops.iter().enumerate().filter(|(_, l)| l.len() > 2) {
            let ids: Vec<u32> = polygon.iter().map(|&v| self.add_vertex(v)).collect();
            if let [a, b, c] = ids[..] {
                self.part.triangles.push([a, b, c]);
                continue;
            }
            let center = self.add_center(node, cell, number, &ids);
            let edges = ids.iter().zip(ids.iter().cycle().skip(1));
            (self.part.triangles).extend(edges.map(|(&a, &b)| [a, b, center]));
        }
    }

    /// Adds the segments on a face of a leaf cell, or those of the finer neighbor if there is one.
    fn add_face_segments(
        &self,
        node: usize,
        cell: [usize; 3],
        (axis, side): (usize, usize),
        segments: &mut Vec<(Vertex, Vertex)>,
    ) {
        let mut neighbour = self.global_corner(self.level, node, cell);
        neighbour[axis] += 2 * side as i32 - 1;
        let local = neighbour.map(|x| (x & 3) as usize);
        match self.function.tree.node_at(self.level, neighbour) {
            Some(other) if self.child(self.level, other, local).is_some() => {
                self.add_leaf_segments(self.level, other, local, (axis, 1 - side), segments);
            }
            _ => self.add_leaf_segments(self.level, node, cell, (axis, side), segments),
        }
    }

    /// Adds the segments on a face of a cell, or of its descendants if it is no leaf.
    fn add_leaf_segments(
        &self,
        level: usize,
        node: usize,
        cell: [usize; 3],
        (axis, side): (usize, usize),
        segments: &mut Vec<(Vertex, Vertex)>,
    ) {
        if let Some(child) = self.child(level, node, cell) {
            let low = cell.map(|x| 2 * (x & 1));
            for corner in face_corners(axis, side) {
                self.add_leaf_segments(level + 1, child, add(low, corner), (axis, side), segments);
            }
            return;
        }
        let values = self.values(level, node);
        let signs = face_corners(axis, side)
            .map(|corner| values[corner_index(add(cell, corner))] > self.iso_value);
        let edges = face_edges(axis, side);
        let vertex = |index: usize| {
            let (offset, axis) = edges[index];
            let corner = add(cell, offset);
            let ends = self.edge_values(level, node, corner, axis);
            self.finest_vertex(level, self.global_corner(level, node, corner), axis, ends)
        };
        segments.extend(face_segments(signs).map(|(from, to)| (vertex(from), vertex(to))));
    }

    /// The values at both ends of an edge.
    fn edge_values(&self, level: usize, node: usize, corner: [usize; 3], axis: usize) -> [f32; 2] {
        let values = self.values(level, node);
        let mut far = corner;
        far[axis] += 1;
        [corner, far].map(|corner| values[corner_index(corner)])
    }

    /// The vertex on an edge, on the finest edge of the cells around it.
    fn finest_vertex(&self, level: usize, corner: [i32; 3], axis: usize, ends: [f32; 2]) -> Vertex {
        let Some(child) = self.finer_node_at_edge(level, corner, axis) else {
            return self.vertex_on(level, corner, axis, ends);
        };
        let mut middle = corner.map(|x| 2 * x);
        middle[axis] += 1;
        let first = self.nodes(level + 1).first_cell(child);
        let local = [0, 1, 2].map(|axis| (middle[axis] - first[axis]) as usize);
        let value = self.values(level + 1, child)[corner_index(local)];
        if (ends[0] > self.iso_value) == (value > self.iso_value) {
            self.finest_vertex(level + 1, middle, axis, [value, ends[1]])
        } else {
            self.finest_vertex(level + 1, corner.map(|x| 2 * x), axis, [ends[0], value])
        }
    }

    /// A node of the next level in one of the four cells around an edge.
    fn finer_node_at_edge(&self, level: usize, corner: [i32; 3], axis: usize) -> Option<usize> {
        (0..4).find_map(|side| {
            let mut cell = corner;
            cell[(axis + 1) % 3] -= side & 1;
            cell[(axis + 2) % 3] -= side >> 1;
            let node = self.function.tree.node_at(level, cell)?;
            self.child(level, node, cell.map(|x| (x & 3) as usize))
        })
    }

    fn vertex_on(&self, level: usize, corner: [i32; 3], axis: usize, ends: [f32; 2]) -> Vertex {
        let along = ((self.iso_value - ends[0]) / (ends[1] - ends[0])).clamp(MARGIN, 1.0 - MARGIN);
        let mut position = corner.map(|x| x as f32);
        position[axis] += along;
        let width = (-(self.nodes(level).depth as f32)).exp2();
        Vertex {
            key: self.key(level, corner) | axis as u64,
            position: position.map(|x| x * width),
        }
    }

    /// The lowest corner of an edge or cell on the finest grid, with eight free bits.
    fn key(&self, level: usize, corner: [i32; 3]) -> u64 {
        let shift = self.function.tree.levels.len() - 1 - level;
        morton::encode(corner.map(|x| (x as u32) << shift)) << 8
    }

    fn global_corner(&self, level: usize, node: usize, corner: [usize; 3]) -> [i32; 3] {
        let first = self.nodes(level).first_cell(node);
        [0, 1, 2].map(|axis| first[axis] + corner[axis] as i32)
    }

    fn add_vertex(&mut self, vertex: Vertex) -> u32 {
        self.part.vertices.push(vertex);
        self.part.vertices.len() as u32 - 1
    }

    /// Adds the mean of the vertices of a polygon.
    fn add_center(&mut self, node: usize, cell: [usize; 3], number: usize, polygon: &[u32]) -> u32 {
        let mut position = [0.0; 3];
        for &index in polygon {
            let vertex = self.part.vertices[index as usize].position;
            for axis in 0..3 {
                position[axis] += vertex[axis] / polygon.len() as f32;
            }
        }
        let corner = self.global_corner(self.level, node, cell);
        let key = self.key(self.level, corner) | (number as u64) << 2 | 3;
        self.add_vertex(Vertex { key, position })
    }
}
