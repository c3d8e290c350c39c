//! Odometry motion model: prediction of a pose hypothesis by a noisy motion.
//!
//! An odometry increment is decomposed into *turn, drive, turn*, u = (δ₁, d, δ₂), of which every
//! particle samples a noisy copy:
//!
//! ```text
//! δ̂₁ ~ N(δ₁, σ_turn²)    d̂ ~ N(d, σ_drive²)    ŝ ~ N(0, σ_side²)    δ̂₂ ~ N(δ₂, σ_turn²)
//! T_map_current = T_map_previous · Rot(δ̂₁) · Trans(d̂, ŝ) · Rot(δ̂₂)
//! ```
//!
//! Thrun, Burgard and Fox, *Probabilistic Robotics* (2005), table 5.6, with noise that hardly grows
//! with the motion, as in range-mcl (Chen et al., ICRA 2021), and with lateral noise, because for
//! short steps the noise of the turns hardly moves a particle sideways. Long steps, as of two scans a
//! second, add noise in proportion to the distance, σ² = σ_step² + (σ_metre d)². A vehicle that reports its
//! speeds (v, ω) over a duration Δt instead drives an arc (table 5.3):
//!
//! ```text
//! v̂ ~ N(v, σ_v²)    ω̂ ~ N(ω, σ_ω²)    T_map_current = T_map_previous · exp(v̂ Δt, 0, ω̂ Δt)
//! ```
//!
//! A sensor does not follow such an arc exactly, because it is mounted at a small angle to the axle
//! and tyres slip: its lateral motion has noise of its own.

use std::time::Duration;

use nalgebra::{Matrix3, Matrix3x4, Matrix4, Vector2, Vector3, Vector4};
use rand::{Rng, RngExt as _};
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use crate::geometry::Pose2;
use crate::validation::{InvalidValue, Validate, not_negative};

/// Standard deviations of the odometry noise, per increment and per metre of it.
///
/// Defaults: the values of range-mcl, twice the lateral error of a good odometry, 1 cm, and per metre those
/// of a poor one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct OdometryNoise {
    /// Standard deviation of each of the two turns [rad].
    #[default(0.01)]
    pub turn_rad: f64,
    /// Standard deviation of the distance driven [m].
    #[default(0.05)]
    pub drive_m: f64,
    /// Standard deviation of the lateral motion, from slip and visual odometry [m].
    #[default(0.02)]
    pub side_m: f64,
    /// Further standard deviation of each turn per metre [rad/m].
    #[default(0.002)]
    pub turn_rad_per_m: f64,
    /// Further standard deviation of the distance per metre (unitless).
    #[default(0.02)]
    pub drive_per_m: f64,
    /// Further standard deviation of the lateral motion per metre (unitless).
    #[default(0.01)]
    pub side_per_m: f64,
}

impl Validate for OdometryNoise {
    fn validate(&self) -> Result<(), InvalidValue> {
        not_negative("turn_rad", self.turn_rad)?;
        not_negative("drive_m", self.drive_m)?;
        not_negative("side_m", self.side_m)?;
        not_negative("turn_rad_per_m", self.turn_rad_per_m)?;
        not_negative("drive_per_m", self.drive_per_m)?;
        not_negative("side_per_m", self.side_per_m)
    }
}

impl OdometryNoise {
    /// The same noise for every length of the motion.
    pub fn constant(turn_rad: f64, drive_m: f64, side_m: f64) -> Self {
        Self {
            turn_rad,
            drive_m,
            side_m,
            turn_rad_per_m: 0.0,
            drive_per_m: 0.0,
            side_per_m: 0.0,
        }
    }

    /// The noise with all standard deviations multiplied.
    #[must_use]
    pub(crate) fn scaled(&self, factor: f64) -> Self {
        Self {
            turn_rad: factor * self.turn_rad,
            drive_m: factor * self.drive_m,
            side_m: factor * self.side_m,
            turn_rad_per_m: factor * self.turn_rad_per_m,
            drive_per_m: factor * self.drive_per_m,
            side_per_m: factor * self.side_per_m,
        }
    }

