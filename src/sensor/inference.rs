//! The sensor of some scans, or of a recording: what is given, else what the scans show.

use std::borrow::Cow;

use super::beams::{self, BeamSource};
use super::config::{MotionCompensation, SensorConfig};
use super::dropped::DroppedPoints;
use super::mounting::{self, Surroundings};
use super::{Sensor, columns, own_car, projection, raw, rotation};
use crate::geometry::wrap_angle;
use crate::lidar::{LidarModel, PERIOD_S, PointTiming, Scan};
use crate::odometry::{OdometryConfig, TimingComparison, TimingError, compare_timings, fits_best};
use crate::recording::{Frame, Recording, RecordingError};

/// Number of scans from which a sensor is inferred.
pub const SENSOR_SCANS: usize = 10;

/// What to set where nothing shows the times of the points.
const SET_TIMES: &str = "set motion_compensation to null if they are compensated, else to order, clockwise or counter_clockwise";

/// Number of consecutive scans that show the times of points.
pub const TIMING_SCANS: usize = 16;

/// Why a sensor cannot be inferred, or a scan does not match it.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the messages are the documentation")]
pub enum SensorError {
    #[error(transparent)]
    Recording(#[from] RecordingError),
    #[error(transparent)]
    Timing(#[from] TimingError),
    #[error("the scans have no points that show the sensor; give the sensor, or other scans")]
    NoPoints,
    #[error(
        "{:.0} % of the points of the scan are outside the field of view of the sensor ({sensor}); give the sensor of these scans, or leave it unset, so that it is inferred",
        100.0 * share
    )]
    OtherSensor { sensor: Box<Sensor>, share: f64 },
}

impl Sensor {
    /// The sensor of some scans: one suffices for the beams, ten of a drive for the rest, better spread over some
    /// seconds than neighbours. What is known takes precedence.
    ///
    /// # Errors
    /// No scan has a point with a direction.
    pub fn infer(scans: &[Scan], known: &SensorConfig) -> Result<Self, SensorError> {
        let scans: Vec<Scan> = scans.iter().map(valid_points).collect();
        let scans: &[Scan] = &scans;
        if scans.iter().all(Scan::is_empty) {
            return Err(SensorError::NoPoints);
        }
        let beams = beams::find(scans);
        let horizontal_fov_deg = columns::horizontal_fov_deg(scans);
        let columns = columns::count(&beams);
        let surroundings = Surroundings::of(scans);
        let own_car = own_car::find(&surroundings);
        let sensor = Self {
            range_image: projection::model(scans, &beams, columns, own_car.near_m),
            has_rows: beams.source != BeamSource::None,
            beams: beams.nominal,
            beam_source: beams.source,
            columns,
            horizontal_fov_deg,
            mounting: mounting::find(&surroundings),
            sensor_height_m: None,
            own_car_m: own_car.rectangle_m,
            is_moving: own_car.is_moving,
            period_s: rotation::period_s(scans, horizontal_fov_deg),
            rotation: rotation::direction(scans, horizontal_fov_deg),
            motion_compensation: Some(MotionCompensation::Auto),
            scans: scans.len(),
        };
        Ok(sensor.with_known(known))
    }

    /// The sensor of a recording, from ten of its scans, and from consecutive ones of its middle for the times of the
    /// points where the data have none. What is known takes precedence; a rotation that contradicts the scans is a
    /// warning.
    ///
    /// # Errors
    /// A scan cannot be read, or memory does not suffice to compare the timings of points.
    pub fn infer_recording(
        recording: &Recording,
        known: &SensorConfig,
    ) -> Result<Self, SensorError> {
        Self::infer_with_expected(recording, known, None)
    }

    /// The sensor of a recording that is expected to be of a known one, such as that of the map: the rotation of that one is taken if it
    /// fits clearly best, without a comparison with all others.
    ///
    /// # Errors
    /// As [`infer_recording`](Self::infer_recording).
    pub fn infer_with_expected(
        recording: &Recording,
        known: &SensorConfig,
        expected: Option<&Self>,
    ) -> Result<Self, SensorError> {
        let is_auto = known.motion_compensation == Some(MotionCompensation::Auto);
        if let (Some(configured), false) = (known.motion_compensation, is_auto) {
            warn_of_contradiction(recording, configured)?;
        }
        if let (Some(sensor), false) = (Self::configured(known), is_auto) {
            return Ok(sensor);
        }
        let mut scans = spread_scans(recording)?;
        if known.motion_compensation.is_none() {
            scans.iter_mut().for_each(|scan| scan.times_s.clear());
        }
        let mut sensor = Self::infer_spread(recording, &scans, known)?;
        tracing::info!("sensor: {sensor}");
        sensor.warn_of_dropped_points(&scans);
        if is_auto && scans.iter().all(|scan| scan.times_s.is_empty()) {
            sensor.motion_compensation =
                sensor.timing(&scans, || timings_of_recording(recording, expected))?;
        }
        Ok(sensor)
    }

