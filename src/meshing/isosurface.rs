//! The surface where a function on the octree has a given value, without cracks between cells of
//! different size.
//!
//! Marching cubes on the leaf cells. Where a leaf borders on finer ones, it takes the segments of
//! its face from them and its points from the finest edges, so that both sides draw the same line:
//! Kazhdan, Klein, Dalal and Hoppe, *Unconstrained Isosurface Extraction on Arbitrary Octrees*
//! (2007). The function is trilinear in every leaf and continuous, so an edge of a leaf is
//! crossed once at most, however finely its neighbours divide it.

use rayon::prelude::*;

use super::block::CLOSED;
use super::cell_table::{cell_case, close_loops, edge, face_corners, face_edges, face_segments};
use super::morton;
use super::octree::{Level, Octree};

/// A mesh in the unit cube.
pub struct UnitMesh {
    /// Positions.
    pub vertices: Vec<[f32; 3]>,
    /// Counter-clockwise seen from where the function is higher.
    pub triangles: Vec<[u32; 3]>,
}

/// The function: per level the values at the closed corners of the nodes.
pub struct NodalFunction<'a> {
    /// The cells.
    pub tree: &'a Octree,
    /// 125 values per node and level.
    pub values: &'a [Vec<f32>],
}

/// A point of the surface: what it lies on, and where.
#[derive(Clone, Copy)]
struct Point {
    /// Lowest corner of the edge or cell on the finest grid, and which of its points this is.
    key: u64,
    position: [f32; 3],
}

/// What a few nodes add to the mesh.
#[derive(Default)]
struct Patch {
    points: Vec<Point>,
    triangles: Vec<[u32; 3]>,
}

/// Nodes per patch.
const PATCH: usize = 256;
/// Place of no point in the cache of a node.
const NOWHERE: u32 = u32::MAX;
/// Points stay off the corners by this share of an edge: no triangle is without area.
const MARGIN: f32 = 0.005;

/// The surface where the function has the value `iso`.
pub fn extract(function: &NodalFunction<'_>, iso: f32) -> UnitMesh {
    let mut patches = Vec::new();
    for (level, nodes) in function.tree.levels.iter().enumerate() {
        let starts: Vec<usize> = (0..nodes.len()).step_by(PATCH).collect();
        patches.par_extend(starts.into_par_iter().map(|start| {
            let mut walk = Extraction {
                function,
                iso,
                level,
                patch: Patch::default(),
            };
            for node in start..(start + PATCH).min(nodes.len()) {
                walk.add_node(node);
            }
            walk.patch
        }));
    }
    weld(&patches)
}

/// One vertex for all points with one key, in the order of the keys.
fn weld(patches: &[Patch]) -> UnitMesh {
    let mut starts = Vec::with_capacity(patches.len());
    let mut keys: Vec<(u64, u32)> = Vec::new();
    for patch in patches {
        starts.push(keys.len() as u32);
        let start = keys.len() as u32;
        keys.extend(
            patch
                .points
                .iter()
                .zip(start..)
                .map(|(point, index)| (point.key, index)),
        );
    }
    keys.par_sort_unstable();
    let mut vertex_of = vec![0_u32; keys.len()];
    let mut vertices = Vec::new();
    let positions: Vec<[f32; 3]> = patches
        .iter()
        .flat_map(|patch| patch.points.iter().map(|point| point.position))
        .collect();
    let mut previous = None;
    for (key, index) in keys {
        if previous != Some(key) {
            vertices.push(positions[index as usize]);
            previous = Some(key);
        }
        vertex_of[index as usize] = vertices.len() as u32 - 1;
    }
    let triangles = patches
        .iter()
        .zip(starts)
        .flat_map(|(patch, start)| {
            let vertex_of = &vertex_of;
            patch
                .triangles
                .iter()
                .map(move |triangle| triangle.map(|point| vertex_of[(start + point) as usize]))
        })
        .collect();
    UnitMesh {
        vertices,
        triangles,
    }
}

struct Extraction<'a> {
    function: &'a NodalFunction<'a>,
    iso: f32,
    level: usize,
    patch: Patch,
}

/// Place of a closed corner.
#[inline]
fn closed_index(corner: [usize; 3]) -> usize {
    corner[0] + 5 * corner[1] + 25 * corner[2]
}

