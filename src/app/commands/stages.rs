//! Inputs of build-map, localize and refine: a recording with what is known about its sensor, and a map.

use std::path::Path;

use anyhow::{Context as _, Result};
use serde_json::{Value, json};

use crate::app::report::run_output;
use crate::app::run::arguments::yaml;
use crate::app::run::input::is_bag;
use crate::app::run::{Context, input, memory};
use crate::app::settings::{
    GnssInputConfig, InertialConfig, MapInputConfig, MotionSourceConfig, OdometrySource,
    PoseInputConfig, RecordingConfig,
};
use crate::file_path::text_of;
use crate::map::{Map, MapCache, MapOptions, MappingPath};
use crate::mapping::calibrated;
use crate::odometry::{GnssConstraints, OdometryConfig};
use crate::recording::{PoseTrack, Recording, RecordingError, is_topic};
use crate::sensor::{MotionCompensation, Sensor, SensorConfig};

/// Values of keys, as those of `--set`.
pub fn settings_of(keys: &[(&str, Value)]) -> Vec<(String, String)> {
    let keys = keys.iter();
    keys.map(|(key, value)| ((*key).to_owned(), yaml(value)))
        .collect()
}

/// A path as the value of a key.
pub fn path_value(path: &Path) -> Value {
    json!(text_of(path))
}

/// A recording, and the poses that are given with it.
#[derive(Clone, Copy)]
pub struct RecordingInputs<'a> {
    /// The folder or bag, and the frames.
    pub recording: &'a RecordingConfig,
    /// Poses of the recording.
    pub poses: &'a PoseInputConfig,
}

impl<'a> RecordingInputs<'a> {
    /// The inputs of a configuration.
    pub fn new(recording: &'a RecordingConfig, poses: &'a PoseInputConfig) -> Self {
        Self { recording, poses }
    }

    /// The folder or bag and the files, which are not those that are topics of the bag, and their keys.
    pub fn files(&self) -> Vec<(&'static str, &'a Path)> {
        let folder = self.recording.scan_folder.as_path();
        let mut files = vec![("scan_folder", folder)];
        let poses = self.poses.pose_file.as_deref();
        let poses = poses.and_then(|path| self.recording.file(path));
        files.extend(poses.map(|path| ("pose_file", path)));
        let calibration = self.poses.calib_file.as_deref();
        files.extend(calibration.map(|path| ("calib_file", path)));
        files
    }

    /// Opens the selected frames of the recording.
    pub fn open(&self) -> Result<Recording> {
        let config = self.recording;
        let topic = config.topic.as_deref();
        let mut recording = Recording::open_with(
            &config.scan_folder,
            config.layout,
            topic,
            &config.frames,
            memory::budget(),
        )?;
        recording.body_from_lidar = self.poses.body_from_lidar();
        Ok(recording.with_elevation_bias(config.elevation_bias_deg.to_radians()))
    }

    /// Opens the selected frames, with the true poses in the frame of a map, and completes what is known about the sensor
    /// by what the scans show. `found` is what an earlier command inferred from the same scans: nothing is inferred again where it is
    /// complete and equal to what is known.
    pub fn open_in_map(
        &self,
        map: &Map,
        known: &mut SensorConfig,
        found: Option<&SensorConfig>,
    ) -> Result<(Recording, Sensor)> {
        let mut recording = self.open()?;
        if let Some(pose_file) = &self.poses.pose_file {
            let track = self.track(pose_file, &recording)?;
            recording = recording.with_truth(track.in_map(&map.path.world_from_map))?;
        }
        let is_complete = known.motion_compensation != Some(MotionCompensation::Auto);
        let found = found.filter(|found| is_complete && *found == known);
        let sensor = match found.and_then(Sensor::configured) {
            Some(sensor) => sensor,
            None => Sensor::infer_with_expected(&recording, known, map.path.sensor.as_ref())?,
        };
        *known = SensorConfig::from(&sensor);
        Ok((sensor.applied_to(recording), sensor))
    }

    /// Reads poses of the recording from a file, or from a topic of its bag.
    pub fn track(&self, path: &Path, recording: &Recording) -> Result<PoseTrack> {
        Ok(recording.read_track(path, self.poses.calib_file.as_deref())?)
    }
}

impl RecordingConfig {
    /// What is read with the recording, unless it is a topic of its bag.
    pub fn file<'a>(&self, path: &'a Path) -> Option<&'a Path> {
        let is_in_bag = is_topic(path) && is_bag(&self.scan_folder);
        (!is_in_bag).then_some(path)
    }
}

impl InertialConfig {
    /// The file of the measurements, which is not a topic of the bag, and its key.
    pub fn files(&self, recording: &RecordingConfig) -> Option<(&'static str, &Path)> {
        Some(("imu_file", recording.file(self.imu_file.as_deref()?)?))
    }

