//! Consistency of given poses with the motion that the scans show.
//!
//! The motion between neighbouring scans by the odometry is compared with that of the poses, read as they are
//! given and by the usual mistakes:
//!
//! ```text
//! P⁻¹ P'   P = T⁻¹ W₀⁻¹ W T      W rows of the file, world_from_body; T = body_from_lidar
//! ```
//!
//! The difference of two motions is that of points at a distance r: |t| + r θ, t and θ the translation and the
//! angle of one motion after the inverse of the other. Poses are judged by its median.

use std::f64::consts::{FRAC_PI_2, PI};

use nalgebra::{UnitQuaternion, Vector3};

use super::config::OdometryConfig;
use super::odometer::{Odometer, OdometryEstimate, StepState};
use super::timing::TimingError;
use crate::geometry::{Pose3, mirrored_motion};
use crate::lidar::Scan;
use crate::statistics::median;

/// Poses as they are given.
#[derive(Clone, Copy, Debug)]
pub struct GivenPoses<'a> {
    /// One pose per scan.
    pub map_from_lidar: &'a [Pose3],
    /// Frame of the map in the world of the file.
    pub world_from_map: Pose3,
    /// Calibration that was applied.
    pub body_from_lidar: Pose3,
}

/// What the rows of a pose file are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PoseMeaning {
    /// The given poses: poses of the body of the calibration.
    Given,
    /// Poses of a camera: x right, y down, z forward.
    Camera,
    /// Poses of the lidar, to which no calibration applies.
    Lidar,
    /// Inverse poses, `body_from_world`.
    Inverse,
    /// Poses of left-handed frames: those of the lidar with y axes that point to the other side.
    Mirrored,
    /// Poses of a body about whose z axis the lidar is turned, in addition to the calibration [rad].
    Turned(f64),
}

impl PoseMeaning {
    const ALL: [Self; 8] = [
        Self::Given,
        Self::Camera,
        Self::Lidar,
        Self::Inverse,
        Self::Mirrored,
        Self::Turned(FRAC_PI_2),
        Self::Turned(-FRAC_PI_2),
        Self::Turned(PI),
    ];

    /// The motion `previous_from_current` of the lidar between two scans.
    fn motion(self, given: &GivenPoses, previous: usize, current: usize) -> Pose3 {
        let [previous, current] = [previous, current].map(|row| given.map_from_lidar[row]);
        let lidar = previous.inverse() * current;
        let in_frame = |a_from_b: Pose3, motion: Pose3| a_from_b.inverse() * motion * a_from_b;
        let body = in_frame(given.body_from_lidar.inverse(), lidar);
        match self {
            Self::Given => lidar,
            Self::Camera => in_frame(camera_from_lidar(), body),
            Self::Lidar => body,
            Self::Inverse => {
                let world_from_map = given.world_from_map;
                let body = in_frame(world_from_map.inverse(), previous * current.inverse());
                in_frame(given.body_from_lidar, body)
            }
            Self::Mirrored => mirrored_motion(&lidar),
            Self::Turned(rad) => in_frame(Pose3::rotation(Vector3::z() * rad), lidar),
        }
    }
}

/// Axes of a camera that looks forward.
fn camera_from_lidar() -> Pose3 {
    let third = 2.0 * PI / 3.0;
    let axis = Vector3::new(1.0, -1.0, 1.0).normalize();
    Pose3::from_parts(
        nalgebra::Translation3::identity(),
        UnitQuaternion::from_scaled_axis(axis * third),
    )
}

/// Translation and angle between two motions: medians over the scans.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotionDifference {
    /// Translation [m].
    pub translation_m: f64,
    /// Rotation [rad].
    pub rotation_rad: f64,
    /// Difference of points at a distance [m].
    pub points_m: f64,
}

impl MotionDifference {
    /// Distance of the points [m].
    const RADIUS_M: f64 = 10.0;

    fn median(differences: &[Pose3]) -> Self {
        let median =
            |value: &dyn Fn(&Pose3) -> f64| median(differences.iter().map(value)).unwrap_or(0.0);
        let translation_m = |pose: &Pose3| pose.translation.vector.norm();
        let rotation_rad = |pose: &Pose3| pose.rotation.angle();
        Self {
            translation_m: median(&translation_m),
            rotation_rad: median(&rotation_rad),
            points_m: median(&|pose| translation_m(pose) + Self::RADIUS_M * rotation_rad(pose)),
        }
    }
}

/// Whether poses fit the scans.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum PoseFit {
    /// They do.
    Fits,
    /// They differ more than accurate poses do.
    Doubtful,
    /// They are of another motion, or fit with another meaning.
    Wrong,
}

