//! Odometry motion model: where a pose hypothesis goes when the vehicle moves.
//!
//! An odometry increment is read as *turn, drive, turn*, u = (δ₁, d, δ₂), and every
//! hypothesis follows its own noisy copy of it:
//!
//! ```text
//! δ̂₁ ~ N(δ₁, σ_turn²)    d̂ ~ N(d, σ_drive²)    ŝ ~ N(0, σ_side²)    δ̂₂ ~ N(δ₂, σ_turn²)
//! T_map_current = T_map_previous · Rot(δ̂₁) · Trans(d̂, ŝ) · Rot(δ̂₂)
//! ```
//!
//! Thrun, Burgard and Fox, *Probabilistic Robotics* (2005), table 5.6, with a noise that
//! does not grow with the motion, as in range-mcl (Chen et al., ICRA 2021), and one that the tables
//! do not have: to the side, where turning says the less the shorter the step. A vehicle that
//! reports its speeds (v, ω) over a duration Δt instead drives an arc (table 5.3):
//!
//! ```text
//! v̂ ~ N(v, σ_v²)    ω̂ ~ N(ω, σ_ω²)    T_map_current = T_map_previous · exp(v̂ Δt, 0, ω̂ Δt)
//! ```
//!
//! A sensor does not follow such an arc exactly: it is mounted at a small angle to the axle, and
//! tyres slip. What it moves sideways has a noise of its own.

use std::time::Duration;

use nalgebra::{Matrix3, Matrix4, Matrix4x3, Vector2, Vector4};
use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use serde::{Deserialize, Serialize};

use crate::geometry::Pose2;

/// Standard deviations of the odometry noise, per increment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OdometryNoise {
    /// Of each of the two turns [rad].
    pub turn_rad: f64,
    /// Of the distance driven [m].
    pub drive_m: f64,
    /// Of a shift to the side: slip, and what an odometry from images errs there [m].
    pub side_m: f64,
}

impl Default for OdometryNoise {
    /// The values of range-mcl, and twice the centimetre that a good odometry errs to the side.
    fn default() -> Self {
        Self {
            turn_rad: 0.01,
            drive_m: 0.05,
            side_m: 0.02,
        }
    }
}

impl OdometryNoise {
    /// Covariance of (x, y, heading) of a motion in the axes of the car before it [m², m·rad, rad²],
    /// to first order in the turns.
    pub fn covariance(&self, motion: &TurnDriveTurn) -> Matrix3<f64> {
        let (sin, cos) = motion.first_turn_rad.sin_cos();
        let slopes = Matrix4x3::new(
            -motion.drive_m * sin,
            motion.drive_m * cos,
            1.0,
            cos,
            sin,
            0.0,
            -sin,
            cos,
            0.0,
            0.0,
            0.0,
            1.0,
        );
        let sigmas = Vector4::new(self.turn_rad, self.drive_m, self.side_m, self.turn_rad);
        let variances = Matrix4::from_diagonal(&sigmas.map(|sigma| sigma.powi(2)));
        slopes.transpose() * variances * slopes
    }
}

/// An odometry increment as three moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TurnDriveTurn {
    /// From the old heading towards the goal [rad].
    pub first_turn_rad: f64,
    /// Straight ahead [m].
    pub drive_m: f64,
    /// From there into the new heading [rad].
    pub second_turn_rad: f64,
}

impl TurnDriveTurn {
    /// Splits an increment into its three moves; [`compose`](Self::compose) is the inverse.
    pub fn decompose(previous_from_current: &Pose2) -> Self {
        let step = previous_from_current.translation.vector;
        let first_turn_rad = step.y.atan2(step.x);
        let second_turn_rad = previous_from_current.rotation.angle() - first_turn_rad;
        Self {
            first_turn_rad,
            drive_m: step.norm(),
            second_turn_rad,
        }
    }

    /// The increment `previous_from_current` that the three moves add up to.
    pub fn compose(&self) -> Pose2 {
        Pose2::rotation(self.first_turn_rad)
            * Pose2::translation(self.drive_m, 0.0)
            * Pose2::rotation(self.second_turn_rad)
    }

    /// Draws the increment of a noisy copy of the moves.
    pub fn sample(&self, noise: &OdometryNoise, rng: &mut impl Rng) -> Pose2 {
        let mut gaussian = |mean: f64, sigma: f64| {
            let deviate: f64 = StandardNormal.sample(rng);
            mean + sigma * deviate
        };
        let first_turn_rad = gaussian(self.first_turn_rad, noise.turn_rad);
        let drive_m = gaussian(self.drive_m, noise.drive_m);
        let second_turn_rad = gaussian(self.second_turn_rad, noise.turn_rad);
        let side_m = gaussian(0.0, noise.side_m);
        Pose2::rotation(first_turn_rad)
            * Pose2::translation(drive_m, side_m)
            * Pose2::rotation(second_turn_rad)
    }
}

