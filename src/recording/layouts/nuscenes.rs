//! nuScenes: an HDL-32E on a car, of which scenes of 20 s are published.
//!
//! Caesar et al., *nuScenes: A multimodal dataset for autonomous driving* (2020), and its schema: tables of records in JSON, joined
//! by tokens; files of float32 x, y, z, intensity, ring; times of the sweeps [µs]. Poses are those of the car, and the lidar is mounted
//! on it:
//!
//! ```text
//! world_from_lidar = world_from_ego(sweep) · ego_from_lidar(calibrated sensor)
//! ```
//!
//! The tables have up to a gigabyte: they are read record by record, and only those of the scene are kept.

use std::collections::BTreeMap;
use std::fmt;
use std::fs::{self, File};
use std::io::BufReader;
use std::marker::PhantomData;
use std::path::{Component, Path, PathBuf};

use nalgebra::Quaternion;
use serde::Deserialize;
use serde::de::{DeserializeOwned, DeserializeSeed, Deserializer, SeqAccess, Visitor};

use super::super::error::RecordingError;
use super::super::layout::{Layout, RecordingFiles};
use super::super::poses::check_time;
use super::super::scan_files::point_table::NumberType::F32;
use super::super::scan_files::records::{PointFormat, RecordFormat};
use super::super::scan_list::ScanFile;
use super::super::table::{position, rotation};
use super::named::{BodyPoses, NamedLayout, choose};
use crate::geometry::Pose3;

pub const NUSCENES: NamedLayout = NamedLayout {
    layout: Layout::Nuscenes,
    needs: "the tables v1.0-*/ next to samples/ and sweeps/",
    find,
    poses,
};

const POINTS: RecordFormat = RecordFormat::in_metres(&[
    ("x", F32),
    ("y", F32),
    ("z", F32),
    ("intensity", F32),
    ("ring", F32),
]);

/// The lidar.
const CHANNEL: &str = "LIDAR_TOP";

/// Most records of a table that are kept: all scenes, or what belongs to one of them.
const MOST_KEPT: usize = 100_000;

/// A scene.
#[derive(Deserialize)]
struct SceneRecord {
    token: String,
    name: String,
}

/// A moment of a scene.
#[derive(Deserialize)]
struct SampleRecord {
    token: String,
    scene_token: String,
}

/// A sensor.
#[derive(Deserialize)]
struct SensorRecord {
    token: String,
    channel: String,
}

/// A sensor as it is mounted on a car.
#[derive(Deserialize)]
struct CalibratedSensor {
    token: String,
    sensor_token: String,
    #[serde(flatten)]
    ego_from_sensor: TransformRecord,
}

/// Measurement of a sensor.
#[derive(Deserialize)]
struct SampleData {
    sample_token: String,
    ego_pose_token: String,
    calibrated_sensor_token: String,
    timestamp: f64,
    filename: PathBuf,
}

/// Pose of the car.
#[derive(Deserialize)]
struct EgoPose {
    token: String,
    #[serde(flatten)]
    world_from_ego: TransformRecord,
}

/// A pose as in the tables.
#[derive(Deserialize)]
struct TransformRecord {
    translation: [f64; 3],
    /// Quaternion w, x, y, z.
    rotation: [f64; 4],
}

/// A sweep of the lidar.
struct LidarSweep {
    time_s: f64,
    file: PathBuf,
    ego_pose_token: String,
    ego_from_lidar: Pose3,
}

fn find(folder: &Path, part: Option<&str>) -> Result<Option<RecordingFiles>, RecordingError> {
    let is_tables = |path: &PathBuf| {
        let name = path.file_name().unwrap_or_default();
        name.as_encoded_bytes().starts_with(b"v1.0-") && path.join("sample_data.json").is_file()
    };
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut tables: Vec<PathBuf> = entries.map(|it| it.path()).filter(is_tables).collect();
    tables.sort();
    let mut scenes = BTreeMap::new();
    for tables in &tables {
        for scene in kept(tables, "scene", |scene: SceneRecord| Some(scene.name))? {
            scenes.entry(scene).or_insert(tables);
        }
    }
    if scenes.is_empty() {
        return Ok(None);
    }
    // The loader of KISS-ICP has numbers of scenes.
    let is_number = |part: &&str| !part.is_empty() && part.bytes().all(|it| it.is_ascii_digit());
    let name = part
        .filter(is_number)
        .map(|number| format!("scene-{number:0>4}"));
    let names: Vec<String> = scenes.keys().cloned().collect();
    let scene = choose(folder, "scenes", &names, name.as_deref().or(part))?;
    let tables = scenes[scene];
    let sweeps = sweeps(tables, scene)?;
    let all = sweeps.len();
    let scan = |sweep: LidarSweep| (sweep.time_s, folder.join(sweep.file));
    let existing = sweeps
        .into_iter()
        .map(scan)
        .filter(|(_, path)| path.is_file());
    let listed: Vec<ScanFile> = (existing.enumerate())
        .map(|(number, (time_s, path))| ScanFile {
            number,
            path,
            time_s: Some(time_s),
        })
        .collect();
    if listed.len() < all {
        tracing::warn!(
            "{} of {all} sweeps of {scene} are not below {}: they are left out",
            all - listed.len(),
            folder.display()
        );
    }
    Ok(Some(RecordingFiles {
        format: PointFormat::records(&POINTS),
        listed: Some(listed),
        part: Some(scene.to_owned()),
        ..RecordingFiles::new(
            Layout::Nuscenes,
            folder.to_owned(),
            tables.join("ego_pose.json"),
        )
    }))
}