/// The octant of a node in which one of its cells lies.
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

    fn values(&self, level: usize, node: usize) -> &[f32] {
        &self.function.values[level][node * CLOSED..][..CLOSED]
    }

    fn add_node(&mut self, node: usize) {
        let nodes = self.nodes(self.level);
        let values = self.values(self.level, node);
        let first = values[0] > self.iso;
        if nodes.child_mask[node] == 255 || values.iter().all(|&v| (v > self.iso) == first) {
            return;
        }
        let is_plain = nodes.neighbors[node]
            .iter()
            .all(|&other| other as usize == nodes.len() || nodes.child_mask[other as usize] == 0);
        let mut cache = [NOWHERE; 3 * CLOSED];
        for index in 0..64 {
            let cell = [index & 3, index >> 2 & 3, index >> 4];
            if self
                .nodes(self.level)
                .child(node, octant_of(cell))
                .is_some()
            {
                continue;
            }
            let in_front = (0..8).fold(0_u8, |bits, corner| {
                let at = add(cell, [corner & 1, corner >> 1 & 1, corner >> 2]);
                let value = self.values(self.level, node)[closed_index(at)];
                bits | u8::from(value > self.iso) << corner
            });
            if in_front == 0 || in_front == 255 {
                continue;
            }
            if is_plain {
                self.add_plain_cell(node, cell, in_front, &mut cache);
            } else {
                self.add_bordering_cell(node, cell);
            }
        }
    }

    /// A cell whose neighbours are not finer.
    fn add_plain_cell(
        &mut self,
        node: usize,
        cell: [usize; 3],
        in_front: u8,
        cache: &mut [u32; 3 * CLOSED],
    ) {
        let case = cell_case(in_front);
        let mut ids = [NOWHERE; 16];
        for &id in case.triangles.iter().flatten().filter(|&&id| id < 12) {
            let (offset, axis) = edge(id.into());
            let corner = add(cell, offset);
            let place = closed_index(corner) + CLOSED * axis;
            if cache[place] == NOWHERE {
                let values = self.values(self.level, node);
                let mut far = corner;
                far[axis] += 1;
                let ends = [values[closed_index(corner)], values[closed_index(far)]];
                let global = self.global_corner(self.level, node, corner);
                cache[place] = self.add_point(self.point_on(self.level, global, axis, ends));
            }
            ids[id as usize] = cache[place];
        }
        for (number, points) in case.middles.iter().enumerate() {
            let points: Vec<u32> = points.iter().map(|&id| ids[id as usize]).collect();
            ids[12 + number] = self.add_middle(node, cell, number, &points);
        }
        self.patch.triangles.extend(
            case.triangles
                .iter()
                .map(|triangle| triangle.map(|id| ids[id as usize])),
        );
    }

    /// A cell that may have finer neighbours.
    fn add_bordering_cell(&mut self, node: usize, cell: [usize; 3]) {
        let mut segments: Vec<(Point, Point)> = Vec::new();
        for axis in 0..3 {
            for side in 0..2 {
                let before = segments.len();
                self.face_lines(node, cell, axis, side, &mut segments);
                if side == 1 {
                    for segment in &mut segments[before..] {
                        *segment = (segment.1, segment.0);
                    }
                }
            }
        }
        let loops = close_loops(segments, |a, b| a.key == b.key);
        for (number, points) in loops
            .iter()
            .enumerate()
            .filter(|(_, points)| points.len() > 2)
        {
            let ids: Vec<u32> = points.iter().map(|&point| self.add_point(point)).collect();
            if let [a, b, c] = ids[..] {
                self.patch.triangles.push([a, b, c]);
                continue;
            }
            let middle = self.add_middle(node, cell, number, &ids);
            for i in 0..ids.len() {
                self.patch
                    .triangles
                    .push([ids[i], ids[(i + 1) % ids.len()], middle]);
            }
        }
    }

    /// The segments on a face of a leaf cell: the finer neighbour's, if there is one.
    fn face_lines(
        &self,
        node: usize,
        cell: [usize; 3],
        axis: usize,
        side: usize,
        segments: &mut Vec<(Point, Point)>,
    ) {
        let mut beside = self.global_corner(self.level, node, cell);
        beside[axis] += 2 * side as i32 - 1;
        match self.function.tree.node_at(self.level, beside) {
            Some(other) => {
                let local = beside.map(|x| (x & 3) as usize);
                let is_finer = self
                    .nodes(self.level)
                    .child(other, octant_of(local))
                    .is_some();
                if is_finer {
                    self.lines_of(self.level, other, local, (axis, 1 - side), segments);
                } else {
                    self.lines_of(self.level, node, cell, (axis, side), segments);
                }
            }
            None => self.lines_of(self.level, node, cell, (axis, side), segments),
        }
    }

    /// The segments on a face of a cell or, where it has them, of its children.
    fn lines_of(
        &self,
        level: usize,
        node: usize,
        cell: [usize; 3],
        (axis, side): (usize, usize),
        segments: &mut Vec<(Point, Point)>,
    ) {
        if let Some(child) = self.nodes(level).child(node, octant_of(cell)) {
            let low = cell.map(|x| 2 * (x & 1));
            for corner in face_corners(axis, side) {
                self.lines_of(level + 1, child, add(low, corner), (axis, side), segments);
            }
            return;
        }
        let values = self.values(level, node);
        let signs = face_corners(axis, side)
            .map(|corner| values[closed_index(add(cell, corner))] > self.iso);
        let edges = face_edges(axis, side);
        for (from, to) in face_segments(signs) {
            let [from, to] = [from, to].map(|place| {
                let (offset, axis) = edges[place];
                let corner = add(cell, offset);
                let mut far = corner;
                far[axis] += 1;
                let ends = [values[closed_index(corner)], values[closed_index(far)]];
                self.finest_point(level, self.global_corner(level, node, corner), axis, ends)
            });
            segments.push((from, to));
        }
    }

    /// The crossing of an edge, on the finest edge that the cells around it have there.
    fn finest_point(&self, level: usize, corner: [i32; 3], axis: usize, ends: [f32; 2]) -> Point {
        let Some(child) = self.finer_node_at_edge(level, corner, axis) else {
            return self.point_on(level, corner, axis, ends);
        };
        let mut middle = corner.map(|x| 2 * x);
        middle[axis] += 1;
        let first = self.nodes(level + 1).first_cell(child);
        let local = [0, 1, 2].map(|axis| (middle[axis] - first[axis]) as usize);
        let value = self.values(level + 1, child)[closed_index(local)];
        if (ends[0] > self.iso) == (value > self.iso) {
            self.finest_point(level + 1, middle, axis, [value, ends[1]])
        } else {
            self.finest_point(level + 1, corner.map(|x| 2 * x), axis, [ends[0], value])
        }
    }

    /// A node of the next level at one of the four cells around an edge.
    fn finer_node_at_edge(&self, level: usize, corner: [i32; 3], axis: usize) -> Option<usize> {
        (0..4).find_map(|side| {
            let mut cell = corner;
            cell[(axis + 1) % 3] -= side & 1;
            cell[(axis + 2) % 3] -= side >> 1;
            let node = self.function.tree.node_at(level, cell)?;
            let local = cell.map(|x| (x & 3) as usize);
            self.nodes(level).child(node, octant_of(local))
        })
    }

    fn point_on(&self, level: usize, corner: [i32; 3], axis: usize, ends: [f32; 2]) -> Point {
        let depth = self.nodes(level).depth;
        let along = ((self.iso - ends[0]) / (ends[1] - ends[0])).clamp(MARGIN, 1.0 - MARGIN);
        let mut place = corner.map(|x| x as f32);
        place[axis] += along;
        let width = (-(depth as f32)).exp2();
        Point {
            key: self.key(level, corner) | axis as u64,
            position: place.map(|x| x * width),
        }
    }

    /// The lowest corner of an edge or cell on the finest grid, with room for eight bits.
    fn key(&self, level: usize, corner: [i32; 3]) -> u64 {
        let shift = self.function.tree.levels.len() - 1 - level;
        morton::encode(corner.map(|x| (x as u32) << shift)) << 8
    }

    fn global_corner(&self, level: usize, node: usize, corner: [usize; 3]) -> [i32; 3] {
        let first = self.nodes(level).first_cell(node);
        [0, 1, 2].map(|axis| first[axis] + corner[axis] as i32)
    }

    fn add_point(&mut self, point: Point) -> u32 {
        self.patch.points.push(point);
        self.patch.points.len() as u32 - 1
    }

    /// The mean of a loop's points.
    fn add_middle(&mut self, node: usize, cell: [usize; 3], number: usize, loop_: &[u32]) -> u32 {
        let mut position = [0.0; 3];
        for &index in loop_ {
            let point = self.patch.points[index as usize].position;
            for axis in 0..3 {
                position[axis] += point[axis] / loop_.len() as f32;
            }
        }
        let corner = self.global_corner(self.level, node, cell);
        let key = self.key(self.level, corner) | (number as u64) << 2 | 3;
        self.add_point(Point { key, position })
    }
}
