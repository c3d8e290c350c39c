//! Tracking of a car in a map, scan by scan, whatever its sensor.
//!
//! ```text
//! scan  →  sensor     given, else inferred from the first scan; own car and times of points
//!                     once scans in motion show them
//!       →  odometer   motion since the last scan, unless it is given
//!       →  localizer  pose, confirmed and recovered by the particle filter
//! ```

use std::borrow::Cow;

use serde::{Deserialize, Serialize};
use smart_default::SmartDefault;

use super::config::LocalizerConfig;
use super::estimate::Estimate;
use super::localizer::{Localizer, LocalizerError, Start};
use super::odometry::Odometry;
use crate::geometry::Pose3;
use crate::lidar::Scan;
use crate::map::Map;
use crate::odometry::{Odometer, OdometryConfig, OdometryError};
use crate::sensor::{Sensor, SensorConfig, SensorError, TIMING_SCANS};
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

/// Why a scan cannot be tracked.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum TrackerError {
    #[error(transparent)]
    Invalid(#[from] InvalidValue),
    #[error(transparent)]
    Sensor(#[from] SensorError),
    #[error(transparent)]
    Odometry(#[from] OdometryError),
    #[error(transparent)]
    Localizer(#[from] LocalizerError),
}

/// Estimates the pose of a car in a map from its scans, one after the other. The same seed gives the same estimates.
pub struct Tracker {
    map: Map,
    config: TrackerConfig,
    start: Start,
    /// `None` before the first scan, unless it was given.
    sensor: Option<Sensor>,
    /// The last scans, while an inferred sensor is not complete.
    shown: Option<Vec<Scan>>,
    /// `None` where it is not wanted, and since it missed a scan.
    odometer: Option<Odometer>,
    /// Motion since the last scan that was localized.
    previous_from_current: Pose3,
    /// Whether the odometer has seen the scan that is localized next.
    is_measured: bool,
    /// `None` before the first scan.
    localizer: Option<Localizer>,
}

impl Tracker {
    /// A tracker in a map, with a start that is unknown and a sensor that is inferred from the first scan if the
    /// configuration does not contain it.
    ///
    /// # Errors
    /// A field of the configuration is out of its range.
    pub fn new(map: &Map, config: TrackerConfig) -> Result<Self, TrackerError> {
        config.validate()?;
        let sensor = Sensor::configured(&config.sensor);
        Ok(Self {
            map: map.clone(),
            start: Start::unknown(map),
            shown: sensor.is_none().then(Vec::new),
            sensor,
            odometer: config.odometry.clone().map(Odometer::new).transpose()?,
            previous_from_current: Pose3::identity(),
            is_measured: false,
            localizer: None,
            config,
        })
    }

    /// The same tracker before its first scan, with a known start.
    #[must_use]
    pub fn with_start(mut self, start: Start) -> Self {
        self.start = start;
        self
    }

    /// The same tracker before its first scan, with a known sensor, in which the configured values take precedence.
    #[must_use]
    pub fn with_sensor(mut self, sensor: Sensor) -> Self {
        self.sensor = Some(sensor.with_known(&self.config.sensor));
        self.shown = None;
        self
    }

    /// Forgets all scans but what they showed about the sensor: the next one is the first, at a start.
    ///
    /// # Errors
    /// As [`new`](Self::new).
    pub fn restart(&mut self, start: Start) -> Result<(), TrackerError> {
        self.start = start;
        self.odometer = (self.config.odometry.clone())
            .map(Odometer::new)
            .transpose()?;
        self.previous_from_current = Pose3::identity();
        self.is_measured = false;
        self.localizer = None;
        Ok(())
    }

    /// Does before the first scan what does not depend on where the car is, as the panoramas of the map for the height of the
    /// sensor in a scan: it may take longer than the car waits. Estimates are the same without it.
    ///
    /// # Errors
    /// As [`step`](Self::step).
    pub fn prepare_start(&mut self, scan: &Scan) -> Result<(), TrackerError> {
        let sensor = match &self.sensor {
            Some(sensor) => sensor.clone(),
            None => Sensor::infer(std::slice::from_ref(scan), &self.config.sensor)?,
        };
        let (config, start) = (self.config.localizer.clone(), self.start.clone());
        let mut localizer = Localizer::new(&self.map, &sensor, config, start, self.config.seed)?;
        Ok(localizer.prepare_start(&sensor.timed(scan))?)
    }

    /// The map.
    pub fn map(&self) -> &Map {
        &self.map
    }

    /// The sensor, as far as it is known; `None` before the first scan, unless it was given.
    pub fn sensor(&self) -> Option<&Sensor> {
        self.sensor.as_ref()
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

    /// Takes a scan between those that are localized, which only the odometry needs.
    pub(crate) fn pass(&mut self, scan: &Scan) -> Result<(), TrackerError> {
        let scan = self.prepare(scan)?;
        if let Some(odometer) = &mut self.odometer {
            self.previous_from_current *= odometer.step(&scan)?.previous_from_current;
        }
        Ok(())
    }

    /// Measures the motion into the next scan since the last one that was localized; it is localized by
    /// [`step_with_motion`](Self::step_with_motion) afterwards. `Unknown` without odometry.
    ///
    /// # Errors
    /// The first scan has no points, from which the sensor is inferred, or times of scans do not ascend.
    pub fn measure(&mut self, scan: &Scan) -> Result<Odometry, TrackerError> {
        self.pass(scan)?;
        self.is_measured = true;
        let is_known = self.odometer.is_some();
        Ok(if is_known {
            Odometry::Motion(self.previous_from_current)
        } else {
            Odometry::Unknown
        })
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
        let scan = if self.is_measured {
            self.timed(scan)
        } else {
            self.odometer = None;
            self.prepare(scan)?
        };
        self.is_measured = false;
        let localizer = match self.localizer.take() {
            Some(localizer) => localizer,
            None => self.begin()?,
        };
        let localizer = self.localizer.insert(localizer);
        let estimate = localizer.step(&scan, odometry)?;
        // After an error the motion is still that since the last scan that was localized.
        self.previous_from_current = Pose3::identity();
        Ok(estimate)
    }

    /// The localizer before the first scan.
    fn begin(&self) -> Result<Localizer, TrackerError> {
        let sensor = self.sensor.as_ref().ok_or(SensorError::NoPoints)?;
        let (config, start) = (self.config.localizer.clone(), self.start.clone());
        let localizer = Localizer::new(&self.map, sensor, config, start, self.config.seed);
        Ok(localizer?)
    }

    /// Learns about the sensor from a scan; returns it with the times of its points.
    fn prepare<'a>(&mut self, scan: &'a Scan) -> Result<Cow<'a, Scan>, TrackerError> {
        let known = &self.config.sensor;
        let sensor = match self.sensor.take() {
            Some(sensor) => sensor,
            None => Sensor::infer(std::slice::from_ref(scan), known)?,
        };
        let sensor = self.sensor.insert(sensor);
        if let Some(shown) = &mut self.shown {
            shown.push(scan.clone());
            if shown.len() == TIMING_SCANS {
                // What cannot be learned from these scans may be learned from the next ones.
                let shown = std::mem::take(shown);
                if sensor.complete(&shown, known)? {
                    self.shown = None;
                }
                if let Some(localizer) = &mut self.localizer {
                    localizer.set_own_car(sensor.own_car_m);
                }
            }
        }
        Ok(self.timed(scan))
    }

    fn timed<'a>(&self, scan: &'a Scan) -> Cow<'a, Scan> {
        match &self.sensor {
            Some(sensor) => sensor.timed(scan),
            None => Cow::Borrowed(scan),
        }
    }
}

#[cfg(test)]
#[path = "tracker_tests.rs"]
mod tests;
