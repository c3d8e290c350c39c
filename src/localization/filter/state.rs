//! State of the filter between frames, and its estimate.

use std::time::Duration;

use nalgebra::{Matrix3, Vector3};

use crate::geometry::Pose2;
use crate::lidar::PERIOD_S;
use crate::localization::config::LocalizerConfig;
use crate::localization::convergence::is_narrow;
use crate::localization::estimate::Estimate;
use crate::localization::particles::{ParticleSet, long_axis_m, spread};
use crate::localization::tracking_loss::{AgreementMonitor, State};
use crate::map::{GroundPatch, Map, PanoramaRequest, SensorAttitude};

/// A distribution over planar poses, `map_from_lidar`, updated frame by frame.
pub struct ParticleFilter {
    pub(super) config: LocalizerConfig,
    pub(super) map: Map,
    /// Panoramas of the places where the search restarts once tracking is lost; without them the
    /// filter reports the loss and stays lost.
    pub(super) restart: Option<PanoramaRequest>,
    pub(super) particles: ParticleSet,
    /// Motion since the last update, `updated_from_current`.
    pub(super) pending: Pose2,
    /// Duration of the velocity commands since the last update.
    pub(super) pending_duration: Duration,
    /// Last estimate of an updated frame.
    pub(super) estimate: Pose2,
    /// Its covariance [m², m·rad, rad²].
    pub(super) covariance: Matrix3<f64>,
    /// Whether the distribution around it was narrow.
    pub(super) is_narrow: bool,
    /// Motion into it, for frames without odometry; `None` while unknown.
    pub(super) last_increment: Option<Pose2>,
    /// Duration of that motion [s].
    pub(super) last_duration_s: f64,
    /// Time since the previous frame [s].
    pub(super) duration_s: f64,
    /// Last known ground below the estimate.
    pub(super) patch: Option<GroundPatch>,
    pub(super) attitude: Option<SensorAttitude>,
    pub(super) state: State,
    pub(super) agreement: AgreementMonitor,
    pub(super) updates_in_state: usize,
    /// Whether the pose was confirmed since the distribution was last too wide for it to be called tracked.
    pub(super) is_sure: bool,
    pub(super) search: Search,
    pub(super) is_first: bool,
}

/// What the particles represent until the filter tracks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Search {
    /// The surroundings of a known start.
    Around,
    /// Many places, none of them registered yet.
    Anywhere,
    /// Places with their weights.
    Places {
        /// Number of places that are likely.
        likely: usize,
    },
}

impl Search {
    /// Of particles with which a search starts.
    pub fn of(particles: &ParticleSet) -> Self {
        /// Standard deviation of the position around a known start, at most [m].
        const AROUND_M: f64 = 10.0;
        match spread(&particles.covariance_about(&particles.mean())).0 > AROUND_M {
            true => Self::Anywhere,
            false => Self::Around,
        }
    }
}

impl ParticleFilter {
    /// Starts with a distribution; see [`initialization`](crate::localization::initialization).
    pub fn new(
        config: LocalizerConfig,
        map: Map,
        restart: Option<PanoramaRequest>,
        particles: ParticleSet,
    ) -> Self {
        let estimate = particles.mean();
        Self {
            patch: map.ground.patch_under(&estimate, particles.best().level_m),
            config,
            map,
            restart,
            covariance: particles.covariance_about(&estimate),
            search: Search::of(&particles),
            particles,
            pending: Pose2::identity(),
            pending_duration: Duration::ZERO,
            estimate,
            is_narrow: false,
            last_increment: None,
            last_duration_s: PERIOD_S,
            duration_s: PERIOD_S,
            attitude: None,
            state: State::Searching,
            agreement: AgreementMonitor::default(),
            updates_in_state: 0,
            is_sure: true,
            is_first: true,
        }
    }

    /// Sets the time between the previous frame and the next [s].
    pub fn set_duration_s(&mut self, duration_s: f64) {
        self.duration_s = duration_s;
    }

    /// Searching, tracking or lost.
    pub fn state(&self) -> State {
        self.state
    }

    /// The particles with which the next frame starts.
    pub fn particles(&self) -> &ParticleSet {
        &self.particles
    }

    /// Attitude of the sensor in the last frame if it is a good start for the next: while tracking it
    /// comes from the map, which is more accurate than the ground plane of a single scan.
    pub fn attitude(&self) -> Option<SensorAttitude> {
        let proposes = self.config.proposal.scan && self.state == State::Tracking;
        self.attitude.filter(|_| proposes)
    }

    /// Estimate of a frame whose scan was not used, in space on the ground below it or, without any, on
    /// the last known ground.
    pub(super) fn estimate_of(
        &mut self,
        pose: Pose2,
        particles: ParticleSet,
        covariance: Matrix3<f64>,
        attitude: &SensorAttitude,
    ) -> Estimate {
        let found = self.patch_at(&pose);
        self.patch = found.or(self.patch);
        let level = GroundPatch {
            height_m: 0.0,
            normal: Vector3::z(),
        };
        Estimate {
            pose,
            map_from_lidar: self.patch.unwrap_or(level).lift(&pose, attitude),
            attitude: *attitude,
            level_m: self.patch.map(|patch| patch.height_m),
            covariance,
            effective_sample_size: particles.effective_sample_size(),
            mean_cost_m: None,
            agreement: None,
            places: self.likely_places(),
            state: self.reported_state(&covariance),
            updated: false,
            on_mapped_ground: found.is_some(),
            motion: None,
            particles,
        }
    }

    /// The state, of a frame whose estimate has a covariance: tracking only if that is small.
    pub(super) fn reported_state(&self, covariance: &Matrix3<f64>) -> State {
        match self.state {
            State::Tracking if !self.is_sure || self.is_too_wide(covariance) => State::Searching,
            state => state,
        }
    }

    /// Whether a position with a covariance is too uncertain to be called tracked.
    pub(super) fn is_too_wide(&self, covariance: &Matrix3<f64>) -> bool {
        long_axis_m(covariance) > self.config.tracking_loss.sure_spread_m
    }

    /// Ground patch under a pose near the particles.
    pub(super) fn patch_at(&self, pose: &Pose2) -> Option<GroundPatch> {
        self.map.ground.patch_under(pose, self.level_m())
    }

    /// Height of the ground below the best particle [m].
    pub(super) fn level_m(&self) -> Option<f64> {
        self.particles.best().level_m
    }

    pub(super) fn is_narrow(&self) -> bool {
        is_narrow(&self.particles, &self.config.convergence)
    }
}