fn poses(files: &RecordingFiles, path: &Path) -> Result<BodyPoses, RecordingError> {
    let tables = path.parent().unwrap_or(path);
    let scene = files.part.as_deref().unwrap_or_default();
    let sweeps = sweeps(tables, scene)?;
    let rows: BTreeMap<&str, usize> = (sweeps.iter().enumerate())
        .map(|(row, sweep)| (sweep.ego_pose_token.as_str(), row))
        .collect();
    let mut found = kept(tables, "ego_pose", |pose: EgoPose| {
        Some((*rows.get(pose.token.as_str())?, pose.world_from_ego))
    })?;
    found.sort_by_key(|(row, _)| *row);
    let pose = |(row, world_from_ego): (usize, TransformRecord)| {
        let sweep = &sweeps[row];
        let world_from_ego = world_from_ego.pose(path)?;
        Ok((sweep.time_s, world_from_ego * sweep.ego_from_lidar))
    };
    let poses: Vec<(f64, Pose3)> = found.into_iter().map(pose).collect::<Result<_, _>>()?;
    if poses.is_empty() {
        let path = path.to_owned();
        return Err(RecordingError::NoPoses { path });
    }
    Ok(BodyPoses::timed(poses, Pose3::identity()))
}

/// The sweeps of the lidar in a scene, by their times.
fn sweeps(tables: &Path, scene: &str) -> Result<Vec<LidarSweep>, RecordingError> {
    let scenes = kept(tables, "scene", |it: SceneRecord| {
        (it.name == scene).then_some((it.token, ()))
    })?;
    let scenes: BTreeMap<String, ()> = scenes.into_iter().collect();
    let samples = kept(tables, "sample", |it: SampleRecord| {
        scenes
            .contains_key(&it.scene_token)
            .then_some((it.token, ()))
    })?;
    let samples: BTreeMap<String, ()> = samples.into_iter().collect();
    let sensors = kept(tables, "sensor", |it: SensorRecord| {
        (it.channel == CHANNEL).then_some((it.token, ()))
    })?;
    let sensors: BTreeMap<String, ()> = sensors.into_iter().collect();
    let lidars = kept(tables, "calibrated_sensor", |it: CalibratedSensor| {
        let is_lidar = sensors.contains_key(&it.sensor_token);
        is_lidar.then_some((it.token, it.ego_from_sensor))
    })?;
    let lidars: BTreeMap<String, TransformRecord> = lidars.into_iter().collect();
    let measured = kept(tables, "sample_data", |it: SampleData| {
        let is_sweep = lidars.contains_key(&it.calibrated_sensor_token)
            && samples.contains_key(&it.sample_token);
        is_sweep.then_some(it)
    })?;
    let path = tables.join("sample_data.json");
    let sweep = |it: SampleData| {
        let is_inside = |part: Component<'_>| matches!(part, Component::Normal(_));
        if !it.filename.components().all(is_inside) {
            return Err(RecordingError::BadTable {
                path: path.clone(),
                problem: format!(
                    "names {}, which is outside of its folder",
                    it.filename.display()
                ),
            });
        }
        Ok(LidarSweep {
            time_s: check_time(it.timestamp * 1e-6, &path, 0)?,
            file: it.filename,
            ego_pose_token: it.ego_pose_token,
            ego_from_lidar: lidars[&it.calibrated_sensor_token].pose(&path)?,
        })
    };
    let mut sweeps: Vec<LidarSweep> = measured.into_iter().map(sweep).collect::<Result<_, _>>()?;
    sweeps.sort_by(|a, b| a.time_s.total_cmp(&b.time_s));
    Ok(sweeps)
}

impl TransformRecord {
    fn pose(&self, path: &Path) -> Result<Pose3, RecordingError> {
        let [x, y, z] = self.translation;
        let [qw, qx, qy, qz] = self.rotation;
        let rotation = rotation(Quaternion::new(qw, qx, qy, qz), path, 0)?;
        Ok(Pose3::from_parts(position(x, y, z, path, 0)?, rotation))
    }
}

/// Reads a table record by record, and returns what `keep` keeps.
fn kept<T: DeserializeOwned, K>(
    tables: &Path,
    name: &str,
    keep: impl FnMut(T) -> Option<K>,
) -> Result<Vec<K>, RecordingError> {
    let path = tables.join(format!("{name}.json"));
    let file = File::open(&path).map_err(RecordingError::read(&path))?;
    let mut json = serde_json::Deserializer::from_reader(BufReader::new(file));
    let records = Records {
        keep,
        record: PhantomData,
    };
    (records.deserialize(&mut json)).map_err(|error| RecordingError::BadTable {
        problem: format!("is no table of nuScenes: {error}"),
        path,
    })
}

/// Records of a table, of which few are kept.
struct Records<T, F> {
    keep: F,
    record: PhantomData<T>,
}

impl<'de, T: Deserialize<'de>, K, F: FnMut(T) -> Option<K>> DeserializeSeed<'de> for Records<T, F> {
    type Value = Vec<K>;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Vec<K>, D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de, T: Deserialize<'de>, K, F: FnMut(T) -> Option<K>> Visitor<'de> for Records<T, F> {
    type Value = Vec<K>;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("a list of records")
    }

    fn visit_seq<A: SeqAccess<'de>>(mut self, mut records: A) -> Result<Vec<K>, A::Error> {
        let mut kept = Vec::new();
        while let Some(record) = records.next_element()? {
            kept.extend((self.keep)(record));
            if kept.len() > MOST_KEPT {
                let text = format!("more than {MOST_KEPT} records belong together");
                return Err(serde::de::Error::custom(text));
            }
        }
        Ok(kept)
    }
}
