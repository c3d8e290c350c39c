//! Cuts local maps at the border of what each owns.
//!
//! Ownership is decided per cell of a grid, so borders are vertical planes x = const and y = const.
//! Triangles across a border are clipped at these planes in both local maps: seen from above, there
//! is neither a gap nor an overlap between the two. What remains of the seam is the difference of
//! their surfaces, on a road a step of millimetres. A wall in a border plane, to within that
//! difference, may be in both maps or in neither.
//!
//! Polygons are clipped as in Sutherland and Hodgman, *Reentrant Polygon Clipping* (1974), first into
//! columns of the grid, then into rows. An edge is divided in the same order in both of its triangles,
//! so that both get identical new vertices.

use std::ops::{Range, RangeInclusive};

use foldhash::{HashMap, HashMapExt as _};
use glam::{DVec3, Vec3};

use super::plan::Region;
use crate::geometry::TriangleMesh;

/// An ear with more than this share of a polygon is not cut off: the remainder would be a line of
/// vertices along a straight edge (unitless).
const MAX_EAR_SHARE: f32 = 0.9999;

/// Clips a mesh, whose vertices are relative to `origin` [m], to what a local map owns; returns the number of triangles
/// of which nothing is left. Normals of new vertices are interpolated; colours are dropped.
pub(crate) fn keep_own(mesh: &mut TriangleMesh, region: &Region, origin: DVec3) -> usize {
    let region = OwnRegion::new(region, origin);
    let mut clipper = Clipper {
        region: &region,
        vertices: std::mem::take(&mut mesh.vertices),
        normals: std::mem::take(&mut mesh.normals),
        kept: Vec::with_capacity(mesh.triangles.len()),
        new_vertices: HashMap::new(),
        edges: HashMap::new(),
    };
    let triangles = std::mem::take(&mut mesh.triangles);
    let overlaps: Vec<Overlap> = (triangles.iter())
        .map(|&triangle| region.overlap(triangle.map(|vertex| clipper.vertices[vertex as usize])))
        .collect();
    for (&triangle, overlap) in triangles.iter().zip(&overlaps) {
        if *overlap == Overlap::Partial {
            clipper.divide_edges(triangle);
        }
    }
    let mut foreign = 0;
    for (&triangle, overlap) in triangles.iter().zip(&overlaps) {
        let before = clipper.kept.len();
        match overlap {
            Overlap::Inside => clipper.keep(triangle),
            Overlap::Partial => clipper.clip(triangle),
            Overlap::Outside => {}
        }
        foreign += usize::from(clipper.kept.len() == before);
    }
    mesh.vertices = clipper.vertices;
    mesh.normals = clipper.normals;
    mesh.triangles = clipper.kept;
    mesh.colors.clear();
    mesh.drop_unreferenced_vertices();
    foreign
}

/// Returns which vertices, relative to `origin` [m], lie on the border of what a local map owns.
pub(crate) fn on_border(vertices: &[Vec3], region: &Region, origin: DVec3) -> Vec<bool> {
    let region = OwnRegion::new(region, origin);
    let touches_foreign = |vertex: &Vec3| {
        let mut columns = region.touching(0, vertex.x);
        columns.any(|column| {
            let mut rows = region.touching(1, vertex.y);
            rows.any(|row| !region.contains(column, row))
        })
    };
    vertices.iter().map(touches_foreign).collect()
}

/// How a triangle overlaps the own region.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Overlap {
    Inside,
    Partial,
    Outside,
}

/// The cells of a local map and the grid lines around them. Cells are counted from 1; cell 0 and the
/// last one reach from the edge of the grid to infinity.
struct OwnRegion<'a> {
    region: &'a Region,
    /// Lines between the columns and between the rows, rounded once, with lines at infinity at both
    /// ends [m]: cell i lies between the lines i and i + 1.
    lines: [Vec<f32>; 2],
}