    /// The sensor of [`spread_scans`] of a recording, whose times show the period where those of the points do not.
    pub(crate) fn infer_spread(
        recording: &Recording,
        scans: &[Scan],
        known: &SensorConfig,
    ) -> Result<Self, SensorError> {
        let sensor = Self::infer(scans, known)?;
        Ok(Self {
            period_s: sensor.period_s.or_else(|| period_s(recording)),
            ..sensor
        })
    }

    /// The sensor of a configuration from which nothing about range images, rows and own car is missing.
    pub(crate) fn configured(known: &SensorConfig) -> Option<Self> {
        let sensor = Self::new(known.range_image.or(&LidarModel::default())).with_known(known);
        (SensorConfig::from(&sensor) == *known).then_some(sensor)
    }

    /// The same sensor, with what is known.
    #[must_use]
    pub fn with_known(mut self, known: &SensorConfig) -> Self {
        self.range_image = known.range_image.or(&self.range_image);
        self.has_rows = known.has_rows.unwrap_or(self.has_rows);
        self.beams = self.beams.filter(|_| self.has_rows);
        self.own_car_m = known.own_car_m.unwrap_or(self.own_car_m);
        self.sensor_height_m = known.sensor_height_m.or(self.sensor_height_m);
        if known.motion_compensation != Some(MotionCompensation::Auto) {
            self.motion_compensation = known.motion_compensation;
        }
        self
    }

    /// Completes a sensor that was inferred from its first scans by more of them, consecutive ones: own car, period and
    /// times of the points, where they are not known. Returns whether the scans show them, which needs motion.
    pub(crate) fn complete(
        &mut self,
        scans: &[Scan],
        known: &SensorConfig,
    ) -> Result<bool, SensorError> {
        let valid: Vec<Scan> = scans.iter().map(valid_points).collect();
        let own_car = own_car::find(&Surroundings::of(&valid));
        if !own_car.is_moving {
            return Ok(false);
        }
        self.is_moving = true;
        self.own_car_m = known.own_car_m.unwrap_or(own_car.rectangle_m);
        self.period_s = self.period_s.or_else(|| {
            let times = (scans.iter().enumerate())
                .filter_map(|(number, scan)| Some((number, scan.time_s?)));
            rotation::interval_s(&times.collect::<Vec<_>>())
        });
        if self.motion_compensation == Some(MotionCompensation::Auto)
            && scans.iter().all(|scan| scan.times_s.is_empty())
        {
            let interval_s = self.period_s.unwrap_or(PERIOD_S);
            self.motion_compensation = self.timing(scans, || timings_of(scans, interval_s))?;
        }
        Ok(true)
    }

    /// The recording, whose points have times where the data have none; without motion compensation, times of the data
    /// are ignored.
    pub fn applied_to(&self, recording: Recording) -> Recording {
        let Some(compensation) = self.motion_compensation else {
            return recording.compensated();
        };
        let interval_s = period_s(&recording).unwrap_or(PERIOD_S);
        recording.timed(compensation.timing(interval_s))
    }

