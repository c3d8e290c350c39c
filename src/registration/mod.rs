//! Registration of a scan to the map: Gauss-Newton on the distances between the returns and the
//! surfaces that their beams hit.
//!
//! ```text
//! rᵢ = nᵢ · (map_from_lidar qᵢ − sᵢ)                      return q, surface s with normal n [m]
//! ∂rᵢ / ∂(translation, rotation) = (nᵢ, qᵢ × nᵢ)          n in the lidar frame
//! Σ wᵢ Jᵢᵀ Jᵢ δ = − Σ wᵢ Jᵢᵀ rᵢ        wᵢ: robust kernel
//! ```
//!
//! Each iteration casts one ray per beam; the hit is the correspondence of the return (projective
//! association), and the plane of its triangle gives the point-to-plane residual. Its step minimizes the robust cost of the
//! linearized residuals.
//!
//! Neighboring returns hit the same surface and share its map error, so their residuals are
//! correlated, and only sectors of the azimuth are taken as independent: the covariance is that of the jackknife, by the
//! shifts of the pose where one of K sectors is left out.
//!
//! ```text
//! Σ = σ² H⁻¹ + (K − 1) / K · Σₖ δₖ δₖᵀ        δₖ = (H − Hₖ)⁻¹ gₖ,   Hₖ = Σ wᵢ Jᵢᵀ Jᵢ,   gₖ = Σ wᵢ Jᵢᵀ rᵢ   of sector k
//! ```
//!
//! with the residuals after the step, and 0.95 of Hₖ: without all of it, what a sector alone determines would be unknown.
//!
//! Efron and Stein, *The Jackknife Estimate of Variance* (1981); Bell and McCaffrey, *Bias Reduction in Standard Errors for
//! Linear Regression with Multi-Stage Samples* (2002), for its use with clusters of which few determine a parameter. In the
//! covariance, the normals have noise: along a tunnel it would count as information, of W σₙ² for a sum W of weights, which
//! is taken off each horizontal direction (errors in variables: Fuller, *Measurement Error Models*, 1987). The first term,
//! the covariance of independent returns, keeps the estimate positive definite when few sectors have returns. The error that
//! the map has in all frames is none of it, see [`RegistrationConfig::of_map`]. Chen and Medioni, *Object
//! Modelling by Registration of Multiple Range Images* (1992), for point to plane; Blais and Levine
//! (1995) for projective association.

mod config;
mod information;
mod informative;

use nalgebra::{Matrix3, Matrix6, Vector6};

pub use self::config::RegistrationConfig;
use self::information::{Horizontal, Residual};
use crate::geometry::pose::exponential;
use crate::geometry::{Pose3, Rigid3f, RobustKernel, azimuth_sector};
use crate::lidar::Beam;
use crate::rendering::{RangeRenderer, RenderError, SurfaceHit};

/// Tolerance of a registration that another one continues [m].
const COARSE_TOLERANCE_M: f64 = 0.01;

/// Number of beams that [`approach`] registers.
const COARSE_BEAMS: usize = 2400;

/// A registered pose with its covariance.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct RegistrationResult {
    /// `p_map = map_from_lidar * p_lidar`.
    pub map_from_lidar: Pose3,
    /// Covariance of (x, y, z, roll, pitch, yaw) in the lidar frame [m, rad].
    pub covariance: Matrix6<f64>,
    /// Number of iterations of the last stage.
    pub iterations: usize,
}

impl RegistrationResult {
    /// Covariance of (x, y, heading) in the axes of the map [m², m·rad, rad²].
    pub(crate) fn planar_covariance(&self) -> Matrix3<f64> {
        let rotation = self.map_from_lidar.rotation.to_rotation_matrix();
        let mut map_from_lidar = Matrix6::zeros();
        for corner in [0, 3] {
            map_from_lidar
                .fixed_view_mut::<3, 3>(corner, corner)
                .copy_from(rotation.matrix());
        }
        let in_map = map_from_lidar * self.covariance * map_from_lidar.transpose();
        let axes = [0, 1, 5];
        Matrix3::from_fn(|row, column| in_map[(axes[row], axes[column])])
    }
}

