//! Where local maps meet: each is cut at the border of what it owns.
//!
//! Ownership is decided per cell of a grid, so a border runs along vertical planes x = const and
//! y = const. Triangles that reach over it are cut along these very planes, in the one local map
//! and in the other: seen from above there is neither a gap between the two nor a place that both
//! cover. What is left of the seam is the difference of their heights.
//!
//! Each polygon is cut as in Sutherland and Hodgman, *Reentrant Polygon Clipping* (1974), first into
//! columns of the grid, then into rows. An edge is cut in the same order in both of its triangles, so
//! that both get the same new vertices, to the bit.

use std::collections::HashMap;

use glam::Vec3;

use super::plan::Ownership;
use crate::geometry::TriangleMesh;

/// A corner is not cut off with more than this share of a polygon: what it leaves would be a line
/// of vertices along a straight edge (unitless).
const MOST_OF_IT: f32 = 0.9999;

/// Cuts a mesh down to what a local map owns; returns the number of triangles of which nothing is
/// left. Normals of new vertices are interpolated; colours are dropped.
pub(super) fn keep_own(mesh: &mut TriangleMesh, ownership: &Ownership, number: usize) -> usize {
    let lines = Lines::of(ownership);
    let mut cutter = Cutter::new(mesh, lines);
    let triangles = std::mem::take(&mut mesh.triangles);
    let places: Vec<Place> = triangles
        .iter()
        .map(|&triangle| cutter.place(triangle, ownership, number))
        .collect();
    for (&triangle, _) in triangles
        .iter()
        .zip(&places)
        .filter(|(_, place)| **place == Place::Across)
    {
        cutter.remember_edges(triangle);
    }
    let mut kept = Vec::with_capacity(triangles.len());
    let mut foreign = 0;
    for (&triangle, place) in triangles.iter().zip(&places) {
        let before = kept.len();
        match place {
            Place::Own => cutter.keep(triangle, &mut kept),
            Place::Across => cutter.cut(triangle, ownership, number, &mut kept),
            Place::Foreign => {}
        }
        foreign += usize::from(kept.len() == before);
    }
    mesh.vertices = cutter.vertices;
    mesh.normals = cutter.normals;
    mesh.colors.clear();
    mesh.triangles = kept;
    mesh.drop_unreferenced_vertices();
    foreign
}

/// Where a triangle lies.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Place {
    Own,
    Across,
    Foreign,
}

/// The lines between the columns and between the rows of a grid, rounded once and for all [m].
struct Lines([Vec<f32>; 2]);

impl Lines {
    fn of(ownership: &Ownership) -> Self {
        let grid = ownership.grid();
        let lines = |origin: f64, count: usize| {
            (0..=count)
                .map(|line| (origin + line as f64 * grid.cell_m) as f32)
                .collect()
        };
        Self([
            lines(grid.origin.x, grid.columns),
            lines(grid.origin.y, grid.rows),
        ])
    }

    /// The lines strictly between two places along an axis, as a range.
    fn between(&self, axis: usize, from: f32, to: f32) -> std::ops::Range<usize> {
        let lines = &self.0[axis];
        let first = lines.partition_point(|&line| line <= from.min(to));
        first
            ..lines
                .partition_point(|&line| line < from.max(to))
                .max(first)
    }

    /// The columns or rows that an interval has a part in, -1 before the first.
    fn cells(&self, axis: usize, from: f32, to: f32) -> std::ops::RangeInclusive<isize> {
        let inner = self.between(axis, from, to);
        inner.start as isize - 1..=inner.end as isize - 1
    }
}

/// Cuts triangles and keeps the vertices that arise.
struct Cutter {
    lines: Lines,
    vertices: Vec<Vec3>,
    normals: Vec<Vec3>,
    /// New vertices by the bits of their places.
    new: HashMap<[u32; 3], u32>,
    /// Edges of triangles that are cut, smaller vertex first, and the new vertices along them.
    edges: HashMap<(u32, u32), Vec<u32>>,
}

impl Cutter {
    fn new(mesh: &mut TriangleMesh, lines: Lines) -> Self {
        Self {
            lines,
            vertices: std::mem::take(&mut mesh.vertices),
            normals: std::mem::take(&mut mesh.normals),
            new: HashMap::new(),
            edges: HashMap::new(),
        }
    }

