use approx::assert_relative_eq;
use nalgebra::{Vector2, Vector3};

use super::information::Horizontal;
use super::*;
use crate::geometry::{Pose2, TriangleMesh, Vec3};
use crate::lidar::{LidarModel, RangeImage};
use crate::map::SensorAttitude;
use crate::map::world_for_tests::TestWorld;
use crate::rendering::CpuRenderer;

/// Registers all beams at once.
fn register(
    renderer: &dyn RangeRenderer,
    beams: &[Beam],
    initial: &Pose3,
    config: &RegistrationConfig,
) -> Result<Option<RegistrationResult>, RenderError> {
    let found = Linearized::new(renderer, beams, initial, config)?.descend()?;
    found.map_or(Ok(None), Descent::result)
}

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
    let kernel = config.kernel();
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
fn residuals_of_the_most_informative_beams_have_the_numbers_of_these() {
    let world = TestWorld::street();
    let pose = lift(&world, &world.pose_at(5.0, 0.3, 0.1));
    let all: Vec<Beam> = world.scan(&world.pose_at(5.0, 0.31, 0.1)).beams().collect();
    let config = RegistrationConfig::default();
    let all = Linearized::new(&world, &all, &pose, &config).unwrap();
    let chosen = all.most_informative();
    assert!(chosen.beams.len() < all.beams.len());
    let again = chosen.residuals_at(&pose).unwrap();
    let numbered = |residuals: &[Residual]| -> Vec<(usize, f64)> {
        (residuals.iter().map(|it| (it.beam, it.value_m))).collect()
    };
    assert!(numbered(&chosen.residuals) == numbered(&again));
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
        let off = nalgebra::Vector3::new(off.x, off.y, (truth.inverse() * pose).rotation.angle());
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

/// A corridor of 120 m along x, 10 m wide, with ripples on its walls: the root mean square of the errors of the normals is 0.08 rad
/// for 15 mm.
fn corridor(ripple_m: f32) -> CpuRenderer {
    const STEP_M: f32 = 0.1;
    const WAVE_M: f32 = 0.8;
    let columns = 1200_u32;
    let mut mesh = TriangleMesh::default();
    // The floor, and both walls.
    for strip in 0..3 {
        let first = mesh.vertices.len() as u32;
        for column in 0..=columns {
            let x = STEP_M * column as f32 - 60.0;
            let y = 5.0 + ripple_m * (std::f32::consts::TAU * x / WAVE_M).sin();
            mesh.vertices.extend(match strip {
                0 => [Vec3::new(x, -6.0, -1.73), Vec3::new(x, 6.0, -1.73)],
                1 => [Vec3::new(x, y, -2.0), Vec3::new(x, y, 4.0)],
                _ => [Vec3::new(x, -y, -2.0), Vec3::new(x, -y, 4.0)],
            });
        }
        for column in 0..columns {
            let a = first + 2 * column;
            (mesh.triangles).extend([[a, a + 2, a + 3], [a, a + 3, a + 1]]);
        }
    }
    CpuRenderer::new(&[mesh])
}

#[test]
fn ripples_of_the_map_that_no_scan_follows_show_no_position_along_a_corridor() {
    let model = LidarModel {
        height: 32,
        width: 360,
        ..LidarModel::default()
    };
    // Turned and pitched, so that the axes of map and lidar differ.
    let truth = Pose3::new(Vector3::zeros(), Vector3::new(0.0, 0.05, 0.7));
    let rippled = corridor(0.015);
    // Standard deviations along the corridor of a scan of another one: of few beams, of the most informative ones of many,
    // and of a pose that is kept.
    let sigmas_m = |scanned: &CpuRenderer| {
        let image = scanned.render(&[truth], &model).unwrap().remove(0);
        let beams: Vec<Beam> = RangeImage::from_ranges(image, &model).beams().collect();
        let few: Vec<Beam> = beams.iter().step_by(5).copied().collect();
        assert!(few.len() < COARSE_BEAMS && beams.len() > 2 * COARSE_BEAMS);
        // Of one step, so that the residuals are those from which the beams were chosen.
        let config = RegistrationConfig {
            iterations: 1,
            ..RegistrationConfig::default()
        };
        let of_few = register(&rippled, &few, &truth, &config).unwrap();
        let there = Linearized::new(&rippled, &beams, &truth, &config).unwrap();
        let found = [of_few, there.registered().unwrap(), there.kept().unwrap()];
        found.map(|found| found.unwrap().planar_covariance()[(0, 0)].sqrt())
    };
    let (flat, same) = (sigmas_m(&corridor(0.0)), sigmas_m(&rippled));
    for (flat, same) in std::iter::zip(flat, same) {
        assert!(same < 0.01 && flat > 0.1, "{same} {flat}");
    }
}

#[test]
fn the_factor_of_the_ranges_is_found_together_with_the_pose() {
    let world = TestWorld::street();
    let truth = world.pose_at(5.0, 0.3, 0.1);
    let beams = beams(&world, &truth);
    let config = RegistrationConfig::default();
    let near = truth * Pose2::new(Vector2::new(0.05, -0.05), 0.002);
    for (pose, tolerance) in [(truth, 2e-4), (near, 2e-3)] {
        for factor in [0.98_f64, 0.99, 1.0, 1.01, 1.02] {
            let distorted: Vec<Beam> = (beams.iter())
                .map(|beam| Beam {
                    range_m: beam.range_m / factor as f32,
                    ..*beam
                })
                .collect();
            let found = measured_range_factor(&world, &distorted, &lift(&world, &pose), &config);
            // To first order: a tenth of the change.
            let tolerance = tolerance + 0.1 * (factor - 1.0).abs();
            assert_relative_eq!(found.unwrap().unwrap(), factor, epsilon = tolerance);
        }
    }
    let few = &beams[..20];
    let found = measured_range_factor(&world, few, &lift(&world, &truth), &config);
    assert_eq!(found.unwrap(), None);
}
