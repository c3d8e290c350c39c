//! Inertial measurements of a recording: a table, KITTI's `oxts`, or a topic of its bag.
//!
//! A table has a row per measurement: a time, three angular rates, three specific forces, separated by commas or white
//! space. A header names its columns and may state their units; units that are not stated are found:
//!
//! ```text
//! time       from the time between rows: s, ms, µs or ns
//! forces     from their median: m/s² near 9.8, g near 1
//! rates      from their 99 % quantile: rad/s below 6, deg/s above 12
//! ```
//!
//! and refused where they are none of these. A wrong guess of rates is noticed where they are compared with the scans.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use nalgebra::{UnitQuaternion, Vector3};

#[cfg(feature = "bags")]
use super::bags::{TopicKind, transform_between};
use super::error::RecordingError;
use super::open::Recording;
#[cfg(feature = "bags")]
use super::open::is_topic;
use super::oxts;
use super::table::{parse_numbers, read_rows, read_text};
use crate::geometry::Pose3;
use crate::inertial::{
    GRAVITY_M_S2, Gyroscope, Imu, ImuCalibration, ImuSample, ImuSamples, MeasuredTurn,
};
use crate::statistics::median;

impl Recording {
    /// Reads the inertial sensor of this recording from a table, a folder `oxts`, or a topic of its bag. The rotation of its
    /// axes, where it is not given, is that of the calibration or of the static transforms, else unknown.
    ///
    /// # Errors
    /// The measurements cannot be read, or are none of an inertial sensor.
    pub fn read_imu(
        &self,
        source: &Path,
        lidar_from_imu: Option<UnitQuaternion<f64>>,
    ) -> Result<Imu, RecordingError> {
        let (samples, mounting) = self.read_measurements(source)?;
        let samples = ImuSamples::new(samples).map_err(|problem| RecordingError::BadImu {
            path: source.to_owned(),
            problem,
        })?;
        Ok(Imu {
            samples: Arc::new(samples),
            lidar_from_imu: lidar_from_imu.or(mounting),
        })
    }

    fn read_measurements(
        &self,
        source: &Path,
    ) -> Result<(Vec<ImuSample>, Option<UnitQuaternion<f64>>), RecordingError> {
        #[cfg(feature = "bags")]
        if let (Some((bag, scans)), true) = (&self.bag, is_topic(source)) {
            let topic = &bag.topic(TopicKind::Inertial, source.to_str())?.name;
            let (mut samples, frame) = bag.imu(topic)?;
            // The drivers of Livox write g.
            let per_unit = force_unit(source, &samples)?;
            samples
                .iter_mut()
                .for_each(|sample| sample.force_m_s2 *= per_unit);
            let lidar = bag.scan_frame(scans)?;
            let lidar_from_imu = transform_between(&bag.static_transforms()?, &lidar, &frame);
            return Ok((samples, lidar_from_imu.map(|pose| pose.rotation)));
        }
        if source.is_dir() {
            let lidar_from_imu = oxts::imu_from_lidar(source)?.cam0_from_lidar.inverse();
            return Ok((read_oxts(source)?, Some(lidar_from_imu.rotation)));
        }
        Ok((read_table(source)?, None))
    }

    /// The same recording with an inertial sensor, whose rates predict the rotations between and within the scans, and by which
    /// poses that are found from the scans are level.
    #[must_use]
    pub fn with_imu(self, imu: Imu) -> Self {
        if !self.has_times {
            tracing::warn!(
                "the inertial sensor is left out: the scans have no times; give them in times.txt"
            );
        } else if let Some(part) = self.uncovered(&imu.samples) {
            tracing::warn!("{part}");
        }
        Self {
            imu: Some(imu).filter(|_| self.has_times),
            ..self
        }
    }

    /// Warning if some scans are outside of the times of the measurements.
    fn uncovered(&self, samples: &ImuSamples) -> Option<String> {
        /// Largest difference of clocks, and duration of a scan [s].
        const MARGIN_S: f64 = 1.0;
        let [first_s, last_s] = samples.span_s();
        let covered = first_s - MARGIN_S..=last_s + MARGIN_S;
        let frames = self.frames.iter().chain(&self.skipped);
        let scans = frames.clone().count();
        let without = frames.filter(|it| !covered.contains(&it.time_s)).count();
        (0 < without && without < scans).then(|| {
            format!(
                "{without} of {scans} scans have no inertial measurements, which are from {first_s:.3} to {last_s:.3} s; give those of the whole drive"
            )
        })
    }

