//! What precedes the localization of a scan and needs no map: the sensor, the times of its points, and the motion to it.

use std::borrow::Cow;
use std::sync::Arc;
use std::thread::{self, JoinHandle};

use super::error::TrackerError;
use super::odometry::MotionOfScans;
use crate::lidar::Scan;
use crate::odometry::{Odometer, OdometryConfig};
use crate::sensor::{Sensor, SensorConfig, SensorError, TIMING_SCANS};
use crate::validation::InvalidValue;

/// The half of a [`Tracker`](super::Tracker) that needs no map. The sensor is given, else inferred: from the first scan, its own
/// car and the times of points once scans in motion show them.
pub struct FrontEnd {
    known: SensorConfig,
    /// `None` before the first scan, unless it was given.
    sensor: Option<Arc<Sensor>>,
    /// The last scans, while an inferred sensor is not complete.
    shown: Option<Vec<Scan>>,
    /// Whether no scan waits for the sensor to be completed.
    is_real_time: bool,
    /// The thread in which it is completed.
    completing: Option<JoinHandle<Result<Completed, SensorError>>>,
    odometry: Option<OdometryConfig>,
    /// `None` where it is not wanted, and since it missed a scan.
    odometer: Option<Odometer>,
    /// Motion over the scans since the last one that was measured.
    since_measured: MotionOfScans,
}

/// A sensor and whether scans showed all of it.
type Completed = (Sensor, bool);

/// What is known about a scan before it is localized.
#[derive(Clone, Debug)]
pub struct Measured {
    pub(super) sensor: Arc<Sensor>,
    /// The scan with the times of its points, where it lacked them.
    pub(super) timed: Option<Scan>,
    /// Motion since the last scan that was measured; `None` without odometry.
    pub(super) motion: Option<MotionOfScans>,
}

impl FrontEnd {
    pub(super) fn new(
        known: SensorConfig,
        odometry: Option<OdometryConfig>,
    ) -> Result<Self, InvalidValue> {
        let sensor = Sensor::configured(&known).map(Arc::new);
        Ok(Self {
            shown: sensor.is_none().then(Vec::new),
            is_real_time: false,
            completing: None,
            sensor,
            odometer: odometry.clone().map(Odometer::new).transpose()?,
            odometry,
            since_measured: MotionOfScans::default(),
            known,
        })
    }

    pub(super) fn set_sensor(&mut self, sensor: Sensor) {
        self.sensor = Some(Arc::new(sensor.with_known(&self.known)));
        self.shown = None;
    }

    pub(super) fn set_real_time(&mut self) {
        self.is_real_time = true;
    }

    /// Forgets all scans but what they showed about the sensor.
    pub(super) fn restart(&mut self) -> Result<(), InvalidValue> {
        self.odometer = self.odometry.clone().map(Odometer::new).transpose()?;
        self.since_measured = MotionOfScans::default();
        Ok(())
    }

    pub(super) fn sensor(&self) -> Option<&Sensor> {
        self.sensor.as_deref()
    }

    /// The sensor, as far as it is known, else as a scan shows it.
    pub(super) fn sensor_in(&self, scan: &Scan) -> Result<Arc<Sensor>, SensorError> {
        if let Some(sensor) = &self.sensor {
            return Ok(sensor.clone());
        }
        let sensor = Sensor::infer(std::slice::from_ref(scan), &self.known)?;
        Ok(Arc::new(sensor))
    }

    /// Takes a scan between those that are localized, which only the odometry needs.
    ///
    /// # Errors
    /// As [`measure`](Self::measure).
    pub fn pass(&mut self, scan: &Scan) -> Result<(), TrackerError> {
        self.advance(scan)?;
        Ok(())
    }

    /// Measures the motion into the next scan that is localized.
    ///
    /// # Errors
    /// The first scan has no points, from which the sensor is inferred, or times of scans do not ascend.
    pub fn measure(&mut self, scan: &Scan) -> Result<Measured, TrackerError> {
        let (sensor, timed) = self.advance(scan)?;
        let motion = std::mem::take(&mut self.since_measured);
        Ok(Measured {
            sensor,
            timed,
            motion: self.odometer.is_some().then_some(motion),
        })
    }

    /// Prepares a scan whose motion is given: the odometry of the scans ends with it.
    pub(super) fn unmeasured(&mut self, scan: &Scan) -> Result<Measured, TrackerError> {
        self.odometer = None;
        self.measure(scan)
    }

    /// Takes the next scan; returns its sensor, and the scan with the times of its points where it lacked them.
    fn advance(&mut self, scan: &Scan) -> Result<(Arc<Sensor>, Option<Scan>), TrackerError> {
        let sensor = self.learn(scan)?;
        let timed = sensor.timed(scan);
        if let Some(odometer) = &mut self.odometer {
            let of_scan = (&odometer.step(&timed)?).into();
            self.since_measured = self.since_measured.followed_by(of_scan);
        }
        let timed = match timed {
            Cow::Borrowed(_) => None,
            Cow::Owned(timed) => Some(timed),
        };
        Ok((sensor, timed))
    }

    /// The sensor, about which a scan may show more.
    fn learn(&mut self, scan: &Scan) -> Result<Arc<Sensor>, SensorError> {
        let sensor = self.sensor_in(scan)?;
        self.sensor = Some(sensor.clone());
        // A thread that panicked has learned nothing.
        let finished = self.completing.take_if(|it| it.is_finished());
        if let Some(Ok(completed)) = finished.map(JoinHandle::join) {
            let completed = completed?;
            return Ok(self.take(completed));
        }
        let is_waiting = self.completing.is_some();
        let Some(shown) = self.shown.as_mut().filter(|_| !is_waiting) else {
            return Ok(sensor);
        };
        shown.push(scan.clone());
        if shown.len() < TIMING_SCANS {
            return Ok(sensor);
        }
        let (shown, known) = (std::mem::take(shown), self.known.clone());
        let before = Sensor::clone(&sensor);
        let complete = move || {
            let mut sensor = before;
            let is_complete = sensor.complete(&shown, &known)?;
            Ok((sensor, is_complete))
        };
        if !self.is_real_time {
            let completed = complete()?;
            return Ok(self.take(completed));
        }
        self.completing = Some(thread::spawn(move || {
            // The other cores are for the scans.
            let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
            match pool {
                Ok(pool) => pool.install(complete),
                Err(_) => complete(),
            }
        }));
        Ok(sensor)
    }

    /// Takes over a sensor. What could not be learned from these scans may be learned from the next ones.
    fn take(&mut self, (sensor, is_complete): Completed) -> Arc<Sensor> {
        if is_complete {
            self.shown = None;
        }
        self.sensor.insert(Arc::new(sensor)).clone()
    }
}