impl<'a> OwnRegion<'a> {
    fn new(region: &'a Region, relative_to: DVec3) -> Self {
        let grid = &region.grid;
        let lines = |origin: f64, count: usize| {
            let inner = (0..=count).map(|line| (origin + line as f64 * grid.cell_m) as f32);
            let lower = std::iter::once(f32::NEG_INFINITY);
            lower.chain(inner).chain([f32::INFINITY]).collect()
        };
        Self {
            region,
            lines: [
                lines(grid.origin.x - relative_to.x, grid.columns),
                lines(grid.origin.y - relative_to.y, grid.rows),
            ],
        }
    }

    fn contains(&self, column: usize, row: usize) -> bool {
        let (Some(column), Some(row)) = (column.checked_sub(1), row.checked_sub(1)) else {
            return false;
        };
        self.region.contains(column, row)
    }

    fn overlap(&self, [a, b, c]: [Vec3; 3]) -> Overlap {
        let (min, max) = (a.min(b).min(c), a.max(b).max(c));
        let (mut own, mut foreign) = (false, false);
        for column in self.cells(0, min.x, max.x) {
            for row in self.cells(1, min.y, max.y) {
                let is_own = self.contains(column, row);
                own |= is_own;
                foreign |= !is_own;
            }
        }
        match (own, foreign) {
            (true, false) => Overlap::Inside,
            (true, true) => Overlap::Partial,
            (false, _) => Overlap::Outside,
        }
    }

    /// Lines strictly between two coordinates along an axis.
    fn between(&self, axis: usize, from: f32, to: f32) -> Range<usize> {
        let lines = &self.lines[axis];
        let first = lines.partition_point(|&line| line <= from.min(to));
        let end = lines.partition_point(|&line| line < from.max(to));
        first..end.max(first)
    }

    /// Columns or rows whose closed interval contains a coordinate.
    fn touching(&self, axis: usize, coordinate: f32) -> RangeInclusive<usize> {
        let lines = &self.lines[axis];
        let first = lines.partition_point(|&line| line < coordinate) - 1;
        first..=lines.partition_point(|&line| line <= coordinate) - 1
    }

    /// Columns or rows that an interval overlaps.
    fn cells(&self, axis: usize, from: f32, to: f32) -> RangeInclusive<usize> {
        let inner = self.between(axis, from, to);
        inner.start - 1..=inner.end - 1
    }
}

/// Clips triangles to a region.
struct Clipper<'a> {
    region: &'a OwnRegion<'a>,
    vertices: Vec<Vec3>,
    normals: Vec<Vec3>,
    kept: Vec<[u32; 3]>,
    /// New vertices by the bits of their positions.
    new_vertices: HashMap<[u32; 3], u32>,
    /// New vertices along the edges of clipped triangles; the smaller vertex of an edge first.
    edges: HashMap<(u32, u32), Vec<u32>>,
}

