//! Tracking of a car in a map, scan by scan, whatever its sensor.
//!
//! ```text
//! scan  →  front end  sensor, times of points, motion since the last scan: nothing of the map
//!       →  back end   pose, confirmed and recovered by the particle filter
//! ```
//!
//! The front end may be a scan ahead, in another thread.

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::config::LocalizerConfig;
use super::distortion_search::{DistortionSearch, GivenScan};
use super::error::TrackerError;
use super::estimate::Estimate;
use super::front_end::{FrontEnd, Measured};
use super::localizer::{Localizer, Start};
use super::odometry::{MotionOfScans, Odometry};
use super::tracking_loss::State;
use crate::lidar::Scan;
use crate::map::Map;
use crate::odometry::OdometryConfig;
use crate::sensor::{Sensor, SensorConfig};
use crate::validation::{InvalidValue, Validate, nested};

/// Configuration of a tracker.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, SmartDefault)]
#[cfg_attr(feature = "configuration", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct TrackerConfig {
    /// What is known about the sensor; the rest is inferred from the scans.
    pub sensor: SensorConfig,
    /// The localizer.
    pub localizer: LocalizerConfig,
    /// Odometry of the scans; `None`: the velocity is assumed constant where no motion is given.
    #[default(Some(OdometryConfig::default()))]
    pub odometry: Option<OdometryConfig>,
    /// Seed of all random choices.
    pub seed: u64,
}

impl Validate for TrackerConfig {
    fn validate(&self) -> Result<(), InvalidValue> {
        nested("sensor", &self.sensor)?;
        nested("localizer", &self.localizer)?;
        match &self.odometry {
            Some(odometry) => nested("odometry", odometry),
            None => Ok(()),
        }
    }
}

/// Estimates the pose of a car in a map from its scans, one after the other. The same seed gives the same estimates.
pub struct Tracker {
    front: FrontEnd,
    back: BackEnd,
    /// The scan that is localized next, where it was measured.
    measured: Option<Measured>,
}

impl Tracker {
    /// A tracker in a map, with a start that is unknown and a sensor that is inferred from the first scan if the
    /// configuration does not contain it.
    ///
    /// # Errors
    /// A field of the configuration is out of its range.
    pub fn new(map: &Map, config: TrackerConfig) -> Result<Self, TrackerError> {
        config.validate()?;
        Ok(Self {
            front: FrontEnd::new(config.sensor, config.odometry)?,
            back: BackEnd {
                map: map.clone(),
                config: config.localizer,
                seed: config.seed,
                start: Start::unknown(map),
                since_localized: MotionOfScans::default(),
                localizer: None,
                distortions: DistortionSearch::default(),
            },
            measured: None,
        })
    }

    /// The same tracker before its first scan, with a known start.
    #[must_use]
    pub fn with_start(mut self, start: Start) -> Self {
        self.back.start = start;
        self
    }

    /// The same tracker before its first scan, with a known sensor, in which the configured values take precedence.
    #[must_use]
    pub fn with_sensor(mut self, sensor: Sensor) -> Self {
        self.front.set_sensor(sensor);
        self
    }

    /// The same tracker for scans that do not wait: an inferred sensor is completed in a thread of its own, which takes seconds
    /// where times of points are compared. Which scan is the first with the complete sensor depends on the machine.
    #[must_use]
    pub fn in_real_time(mut self) -> Self {
        self.front.set_real_time();
        self
    }

