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
use crate::validation::{InvalidValue, Validate, not_negative};

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

impl Validate for OdometryNoise {
    fn validate(&self) -> Result<(), InvalidValue> {
        not_negative("turn_rad", self.turn_rad)?;
        not_negative("drive_m", self.drive_m)?;
        not_negative("side_m", self.side_m)
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

impl Validate for VelocityNoise {
    fn validate(&self) -> Result<(), InvalidValue> {
        not_negative("speed_m_per_s", self.speed_m_per_s)?;
        not_negative("side_speed_m_per_s", self.side_speed_m_per_s)?;
        not_negative("turn_rate_rad_per_s", self.turn_rate_rad_per_s)?;
        not_negative("final_turn_rate_rad_per_s", self.final_turn_rate_rad_per_s)
    }
}

impl VelocityNoise {
    /// Covariance of (x, y, heading) of a command's motion in the axes of the car before it
    /// [m², m·rad, rad²], to first order in the noise. Taken for an arc that is hardly longer than its
    /// chord, which points along the middle of the turn.
    pub fn covariance(&self, command: &VelocityCommand) -> Matrix3<f64> {
        let seconds = command.duration.as_secs_f64();
        let turn_rad = command.turn_rate_rad_per_s * seconds;
        let (middle_sin, middle_cos) = (0.5 * turn_rad).sin_cos();
        let (sin, cos) = turn_rad.sin_cos();
        // A turn moves the end of the arc half as far aside as the whole arc lies ahead.
        let half_drive_m = 0.5 * command.speed_m_per_s * seconds;
        let slopes = Matrix4x3::new(
            middle_cos,
            middle_sin,
            0.0,
            -half_drive_m * middle_sin,
            half_drive_m * middle_cos,
            1.0,
            -sin,
            cos,
            0.0,
            0.0,
            0.0,
            1.0,
        );
        let sigmas = seconds
            * Vector4::new(
                self.speed_m_per_s,
                self.turn_rate_rad_per_s,
                self.side_speed_m_per_s,
                self.final_turn_rate_rad_per_s,
            );
        let variances = Matrix4::from_diagonal(&sigmas.map(|sigma| sigma.powi(2)));
        slopes.transpose() * variances * slopes
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
#[path = "motion_tests.rs"]
mod tests;
