//! Calibration of an inertial sensor by the first scans of a drive, which the odometry registers without it.
//!
//! It ends as soon as the axes of the sensor are known well enough to predict rotations between scans, or as soon as its rates
//! contradict those of the scans; see [`ImuCalibration::estimate`].

use super::config::OdometryConfig;
use super::odometer::{Odometer, OdometryError, OdometryEstimate};
use crate::inertial::{Gyroscope, Imu, ImuCalibration, ImuRejection, MeasuredTurn};
use crate::lidar::Scan;
use crate::validation::InvalidValue;

/// Finds the calibration of an inertial sensor, scan by scan.
#[derive(Clone, Debug)]
pub struct ImuCalibrator {
    imu: Imu,
    odometer: Odometer,
    /// Time of the last scan [s].
    time_s: Option<f64>,
    turns: Vec<MeasuredTurn>,
    /// Number of turns at which the calibration is tried next.
    next: usize,
}

impl ImuCalibrator {
    /// A calibration before the first scan.
    ///
    /// # Errors
    /// A field of the configuration is out of its range.
    pub fn new(imu: Imu, config: OdometryConfig) -> Result<Self, InvalidValue> {
        /// Number of turns of the first trial: twice those that an estimate needs, of which some may be outliers.
        const FIRST: usize = 64;
        Ok(Self {
            imu,
            odometer: Odometer::new(config)?,
            time_s: None,
            turns: vec![],
            next: FIRST,
        })
    }

    /// Registers the next scan; returns the sensor once it is calibrated, or why it is left out whatever follows.
    ///
    /// # Errors
    /// Times of scans do not ascend, or memory does not suffice.
    pub fn add(
        &mut self,
        scan: &Scan,
    ) -> Result<Option<Result<Gyroscope, ImuRejection>>, OdometryError> {
        let step = self.odometer.step(scan)?;
        let times_s = self.time_s.zip(scan.time_s);
        self.time_s = scan.time_s;
        (self.turns).extend(times_s.and_then(|times_s| measured_turn(&step, times_s)));
        if self.turns.len() < self.next {
            return Ok(None);
        }
        self.next *= 2;
        Ok(self.verdict())
    }

    /// The sensor, calibrated by all scans.
    ///
    /// # Errors
    /// The scans contradict the sensor, or do not show how it is mounted.
    pub fn finish(self) -> Result<Gyroscope, ImuRejection> {
        if self.time_s.is_none() {
            return Err(ImuRejection::NoTimes);
        }
        let calibration = ImuCalibration::estimate(&self.imu, &self.turns)?;
        Ok(Gyroscope::new(&self.imu, calibration))
    }

    /// The result, if more scans would not change it.
    fn verdict(&self) -> Option<Result<Gyroscope, ImuRejection>> {
        /// Largest standard deviation of the axes that suffices: it turns a rotation of 40 degrees between two scans by 0.7
        /// degrees, less than the odometry takes a prediction to be certain.
        const AXES_DEG: f64 = 1.0;
        /// Number of turns of which a contradiction is none by chance.
        const MANY: usize = 256;
        match ImuCalibration::estimate(&self.imu, &self.turns) {
            Ok(calibration) => (calibration.axes_sigma_rad.to_degrees() <= AXES_DEG)
                .then(|| Ok(Gyroscope::new(&self.imu, calibration))),
            Err(rejection) => {
                (rejection.is_contradiction() && self.turns.len() >= MANY).then_some(Err(rejection))
            }
        }
    }
}

/// The rotation into a scan between two times [s], if the scans determine it.
pub(super) fn measured_turn(
    step: &OdometryEstimate,
    (from_s, to_s): (f64, f64),
) -> Option<MeasuredTurn> {
    step.is_determined().then_some(MeasuredTurn {
        from_s,
        to_s,
        turn: step.previous_from_current.rotation,
    })
}