/// Registers beams to the map, starting at `initial`; `None` if the beams do not determine the pose.
/// The caller has to check whether the result is an improvement.
pub(crate) fn register(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    initial: &Pose3,
    config: &RegistrationConfig,
) -> Result<Option<RegistrationResult>, RenderError> {
    let residuals = linearize(renderer, beams, initial, config)?;
    descend(renderer, beams, *initial, residuals, config)
}

/// Registers beams, starting at a pose with its residuals.
fn descend(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    mut pose: Pose3,
    mut residuals: Vec<Residual>,
    config: &RegistrationConfig,
) -> Result<Option<RegistrationResult>, RenderError> {
    let mut iterations = 0;
    loop {
        let Some(equations) = Equations::minimal(&residuals, config) else {
            return Ok(None);
        };
        let step = equations.determined_step();
        pose *= exponential(&step);
        iterations += 1;
        if length_m(&step) < config.tolerance_m || iterations >= config.iterations {
            let covariance = equations.covariance();
            return Ok(covariance.map(|covariance| RegistrationResult {
                map_from_lidar: pose,
                covariance,
                iterations,
            }));
        }
        residuals = linearize(renderer, beams, &pose, config)?;
    }
}

/// Length of a step; rotations have a lever of ten metres.
fn length_m(step: &Vector6<f64>) -> f64 {
    const LEVER_M: f64 = 10.0;
    step.fixed_rows::<3>(0).norm() + LEVER_M * step.fixed_rows::<3>(3).norm()
}

/// Registers some of many beams coarsely: a pose from which [`register_informative`] goes on. It is the initial one for few beams,
/// and where they do not determine the pose.
pub(crate) fn approach(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    initial: &Pose3,
    config: &RegistrationConfig,
) -> Result<Pose3, RenderError> {
    if beams.len() <= COARSE_BEAMS {
        return Ok(*initial);
    }
    let step = beams.len().div_ceil(COARSE_BEAMS);
    let some: Vec<Beam> = beams.iter().step_by(step).copied().collect();
    let coarse = config.with_tolerance(COARSE_TOLERANCE_M);
    let near = register(renderer, &some, initial, &coarse)?;
    Ok(near.map_or(*initial, |near| near.map_from_lidar))
}

/// Registers the most informative beams, see [`Linearized::registered`].
pub(crate) fn register_informative(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    near: &Pose3,
    config: &RegistrationConfig,
) -> Result<Option<RegistrationResult>, RenderError> {
    Linearized::at(renderer, beams, near, config)?.registered()
}

/// Many beams at a pose near the right one: it can be improved, or kept.
pub(crate) struct Linearized<'a> {
    renderer: &'a dyn RangeRenderer,
    beams: &'a [Beam],
    map_from_lidar: Pose3,
    config: &'a RegistrationConfig,
    residuals: Vec<Residual>,
}

impl<'a> Linearized<'a> {
    /// Finds what the beams hit from a pose.
    pub fn at(
        renderer: &'a dyn RangeRenderer,
        beams: &'a [Beam],
        map_from_lidar: &Pose3,
        config: &'a RegistrationConfig,
    ) -> Result<Self, RenderError> {
        Ok(Self {
            renderer,
            beams,
            map_from_lidar: *map_from_lidar,
            config,
            residuals: linearize(renderer, beams, map_from_lidar, config)?,
        })
    }

    /// The pose as it is. Its covariance contains the square of the step that it does not take. `None` if the beams do not
    /// determine the pose.
    pub fn kept(&self) -> Option<RegistrationResult> {
        let equations = Equations::new(&self.residuals, &Vector6::zeros(), self.config)?;
        let step = equations.determined_step();
        Some(RegistrationResult {
            map_from_lidar: self.map_from_lidar,
            covariance: equations.covariance()? + step * step.transpose(),
            iterations: 0,
        })
    }

