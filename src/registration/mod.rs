//! A scan laid onto the map: a few Gauss-Newton iterations on the distances between the returns
//! and the surfaces that their beams meet.
//!
//! ```text
//! rᵢ = nᵢ · (map_from_lidar qᵢ − sᵢ)                      return q, surface s with normal n [m]
//! ∂rᵢ / ∂(shift, turn) = (nᵢ, qᵢ × nᵢ)                    n in the lidar frame
//! Σ wᵢ Jᵢᵀ Jᵢ δ = − Σ wᵢ Jᵢᵀ rᵢ        wᵢ = (1 + rᵢ²/c²)⁻²       Geman and McClure
//! ```
//!
//! One cast per iteration: what a beam meets is where its return should lie (projective
//! association), and the plane of the triangle gives the slope. In x, y and heading, or in all six
//! degrees of freedom, which also finds the tilt and the height of the car.
//!
//! Neighbouring returns see the same surface, with the same error of the map: they err together. How
//! much so, the residuals say themselves. They are summed by sectors of the azimuth, which err on their
//! own, whatever the returns within one have in common (cluster-robust covariance):
//!
//! ```text
//! Σ = H⁻¹ (σ² H + Σₖ gₖ gₖᵀ) H⁻¹ + M        H = Σ wᵢ Jᵢᵀ Jᵢ,   gₖ = Σ_{i in sector k} wᵢ Jᵢᵀ rᵢ
//! ```
//!
//! White, *A Heteroskedasticity-Consistent Covariance Matrix Estimator* (1980), and Liang and Zeger,
//! *Longitudinal Data Analysis Using Generalized Linear Models* (1986), for sums over clusters. The
//! first term, the covariance of independent returns, stands in for what sectors that are too few
//! cannot tell; M is by how much the map as a whole may be off. Chen and Medioni,
//! *Object Modelling by Registration of Multiple Range Images* (1992), for point to plane; Blais
//! and Levine (1995) for the association along beams.

use nalgebra::{Matrix3, Matrix6, UnitQuaternion, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use crate::geometry::{Pose3, Rigid3f, Vec3};
use crate::lidar::Beam;
use crate::rendering::{RangeRenderer, RenderError, SurfaceHit};
use crate::validation::{InvalidValue, Validate, at_least_one, not_negative, positive};

/// What registration may change.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Freedom {
    /// x, y and heading, along the plane of the road.
    Planar,
    /// Also height, roll and pitch.
    Spatial,
}

/// Settings of the registration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RegistrationConfig {
    /// What it may change.
    pub freedom: Freedom,
    /// Iterations, at most.
    pub iterations: usize,
    /// Scale c of the robust kernel: a residual of c weighs a quarter [m].
    pub kernel_m: f64,
    /// It ends when a step is shorter than this [m], at a lever of ten metres for rotations.
    pub tolerance_m: f64,
    /// Parts of the circle, the returns within each of which err together: for the covariance.
    pub sectors: usize,
    /// Standard deviation by which all surfaces in view may be off together, per axis [m]. Residuals
    /// do not show it, for the scan follows. A thirtieth of the cells of 9 cm that maps have: along
    /// simulated maps they are off by 3 to 4 mm for tens of metres.
    pub map_error_m: f64,
}

impl Default for RegistrationConfig {
    /// Our own values; from a degree and a half away it takes up to ten iterations.
    fn default() -> Self {
        Self {
            freedom: Freedom::Spatial,
            iterations: 12,
            kernel_m: 0.1,
            tolerance_m: 1e-3,
            sectors: 24,
            map_error_m: 0.003,
        }
    }
}

impl Validate for RegistrationConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        at_least_one("iterations", self.iterations)?;
        positive("kernel_m", self.kernel_m)?;
        not_negative("tolerance_m", self.tolerance_m)?;
        at_least_one("sectors", self.sectors)?;
        not_negative("map_error_m", self.map_error_m)
    }
}

/// Where the scan came to lie.
#[derive(Clone, Debug, PartialEq)]
pub struct Registration {
    /// `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Pose3,
    /// Covariance of (x, y, z, roll, pitch, yaw) in the lidar frame; zero in what was not free.
    pub covariance: Matrix6<f64>,
    /// Iterations, one ray per beam each.
    pub iterations: usize,
}

