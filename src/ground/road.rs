//! The plane of the road around the car, from which the sensor attitude follows: height, roll and
//! pitch above ground.

use glam::{DMat3, DVec3, Vec3};
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::validation::{InvalidValue, Validate, fraction, in_range, positive};

/// The plane of the ground around the sensor, in the lidar frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoadPlane {
    /// Unit normal, up.
    pub up: Vec3,
    /// Distance of the sensor above the plane [m].
    pub height_m: f64,
}

/// Ground from which the plane of the road is computed.
///
/// Defaults: our own values.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct RoadConfig {
    /// Radius around the sensor within which the road is taken as plane [m].
    #[default(12.0)]
    pub road_radius_m: f32,
    /// Standard deviation of the weight over the distance, so that the road outweighs what lies next to it [m].
    #[default(5.0)]
    pub nearness_m: f64,
    /// Least confidence of a point of the ground, 0 to 1.
    #[default(0.5)]
    pub min_confidence: f32,
    /// Least number of cells of 0.5 m with ground; with fewer there is no plane.
    #[default(30)]
    pub min_ground_cells: usize,
    /// Least variance of their positions in the narrowest direction: a strip on one side of the sensor determines no
    /// tilt [m²].
    #[default(0.5)]
    pub min_width_m2: f64,
}

impl Validate for RoadConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        in_range("road_radius_m", self.road_radius_m, 1.0..=200.0)?;
        positive("nearness_m", self.nearness_m)?;
        fraction("min_confidence", self.min_confidence)?;
        in_range("min_ground_cells", self.min_ground_cells, 3..=100_000)?;
        positive("min_width_m2", self.min_width_m2)
    }
}

/// Scales of Tukey's weights, from where the tilt is unknown down to where a kerb is an outlier [m].
const SCALES_M: [f64; 12] = [
    0.3, 0.2, 0.13, 0.09, 0.06, 0.04, 0.03, 0.02, 0.02, 0.02, 0.02, 0.02,
];
/// Edge of the cells in which points are averaged, so that dense rings near the car do not
/// outweigh the rest [m].
const CELL_M: f32 = 0.5;
/// Number of points from which on a cell of more is not more certain.
const MOST_COUNTED: f64 = 8.0;

/// Fits the plane of the ground around the sensor: least squares with Tukey's weights over
/// cells of 0.5 m, weighted by the confidences of the points.
///
/// `None` where there is too little ground, or only on one side of the sensor.
pub fn road_plane(points: &[Vec3], confidences: &[f32], config: &RoadConfig) -> Option<RoadPlane> {
    let cells = ground_cells(points, confidences, config);
    if cells.len() < config.min_ground_cells {
        return None;
    }
    let mut heights: Vec<f64> = cells.iter().map(|cell| cell.point.z).collect();
    heights.sort_by(f64::total_cmp);
    // z = a + b x + c y
    let mut plane = DVec3::new(heights[heights.len() / 2], 0.0, 0.0);
    for scale_m in SCALES_M {
        plane = weighted_fit(&cells, plane, scale_m, config.min_width_m2)?;
    }
    let up = DVec3::new(-plane.y, -plane.z, 1.0).normalize();
    Some(RoadPlane {
        up: up.as_vec3(),
        height_m: -plane.x * up.z,
    })
}

struct GroundCell {
    point: DVec3,
    weight: f64,
}

/// Computes mean position and weight of the ground per cell, in the order of the cells.
fn ground_cells(points: &[Vec3], confidences: &[f32], config: &RoadConfig) -> Vec<GroundCell> {
    let radius_m = config.road_radius_m;
    let across = (2.0 * radius_m / CELL_M) as usize;
    let mut sums = vec![(DVec3::ZERO, 0.0, 0.0); across * across];
    for (&point, &confidence) in points.iter().zip(confidences) {
        let near = point.x * point.x + point.y * point.y < radius_m * radius_m;
        if !near || confidence < config.min_confidence || !point.z.is_finite() {
            continue;
        }
        let column = ((point.x + radius_m) / CELL_M) as usize;
        let row = ((point.y + radius_m) / CELL_M) as usize;
        let sum = &mut sums[row.min(across - 1) * across + column.min(across - 1)];
        let weight = f64::from(confidence);
        sum.0 += weight * point.as_dvec3();
        sum.1 += weight;
        sum.2 += 1.0;
    }
    sums.into_iter()
        .filter(|&(_, _, count)| count > 0.0)
        .map(|(sum, weight, count): (DVec3, f64, f64)| GroundCell {
            point: sum / weight,
            // A cell of many points is more certain, but not in proportion to their number.
            weight: weight / count
                * count.min(MOST_COUNTED)
                * nearness(sum / weight, config.nearness_m),
        })
        .collect()
}

