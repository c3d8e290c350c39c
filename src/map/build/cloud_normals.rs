//! Oriented normals of a point cloud without sensor positions.
//!
//! A normal is that of the least-squares plane of the nearest neighbours. Ground faces up; from it, or
//! from the highest point of what is not connected to ground, the orientation is propagated along a
//! minimum spanning tree of the neighbours (Hoppe et al., *Surface Reconstruction from Unorganized
//! Points*, SIGGRAPH 1992). Across an edge e the normal is mirrored, so that it is right at corners too
//! (König and Gumhold, *Consistent Propagation of Normal Orientations in Point Clouds*, VMV 2009):
//!
//! ```text
//! e = (p_j − p_i) / |p_j − p_i|      n_i' = n_i − 2 (n_i · e) e
//! n_j is flipped if n_i' · n_j < 0   weight of the edge = 1 − |n_i' · n_j|
//! ```

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use glam::Vec3;
use rayon::prelude::*;

use crate::geometry::{KdTree, PlaneSums};

/// Numbers of neighbours of a plane: more where fewer are on a line, as in a single sweep of a beam.
const PLANE_NEIGHBOURS: [usize; 3] = [20, 40, 80];

/// Neighbours on a line have a smaller ratio of the variances along it and across it.
const MIN_ACROSS: f64 = 0.05;

/// Largest share of the variance off the plane of its sum; 1/3 is a ball.
const MAX_OFF_PLANE: f64 = 0.15;

/// Neighbours to which an orientation is propagated.
const TREE_NEIGHBOURS: usize = 10;

/// Returns the normals of points, of arbitrary sign; `None` where the neighbours are no surface.
pub(crate) fn estimate(points: &[Vec3], tree: &KdTree) -> Vec<Option<Vec3>> {
    let normal = |found: &mut Vec<(f32, u32)>, &point: &Vec3| {
        PLANE_NEIGHBOURS.iter().find_map(|&count| {
            tree.nearest(point, count, found);
            let mut sums = PlaneSums::about(point);
            found
                .iter()
                .for_each(|&(_, number)| sums.add(points[number as usize]));
            let plane = sums.fit()?;
            let [off, across, along] = plane.variances;
            let is_plane = off <= MAX_OFF_PLANE * (off + across + along);
            (across >= MIN_ACROSS * along).then_some(is_plane.then_some(plane.normal))
        })
    };
    let points = points.par_iter().with_min_len(256);
    points
        .map_init(Vec::new, normal)
        .map(Option::flatten)
        .collect()
}

/// Orients normals towards the nearest of the positions of a sensor.
pub(crate) fn face_sensor(points: &[Vec3], normals: &mut [Vec3], sensor_positions: &[Vec3]) {
    let tree = KdTree::new(sensor_positions);
    let points = points.par_iter().zip(normals).with_min_len(256);
    points.for_each_init(Vec::new, |found, (&point, normal)| {
        tree.nearest(point, 1, found);
        if let Some(&(_, sensor)) = found.first()
            && normal.dot(sensor_positions[sensor as usize] - point) < 0.0
        {
            *normal = -*normal;
        }
    });
}

/// Orients normals consistently, those of ground upwards.
pub(crate) fn propagate(points: &[Vec3], normals: &mut [Vec3], is_ground: &[bool], tree: &KdTree) {
    let neighbours = Neighbours::new(points, tree);
    let mut roots: Vec<usize> = (0..points.len()).collect();
    roots.sort_unstable_by(|&a, &b| {
        let height = points[b].z.total_cmp(&points[a].z);
        is_ground[b].cmp(&is_ground[a]).then(height).then(a.cmp(&b))
    });
    let mut is_oriented = vec![false; points.len()];
    let mut edges = BinaryHeap::new();
    // All ground at once, then the highest point of each further component.
    let grounds = roots.iter().filter(|&&root| is_ground[root]).count();
    let (ground, others) = roots.split_at(grounds);
    for group in std::iter::once(ground).chain(others.chunks(1)) {
        for &root in group {
            if !is_oriented[root] {
                face(&mut normals[root], Vec3::Z);
                is_oriented[root] = true;
            }
        }
        for &root in group {
            neighbours.push_edges(root, points, normals, &is_oriented, &mut edges);
        }
        while let Some(Reverse((_, to, from))) = edges.pop() {
            let (from, to) = (from as usize, to as usize);
            if !is_oriented[to] {
                let mirrored = mirrored(normals[from], points[to] - points[from]);
                face(&mut normals[to], mirrored);
                is_oriented[to] = true;
                neighbours.push_edges(to, points, normals, &is_oriented, &mut edges);
            }
        }
    }
}

/// Edges by weight: its bits, the point that it leads to, the point that it comes from.
type Edges = BinaryHeap<Reverse<(u32, u32, u32)>>;

/// Neighbours of each point, in both directions.
struct Neighbours {
    /// First neighbour of each point, and the end of the last.
    starts: Vec<usize>,
    numbers: Vec<u32>,
}

