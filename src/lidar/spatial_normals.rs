//! Surface normals from neighbours in space, for sensors without rows.
//!
//! The points are sorted into cells of a grid. The neighbourhood of a point is its cell and the 26 around it, or
//! the 124 around it where these have too few points, up to the nearest points. A plane is fitted by principal
//! components, and once more to the points that are within the tolerance of the first one. There is no normal where
//! few points are, where they are not in a plane, or where they are in a line.

use std::ops::Range;

use foldhash::HashMap;
use glam::{IVec3, Vec3};
use rayon::prelude::*;

use super::normals::NormalConfig;
use crate::geometry::{PlaneFit, PlaneSums};

/// Edge of a cell [m].
const CELL_M: f32 = 0.4;
/// Largest coordinate of a point that has a normal [m].
const FARTHEST_M: f32 = 1e4;
/// Points of a neighbourhood, at most, and fewest before it is enlarged.
const POINTS: [usize; 2] = [24, 12];
/// Points on a plane, at least.
const MIN_POINTS: usize = 6;
/// Share of the neighbourhood on the plane, at least (unitless).
const MIN_SHARE: f32 = 0.6;

/// Unit normals in the lidar frame, towards the sensor, one per point; `None` where there is no plane.
///
/// The tolerances and the incidence of the configuration apply.
pub fn estimate_spatial_normals(points: &[Vec3], config: &NormalConfig) -> Vec<Option<Vec3>> {
    let grid = Grid::new(points);
    (points.par_iter())
        .map(|&point| normal_at(&grid, point, config))
        .collect()
}

/// Points in the order of their cells.
struct Grid {
    points: Vec<Vec3>,
    cells: HashMap<IVec3, Range<usize>>,
}

/// Whether a point is near enough, and not that of an empty pixel at the origin.
fn is_return(point: Vec3) -> bool {
    point.abs().max_element() < FARTHEST_M && point != Vec3::ZERO
}

fn cell_of(point: Vec3) -> IVec3 {
    (point / CELL_M).floor().as_ivec3()
}

impl Grid {
    fn new(points: &[Vec3]) -> Self {
        let near = points.iter().filter(|point| is_return(**point));
        let mut points: Vec<Vec3> = near.copied().collect();
        points.sort_by_key(|&point| cell_of(point).to_array());
        let mut start = 0;
        let cells = (points.chunk_by(|&a, &b| cell_of(a) == cell_of(b)))
            .map(|members| {
                start += members.len();
                (cell_of(members[0]), start - members.len()..start)
            })
            .collect();
        Self { points, cells }
    }

    /// Points in the cells up to `radius` cells away.
    fn around(&self, point: Vec3, radius: i32) -> Vec<Vec3> {
        let center = cell_of(point);
        let mut found = vec![];
        for x in -radius..=radius {
            for y in -radius..=radius {
                for z in -radius..=radius {
                    if let Some(range) = self.cells.get(&(center + IVec3::new(x, y, z))) {
                        found.extend_from_slice(&self.points[range.clone()]);
                    }
                }
            }
        }
        found
    }
}

fn normal_at(grid: &Grid, point: Vec3, config: &NormalConfig) -> Option<Vec3> {
    if !is_return(point) {
        return None;
    }
    let mut neighbors = grid.around(point, 1);
    if neighbors.len() < POINTS[1] {
        neighbors = grid.around(point, 2);
    }
    let distance = |neighbor: &Vec3| neighbor.distance_squared(point);
    neighbors.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
    neighbors.truncate(POINTS[0]);

    let range_m = point.length();
    let tolerance_m = config.tolerance_m + config.relative_tolerance * range_m;
    let first = plane_of(&neighbors, point)?;
    let needed = (MIN_SHARE * neighbors.len() as f32) as usize;
    let off_m = |plane: &PlaneFit, p: Vec3| plane.normal.dot(p - plane.center).abs();
    neighbors.retain(|&neighbor| off_m(&first, neighbor) < tolerance_m);
    let plane = plane_of(&neighbors, point).filter(|_| neighbors.len() >= needed)?;
    // The tilt of a strip hardly wider than the noise is undetermined.
    let is_strip = plane.variances[1] < 4.0 * plane.variances[0]
        || plane.variances[1] < 0.02 * plane.variances[2];
    let is_rough = plane.variances[0].sqrt() > f64::from(0.5 * tolerance_m);
    if is_strip || is_rough || off_m(&plane, point) > tolerance_m {
        return None;
    }
    let cosine = -plane.normal.dot(point) / range_m;
    (cosine.abs() >= super::normals::MIN_INCIDENCE).then_some(plane.normal * cosine.signum())
}

