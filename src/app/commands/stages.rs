//! Inputs of build-map, localize and refine: a recording with what is known about its sensor, and a map.

use std::path::Path;

use anyhow::{Context as _, Result};

use crate::app::run::{Context, input};
use crate::app::settings::{
    BuildMapConfig, LocalizationConfig, OdometryCommandConfig, RefinementConfig, body_from_lidar,
};
use crate::geometry::wrap_angle;
use crate::lidar::{LidarModel, PERIOD_S, Rotation, Scan};
use crate::map::build::scan_cloud::ScanConfig;
use crate::map::{Map, MapOptions, MappingPath};
use crate::odometry::{OdometryConfig, TimingComparison, compare_timings};
use crate::recording::{PoseTrack, Recording, Selection};
use crate::sensor::{self, DroppedPoints, MotionCompensation, RangeImageConfig, SensorDescription};

/// Number of scans from which a sensor is inferred.
const SENSOR_SCANS: usize = 10;

/// Keys of a recording.
#[derive(Clone, Copy)]
pub struct RecordingInputs<'a> {
    /// The folder, or the bag.
    pub scan_folder: &'a Path,
    /// Topic of the scans of a bag.
    pub topic: Option<&'a str>,
    /// Poses of the recording.
    pub pose_file: Option<&'a Path>,
    /// Calibration to which the poses belong.
    pub calib_file: Option<&'a Path>,
    /// Pose of the lidar on the body whose poses are given: x, y, z [m], roll, pitch, yaw [deg].
    pub body_from_lidar: Option<[f64; 6]>,
    /// Angle to add to the elevations of all points [deg].
    pub elevation_bias_deg: f64,
}

impl<'a> RecordingInputs<'a> {
    /// Checks that the files exist, before any work is done.
    pub fn require(&self) -> Result<()> {
        if !is_bag(self.scan_folder) {
            input::require_folder("scan_folder", self.scan_folder)?;
        }
        if let Some(path) = self.pose_file {
            self.require_poses("pose_file", path)?;
        }
        input::require_optional_file("calib_file", self.calib_file)
    }

    /// Requires a file of poses, a folder `oxts`, or a topic if the recording is a bag.
    pub fn require_poses(&self, key: &str, path: &Path) -> Result<()> {
        if path.is_dir() || (is_bag(self.scan_folder) && is_topic(path)) {
            return Ok(());
        }
        input::require_file(key, path)
    }

    /// The files and their keys.
    pub fn files(&self) -> Vec<(&'static str, &'a Path)> {
        let optional = [
            ("pose_file", self.pose_file),
            ("calib_file", self.calib_file),
        ];
        (optional.into_iter())
            .filter_map(|(key, path)| Some((key, path?)))
            .collect()
    }

    /// Opens the selected frames of the recording.
    pub fn open(&self, selection: &Selection) -> Result<Recording> {
        let mut recording = Recording::open_with(self.scan_folder, self.topic, selection)?;
        recording.body_from_lidar = self.body_from_lidar.map(body_from_lidar);
        Ok(recording.with_elevation_bias(self.elevation_bias_deg.to_radians()))
    }

    /// Reads poses of the recording from a file, or from a topic of its bag.
    pub fn track(&self, path: &Path, recording: &Recording) -> Result<PoseTrack> {
        #[cfg(feature = "bags")]
        if let (Some((bag, scan_topic)), true) = (&recording.bag, is_topic(path)) {
            return Ok(PoseTrack::read_topic(
                bag,
                path.to_str(),
                scan_topic,
                recording.body_from_lidar,
            )?);
        }
        #[cfg(not(feature = "bags"))]
        let _ = recording;
        self.file_track(path)
    }

    /// Reads poses of the recording from a file or a folder `oxts`.
    pub fn file_track(&self, path: &Path) -> Result<PoseTrack> {
        Ok(match self.body_from_lidar {
            Some(numbers) => PoseTrack::read_of_body(path, body_from_lidar(numbers))?,
            None => PoseTrack::read(path, self.calib_file)?,
        })
    }
}

/// Whether a path is that of a bag.
pub fn is_bag(path: &Path) -> bool {
    #[cfg(feature = "bags")]
    return crate::recording::bags::is_bag(path);
    #[cfg(not(feature = "bags"))]
    return {
        let _ = path;
        false
    };
}

/// Whether a path can be the name of a topic.
pub fn is_topic(path: &Path) -> bool {
    path.starts_with("/") && !path.exists()
}