    /// The pose registered by the 4,800 most informative beams, see [`informative::choose`], or by all if these are no more than
    /// [`approach`] takes. Where the pose turns out to be farther off, they are chosen after an approach. `None` if they do not
    /// determine it.
    pub fn registered(mut self) -> Result<Option<RegistrationResult>, RenderError> {
        const FINE: usize = 4800;
        /// Step up to which the right beams are chosen: half of the default scale of the kernel [m].
        const NEAR_M: f64 = 0.05;
        let is_near = |equations: Equations| length_m(&equations.determined_step()) <= NEAR_M;
        if self.beams.len() > COARSE_BEAMS
            && !Equations::new(&self.residuals, &Vector6::zeros(), self.config).is_some_and(is_near)
        {
            let Self {
                renderer,
                beams,
                config,
                ..
            } = self;
            let near = approach(renderer, beams, &self.map_from_lidar, config)?;
            self = Self::at(renderer, beams, &near, config)?;
        }
        let Self {
            renderer,
            beams,
            map_from_lidar,
            config,
            residuals,
        } = self;
        if beams.len() <= COARSE_BEAMS {
            return descend(renderer, beams, map_from_lidar, residuals, config);
        }
        let residuals = informative::choose(residuals, FINE, config);
        let chosen: Vec<Beam> = (residuals.iter())
            .map(|residual| beams[residual.beam])
            .collect();
        descend(renderer, &chosen, map_from_lidar, residuals, config)
    }
}

/// Registers beams from farther away in two stages: the first of `beams` with a kernel of `wide_kernel_m`, then the second
/// as configured. Beams that do not determine the pose are passed over, and a pose that is not accepted ends it; the last accepted
/// one is returned, if any.
pub(crate) fn register_coarse_to_fine(
    renderer: &dyn RangeRenderer,
    beams: [&[Beam]; 2],
    initial: &Pose3,
    wide_kernel_m: f64,
    config: &RegistrationConfig,
    is_accepted: impl Fn(&Pose3) -> bool,
) -> Result<Option<RegistrationResult>, RenderError> {
    let wide = RegistrationConfig {
        kernel_m: config.kernel_m.max(wide_kernel_m),
        ..config.with_tolerance(COARSE_TOLERANCE_M)
    };
    let (mut pose, mut result) = (*initial, None);
    for (beams, config) in beams.into_iter().zip([&wide, config]) {
        let Some(found) = register(renderer, beams, &pose, config)? else {
            continue;
        };
        if !is_accepted(&found.map_from_lidar) {
            break;
        }
        pose = found.map_from_lidar;
        result = Some(found);
    }
    Ok(result)
}

/// Linearized residuals of all beams that pass the gates.
fn linearize(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    pose: &Pose3,
    config: &RegistrationConfig,
) -> Result<Vec<Residual>, RenderError> {
    /// Gate on the distance along the beam, in kernel widths, for grazing incidence.
    const GATE_ALONG: f64 = 20.0;
    let within_m = (GATE_ALONG * config.kernel_m) as f32;
    let hits = renderer.surfaces(pose, beams, within_m)?;
    let lidar_from_map = Rigid3f::from(&pose.inverse());
    let residual = |(number, (beam, hit)): (usize, (&Beam, &Option<SurfaceHit>))| {
        residual((number, beam), hit.as_ref()?, &lidar_from_map, config)
    };
    let pairs = beams.iter().zip(&hits).enumerate();
    Ok(pairs.filter_map(residual).collect())
}

/// The linearized residual of one beam; `None` if its return is too far from the plane of the hit to be a
/// correspondence.
fn residual(
    (number, beam): (usize, &Beam),
    hit: &SurfaceHit,
    lidar_from_map: &Rigid3f,
    config: &RegistrationConfig,
) -> Option<Residual> {
    /// Gate on the distance to the plane, in kernel widths.
    const GATE_ACROSS: f64 = 5.0;
    let normal = lidar_from_map.rotate(hit.normal_in_map);
    let excess_m = f64::from(beam.range_m - hit.range_m);
    let value_m = excess_m * f64::from(normal.dot(beam.direction));
    if value_m.abs() > GATE_ACROSS * config.kernel_m {
        return None;
    }
    let lever = beam.point().cross(normal);
    let jacobian = [normal.x, normal.y, normal.z, lever.x, lever.y, lever.z];
    Some(Residual {
        beam: number,
        value_m,
        jacobian: Vector6::from(jacobian.map(f64::from)),
        sector: azimuth_sector(beam.direction, config.sectors),
    })
}