    fn place(&self, triangle: [u32; 3], ownership: &Ownership, number: usize) -> Place {
        let corners = triangle.map(|vertex| self.vertices[vertex as usize]);
        let min = corners[0].min(corners[1]).min(corners[2]);
        let max = corners[0].max(corners[1]).max(corners[2]);
        let (mut own, mut foreign) = (false, false);
        for column in self.lines.cells(0, min.x, max.x) {
            for row in self.lines.cells(1, min.y, max.y) {
                let is_own = ownership.owner_of(column, row) == Some(number);
                own |= is_own;
                foreign |= !is_own;
            }
        }
        match (own, foreign) {
            (true, false) => Place::Own,
            (true, true) => Place::Across,
            (false, _) => Place::Foreign,
        }
    }

    /// Notes the edges of a triangle that is to be cut, with the vertices that arise along them.
    fn remember_edges(&mut self, [a, b, c]: [u32; 3]) {
        for (from, to) in [(a, b), (b, c), (c, a)].map(|(a, b)| (a.min(b), a.max(b))) {
            if self.edges.contains_key(&(from, to)) {
                continue;
            }
            let mut line = vec![from, to];
            for axis in 0..2 {
                line = line.windows(2).fold(vec![from], |mut cut, side| {
                    self.divide(side[0], side[1], axis, &mut cut);
                    cut.push(side[1]);
                    cut
                });
            }
            line.dedup();
            let between = line[1..line.len() - 1].to_vec();
            self.edges.insert((from, to), between);
        }
    }

    /// Appends the vertices where a side crosses the lines of an axis, in the order of the side.
    fn divide(&mut self, from: u32, to: u32, axis: usize, cut: &mut Vec<u32>) {
        let at = |vertex: u32| self.vertices[vertex as usize][axis];
        let (low, high) = if at(from) <= at(to) {
            (from, to)
        } else {
            (to, from)
        };
        let start = cut.len();
        let mut last = low;
        for line in self.lines.between(axis, at(low), at(high)) {
            let place = self.lines.0[axis][line];
            last = self.crossing(last, high, axis, place);
            cut.push(last);
        }
        if low != from {
            cut[start..].reverse();
        }
    }

    /// The vertex where a side that rises along an axis reaches a place.
    fn crossing(&mut self, low: u32, high: u32, axis: usize, place: f32) -> u32 {
        let (a, b) = (self.vertices[low as usize], self.vertices[high as usize]);
        let share = (place - a[axis]) / (b[axis] - a[axis]);
        let mut point = a + share * (b - a);
        point[axis] = place;
        let normals = &mut self.normals;
        let vertices = &mut self.vertices;
        *self
            .new
            .entry(point.to_array().map(f32::to_bits))
            .or_insert_with(|| {
                if !normals.is_empty() {
                    let normal = normals[low as usize].lerp(normals[high as usize], share);
                    normals.push(normal.normalize_or(Vec3::Z));
                }
                vertices.push(point);
                vertices.len() as u32 - 1
            })
    }

    /// Keeps a whole triangle, with the vertices that its neighbours put on its edges.
    fn keep(&self, triangle: [u32; 3], kept: &mut Vec<[u32; 3]>) {
        let mut outline = Vec::with_capacity(8);
        for k in 0..3 {
            let (from, to) = (triangle[k], triangle[(k + 1) % 3]);
            outline.push(from);
            if let Some(between) = self.edges.get(&(from.min(to), from.max(to))) {
                let start = outline.len();
                outline.extend(between);
                if from > to {
                    outline[start..].reverse();
                }
            }
        }
        if outline.len() == triangle.len() {
            kept.push(triangle);
        } else {
            self.triangulate(outline, kept);
        }
    }

    /// Keeps the parts of a triangle that lie in own cells.
    fn cut(
        &mut self,
        triangle: [u32; 3],
        ownership: &Ownership,
        number: usize,
        kept: &mut Vec<[u32; 3]>,
    ) {
        for (column, strip) in self.slices(&triangle, 0) {
            for (row, piece) in self.slices(&strip, 1) {
                if ownership.owner_of(column, row) == Some(number) {
                    self.triangulate(piece, kept);
                }
            }
        }
    }