    /// The same recording with a calibrated gyroscope: its scans have the rotations that it has measured.
    #[must_use]
    pub fn with_gyroscope(mut self, gyroscope: Gyroscope) -> Self {
        let gyroscope = Arc::new(gyroscope);
        for frame in self.frames.iter_mut().chain(&mut self.skipped) {
            frame.gyroscope = Some(gyroscope.clone());
        }
        self
    }

    /// The same recording, whose inertial sensor is calibrated by the poses of the recording, or left out with a warning where
    /// it contradicts them.
    #[must_use]
    pub(crate) fn with_gyroscope_of_poses(mut self) -> Self {
        let (Some(imu), Some(track)) = (&self.imu, &self.track) else {
            return self;
        };
        let poses: Vec<(f64, Pose3)> = (self.dense_frames().iter())
            .filter_map(|frame| Some((frame.time_s, track.pose_at(frame, self.has_times)?)))
            .collect();
        let turn = |pair: &[(f64, Pose3)]| MeasuredTurn {
            from_s: pair[0].0,
            to_s: pair[1].0,
            turn: pair[0].1.rotation.inverse() * pair[1].1.rotation,
        };
        let turns: Vec<MeasuredTurn> = poses.windows(2).map(turn).collect();
        match ImuCalibration::estimate(imu, &turns) {
            Ok(calibration) => {
                let gyroscope = Gyroscope::new(imu, calibration);
                self.with_gyroscope(gyroscope)
            }
            Err(rejection) => {
                tracing::warn!("the inertial sensor is left out: {rejection}");
                self.imu = None;
                self
            }
        }
    }
}

/// Reads the columns `ax ay az` and `wx wy wz` of KITTI's `oxts/data`, and `oxts/timestamps.txt`.
fn read_oxts(oxts: &Path) -> Result<Vec<ImuSample>, RecordingError> {
    const COLUMNS: usize = 20;
    let read = |(path, time_s): (PathBuf, f64)| {
        let rows = read_rows(&path)?;
        let row = rows.first().map_or(&[][..], |(_, row)| row);
        let numbers = row.get(..COLUMNS);
        let numbers = numbers.ok_or_else(|| RecordingError::WrongCount {
            path: path.clone(),
            line: 1,
            found: row.len(),
            expected: 30,
            layout: "latitude longitude altitude ... ax ay az af al au wx wy wz ...",
        })?;
        Ok(ImuSample {
            time_s,
            rate_rad_s: Vector3::from_column_slice(&numbers[17..20]),
            force_m_s2: Vector3::from_column_slice(&numbers[11..14]),
        })
    };
    oxts::timed_files(oxts)?.into_iter().map(read).collect()
}

/// Reads a table.
fn read_table(path: &Path) -> Result<Vec<ImuSample>, RecordingError> {
    let text = read_text(path)?;
    let mut columns: Option<Columns> = None;
    let mut samples = vec![];
    for (line, row) in (1..).zip(text.lines().map(str::trim)) {
        let is_header = || {
            let first = words(row).next().unwrap_or_default();
            first.parse::<f64>().is_err()
        };
        if row.is_empty() || (row.starts_with('#') && columns.is_some()) {
            continue;
        }
        let found = match &columns {
            Some(found) => found,
            None if is_header() => {
                // A comment may be one before the header.
                match Columns::named(row) {
                    Some(named) => columns = Some(named),
                    None if row.starts_with('#') => {}
                    None => return Err(bad_columns(path, row)),
                }
                continue;
            }
            // Other columns may be anything: a magnetometer's, or an orientation.
            None if words(row).count() <= 7 => columns.insert(Columns::in_order()),
            None => return Err(bad_columns(path, row)),
        };
        let numbers = parse_numbers(&row.replace([',', ';'], " "), path, line)?;
        let at = |[x, y, z]: [usize; 3]| {
            Some(Vector3::new(
                *numbers.get(x)?,
                *numbers.get(y)?,
                *numbers.get(z)?,
            ))
        };
        let sample = (numbers.get(found.time).copied())
            .zip(at(found.rates).zip(at(found.forces)))
            .map(|(time_s, (rate_rad_s, force_m_s2))| ImuSample {
                time_s,
                rate_rad_s,
                force_m_s2,
            });
        samples.push(sample.ok_or_else(|| RecordingError::WrongCount {
            path: path.to_owned(),
            line,
            found: numbers.len(),
            expected: found.count(),
            layout: "time, three angular rates, three specific forces",
        })?);
    }
    let units = columns.unwrap_or_else(Columns::in_order).units;
    let per_time = units[0].map_or_else(|| time_unit(path, &samples), Ok)?;
    let per_rate = units[1].map_or_else(|| rate_unit(path, &samples), Ok)?;
    let per_force = units[2].map_or_else(|| force_unit(path, &samples), Ok)?;
    for sample in &mut samples {
        sample.time_s *= per_time;
        sample.rate_rad_s *= per_rate;
        sample.force_m_s2 *= per_force;
    }
    Ok(samples)
}

