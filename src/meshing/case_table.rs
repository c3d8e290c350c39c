//! The case table of marching cubes: the triangles of a cell for each of the 256 sign patterns of its
//! corners.
//!
//! On every face, each run of corners behind the surface is separated by one segment, a rule that gives
//! both cells at a face the same segments. The segments of the six faces form closed loops, which are
//! triangulated. A diagonal never joins two vertices of one face: the neighboring cell could have the
//! same edge, and four triangles would share it. Lorensen and Cline, *Marching Cubes* (1987), with
//! generated tables.

use std::sync::OnceLock;

/// The triangles of one case; vertices are on edges 0 to 11 or, from 12 on, centers of loops.
#[derive(Clone, Debug, Default)]
pub struct CellCase {
    /// Vertices of the triangles, counter-clockwise seen from the front.
    pub triangles: Vec<[u8; 3]>,
    /// The loops that need a center; that of the first is vertex 12.
    pub centers: Vec<Vec<u8>>,
}

/// Bits of the corners in front of the surface, corner `x + 2y + 4z`.
pub fn corner_signs(in_front: [bool; 8]) -> u8 {
    (0..8).fold(0, |bits, corner| {
        bits | u8::from(in_front[corner]) << corner
    })
}

/// The case of the bits of the corners in front of the surface.
pub fn cell_case(in_front: u8) -> &'static CellCase {
    static CASES: OnceLock<Vec<CellCase>> = OnceLock::new();
    let cases = CASES.get_or_init(|| (0..=255).map(triangulate).collect());
    &cases[in_front as usize]
}

/// Lowest corner and axis of an edge.
#[inline]
pub fn edge(id: usize) -> ([usize; 3], usize) {
    let axis = id / 4;
    let mut corner = [0; 3];
    corner[(axis + 1) % 3] = id & 1;
    corner[(axis + 2) % 3] = id >> 1 & 1;
    (corner, axis)
}

fn edge_id(corner: [usize; 3], axis: usize) -> u8 {
    (4 * axis + corner[(axis + 1) % 3] + 2 * corner[(axis + 2) % 3]) as u8
}

/// The corners of a face, counter-clockwise seen from the end of its axis, relative to the lowest
/// corner of the cell.
pub fn face_corners(axis: usize, side: usize) -> [[usize; 3]; 4] {
    [[0, 0], [1, 0], [1, 1], [0, 1]].map(|[u, v]| {
        let mut corner = [0; 3];
        corner[axis] = side;
        corner[(axis + 1) % 3] = u;
        corner[(axis + 2) % 3] = v;
        corner
    })
}

/// The edges of a face in the order of its corners: lowest corner and axis.
pub fn face_edges(axis: usize, side: usize) -> [([usize; 3], usize); 4] {
    let corners = face_corners(axis, side);
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    [
        (corners[0], u),
        (corners[1], v),
        (corners[3], u),
        (corners[0], v),
    ]
}

/// Pairs of face edges joined by a segment; seen from the end of the axis, the left side is behind the
/// surface.
pub fn face_segments(in_front: [bool; 4]) -> impl Iterator<Item = (usize, usize)> {
    (0..4)
        .filter(move |&i| !in_front[i] && in_front[(i + 1) % 4])
        .map(move |leaving| {
            let entering = (1..4)
                .map(|back| (leaving + 4 - back) % 4)
                .find(|&i| in_front[i] && !in_front[(i + 1) % 4]);
            (leaving, entering.unwrap_or(leaving))
        })
}

/// Joins segments to closed loops, in the order of their first segments.
pub fn join_loops<P: Copy>(mut segments: Vec<(P, P)>, same: impl Fn(P, P) -> bool) -> Vec<Vec<P>> {
    let mut loops = Vec::new();
    while !segments.is_empty() {
        let (start, mut end) = segments.remove(0);
        let mut points = vec![start];
        while !same(end, start) {
            let Some(next) = segments.iter().position(|&(from, _)| same(from, end)) else {
                break;
            };
            points.push(end);
            end = segments.remove(next).1;
        }
        loops.push(points);
    }
    loops
}

fn triangulate(in_front: u8) -> CellCase {
    let mut segments = Vec::new();
    for axis in 0..3 {
        for side in 0..2 {
            let signs =
                face_corners(axis, side).map(|[x, y, z]| in_front >> (x + 2 * y + 4 * z) & 1 == 1);
            let edges = face_edges(axis, side).map(|(corner, axis)| edge_id(corner, axis));
            segments.extend(face_segments(signs).map(|(from, to)| match side {
                0 => (edges[from], edges[to]),
                _ => (edges[to], edges[from]),
            }));
        }
    }
    let mut case = CellCase::default();
    for polygon in join_loops(segments, |a, b| a == b) {
        let count = polygon.len();
        let at = |apex: usize, step: usize| polygon[(apex + step) % count];
        let apex = (0..count)
            .find(|&apex| (2..count - 1).all(|step| !share_face(polygon[apex], at(apex, step))));
        if let Some(apex) = apex {
            let steps = 1..count - 1;
            (case.triangles)
                .extend(steps.map(|step| [polygon[apex], at(apex, step), at(apex, step + 1)]));
        } else {
            let center = (12 + case.centers.len()) as u8;
            (case.triangles).extend((0..count).map(|i| [polygon[i], at(i, 1), center]));
            case.centers.push(polygon);
        }
    }
    case
}

/// Whether two edges of a cell are on one face.
fn share_face(a: u8, b: u8) -> bool {
    let ((corner_a, axis_a), (corner_b, axis_b)) = (edge(a.into()), edge(b.into()));
    (0..3).any(|axis| axis != axis_a && axis != axis_b && corner_a[axis] == corner_b[axis])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_corner_behind_the_surface_gives_one_triangle_that_faces_away_from_it() {
        let case = cell_case(0b1111_1110);
        assert_eq!(case.triangles.len(), 1);
        let [a, b, c] = case.triangles[0].map(|id| {
            let (corner, axis) = edge(id.into());
            let mut at = corner.map(|x| x as f32);
            at[axis] += 0.5;
            glam::Vec3::from(at)
        });
        assert!((b - a).cross(c - a).dot(glam::Vec3::ONE) > 0.0);
    }

    #[test]
    fn exactly_the_edges_with_a_sign_change_are_used() {
        for in_front in 0..=255_u8 {
            let mut used = [false; 12];
            for id in cell_case(in_front)
                .triangles
                .iter()
                .flatten()
                .filter(|&&id| id < 12)
            {
                used[*id as usize] = true;
            }
            for (id, used) in used.into_iter().enumerate() {
                let (corner, axis) = edge(id);
                let first = corner[0] + 2 * corner[1] + 4 * corner[2];
                let changes = (in_front >> first ^ in_front >> (first + (1 << axis))) & 1 == 1;
                assert_eq!(used, changes, "case {in_front} edge {id}");
            }
        }
    }
}