impl Neighbours {
    fn new(points: &[Vec3], tree: &KdTree) -> Self {
        let near = |found: &mut Vec<(f32, u32)>, (point, number): (&Vec3, u32)| {
            tree.nearest(*point, TREE_NEIGHBOURS + 1, found);
            let others = found
                .iter()
                .map(|&(_, other)| other)
                .filter(|&other| other != number);
            others
                .flat_map(|other| [(number, other), (other, number)])
                .collect::<Vec<_>>()
        };
        let numbered = points
            .par_iter()
            .zip(0..points.len() as u32)
            .with_min_len(256);
        let mut pairs: Vec<(u32, u32)> = numbered.map_init(Vec::new, near).flatten_iter().collect();
        pairs.par_sort_unstable();
        pairs.dedup();
        let start = |point: usize| pairs.partition_point(|&(from, _)| (from as usize) < point);
        Self {
            starts: (0..=points.len()).map(start).collect(),
            numbers: pairs.iter().map(|&(_, to)| to).collect(),
        }
    }

    fn push_edges(
        &self,
        from: usize,
        points: &[Vec3],
        normals: &[Vec3],
        is_oriented: &[bool],
        edges: &mut Edges,
    ) {
        for &to in &self.numbers[self.starts[from]..self.starts[from + 1]] {
            let other = to as usize;
            if !is_oriented[other] {
                let mirrored = mirrored(normals[from], points[other] - points[from]);
                let weight = (1.0 - mirrored.dot(normals[other]).abs()).max(0.0);
                edges.push(Reverse((weight.to_bits(), to, from as u32)));
            }
        }
    }
}

/// A normal mirrored at the plane across an edge.
fn mirrored(normal: Vec3, edge: Vec3) -> Vec3 {
    let edge = edge.normalize_or_zero();
    normal - 2.0 * normal.dot(edge) * edge
}

/// Turns a normal to the side of a direction.
fn face(normal: &mut Vec3, direction: Vec3) {
    if normal.dot(direction) < 0.0 {
        *normal = -*normal;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points on the faces of a box, with the outward normals of their faces.
    fn box_points(size: Vec3, step_m: f32) -> (Vec<Vec3>, Vec<Vec3>) {
        let (mut points, mut outward) = (Vec::new(), Vec::new());
        for axis in 0..3 {
            let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
            for side in [-1.0, 1.0_f32] {
                let count = |axis: usize| (size[axis] / step_m) as i32;
                for i in 0..count(u) {
                    for j in 0..count(v) {
                        let mut point = Vec3::ZERO;
                        point[axis] = 0.5 * side * size[axis];
                        point[u] = (i as f32 + 0.5) * step_m - 0.5 * size[u];
                        point[v] = (j as f32 + 0.5) * step_m - 0.5 * size[v];
                        points.push(point);
                        outward.push(side * Vec3::AXES[axis]);
                    }
                }
            }
        }
        (points, outward)
    }

    /// The points with normals, and those normals with alternating signs.
    struct Unoriented {
        points: Vec<Vec3>,
        outward: Vec<Vec3>,
        normals: Vec<Vec3>,
        tree: KdTree,
    }

    fn unoriented(size: Vec3, step_m: f32) -> Unoriented {
        let (points, outward) = box_points(size, step_m);
        let found = estimate(&points, &KdTree::new(&points));
        let has_normal = |index: &usize| found[*index].is_some();
        let kept: Vec<usize> = (0..points.len()).filter(has_normal).collect();
        assert!(kept.len() > points.len() * 9 / 10);
        let points: Vec<Vec3> = kept.iter().map(|&i| points[i]).collect();
        let sign = |i: usize| if i.is_multiple_of(3) { -1.0 } else { 1.0 };
        Unoriented {
            outward: kept.iter().map(|&i| outward[i]).collect(),
            normals: kept.iter().map(|&i| sign(i) * found[i].unwrap()).collect(),
            tree: KdTree::new(&points),
            points,
        }
    }

    #[test]
    fn a_room_faces_inwards_from_its_floor_and_a_box_without_ground_outwards() {
        for (has_floor, sign) in [(true, -1.0), (false, 1.0)] {
            let Unoriented {
                points,
                outward,
                mut normals,
                tree,
            } = unoriented(Vec3::new(8.0, 6.0, 3.0), 0.1);
            let is_ground: Vec<bool> = (outward.iter())
                .map(|normal| has_floor && *normal == Vec3::NEG_Z)
                .collect();
            propagate(&points, &mut normals, &is_ground, &tree);
            let faces = normals.iter().zip(&outward);
            let right = faces
                .filter(|(normal, outward)| sign * normal.dot(**outward) > 0.0)
                .count();
            assert_eq!(right, points.len());
        }
    }

    #[test]
    fn normals_face_the_nearest_position_of_the_sensor() {
        let Unoriented {
            points,
            outward,
            mut normals,
            ..
        } = unoriented(Vec3::new(8.0, 6.0, 3.0), 0.2);
        face_sensor(&points, &mut normals, &[Vec3::ZERO, Vec3::X]);
        assert!(
            normals
                .iter()
                .zip(&outward)
                .all(|(normal, outward)| normal.dot(*outward) < 0.0)
        );
    }

    #[test]
    fn points_on_a_line_and_in_a_ball_have_no_normal() {
        let line: Vec<Vec3> = (0..200).map(|i| 0.1 * i as f32 * Vec3::X).collect();
        assert!(
            estimate(&line, &KdTree::new(&line))
                .iter()
                .all(Option::is_none)
        );
        let grid =
            (0..1000).map(|i| Vec3::new((i % 10) as f32, (i / 10 % 10) as f32, (i / 100) as f32));
        let grid: Vec<Vec3> = grid.collect();
        let normals = estimate(&grid, &KdTree::new(&grid));
        assert_eq!(normals[555], None);
    }
}
