//! Alignment of an estimated trajectory with the truth: a rigid transform, no scale.
//!
//! ```text
//! first    T = Q₀ P₀⁻¹
//! rigid    (R, t) = argmin Σᵢ |qᵢ − (R pᵢ + t)|²
//!          U D Vᵀ = Σᵢ (qᵢ − q̄)(pᵢ − p̄)ᵀ    S = diag(1, 1, det U det V)    R = U S Vᵀ    t = q̄ − R p̄
//! ```
//!
//! with the true poses Q and the estimates P, whose positions are q and p. Umeyama, *Least-squares
//! estimation of transformation parameters between two point patterns*, IEEE PAMI 13(4), 1991, eq. 38 to 43.

use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::Pose3;

/// Alignment of a trajectory with the truth before its errors are computed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum Alignment {
    /// None: both are in one frame.
    None,
    /// The first pose is made equal to the true one.
    First,
    /// The rigid transform with the least squared distances of all positions.
    Rigid,
}

impl Alignment {
    /// The transform `truth_from_estimate`; `None` without poses, and for `Rigid` on a straight line or a point,
    /// which does not determine it.
    pub(crate) fn transform(self, estimates: &[Pose3], truth: &[Pose3]) -> Option<Pose3> {
        match self {
            Self::None => Some(Pose3::identity()),
            Self::First => Some(truth.first()? * estimates.first()?.inverse()),
            Self::Rigid => rigid_alignment(estimates, truth),
        }
    }
}

/// The rigid transform `truth_from_estimate` between the positions of two trajectories of one length; `None` if
/// these are on a straight line.
pub fn rigid_alignment(estimates: &[Pose3], truth: &[Pose3]) -> Option<Pose3> {
    /// Smallest ratio of the second to the first singular value.
    const LINE: f64 = 1e-12;
    let (from, to) = (centre(estimates)?, centre(truth)?);
    let covariance: Matrix3<f64> = (estimates.iter().zip(truth))
        .map(|(p, q)| (q.translation.vector - to) * (p.translation.vector - from).transpose())
        .sum();
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let is_determined = svd.singular_values[1] > LINE * svd.singular_values[0];
    let mirror = (u.determinant() * v_t.determinant()).signum();
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, mirror)) * v_t;
    let rotation =
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let translation = Translation3::from(to - rotation * from);
    is_determined.then(|| Pose3::from_parts(translation, rotation))
}

/// Transforms estimates into the frame of the truth by `truth_from_estimate`.
pub fn aligned(truth_from_estimate: &Pose3, estimates: &[Pose3]) -> Vec<Pose3> {
    (estimates.iter())
        .map(|pose| truth_from_estimate * pose)
        .collect()
}

/// Turns poses of a camera, whose truth moves along its z axis, so that x is ahead and z is up: heights, headings and
/// pictures from above need such axes, distances and angles do not depend on them.
pub fn level_camera_axes(estimates: &mut [Pose3], truth: &mut [Pose3]) {
    if !moves_along_z(truth) {
        return;
    }
    let lidar_from_camera = Matrix3::new(0.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, -1.0, 0.0);
    let rotation = Rotation3::from_matrix_unchecked(lidar_from_camera);
    let turn = Pose3::from_parts(
        Translation3::identity(),
        UnitQuaternion::from_rotation_matrix(&rotation),
    );
    for pose in estimates.iter_mut().chain(truth) {
        *pose = turn * *pose * turn.inverse();
    }
}

/// Whether the sum of all steps, each in the frame of its pose, is mostly along z.
fn moves_along_z(poses: &[Pose3]) -> bool {
    let steps: Vector3<f64> = (poses.windows(2))
        .map(|pair| (pair[0].inverse() * pair[1]).translation.vector)
        .sum();
    steps.z.abs() > steps.x.abs().max(steps.y.abs())
}

/// Mean of the positions; `None` without poses.
fn centre(poses: &[Pose3]) -> Option<Vector3<f64>> {
    let sum: Vector3<f64> = poses.iter().map(|pose| pose.translation.vector).sum();
    (!poses.is_empty()).then(|| sum / poses.len() as f64)
}

#[cfg(test)]
mod tests {
    use approx::assert_relative_eq;

    use super::*;

    fn curve(count: usize) -> Vec<Pose3> {
        let step = Pose3::new(Vector3::new(1.0, 0.0, 0.02), Vector3::new(0.0, 0.001, 0.03));
        std::iter::successors(Some(Pose3::identity()), |pose| Some(pose * step))
            .take(count)
            .collect()
    }

    const ELSEWHERE: [f64; 6] = [400.0, -50.0, 6.0, 0.3, -2.0, 1.1];

    fn elsewhere() -> Pose3 {
        let [x, y, z, a, b, c] = ELSEWHERE;
        Pose3::new(Vector3::new(x, y, z), Vector3::new(a, b, c))
    }

    #[test]
    fn a_rigid_transform_of_the_truth_is_undone_by_both_alignments() {
        let truth = curve(200);
        let estimates = aligned(&elsewhere(), &truth);
        for alignment in [Alignment::First, Alignment::Rigid] {
            let found = alignment.transform(&estimates, &truth).unwrap();
            assert_relative_eq!(found, elsewhere().inverse(), epsilon = 1e-9);
        }
    }

    #[test]
    fn the_alignment_is_a_rotation_even_where_a_reflection_fits_better() {
        let truth = curve(200);
        let mirrored: Vec<Pose3> = (truth.iter())
            .map(|pose| {
                let t = pose.translation;
                Pose3::translation(t.x, t.y, -t.z)
            })
            .collect();
        let found = rigid_alignment(&mirrored, &truth).unwrap();
        let matrix = found.rotation.to_rotation_matrix();
        assert_relative_eq!(matrix.matrix().determinant(), 1.0, epsilon = 1e-12);
    }

    #[test]
    fn no_other_rigid_transform_has_smaller_squared_distances() {
        let truth = curve(100);
        let estimates: Vec<Pose3> = (truth.iter().enumerate())
            .map(|(i, pose)| {
                let i = i as f64;
                pose * Pose3::translation(i.sin(), (2.0 * i).cos(), (3.0 * i).sin())
            })
            .collect();
        let cost = |transform: &Pose3| -> f64 {
            (aligned(transform, &estimates).iter().zip(&truth))
                .map(|(p, q)| (p.translation.vector - q.translation.vector).norm_squared())
                .sum()
        };
        let best = rigid_alignment(&estimates, &truth).unwrap();
        for axis in 0..6 {
            for sign in [-1e-3, 1e-3] {
                let mut change = [0.0; 6];
                change[axis] = sign;
                let [x, y, z, a, b, c] = change;
                let change = Pose3::new(Vector3::new(x, y, z), Vector3::new(a, b, c));
                assert!(cost(&(change * best)) > cost(&best), "axis {axis}");
            }
        }
    }

    #[test]
    fn a_straight_line_does_not_determine_the_rotation() {
        let line: Vec<Pose3> = (0..50)
            .map(|i| elsewhere() * Pose3::translation(f64::from(i), 0.0, 0.0))
            .collect();
        assert_eq!(rigid_alignment(&line, &line), None);
        assert_eq!(rigid_alignment(&[], &[]), None);
        assert!(Alignment::First.transform(&line, &line).is_some());
    }
}