    /// A convex polygon cut by all lines of an axis: the parts with their columns or rows.
    fn slices(&mut self, polygon: &[u32], axis: usize) -> Vec<(isize, Vec<u32>)> {
        let mut outline = Vec::with_capacity(2 * polygon.len());
        for (k, &from) in polygon.iter().enumerate() {
            outline.push(from);
            self.divide(from, polygon[(k + 1) % polygon.len()], axis, &mut outline);
        }
        let at = |vertex: u32| self.vertices[vertex as usize][axis];
        let low = outline.iter().map(|&v| at(v)).fold(f32::INFINITY, f32::min);
        let high = outline
            .iter()
            .map(|&v| at(v))
            .fold(f32::NEG_INFINITY, f32::max);
        let lines = &self.lines.0[axis];
        self.lines
            .cells(axis, low, high)
            .map(|cell| {
                let line = |index: isize| usize::try_from(index).ok().and_then(|i| lines.get(i));
                let from = line(cell).copied().unwrap_or(f32::NEG_INFINITY);
                let until = line(cell + 1).copied().unwrap_or(f32::INFINITY);
                let is_inside = |&vertex: &u32| (from..=until).contains(&at(vertex));
                let mut slice: Vec<u32> = outline.iter().copied().filter(is_inside).collect();
                slice.dedup();
                (cell, slice)
            })
            .collect()
    }

    /// Cuts off corner after corner, the best-shaped first, until a triangle is left.
    fn triangulate(&self, mut outline: Vec<u32>, kept: &mut Vec<[u32; 3]>) {
        while outline.len() >= 3 {
            let count = outline.len();
            let ear = |tip: usize| {
                [
                    outline[(tip + count - 1) % count],
                    outline[tip],
                    outline[(tip + 1) % count],
                ]
            };
            let whole = self.area(&outline);
            let best = (0..count)
                .filter(|&tip| count == 3 || self.area(&ear(tip)) < MOST_OF_IT * whole)
                .map(|tip| (self.shape(ear(tip)), tip))
                .max_by(|a, b| a.0.total_cmp(&b.0));
            match best {
                Some((shape, tip)) if shape > 0.0 => {
                    kept.push(ear(tip));
                    outline.remove(tip);
                }
                // What is left is a line.
                _ => return,
            }
        }
    }

    fn area(&self, outline: &[u32]) -> f32 {
        let at = |k: usize| self.vertices[outline[k] as usize];
        let doubled: Vec3 = (2..outline.len())
            .map(|k| (at(k - 1) - at(0)).cross(at(k) - at(0)))
            .sum();
        0.5 * doubled.length()
    }

    /// The area of a triangle over its longest edge squared; 0 for a line.
    fn shape(&self, triangle: [u32; 3]) -> f32 {
        let [a, b, c] = triangle.map(|vertex| self.vertices[vertex as usize]);
        let longest = [b - a, c - b, a - c]
            .map(Vec3::length_squared)
            .into_iter()
            .fold(f32::MIN_POSITIVE, f32::max);
        self.area(&triangle) / longest
    }
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use rand::{RngExt as _, SeedableRng as _, rngs::StdRng};

    use super::super::plan::{counted_frames, local_maps};
    use super::*;
    use crate::geometry::Pose3;
    use crate::kitti::Frame;
    use crate::raycasting::Scene;

    const LOCAL_MAPS: usize = 4;

    /// Scans along an arc of 12 m, three to a local map.
    fn ownership() -> Ownership {
        let frames: Vec<Frame> = (0..3 * LOCAL_MAPS)
            .map(|number| {
                let turn = number as f64 * 0.25;
                Frame {
                    number,
                    scan_path: String::new().into(),
                    time_s: 0.0,
                    map_from_lidar: Pose3::translation(4.0 * turn.sin(), 4.0 * turn.cos(), 0.0),
                    revolution: None,
                }
            })
            .collect();
        let frames = counted_frames(&frames, 0.2);
        Ownership::new(&frames, &local_maps(&frames, 3, 1.0), 20.0)
    }

    /// Bumpy ground of 16 m x 16 m with corners where chance puts them.
    fn bumpy(seed: u64) -> TriangleMesh {
        const CELLS: u32 = 53;
        let mut rng = StdRng::seed_from_u64(seed);
        let step = 16.0 / CELLS as f32;
        let mut mesh = TriangleMesh::default();
        for i in 0..(CELLS + 1) * (CELLS + 1) {
            let (column, row) = (i % (CELLS + 1), i / (CELLS + 1));
            let mut jitter = |spread: f32| spread * (rng.random::<f32>() - 0.5);
            mesh.vertices.push(Vec3::new(
                step * column as f32 - 8.0 + jitter(0.5 * step),
                step * row as f32 - 8.0 + jitter(0.5 * step),
                jitter(0.05),
            ));
            mesh.normals.push(Vec3::Z);
        }
        for i in (0..CELLS * (CELLS + 1)).filter(|i| i % (CELLS + 1) < CELLS) {
            let up = i + CELLS + 1;
            mesh.triangles.push([i, i + 1, up + 1]);
            mesh.triangles.push([i, up + 1, up]);
        }
        mesh
    }