    /// Standard deviations of turn, drive and lateral motion of a motion.
    fn of(&self, motion: &TurnDriveTurn) -> [f64; 3] {
        let distance_m = motion.drive_m.abs();
        [
            self.turn_rad.hypot(self.turn_rad_per_m * distance_m),
            self.drive_m.hypot(self.drive_per_m * distance_m),
            self.side_m.hypot(self.side_per_m * distance_m),
        ]
    }

    /// Covariance of (x, y, heading) of a motion in the axes of the car before it [m², m·rad, rad²],
    /// to first order in the turns.
    pub(crate) fn covariance(&self, motion: &TurnDriveTurn) -> Matrix3<f64> {
        let (sin, cos) = motion.first_turn_rad.sin_cos();
        let jacobian = Matrix3x4::from_columns(&[
            Vector3::new(-motion.drive_m * sin, motion.drive_m * cos, 1.0),
            Vector3::new(cos, sin, 0.0),
            Vector3::new(-sin, cos, 0.0),
            Vector3::z(),
        ]);
        let [turn_rad, drive_m, side_m] = self.of(motion);
        let sigmas = Vector4::new(turn_rad, drive_m, side_m, turn_rad);
        propagated_covariance(&jacobian, &sigmas)
    }
}

/// An odometry increment as turn, drive, turn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TurnDriveTurn {
    /// Turn from the previous heading towards the current position, δ₁ [rad].
    pub first_turn_rad: f64,
    /// Distance driven, d [m].
    pub drive_m: f64,
    /// Turn into the current heading, δ₂ [rad].
    pub second_turn_rad: f64,
}

impl TurnDriveTurn {
    /// Decomposes an increment.
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

    /// Samples `previous_from_current` with noise; without noise it is the decomposed increment.
    pub fn sample(&self, noise: &OdometryNoise, rng: &mut impl Rng) -> Pose2 {
        let mut normal =
            |mean: f64, sigma: f64| mean + sigma * rng.sample::<f64, _>(StandardNormal);
        let [turn_sigma_rad, drive_sigma_m, side_sigma_m] = noise.of(self);
        let first_turn_rad = normal(self.first_turn_rad, turn_sigma_rad);
        let drive_m = normal(self.drive_m, drive_sigma_m);
        let second_turn_rad = normal(self.second_turn_rad, turn_sigma_rad);
        let side_m = normal(0.0, side_sigma_m);
        Pose2::rotation(first_turn_rad)
            * Pose2::translation(drive_m, side_m)
            * Pose2::rotation(second_turn_rad)
    }
}

/// Standard deviations of the velocities, constant over a command.
///
/// Defaults: at ten commands per second, the forward and heading noise of [`OdometryNoise`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct VelocityNoise {
    /// Standard deviation of the forward speed [m/s].
    #[default(0.5)]
    pub speed_m_per_s: f64,
    /// Standard deviation of the lateral speed [m/s]: slip, and the mounting angle of the sensor, which
    /// causes 0.3 m/s per degree at 60 km/h.
    #[default(0.3)]
    pub side_speed_m_per_s: f64,
    /// Standard deviation of the turn rate [rad/s].
    #[default(0.1)]
    pub turn_rate_rad_per_s: f64,
    /// Standard deviation of the rate of a final turn in place, without which the poses would lie on a
    /// surface (γ̂ of table 5.3) [rad/s].
    #[default(0.1)]
    pub final_turn_rate_rad_per_s: f64,
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
    /// Covariance of (x, y, heading) of the motion of a command in the axes of the car before it
    /// [m², m·rad, rad²], to first order in the noise, for arcs hardly longer than their chord.
    pub(crate) fn covariance(&self, command: &VelocityCommand) -> Matrix3<f64> {
        let seconds = command.duration.as_secs_f64();
        let turn_rad = command.turn_rate_rad_per_s * seconds;
        let (middle_sin, middle_cos) = (0.5 * turn_rad).sin_cos();
        let (sin, cos) = turn_rad.sin_cos();
        // The chord points along the middle of the turn; a turn by dα moves its end sideways by half
        // its length times dα.
        let half_drive_m = 0.5 * command.speed_m_per_s * seconds;
        let jacobian = Matrix3x4::from_columns(&[
            Vector3::new(middle_cos, middle_sin, 0.0),
            Vector3::new(-half_drive_m * middle_sin, half_drive_m * middle_cos, 1.0),
            Vector3::new(-sin, cos, 0.0),
            Vector3::z(),
        ]);
        let rates = Vector4::new(
            self.speed_m_per_s,
            self.turn_rate_rad_per_s,
            self.side_speed_m_per_s,
            self.final_turn_rate_rad_per_s,
        );
        propagated_covariance(&jacobian, &(seconds * rates))
    }
}