/// Standard deviations of commanded velocities, constant over a command.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VelocityNoise {
    /// Of the speed ahead [m/s].
    pub speed_m_per_s: f64,
    /// Of the speed to the side, which a command does not have: slip, and a sensor that is mounted
    /// askew (a degree at 60 km/h makes 0.3 m/s) [m/s].
    pub side_speed_m_per_s: f64,
    /// Of the turn rate [rad/s].
    pub turn_rate_rad_per_s: f64,
    /// Of the rate of a last turn on the spot, without which the poses would lie on a surface
    /// (γ̂ of table 5.3) [rad/s].
    pub final_turn_rate_rad_per_s: f64,
}

impl Default for VelocityNoise {
    /// At ten commands a second ahead and in heading as much as [`OdometryNoise`].
    fn default() -> Self {
        Self {
            speed_m_per_s: 0.5,
            side_speed_m_per_s: 0.3,
            turn_rate_rad_per_s: 0.1,
            final_turn_rate_rad_per_s: 0.1,
        }
    }
}

/// A velocity command [v, ω] that is held for some time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityCommand {
    /// Ahead, v [m/s].
    pub speed_m_per_s: f64,
    /// To the left, ω [rad/s].
    pub turn_rate_rad_per_s: f64,
    /// How long it is held, Δt.
    pub duration: Duration,
}

impl VelocityCommand {
    /// The command whose arc ends where an increment does, as far as an arc can: its length is the
    /// distance driven (backwards where that is behind), its turn that of the increment.
    pub fn driving(previous_from_current: &Pose2, duration: Duration) -> Self {
        let seconds = duration.as_secs_f64().max(f64::MIN_POSITIVE);
        let turn_rad = previous_from_current.rotation.angle();
        let step = previous_from_current.translation.vector;
        // The chord of an arc is shorter than the arc by sin(α/2) / (α/2).
        let half_rad = 0.5 * turn_rad;
        let chord_per_arc = if half_rad.abs() < 1e-6 {
            1.0
        } else {
            half_rad.sin() / half_rad
        };
        let drive_m = step.norm().copysign(step.x) / chord_per_arc;
        Self {
            speed_m_per_s: drive_m / seconds,
            turn_rate_rad_per_s: turn_rad / seconds,
            duration,
        }
    }

    /// The increment `previous_from_current` along the arc; a straight line where ω is 0.
    pub fn compose(&self) -> Pose2 {
        let seconds = self.duration.as_secs_f64();
        let turn_rad = self.turn_rate_rad_per_s * seconds;
        let drive_m = self.speed_m_per_s * seconds;
        // sin α / α and (1 − cos α) / α, by their series where α is small.
        let (ahead, aside) = if turn_rad.abs() < 1e-6 {
            (1.0, 0.5 * turn_rad)
        } else {
            (turn_rad.sin() / turn_rad, (1.0 - turn_rad.cos()) / turn_rad)
        };
        Pose2::new(Vector2::new(ahead, aside) * drive_m, turn_rad)
    }

    /// Draws the increment of a noisy copy of the command.
    pub fn sample(&self, noise: &VelocityNoise, rng: &mut impl Rng) -> Pose2 {
        let mut gaussian = |sigma: f64| {
            let deviate: f64 = StandardNormal.sample(rng);
            sigma * deviate
        };
        let noisy = Self {
            speed_m_per_s: self.speed_m_per_s + gaussian(noise.speed_m_per_s),
            turn_rate_rad_per_s: self.turn_rate_rad_per_s + gaussian(noise.turn_rate_rad_per_s),
            duration: self.duration,
        };
        let seconds = self.duration.as_secs_f64();
        let aside_m = gaussian(noise.side_speed_m_per_s) * seconds;
        let last_turn_rad = gaussian(noise.final_turn_rate_rad_per_s) * seconds;
        noisy.compose() * Pose2::new(Vector2::new(0.0, aside_m), last_turn_rad)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::{FRAC_PI_2, PI};

    use approx::assert_relative_eq;
    use nalgebra::Vector3;
    use rand::{SeedableRng, rngs::StdRng};

    use super::*;

    #[test]
    fn composing_undoes_decomposing() {
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
            let round_trip = TurnDriveTurn::decompose(&increment).compose();
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
        let noise = OdometryNoise {
            turn_rad: 0.02,
            drive_m: 0.2,
            side_m: 0.1,
        };
        let mut rng = StdRng::seed_from_u64(7);
        let n = 20_000.0_f64;
        let noiseless = odometry.compose();
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
    fn a_velocity_command_drives_an_arc_of_radius_v_over_omega() {
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
    fn the_command_of_an_arc_is_the_command_that_drives_it() {
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
    fn two_halves_of_a_velocity_command_are_the_whole() {
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
    fn velocity_samples_spread_with_the_duration() {
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
    fn a_mistyped_key_is_an_error() {
        let result: Result<OdometryNoise, _> = serde_yaml::from_str("turn_red: 0.02\n");
        let message = result.unwrap_err().to_string();
        assert!(message.contains("turn_red"), "{message}");
    }
}
