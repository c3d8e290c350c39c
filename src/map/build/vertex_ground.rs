//! Ground confidences and colours of vertices, and the ground triangles of a mesh.
//!
//! The confidence of a vertex is the mean over the points around it, of all scans, in the smallest cells that have any: far from
//! the path points are farther apart. Its colour is
//! interpolated between the colours of rest and ground and changes sides at the threshold: the stronger
//! of the two shows the classification.

use foldhash::{HashMap, HashMapExt as _};
use glam::{IVec3, Vec3};
use rayon::prelude::*;

use crate::geometry::{PointCloud, TriangleMesh};

/// Colours of the ground and of the rest of a map.
pub(crate) const GROUND: [u8; 3] = [255, 0, 0];
pub(crate) const REST: [u8; 3] = [0, 0, 255];

/// Smallest distance of a colour from the middle (unitless), more than the error of rounding to
/// bytes.
const MIN_CONTRAST: f32 = 0.01;

/// Mean ground confidences of points in cells of several sizes, each twice as large as the one before.
pub(crate) struct GroundConfidences {
    cell_m: f32,
    /// Sum and number of the confidences of each cell, per size.
    levels: Vec<HashMap<IVec3, (f32, f32)>>,
}

impl GroundConfidences {
    /// The means of a cloud in cells with edges from one to a larger one [m].
    pub(crate) fn new(cloud: &PointCloud, cell_m: f32, largest_m: f32) -> Self {
        let mut finest: HashMap<IVec3, (f32, f32)> = HashMap::with_capacity(cloud.len() / 4);
        for (&position, &ground) in cloud.positions.iter().zip(&cloud.ground) {
            let cell = finest.entry(cell_of(position, cell_m)).or_default();
            cell.0 += ground;
            cell.1 += 1.0;
        }
        let mut levels = vec![finest];
        let count = (largest_m / cell_m).log2().ceil().max(0.0) as usize;
        for level in 0..count {
            let mut coarser: HashMap<IVec3, (f32, f32)> = HashMap::new();
            let mut cells: Vec<_> = levels[level].iter().collect();
            // The order of a sum decides its rounding.
            cells.sort_unstable_by_key(|(cell, _)| cell.to_array());
            for (cell, (sum, count)) in cells {
                let cell = coarser.entry(*cell >> 1).or_default();
                cell.0 += sum;
                cell.1 += count;
            }
            levels.push(coarser);
        }
        Self { cell_m, levels }
    }

    /// Returns per vertex the mean ground confidence, 0 to 1, of the points in its cell, or else in the
    /// cells around it, of the smallest size that has any; 0 where there are none.
    pub(crate) fn of(&self, vertices: &[Vec3]) -> Vec<f32> {
        let around: Vec<IVec3> = (0..27)
            .map(|i| IVec3::new(i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1))
            .collect();
        let mean = |(sum, count): (f32, f32)| (count > 0.0).then(|| sum / count);
        let near = |level: usize, vertex: Vec3| {
            let cells = &self.levels[level];
            let center = cell_of(vertex, self.cell_m) >> level as i32;
            let own = cells.get(&center).copied();
            mean(own.unwrap_or_else(|| {
                around
                    .iter()
                    .filter_map(|offset| cells.get(&(center + offset)))
                    .fold((0.0, 0.0), |sum, cell| (sum.0 + cell.0, sum.1 + cell.1))
            }))
        };
        vertices
            .par_iter()
            .map(|&vertex| {
                let found = (0..self.levels.len()).find_map(|level| near(level, vertex));
                found.unwrap_or(0.0)
            })
            .collect()
    }
}

fn cell_of(point: Vec3, cell_m: f32) -> IVec3 {
    (point / cell_m).floor().as_ivec3()
}

/// Returns the colour of a confidence: `rest` at 0, `ground` at 1, closer to `ground` exactly from the
/// threshold on.
pub(crate) fn color(confidence: f32, threshold: f32, rest: [u8; 3], ground: [u8; 3]) -> [u8; 3] {
    let half = 0.5 - MIN_CONTRAST;
    let share = if confidence >= threshold {
        let over = (confidence - threshold) / (1.0 - threshold).max(f32::EPSILON);
        1.0 - half + half * over.min(1.0)
    } else {
        half * (confidence / threshold).max(0.0)
    };
    std::array::from_fn(|i| {
        let (from, to) = (f32::from(rest[i]), f32::from(ground[i]));
        (from + share * (to - from)).round() as u8
    })
}