/// Keys of a map.
pub struct MapInputs<'a> {
    /// The map.
    pub map_file: &'a Path,
    /// Poses that the map was built with; for maps of range-mcl.
    pub map_pose_file: Option<&'a Path>,
    /// Calibration that the map was built with; for maps of range-mcl.
    pub map_calib_file: Option<&'a Path>,
}

impl<'a> MapInputs<'a> {
    /// The files and their keys.
    pub fn files(&self) -> Vec<(&'static str, &'a Path)> {
        let mut files = vec![("map_file", self.map_file)];
        files.extend(self.map_pose_file.map(|path| ("map_pose_file", path)));
        files.extend(self.map_calib_file.map(|path| ("map_calib_file", path)));
        files
    }

    /// Reads the map and prepares it for rendering on the backend of the context, with the other options given.
    pub fn load(&self, options: MapOptions, context: &Context) -> Result<Map> {
        let options = MapOptions {
            backend: context.backend,
            ..options
        };
        let map = Map::load_with_path(self.map_file, self.given_path()?, &options)
            .with_context(|| format!("map_file is {}", self.map_file.display()))?;
        self.report_frame(&map.path);
        tracing::info!(
            "map {}: {} triangles in {} tiles, rendered by {}",
            self.map_file.display(),
            map.triangle_count(),
            map.tiles.len(),
            map.renderer.name()
        );
        Ok(map)
    }

    /// The path of the mapping drive from the files of the configuration.
    fn given_path(&self) -> Result<Option<MappingPath>> {
        let Some(poses) = self.map_pose_file else {
            return Ok(None);
        };
        input::require_file("map_pose_file", poses)?;
        input::require_optional_file("map_calib_file", self.map_calib_file)?;
        let track = PoseTrack::read(poses, self.map_calib_file)?;
        Ok(Some(MappingPath {
            world_from_map: track.world_from_map,
            map_from_lidar: track.map_from_lidar,
        }))
    }

    /// Reports the frame of a map without a mapping drive.
    fn report_frame(&self, path: &MappingPath) {
        if !path.map_from_lidar.is_empty() {
            return;
        }
        let map = self.map_file.display();
        tracing::info!(
            "{map} has no mapping path: poses are in its own frame, and a start on the road is one anywhere; for a map of range-mcl, give map_pose_file and map_calib_file"
        );
        let origin = path.world_from_map.translation.vector;
        if origin.norm() > 0.0 {
            tracing::warn!(
                "the origin of {map} is moved by ({:.0}, {:.0}, {:.0}) m, because its coordinates are large: results are relative to it",
                origin.x,
                origin.y,
                origin.z
            );
        }
    }
}

/// Keys of the sensor that are inferred where they are not given.
pub struct SensorKeys<'a> {
    /// Projection and limits of range.
    pub range_image: &'a mut RangeImageConfig,
    /// Box of the own car.
    pub own_car_m: &'a mut Option<[f32; 4]>,
    /// Times of the points.
    pub motion_compensation: &'a mut Option<MotionCompensation>,
}

impl SensorKeys<'_> {
    /// Sets what is not given from the scans; returns the recording, whose points have times if they are known.
    pub fn resolve(
        self,
        mut recording: Recording,
    ) -> Result<(Recording, Option<SensorDescription>)> {
        if self.motion_compensation.is_none() {
            recording = recording.compensated();
        }
        let is_given = RangeImageConfig::of(&self.range_image.model());
        let is_complete = RangeImageConfig {
            has_rows: None,
            max_instance: None,
            render_instanced: None,
            ..self.range_image.clone()
        } == is_given
            && self.own_car_m.is_some();
        let is_auto = *self.motion_compensation == Some(MotionCompensation::Auto);
        if let (Some(configured), false) = (*self.motion_compensation, is_auto) {
            warn_of_contradiction(&recording, configured)?;
        }
        if is_complete && !is_auto {
            return Ok((rotating(recording, *self.motion_compensation), None));
        }
        let scans = sample(&recording)?;
        let sensor = sensor::infer(&scans);
        tracing::info!("sensor: {}", description(&sensor));
        let own_car_m = apply(&sensor, self.range_image, self.own_car_m);
        warn_of_dropped_points(&scans, &self.range_image.model(), own_car_m);
        if is_auto && scans.iter().all(|scan| scan.times_s.is_empty()) {
            let is_spinning = sensor.has_rows && sensor.horizontal_fov_deg > SPINNING_DEG;
            *self.motion_compensation = match is_spinning {
                true => fitting_rotation(&recording)?,
                false => None,
            };
        }
        Ok((rotating(recording, *self.motion_compensation), Some(sensor)))
    }
}

