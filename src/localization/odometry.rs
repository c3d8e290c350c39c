//! Motion of the car between two frames, as a planar transform `previous_from_current`.
//!
//! ```text
//! u_k = T_world_lidar(k−1)⁻¹ · T_world_lidar(k)
//! ```
//!
//! The world frame cancels out: recorded odometry may start anywhere and drift.

use rand::Rng;

use super::motion::{OdometryNoise, TurnDriveTurn, VelocityCommand};
use crate::geometry::{FARTHEST_M, Pose2, Pose3, pose2_from_pose3};

/// Known motion into a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Odometry {
    /// Measured: `previous_from_current`.
    Increment(Pose2),
    /// Measured in space, such as by the odometry of the scans; roll and pitch follow it too.
    Motion(Pose3),
    /// Commanded: velocities held since the previous frame.
    Velocity(VelocityCommand),
    /// Unknown: the motion into the previous frame is assumed to continue (constant velocity).
    Unknown,
}

impl Odometry {
    /// The motion in the plane; `None` if it is unknown.
    pub(super) fn in_plane(&self) -> Option<Pose2> {
        match self {
            Self::Increment(increment) => Some(*increment),
            Self::Motion(motion) => Some(pose2_from_pose3(motion)),
            Self::Velocity(command) => Some(command.compose()),
            Self::Unknown => None,
        }
    }

    /// Whether the motion is finite and stays on Earth.
    pub(super) fn is_possible(&self) -> bool {
        let Some(increment) = self.in_plane() else {
            return true;
        };
        let length_m = increment.translation.vector.norm();
        length_m <= FARTHEST_M && increment.rotation.angle().is_finite()
    }
}

/// Motions `previous_from_current` between consecutive poses, one per pose; the first is the identity.
pub fn motions(world_from_lidar: &[Pose3]) -> Vec<Pose3> {
    let first = world_from_lidar.first().map(|_| Pose3::identity());
    let steps = world_from_lidar
        .windows(2)
        .map(|pair| pair[0].inverse() * pair[1]);
    first.into_iter().chain(steps).collect()
}

/// The same motions in the plane of the car.
#[cfg(test)]
pub(crate) fn increments(world_from_lidar: &[Pose3]) -> Vec<Pose2> {
    let motions = motions(world_from_lidar);
    motions.iter().map(pose2_from_pose3).collect()
}

/// Whether motions were measured in space: those of wheels stay in the plane of the car.
pub fn are_in_space(motions: &[Pose3]) -> bool {
    const LEAST_M: f64 = 1e-3;
    const LEAST_RAD: f64 = 1e-4;
    motions.iter().any(|motion| {
        let up = motion.rotation * nalgebra::Vector3::z();
        motion.translation.z.abs() > LEAST_M || up.xy().norm() > LEAST_RAD
    })
}

/// Increments with noise on turn, drive and turn; the first, which is no motion, is unchanged. With
/// increments of the ground truth this is the demonstration of range-mcl, which reports must state.
pub fn with_noise(increments: &[Pose2], noise: &OdometryNoise, rng: &mut impl Rng) -> Vec<Pose2> {
    increments
        .iter()
        .enumerate()
        .map(|(frame, increment)| match frame {
            0 => *increment,
            _ => TurnDriveTurn::decompose(increment).sample(noise, rng),
        })
        .collect()
}

/// Noise that range-mcl adds to the true increments: 0.01 rad, 0.01 m, none laterally.
pub fn demonstration_noise() -> OdometryNoise {
    OdometryNoise::constant(0.01, 0.01, 0.0)
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector3;
    use rand::{SeedableRng, rngs::StdRng};

    use super::*;

    fn drive() -> Vec<Pose3> {
        let step = Pose3::new(Vector3::new(1.0, 0.02, 0.0), Vector3::new(0.0, 0.0, 0.03));
        let mut pose = Pose3::new(Vector3::new(3.0, -4.0, 0.5), Vector3::new(0.0, 0.0, 1.0));
        (0..50)
            .map(|_| {
                pose *= step;
                pose
            })
            .collect()
    }

    #[test]
    fn the_product_of_the_increments_is_the_trajectory() {
        let poses = drive();
        let mut pose = pose2_from_pose3(&poses[0]);
        for (increment, expected) in increments(&poses).iter().zip(&poses) {
            pose *= increment;
            assert_relative_eq!(pose, pose2_from_pose3(expected), epsilon = 1e-9);
        }
    }

    #[test]
    fn increments_do_not_depend_on_the_world_frame() {
        let poses = drive();
        let other_from_world = Pose3::new(Vector3::new(9.0, 8.0, 7.0), Vector3::new(0.3, 0.2, 2.0));
        let moved: Vec<Pose3> = poses.iter().map(|pose| other_from_world * pose).collect();
        for (a, b) in increments(&poses).iter().zip(&increments(&moved)) {
            assert_relative_eq!(a, b, epsilon = 1e-9);
        }
    }

    #[test]
    fn a_trajectory_without_poses_has_no_increments() {
        assert_eq!(increments(&[]), []);
    }

    #[test]
    fn zero_noise_changes_nothing_and_the_first_increment_has_no_noise() {
        let increments = increments(&drive());
        let mut rng = StdRng::seed_from_u64(1);
        let zero = OdometryNoise::constant(0.0, 0.0, 0.0);
        for (a, b) in with_noise(&increments, &zero, &mut rng)
            .iter()
            .zip(&increments)
        {
            assert_relative_eq!(a, b, epsilon = 1e-12);
        }
        let noisy = with_noise(&increments, &demonstration_noise(), &mut rng);
        assert_eq!(noisy[0], Pose2::identity());
        assert_ne!(noisy[1], increments[1]);
    }
}