fn nearness(point: DVec3, nearness_m: f64) -> f64 {
    (-0.5 * point.truncate().length_squared() / (nearness_m * nearness_m)).exp()
}

/// One step of iteratively reweighted least squares with Tukey's biweight.
fn weighted_fit(
    cells: &[GroundCell],
    plane: DVec3,
    scale_m: f64,
    min_width_m2: f64,
) -> Option<DVec3> {
    /// 95 % efficiency for normal residuals.
    const TUKEY: f64 = 4.685;
    let mut matrix = DMat3::ZERO;
    let mut right = DVec3::ZERO;
    for GroundCell { point, weight } in cells {
        let residual = point.z - plane.x - plane.y * point.x - plane.z * point.y;
        let u = residual / (TUKEY * scale_m);
        if u.abs() < 1.0 {
            let weight = weight * (1.0 - u * u).powi(2);
            let row = DVec3::new(1.0, point.x, point.y);
            matrix += DMat3::from_cols(row, row * row.y, row * row.z) * weight;
            right += row * point.z * weight;
        }
    }
    let weight = matrix.x_axis.x;
    let variance = |sum: f64, squares: f64| squares / weight - (sum / weight).powi(2);
    let spread =
        variance(matrix.x_axis.y, matrix.y_axis.y) + variance(matrix.x_axis.z, matrix.z_axis.z);
    // About the variance of the positions in their narrowest direction [m²].
    let narrowest = matrix.determinant() / weight.powi(3) / spread;
    (narrowest > min_width_m2).then(|| matrix.inverse() * right)
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    use super::*;

    /// Points on a tilted road, with 2 cm of noise, seen from `height_m` above it.
    fn road(up: Vec3, height_m: f32) -> Vec<Vec3> {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        (0..20_000)
            .map(|_| {
                let (x, y) = (rng.random_range(-15.0..15.0), rng.random_range(-15.0..15.0));
                let noise: f32 = (0..4).map(|_| rng.random_range(-0.02..0.02_f32)).sum();
                let z = (-height_m - up.x * x - up.y * y) / up.z + noise;
                Vec3::new(x, y, z)
            })
            .collect()
    }

    #[test]
    fn tilt_and_height_of_a_noisy_road_are_recovered() {
        for (tilt, height_m) in [
            (Vec3::Z, 1.73),
            (Vec3::new(0.05, -0.03, 1.0).normalize(), 2.1),
        ] {
            let points = road(tilt, height_m);
            let plane =
                road_plane(&points, &vec![1.0; points.len()], &RoadConfig::default()).unwrap();
            assert!(
                plane.up.angle_between(tilt).to_degrees() < 0.05,
                "{plane:?}"
            );
            assert!(
                (plane.height_m - f64::from(height_m)).abs() < 0.005,
                "{plane:?}"
            );
        }
    }

    #[test]
    fn a_sidewalk_and_false_positives_do_not_bias_the_plane() {
        let mut points = road(Vec3::Z, 1.73);
        for point in &mut points {
            if point.y > 4.0 {
                point.z += 0.15;
            }
            if point.x > 9.0 && point.y < 0.0 {
                point.z += 0.4;
            }
        }
        let plane = road_plane(&points, &vec![0.9; points.len()], &RoadConfig::default()).unwrap();
        assert!(
            plane.up.angle_between(Vec3::Z).to_degrees() < 0.1,
            "{plane:?}"
        );
        assert!((plane.height_m - 1.73).abs() < 0.01, "{plane:?}");
    }

    #[test]
    fn no_plane_without_ground_or_with_a_narrow_strip_of_it() {
        let points = road(Vec3::Z, 1.73);
        assert_eq!(
            road_plane(&points, &vec![0.1; points.len()], &RoadConfig::default()),
            None
        );
        assert_eq!(road_plane(&[], &[], &RoadConfig::default()), None);
        let nan = vec![Vec3::NAN; 100];
        assert_eq!(road_plane(&nan, &[1.0; 100], &RoadConfig::default()), None);
        let strip: Vec<Vec3> = points
            .into_iter()
            .filter(|point| point.y.abs() < 0.5)
            .collect();
        let plane = |config| road_plane(&strip, &vec![1.0; strip.len()], &config);
        assert_eq!(plane(RoadConfig::default()), None);
        let narrow = RoadConfig {
            min_width_m2: 0.01,
            ..RoadConfig::default()
        };
        assert!(plane(narrow).is_some());
        let large = RoadConfig {
            min_ground_cells: 10_000,
            ..narrow
        };
        assert_eq!(plane(large), None);
    }
}
