//! Where local maps meet: each is cut at the border of what it owns.
//!
//! Ownership is decided per cell of a grid, so a border runs along vertical planes x = const and
//! y = const. Triangles that reach over it are cut along these very planes, in the one local map
//! and in the other: seen from above there is neither a gap between the two nor a place that both
//! cover. What is left of the seam is the difference of their surfaces, of a road a step of
//! millimetres. A wall that stands on the very plane, to within that difference, may be in both
//! maps or in neither for as long as it runs along it.
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

/// Which vertices lie on the border of what a local map owns.
pub(super) fn on_border(vertices: &[Vec3], ownership: &Ownership, number: usize) -> Vec<bool> {
    let lines = Lines::of(ownership);
    let touches_foreign = |vertex: &Vec3| {
        lines.touching(0, vertex.x).any(|column| {
            (lines.touching(1, vertex.y)).any(|row| ownership.owner_of(column, row) != Some(number))
        })
    };
    vertices.iter().map(touches_foreign).collect()
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

    /// The columns or rows that a place is in or on the line of.
    fn touching(&self, axis: usize, place: f32) -> std::ops::RangeInclusive<isize> {
        let before = |is_before: fn(f32, f32) -> bool| {
            self.0[axis].partition_point(|&line| is_before(line, place)) as isize - 1
        };
        before(|line, place| line < place)..=before(|line, place| line <= place)
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
