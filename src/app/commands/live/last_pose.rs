//! The last confirmed pose of a run, next to its result: a restart begins there.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, ensure};
use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};
use serde::{Deserialize, Serialize};

use crate::app::run::output;
use crate::app::settings::LocalizationConfig;
use crate::file_path::FilePath;
use crate::files::folder_of;
use crate::geometry::{FARTHEST_M, Pose3};

/// Name of the file.
pub const FILE: &str = "last_pose.json";

/// Largest size of the file that is read [bytes].
const MOST_BYTES: u64 = 1 << 16;

/// Time between two writings: after a crash, a car is at most a few metres from the pose.
const INTERVAL: Duration = Duration::from_secs(1);

/// A confirmed pose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct LastPose {
    /// The map that it is in.
    map_file: FilePath,
    /// Size of the file of the map [bytes].
    map_bytes: u64,
    /// Time of its scan [s].
    time_s: f64,
    /// Position x, y, z [m], and quaternion x, y, z, w.
    map_from_lidar: [f64; 7],
}

/// Reads the pose in the map next to the result of a configuration; `None`, with a warning, where there is none yet.
pub fn read(config: &LocalizationConfig) -> Result<Option<Pose3>> {
    let path = path(config);
    if !path.exists() {
        tracing::warn!(
            "{} does not exist: the start is searched as without --start",
            path.display()
        );
        return Ok(None);
    }
    let read = || {
        let bytes = fs::metadata(&path)?.len();
        ensure!(bytes <= MOST_BYTES, "it has {bytes} bytes");
        let last: LastPose = serde_json::from_str(&fs::read_to_string(&path)?)?;
        let pose = last.pose().context("it has no pose on Earth")?;
        Ok((last, pose))
    };
    let (last, pose) = read().with_context(|| {
        let path = path.display();
        format!("{path} is no last pose of fpmcl; remove it, or start without --start last")
    })?;
    let map_file = &config.map_input.map_file;
    ensure!(
        last.map_bytes == bytes_of(map_file),
        "{} is a pose in the map {}, and {} is another one; start without --start last",
        path.display(),
        last.map_file.display(),
        map_file.display()
    );
    Ok(Some(pose))
}

impl LastPose {
    fn pose(&self) -> Option<Pose3> {
        let [x, y, z, i, j, k, w] = self.map_from_lidar;
        let quaternion = Quaternion::new(w, i, j, k);
        let is_on_earth = [x, y, z].iter().all(|it| it.abs() <= FARTHEST_M);
        (is_on_earth && (0.9..1.1).contains(&quaternion.norm())).then(|| {
            let rotation = UnitQuaternion::from_quaternion(quaternion);
            Isometry3::from_parts(Translation3::new(x, y, z), rotation)
        })
    }
}

fn path(config: &LocalizationConfig) -> PathBuf {
    folder_of(&config.result_path).join(FILE)
}

/// Size of a file; 0 where it cannot be known.
fn bytes_of(path: &Path) -> u64 {
    fs::metadata(path).map_or(0, |file| file.len())
}

/// Writes the last pose now and then.
pub struct LastPoseWriter {
    path: PathBuf,
    last: LastPose,
    written: Option<Instant>,
    is_current: bool,
    has_failed: bool,
}

impl LastPoseWriter {
    /// A writer next to the result of a configuration; `None` where no result is kept.
    pub fn new(config: &LocalizationConfig) -> Option<Self> {
        let map_file = &config.map_input.map_file;
        config.save_result.then(|| Self {
            path: path(config),
            last: LastPose {
                map_bytes: bytes_of(map_file),
                map_file: map_file.clone(),
                time_s: 0.0,
                map_from_lidar: [0.0; 7],
            },
            written: None,
            is_current: true,
            has_failed: false,
        })
    }

    /// Takes a confirmed pose; writes it if the last one was written a while ago.
    pub fn update(&mut self, time_s: f64, map_from_lidar: &Pose3) {
        let [x, y, z] = map_from_lidar.translation.vector.into();
        let [i, j, k, w] = map_from_lidar.rotation.coords.into();
        (self.last.time_s, self.last.map_from_lidar) = (time_s, [x, y, z, i, j, k, w]);
        self.is_current = false;
        if self
            .written
            .is_none_or(|written| written.elapsed() >= INTERVAL)
        {
            self.write();
        }
    }

    /// Writes the last pose, unless it is written. A disk that is full does not end the drive.
    pub fn write(&mut self) {
        if self.is_current {
            return;
        }
        (self.written, self.is_current) = (Some(Instant::now()), true);
        let written = output::write_json(&self.path, &self.last);
        if let Err(error) = &written
            && !self.has_failed
        {
            tracing::warn!("the last pose is not kept: {error:#}");
        }
        self.has_failed = written.is_err();
    }
}