/// J diag(σ²) Jᵀ.
fn propagated_covariance(jacobian: &Matrix3x4<f64>, sigmas: &Vector4<f64>) -> Matrix3<f64> {
    let variances = Matrix4::from_diagonal(&sigmas.map(|sigma| sigma.powi(2)));
    jacobian * variances * jacobian.transpose()
}

/// Jacobian of (x, y, heading) after a step [m] by the pose before it: a turn moves the end of the step aside.
pub(crate) fn jacobian_of_step(step: &Vector2<f64>) -> Matrix3<f64> {
    Matrix3::new(1.0, 0.0, -step.y, 0.0, 1.0, step.x, 0.0, 0.0, 1.0)
}

/// Velocities that are held for a duration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VelocityCommand {
    /// Forward speed, v [m/s].
    pub speed_m_per_s: f64,
    /// Turn rate to the left, ω [rad/s].
    pub turn_rate_rad_per_s: f64,
    /// Duration, Δt.
    pub duration: Duration,
}

impl VelocityCommand {
    /// The command whose arc has the turn of an increment and a chord of its length; backwards where
    /// the increment is.
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

    /// `previous_from_current` along the arc; a straight line for ω = 0.
    pub(crate) fn compose(&self) -> Pose2 {
        let seconds = self.duration.as_secs_f64();
        let turn_rad = self.turn_rate_rad_per_s * seconds;
        let drive_m = self.speed_m_per_s * seconds;
        // sin α / α and (1 − cos α) / α, by their series where α is small.
        let (forward, lateral) = if turn_rad.abs() < 1e-6 {
            (1.0, 0.5 * turn_rad)
        } else {
            (turn_rad.sin() / turn_rad, (1.0 - turn_rad.cos()) / turn_rad)
        };
        Pose2::new(Vector2::new(forward, lateral) * drive_m, turn_rad)
    }

    /// Samples `previous_from_current` with noise.
    pub(crate) fn sample(&self, noise: &VelocityNoise, rng: &mut impl Rng) -> Pose2 {
        let mut normal = |sigma: f64| sigma * rng.sample::<f64, _>(StandardNormal);
        let noisy = Self {
            speed_m_per_s: self.speed_m_per_s + normal(noise.speed_m_per_s),
            turn_rate_rad_per_s: self.turn_rate_rad_per_s + normal(noise.turn_rate_rad_per_s),
            duration: self.duration,
        };
        let seconds = self.duration.as_secs_f64();
        let lateral_m = normal(noise.side_speed_m_per_s) * seconds;
        let final_turn_rad = normal(noise.final_turn_rate_rad_per_s) * seconds;
        noisy.compose() * Pose2::new(Vector2::new(0.0, lateral_m), final_turn_rad)
    }
}

#[cfg(test)]
#[path = "motion_tests.rs"]
mod tests;