    /// A scan whose points have times where the data have none; without motion compensation, times of the data are
    /// ignored.
    pub(crate) fn timed<'a>(&self, scan: &'a Scan) -> Cow<'a, Scan> {
        let timing =
            (self.motion_compensation).and_then(|it| it.timing(self.period_s.unwrap_or(PERIOD_S)));
        let mut timed = match (self.motion_compensation, timing) {
            (None, _) if !scan.times_s.is_empty() => scan.clone(),
            (Some(_), Some(_)) if scan.times_s.is_empty() => scan.clone(),
            _ => return Cow::Borrowed(scan),
        };
        timed.times_s.clear();
        if let Some(timing) = timing {
            timed.times_s = timing.point_times(&timed);
            timed.center_times();
        }
        Cow::Owned(timed)
    }

    /// Requires that the points of a scan are in the field of view.
    ///
    /// # Errors
    /// More than a fifth of the points are outside of the field of view of the sensor.
    pub fn require_fit(&self, scan: &Scan) -> Result<(), SensorError> {
        let dropped = DroppedPoints::count(scan, &self.range_image, self.own_car_m);
        let share = dropped.share_outside();
        if share > DroppedPoints::TOO_MANY {
            let sensor = Box::new(self.clone());
            return Err(SensorError::OtherSensor { sensor, share });
        }
        Ok(())
    }

    /// Whether the sensor sees nearly all around, in rows.
    fn is_spinning(&self) -> bool {
        /// Horizontal field of view [deg].
        const SPINNING_DEG: f32 = 300.0;
        self.has_rows && self.horizontal_fov_deg > SPINNING_DEG
    }

    /// The times of the points of some scans that have none, by a comparison of consecutive ones, or by their order
    /// where they are as measured; `None` if they fit best as they are, or if nothing shows it.
    pub(super) fn timing(
        &self,
        scans: &[Scan],
        compare: impl FnOnce() -> Result<Option<TimingComparison>, SensorError>,
    ) -> Result<Option<MotionCompensation>, SensorError> {
        if !self.is_spinning() {
            return Ok(None);
        }
        let are_raw = || {
            let scans: Vec<Scan> = scans.iter().map(valid_points).collect();
            self.is_moving && raw::are_raw(&scans, &self.range_image)
        };
        let Some(compared) = compare()? else {
            if are_raw() {
                tracing::warn!(
                    "motion compensation: undecided, none; the scans look as measured, but are too few or too far apart to show the times of their points; {SET_TIMES}"
                );
            }
            return Ok(None);
        };
        let residuals = residuals_in_words(&compared);
        let fitting = compared.best.map(|best| compared.residuals_m[best].0);
        let ordered = || match compared.residuals_m.as_slice() {
            [_, (order @ Some(PointTiming::Order { .. }), _)] => are_raw().then_some(*order),
            _ => None,
        };
        let Some(best) = fitting.or_else(ordered) else {
            if self.is_moving {
                tracing::warn!(
                    "motion compensation: undecided, none; distances between scans: {residuals}; {SET_TIMES}"
                );
            } else {
                tracing::info!("motion compensation: none, as the sensor does not move");
            }
            return Ok(None);
        };
        tracing::info!(
            "motion compensation: {}; distances between scans: {residuals}",
            timing_in_words(best)
        );
        let interval_s = self.period_s.unwrap_or(PERIOD_S);
        Ok(best.map(|best| MotionCompensation::of(&best, interval_s)))
    }

    /// Warns of each reason that drops too many of the points.
    fn warn_of_dropped_points(&self, scans: &[Scan]) {
        let mut dropped = DroppedPoints::default();
        for scan in scans {
            dropped.add(&DroppedPoints::count(
                scan,
                &self.range_image,
                self.own_car_m,
            ));
        }
        for (reason, share) in dropped.above(DroppedPoints::TOO_MANY) {
            tracing::warn!(
                "{:.0} % of the points are not used: they {}; see {}",
                100.0 * share,
                reason.description(),
                reason.keys()
            );
        }
    }
}

/// The points with a direction.
fn valid_points(scan: &Scan) -> Scan {
    /// Nearer points are marks of missing returns, and have no accurate direction [m].
    const NEAREST_M: f32 = 0.1;
    let any_range = LidarModel {
        min_range: NEAREST_M,
        max_range: f32::MAX,
        ..LidarModel::default()
    };
    let mut scan = scan.clone();
    scan.drop_invalid(&any_range);
    scan
}

/// Ten scans, spread over a recording.
pub fn spread_scans(recording: &Recording) -> Result<Vec<Scan>, RecordingError> {
    let step = recording.frames.len().div_ceil(SENSOR_SCANS).max(1);
    let frames = recording.frames.iter().step_by(step);
    frames.map(Frame::read).collect()
}

/// Duration of a revolution: the time between scans with consecutive numbers, if it was recorded and is plausible [s].
fn period_s(recording: &Recording) -> Option<f64> {
    let frames = recording.frames.iter();
    let numbered: Vec<_> = frames.map(|frame| (frame.number, frame.time_s)).collect();
    rotation::interval_s(&numbered).filter(|_| recording.has_times)
}

