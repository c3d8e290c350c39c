//! What is known between two scans: the state with its reason, and the pose while it is believed.
//!
//! As REP-105 (Meeussen, *Coordinate Frames for Mobile Platforms*, 2010) has it, the localization says where the odometry
//! began, which does not change while the robot moves:
//!
//! ```text
//! map_from_odom = map_from_lidar(scan) · odom_from_lidar(scan)⁻¹
//! map_from_lidar(now) = map_from_odom · odom_from_lidar(now)
//! ```

use std::time::Duration;

use nalgebra::Matrix3;

use super::state::{LiveState, Reason};
use crate::geometry::{Pose3, pose2_from_pose3};
use crate::localization::motion::{OdometryNoise, TurnDriveTurn, jacobian_of_step};
use crate::localization::particles::spread;
use crate::localization::{Estimate, LocalizerConfig, State, TrackingLossConfig};

/// Longest time over which a motion that nobody measures is extrapolated: a car that brakes leaves a prediction of
/// constant velocity by ½ a t². With the deceleration that drivers are comfortable with, a = 3.4 m/s² (AASHTO, *A Policy on
/// Geometric Design of Highways and Streets*, stopping sight distance), these are the 2 m of
/// `tracking_loss.max_spread_m` after 1.1 s.
pub(super) const LONGEST_COAST: Duration = Duration::from_millis(1100);

/// Scans in turn that are missing when the sensor is called stalled: of best-effort messages single ones get lost.
const MISSING_SCANS: u32 = 2;

/// The localization between two scans.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LivePose {
    /// `p_map = map_from_lidar * p_lidar`, extrapolated to the moment that was asked for.
    pub map_from_lidar: Pose3,
    /// Covariance of (x, y, heading) at that moment [m², m·rad, rad²].
    pub covariance: Matrix3<f64>,
}

/// Why no scan is localized.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outage {
    /// No scan arrives.
    NoScans,
    /// Scans that cannot be used: damaged, repeated, or of another sensor.
    UnusableScans,
}

/// The last estimate while the pose is believed.
#[derive(Clone, Copy, Debug)]
struct Believed {
    map_from_lidar: Pose3,
    odom_from_lidar: Pose3,
    covariance: Matrix3<f64>,
}

/// Follows the estimates of a tracker.
#[derive(Clone, Debug)]
pub struct Monitor {
    limits: TrackingLossConfig,
    noise: OdometryNoise,
    reason: Reason,
    odom_from_lidar: Pose3,
    believed: Option<Believed>,
}

impl Monitor {
    /// A monitor before the first scan.
    pub fn new(config: &LocalizerConfig) -> Self {
        Self {
            limits: config.tracking_loss.clone(),
            noise: config.motion.clone(),
            reason: Reason::NoScan,
            odom_from_lidar: Pose3::identity(),
            believed: None,
        }
    }

    /// Why the localization is in its state.
    pub fn reason(&self) -> Reason {
        self.reason
    }

    /// The state.
    pub fn state(&self) -> LiveState {
        self.reason.state()
    }

    /// Takes an estimate, and the motion `previous_from_current` since the one before.
    pub fn update(&mut self, estimate: &Estimate, motion: &Pose3) {
        let odom_from_lidar = self.odom_from_lidar * motion;
        self.update_in_odom(estimate, &odom_from_lidar);
    }

    /// Takes an estimate, and where the odometry has the sensor at its scan.
    pub fn update_in_odom(&mut self, estimate: &Estimate, odom_from_lidar: &Pose3) {
        self.odom_from_lidar = *odom_from_lidar;
        // Products of many motions are no rotations any more.
        self.odom_from_lidar.rotation.renormalize();
        self.set(self.reason_of(estimate));
        if self.state().is_believed() {
            self.believed = Some(Believed {
                map_from_lidar: estimate.map_from_lidar,
                odom_from_lidar: self.odom_from_lidar,
                covariance: estimate.covariance,
            });
        }
    }

