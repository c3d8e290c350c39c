//! State of the filter between frames, and its estimate.

use std::time::Duration;

use nalgebra::Matrix3;

use super::phase::{Phase, Search};
use crate::geometry::{Pose2, Pose3, pose2_from_pose3};
use crate::lidar::PERIOD_S;
use crate::localization::config::LocalizerConfig;
use crate::localization::convergence::is_narrow;
use crate::localization::estimate::Estimate;
use crate::localization::odometry::Odometry;
use crate::localization::particles::{ParticleSet, long_axis_m};
use crate::localization::tracking_loss::AgreementMonitor;
use crate::map::{GroundPatch, Map, PanoramaRequest, SensorAttitude};
use crate::rendering::RenderError;

/// A distribution over planar poses, `map_from_lidar`, updated frame by frame.
pub struct ParticleFilter {
    pub(super) config: LocalizerConfig,
    pub(super) map: Map,
    /// Panoramas of the places where the search restarts once tracking is lost; without them the
    /// filter reports the loss and stays lost.
    pub(super) restart: Option<PanoramaRequest>,
    pub(super) particles: ParticleSet,
    pub(super) phase: Phase,
    pub(super) agreement: AgreementMonitor,
    /// The last update, or what is known before the first.
    pub(super) updated: Updated,
    /// Motion since then; `None` before the first update.
    pub(super) pending: Option<Pending>,
    /// Motion between the last updates, for frames without odometry; `None` while unknown.
    pub(super) last_motion: Option<LastMotion>,
    /// Time since the previous frame [s].
    pub(super) duration_s: f64,
    /// Start of the registration of the next scan; the prediction if `None`.
    pub(super) registration_start: Option<Pose3>,
    /// Last known ground below the estimate.
    pub(super) patch: Option<GroundPatch>,
    /// Of the last estimate; `None` before the first.
    pub(super) in_space: Option<InSpace>,
    /// Pose in space of the next frame, where a motion in space leads to it while tracking.
    pub(super) predicted: Option<Pose3>,
}

/// Estimate of an update.
pub(super) struct Updated {
    pub pose: Pose2,
    /// Its covariance, without the error of the map [m², m·rad, rad²].
    pub covariance: Matrix3<f64>,
    /// Whether the distribution around it was narrow.
    pub is_narrow: bool,
    /// Whether its scan refuted the prediction, or replaced one that no scan confirmed.
    pub refuted: bool,
    /// Whether others around the prediction fitted alike.
    pub is_one_of_several: bool,
    /// How long the poses have been doubtful [s]: refuted, or others fit as well, so that those around the next prediction are
    /// compared, too. `None` where this one is not.
    pub doubtful_s: Option<f64>,
}

/// Motion since the last update.
#[derive(Clone, Copy, Default)]
pub(super) struct Pending {
    /// `updated_from_current`.
    pub motion: Pose2,
    /// Duration of the velocity commands in it.
    pub duration: Duration,
}

/// Motion between two updates.
pub(super) struct LastMotion {
    /// `previous_from_updated`.
    pub increment: Pose2,
    pub duration_s: f64,
}

/// Pose of a sensor in space, and its attitude above the ground there.
#[derive(Clone, Copy)]
pub(super) struct InSpace {
    pub map_from_lidar: Pose3,
    pub attitude: SensorAttitude,
}

/// Attitude of the sensor above a ground: that of a pose in space, where it is known, else a given one.
pub(super) fn attitude_above(
    ground: &GroundPatch,
    in_space: Option<Pose3>,
    given: &SensorAttitude,
) -> SensorAttitude {
    in_space.map_or(*given, |map_from_lidar| ground.attitude_of(&map_from_lidar))
}

impl Updated {
    /// The estimate that particles give by themselves.
    pub fn from_particles(particles: &ParticleSet) -> Self {
        let pose = particles.mean();
        Self {
            pose,
            covariance: particles.covariance_about(&pose),
            is_narrow: false,
            refuted: false,
            is_one_of_several: false,
            doubtful_s: None,
        }
    }
}

impl ParticleFilter {
    /// Starts with a distribution; see [`initialization`](crate::localization::initialization).
    ///
    /// # Errors
    /// That of the tile of the map under the distribution.
    pub fn new(
        config: LocalizerConfig,
        map: Map,
        restart: Option<PanoramaRequest>,
        particles: ParticleSet,
    ) -> Result<Self, RenderError> {
        let updated = Updated::from_particles(&particles);
        let level_m = particles.best().level_m;
        Ok(Self {
            patch: map.ground.patch_under(&updated.pose, level_m)?,
            phase: Phase::searching(Search::from_particles(&particles, &config.places)),
            config,
            map,
            restart,
            particles,
            agreement: AgreementMonitor::default(),
            updated,
            pending: None,
            last_motion: None,
            duration_s: PERIOD_S,
            registration_start: None,
            in_space: None,
            predicted: None,
        })
    }