/// Sets the keys of a sensor that are not given; returns the box of the own car.
pub fn apply(
    sensor: &SensorDescription,
    range_image: &mut RangeImageConfig,
    own_car_m: &mut Option<[f32; 4]>,
) -> [f32; 4] {
    range_image.resolve(&sensor.lidar, sensor.has_rows);
    *own_car_m.get_or_insert(match sensor.is_moving {
        true => sensor.own_car_m,
        false => ScanConfig::default().own_car_m,
    })
}

/// The recording, whose points have times from the rotation of the sensor where the data have none.
fn rotating(recording: Recording, compensation: Option<MotionCompensation>) -> Recording {
    let period_s = period_s(&recording);
    let rotation = compensation.and_then(|it| it.rotation(period_s));
    recording.rotating(rotation)
}

/// Adds the inputs of a configuration that names a recording.
macro_rules! recording_inputs {
    ($($config:ty),*) => {
        $(impl $config {
            /// The recording with its poses.
            pub fn recording_inputs(&self) -> RecordingInputs<'_> {
                RecordingInputs {
                    scan_folder: &self.scan_folder,
                    topic: self.topic.as_deref(),
                    pose_file: self.pose_file.as_deref(),
                    calib_file: self.calib_file.as_deref(),
                    body_from_lidar: self.body_from_lidar,
                    elevation_bias_deg: self.elevation_bias_deg,
                }
            }
        })*
    };
}

recording_inputs!(
    BuildMapConfig,
    OdometryCommandConfig,
    LocalizationConfig,
    RefinementConfig
);

/// Adds the sensor of a configuration that describes it.
macro_rules! sensor_keys {
    ($($config:ty),*) => {
        $(impl $config {
            /// The keys of the sensor.
            pub fn sensor_keys(&mut self) -> SensorKeys<'_> {
                SensorKeys {
                    range_image: &mut self.range_image,
                    own_car_m: &mut self.own_car_m,
                    motion_compensation: &mut self.motion_compensation,
                }
            }
        })*
    };
}

sensor_keys!(BuildMapConfig, LocalizationConfig, RefinementConfig);

/// Adds the inputs of a configuration that names also a map.
macro_rules! inputs_in_map {
    ($($config:ty),*) => {
        $(impl $config {
            /// The map.
            pub fn map_inputs(&self) -> MapInputs<'_> {
                MapInputs {
                    map_file: &self.map_file,
                    map_pose_file: self.map_pose_file.as_deref(),
                    map_calib_file: self.map_calib_file.as_deref(),
                }
            }

            /// All input files and their keys.
            pub fn input_files<'a>(&'a self, context: &'a Context) -> Vec<(&'static str, &'a Path)> {
                let mut files = self.map_inputs().files();
                files.extend(self.recording_inputs().files());
                let odometry = self.odometry_file.as_deref();
                files.extend(odometry.map(|path| ("odometry_file", path)));
                files.extend(context.input());
                files
            }

            /// Opens the selected frames, with the true poses in the frame of the map, and completes the
            /// configuration by what the scans show about the sensor.
            pub fn open_in_map(&mut self, map: &Map) -> Result<Recording> {
                let inputs = self.recording_inputs();
                let mut recording = inputs.open(&self.selection())?;
                if let Some(pose_file) = &self.pose_file {
                    let track = inputs.track(pose_file, &recording)?;
                    recording = recording.with_poses(track.in_map(&map.path.world_from_map))?;
                }
                Ok(self.sensor_keys().resolve(recording)?.0)
            }
        })*
    };
}

inputs_in_map!(LocalizationConfig, RefinementConfig);

/// Horizontal field of view from which on a sensor is taken for one that spins [deg].
const SPINNING_DEG: f32 = 300.0;

/// Duration of a revolution: the time between scans with consecutive numbers, if that is plausible [s].
fn period_s(recording: &Recording) -> f64 {
    let [first, .., last] = recording.frames.as_slice() else {
        return PERIOD_S;
    };
    let period_s = (last.time_s - first.time_s) / (last.number - first.number) as f64;
    match recording.has_times && (0.03..0.3).contains(&period_s) {
        true => period_s,
        false => PERIOD_S,
    }
}

