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
use crate::odometry::{OdometryEstimate, StepState};

/// Known motion into a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Odometry {
    /// Measured: `previous_from_current`.
    Increment(Pose2),
    /// Measured in space, such as by the odometry of the scans; roll and pitch follow it too.
    Motion(Pose3),
    /// In space as well, but predicted, doubtful, or not determined in some direction by the scans.
    Assumed(Pose3),
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
            Self::Motion(motion) | Self::Assumed(motion) => Some(pose2_from_pose3(motion)),
            Self::Velocity(command) => Some(command.compose()),
            Self::Unknown => None,
        }
    }

    /// The motion in space; `None` if it was not measured there.
    pub fn in_space(&self) -> Option<Pose3> {
        match self {
            Self::Motion(motion) | Self::Assumed(motion) => Some(*motion),
            Self::Increment(_) | Self::Velocity(_) | Self::Unknown => None,
        }
    }

    /// The same with another motion in space, where it has one.
    pub(super) fn map_in_space(self, change: impl Fn(&Pose3) -> Pose3) -> Self {
        match self {
            Self::Motion(motion) => Self::Motion(change(&motion)),
            Self::Assumed(motion) => Self::Assumed(change(&motion)),
            other => other,
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

/// Motion that the odometry of the scans found, over one scan or several.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct MotionOfScans {
    pub previous_from_current: Pose3,
    /// Whether any of them does not determine the motion to it.
    pub is_assumed: bool,
}

impl MotionOfScans {
    /// This motion and then the next one.
    pub fn followed_by(self, next: Self) -> Self {
        Self {
            previous_from_current: self.previous_from_current * next.previous_from_current,
            is_assumed: self.is_assumed || next.is_assumed,
        }
    }
}

impl From<&OdometryEstimate> for MotionOfScans {
    fn from(estimate: &OdometryEstimate) -> Self {
        Self {
            previous_from_current: estimate.previous_from_current,
            is_assumed: !estimate.is_determined() && estimate.state != StepState::First,
        }
    }
}

impl From<MotionOfScans> for Odometry {
    fn from(motion: MotionOfScans) -> Self {
        if motion.is_assumed {
            Self::Assumed(motion.previous_from_current)
        } else {
            Self::Motion(motion.previous_from_current)
        }
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
    use nalgebra::{Matrix6, Vector3, Vector6};
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
    fn a_motion_over_scans_is_assumed_if_one_of_them_does_not_determine_its_part() {
        let estimate = |state: StepState, directions: usize| OdometryEstimate {
            odom_from_lidar: Pose3::identity(),
            previous_from_current: Pose3::translation(1.0, 0.0, 0.0),
            duration_s: 0.1,
            covariance: Matrix6::zeros(),
            state,
            degenerate_directions: vec![Vector6::x(); directions],
            residual_m: None,
            matched_share: 1.0,
            elapsed: std::time::Duration::ZERO,
        };
        let over = |steps: &[(StepState, usize)]| {
            let motions = (steps.iter()).map(|&(state, count)| (&estimate(state, count)).into());
            Odometry::from(motions.fold(MotionOfScans::default(), MotionOfScans::followed_by))
        };
        let of = |metres| Pose3::translation(metres, 0.0, 0.0);
        use StepState::{Doubtful, First, Lost, Predicted, Registered};
        let found = over(&[(First, 0), (Registered, 0)]);
        assert_eq!(found, Odometry::Motion(of(2.0)));
        for weak in [(Registered, 1), (Doubtful, 0), (Predicted, 0), (Lost, 0)] {
            let found = over(&[(Registered, 0), weak, (Registered, 0)]);
            assert_eq!(found, Odometry::Assumed(of(3.0)));
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