/// Words of a row, separated by commas or semicolons if it has some, else by white space.
fn words(row: &str) -> impl Iterator<Item = &str> {
    let has_marks = row.contains([',', ';']);
    let is_separator = move |letter: char| {
        if has_marks {
            matches!(letter, ',' | ';')
        } else {
            letter.is_whitespace()
        }
    };
    (row.trim_start_matches('#').trim().split(is_separator))
        .map(str::trim)
        .filter(|word| !word.is_empty())
}

/// The axis in the name of a column: x, y or z, as in `wx`, `gyro_x_rad_s` or `angular_velocity.x`.
fn axis_of(name: &str) -> Option<char> {
    const STEMS: [&str; 12] = [
        "", "a", "acc", "accel", "angvel", "force", "g", "gyr", "gyro", "omega", "rate", "w",
    ];
    let name = name.split(['[', '(']).next().unwrap_or_default().trim();
    let is_axis = |part: &&str| {
        let stem = part.strip_suffix(['x', 'y', 'z']);
        stem.is_some_and(|stem| STEMS.contains(&stem))
    };
    let mut parts = name.split(['_', '.', ' ', '/', '-']);
    parts.find(is_axis)?.chars().last()
}

fn bad_columns(path: &Path, header: &str) -> RecordingError {
    RecordingError::ImuColumns {
        path: path.to_owned(),
        header: header.chars().take(200).collect(),
    }
}

/// Columns of a table, and the units that its header states: of times, rates and forces.
#[derive(Clone, Debug, PartialEq)]
struct Columns {
    time: usize,
    rates: [usize; 3],
    forces: [usize; 3],
    units: [Option<f64>; 3],
}

impl Columns {
    fn in_order() -> Self {
        Self {
            time: 0,
            rates: [1, 2, 3],
            forces: [4, 5, 6],
            units: [None; 3],
        }
    }

    fn count(&self) -> usize {
        let last = self.rates.iter().chain(&self.forces).chain([&self.time]);
        last.max().map_or(0, |last| last + 1)
    }

    /// The columns that a header names; `None` if it does not name a time, three rates and three forces.
    fn named(header: &str) -> Option<Self> {
        let names: Vec<String> = words(header).map(str::to_lowercase).collect();
        let of = |is_one: &dyn Fn(&str) -> bool| -> Vec<usize> {
            let numbered = names.iter().enumerate();
            let found = numbered.filter(|(_, name)| is_one(name));
            found.map(|(column, _)| column).collect()
        };
        let has = |name: &str, parts: &[&str]| parts.iter().any(|part| name.contains(part));
        let is_rate = |name: &str| {
            has(name, &["gyr", "omega", "rate", "angular", "angvel"])
                || name.starts_with('w')
                || matches!(name, "gx" | "gy" | "gz")
        };
        let is_force =
            |name: &str| !is_rate(name) && (has(name, &["acc", "force"]) || name.starts_with('a'));
        // Seconds with their fraction, if that is in no other column.
        let is_whole = names.iter().any(|name| has(name, &["nsec", "nanosec"]));
        let times = of(&|name| {
            has(name, &["time", "stamp"]) || name == "t" || (name == "sec" && !is_whole)
        });
        // Boreas and others begin with z.
        let by_axis = |found: Vec<usize>| -> Option<[usize; 3]> {
            let mut columns: [usize; 3] = found.try_into().ok()?;
            let axis = |column: &usize| axis_of(&names[*column]);
            columns.sort_by_key(axis);
            match columns.map(|column| axis(&column)) {
                [Some('x'), Some('y'), Some('z')] | [None, None, None] => Some(columns),
                _ => None,
            }
        };
        let rates = by_axis(of(&is_rate))?;
        let forces = by_axis(of(&is_force))?;
        let time = *times.first()?;
        // The unit is what follows the name.
        let is_in = |column: usize, units: &[&str]| {
            units.iter().any(|unit| {
                let name = names[column].trim_end_matches([']', ')']);
                name.ends_with(unit) && name.len() > unit.len()
            })
        };
        let stated = |column: usize, units: &[(&[&str], f64)]| {
            let found = units.iter().find(|(words, _)| is_in(column, words));
            found.map(|(_, factor)| *factor)
        };
        Some(Self {
            time,
            rates,
            forces,
            units: [
                stated(
                    time,
                    &[
                        (&["_ns", "[ns", "(ns"], 1e-9),
                        (&["_us", "[us", "(us", "[µs"], 1e-6),
                        (&["_ms", "[ms", "(ms"], 1e-3),
                        (&["_s", "[s", "(s"], 1.0),
                    ],
                ),
                stated(
                    rates[0],
                    &[
                        (
                            &["deg_s", "deg/s", "deg s^-1", "dps", "deg_per_s", "°/s"],
                            1_f64.to_radians(),
                        ),
                        (&["rad_s", "rad/s", "rad s^-1", "rad_per_s"], 1.0),
                    ],
                ),
                stated(
                    forces[0],
                    &[
                        (
                            &["m_s2", "m/s2", "m/s^2", "m s^-2", "m/s²", "m_per_s2"],
                            1.0,
                        ),
                        (&["_mg", "[mg", "(mg"], 1e-3 * GRAVITY_M_S2),
                        (&["_g", "[g", "(g"], GRAVITY_M_S2),
                    ],
                ),
            ],
        })
    }
}

