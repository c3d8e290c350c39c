//! Where the particles begin: around a given pose, along the road, or anywhere on the map.
//!
//! ```text
//! tracking   x₀ + U(±5 m), y₀ + U(±5 m), θ₀ + U(±30°)
//! global     a cell of the road (within 2 m of the mapping poses) or of the map,  θ ~ U(−π, π)
//! ```
//!
//! Chen et al., *Range Image-based LiDAR Localization for Autonomous Vehicles*, ICRA 2021.

use std::collections::BTreeSet;
use std::f64::consts::PI;

use nalgebra::{Point2, Vector2};
use rand::{Rng, RngExt as _};
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::geometry::Pose2;
use crate::map::{GroundMap, TileGrid};
use crate::validation::{InvalidValue, Validate, not_negative};

/// The shape of a spread.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Distribution1 {
    /// Equally likely up to the bound on either side.
    Uniform,
    /// Normal, with the bound as standard deviation.
    Gaussian,
}

/// How the particles are spread around a pose that is given.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StartSpread {
    /// Of each coordinate.
    pub distribution: Distribution1,
    /// In x and in y [m].
    pub position_m: f64,
    /// In heading [rad].
    pub heading_rad: f64,
}

impl Default for StartSpread {
    /// The values of range-mcl: uniform, ±5 m, ±30 degrees.
    fn default() -> Self {
        Self {
            distribution: Distribution1::Uniform,
            position_m: 5.0,
            heading_rad: 30.0_f64.to_radians(),
        }
    }
}

impl Validate for StartSpread {
    fn validate(&self) -> Result<(), InvalidValue> {
        not_negative("position_m", self.position_m)?;
        not_negative("heading_rad", self.heading_rad)
    }
}

/// Half the width of the road around the mapping poses [m], as in range-mcl.
pub const ROAD_HALF_WIDTH_M: f64 = 2.0;

/// Square cells in which a global search begins.
#[derive(Clone, Debug, PartialEq)]
pub struct Cells {
    /// Middles of the cells [m], ordered by y, then x.
    pub centers: Vec<Point2<f64>>,
    /// Side of a cell [m].
    pub cell_m: f64,
}

impl Cells {
    /// The cells whose middle is within `reach_m` of a mapping pose.
    pub fn along_road(poses: &[Pose2], reach_m: f64, cell_m: f64) -> Self {
        let reach = (reach_m / cell_m).ceil() as i64;
        let middle = |cell: i64| (cell as f64 + 0.5) * cell_m;
        let mut cells = BTreeSet::new();
        for pose in poses {
            let place = pose.translation.vector;
            let (column, row) = (
                (place.x / cell_m).floor() as i64,
                (place.y / cell_m).floor() as i64,
            );
            for row in row - reach..=row + reach {
                for column in column - reach..=column + reach {
                    let center = Vector2::new(middle(column), middle(row));
                    if (center - place).norm() <= reach_m {
                        cells.insert((row, column));
                    }
                }
            }
        }
        Self {
            centers: cells
                .into_iter()
                .map(|(row, column)| Point2::new(middle(column), middle(row)))
                .collect(),
            cell_m,
        }
    }

    /// The cells over the whole extent of the map: in valid tiles, where there is ground.
    pub fn over_map(tiles: &TileGrid, ground: &GroundMap, cell_m: f64) -> Self {
        let (min, max) = tiles.extent();
        let count = |extent_m: f64| (extent_m / cell_m).floor() as usize;
        let mut centers = Vec::new();
        for row in 0..count(max.y - min.y) {
            for column in 0..count(max.x - min.x) {
                let offset = Vector2::new(column as f64 + 0.5, row as f64 + 0.5) * cell_m;
                let pose = Pose2::from(min.coords + offset);
                if tiles.valid_tile_of(&pose).is_some() && ground.patch_under(&pose, None).is_some()
                {
                    centers.push(min + offset);
                }
            }
        }
        Self { centers, cell_m }
    }

    /// Poses in cells drawn with replacement, anywhere in the cell, with any heading. None where
    /// there are no cells.
    pub fn sample(&self, count: usize, rng: &mut impl Rng) -> Vec<Pose2> {
        if self.centers.is_empty() {
            return Vec::new();
        }
        (0..count)
            .map(|_| {
                let center = self.centers[rng.random_range(0..self.centers.len())];
                let place = uniform_in_cell(center, self.cell_m, rng);
                Pose2::new(place, rng.random_range(-PI..PI))
            })
            .collect()
    }
}

/// Poses around a given one, in the axes of the map.
pub fn around(pose: &Pose2, count: usize, start: &StartSpread, rng: &mut impl Rng) -> Vec<Pose2> {
    let mut draw = |bound: f64| -> f64 {
        let unit: f64 = match start.distribution {
            Distribution1::Uniform => rng.random_range(-1.0..=1.0),
            Distribution1::Gaussian => StandardNormal.sample(rng),
        };
        bound * unit
    };
    (0..count)
        .map(|_| {
            let offset = Vector2::new(draw(start.position_m), draw(start.position_m));
            let turn_rad = draw(start.heading_rad);
            Pose2::new(
                pose.translation.vector + offset,
                pose.rotation.angle() + turn_rad,
            )
        })
        .collect()
}

