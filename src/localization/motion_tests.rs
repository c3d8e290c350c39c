//! Laws of the motion models.

use std::f64::consts::{FRAC_PI_2, PI};

use approx::assert_relative_eq;
use nalgebra::Vector3;
use rand::{SeedableRng, rngs::StdRng};

use super::*;

/// The increment of turn, drive, turn without noise.
fn compose(motion: &TurnDriveTurn) -> Pose2 {
    let zero = OdometryNoise::constant(0.0, 0.0, 0.0);
    motion.sample(&zero, &mut StdRng::seed_from_u64(0))
}

#[test]
fn a_sample_without_noise_is_the_decomposed_increment() {
    let forward = Pose2::new(Vector2::new(1.2, 0.1), 0.05);
    let reverse = Pose2::new(Vector2::new(-0.8, 0.0), -0.02);
    let turn_in_place = Pose2::new(Vector2::zeros(), FRAC_PI_2);
    let half_turn = Pose2::new(Vector2::new(0.0, 2.0), PI);
    for increment in [
        forward,
        reverse,
        turn_in_place,
        half_turn,
        Pose2::identity(),
    ] {
        let round_trip = compose(&TurnDriveTurn::decompose(&increment));
        assert_relative_eq!(round_trip, increment, epsilon = 1e-12);
    }
}

#[test]
fn samples_have_the_configured_spread() {
    let odometry = TurnDriveTurn {
        first_turn_rad: 0.3,
        drive_m: 1.0,
        second_turn_rad: -0.1,
    };
    let noise = OdometryNoise::constant(0.02, 0.2, 0.1);
    let mut rng = StdRng::seed_from_u64(7);
    let n = 20_000.0_f64;
    let noiseless = compose(&odometry);
    let mut found = Matrix3::zeros();
    for _ in 0..20_000 {
        let step = odometry.sample(&noise, &mut rng);
        let off = step.translation.vector - noiseless.translation.vector;
        let turn = step.rotation.angle() - noiseless.rotation.angle();
        let off = Vector3::new(off.x, off.y, turn);
        found += off * off.transpose() / n;
    }
    // Four standard errors of a variance.
    let expected = noise.covariance(&odometry);
    assert_relative_eq!(found, expected, epsilon = 4.0 * 0.04 * (2.0 / n).sqrt());
    let ahead = Vector3::new(0.3_f64.cos(), 0.3_f64.sin(), 0.0);
    let aside = Vector3::new(-ahead.y, ahead.x, 0.0);
    for (axis, variance) in [
        (ahead, 0.04),
        (aside, 0.01 + 0.0004),
        (Vector3::z(), 2.0 * 0.0004),
    ] {
        let found = axis.dot(&(found * axis));
        assert_relative_eq!(found, variance, max_relative = 4.0 * (2.0 / n).sqrt());
    }
}

#[test]
fn the_covariance_of_a_motion_is_that_of_its_turns_and_ways_in_the_direction_of_the_drive() {
    let noise = OdometryNoise::constant(0.1, 0.2, 0.3);
    for first_turn_rad in [0.0, 0.4, -2.0] {
        let motion = TurnDriveTurn {
            first_turn_rad,
            drive_m: 2.0,
            second_turn_rad: 0.7,
        };
        // The first turn moves the end of the way aside.
        let along_drive = Matrix3::new(
            0.04,
            0.0,
            0.0, //
            0.0,
            0.09 + 0.04,
            0.02, //
            0.0,
            0.02,
            2.0 * 0.01,
        );
        let turn = Pose2::rotation(first_turn_rad).rotation;
        let turn = turn.to_rotation_matrix().to_homogeneous();
        let expected = turn * along_drive * turn.transpose();
        assert_relative_eq!(noise.covariance(&motion), expected, epsilon = 1e-12);
    }
}

#[test]
fn a_velocity_command_is_an_arc_of_radius_v_over_omega() {
    let quarter = VelocityCommand {
        speed_m_per_s: 2.0,
        turn_rate_rad_per_s: 0.5,
        duration: Duration::from_secs_f64(PI),
    };
    let expected = Pose2::new(Vector2::new(4.0, 4.0), FRAC_PI_2);
    // A duration is a whole number of nanoseconds.
    assert_relative_eq!(quarter.compose(), expected, epsilon = 1e-8);
    let straight = VelocityCommand {
        turn_rate_rad_per_s: 0.0,
        ..quarter
    };
    let expected = Pose2::translation(2.0 * PI, 0.0);
    assert_relative_eq!(straight.compose(), expected, epsilon = 1e-8);
}

