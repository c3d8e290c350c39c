//! Inputs of build-map, localize and refine: a recording with what is known about its sensor, and a map.

use std::path::Path;

use anyhow::{Context as _, Result};

use crate::app::run::{Context, input};
use crate::app::settings::{
    BuildMapConfig, LocalizationConfig, OdometryCommandConfig, RefinementConfig, body_from_lidar,
};
use crate::map::{Map, MapCache, MapOptions, MappingPath};
use crate::recording::{PoseTrack, Recording, Selection};
use crate::sensor::{MotionCompensation, RangeImageConfig, Sensor, SensorConfig};

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

    /// Reads the map and prepares it for rendering on the backend of the context, with its tiles next to it and the
    /// other options given.
    pub fn load(&self, options: MapOptions, context: &Context) -> Result<Map> {
        let options = MapOptions {
            backend: context.backend,
            cache: MapCache::NextToMap,
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
    pub fn resolve(self, recording: Recording) -> Result<(Recording, Sensor)> {
        let known = SensorConfig {
            range_image: self.range_image.clone(),
            own_car_m: *self.own_car_m,
            sensor_height_m: None,
            motion_compensation: *self.motion_compensation,
        };
        let sensor = Sensor::infer_recording(&recording, &known)?;
        self.range_image
            .resolve(&sensor.range_image, sensor.has_rows);
        *self.own_car_m = Some(sensor.own_car_m);
        *self.motion_compensation = sensor.motion_compensation;
        Ok((sensor.applied_to(recording), sensor))
    }
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
            pub fn open_in_map(&mut self, map: &Map) -> Result<(Recording, Sensor)> {
                let inputs = self.recording_inputs();
                let mut recording = inputs.open(&self.selection())?;
                if let Some(pose_file) = &self.pose_file {
                    let track = inputs.track(pose_file, &recording)?;
                    recording = recording.with_poses(track.in_map(&map.path.world_from_map))?;
                }
                let (recording, sensor) = self.sensor_keys().resolve(recording)?;
                Ok((recording, sensor.with_known(&self.known_sensor())))
            }
        })*
    };
}

inputs_in_map!(LocalizationConfig, RefinementConfig);
