//! Search for a [`Distortion`] of the scans of a drive, with an unknown start: y of the wrong sign, as left-handed drivers write it, or
//! ranges that are too long or too short.
//!
//! ```text
//! suspect   while no pose is tracked, another localizer takes the scans with one distortion after another undone; while one is, with
//!           their ranges times the factor that fits the map there, unless it is one
//! named     it tracks a pose in several scans, and they agree better there than those that were given agree with theirs
//! ```
//!
//! A right pose of undistorted scans is not doubted: where a street looks alike from both sides, they agree as well. Distorted scans that are
//! tracked from the first one on are not noticed before they are lost, unless their ranges are off.

use super::distortion::Distortion;
use super::estimate::Estimate;
use super::localizer::Localizer;
use super::odometry::Odometry;
use super::tracking_loss::{AgreementMonitor, State, TrackingLossConfig};
use crate::geometry::Pose3;
use crate::lidar::Scan;

/// Number of times that each distortion is suspected in turn.
const ROUNDS: usize = 2;
/// Scans within which a pose has to be tracked without a distortion.
const PATIENCE: usize = 5;

/// Whether a factor of ranges is not one.
fn differs_from_one(factor: f64) -> bool {
    /// Twice the largest difference from one at right poses (`docs/method.md`, Distorted scans).
    const LARGEST: f64 = 0.01;
    (factor - 1.0).abs() > LARGEST
}

/// A scan as it was given, and what was found of it.
#[derive(Clone, Copy)]
pub(super) struct GivenScan<'a> {
    pub scan: &'a Scan,
    pub odometry: Odometry,
    /// Rectangle of the own car: x_min, x_max, y_min, y_max [m].
    pub own_car_m: [f32; 4],
    pub estimate: &'a Estimate,
    /// Whether one pose is followed, also where it is not certain.
    pub is_followed: bool,
    /// The factor by which its ranges fit the map best at the pose that it tracks, where that was measured.
    pub range_factor: Option<f64>,
}

/// Search for a distortion of the scans of a drive. Its localizers search the whole map, whose panoramas a search near a known start may do
/// without.
#[derive(Default)]
pub(super) struct DistortionSearch {
    /// Number of scans since a pose was followed.
    without_pose: usize,
    /// Number of distortions that were suspected while none was.
    suspected: usize,
    /// Number of distortions that were suspected by the factor of the ranges.
    suspected_by_factor: usize,
    /// A distortion of which scans were tracked, until they are not again.
    certain: Option<Distortion>,
    suspect: Option<Suspect>,
}

/// A localizer that takes scans with a distortion undone.
struct Suspect {
    distortion: Distortion,
    localizer: Box<Localizer>,
    /// Number of scans that it used.
    scans: usize,
    /// Number of them in which it tracks a pose.
    tracked: usize,
    /// That of the last scan; `None` if it could not be localized.
    estimate: Option<Estimate>,
    agreement: AgreementMonitor,
    /// The agreement of the scans as they were given, while they track a pose.
    given: AgreementMonitor,
}

impl DistortionSearch {
    /// Compares a scan with itself without a distortion; `begin` gives another localizer, with a start near a pose or an unknown one. Returns
    /// the distortion that is certain, if any: the estimate is not to be used.
    pub fn judge(
        &mut self,
        given: GivenScan<'_>,
        config: &TrackingLossConfig,
        begin: impl Fn(Option<Pose3>) -> Option<Localizer>,
    ) -> Option<Distortion> {
        let is_tracking = given.estimate.state == State::Tracking;
        self.without_pose = if given.is_followed {
            0
        } else {
            self.without_pose + 1
        };
        if self.suspect.is_none() {
            let (distortion, pose) = self.next_distortion(&given, config)?;
            self.suspect = begin(pose).map(|localizer| Suspect::new(distortion, localizer));
        }
        let suspect = self.suspect.as_mut()?;
        suspect.step(&given, config);
        let is_right =
            is_tracking && suspect.has_decided(self.certain) && !suspect.is_better(&given, config);
        if is_right || suspect.is_given_up() {
            let is_kept = !is_right && suspect.tracked > 0;
            self.certain = self.certain.filter(|_| is_kept);
            self.suspect = None;
        } else if suspect.tracked >= config.confirming_updates {
            self.certain = Some(suspect.distortion);
        }
        self.certain
    }

