//! The finishing step: a few Gauss-Newton iterations on the distances between the returns of a
//! scan and the surfaces of the map.
//!
//! ```text
//! rᵢ(x) = (rendered_i(x) − measured_i) / √(1 + |∂rᵢ/∂t|²)      about the distance to the plane [m]
//! Σ wᵢ Jᵢᵀ Jᵢ δ = − Σ wᵢ Jᵢᵀ rᵢ          wᵢ = (1 + rᵢ²/c²)⁻²      Geman and McClure
//! ```
//!
//! The slope of every beam is a central difference of rendered ranges, so that any renderer will
//! do. A beam whose forward and backward slope disagree looks over an edge and is left out. In x,
//! y and heading on the map's ground, or in all six degrees of freedom, which also finds the tilt
//! and the height of the car. Point-to-plane registration: Chen and Medioni (1992).

use nalgebra::{Matrix6, UnitQuaternion, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use super::objective::FrameObjective;
use crate::geometry::{Pose3, Vec3};
use crate::lidar::Beam;
use crate::rendering::RenderError;

/// What the step may change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Freedom {
    /// x, y and heading, along the plane of the road.
    Planar,
    /// Also height, roll and pitch.
    Spatial,
}

/// Settings of the finishing step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GaussNewtonConfig {
    /// What it may change.
    pub freedom: Freedom,
    /// Iterations, at most.
    pub iterations: usize,
    /// Scale c of the robust kernel: a residual of c weighs a quarter [m].
    pub kernel_m: f64,
    /// Step of the differences in position [m].
    pub step_m: f64,
    /// Step of the differences in rotation [rad].
    pub step_rad: f64,
    /// It ends when a step is shorter than this [m], at a lever of ten metres for rotations.
    pub tolerance_m: f64,
    /// A single beam is worth this share of an independent measurement (unitless); neighbours see
    /// the same surface with the same error.
    pub independence: f64,
}

impl Default for GaussNewtonConfig {
    /// Our own values.
    fn default() -> Self {
        Self {
            freedom: Freedom::Planar,
            iterations: 5,
            kernel_m: 0.1,
            step_m: 0.02,
            step_rad: 0.001,
            tolerance_m: 5e-4,
            independence: 0.02,
        }
    }
}

/// Where the step ended.
#[derive(Clone, Debug, PartialEq)]
pub struct Finish {
    /// `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Pose3,
    /// Covariance of (x, y, z, roll, pitch, yaw) in the lidar frame; zero in what was not free.
    pub covariance: Matrix6<f64>,
    /// Beams that took part in the last iteration.
    pub beams: usize,
}

/// One beam, linearized.
struct Row {
    residual_m: f64,
    jacobian: Vector6<f64>,
}

/// Moves a pose to where the returns lie on the surfaces; `None` where the beams do not determine
/// it. The caller compares the objective before and after.
pub fn finish(
    objective: &FrameObjective<'_>,
    start: &Pose3,
    config: &GaussNewtonConfig,
) -> Result<Option<Finish>, RenderError> {
    let mut pose = *start;
    let mut last = None;
    for _ in 0..config.iterations {
        let rows = linearize(objective, &pose, config)?;
        let Some((step, covariance)) = solve(&rows, config) else {
            return Ok(None);
        };
        pose *= transform(&step);
        last = Some(Finish {
            map_from_lidar: pose,
            covariance,
            beams: rows.len(),
        });
        let (shift, turn) = (
            step.fixed_rows::<3>(0).norm(),
            step.fixed_rows::<3>(3).norm(),
        );
        if shift + 10.0 * turn < config.tolerance_m {
            break;
        }
    }
    Ok(last)
}

/// A small motion in the lidar frame: shift [m], rotation vector [rad].
fn transform(step: &Vector6<f64>) -> Pose3 {
    Pose3::from_parts(
        Vector3::new(step[0], step[1], step[2]).into(),
        UnitQuaternion::from_scaled_axis(Vector3::new(step[3], step[4], step[5])),
    )
}

/// Residuals and slopes of all beams that see one smooth surface.
fn linearize(
    objective: &FrameObjective<'_>,
    pose: &Pose3,
    config: &GaussNewtonConfig,
) -> Result<Vec<Row>, RenderError> {
    let steps: [f64; 6] = std::array::from_fn(|axis| {
        if axis < 3 {
            config.step_m
        } else {
            config.step_rad
        }
    });
    let mut poses = vec![*pose];
    for (axis, step) in steps.iter().enumerate() {
        poses.push(pose * transform(&Vector6::ith(axis, *step)));
        poses.push(pose * transform(&Vector6::ith(axis, -step)));
    }
    let directions: Vec<Vec3> = objective.beams.iter().map(|beam| beam.direction).collect();
    let ranges = objective.renderer.cast(&poses, &directions)?;
    let rows = objective
        .beams
        .iter()
        .enumerate()
        .filter_map(|(number, beam)| {
            let seen = |pose: usize| f64::from(ranges[pose][number]);
            row(beam, seen, &steps, config)
        });
    Ok(rows.collect())
}