fn plane_of(points: &[Vec3], anchor: Vec3) -> Option<PlaneFit> {
    let mut sums = PlaneSums::about(anchor);
    points.iter().for_each(|&point| sums.add(point));
    sums.fit().filter(|_| points.len() >= MIN_POINTS)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Returns in random directions within 35 degrees of forward, on ground and wall, with 1 cm of noise.
    fn scan() -> Vec<Vec3> {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut angle = || rng.random_range(-0.6..0.6_f32);
        let directions: Vec<Vec3> = (0..6000)
            .map(|_| Vec3::new(1.0, angle(), angle()).normalize())
            .collect();
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        (directions.into_iter())
            .map(|direction| {
                let wall_m = 9.0 / direction.x;
                let ground_m = if direction.z < 0.0 {
                    -1.5 / direction.z
                } else {
                    1e3
                };
                direction * (wall_m.min(ground_m) + rng.random_range(-0.01..0.01))
            })
            .collect()
    }

    #[test]
    fn normals_of_ground_and_wall_are_correct_and_face_the_sensor() {
        let points = scan();
        let normals = estimate_spatial_normals(&points, &NormalConfig::default());
        let found = normals.iter().flatten().count();
        assert!(found > 5400, "{found}");
        let mut good = 0;
        for (point, normal) in points.iter().zip(&normals) {
            let Some(normal) = normal else { continue };
            assert!(normal.dot(*point) < 0.0);
            let best = normal.dot(Vec3::Z).max(normal.dot(-Vec3::X));
            good += usize::from(best > 0.985);
        }
        assert!(good as f32 > 0.97 * found as f32, "{good} of {found}");
    }

    #[test]
    fn the_order_of_the_points_does_not_matter() {
        let points = scan();
        let reversed: Vec<Vec3> = points.iter().rev().copied().collect();
        let normals = estimate_spatial_normals(&points, &NormalConfig::default());
        let mut again = estimate_spatial_normals(&reversed, &NormalConfig::default());
        again.reverse();
        let same = normals.iter().zip(&again).filter(|(a, b)| match (a, b) {
            (Some(a), Some(b)) => a.dot(*b) > 0.9999,
            (a, b) => a.is_none() && b.is_none(),
        });
        assert!(same.count() > 5990);
    }

    #[test]
    fn scattered_linear_and_invalid_points_have_no_normals() {
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let scatter: Vec<Vec3> = (0..3000)
            .map(|_| Vec3::from_array([(); 3].map(|()| rng.random_range(3.0..9.0))))
            .collect();
        let config = NormalConfig::default();
        let found = estimate_spatial_normals(&scatter, &config)
            .iter()
            .flatten()
            .count();
        assert!(found < 60, "{found}");
        let line: Vec<Vec3> = (0..200)
            .map(|i| Vec3::new(5.0, 0.03 * i as f32, 0.0))
            .collect();
        assert!(
            estimate_spatial_normals(&line, &config)
                .iter()
                .all(Option::is_none)
        );
        let invalid = [Vec3::NAN, Vec3::INFINITY, Vec3::splat(1e9), Vec3::ZERO];
        assert_eq!(estimate_spatial_normals(&invalid, &config), [None; 4]);
    }
}