/// Differences between the motion of given poses and that of the scans.
#[derive(Clone, Debug, PartialEq)]
pub struct PoseCheck {
    /// Motion of the scans.
    pub motion: MotionDifference,
    /// Difference of the poses as given.
    pub given: MotionDifference,
    /// The judgement of these.
    pub fit: PoseFit,
    /// Another meaning of the poses with which they fit, and its difference.
    pub better: Option<(PoseMeaning, MotionDifference)>,
}

/// Checks poses against scans, about ten in succession; `None` if the sensor stands, its motion is uncertain, or the scans
/// fit both the poses and another motion.
///
/// Where the scans show another motion, they are registered again, each from the given one. In a tunnel they fit there, too:
/// the rings of the beams look alike wherever the sensor is, so that the scans show no motion.
pub fn check_poses(
    scans: &[Scan],
    given: &GivenPoses,
    config: &OdometryConfig,
) -> Result<Option<PoseCheck>, TimingError> {
    let check = compare(&motions(scans, None, config, is_certain)?, given);
    let fits = |check: &PoseCheck| check.fit == PoseFit::Fits;
    if check.as_ref().is_none_or(fits) {
        return Ok(check);
    }
    let from_given = compare(&motions(scans, Some(given), config, |_| true)?, given);
    Ok(check.filter(|_| !from_given.as_ref().is_some_and(fits)))
}

/// Whether a scan shows all of its motion.
fn is_certain(step: &OdometryEstimate) -> bool {
    step.degenerate_directions.is_empty()
}

/// The motion to each scan that is registered and passes `is_used`. With `expected`, each scan is predicted by the motion of
/// these poses instead of constant velocity.
fn motions(
    scans: &[Scan],
    expected: Option<&GivenPoses>,
    config: &OdometryConfig,
    is_used: impl Fn(&OdometryEstimate) -> bool,
) -> Result<Vec<Option<Pose3>>, TimingError> {
    let mut odometer = Odometer::new(config.clone())?;
    let motion = |(row, scan): (usize, &Scan)| {
        if let Some(given) = expected.filter(|_| row > 0) {
            odometer.set_motion(scan, PoseMeaning::Given.motion(given, row - 1, row));
        }
        let step = odometer.step(scan)?;
        let is_registered = step.state == StepState::Registered;
        Ok((is_registered && is_used(&step)).then_some(step.previous_from_current))
    };
    scans.iter().enumerate().map(motion).collect()
}

/// Compares the motions to scans, as far as they are known, with poses.
fn compare(motions: &[Option<Pose3>], given: &GivenPoses) -> Option<PoseCheck> {
    /// Least number of motions.
    const MIN_MOTIONS: usize = 5;
    /// Motion below which the sensor stands [m].
    const STANDING_M: f64 = 0.1;
    /// Share of the motion above which a difference is that of another motion.
    const WRONG_SHARE: f64 = 0.5;
    /// Ratio of differences below which a meaning is better.
    const BETTER: f64 = 0.5;
    let known = || {
        let rows = (motions.iter().zip(given.map_from_lidar)).enumerate();
        rows.skip(1)
            .filter_map(|(row, (motion, _))| Some((row, (*motion)?)))
    };
    let count = known().count();
    if count < MIN_MOTIONS || 2 * count < motions.len() {
        return None;
    }
    let motion_of = |meaning: PoseMeaning, row: usize| meaning.motion(given, row - 1, row);
    let difference = |meaning: PoseMeaning| {
        let differences = known().map(|(row, motion)| motion_of(meaning, row).inverse() * motion);
        MotionDifference::median(&differences.collect::<Vec<_>>())
    };
    let scans: Vec<Pose3> = known().map(|(_, motion)| motion).collect();
    let poses: Vec<Pose3> = known()
        .map(|(row, _)| motion_of(PoseMeaning::Given, row))
        .collect();
    let motion = MotionDifference::median(&scans);
    let largest_m = (motion.points_m).max(MotionDifference::median(&poses).points_m);
    if largest_m < STANDING_M {
        return None;
    }
    let as_given = difference(PoseMeaning::Given);
    let fits = |difference: &MotionDifference| difference.points_m <= 0.1 + 0.1 * largest_m;
    let mut fit = match &as_given {
        given if fits(given) => PoseFit::Fits,
        given if given.points_m <= WRONG_SHARE * largest_m => PoseFit::Doubtful,
        _ => PoseFit::Wrong,
    };
    let others = PoseMeaning::ALL[1..]
        .iter()
        .map(|&other| (other, difference(other)));
    let better = others.min_by(|a, b| a.1.points_m.total_cmp(&b.1.points_m));
    let is_better = |(_, other): &(PoseMeaning, MotionDifference)| {
        fit != PoseFit::Fits && fits(other) && other.points_m < BETTER * as_given.points_m
    };
    let better = better.filter(is_better);
    if better.is_some() {
        fit = PoseFit::Wrong;
    }
    Some(PoseCheck {
        motion,
        given: as_given,
        fit,
        better,
    })
}

#[cfg(test)]
#[path = "pose_check_tests.rs"]
mod tests;