impl Registration {
    /// Covariance of (x, y, heading) seen from above, in the axes of the map [m², m·rad, rad²].
    pub fn planar_covariance(&self) -> Matrix3<f64> {
        let rotation = self.map_from_lidar.rotation.to_rotation_matrix();
        let mut map_from_lidar = Matrix6::zeros();
        for corner in [0, 3] {
            map_from_lidar
                .fixed_view_mut::<3, 3>(corner, corner)
                .copy_from(rotation.matrix());
        }
        let in_map = map_from_lidar * self.covariance * map_from_lidar.transpose();
        Matrix3::from_fn(|row, column| {
            let axes = [0, 1, 5];
            in_map[(axes[row], axes[column])]
        })
    }
}

/// One beam, linearized.
struct Row {
    residual_m: f64,
    jacobian: Vector6<f64>,
    sector: usize,
}

/// Moves a pose to where the returns lie on the surfaces; `None` where the beams do not determine
/// it. Whether the result is better is for the caller to judge.
pub fn register(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    start: &Pose3,
    config: &RegistrationConfig,
) -> Result<Option<Registration>, RenderError> {
    /// Lever of rotations [m].
    const LEVER_M: f64 = 10.0;
    let directions: Vec<Vec3> = beams.iter().map(|beam| beam.direction).collect();
    let mut pose = *start;
    let mut last = None;
    for iteration in 1..=config.iterations {
        let rows = linearize(renderer, beams, &directions, &pose, config)?;
        let Some((step, covariance)) = solve(&rows, config) else {
            return Ok(None);
        };
        pose *= transform(&step);
        last = Some(Registration {
            map_from_lidar: pose,
            covariance,
            iterations: iteration,
        });
        let shift_m = step.fixed_rows::<3>(0).norm();
        let turn_rad = step.fixed_rows::<3>(3).norm();
        if shift_m + LEVER_M * turn_rad < config.tolerance_m {
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

/// Residuals and slopes of all beams whose return is near the surface that they meet.
fn linearize(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    directions: &[Vec3],
    pose: &Pose3,
    config: &RegistrationConfig,
) -> Result<Vec<Row>, RenderError> {
    let surfaces = renderer.surfaces(pose, directions)?;
    let lidar_from_map = Rigid3f::from(&pose.inverse());
    let row = |(beam, surface): (&Beam, &Option<SurfaceHit>)| {
        let surface = surface.as_ref()?;
        row(beam, surface, &lidar_from_map, config)
    };
    Ok(beams.iter().zip(&surfaces).filter_map(row).collect())
}

/// One beam; `None` where its return belongs to something else than the surface.
fn row(
    beam: &Beam,
    surface: &SurfaceHit,
    lidar_from_map: &Rigid3f,
    config: &RegistrationConfig,
) -> Option<Row> {
    /// Farther than this many kernels from the plane a return belongs to something else.
    const FAR: f64 = 5.0;
    /// And farther than this many along the beam, however flat the beam meets the plane.
    const FAR_ALONG: f64 = 20.0;
    let normal = lidar_from_map.rotate(surface.normal_in_map);
    let excess_m = f64::from(beam.range_m - surface.range_m);
    let residual_m = excess_m * f64::from(normal.dot(beam.direction));
    if residual_m.abs() > FAR * config.kernel_m || excess_m.abs() > FAR_ALONG * config.kernel_m {
        return None;
    }
    let lever = beam.point().cross(normal);
    let jacobian = [normal.x, normal.y, normal.z, lever.x, lever.y, lever.z];
    let turns = 0.5 + beam.direction.y.atan2(beam.direction.x) / std::f32::consts::TAU;
    Some(Row {
        residual_m,
        jacobian: Vector6::from(jacobian.map(f64::from)),
        sector: ((turns * config.sectors as f32) as usize).min(config.sectors - 1),
    })
}

/// The step that the rows ask for, and its covariance; `None` where they do not determine it.
fn solve(rows: &[Row], config: &RegistrationConfig) -> Option<(Vector6<f64>, Matrix6<f64>)> {
    /// Fewer beams than this tell nothing.
    const ENOUGH: usize = 30;
    if rows.len() < ENOUGH {
        return None;
    }
    let free = match config.freedom {
        Freedom::Planar => [1.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        Freedom::Spatial => [1.0; 6],
    };
    let free = Vector6::from(free);
    let mut normal = Matrix6::zeros();
    let mut right_side = Vector6::zeros();
    let mut of_sectors = vec![Vector6::zeros(); config.sectors];
    let (mut squares, mut weights) = (0.0, 0.0);
    for row in rows {
        let jacobian = row.jacobian.component_mul(&free);
        let weight = (1.0 + (row.residual_m / config.kernel_m).powi(2)).powi(-2);
        normal += weight * jacobian * jacobian.transpose();
        let pull = weight * row.residual_m * jacobian;
        right_side -= pull;
        of_sectors[row.sector] += pull;
        squares += weight * row.residual_m.powi(2);
        weights += weight;
    }
    normal += Matrix6::from_diagonal(&free.map(|free| 1.0 - free));
    let cholesky = normal.cholesky()?;
    let step = cholesky.solve(&right_side);
    let together: Matrix6<f64> = of_sectors.iter().map(|pull| pull * pull.transpose()).sum();
    let inverse = cholesky.inverse();
    let mut covariance = inverse * (squares / weights) + inverse * together * inverse;
    for axis in 0..3 {
        covariance[(axis, axis)] += config.map_error_m.powi(2);
    }
    for axis in 0..6 {
        covariance[(axis, axis)] *= free[axis];
    }
    step.iter()
        .all(|value| value.is_finite())
        .then_some((step, covariance))
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector2;

    use super::*;
    use crate::geometry::Pose2;
    use crate::map::Stance;
    use crate::rendering::test_world::TestWorld;

    fn beams(world: &TestWorld, truth: &Pose2) -> Vec<Beam> {
        world.scan(truth).beams().step_by(3).collect()
    }

    fn lift(world: &TestWorld, pose: &Pose2) -> Pose3 {
        world.ground.lift(pose, &Stance::default()).unwrap()
    }

    fn of_a_perfect_map() -> RegistrationConfig {
        RegistrationConfig {
            map_error_m: 0.0,
            ..RegistrationConfig::default()
        }
    }

    fn planar_only() -> RegistrationConfig {
        RegistrationConfig {
            freedom: Freedom::Planar,
            ..RegistrationConfig::default()
        }
    }

    #[test]
    fn from_ten_centimetres_and_half_a_degree_it_finds_the_truth() {
        let world = TestWorld::street();
        let truth = world.pose_at(5.0, 0.3, 0.1);
        let off = truth * Pose2::new(Vector2::new(0.1, -0.08), 0.009);
        for config in [planar_only(), RegistrationConfig::default()] {
            let found = register(&world, &beams(&world, &truth), &lift(&world, &off), &config);
            let found = found.unwrap().unwrap().map_from_lidar;
            assert_relative_eq!(found, lift(&world, &truth), epsilon = 3e-3);
        }
    }

    #[test]
    fn with_six_degrees_of_freedom_it_finds_the_tilt_too() {
        let world = TestWorld::street();
        let truth = world.pose_at(25.0, -0.3, -0.1);
        let expected = lift(&world, &truth);
        let off = transform(&Vector6::new(0.05, 0.05, 0.05, 0.01, -0.01, 0.005));
        let config = RegistrationConfig {
            iterations: 10,
            ..RegistrationConfig::default()
        };
        let beams = beams(&world, &truth);
        let found = register(&world, &beams, &(expected * off), &config);
        let found = found.unwrap().unwrap();
        assert_relative_eq!(found.map_from_lidar, expected, epsilon = 3e-3);
        assert!(found.covariance.cholesky().is_some());
    }

    #[test]
    fn at_the_truth_it_stays() {
        let world = TestWorld::street();
        let truth = world.pose_at(40.0, 0.0, 0.0);
        let start = lift(&world, &truth);
        let beams = beams(&world, &truth);
        let found = register(&world, &beams, &start, &RegistrationConfig::default());
        let found = found.unwrap().unwrap();
        assert_relative_eq!(found.map_from_lidar, start, epsilon = 1e-3);
        assert_eq!(found.iterations, 1);
    }

    #[test]
    fn a_planar_step_leaves_height_and_tilt_alone() {
        let world = TestWorld::street();
        let truth = world.pose_at(5.0, 0.3, 0.1);
        let start = lift(&world, &(truth * Pose2::translation(0.1, 0.05)));
        let found = register(&world, &beams(&world, &truth), &start, &planar_only());
        let found = found.unwrap().unwrap();
        assert_relative_eq!(
            found.map_from_lidar.translation.z,
            start.translation.z,
            epsilon = 1e-9
        );
        let (roll, pitch, _) = found.map_from_lidar.rotation.euler_angles();
        assert!(roll.abs() < 1e-9 && pitch.abs() < 1e-9);
        let axes: Vec<usize> = (0..6)
            .filter(|&axis| found.covariance[(axis, axis)] > 0.0)
            .collect();
        assert_eq!(axes, [0, 1, 5]);
    }

    #[test]
    fn a_car_turned_in_the_map_turns_its_covariance_with_it() {
        let straight = TestWorld::street();
        let turned = TestWorld::moved_street(Pose2::rotation(1.0));
        let covariance = |world: &TestWorld| {
            let truth = world.pose_at(12.0, 0.1, 0.0);
            let beams = beams(world, &truth);
            let start = lift(world, &truth);
            let found = register(world, &beams, &start, &RegistrationConfig::default());
            found.unwrap().unwrap().planar_covariance()
        };
        let (a, b) = (covariance(&straight), covariance(&turned));
        let turn = nalgebra::Rotation3::from_axis_angle(&Vector3::z_axis(), 1.0);
        let expected = turn.matrix() * a * turn.matrix().transpose();
        assert_relative_eq!(b, expected, epsilon = 0.05 * a.norm());
    }

    #[test]
    fn returns_that_err_together_are_worth_less_than_returns_that_err_alone() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.1, 0.0);
        let start = lift(&world, &truth);
        let sigmas = |error_m: &dyn Fn(usize, &Beam) -> f32| {
            let mut beams = beams(&world, &truth);
            for (number, beam) in beams.iter_mut().enumerate() {
                beam.range_m += error_m(number, beam);
            }
            let config = of_a_perfect_map();
            let found = register(&world, &beams, &start, &config).unwrap().unwrap();
            found.planar_covariance().diagonal().map(f64::sqrt)
        };
        let alone = sigmas(&|number, _| if number % 2 == 0 { 0.02 } else { -0.02 });
        let together = sigmas(&|_, beam| {
            let degrees = beam.direction.y.atan2(beam.direction.x).to_degrees();
            if (degrees / 15.0).floor() as i32 % 2 == 0 {
                0.02
            } else {
                -0.02
            }
        });
        for axis in 0..3 {
            assert!(together[axis] > 2.0 * alone[axis], "{together} {alone}");
        }
    }

    #[test]
    fn errors_of_white_noise_are_about_as_large_as_the_covariance_says() {
        use rand::{SeedableRng as _, rngs::StdRng};
        use rand_distr::{Distribution as _, StandardNormal};
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.1, 0.0);
        let start = lift(&world, &truth);
        let mut rng = StdRng::seed_from_u64(1);
        let (mut squares, trials) = (0.0, 60);
        for _ in 0..trials {
            let mut beams = beams(&world, &truth);
            for beam in &mut beams {
                let deviate: f32 = StandardNormal.sample(&mut rng);
                beam.range_m += 0.01 * deviate;
            }
            let config = of_a_perfect_map();
            let found = register(&world, &beams, &start, &config).unwrap().unwrap();
            let pose = crate::geometry::planar(&found.map_from_lidar);
            let off = pose.translation.vector - truth.translation.vector;
            let off =
                nalgebra::Vector3::new(off.x, off.y, (truth.inverse() * pose).rotation.angle());
            squares += off.dot(&(found.planar_covariance().try_inverse().unwrap() * off));
        }
        // Both terms hold white noise: twice the variance, so half of the three squares, or a little
        // more, for sums over few sectors scatter.
        let mean = squares / f64::from(trials);
        assert!((0.7..3.5).contains(&mean), "{mean}");
    }

    #[test]
    fn without_beams_nothing_is_determined() {
        let world = TestWorld::street();
        let start = lift(&world, &world.pose_at(0.0, 0.0, 0.0));
        let found = register(&world, &[], &start, &RegistrationConfig::default()).unwrap();
        assert_eq!(found, None);
    }
}