    /// The same filter before its first scan, whose particles are in the places that resemble this scan: several ones, also where
    /// all of the map is as small as the surroundings of a pose.
    #[must_use]
    pub fn searching_anywhere(mut self) -> Self {
        self.phase = Phase::searching(Search::Anywhere);
        self
    }

    /// Whether one pose is followed, also where it is not certain.
    pub fn follows_a_pose(&self) -> bool {
        self.phase.is_tracking()
    }

    /// Sets the time between the previous frame and the next [s].
    pub fn set_duration_s(&mut self, duration_s: f64) {
        self.duration_s = duration_s;
    }

    /// Sets the pose at which the registration of the next scan starts: that of [`registered`](Self::registered).
    pub fn set_registration_start(&mut self, start: Option<Pose3>) {
        self.registration_start = start;
    }

    /// Follows the sensor by a motion. Returns its attitude, with which the next frame begins: while tracking it comes from the map,
    /// which is more accurate than the ground plane of a single scan; `None` while not tracking. A motion in space is followed in
    /// space: under a sensor that is carried, the ground may rise by a step.
    pub fn predict(&mut self, odometry: Odometry) -> Result<Option<SensorAttitude>, RenderError> {
        self.predicted = None;
        let proposes = self.config.proposal.scan && self.phase.is_tracking();
        let Some(last) = self.in_space.filter(|_| proposes) else {
            return Ok(None);
        };
        let Some(motion) = odometry.in_space() else {
            return Ok(Some(last.attitude));
        };
        let map_from_lidar = last.map_from_lidar * motion;
        self.predicted = Some(map_from_lidar);
        let ground = self.ground_at(&pose2_from_pose3(&map_from_lidar))?;
        Ok(Some(ground.attitude_of(&map_from_lidar)))
    }

    /// Estimate of a frame at a pose and in space there, which is kept. `covariance` is without the error of the map, which is added.
    pub(super) fn estimate_of(
        &mut self,
        pose: Pose2,
        particles: ParticleSet,
        covariance: Matrix3<f64>,
        in_space: InSpace,
    ) -> Result<Estimate, RenderError> {
        let found = self.patch_at(&pose)?;
        self.patch = found.or(self.patch);
        self.in_space = Some(in_space);
        let covariance = covariance + self.config.proposal.registration.of_map();
        Ok(Estimate {
            pose,
            map_from_lidar: in_space.map_from_lidar,
            attitude: in_space.attitude,
            level_m: self.patch.map(|patch| patch.height_m),
            covariance,
            effective_sample_size: particles.effective_sample_size(),
            mean_cost_m: None,
            agreement: None,
            places: self.likely_places(),
            state: self.phase.reported(self.is_precise(&covariance)),
            distortion: None,
            updated: false,
            on_mapped_ground: found.is_some(),
            motion: None,
            particles,
        })
    }

    /// A pose in space, by the attitude of the sensor above `ground` or, without that, above the ground below it.
    pub(super) fn lift(
        &self,
        pose: &Pose2,
        attitude: &SensorAttitude,
        ground: Option<GroundPatch>,
    ) -> Result<InSpace, RenderError> {
        let below = self.ground_at(pose)?;
        let map_from_lidar = ground.unwrap_or(below).lift(pose, attitude);
        let attitude = match ground {
            Some(_) => below.attitude_of(&map_from_lidar),
            None => *attitude,
        };
        Ok(InSpace {
            map_from_lidar,
            attitude,
        })
    }

    /// The ground below a pose, or the last known one.
    pub(super) fn ground_at(&self, pose: &Pose2) -> Result<GroundPatch, RenderError> {
        Ok(self.patch_at(pose)?.or(self.patch).unwrap_or_default())
    }

    /// Whether a position with a covariance is certain enough to be reported as tracked.
    pub(super) fn is_precise(&self, covariance: &Matrix3<f64>) -> bool {
        long_axis_m(covariance) <= self.config.tracking_loss.sure_spread_m
    }

    /// Ground patch under a pose near the particles.
    pub(super) fn patch_at(&self, pose: &Pose2) -> Result<Option<GroundPatch>, RenderError> {
        Ok(self.map.ground.patch_under(pose, self.level_m())?)
    }

    /// Height of the ground below the best particle [m].
    pub(super) fn level_m(&self) -> Option<f64> {
        self.particles.best().level_m
    }

    pub(super) fn is_narrow(&self) -> bool {
        is_narrow(&self.particles, &self.config.convergence)
    }
}