/// Normal equations of the residuals at a pose, with their solution.
struct Equations {
    information: Matrix6<f64>,
    /// Parts of the sectors of the information and of the gradient.
    sectors: Vec<(Matrix6<f64>, Vector6<f64>)>,
    /// Variance of the residuals [m²].
    variance: f64,
    horizontal: Horizontal,
    step: Vector6<f64>,
}

impl Equations {
    /// The equations whose step has the least robust cost of the linearized residuals, by iteratively reweighted least squares: they
    /// have the weights of the residuals after the step, or nearly. Weights cost far less than rays.
    fn minimal(residuals: &[Residual], config: &RegistrationConfig) -> Option<Self> {
        /// Most rounds.
        const ROUNDS: usize = 5;
        /// Change of the step that ends them, in tolerances: they need no rays.
        const TOLERANCE: f64 = 0.1;
        let mut before = Vector6::zeros();
        let mut equations = Self::new(residuals, &before, config)?;
        for _ in 0..ROUNDS {
            let step = equations.determined_step();
            if length_m(&(step - before)) < TOLERANCE * config.tolerance_m {
                break;
            }
            before = step;
            let Some(reweighted) = Self::new(residuals, &step, config) else {
                break;
            };
            equations = reweighted;
        }
        Some(equations)
    }

    /// Equations with the weights of the linearized residuals after a step. `None` for too few residuals, or if the information
    /// matrix is singular.
    fn new(
        residuals: &[Residual],
        weighted_after: &Vector6<f64>,
        config: &RegistrationConfig,
    ) -> Option<Self> {
        /// Fewer residuals determine no pose.
        const MIN_RESIDUALS: usize = 30;
        if residuals.len() < MIN_RESIDUALS {
            return None;
        }
        let mut sectors = vec![(Matrix6::zeros(), Vector6::zeros()); config.sectors];
        let (mut squares, mut weights) = (0.0, 0.0);
        let kernel = RobustKernel {
            scale_m: config.kernel_m,
        };
        for residual in residuals {
            let jacobian = residual.jacobian;
            let after_m = residual.value_m + jacobian.dot(weighted_after);
            let weight = kernel.weight(after_m);
            let (of_sector, gradient) = &mut sectors[residual.sector];
            for column in 0..6 {
                let factor = weight * jacobian[column];
                for row in column..6 {
                    of_sector[(row, column)] += factor * jacobian[row];
                }
            }
            gradient.axpy(weight * residual.value_m, &jacobian, 1.0);
            squares += weight * after_m.powi(2);
            weights += weight;
        }
        for (of_sector, _) in &mut sectors {
            of_sector.fill_upper_triangle_with_lower_triangle();
        }
        let information: Matrix6<f64> = sectors.iter().map(|(of_sector, _)| of_sector).sum();
        let gradient: Vector6<f64> = sectors.iter().map(|(_, gradient)| gradient).sum();
        let step = -information.cholesky()?.solve(&gradient);
        let horizontal = Horizontal::new(&information, weights * config.normal_rad.powi(2))?;
        let is_finite = step.iter().all(|value| value.is_finite());
        is_finite.then_some(Self {
            information,
            sectors,
            variance: squares / weights,
            horizontal,
            step,
        })
    }

    /// The step without directions of which only noise is known.
    fn determined_step(&self) -> Vector6<f64> {
        self.horizontal.determined(self.step)
    }