/// Warns if other times than the configured ones make consecutive scans fit best.
fn warn_of_contradiction(
    recording: &Recording,
    configured: MotionCompensation,
) -> Result<(), SensorError> {
    /// Starts of the revolution that are nearer are the same [rad].
    const SAME_START_RAD: f64 = 0.5;
    let scans = timing_scans(recording)?;
    if !show_times(&scans) {
        return Ok(());
    }
    let period_s = period_s(recording).unwrap_or(PERIOD_S);
    let (configured, config) = (configured.timing(period_s), OdometryConfig::default());
    if let Some(timing) = configured
        && fits_best(timing, &scans, &config)?.is_some()
    {
        return Ok(());
    }
    let compared = compare_timings(&scans, period_s, &config)?;
    let is_same = |found: PointTiming, configured: PointTiming| match (found, configured) {
        (PointTiming::Rotation(found), PointTiming::Rotation(configured)) => {
            let apart_rad = wrap_angle(found.start_rad - configured.start_rad).abs();
            found.direction == configured.direction && apart_rad < SAME_START_RAD
        }
        (PointTiming::Order { .. }, PointTiming::Order { .. }) => true,
        _ => false,
    };
    if let Some(best) = compared.best.map(|best| compared.residuals_m[best].0)
        && !(best.zip(configured)).is_some_and(|(best, configured)| is_same(best, configured))
    {
        tracing::warn!(
            "the scans fit best as {}, not as motion_compensation says; distances between scans: {}",
            timing_in_words(best),
            residuals_in_words(&compared)
        );
    }
    Ok(())
}

/// Times of points in words, as the key has them.
fn timing_in_words(timing: Option<PointTiming>) -> String {
    match timing {
        None => "compensated already".to_owned(),
        Some(PointTiming::Order { .. }) => "order".to_owned(),
        Some(rotation) => {
            let text = MotionCompensation::of(&rotation, PERIOD_S).to_string();
            text.replace("counter_clockwise", "counter-clockwise")
        }
    }
}

fn residuals_in_words(compared: &TimingComparison) -> String {
    let residuals = compared.residuals_m.iter();
    let words: Vec<String> = residuals
        .map(|(timing, m)| format!("{} {:.1} mm", timing_in_words(*timing), 1e3 * m))
        .collect();
    words.join(", ")
}

/// Compares the times of points by the distances between successive scans nearest the middle of a recording, first with the
/// rotation of an expected sensor.
fn timings_of_recording(
    recording: &Recording,
    expected: Option<&Sensor>,
) -> Result<Option<TimingComparison>, SensorError> {
    let scans = timing_scans(recording)?;
    let period_s = period_s(recording).unwrap_or(PERIOD_S);
    let expected = expected.and_then(|it| it.motion_compensation?.timing(period_s));
    if let Some(rotation @ PointTiming::Rotation(_)) = expected
        && show_times(&scans)
        && let Some(compared) = fits_best(rotation, &scans, &OdometryConfig::default())?
    {
        return Ok(Some(compared));
    }
    timings_of(&scans, period_s)
}

/// The successive scans nearest the middle of a recording; none if all are far apart.
fn timing_scans(recording: &Recording) -> Result<Vec<Scan>, SensorError> {
    let frames = &recording.frames;
    let middle = frames.len().saturating_sub(TIMING_SCANS) / 2;
    let is_dense =
        |run: &&[Frame]| are_dense(&run.iter().map(|frame| frame.time_s).collect::<Vec<_>>());
    let runs = frames
        .windows(TIMING_SCANS.clamp(1, frames.len().max(1)))
        .enumerate();
    let dense = runs.filter(|(_, run)| is_dense(run));
    let nearest = dense.min_by_key(|(first, _)| first.abs_diff(middle));
    let run = nearest.map_or_else(Default::default, |(_, run)| run);
    Ok(run.iter().map(Frame::read).collect::<Result<_, _>>()?)
}

/// Compares the times of points by the distances between consecutive scans; `None` if these do not show them.
fn timings_of(scans: &[Scan], period_s: f64) -> Result<Option<TimingComparison>, SensorError> {
    if !show_times(scans) {
        return Ok(None);
    }
    let config = OdometryConfig::default();
    Ok(Some(compare_timings(scans, period_s, &config)?))
}

/// Whether consecutive scans may show the times of their points: the data have none, and the scans are enough and near each
/// other.
fn show_times(scans: &[Scan]) -> bool {
    let times_s: Vec<f64> = scans.iter().filter_map(|scan| scan.time_s).collect();
    let are_timed = scans.iter().any(|scan| !scan.times_s.is_empty());
    !are_timed && scans.len() >= TIMING_SCANS / 2 && are_dense(&times_s)
}

/// Whether a sensor moves evenly between scans.
fn are_dense(times_s: &[f64]) -> bool {
    /// Longest time between scans [s].
    const MAX_STEP_S: f64 = 0.35;
    (times_s.windows(2)).all(|pair| pair[1] - pair[0] < MAX_STEP_S)
}