impl Clipper<'_> {
    /// Divides the edges of a triangle that is to be clipped at all lines.
    fn divide_edges(&mut self, triangle: [u32; 3]) {
        for (from, to) in sides(&triangle).map(|(a, b)| (a.min(b), a.max(b))) {
            if self.edges.contains_key(&(from, to)) {
                continue;
            }
            let mut chain = vec![from, to];
            for axis in 0..2 {
                chain = self.divide(chain.windows(2).map(|side| (side[0], side[1])), axis);
                chain.push(to);
            }
            chain.dedup();
            let between = chain[1..chain.len() - 1].to_vec();
            self.edges.insert((from, to), between);
        }
    }

    /// Returns the start of each side, followed by its crossings with the lines of an axis.
    fn divide(&mut self, sides: impl Iterator<Item = (u32, u32)>, axis: usize) -> Vec<u32> {
        let region = self.region;
        let mut outline = Vec::with_capacity(8);
        for (from, to) in sides {
            outline.push(from);
            let start = outline.len();
            let at = |vertex: u32| self.vertices[vertex as usize][axis];
            let (low, high) = if at(from) <= at(to) {
                (from, to)
            } else {
                (to, from)
            };
            let mut last = low;
            for line in region.between(axis, at(low), at(high)) {
                last = self.crossing(last, high, axis, region.lines[axis][line]);
                outline.push(last);
            }
            if low != from {
                outline[start..].reverse();
            }
        }
        outline
    }

    /// Returns the vertex where a side that rises along an axis reaches a coordinate.
    fn crossing(&mut self, low: u32, high: u32, axis: usize, coordinate: f32) -> u32 {
        let (a, b) = (self.vertices[low as usize], self.vertices[high as usize]);
        let share = (coordinate - a[axis]) / (b[axis] - a[axis]);
        let mut point = a + share * (b - a);
        point[axis] = coordinate;
        let bits = point.to_array().map(f32::to_bits);
        *self.new_vertices.entry(bits).or_insert_with(|| {
            if !self.normals.is_empty() {
                let normal = self.normals[low as usize].lerp(self.normals[high as usize], share);
                self.normals.push(normal.normalize_or(Vec3::Z));
            }
            self.vertices.push(point);
            self.vertices.len() as u32 - 1
        })
    }

    /// Keeps a whole triangle, with the vertices that clipping its neighbours added to its edges.
    fn keep(&mut self, triangle: [u32; 3]) {
        let mut outline = Vec::with_capacity(8);
        for (from, to) in sides(&triangle) {
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
            self.kept.push(triangle);
        } else {
            self.triangulate(outline);
        }
    }

    /// Keeps the parts of a triangle in own cells.
    fn clip(&mut self, triangle: [u32; 3]) {
        for (column, strip) in self.slices(&triangle, 0) {
            for (row, piece) in self.slices(&strip, 1) {
                if self.region.contains(column, row) {
                    self.triangulate(piece);
                }
            }
        }
    }

    /// Divides a convex polygon at all lines of an axis; returns the parts with their columns or rows.
    fn slices(&mut self, polygon: &[u32], axis: usize) -> Vec<(usize, Vec<u32>)> {
        let outline = self.divide(sides(polygon), axis);
        let at = |&vertex: &u32| self.vertices[vertex as usize][axis];
        let low = outline.iter().map(at).fold(f32::INFINITY, f32::min);
        let high = outline.iter().map(at).fold(f32::NEG_INFINITY, f32::max);
        let slice = |cell: usize| {
            let [from, to] = [cell, cell + 1].map(|line| self.region.lines[axis][line]);
            let is_inside = |vertex: &u32| (from..=to).contains(&at(vertex));
            let mut slice: Vec<u32> = outline.iter().copied().filter(is_inside).collect();
            slice.dedup();
            (cell, slice)
        };
        self.region.cells(axis, low, high).map(slice).collect()
    }

    /// Cuts ears off a convex polygon, the best-shaped first, until a triangle is left.
    fn triangulate(&mut self, mut outline: Vec<u32>) {
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
                .filter(|&tip| count == 3 || self.area(&ear(tip)) < MAX_EAR_SHARE * whole)
                .map(|tip| (self.shape(ear(tip)), tip))
                .max_by(|a, b| a.0.total_cmp(&b.0));
            match best {
                Some((shape, tip)) if shape > 0.0 => {
                    self.kept.push(ear(tip));
                    outline.remove(tip);
                }
                // The remainder is a line.
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

    /// Area of a triangle over its longest edge squared (unitless); 0 for a line.
    fn shape(&self, triangle: [u32; 3]) -> f32 {
        let [a, b, c] = triangle.map(|vertex| self.vertices[vertex as usize]);
        let longest = [b - a, c - b, a - c]
            .map(Vec3::length_squared)
            .into_iter()
            .fold(f32::MIN_POSITIVE, f32::max);
        self.area(&triangle) / longest
    }
}

/// Sides of a polygon.
fn sides(polygon: &[u32]) -> impl Iterator<Item = (u32, u32)> {
    let ends = polygon.iter().copied().cycle().skip(1);
    polygon.iter().copied().zip(ends)
}