/// A position anywhere in a square cell [m].
pub fn uniform_in_cell(center: Point2<f64>, cell_m: f64, rng: &mut impl Rng) -> Vector2<f64> {
    let half_m = 0.5 * cell_m;
    let mut offset = || rng.random_range(-half_m..=half_m);
    center.coords + Vector2::new(offset(), offset())
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use rand::{SeedableRng, rngs::StdRng};

    use super::*;
    use crate::geometry::{Pose3, wrap_angle};
    use crate::map::TileConfig;

    fn road() -> Vec<Pose2> {
        (0..40)
            .map(|i| Pose2::translation(f64::from(i) - 7.3, 0.4))
            .collect()
    }

    #[test]
    fn a_uniform_start_fills_its_bounds_and_keeps_within_them() {
        let pose = Pose2::new(Vector2::new(10.0, -3.0), 3.0);
        let mut rng = StdRng::seed_from_u64(1);
        let poses = around(&pose, 20_000, &StartSpread::default(), &mut rng);
        let bound = 30.0_f64.to_radians();
        let turns: Vec<f64> = poses
            .iter()
            .map(|p| wrap_angle(p.rotation.angle() - 3.0))
            .collect();
        let x: Vec<f64> = poses.iter().map(|p| p.translation.x - 10.0).collect();
        for (values, bound) in [(turns, bound), (x, 5.0)] {
            assert!(values.iter().all(|v| v.abs() <= bound + 1e-12));
            let n = values.len() as f64;
            let variance = values.iter().map(|v| v * v).sum::<f64>() / n;
            // Variance of the uniform distribution; its fourth moment gives the standard error.
            let error = bound.powi(2) * (1.0_f64 / 5.0 - 1.0 / 9.0).sqrt() / n.sqrt();
            assert_relative_eq!(variance, bound * bound / 3.0, epsilon = 4.0 * error);
        }
    }

    #[test]
    fn a_gaussian_start_has_its_standard_deviation() {
        let start = StartSpread {
            distribution: Distribution1::Gaussian,
            position_m: 0.5,
            heading_rad: 0.1,
        };
        let mut rng = StdRng::seed_from_u64(2);
        let poses = around(&Pose2::identity(), 20_000, &start, &mut rng);
        let n = poses.len() as f64;
        let sigma = (poses.iter().map(|p| p.translation.y.powi(2)).sum::<f64>() / n).sqrt();
        assert_relative_eq!(sigma, 0.5, epsilon = 4.0 * 0.5 / (2.0 * n).sqrt());
    }

    #[test]
    fn road_cells_are_near_the_road_and_cover_it() {
        let cells = Cells::along_road(&road(), 2.0, 0.2);
        let distance = |place: &Point2<f64>| {
            road()
                .iter()
                .map(|pose| (place.coords - pose.translation.vector).norm())
                .fold(f64::INFINITY, f64::min)
        };
        assert!(cells.centers.iter().all(|center| distance(center) <= 2.0));
        let area = cells.centers.len() as f64 * 0.04;
        // 39 m of road, 4 m wide (a little less between the poses), and a half disc at either end.
        assert_relative_eq!(area, 39.0 * 4.0 + PI * 4.0, max_relative = 0.06);
        let mut sorted = cells.centers.clone();
        sorted.dedup();
        assert_eq!(sorted.len(), cells.centers.len());
    }

    #[test]
    fn a_finer_road_grid_covers_the_same_road() {
        let area = |cell_m: f64| {
            Cells::along_road(&road(), 2.0, cell_m).centers.len() as f64 * cell_m * cell_m
        };
        assert_relative_eq!(area(0.1), area(0.2), max_relative = 0.02);
    }

    #[test]
    fn map_cells_have_ground_and_a_valid_tile() {
        let poses: Vec<Pose3> = (0..100)
            .map(|i| Pose3::translation(f64::from(i), 0.0, 0.0))
            .collect();
        let tiles = TileGrid::around(&poses, &TileConfig::default());
        let ground = GroundMap::flat(Point2::new(-20.0, -20.0), Point2::new(60.0, 20.0), -1.7);
        let cells = Cells::over_map(&tiles, &ground, 1.0);
        assert!(!cells.centers.is_empty());
        for center in &cells.centers {
            let pose = Pose2::from(center.coords);
            assert!(ground.patch_under(&pose, None).is_some());
            assert!(tiles.valid_tile_of(&pose).is_some());
        }
        let area = cells.centers.len() as f64;
        assert_relative_eq!(area, 80.0 * 40.0, max_relative = 0.05);
    }

    #[test]
    fn a_global_start_takes_every_heading() {
        let cells = Cells::along_road(&road(), 2.0, 0.2);
        let poses = cells.sample(8_000, &mut StdRng::seed_from_u64(3));
        let mut sectors = [0_u32; 8];
        for pose in &poses {
            let turn = (pose.rotation.angle() + PI) / (2.0 * PI);
            sectors[((turn * 8.0) as usize).min(7)] += 1;
        }
        // Binomial: 1000 ± 30 each.
        assert!(
            sectors.iter().all(|&n| (880..1120).contains(&n)),
            "{sectors:?}"
        );
        assert_eq!(
            Cells {
                centers: vec![],
                cell_m: 1.0
            }
            .sample(5, &mut StdRng::seed_from_u64(1)),
            []
        );
    }
}