/// Whether a colour is that of ground in a map: more red than blue.
pub(crate) fn is_ground_color([red, _, blue]: &[u8; 3]) -> bool {
    red > blue
}

/// Returns which triangles are ground: those whose corners all reach the threshold.
pub(crate) fn ground_triangles(
    mesh: &TriangleMesh,
    confidences: &[f32],
    threshold: f32,
) -> Vec<bool> {
    let is_ground = |&vertex: &u32| confidences[vertex as usize] >= threshold;
    mesh.triangles
        .iter()
        .map(|triangle| triangle.iter().all(is_ground))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_vertex_between_sparse_points_has_the_confidence_of_the_nearest_ones() {
        let mut cloud = PointCloud::default();
        // A road 60 m away, along rings that are 1.5 m apart, and a wall beside it.
        for ring in 0..10 {
            for step in 0..100 {
                let (x, y) = (60.0 + 1.5 * ring as f32, 0.1 * step as f32);
                cloud.push(Vec3::new(x, y, 0.0), Vec3::Z, 0.9);
            }
        }
        for step in 0..100 {
            let position = Vec3::new(60.0 + 0.15 * step as f32, 12.0, 3.0);
            cloud.push(position, Vec3::Y, 0.1);
        }
        let between = [Vec3::new(60.75, 5.0, 0.0), Vec3::new(65.25, 2.0, 0.05)];
        let finest = GroundConfidences::new(&cloud, 0.25, 0.25);
        assert_eq!(finest.of(&between), [0.0; 2]);
        let confidences = GroundConfidences::new(&cloud, 0.25, 2.0);
        for confidence in confidences.of(&between) {
            assert!((confidence - 0.9).abs() < 1e-6, "{confidence}");
        }
        let on_wall = confidences.of(&[Vec3::new(64.0, 12.0, 3.0)]);
        assert!((on_wall[0] - 0.1).abs() < 1e-6);
        assert_eq!(confidences.of(&[Vec3::new(30.0, 5.0, 0.0)]), [0.0]);
    }

    const RED: [u8; 3] = [255, 0, 0];
    const BLUE: [u8; 3] = [0, 0, 255];

    #[test]
    fn a_vertex_has_the_mean_confidence_of_the_points_around_it() {
        let mut cloud = PointCloud::default();
        for (x, confidence) in [(0.1, 0.9), (0.1, 0.9), (0.15, 0.3), (5.1, 0.2)] {
            cloud.push(Vec3::new(x, 0.1, 0.1), Vec3::Z, confidence);
        }
        // In the cell of three points, in the cell of one, next to it, and far from all.
        let vertices = [0.05, 5.2, 5.45, 9.0].map(|x| Vec3::new(x, 0.1, 0.1));
        let means = GroundConfidences::new(&cloud, 0.25, 0.25).of(&vertices);
        for (mean, expected) in means.into_iter().zip([0.7, 0.2, 0.2, 0.0]) {
            assert!((mean - expected).abs() < 1e-6, "{mean} for {expected}");
        }
    }

    #[test]
    fn colors_are_interpolated_from_rest_to_ground_and_show_the_classification() {
        for threshold in [0.2, 0.5, 0.8, 1.0] {
            assert_eq!(color(0.0, threshold, BLUE, RED), BLUE);
            assert_eq!(color(1.0, 0.9 * threshold, BLUE, RED), RED);
            let mut before = 0;
            for step in 0..=1000 {
                let confidence = step as f32 / 1000.0;
                let [red, _, blue] = color(confidence, threshold, BLUE, RED);
                assert_eq!(red > blue, confidence >= threshold, "{confidence}");
                assert!(red >= before && red.abs_diff(255 - blue) <= 1);
                before = red;
            }
        }
    }

    #[test]
    fn a_triangle_is_ground_if_all_its_corners_are() {
        let mesh = TriangleMesh {
            vertices: vec![Vec3::ZERO; 4],
            triangles: vec![[0, 1, 2], [1, 2, 3]],
            ..TriangleMesh::default()
        };
        let confidences = [0.9, 0.6, 0.5, 0.4];
        let at = |threshold| ground_triangles(&mesh, &confidences, threshold);
        assert_eq!(at(0.5), [true, false]);
        assert_eq!(at(0.55), [false, false]);
        assert_eq!(at(0.4), [true, true]);
    }
}