    /// The recording with its inertial sensor, where one is named.
    pub fn open(&self, recording: Recording) -> Result<Recording> {
        let Some(path) = &self.imu_file else {
            return Ok(recording);
        };
        let imu = recording.read_imu(path, self.lidar_from_imu())?;
        Ok(recording.with_imu(imu))
    }

    /// The recording with the rotations of its inertial sensor, where one is named, which is calibrated by the odometry of the
    /// first scans, or left out with a warning where it contradicts them.
    pub fn open_calibrated(
        &self,
        recording: Recording,
        odometry: &OdometryConfig,
        context: &Context,
    ) -> Result<Recording> {
        let recording = self.open(recording)?;
        let interrupt = &context.interrupt;
        let recording = calibrated(recording, odometry, &|_| interrupt.flow())
            .map_err(|error| interrupt.explain(error))?;
        if let Some((name, found)) = run_output::inertial(self, &recording.frames) {
            tracing::info!("{name}: {found}");
        }
        Ok(recording)
    }
}

impl PoseInputConfig {
    /// Reads poses from a file or a folder `oxts`.
    pub fn track(&self, path: &Path) -> Result<PoseTrack> {
        let calibration = self.calib_file.as_deref();
        Ok(PoseTrack::read_mounted(
            path,
            calibration,
            self.body_from_lidar(),
        )?)
    }
}

impl GnssInputConfig {
    /// The file and its key, if it is not a topic of the bag.
    pub fn file(&self, recording: &RecordingConfig) -> Option<(&'static str, &Path)> {
        Some(("gnss_file", recording.file(self.gnss_file.as_deref()?)?))
    }

    /// Reads the positions of a recording, where there are some.
    pub fn read(&self, recording: &Recording) -> Result<Option<GnssConstraints>, RecordingError> {
        let Some(path) = &self.gnss_file else {
            return Ok(None);
        };
        let fixes = recording.read_fixes(path)?;
        tracing::info!(
            "{}: {} fixes, {} messages without a position, {} damaged lines",
            path.display(),
            fixes.fixes.len(),
            fixes.without_position,
            fixes.bad_lines
        );
        Ok(Some(GnssConstraints {
            fixes,
            config: self.errors.clone(),
        }))
    }
}

/// Completes what is known about the sensor by what the scans show; returns the recording, whose points have times if they
/// are known.
pub fn infer(known: &mut SensorConfig, recording: Recording) -> Result<(Recording, Sensor)> {
    let sensor = Sensor::infer_recording(&recording, known)?;
    *known = SensorConfig::from(&sensor);
    Ok((sensor.applied_to(recording), sensor))
}

/// All inputs of a command that localizes, which exist, and their keys.
pub fn input_files<'a>(
    inputs: RecordingInputs<'a>,
    map: &'a MapInputConfig,
    motion: &'a MotionSourceConfig,
    context: &'a Context,
) -> Result<Vec<(&'static str, &'a Path)>> {
    let mut files = map.files();
    files.extend(inputs.files());
    let is_used = matches!(motion.odometry, OdometrySource::File | OdometrySource::Auto);
    let is_file = |path: &&Path| !(is_topic(path) && is_bag(&inputs.recording.scan_folder));
    let odometry = (motion.odometry_file.as_deref()).filter(|path| is_used && is_file(path));
    files.extend(odometry.map(|path| ("odometry_file", path)));
    input::require(&files)?;
    files.extend(context.input());
    Ok(files)
}

impl MapInputConfig {
    /// The files and their keys.
    pub fn files(&self) -> Vec<(&'static str, &Path)> {
        let mut files = vec![("map_file", self.map_file.as_path())];
        files.extend(
            self.map_pose_file
                .as_deref()
                .map(|path| ("map_pose_file", path)),
        );
        files.extend(
            self.map_calib_file
                .as_deref()
                .map(|path| ("map_calib_file", path)),
        );
        files
    }

    /// Reads the map and prepares it for rendering on the backend of the context, with its tiles next to it and the
    /// other options given.
    pub fn load(&self, options: MapOptions, context: &Context) -> Result<Map> {
        let options = MapOptions {
            backend: context.backend,
            cache: MapCache::NextToMap,
            memory_budget: memory::budget(),
            ..options
        };
        let map = Map::load_with_path(&self.map_file, self.given_path()?, &options)
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
        let Some(poses) = &self.map_pose_file else {
            return Ok(None);
        };
        let track = PoseTrack::read(poses, self.map_calib_file.as_deref())?;
        Ok(Some(MappingPath {
            world_from_map: track.world_from_map,
            map_from_lidar: track.map_from_lidar,
            ..MappingPath::default()
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