    fn pieces(whole: &TriangleMesh, ownership: &Ownership) -> Vec<TriangleMesh> {
        (0..LOCAL_MAPS)
            .map(|number| {
                let mut piece = whole.clone();
                keep_own(&mut piece, ownership, number);
                piece
            })
            .collect()
    }

    fn area(mesh: &TriangleMesh) -> f32 {
        (0..mesh.triangles.len())
            .map(|triangle| 0.5 * mesh.scaled_normal(triangle).length())
            .sum()
    }

    #[test]
    fn neighbours_of_other_meshes_of_one_ground_leave_no_gap_and_cover_nothing_twice() {
        let ownership = ownership();
        let mut joined = TriangleMesh::default();
        for (number, seed) in (0..LOCAL_MAPS).zip(1..) {
            let mut mesh = bumpy(seed);
            keep_own(&mut mesh, &ownership, number);
            joined.append(&mesh);
        }
        let scene = Scene::new(&joined);
        let mut rng = StdRng::seed_from_u64(0);
        for _ in 0..50_000 {
            let mut place = || 15.0 * (rng.random::<f32>() - 0.5);
            let above = Vec3::new(place(), place(), 1.0);
            let mut heights_m = Vec::new();
            scene.for_each_hit(above, Vec3::NEG_Z, 2.0, |hit| heights_m.push(hit.range_m));
            // An edge belongs to both of its triangles.
            heights_m.sort_unstable_by(f32::total_cmp);
            heights_m.dedup_by(|a, b| (*a - *b).abs() < 1e-5);
            assert_eq!(heights_m.len(), 1, "under {above}: {heights_m:?}");
        }
    }

    #[test]
    fn the_pieces_of_a_mesh_have_its_area_and_lie_on_it() {
        let whole = bumpy(1);
        let pieces = pieces(&whole, &ownership());
        let sum: f32 = pieces.iter().map(area).sum();
        assert!((sum - area(&whole)).abs() < 1e-4 * sum, "{sum}");
        assert!(
            pieces
                .iter()
                .all(|piece| piece.normals.len() == piece.vertices.len())
        );
        let scene = Scene::new(&whole);
        for vertex in pieces.iter().flat_map(|piece| &piece.vertices) {
            let mut least_m = f32::INFINITY;
            scene.for_each_hit(vertex + Vec3::Z, Vec3::NEG_Z, 2.0, |hit| {
                least_m = least_m.min((hit.range_m - 1.0).abs());
            });
            let on_rim = vertex.x.abs().max(vertex.y.abs()) > 7.8;
            assert!(on_rim || least_m < 1e-5, "{vertex}: {least_m}");
        }
    }

    #[test]
    fn a_piece_is_open_only_where_it_was_and_along_the_border() {
        let ownership = ownership();
        let whole = bumpy(1);
        for piece in pieces(&whole, &ownership) {
            let edges: HashSet<[u32; 2]> = piece
                .triangles
                .iter()
                .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
                .collect();
            assert_eq!(edges.len(), 3 * piece.triangles.len(), "an edge twice");
            let grid = ownership.grid();
            for [from, to] in piece
                .triangles
                .iter()
                .flat_map(|&[a, b, c]| [[a, b], [b, c], [c, a]])
            {
                let [a, b] = [from, to].map(|v| piece.vertices[v as usize]);
                let on_rim = a.min(b).abs().max(a.max(b).abs()).truncate().max_element() > 7.8;
                if on_rim || edges.contains(&[to, from]) {
                    continue;
                }
                let middle = 0.5 * (a + b).truncate();
                let across = (b - a).truncate().perp().normalize() * 0.01;
                let [left, right] = [middle + across, middle - across].map(|place| {
                    let (column, row) = grid.cell_at(place.x.into(), place.y.into()).unwrap();
                    ownership.owner_of(column as isize, row as isize)
                });
                assert_ne!(left, right, "a crack from {a} to {b}");
            }
        }
    }

    #[test]
    fn what_is_not_near_the_border_stays_as_it_is() {
        let frames: Vec<Frame> = Vec::from_iter((0..1).map(|number| Frame {
            number,
            scan_path: String::new().into(),
            time_s: 0.0,
            map_from_lidar: Pose3::identity(),
            revolution: None,
        }));
        let ownership = Ownership::new(&frames, &local_maps(&frames, 3, 1.0), 20.0);
        let whole = bumpy(1);
        let mut own = whole.clone();
        assert_eq!(keep_own(&mut own, &ownership, 0), 0);
        assert!(own == whole);
        assert_eq!(keep_own(&mut own, &ownership, 1), whole.triangles.len());
        assert!(own.vertices.is_empty());
    }
}