#[test]
fn the_command_for_an_arc_drives_that_arc() {
    let duration = Duration::from_millis(100);
    for (speed, turn_rate) in [(10.0, 0.3), (-2.0, 0.1), (5.0, 0.0), (0.0, 0.0)] {
        let command = VelocityCommand {
            speed_m_per_s: speed,
            turn_rate_rad_per_s: turn_rate,
            duration,
        };
        let back = VelocityCommand::driving(&command.compose(), duration);
        assert_relative_eq!(back.speed_m_per_s, speed, epsilon = 1e-9);
        assert_relative_eq!(back.turn_rate_rad_per_s, turn_rate, epsilon = 1e-9);
    }
}

#[test]
fn two_halves_of_a_velocity_command_compose_to_the_whole() {
    let whole = VelocityCommand {
        speed_m_per_s: 7.0,
        turn_rate_rad_per_s: -0.3,
        duration: Duration::from_millis(200),
    };
    let half = VelocityCommand {
        duration: Duration::from_millis(100),
        ..whole
    };
    let twice = half.compose() * half.compose();
    assert_relative_eq!(twice, whole.compose(), epsilon = 1e-12);
}

#[test]
fn the_spread_of_velocity_samples_is_proportional_to_the_duration() {
    let command = VelocityCommand {
        speed_m_per_s: 5.0,
        turn_rate_rad_per_s: 0.0,
        duration: Duration::from_millis(100),
    };
    let noise = VelocityNoise {
        speed_m_per_s: 0.5,
        side_speed_m_per_s: 0.1,
        turn_rate_rad_per_s: 0.0,
        final_turn_rate_rad_per_s: 0.2,
    };
    let mut rng = StdRng::seed_from_u64(3);
    let n = 20_000.0_f64;
    let (mut drive, mut aside, mut turn) = (0.0, 0.0, 0.0);
    for _ in 0..20_000 {
        let step = command.sample(&noise, &mut rng);
        drive += (step.translation.x - 0.5).powi(2) / n;
        aside += step.translation.y.powi(2) / n;
        turn += step.rotation.angle().powi(2) / n;
    }
    // σ Δt, four standard errors of the standard deviation.
    assert_relative_eq!(drive.sqrt(), 0.05, epsilon = 4.0 * 0.05 / (2.0 * n).sqrt());
    assert_relative_eq!(aside.sqrt(), 0.01, epsilon = 4.0 * 0.01 / (2.0 * n).sqrt());
    assert_relative_eq!(turn.sqrt(), 0.02, epsilon = 4.0 * 0.02 / (2.0 * n).sqrt());
}

#[test]
fn samples_of_a_velocity_have_the_covariance_of_its_noise() {
    let noise = VelocityNoise {
        speed_m_per_s: 1.0,
        side_speed_m_per_s: 0.4,
        turn_rate_rad_per_s: 0.5,
        final_turn_rate_rad_per_s: 0.2,
    };
    for (speed_m_per_s, turn_rate_rad_per_s) in [(8.0, 1.0), (-3.0, -0.5), (0.0, 0.0)] {
        let command = VelocityCommand {
            speed_m_per_s,
            turn_rate_rad_per_s,
            duration: Duration::from_millis(200),
        };
        let mut rng = StdRng::seed_from_u64(5);
        let n = 20_000.0_f64;
        let noiseless = command.compose();
        let mut found = Matrix3::zeros();
        for _ in 0..20_000 {
            let step = command.sample(&noise, &mut rng);
            let off = step.translation.vector - noiseless.translation.vector;
            let turn = step.rotation.angle() - noiseless.rotation.angle();
            let off = Vector3::new(off.x, off.y, turn);
            found += off * off.transpose() / n;
        }
        let expected = noise.covariance(&command);
        // Four standard errors of the largest variance.
        let error = 4.0 * expected.diagonal().max() * (2.0 / n).sqrt();
        assert_relative_eq!(found, expected, epsilon = error);
    }
}

#[test]
fn a_mistyped_key_is_an_error() {
    let result: Result<OdometryNoise, _> = serde_yaml::from_str("turn_red: 0.02\n");
    let message = result.unwrap_err().to_string();
    assert!(message.contains("turn_red"), "{message}");
}

#[test]
fn noise_per_metre_adds_to_the_variance_in_proportion_to_the_squared_distance() {
    let noise = OdometryNoise {
        drive_per_m: 0.1,
        ..OdometryNoise::constant(0.0, 0.3, 0.0)
    };
    let variance = |drive_m: f64| {
        let straight = TurnDriveTurn {
            first_turn_rad: 0.0,
            drive_m,
            second_turn_rad: 0.0,
        };
        noise.covariance(&straight)[(0, 0)]
    };
    assert_relative_eq!(variance(0.0), 0.09, epsilon = 1e-12);
    assert_relative_eq!(variance(4.0), 0.09 + 0.16, epsilon = 1e-12);
    assert_relative_eq!(variance(-4.0), variance(4.0), epsilon = 1e-12);
    assert_eq!(noise.scaled(2.0).drive_m, 0.6);
}