    /// Covariance of the pose after the step; `None` if the information is singular.
    fn covariance(&self) -> Option<Matrix6<f64>> {
        /// Part of a sector that is left out: without all of it, what it alone determines would be unknown.
        const PART: f64 = 0.95;
        let corrected = self.horizontal.corrected(&self.information);
        let inverse = corrected.try_inverse()?;
        let to_shift = inverse * self.information;
        // How far the pose moves without a sector, to first order.
        let shift = |(of_sector, gradient): &(Matrix6<f64>, Vector6<f64>)| {
            let rest = (self.information - PART * of_sector).cholesky()?;
            let after_step = gradient + of_sector * self.step;
            Some(to_shift * rest.solve(&after_step))
        };
        let seen = (self.sectors.iter()).filter(|(of_sector, _)| of_sector.trace() > 0.0);
        let shifts: Vec<Vector6<f64>> = seen.map(shift).collect::<Option<_>>()?;
        let count = shifts.len() as f64;
        let outer_products: Matrix6<f64> = shifts.iter().map(|it| it * it.transpose()).sum();
        Some(inverse * self.variance + outer_products * ((count - 1.0) / count))
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector2;

    use super::*;
    use crate::geometry::Pose2;
    use crate::map::SensorAttitude;
    use crate::map::world_for_tests::TestWorld;

    fn beams(world: &TestWorld, truth: &Pose2) -> Vec<Beam> {
        world.scan(truth).beams().step_by(3).collect()
    }

    fn lift(world: &TestWorld, pose: &Pose2) -> Pose3 {
        world
            .ground
            .lift(pose, &SensorAttitude::default())
            .unwrap()
            .unwrap()
    }

    fn perfect_map_config() -> RegistrationConfig {
        RegistrationConfig {
            map_error_m: 0.0,
            ..RegistrationConfig::default()
        }
    }

    #[test]
    fn registration_converges_from_ten_centimeters_and_half_a_degree() {
        let world = TestWorld::street();
        let truth = world.pose_at(5.0, 0.3, 0.1);
        let off = truth * Pose2::new(Vector2::new(0.1, -0.08), 0.009);
        let config = RegistrationConfig::default();
        let found = register(&world, &beams(&world, &truth), &lift(&world, &off), &config);
        let found = found.unwrap().unwrap().map_from_lidar;
        assert_relative_eq!(found, lift(&world, &truth), epsilon = 3e-3);
    }

    #[test]
    fn the_most_informative_of_many_beams_find_the_pose_and_few_are_all_registered() {
        let world = TestWorld::street();
        let truth = world.pose_at(5.0, 0.3, 0.1);
        let off = lift(
            &world,
            &(truth * Pose2::new(Vector2::new(0.1, -0.08), 0.009)),
        );
        let config = RegistrationConfig::default();
        let all: Vec<Beam> = world.scan(&truth).beams().collect();
        assert!(all.len() > 6000, "{}", all.len());
        let near = approach(&world, &all, &off, &config).unwrap();
        let found = register_informative(&world, &all, &near, &config);
        let found = found.unwrap().unwrap().map_from_lidar;
        assert_relative_eq!(found, lift(&world, &truth), epsilon = 3e-3);
        let few: Vec<Beam> = all.into_iter().step_by(11).collect();
        assert_eq!(approach(&world, &few, &off, &config).unwrap(), off);
        let found = register_informative(&world, &few, &off, &config).unwrap();
        assert_eq!(found, register(&world, &few, &off, &config).unwrap());
    }

    #[test]
    fn a_step_has_the_least_robust_cost_of_the_linearized_residuals() {
        let world = TestWorld::street();
        let truth = world.pose_at(5.0, 0.3, 0.1);
        let off = truth * Pose2::new(Vector2::new(0.06, -0.05), 0.004);
        let mut beams = beams(&world, &truth);
        // A fifth of the beams end 0.2 m too early.
        (beams.iter_mut().step_by(5)).for_each(|beam| beam.range_m -= 0.2);
        let config = RegistrationConfig::default();
        let residuals = linearize(&world, &beams, &lift(&world, &off), &config).unwrap();
        let kernel = RobustKernel {
            scale_m: config.kernel_m,
        };
        let cost = |step: &Vector6<f64>| -> f64 {
            let after_m = |it: &Residual| it.value_m + it.jacobian.dot(step);
            residuals.iter().map(|it| kernel.cost(after_m(it))).sum()
        };
        let once = Equations::new(&residuals, &Vector6::zeros(), &config).unwrap();
        let least = Equations::minimal(&residuals, &config).unwrap().step;
        assert!(cost(&least) < cost(&once.step), "{least} {}", once.step);
        for component in 0..6 {
            for sign in [-1.0, 1.0] {
                let mut beside = least;
                beside[component] += sign * 2e-3;
                assert!(cost(&beside) > cost(&least), "{component} {sign}");
            }
        }
    }

    #[test]
    fn beams_are_chosen_after_an_approach_where_the_pose_is_farther_off() {
        let world = TestWorld::street();
        let truth = world.pose_at(5.0, 0.3, 0.1);
        let all: Vec<Beam> = world.scan(&truth).beams().collect();
        let config = RegistrationConfig::default();
        let off = lift(
            &world,
            &(truth * Pose2::new(Vector2::new(0.2, -0.1), 0.009)),
        );
        let found = register_informative(&world, &all, &off, &config).unwrap();
        let near = approach(&world, &all, &off, &config).unwrap();
        let expected = register_informative(&world, &all, &near, &config).unwrap();
        assert_eq!(found, expected);
        assert_relative_eq!(
            found.unwrap().map_from_lidar,
            lift(&world, &truth),
            epsilon = 3e-3
        );
    }

    #[test]
    fn six_degrees_of_freedom_recover_roll_pitch_and_height() {
        let world = TestWorld::street();
        let truth = world.pose_at(25.0, -0.3, -0.1);
        let expected = lift(&world, &truth);
        let off = exponential(&Vector6::new(0.05, 0.05, 0.05, 0.01, -0.01, 0.005));
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
    fn a_cautious_registration_has_twice_the_noise_of_normals_and_else_the_same_settings() {
        let config = RegistrationConfig {
            iterations: 7,
            kernel_m: 0.3,
            normal_rad: 0.015,
            ..RegistrationConfig::default()
        };
        let cautious = config.cautious();
        assert_eq!(cautious.normal_rad, 0.03);
        let same = RegistrationConfig {
            normal_rad: 0.015,
            ..cautious
        };
        assert_eq!(same, config);
    }

    #[test]
    fn noise_of_normals_along_a_tunnel_is_no_information() {
        let usual = RegistrationConfig::default();
        // Normals with a noise of 0.02 rad, and for poses that are not certain of 0.05 rad.
        for (amplitude_rad, config) in [(0.028, &usual), (0.07, &usual.cautious())] {
            along_a_tunnel_nothing_is_known(amplitude_rad, config.normal_rad);
        }
    }

    /// Checks the information of walls along x, a floor and a ceiling, whose normals have some noise.
    fn along_a_tunnel_nothing_is_known(amplitude_rad: f64, normal_rad: f64) {
        let mut information = Matrix6::zeros();
        for k in 0..1200 {
            let (sine, cosine) = (0.3 * f64::from(k)).sin_cos();
            let noise = Vector6::new(amplitude_rad * sine, 0.0, 0.0, 0.0, 0.0, 0.0);
            let lever = 20.0 * cosine;
            let jacobian = match k % 2 {
                0 => Vector6::new(0.0, 1.0, 0.0, 1.5 * sine, 0.0, lever),
                _ => Vector6::new(0.0, 0.0, 1.0, 3.0 * sine, lever, 0.0),
            } + noise;
            information += jacobian * jacobian.transpose();
        }
        let horizontal = Horizontal::new(&information, 1200.0 * normal_rad.powi(2)).unwrap();
        let sigma = |information: &Matrix6<f64>, axis: usize| {
            information.try_inverse().unwrap()[(axis, axis)].sqrt()
        };
        let corrected = horizontal.corrected(&information);
        assert!(corrected.cholesky().is_some());
        assert!(sigma(&corrected, 0) > 30.0 * sigma(&information, 0));
        assert_relative_eq!(
            sigma(&corrected, 1),
            sigma(&information, 1),
            max_relative = 0.01
        );
        let step = horizontal.determined(Vector6::new(1.0, 1.0, 1.0, 0.1, 0.1, 0.1));
        assert!(step.x.abs() < 0.01, "{step}");
        assert_relative_eq!(step.y, 1.0, epsilon = 0.01);
        assert_relative_eq!(step.z, 1.0);
    }

    #[test]
    fn the_true_pose_is_a_fixed_point() {
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
    fn the_planar_covariance_is_in_the_axes_of_the_map() {
        // Two centimetres ahead, one aside and three up; 2, 3 and 4 mrad about these axes.
        let variances = Vector6::new(4e-4, 1e-4, 9e-4, 4e-6, 9e-6, 16e-6);
        let found = |axis: nalgebra::Vector3<f64>| {
            let result = RegistrationResult {
                map_from_lidar: Pose3::new(nalgebra::Vector3::zeros(), axis),
                covariance: Matrix6::from_diagonal(&variances),
                iterations: 1,
            };
            result.planar_covariance()
        };
        let quarter = std::f64::consts::FRAC_PI_2;
        let heading_north = found(nalgebra::Vector3::z() * quarter);
        let expected = Matrix3::from_diagonal(&nalgebra::Vector3::new(1e-4, 4e-4, 16e-6));
        assert_relative_eq!(heading_north, expected, epsilon = 1e-12);
        let half_way = found(nalgebra::Vector3::z() * 0.5 * quarter);
        assert_relative_eq!(half_way[(0, 0)], 2.5e-4, epsilon = 1e-12);
        assert_relative_eq!(half_way[(0, 1)], 1.5e-4, epsilon = 1e-12);
        // Rolled by a quarter, the left axis points up: the turn about it is one of the heading.
        let rolled = found(nalgebra::Vector3::x() * quarter);
        let expected = Matrix3::from_diagonal(&nalgebra::Vector3::new(4e-4, 9e-4, 9e-6));
        assert_relative_eq!(rolled, expected, epsilon = 1e-12);
    }

    #[test]
    fn planar_covariance_rotates_with_the_heading() {
        let straight = TestWorld::street();
        let turned = TestWorld::moved_street(Pose2::rotation(1.0));
        let covariance = |world: &TestWorld| {
            let truth = world.pose_at(12.0, 0.1, 0.0);
            let mut beams = beams(world, &truth);
            for beam in &mut beams {
                beam.range_m += 0.02 * (1000.0 * beam.direction.y).sin();
            }
            let start = lift(world, &truth);
            let found = register(world, &beams, &start, &RegistrationConfig::default());
            found.unwrap().unwrap().planar_covariance()
        };
        let (a, b) = (covariance(&straight), covariance(&turned));
        let turn = nalgebra::Rotation3::from_axis_angle(&nalgebra::Vector3::z_axis(), 1.0);
        let expected = turn.matrix() * a * turn.matrix().transpose();
        assert_relative_eq!(b, expected, epsilon = 0.05 * a.norm());
    }

    #[test]
    fn correlated_errors_increase_the_covariance() {
        let world = TestWorld::street();
        let truth = world.pose_at(12.0, 0.1, 0.0);
        let start = lift(&world, &truth);
        let sigmas = |error_m: &dyn Fn(usize, &Beam) -> f32| {
            let mut beams = beams(&world, &truth);
            for (number, beam) in beams.iter_mut().enumerate() {
                beam.range_m += error_m(number, beam);
            }
            let config = perfect_map_config();
            let found = register(&world, &beams, &start, &config).unwrap().unwrap();
            found.planar_covariance().diagonal().map(f64::sqrt)
        };
        let independent = sigmas(&|number, _| if number % 2 == 0 { 0.02 } else { -0.02 });
        let correlated = sigmas(&|_, beam| {
            let degrees = beam.direction.y.atan2(beam.direction.x).to_degrees();
            if (degrees / 15.0).floor() as i32 % 2 == 0 {
                0.02
            } else {
                -0.02
            }
        });
        for axis in 0..3 {
            assert!(
                correlated[axis] > 2.0 * independent[axis],
                "{correlated} {independent}"
            );
        }
    }

    #[test]
    fn the_covariance_is_consistent_with_white_noise() {
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
            let config = perfect_map_config();
            let found = register(&world, &beams, &start, &config).unwrap().unwrap();
            let pose = crate::geometry::pose2_from_pose3(&found.map_from_lidar);
            let off = pose.translation.vector - truth.translation.vector;
            let off =
                nalgebra::Vector3::new(off.x, off.y, (truth.inverse() * pose).rotation.angle());
            squares += off.dot(&(found.planar_covariance().try_inverse().unwrap() * off));
        }
        // White noise enters both terms of the covariance, which doubles it: the expected value is
        // half of the three degrees of freedom, or less, since a jackknife is biased upwards.
        let mean = squares / f64::from(trials);
        assert!((0.9..2.2).contains(&mean), "{mean}");
    }

    #[test]
    fn without_beams_there_is_no_result() {
        let world = TestWorld::street();
        let start = lift(&world, &world.pose_at(0.0, 0.0, 0.0));
        let found = register(&world, &[], &start, &RegistrationConfig::default()).unwrap();
        assert_eq!(found, None);
    }
}
