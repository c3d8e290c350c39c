//! Nearest neighbours in space: a balanced k-d tree (Bentley 1975) in an array.

use std::ops::Range;

use glam::Vec3;

/// Points of which each splits a range of the array along the widest axis of the range: smaller
/// coordinates are before the point in the middle, larger ones behind it.
#[derive(Clone, Debug)]
pub struct KdTree {
    /// Positions and their numbers.
    points: Vec<(Vec3, u32)>,
    /// Axis along which the point in the middle of a range splits it.
    axes: Vec<u8>,
}

/// Largest range that is not split.
const LEAF: usize = 8;

/// Smallest range whose halves are sorted in parallel.
const PARALLEL: usize = 4096;

impl KdTree {
    /// Sorts points, which are numbered from 0; there must be fewer than 2³².
    pub fn new(points: &[Vec3]) -> Self {
        let mut points: Vec<(Vec3, u32)> = points.iter().copied().zip(0..).collect();
        let mut axes = vec![0; points.len()];
        split(&mut points, &mut axes);
        Self { points, axes }
    }

    /// Replaces `found` by the squared distances [m²] and numbers of the `count` points nearest to a position,
    /// the nearest first.
    pub fn nearest(&self, position: Vec3, count: usize, found: &mut Vec<(f32, u32)>) {
        found.clear();
        if count > 0 {
            self.visit(0..self.points.len(), position, count, found);
        }
    }

    fn visit(
        &self,
        range: Range<usize>,
        position: Vec3,
        count: usize,
        found: &mut Vec<(f32, u32)>,
    ) {
        if range.len() <= LEAF {
            range.for_each(|index| self.offer(index, position, count, found));
            return;
        }
        let middle = range.start.midpoint(range.end);
        let axis = usize::from(self.axes[middle]);
        let beyond_m = position[axis] - self.points[middle].0[axis];
        let (before, behind) = (range.start..middle, middle + 1..range.end);
        let (near, far) = if beyond_m < 0.0 {
            (before, behind)
        } else {
            (behind, before)
        };
        self.visit(near, position, count, found);
        self.offer(middle, position, count, found);
        let is_within = |(farthest, _): &(f32, u32)| beyond_m * beyond_m <= *farthest;
        if found.len() < count || found.last().is_some_and(is_within) {
            self.visit(far, position, count, found);
        }
    }

    /// Inserts a point among those found if it is one of the nearest.
    fn offer(&self, index: usize, position: Vec3, count: usize, found: &mut Vec<(f32, u32)>) {
        let (point, number) = self.points[index];
        let offered = (point.distance_squared(position), number);
        let place = found.partition_point(|other| *other < offered);
        if place < count {
            found.truncate(count - 1);
            found.insert(place.min(found.len()), offered);
        }
    }
}

/// Sorts a range and its halves.
fn split(points: &mut [(Vec3, u32)], axes: &mut [u8]) {
    if points.len() <= LEAF {
        return;
    }
    let ends = points.iter().map(|(point, _)| *point);
    let (min, max) = ends.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(min, max), point| {
        (min.min(point), max.max(point))
    });
    let axis = (max - min).max_position();
    let middle = points.len() / 2;
    points.select_nth_unstable_by(middle, |a, b| {
        a.0[axis].total_cmp(&b.0[axis]).then(a.1.cmp(&b.1))
    });
    axes[middle] = axis as u8;
    let is_parallel = points.len() >= PARALLEL;
    let (before, behind) = points.split_at_mut(middle);
    let (axes_before, axes_behind) = axes.split_at_mut(middle);
    let (behind, axes_behind) = (&mut behind[1..], &mut axes_behind[1..]);
    if is_parallel {
        rayon::join(|| split(before, axes_before), || split(behind, axes_behind));
    } else {
        split(before, axes_before);
        split(behind, axes_behind);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_points_are_those_of_comparing_all() {
        let mut state = 1_u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let mut points: Vec<Vec3> = (0..6000)
            .map(|_| Vec3::new(50.0 * random(), 20.0 * random(), random()))
            .collect();
        // Equal points too.
        points.extend_from_within(..300);
        let tree = KdTree::new(&points);
        let mut found = Vec::new();
        for _ in 0..50 {
            let position = Vec3::new(60.0 * random() - 5.0, 20.0 * random(), random());
            let mut all: Vec<(f32, u32)> = (points.iter().zip(0..))
                .map(|(point, number)| (point.distance_squared(position), number))
                .collect();
            all.sort_by(|a, b| a.partial_cmp(b).unwrap());
            for count in [0, 1, 20] {
                tree.nearest(position, count, &mut found);
                assert_eq!(found, all[..count]);
            }
        }
        KdTree::new(&points[..3]).nearest(Vec3::ZERO, 20, &mut found);
        assert_eq!(found.len(), 3);
        KdTree::new(&[]).nearest(Vec3::ZERO, 20, &mut found);
        assert!(found.is_empty());
    }
}