/// Seconds per unit of the times.
fn time_unit(path: &Path, samples: &[ImuSample]) -> Result<f64, RecordingError> {
    let steps = samples.windows(2);
    let period = median(steps.map(|pair| pair[1].time_s - pair[0].time_s)).unwrap_or_default();
    let units = [
        (1e-4, 0.5, 1.0),
        (0.5, 150.0, 1e-3),
        (150.0, 1.5e5, 1e-6),
        (1.5e5, 1e9, 1e-9),
    ];
    let found = units
        .iter()
        .find(|(least, most, _)| (*least..*most).contains(&period));
    found.map(|unit| unit.2).ok_or_else(|| {
        unknown_unit(
            path,
            "times",
            period,
            "between rows, neither s, ms, us nor ns",
        )
    })
}

/// Radians per second of the unit of the rates.
fn rate_unit(path: &Path, samples: &[ImuSample]) -> Result<f64, RecordingError> {
    const RADIANS: f64 = 6.0;
    const DEGREES: f64 = 12.0;
    let mut rates: Vec<f64> = samples
        .iter()
        .map(|sample| sample.rate_rad_s.norm())
        .collect();
    rates.sort_by(f64::total_cmp);
    let quantile = rates
        .get(99 * rates.len() / 100)
        .copied()
        .unwrap_or_default();
    match quantile {
        quantile if quantile < RADIANS => Ok(1.0),
        quantile if quantile > DEGREES => Ok(1_f64.to_radians()),
        _ => Err(unknown_unit(
            path,
            "angular rates",
            quantile,
            "at most, rad/s or deg/s",
        )),
    }
}

/// Metres per second squared of the unit of the forces.
fn force_unit(path: &Path, samples: &[ImuSample]) -> Result<f64, RecordingError> {
    let usual = median(samples.iter().map(|sample| sample.force_m_s2.norm())).unwrap_or_default();
    let is_near = |gravity: f64| (0.8 * gravity..1.25 * gravity).contains(&usual);
    if is_near(GRAVITY_M_S2) {
        Ok(1.0)
    } else if is_near(1.0) {
        Ok(GRAVITY_M_S2)
    } else {
        Err(unknown_unit(
            path,
            "specific forces",
            usual,
            "at rest, neither 9.8 m/s² nor 1 g; they must contain gravity",
        ))
    }
}

fn unknown_unit(
    path: &Path,
    quantity: &'static str,
    value: f64,
    of: &'static str,
) -> RecordingError {
    RecordingError::ImuUnit {
        path: path.to_owned(),
        quantity,
        value,
        of,
    }
}

/// Writes a table that is read back with its units.
pub(crate) fn write_table(
    mut writer: impl std::io::Write,
    samples: &[ImuSample],
) -> std::io::Result<()> {
    writeln!(
        writer,
        "time_s,gyro_x_rad_s,gyro_y_rad_s,gyro_z_rad_s,acc_x_m_s2,acc_y_m_s2,acc_z_m_s2"
    )?;
    for sample in samples {
        let [rate, force] = [sample.rate_rad_s, sample.force_m_s2];
        writeln!(
            writer,
            "{:.6},{:.7},{:.7},{:.7},{:.6},{:.6},{:.6}",
            sample.time_s, rate.x, rate.y, rate.z, force.x, force.y, force.z
        )?;
    }
    Ok(())
}

#[cfg(test)]
#[path = "imu_tests.rs"]
mod tests;