    /// The next distortion to suspect, and where: at a pose that is tracked, where the factor of the ranges is not one; else anywhere, as long
    /// as no pose is followed.
    fn next_distortion(
        &mut self,
        given: &GivenScan<'_>,
        config: &TrackingLossConfig,
    ) -> Option<(Distortion, Option<Pose3>)> {
        /// Most distortions that are suspected by the factor of the ranges.
        const MOST: usize = 10;
        /// Scans between two that are suspected after all rounds.
        const PAUSE: usize = 10;
        if let Some(certain) = self.certain {
            return Some((certain, None));
        }
        if let Some(ratio) = given.range_factor.filter(|&ratio| differs_from_one(ratio)) {
            self.suspected_by_factor += 1;
            let distortion = Distortion::Scaled {
                factor: 1.0 / ratio,
            };
            let pose = given.estimate.map_from_lidar;
            return (self.suspected_by_factor <= MOST).then_some((distortion, Some(pose)));
        }
        let is_lost = given.estimate.state == State::Lost;
        let is_unknown = is_lost || self.without_pose > config.confirming_updates;
        let all = Distortion::all();
        let in_rounds = self.suspected < ROUNDS * all.clone().count();
        let is_due = in_rounds || self.without_pose.is_multiple_of(PAUSE);
        if given.is_followed || !is_unknown || !is_due {
            return None;
        }
        let next = all.cycle().nth(self.suspected);
        self.suspected += 1;
        next.map(|distortion| (distortion, None))
    }
}

impl Suspect {
    fn new(distortion: Distortion, localizer: Localizer) -> Self {
        Self {
            distortion,
            localizer: Box::new(localizer),
            scans: 0,
            tracked: 0,
            estimate: None,
            agreement: AgreementMonitor::default(),
            given: AgreementMonitor::default(),
        }
    }

    /// Localizes a scan without the distortion, and remembers how much of it agrees with and without.
    fn step(&mut self, given: &GivenScan<'_>, config: &TrackingLossConfig) {
        let distortion = self.distortion;
        let own_car_m = distortion.undistort_rectangle(given.own_car_m);
        self.localizer.set_own_car(own_car_m);
        let (scan, odometry) = (
            distortion.undistort(given.scan),
            distortion.undistort_motion(given.odometry),
        );
        self.estimate = self.localizer.step(&scan, odometry).ok();
        if let Some(found) = self.estimate.as_ref().filter(|found| found.updated) {
            self.scans += 1;
            if found.state == State::Tracking {
                self.tracked += 1;
                self.agreement.observe(found.agreement, config);
            }
        }
        if given.estimate.state == State::Tracking {
            self.given.observe(given.estimate.agreement, config);
        } else {
            self.given = AgreementMonitor::default();
        }
        if let (Distortion::Scaled { factor }, Some(ratio)) =
            (&mut self.distortion, self.localizer.range_factor())
        {
            *factor /= ratio;
        }
    }

    /// Whether it shows something where the given scans track a pose. A distortion that was certain has all of its scans for it.
    fn has_decided(&self, certain: Option<Distortion>) -> bool {
        certain.is_none() || self.tracked > 0
    }

    /// Whether it tracks a pose that the given scans do not have: those of a left-handed frame agree so much less that another pose would
    /// be looked for; those whose ranges are off agree less, at another pose.
    fn is_better(&self, given: &GivenScan<'_>, config: &TrackingLossConfig) -> bool {
        let Some(found) = self.estimate.as_ref().filter(|_| self.tracked > 0) else {
            return false;
        };
        let usual = self.given.usual();
        match self.distortion {
            Distortion::Mirrored => self.agreement.suggests_another_pose(usual, config),
            Distortion::Scaled { .. } => {
                let between = found.pose.inverse() * given.estimate.pose;
                let is_elsewhere = between.translation.vector.norm() > config.sure_spread_m;
                is_elsewhere && usual < self.agreement.usual()
            }
        }
    }

    /// Whether it is lost, did not track a pose in time, or has a factor that is one or is not searched for.
    fn is_given_up(&self) -> bool {
        const SEARCHED: std::ops::RangeInclusive<f64> = 0.7..=1.4;
        let state = (self.estimate.as_ref()).map_or(State::Lost, |estimate| estimate.state);
        let is_scaled = |factor| differs_from_one(factor) && SEARCHED.contains(&factor);
        let is_possible = match self.distortion {
            Distortion::Mirrored => true,
            Distortion::Scaled { factor } => is_scaled(factor),
        };
        state == State::Lost || !is_possible || self.tracked == 0 && self.scans >= PATIENCE
    }
}