    /// Notes something that is no estimate. A pose that was believed is not any more where the reason leads to such a state.
    pub fn set(&mut self, reason: Reason) {
        self.reason = reason;
        if !self.state().is_believed() {
            self.believed = None;
        }
    }

    /// Notes that no scan was localized for a time, of a sensor with a period; `moved` is the motion since the last one, where
    /// it is measured.
    pub fn wait(
        &mut self,
        outage: Outage,
        waited: Duration,
        period: Duration,
        moved: Option<&Pose3>,
    ) {
        if !self.state().is_believed() || waited <= (1 + MISSING_SCANS) * period {
            return;
        }
        let is_too_long = match moved {
            Some(moved) => (self.pose_after(moved))
                .is_none_or(|after| spread(&after.covariance).0 > self.limits.max_spread_m),
            None => waited > LONGEST_COAST,
        };
        self.set(match (outage, is_too_long) {
            (Outage::NoScans, false) => Reason::SensorStalled,
            (Outage::NoScans, true) => Reason::StalledTooLong,
            (Outage::UnusableScans, false) => Reason::ScansUnusable,
            (Outage::UnusableScans, true) => Reason::UnusableTooLong,
        });
    }

    /// Whether no scan is localized, and the pose is believed: the motion carries it.
    pub fn is_carried(&self) -> bool {
        matches!(self.reason, Reason::SensorStalled | Reason::ScansUnusable)
    }

    /// `p_map = map_from_odom * p_odom` while the pose is believed.
    pub fn map_from_odom(&self) -> Option<Pose3> {
        let believed = self.believed.as_ref()?;
        Some(believed.map_from_lidar * believed.odom_from_lidar.inverse())
    }

    /// The pose after a motion since the last scan, while it is believed.
    pub fn pose_after(&self, moved: &Pose3) -> Option<LivePose> {
        let believed = self.believed.as_ref()?;
        Some(LivePose {
            map_from_lidar: believed.map_from_lidar * moved,
            covariance: self.covariance_after(believed, moved),
        })
    }

    /// Covariance of (x, y, heading) after a motion since the last scan: F P Fᵀ + R Q Rᵀ, where F moves the position across by
    /// the heading, and R turns the noise Q of the motion into the axes of the map. Without a motion that of the scan.
    fn covariance_after(&self, believed: &Believed, moved: &Pose3) -> Matrix3<f64> {
        if *moved == Pose3::identity() {
            return believed.covariance;
        }
        let before = pose2_from_pose3(&believed.map_from_lidar);
        let motion = pose2_from_pose3(moved);
        let step = before.rotation * motion.translation.vector;
        let carry = jacobian_of_step(&step);
        let (sin, cos) = before.rotation.angle().sin_cos();
        let turn = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
        let noise = self.noise.covariance(&TurnDriveTurn::decompose(&motion));
        carry * believed.covariance * carry.transpose() + turn * noise * turn.transpose()
    }

    /// The reason of an estimate. A pose that was followed before and that the filter does not confirm is still followed:
    /// the filter searches elsewhere only after it was lost.
    fn reason_of(&self, estimate: &Estimate) -> Reason {
        let was_followed = self.state().is_believed();
        let is_scattered = spread(&estimate.covariance).0 > self.limits.max_spread_m;
        let disagrees = estimate
            .agreement
            .is_some_and(|it| it < self.limits.min_agreement);
        match estimate.state {
            State::Tracking => Reason::ScanAgrees,
            State::Searching if was_followed => Reason::PositionImprecise,
            State::Searching if estimate.places > 1 => Reason::SeveralPlaces,
            State::Searching if self.reason == Reason::PoseProposed => Reason::PoseProposed,
            State::Searching => Reason::PositionUnknown,
            State::Lost if was_followed && is_scattered => Reason::ParticlesScattered,
            State::Lost if was_followed || disagrees => Reason::ScanDisagrees,
            State::Lost => Reason::NoPlaceFound,
        }
    }
}

#[cfg(test)]
#[path = "monitor_tests.rs"]
mod tests;
