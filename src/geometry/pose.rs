//! Poses in the plane and in space, and the conversions between them.

use glam::{Mat3, Vec3};
use nalgebra::{Isometry2, Isometry3, Translation3, UnitQuaternion, Vector3, Vector6};

/// A pose or transform in the plane: x, y [m], heading [rad].
pub type Pose2 = Isometry2<f64>;
/// A pose or transform in space [m].
pub type Pose3 = Isometry3<f64>;

/// The circumference of the Earth [m]: no coordinate of a recording or a map is larger.
pub const FARTHEST_M: f64 = 4.0e7;

/// Heading of a pose, `atan2(R₁₀, R₀₀)` [rad].
pub fn yaw(pose: &Pose3) -> f64 {
    let forward = pose.rotation * nalgebra::Vector3::x();
    forward.y.atan2(forward.x)
}

/// A motion in frames whose y axes point to the other side.
pub fn mirrored_motion(motion: &Pose3) -> Pose3 {
    let mut t = motion.translation;
    t.vector.y = -t.vector.y;
    let turn = motion.rotation.scaled_axis();
    let turn = Vector3::new(-turn.x, turn.y, -turn.z);
    Pose3::from_parts(t, UnitQuaternion::from_scaled_axis(turn))
}

/// Returns the pose of x, y, z [m], roll, pitch, yaw [deg]: rotations about the fixed axes x, y, z, in this order.
pub fn pose_from_degrees([x, y, z, roll, pitch, yaw]: [f64; 6]) -> Pose3 {
    let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_radians);
    Pose3::from_parts(
        nalgebra::Translation3::new(x, y, z),
        nalgebra::UnitQuaternion::from_euler_angles(roll, pitch, yaw),
    )
}

/// Projects a pose onto the x-y plane: x, y and heading.
pub fn pose2_from_pose3(pose: &Pose3) -> Pose2 {
    Pose2::new(pose.translation.vector.xy(), yaw(pose))
}

/// The pose at `height_m` without roll and pitch; [`pose2_from_pose3`] is the inverse.
pub fn pose3_from_pose2(pose: &Pose2, height_m: f64) -> Pose3 {
    let t = pose.translation.vector;
    Pose3::from_parts(
        Translation3::new(t.x, t.y, height_m),
        UnitQuaternion::from_euler_angles(0.0, 0.0, pose.rotation.angle()),
    )
}

/// The transform of a translation [m] and a rotation vector [rad].
pub fn exponential(step: &Vector6<f64>) -> Pose3 {
    Pose3::new(
        step.fixed_rows::<3>(0).into(),
        step.fixed_rows::<3>(3).into(),
    )
}

/// The inverse of [`exponential`].
pub fn logarithm(pose: &Pose3) -> Vector6<f64> {
    let (t, r) = (pose.translation.vector, pose.rotation.scaled_axis());
    Vector6::new(t.x, t.y, t.z, r.x, r.y, r.z)
}

/// A rigid transform in `f32` for many points: `p_a = a_from_b.apply(p_b)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rigid3f {
    /// Rotation matrix; its columns are the axes of frame b in frame a.
    pub rotation: Mat3,
    /// Origin of frame b in frame a [m].
    pub translation: Vec3,
}

impl Rigid3f {
    /// Transforms a point from frame b to frame a.
    #[inline]
    pub fn apply(&self, point: Vec3) -> Vec3 {
        self.rotation * point + self.translation
    }

    /// Rotates a direction from frame b to frame a.
    #[inline]
    pub fn rotate(&self, direction: Vec3) -> Vec3 {
        self.rotation * direction
    }
}

impl From<&Pose3> for Rigid3f {
    fn from(pose: &Pose3) -> Self {
        let rotation: nalgebra::Matrix3<f32> = pose.rotation.to_rotation_matrix().matrix().cast();
        let translation: nalgebra::Vector3<f32> = pose.translation.vector.cast();
        Self {
            rotation: rotation.into(),
            translation: translation.into(),
        }
    }
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;
    use nalgebra::Vector2;

    use super::*;

    #[test]
    fn projection_inverts_pose3_from_pose2() {
        for heading in [-3.1, -1.0, 0.0, 0.5, 3.1] {
            let pose = Pose2::new(Vector2::new(3.0, -2.0), heading);
            assert_relative_eq!(
                pose2_from_pose3(&pose3_from_pose2(&pose, 1.5)),
                pose,
                epsilon = 1e-12
            );
        }
    }

    #[test]
    fn single_and_double_precision_agree() {
        let pose = Pose3::new(
            nalgebra::Vector3::new(1.0, 2.0, 3.0),
            nalgebra::Vector3::new(0.1, -0.2, 1.3),
        );
        let moved = Rigid3f::from(&pose).apply(Vec3::new(4.0, 5.0, 6.0));
        let expected = pose * nalgebra::Point3::new(4.0, 5.0, 6.0);
        assert_relative_eq!(f64::from(moved.x), expected.x, epsilon = 1e-5);
        assert_relative_eq!(f64::from(moved.y), expected.y, epsilon = 1e-5);
        assert_relative_eq!(f64::from(moved.z), expected.z, epsilon = 1e-5);
    }
}