/// The rotation that makes consecutive scans fit best; `None` if they fit best as they are, or if nothing shows it.
fn fitting_rotation(recording: &Recording) -> Result<Option<MotionCompensation>> {
    let Some(compared) = compared_timings(recording)? else {
        return Ok(None);
    };
    let best = compared.best.map(|best| compared.residuals_m[best].0);
    let name = best.map_or("undecided, none".to_owned(), timing_in_words);
    tracing::info!(
        "motion compensation: {name}; distances between scans: {}",
        residuals_in_words(&compared)
    );
    Ok(best.flatten().map(|best| MotionCompensation::of(&best)))
}

/// Warns if another rotation than the configured one makes consecutive scans fit best.
fn warn_of_contradiction(recording: &Recording, configured: MotionCompensation) -> Result<()> {
    /// Starts of the revolution that are nearer are the same [rad].
    const SAME_START_RAD: f64 = 0.5;
    let Some(compared) = compared_timings(recording)? else {
        return Ok(());
    };
    let configured = configured.rotation(PERIOD_S);
    let is_same = |found: Rotation, configured: Rotation| {
        let apart_rad = wrap_angle(found.start_rad - configured.start_rad).abs();
        found.direction == configured.direction && apart_rad < SAME_START_RAD
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
fn timing_in_words(timing: Option<Rotation>) -> String {
    match timing {
        None => "compensated already".to_owned(),
        Some(rotation) => {
            let text = MotionCompensation::of(&rotation).to_string();
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

/// Compares the times of points by the distances between consecutive scans; `None` if the data have times, or if
/// the scans are too few or too far apart.
fn compared_timings(recording: &Recording) -> Result<Option<TimingComparison>> {
    /// Number of scans, from the middle of the recording.
    const SCANS: usize = 16;
    /// Longest time between scans in which a sensor moves evenly [s].
    const MAX_STEP_S: f64 = 0.35;
    let frames = &recording.frames;
    let first = frames.len().saturating_sub(SCANS) / 2;
    let run = &frames[first..(first + SCANS).min(frames.len())];
    let is_dense = (run.windows(2)).all(|pair| pair[1].time_s - pair[0].time_s < MAX_STEP_S);
    if run.len() < SCANS / 2 || !is_dense {
        return Ok(None);
    }
    let scans: Vec<Scan> = run
        .iter()
        .map(|frame| frame.read())
        .collect::<Result<_, _>>()?;
    if scans.iter().any(|scan| !scan.times_s.is_empty()) {
        return Ok(None);
    }
    let config = OdometryConfig::default();
    Ok(Some(compare_timings(&scans, period_s(recording), &config)?))
}

/// Some scans, spread over the recording.
pub fn sample(recording: &Recording) -> Result<Vec<Scan>> {
    let count = recording.frames.len();
    let step = count.div_ceil(SENSOR_SCANS).max(1);
    let frames = recording.frames.iter().step_by(step);
    Ok(frames.map(|frame| frame.read()).collect::<Result<_, _>>()?)
}

/// The sensor in words.
pub fn description(sensor: &SensorDescription) -> String {
    let model = &sensor.lidar;
    let rows = match sensor.beams {
        Some(beams) => format!("{beams} beams"),
        None => "points without rows".to_owned(),
    };
    let elevations = model.elevations.as_deref();
    let highest = elevations
        .and_then(|rows| rows.first())
        .unwrap_or(&model.fov_up);
    let lowest = -model.fov_down.abs();
    let lowest = elevations.and_then(|rows| rows.last()).unwrap_or(&lowest);
    let mut text = format!(
        "{rows} from {highest:+.1} to {lowest:+.1} degrees, image {} x {}, ranges {:.1} to {:.0} m",
        model.height, model.width, model.min_range, model.max_range
    );
    if let Some(mounting) = &sensor.mounting {
        text += &format!(", {:.2} m above the ground", mounting.height_m);
    }
    text
}

/// Warns if more than a fifth of the points are dropped, with the reason that drops most.
fn warn_of_dropped_points(scans: &[Scan], model: &LidarModel, own_car_m: [f32; 4]) {
    /// Share of the points.
    const WARNED: f64 = 0.2;
    let mut dropped = DroppedPoints::default();
    for scan in scans {
        dropped.add(&DroppedPoints::count(scan, model, own_car_m));
    }
    for (reason, share) in dropped.above(WARNED) {
        tracing::warn!(
            "{:.0} % of the points are not used: they {}; see {}",
            100.0 * share,
            reason.description(),
            reason.keys()
        );
    }
}