/// One beam; `None` where it meets nothing, is far off, or looks over an edge.
fn row(
    beam: &Beam,
    seen: impl Fn(usize) -> f64,
    steps: &[f64; 6],
    config: &GaussNewtonConfig,
) -> Option<Row> {
    /// Farther than this many kernels a return belongs to something else.
    const FAR: f64 = 5.0;
    let here = seen(0);
    let mut slopes = Vector6::zeros();
    for (axis, step) in steps.iter().enumerate() {
        let (ahead, behind) = (seen(1 + 2 * axis), seen(2 + 2 * axis));
        let slope = (ahead - behind) / (2.0 * step);
        let bend = ahead + behind - 2.0 * here;
        // On a plane the bend is of second order; over an edge it is as large as the jump.
        let is_smooth = bend.abs() <= 0.2 * (ahead - behind).abs() + 0.1 * config.step_m;
        if !is_smooth || !slope.is_finite() {
            return None;
        }
        slopes[axis] = slope;
    }
    // The slope along the shifts is that of the plane: its normal over the cosine of incidence.
    let steepness = slopes.fixed_rows::<3>(0).norm().max(1.0);
    let residual_m = (here - f64::from(beam.range_m)) / steepness;
    (residual_m.abs() < FAR * config.kernel_m).then(|| Row {
        residual_m,
        jacobian: slopes / steepness,
    })
}

/// The step that the rows ask for, and its covariance; `None` where they do not determine it.
fn solve(rows: &[Row], config: &GaussNewtonConfig) -> Option<(Vector6<f64>, Matrix6<f64>)> {
    let free = match config.freedom {
        Freedom::Planar => [true, true, false, false, false, true],
        Freedom::Spatial => [true; 6],
    };
    let mut normal = Matrix6::zeros();
    let mut right_side = Vector6::zeros();
    let (mut squares, mut weights) = (0.0, 0.0);
    for row in rows {
        let jacobian =
            Vector6::from_fn(|axis, _| if free[axis] { row.jacobian[axis] } else { 0.0 });
        let weight = (1.0 + (row.residual_m / config.kernel_m).powi(2)).powi(-2);
        normal += weight * jacobian * jacobian.transpose();
        right_side -= weight * row.residual_m * jacobian;
        squares += weight * row.residual_m.powi(2);
        weights += weight;
    }
    for (axis, is_free) in free.iter().enumerate() {
        if !is_free {
            normal[(axis, axis)] = 1.0;
        }
    }
    let cholesky = normal.cholesky()?;
    let step = cholesky.solve(&right_side);
    let mut covariance = cholesky.inverse() * (squares / weights / config.independence);
    for (axis, is_free) in free.iter().enumerate() {
        if !is_free {
            covariance[(axis, axis)] = 0.0;
        }
    }
    step.iter()
        .all(|value| value.is_finite())
        .then_some((step, covariance))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;
    use crate::geometry::Pose2;
    use crate::map::Stance;
    use crate::rendering::test_world::TestWorld;

    fn beams(world: &TestWorld, truth: &Pose2) -> Vec<Beam> {
        world.scan(truth).beams().step_by(3).collect()
    }

    #[test]
    fn from_ten_centimetres_and_half_a_degree_it_finds_the_truth() {
        let world = TestWorld::street();
        let truth = world.pose_at(5.0, 0.3, 0.1);
        let beams = beams(&world, &truth);
        let objective = world.objective(&beams);
        let off = truth * Pose2::new(nalgebra::Vector2::new(0.1, -0.08), 0.009);
        let start = objective.lift(&off, None).unwrap();
        let finish = finish(&objective, &start, &GaussNewtonConfig::default())
            .unwrap()
            .unwrap();
        let expected = objective.lift(&truth, None).unwrap();
        assert_relative_eq!(finish.map_from_lidar, expected, epsilon = 3e-3);
    }

    #[test]
    fn with_six_degrees_of_freedom_it_finds_the_tilt_too() {
        let world = TestWorld::street();
        let truth = world.pose_at(25.0, -0.3, -0.1);
        let beams = beams(&world, &truth);
        let objective = world.objective(&beams);
        let expected = objective.lift(&truth, None).unwrap();
        let off = Vector6::new(0.05, 0.05, 0.05, 0.01, -0.01, 0.005);
        let config = GaussNewtonConfig {
            freedom: Freedom::Spatial,
            iterations: 10,
            ..GaussNewtonConfig::default()
        };
        let start = expected * transform(&off);
        let finish = finish(&objective, &start, &config).unwrap().unwrap();
        assert_relative_eq!(finish.map_from_lidar, expected, epsilon = 3e-3);
        assert!(finish.covariance.cholesky().is_some());
    }

    #[test]
    fn at_the_truth_it_stays() {
        let world = TestWorld::street();
        let truth = world.pose_at(40.0, 0.0, 0.0);
        let beams = beams(&world, &truth);
        let objective = world.objective(&beams);
        let start = objective.lift(&truth, None).unwrap();
        let finish = finish(&objective, &start, &GaussNewtonConfig::default())
            .unwrap()
            .unwrap();
        assert_relative_eq!(finish.map_from_lidar, start, epsilon = 1e-3);
    }

    #[test]
    fn without_beams_nothing_is_determined() {
        let world = TestWorld::street();
        let objective = FrameObjective {
            stance: Stance::default(),
            ..world.objective(&[])
        };
        let start = objective.lift(&world.pose_at(0.0, 0.0, 0.0), None).unwrap();
        assert_eq!(
            finish(&objective, &start, &GaussNewtonConfig::default()).unwrap(),
            None
        );
    }
}