    /// Forgets all scans but what they showed about the sensor: the next one is the first, at a start.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn restart(&mut self, start: Start) -> Result<(), TrackerError> {
        self.front.restart()?;
        self.back.restart(start);
        self.measured = None;
        Ok(())
    }

    /// Does before the first scan what does not depend on where the car is, as the panoramas of the map for the height of the
    /// sensor in a scan: it may take longer than the car waits. Estimates are the same without it.
    ///
    /// # Errors
    /// As [`step`](Self::step).
    pub fn prepare_start(&mut self, scan: &Scan) -> Result<(), TrackerError> {
        let sensor = self.front.sensor_in(scan)?;
        let mut localizer = self.back.begin(&sensor)?;
        Ok(localizer.prepare_start(&sensor.timed(scan))?)
    }

    /// The map.
    pub fn map(&self) -> &Map {
        &self.back.map
    }

    /// The sensor, as far as it is known; `None` before the first scan, unless it was given.
    pub fn sensor(&self) -> Option<&Sensor> {
        self.front.sensor()
    }

    /// The two halves, so that one scan is localized while the next one is measured.
    pub fn split(&mut self) -> (&mut FrontEnd, &mut BackEnd) {
        (&mut self.front, &mut self.back)
    }

    /// Estimates `map_from_lidar` at the moment of the next scan; the motion is that of the scans.
    ///
    /// # Errors
    /// The points do not fit the sensor, times of scans do not ascend, the start is outside of the map, or the map cannot be
    /// rendered.
    pub fn step(&mut self, scan: &Scan) -> Result<Estimate, TrackerError> {
        let odometry = self.measure(scan)?;
        self.step_with_motion(scan, odometry)
    }

    /// Measures the motion into the next scan since the last one that was localized; it is localized by
    /// [`step_with_motion`](Self::step_with_motion) afterwards. `Unknown` without odometry.
    ///
    /// # Errors
    /// The first scan has no points, from which the sensor is inferred, or times of scans do not ascend.
    pub fn measure(&mut self, scan: &Scan) -> Result<Odometry, TrackerError> {
        if let Some(before) = self.measured.take() {
            self.back.leave_out(&before);
        }
        let measured = self.front.measure(scan)?;
        let odometry = self.back.motion_into(&measured);
        self.measured = Some(measured);
        Ok(odometry)
    }

    /// Estimates `map_from_lidar` at the moment of the next scan, given the motion since the last one that was localized. The odometry of the
    /// scans ends with a scan that was not [measured](Self::measure).
    ///
    /// # Errors
    /// The motion is impossible; else as [`step`](Self::step).
    pub fn step_with_motion(
        &mut self,
        scan: &Scan,
        odometry: Odometry,
    ) -> Result<Estimate, TrackerError> {
        let measured = match self.measured.take() {
            Some(measured) => measured,
            None => self.front.unmeasured(scan)?,
        };
        self.back.step(scan, &measured, odometry)
    }
}

/// The half of a [`Tracker`] that needs the map.
pub struct BackEnd {
    map: Map,
    config: LocalizerConfig,
    seed: u64,
    start: Start,
    /// Motion since the last scan that was localized, over those that could not be.
    since_localized: MotionOfScans,
    /// `None` before the first scan.
    localizer: Option<Localizer>,
    /// Not used where the start is known.
    distortions: DistortionSearch,
}

impl BackEnd {
    /// The motion into a scan since the last one that was localized, as the scans show it.
    pub fn motion_into(&self, measured: &Measured) -> Odometry {
        let motion = |of_scan| self.since_localized.followed_by(of_scan).into();
        measured.motion.map_or(Odometry::Unknown, motion)
    }

    /// Estimates `map_from_lidar` at the moment of the next scan, given the motion since the last one that was localized.
    ///
    /// # Errors
    /// The motion is impossible, the points do not fit the sensor, the start is outside of the map, or the map cannot be
    /// rendered.
    pub fn step(
        &mut self,
        scan: &Scan,
        measured: &Measured,
        odometry: Odometry,
    ) -> Result<Estimate, TrackerError> {
        let mut localizer = match self.localizer.take() {
            Some(localizer) => localizer,
            None => self.begin(&measured.sensor)?,
        };
        localizer.set_own_car(measured.sensor.own_car_m);
        let scan = measured.timed.as_ref().unwrap_or(scan);
        let localizer = self.localizer.insert(localizer);
        let mut estimate = match localizer.step(scan, odometry) {
            Ok(estimate) => estimate,
            Err(error) => {
                self.leave_out(measured);
                return Err(error.into());
            }
        };
        self.since_localized = MotionOfScans::default();
        if matches!(self.start, Start::Pose { .. }) {
            return Ok(estimate);
        }
        let given = GivenScan {
            scan,
            odometry,
            own_car_m: measured.sensor.own_car_m,
            estimate: &estimate,
            is_followed: localizer.follows_a_pose(),
            range_factor: localizer.range_factor(),
        };
        let config = &self.config.tracking_loss;
        let begin = |pose| localizer.begin_undistorted(pose);
        if let Some(distortion) = self.distortions.judge(given, config, begin) {
            estimate.state = State::Lost;
            estimate.distortion = Some(distortion);
        }
        Ok(estimate)
    }

    /// Remembers the motion into a scan that is not localized.
    fn leave_out(&mut self, measured: &Measured) {
        let motion = measured.motion.unwrap_or_default();
        self.since_localized = self.since_localized.followed_by(motion);
    }

    fn restart(&mut self, start: Start) {
        self.start = start;
        self.since_localized = MotionOfScans::default();
        self.localizer = None;
        self.distortions = DistortionSearch::default();
    }

    /// The localizer before the first scan.
    fn begin(&self, sensor: &Sensor) -> Result<Localizer, TrackerError> {
        let (config, start) = (self.config.clone(), self.start.clone());
        Ok(Localizer::new(&self.map, sensor, config, start, self.seed)?)
    }
}

#[cfg(test)]
#[path = "tracker_tests.rs"]
mod tests;
